"""Noise whose std grows with the predicted value."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from scipy import stats

from probcal import (
    MAP,
    Bernoulli,
    Bias,
    Censored,
    Channel,
    ConstantVelocity,
    Gaussian,
    Known,
    Mixture,
    Network,
    Node,
    Problem,
    StudentT,
    Target,
    Unknown,
    fit,
    sensor,
    simulate,
)
from probcal.errors import InputError
from probcal.gaussian.information import growing_square
from probcal.geometry import norm
from probcal.inference.ending import misfit_sentence
from probcal.model.model import At
from probcal.model.rows import parameter_score
from probcal.modes import automatic_start
from probcal.modes.grid import follow_states, grid_start
from probcal.noise import Growing, Grows, Normal, level_at

FAMILIES = [Normal(), StudentT(4.0), Mixture(0.2, 6.0, late="exponential")]


@pytest.mark.ci
@pytest.mark.parametrize("inner", FAMILIES, ids=repr)
@pytest.mark.parametrize("predicted", [3.0, -8.0])
def test_growing_noise_agrees_with_its_density(inner, predicted):
    """It integrates to one; score by the predicted value, level score and information follow from it."""
    family, e = Growing(inner, 0.2), np.sinh(np.linspace(-9.0, 9.0, 100_001))
    with jax.enable_x64(True):
        y = jnp.asarray(predicted + 0.7 * e)
        at, std = jnp.full(e.shape, predicted), jnp.full(e.shape, 0.5)
        p = np.exp(family.log_likelihood(y, at, std, None))
        by_predicted = jax.jvp(lambda m: family.log_likelihood(y, m, std, None), (at,), (jnp.ones_like(at),))[1]
        by_level = jax.jvp(lambda s: family.log_likelihood(y, at, s, None), (std,), (std,))[1]
        np.testing.assert_allclose(family.score(y, at, std, None), by_predicted, atol=1e-9, rtol=1e-9)
        np.testing.assert_allclose(family.level_score(y, at, std, None), 1 + by_level, atol=1e-9, rtol=1e-9)
        information = float(family.information(at[:1], std[:1])[0])
        weight = np.asarray(family.weight(y, at, std, None))
        drawn = np.asarray(family.sample(jax.random.key(0), at[:50_000], std[:50_000]))
    assert np.trapezoid(p, y) == pytest.approx(1.0, abs=1e-5)
    assert np.trapezoid(p * np.asarray(by_predicted) ** 2, y) == pytest.approx(information, rel=1e-5)
    least = 1.0 / (0.25 + (0.2 * predicted) ** 2)
    assert information > least or inner != Normal(), "the std tells of the predicted value too"
    assert (weight > 0).all()
    below = np.concatenate([[0.0], np.cumsum(0.5 * (p[1:] + p[:-1]) * np.diff(y))])
    assert stats.kstest(drawn, lambda value: np.interp(value, y, below)).pvalue > 1e-3


@pytest.mark.parametrize("inner", FAMILIES, ids=repr)
def test_squares_are_one_under_the_model(inner):
    family, one = Growing(inner, 0.02), np.ones(20_000, np.float32)

    @jax.jit
    def squares(predicted, std):
        return family.square(family.sample(jax.random.key(1), predicted, std), predicted, std)

    assert np.mean(squares(10.0 * one, 0.03 * one)) == pytest.approx(1.0, abs=0.05)


def test_a_square_is_large_where_the_prediction_is_far_off():
    """The standardised score is near one there, since the std is as wide as the residual."""
    family, y, far, std = Growing(Normal(), 0.02), np.array([10.0]), np.array([500.0]), np.array([0.03])
    scored = jax.jit(lambda: family.score(y, far, std, None) ** 2 / family.information(far, std))()
    assert float(scored[0]) == pytest.approx(1.0, abs=0.01)
    assert float(jax.jit(family.square)(y, far, std)[0]) > 1000.0


def walked(slope, noise=None, key=0):
    """A walk of 40 s seen by four range sensors: the problem, and the true positions (E, 2)."""
    start = {"position": ((30.0, 30.0), 10.0), "velocity": ((0.0, 0.0), 2.0)}
    network, motion = ranges(Grows(0.03, slope), noise), Target(ConstantVelocity(0.5), start)
    run = simulate(network, motion, np.arange(0.0, 40.0), key=key, share=1.0)
    return Problem(network, motion, run.table), run.truth.tracks[["position_x", "position_y"]].to_numpy()


def away(point, path):
    """Root mean square distance in m of the track at a point from the true positions."""
    return float(np.sqrt(np.mean(np.sum((np.asarray(point.states[0])[:, :2] - path) ** 2, 1))))


@pytest.mark.ci
@pytest.mark.parametrize(
    ("noise", "key"),
    [(Normal(), 2), (Normal(), 9), pytest.param(FAMILIES[1], 9, marks=pytest.mark.slow), (FAMILIES[2], 9)],
    ids=repr,
)
def test_a_start_finds_the_track_where_the_std_grows(noise, key):
    """With the std at the prediction those of Gaussian noise end 38 and 145 m away."""
    problem, path = walked(0.02, noise, key)
    with jax.enable_x64(True):
        assert away(grid_start(problem, jnp.zeros(len(problem.labels))), path) < 4.0  # offsets are 0.5 m


@pytest.mark.slow
def test_a_fit_finds_the_track_where_the_std_grows():
    """With the std at the prediction it ends 18 m away, and says that it converged."""
    problem, path = walked(0.02, key=9)
    tree = fit(problem, MAP(), prior=Gaussian())
    track = tree["track/target"].to_dataset().sel(component=["position_x", "position_y"])
    assert tree.attrs["status"] == "converged"
    assert np.mean(((track["mean"].values - path) / track["sd"].values) ** 2) < 4.0


@pytest.mark.ci
def test_a_wrong_mode_of_growing_noise_is_a_misfit():
    """Residuals of a track moved aside count, though its mean square is far below 100."""
    problem, _ = walked(0.1)
    with jax.enable_x64(True):
        point = automatic_start(problem)
        assert misfit_sentence(problem, point, 1.0) == ""
        states = np.array(point.states[0])
        states[:, 0] += 10.0
        moved = follow_states(problem, [states])
        assert 3.0 < growing_square(problem.model, moved) < 100.0
        assert re.search("ended in a wrong mode: mean square .* leaves", misfit_sentence(problem, moved, 1.0))
        pairs = zip(problem.model.values, problem.model.predict(point), strict=True)
        wide = problem.redrawn([np.asarray(y) + 4.0 * np.asarray(y - predicted) for y, predicted in pairs])
        at = automatic_start(wide)
        assert growing_square(wide.model, at) > 9.0
        assert misfit_sentence(wide, at, 1.0).startswith("The fit explains nothing")


def ranges(std, noise=None, dimension=2):
    """Ranges of four nodes whose noise is that of a declaration."""

    @sensor(range=Channel("m", std=std, noise=noise or Normal()))
    def gauge(target, pose, *, range_offset=Bias("m", 0.5)):
        return dict(range=norm(target.position - pose.position) + range_offset)

    places = [(0, 0, 0), (60, 0, 5), (60, 60, 0), (0, 60, 5)]
    return Network([gauge.on(Node(f"g{k}", p[:dimension])) for k, p in enumerate(places)])


@pytest.mark.ci
@pytest.mark.parametrize(
    "noise",
    [Normal(), pytest.param(Mixture(Unknown(0.2), 6.0, late="exponential"), marks=pytest.mark.slow)],
    ids=["normal", "mixture"],
)
def test_the_slopes_by_both_levels_are_those_of_the_evidence(noise):
    """By differences of sum log p - spread I / 2, rows with a std of their own held."""
    rng, time = np.random.default_rng(1), np.arange(20.0)
    path = np.stack([10 + 2 * time, 30 + 10 * np.sin(time / 4)], 1)
    table = pd.concat(
        [pd.DataFrame({"time": time, "sensor": f"g{k}", "range": np.linalg.norm(path - p, axis=1)}) for k, p in
         enumerate([(0, 0), (60, 0)])]
    )  # fmt: skip
    table["range"] += (0.3 + 0.02 * table["range"]) * rng.normal(size=len(table))
    table["range_std"] = np.where(np.arange(len(table)) < 5, 0.4, np.nan)
    problem = Problem(ranges(Grows(Unknown(0.3), Unknown(0.02)), noise), ConstantVelocity(0.3), table)
    labels = [own.label for own in problem.levels]
    assert {"gauge.range_std", "gauge.range_slope"} <= set(labels)
    with jax.enable_x64(True):
        model = problem.model
        states = np.concatenate([path, np.zeros_like(path)], 1)
        point = At((jnp.asarray(states),), jnp.zeros(model.biases), jnp.asarray(0.2 * np.arange(1.0, len(labels) + 1)))
        predicted = model.predict(point)[0]
        spread = jnp.asarray(rng.uniform(1e-3, 1e-2, predicted.shape))

        def told(levels):
            at = point._replace(levels=levels)
            return float(jnp.sum(model.log_likelihood(at)[0] - 0.5 * spread * model.information(at)[0]))

        slope, information, chosen = parameter_score(model.blocks[0], model.rows[0], predicted, point.levels, spread)
        for h in range(len(labels)):
            step = 1e-5 * jnp.eye(len(labels))[h]
            difference = (told(point.levels + step) - told(point.levels - step)) / 2e-5
            assert float(slope[h]) == pytest.approx(difference, rel=1e-4, abs=1e-5)
            assert float(information[h, h]) > 0
        assert (np.asarray(chosen)[:-1] > 0).all()
        wide = np.asarray(model.spread_of_noise(point)[0])[:, 0]
        std = np.where(np.arange(len(table)) < 5, 0.4, 0.3 * np.exp(point.levels[labels.index("gauge.range_std")]))
        own = level_at(0.02, False, float(point.levels[labels.index("gauge.range_slope")]))
        np.testing.assert_allclose(wide, np.hypot(std, own * np.asarray(predicted)[:, 0]), rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("dimension", [2, 3])
def test_floor_and_slope_are_learnt(dimension):
    """Known paths from 1 to 85 m away: both levels within 4 sd of the truth, and offsets by their intervals."""
    time = np.arange(0.0, 300.0)
    path = np.stack([30 + 29 * np.cos(time / 20), 30 + 29 * np.sin(time / 31), 3 + np.sin(time / 9)], 1)[:, :dimension]
    motion = Known((time, path))
    run = simulate(ranges(Grows(0.2, 0.02), None, dimension), motion, time, key=0)
    network = ranges(Grows(Unknown(0.5), Unknown(0.05)), None, dimension)
    tree = fit(Problem(network, motion, run.table), MAP(), prior=Gaussian())
    assert tree.attrs["status"] == "converged"
    found = tree["level"].to_dataset()["std"].to_series()
    assert found["gauge.range_slope"] == pytest.approx(0.02, rel=0.12)  # of 1200 ranges: sd 2.5 %
    assert found["gauge.range_std"] == pytest.approx(0.2, rel=0.5)  # which matters within 10 m
    calibration = tree["calibration"].to_dataset()
    for label, value in run.truth.biases.items():
        own = calibration.sel(bias_label=label)
        assert abs(float(own["mean"]) - value) < 4 * float(own["sd"])


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: Grows(-1.0, 0.1), "Grows: std is -1: it must be positive"),
        (lambda: Grows(1.0, 0.0), "Grows: slope is 0: it must be positive"),
        (lambda: Channel("rad", std=Grows(0.1, 0.1), wrap=True), r"std=Grows\(...\)\): the noise must be additive"),
        (lambda: Channel("dB", std=Grows(0.1, 0.1), noise=Censored(-90.0)), "and not wrap"),
        (lambda: Channel("1", std=Grows(0.1, 0.1), noise=Bernoulli()), "and not wrap"),
    ],
)
def test_growing_noise_that_is_none_is_refused(make, says):
    with pytest.raises(InputError, match=says):
        make()
