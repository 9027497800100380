"""Late ranges: one-sided late parts of a mixture, and parameters of noise families that are estimated."""

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from scipy import stats

from probcal import (
    MAP,
    Bias,
    Channel,
    ConstantVelocity,
    Gaussian,
    Network,
    Node,
    Problem,
    Unknown,
    fit,
    sensor,
    simulate,
)
from probcal.errors import InputError
from probcal.geometry import norm
from probcal.model.model import At
from probcal.model.rows import BY_ROW, parameter_score
from probcal.noise import AdditiveNoise, Mixture, StudentT, at_guess, level_at, log_level, unknowns, with_values

FAMILIES = [
    Mixture(0.2, 6.0, late="exponential"),
    Mixture(0.3, 0.5, 2.0, late="exponential"),
    Mixture(0.2, 6.0, late="half-normal"),
    Mixture(0.3, 0.5, -2.0, late="half-normal"),
]
PLACES = [(0.0, 0.0, 0.0), (10.0, 0.0, 3.0), (10.0, 8.0, 0.5), (0.0, 8.0, 2.5), (5.0, 9.0, 1.5)]
TIME = np.arange(150) * 0.2
CIRCLE = np.stack([5 + 3 * np.cos(TIME / 3), 4 + 2.5 * np.sin(TIME / 2.3), 1 + 0.5 * np.sin(TIME / 5)], 1)


def beacons(noise, std=0.05, dimension=2):
    """Five beacons of which each has an offset of its range."""

    @sensor(range=Channel("m", std=std, noise=noise))
    def uwb(target, pose, *, range_offset=Bias("m", 0.3)):
        return dict(range=norm(target.position - pose.position) + range_offset)

    return Network([uwb.on(Node(f"a{k}", p[:dimension], survey={"position": 0.01})) for k, p in enumerate(PLACES)])


def recording(noise, dimension=2, key=1):
    """Ranges to a target on a circle, offsets drawn from their prior."""
    offsets = 0.3 * np.random.default_rng(key).normal(size=5)
    biases = {f"a{k}.range_offset": float(b) for k, b in enumerate(offsets)}
    tracks = {"target": CIRCLE[:, :dimension]}
    run = simulate(beacons(noise, 0.05, dimension), ConstantVelocity(0.3), TIME, key=key, biases=biases, tracks=tracks)
    return run.table, biases


@pytest.mark.ci
@pytest.mark.parametrize("family", FAMILIES, ids=repr)
def test_a_late_part_agrees_with_its_density(family):
    """It integrates to one; score, level score and information follow from it, and the draws have it."""
    e = np.linspace(-40.0, 260.0, 300_001)
    with jax.enable_x64(True):
        y, std = jnp.asarray(0.7 * e), jnp.full(e.shape, 0.7)
        none = jnp.zeros_like(y)
        p = np.exp(family.log_likelihood(y, none, std, None))
        score = jax.vmap(jax.grad(lambda m, own: family.log_likelihood(own, m, 0.7, None)))(none, y)
        level = jax.vmap(jax.grad(lambda s, own: family.log_likelihood(own, 0.0, s, None)))(std, y)
        np.testing.assert_allclose(family.score(y, none, std, None), score, atol=1e-9)
        np.testing.assert_allclose(family.level_score(y, none, std, None), 1 + 0.7 * level, atol=1e-8)
        information = float(family.information(none[:1], std[:1])[0])
        weight = np.asarray(family.weight(y, none, std, None)) * 0.49
        drawn = np.asarray(family.sample(jax.random.key(0), jnp.zeros(50_000), jnp.full(50_000, 0.7)))
        estimated = {name: jnp.asarray(getattr(family, name)) for name in ("share", "scale", "delay")}
        close = float(with_values(family, estimated).unit_information())
    assert np.trapezoid(p, y) == pytest.approx(1.0, abs=1e-6)
    assert np.trapezoid(p * np.asarray(score) ** 2, y) == pytest.approx(information, rel=1e-6)
    assert close == pytest.approx(0.49 * information, rel=1e-3), "the quadrature of estimated parameters is coarser"
    assert (weight > 0).all()
    assert (weight <= 1.0 + 1e-12).all()
    below = np.concatenate([[0.0], np.cumsum(0.5 * (p[1:] + p[:-1]) * np.diff(y))])
    assert stats.kstest(drawn, lambda value: np.interp(value, y, below)).pvalue > 1e-3


def test_a_share_keeps_between_zero_and_one_and_levels_come_back():
    family = Mixture(Unknown(0.2), Unknown(6.0), late="exponential")
    assert list(unknowns(family)) == ["share", "scale"]
    assert at_guess(family) == Mixture(0.2, 6.0, late="exponential")
    logs = np.linspace(-8.0, 8.0, 9)
    share = level_at(0.2, True, logs)
    assert ((share > 0) & (share < 1)).all()
    assert share[4] == pytest.approx(0.2)
    np.testing.assert_allclose(log_level(0.2, True, share), logs, rtol=1e-9)
    np.testing.assert_allclose(log_level(6.0, False, level_at(6.0, False, logs)), logs, atol=1e-12)


def each(noise, std=0.05):
    """A problem with ranges of three of the beacons, and a point near the path."""
    family = Mixture(0.3, 8.0, late="exponential")
    path, some = CIRCLE[:30, :2], np.random.default_rng(0)
    late = np.asarray(family.sample(jax.random.key(0), jnp.zeros((30, 3)), jnp.full((30, 3), 0.05)))
    ranges = [np.linalg.norm(path - np.array(PLACES[k][:2]), axis=1) + late[:, k] for k in range(3)]
    table = pd.concat([pd.DataFrame({"time": TIME[:30], "sensor": f"a{k}", "range": r}) for k, r in enumerate(ranges)])
    problem = Problem(beacons(noise, std), ConstantVelocity(0.3), table)
    states = np.concatenate([path + 0.02 * some.normal(size=path.shape), np.zeros((30, 2))], 1)
    return problem, At((jnp.asarray(states),), jnp.zeros(problem.model.biases), jnp.zeros(len(problem.levels)))


@pytest.mark.ci
@pytest.mark.parametrize("by", [None, "sensor"])
@pytest.mark.parametrize("name", ["share", "df"])
def test_the_slope_by_a_parameter_is_that_of_the_evidence(name, by):
    """By differences of sum log p - spread I / 2; its information is the sum of squared scores of single rows."""
    guess = Unknown(0.2, 3.0, by)
    family = StudentT(Unknown(4.0, 3.0, by)) if name == "df" else Mixture(guess, Unknown(8.0), late="exponential")
    with jax.enable_x64(True):
        problem, point = each(family)
        model, block, rows = problem.model, problem.model.blocks[0], problem.model.rows[0]
        predicted = model.predict(point)[0]
        levels = jnp.asarray(0.1 * np.arange(1.0, len(problem.levels) + 1))
        spread = jnp.asarray(np.random.default_rng(0).uniform(1e-4, 1e-3, predicted.shape))

        def told(log):
            at = point._replace(levels=log)
            parts = model.log_likelihood(at)[0], model.information(at)[0]
            return parts[0] - 0.5 * spread * parts[1]

        def difference(of, h):
            step = 1e-5 * jnp.eye(len(levels))[h]
            return np.asarray(of(levels + step) - of(levels - step)) / 2e-5

        slope, information, chosen = parameter_score(block, rows, predicted, levels, spread)
        silent = ("a3", "a4")  # which have no rows
        own = [not level.label.startswith(silent) for level in problem.levels]
        np.testing.assert_array_equal(np.asarray(chosen)[:-1] > 0, own)
        alone = [
            difference(lambda log: model.log_likelihood(point._replace(levels=log))[0], h) for h in range(len(own))
        ]
        for h in np.flatnonzero(own):
            assert float(slope[h]) == pytest.approx(difference(told, h).sum(), rel=1e-4, abs=1e-5)
            assert float(information[h, h]) == pytest.approx((alone[h] ** 2).sum(), rel=1e-4, abs=1e-8)
    labels = [level.label for level in problem.levels]
    assert (f"a1.range_{name}" in labels) == (by == "sensor")
    assert (f"uwb.range_{name}" in labels) == (by is None)


def test_rows_of_a_sensor_have_its_own_std_and_parameters():
    """Log levels of one sensor move the density of its rows and of no others."""
    with jax.enable_x64(True):
        problem, point = each(Mixture(Unknown(0.2, by="sensor"), 8.0, late="exponential"), Unknown(0.1, by="sensor"))
        labels = [level.label for level in problem.levels]
        sensor_of = np.asarray(problem.model.rows[0].sensor)
        assert {"a0.range_std", "a2.range_std", "a0.range_share"} <= set(labels)
        before = np.asarray(problem.model.log_likelihood(point)[0])
        for name in ("a1.range_std", "a1.range_share"):
            moved = point._replace(levels=np.asarray(point.levels) + 0.3 * (np.array(labels) == name))
            changed = np.abs(np.asarray(problem.model.log_likelihood(moved)[0]) - before)[:, 0] > 1e-9
            np.testing.assert_array_equal(changed, sensor_of == 1)


def test_a_family_of_ones_own_has_parameters_to_learn():
    from dataclasses import dataclass

    @dataclass(frozen=True)
    class Power(AdditiveNoise):
        power: float = 2.0

        def log_density(self, e):
            return -(jnp.sqrt(1.0 + e**2) ** self.power) - jnp.log1p(self.power)

    with jax.enable_x64(True):
        problem, point = each(Power(Unknown(1.5)))
        assert [level.label for level in problem.levels] == ["uwb.range_power"]
        found = jax.jit(problem.model.information)(point)[0]
        assert float(found[0, 0]) == pytest.approx(Power(1.5).unit_information() / 0.05**2, rel=1e-3)
    assert set(BY_ROW) < set(problem.model.rows[0]._fields), "parameters are no arrays of rows"


@pytest.mark.slow
@pytest.mark.parametrize("dimension", [2, 3])
def test_late_ranges_are_learnt(dimension):
    """A fifth of 750 ranges late by 15 std on average: from guesses of a factor of two the truth within 4 sd."""
    table, biases = recording(Mixture(0.2, 15.0, late="exponential"), dimension)
    noise = Mixture(Unknown(0.1), Unknown(8.0), late="exponential")
    problem = Problem(beacons(noise, Unknown(0.1), dimension), ConstantVelocity(Unknown(0.3)), table)
    tree = fit(problem, MAP(), prior=Gaussian())
    assert tree.attrs["status"] == "converged"
    level = tree["level"].to_dataset()["std"].to_series()
    assert 0.14 < level["uwb.range_share"] < 0.27  # sd .015 if nobody were in doubt, .02 as it is
    assert 10.0 < level["uwb.range_scale"] < 21.0  # a mean of 150: sd 1.2
    assert 0.040 < level["uwb.range_std"] < 0.060
    calibration = tree["calibration"].to_dataset()
    for label, value in biases.items():
        own = calibration.sel(bias_label=label)
        assert abs(float(own["mean"]) - value) < 4 * float(own["sd"])
    lost = Problem(beacons(StudentT(4.0), Unknown(0.1), dimension), ConstantVelocity(Unknown(0.3)), table)
    assert float(fit(lost, MAP(), prior=Gaussian()).attrs["log_evidence"]) < float(tree.attrs["log_evidence"]) - 20


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: Mixture(late="early"), r"Mixture\(late=.*give one of normal, exponential, half-normal"),
        (lambda: Unknown(1.0, by="type"), 'by is None or "sensor"'),
        (lambda: ConstantVelocity(Unknown(1.0, by="sensor")), 'by="sensor" is for the noise of channels'),
        (lambda: ConstantVelocity(1.0, noise=Mixture(Unknown(0.1))), "which cannot drive a motion"),
        (lambda: ConstantVelocity(1.0, noise=Mixture(0.1, late="exponential")), "which cannot drive a motion"),
        (lambda: ConstantVelocity(1.0, noise=StudentT(Unknown(4.0))), "which cannot drive a motion"),
        (lambda: Mixture(Unknown(1.5)), "must lie between 0 and 1"),
    ],
)
def test_a_late_part_that_is_none_is_refused(make, says):
    with pytest.raises(InputError, match=says):
        make()
