"""Gibbs sampling by split HMC: exact on linear worlds by both engines, as the collapsed sampler elsewhere."""

from functools import cache
from unittest.mock import patch

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
import worlds
from arviz_stats.base import array_stats
from scipy import stats
from sparse_worlds import LIBRARIES, drawn, drawn_in_space, loud

import probcal as pc
from probcal.errors import InputError
from probcal.gaussian.choose import direct_engine
from probcal.gaussian.dense import DenseEngine
from probcal.gaussian.mode import Point, driven_states, log_density
from probcal.geometry import norm
from probcal.inference import calibrate
from probcal.inference.joint_gibbs import Gibbs, GibbsChains
from probcal.inference.method import Context
from probcal.inference.mixed import Effective
from probcal.inference.noise_step import draw_noise, levels_alone
from probcal.inference.solve import solve
from probcal.inference.split_hmc import Reference, SplitGaussian, placed, split_variables, variables_of
from probcal.model.motions import level_values
from probcal.modes import automatic_start

SHORT = {"chains": 2, "warmup": 25, "draws": 50, "patience": 1}


@pytest.fixture(params=[DenseEngine, pytest.param(direct_engine, id="sparse")])
def engine(request, monkeypatch):
    """The engine that `Gibbs` takes, whatever the size."""
    made = request.param()
    monkeypatch.setattr("probcal.inference.joint_gibbs.choose_fast", lambda model: made)
    return made


def reference_of(problem, engine=None):
    """The reference at the known answer of a linear world."""
    point = jax.tree.map(jnp.asarray, worlds.resting(problem))
    return Reference((engine or DenseEngine()).at(problem.model, point))


@pytest.mark.slow
@pytest.mark.parametrize("made", [drawn, drawn_in_space])
def test_the_rest_is_what_the_joint_density_has_beyond_its_gaussian(made, engine):
    """Of moving targets, one at rest, bent sensors, in 2-D and 3-D: value to 1e-9, slope to 1e-5 of differences."""
    problem = made()[0]
    with jax.enable_x64(True):
        reference = Reference(engine.settled(problem.model, automatic_start(problem)))
        given, at = SplitGaussian.of(reference, np.ones(problem.model.biases)), reference.at
        step = given.deviation(jax.random.key(0))
        there = placed(problem.model, at.point, jnp.asarray(reference.variables + step))
        (states, z), rows = split_variables(problem.model, jnp.asarray(step)), at.rows
        du = [u - before for u, before in zip(there.noises, at.point.noises, strict=True)]
        gaussian = sum(float(-jnp.sum(u * (before + 0.5 * u))) for u, before in zip(du, at.point.noises, strict=True))
        along = problem.model.responses(rows, [x[:, :, None] for x in states], z[:, None])
        for lin, own in zip(rows, along, strict=True):
            gaussian += float(jnp.sum(own[:, :, 0] * (lin.score - 0.5 * lin.weight * own[:, :, 0])))
        beyond = log_density(problem.model, there) - log_density(problem.model, at.point) - gaussian
        value, slope = reference.rest(reference.variables + step)
        value -= reference.rest(reference.variables)[0]
        assert value == pytest.approx(float(beyond), rel=1e-6, abs=1e-6)
        assert reference.log_density(reference.variables + step) == pytest.approx(
            float(log_density(problem.model, there))
        )
        for k in np.random.default_rng(0).integers(len(step), size=12):
            eps = 1e-5 * np.eye(len(step))[k]
            ends = (reference.rest(reference.variables + step + own)[0] for own in (eps, -eps))
            assert slope[k] == pytest.approx(np.subtract(*ends) / 2e-5, rel=1e-5, abs=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["plane", "extras", "drifting"])
def test_nothing_is_beyond_the_gaussian_of_a_linear_world(name, engine):
    """The rest is the same wherever one looks, and every turn is taken."""
    problem, _ = worlds.linear(name)
    with jax.enable_x64(True):
        reference = reference_of(problem, engine)
        given, at = SplitGaussian.of(reference, np.ones(problem.model.biases)), reference.variables
        known = reference.rest(at)[0]
        for kicks in (1, 3):
            at, rest, rate, _ = given.turned(at, known, kicks, jax.random.key(kicks))
            assert rest == pytest.approx(known, abs=1e-7 * abs(reference.log_density(at)))
            assert rate == pytest.approx(1.0, abs=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("library", LIBRARIES, indirect=True)
@pytest.mark.parametrize("name", ["plane", "drifting"])
def test_sparse_draws_of_a_linear_world_have_its_exact_moments(name, library, monkeypatch):
    monkeypatch.setattr("probcal.inference.joint_gibbs.choose_fast", lambda model: direct_engine())
    draws_have_exact_moments(name)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["space", "drifting"])
def test_dense_draws_of_a_linear_world_have_its_exact_moments(name):
    """Those of "space" too, whose noise reaches only a part of the state."""
    draws_have_exact_moments(name)


def draws_have_exact_moments(name):
    """Means within 5 standard errors of the dense joint Gaussian, sds within 5; gamma and tracks too."""
    problem, _ = worlds.linear(name)
    method, start = Gibbs(chains=4, warmup=0, draws=250), worlds.resting(problem)
    tree = calibrate(problem, method, prior=pc.Gaussian(), start=start)[0]
    group, whole = tree["calibration"].to_dataset(), worlds.exact(name)
    assert tree.attrs["status"] == "converged", tree.attrs["message"]
    exact = worlds.fitted(name)["calibration"].to_dataset()
    error = 1.1 / np.sqrt(1000)  # draws follow each other by cos(0.9 pi / 2) at most
    sd = exact["sd"].values
    np.testing.assert_allclose(np.asarray(whole.mean)[: len(sd)] * problem.scales, exact["mean"], atol=1e-6)
    np.testing.assert_allclose((group["mean"].values - exact["mean"].values) / sd, 0.0, atol=5 * error)
    np.testing.assert_allclose(group["sd"].values / sd, 1.0, atol=5 * error / np.sqrt(2))
    np.testing.assert_allclose(group["gamma"], exact["gamma"], atol=5 * np.sqrt(2) * error)
    assert (tree["sample_stats"]["acceptance_rate"] > 0.999).all()
    for name_of in problem.measurements.target_names:
        one, other = (t[f"track/{name_of}"].to_dataset() for t in (worlds.fitted(name), tree))
        free = one["sd"].values > 1e-9
        off = (other["mean"].values - one["mean"].values)[free] / one["sd"].values[free]
        np.testing.assert_allclose(off, 0.0, atol=5 * error)
        np.testing.assert_allclose(other["sd"].values[free] / one["sd"].values[free], 1.0, atol=5 * error)


@pytest.mark.slow
@pytest.mark.parametrize("prior", [pc.Horseshoe(), pc.Gaussian()], ids=["horseshoe", "gaussian"])
def test_the_density_of_a_draw_is_the_joint_one_at_its_point(prior):
    """To 1e-9: what simulation-based calibration ranks a truth by."""
    problem = drawn()[0]
    method = Gibbs(chains=1, warmup=1, draws=4, patience=1)
    with jax.enable_x64(True):
        start = automatic_start(problem)
        posterior = solve(problem, method, prior, Context(jax.random.key(0), threads=1), start=start).posterior
        run = posterior.run
        for d in range(4):
            at = variables_of([x[0, d] for x in run.states], run.z[0, d])
            point = placed(problem.model, start, jnp.asarray(at))
            phi = {name: jnp.asarray(leaf[0, d]) for name, leaf in posterior.hyper.items()}
            assert posterior.joint(point, phi) == pytest.approx(run.draws.density[0, d], rel=1e-9)


@pytest.mark.slow
def test_it_agrees_with_the_collapsed_sampler_in_space():
    """3-D radars and rangers, three of four displaced: means within 0.25 sds, sds within a fifth."""
    problem, truth = drawn_in_space()
    ours = pc.fit(problem, Gibbs(warmup=50, draws=300), prior=pc.Gaussian())["calibration"].to_dataset()
    other = pc.fit(problem, pc.Collapsed(draws=300), prior=pc.Gaussian())["calibration"].to_dataset()
    np.testing.assert_allclose((ours["mean"] - other["mean"]) / other["sd"], 0.0, atol=0.25)
    np.testing.assert_allclose(np.log(ours["sd"] / other["sd"]), 0.0, atol=0.2)
    true = np.array([truth.biases[label] for label in ours["bias_label"].values.tolist()])
    assert np.mean((ours["lower"].values <= true) & (true <= ours["upper"].values)) > 0.7


@pytest.mark.slow
@pytest.mark.parametrize("prior", [pc.Horseshoe(), pc.ARD(rate=0.5), pc.Laplace()], ids=lambda p: type(p).__name__)
def test_it_agrees_with_the_collapsed_sampler(prior):
    """Bent sensors, targets at rest and shared biases: means within 0.35 sds, sds within a fifth, gamma within 0.1."""
    problem, truth = drawn()
    ours = pc.fit(problem, Gibbs(warmup=100, draws=500), prior=prior)
    other = pc.fit(problem, pc.Collapsed(draws=500), prior=prior)
    a, b = (tree["calibration"].to_dataset() for tree in (ours, other))
    sd = b["sd"].values
    np.testing.assert_allclose(a["mean"].values / sd, b["mean"].values / sd, atol=0.35)
    np.testing.assert_allclose(np.log(a["sd"].values / sd), 0.0, atol=0.25)
    np.testing.assert_allclose(a["gamma"], b["gamma"], atol=0.1)
    np.testing.assert_allclose(
        np.log(ours["posterior"]["global_scale"].mean() / other["posterior"]["global_scale"].mean())
        if "global_scale" in ours["posterior"] else 0.0, 0.0, atol=0.4,
    )  # fmt: skip
    true = np.array([truth.biases[label] for label in a["bias_label"].values.tolist()])
    assert np.mean((a["lower"].values <= true) & (true <= a["upper"].values)) > 0.75
    for name in ("car", "van", "mast"):
        one, two = (tree[f"track/{name}"].to_dataset() for tree in (ours, other))
        np.testing.assert_allclose((one["mean"] - two["mean"]) / two["sd"], 0.0, atol=0.5)
        np.testing.assert_allclose(np.log(one["sd"] / two["sd"]), 0.0, atol=0.4)


@pc.sensor(level=pc.Channel("m", std=0.5))
def bent(target, pose, *, gain=pc.Bias("1", 1.0)):
    """A level that a bias bends: its posterior is far from Gaussian."""
    return dict(level=norm(pose.local(target.position)) * jnp.exp(gain))


@pytest.mark.slow
@pytest.mark.parametrize("away", [0.0, 0.6])
def test_a_bias_that_bends_what_is_measured_has_its_posterior(away, engine):
    """One bias, known targets: mean and sd by quadrature within 5 standard errors, wherever the Gaussian is taken."""
    network = pc.Network([bent.on(pc.Node("n", (0.0, 0.0)))])
    paths = pd.DataFrame({"time": [0.0, 1.0], "target": "car", "position_x": [1.0, 0.7], "position_y": 0.0})
    table = pd.DataFrame({"time": [0.0, 1.0], "target": "car", "sensor": "n", "level": [0.3, 0.9]})
    problem = pc.Problem(network, pc.Known(paths), table)
    z = np.linspace(-6, 4, 20_001)
    left = (table["level"].values[:, None] - paths["position_x"].values[:, None] * np.exp(z)) / 0.5
    weight = np.exp(-0.5 * (left**2).sum(0) - 0.5 * z**2)
    mean = (weight @ z) / weight.sum()
    sd = np.sqrt((weight @ (z - mean) ** 2) / weight.sum())
    with jax.enable_x64(True):
        point = automatic_start(problem)
        reference = Reference(engine.at(problem.model, point._replace(z=jnp.array([mean + away]))))
        given = SplitGaussian.of(reference, np.ones(1))
        for kicks, count in ((1, 1500), (3, 800)):
            at, rest, rates, draws = reference.variables, 0.0, [], []
            for key in jax.random.split(jax.random.key(kicks), count):
                at, rest, rate, _ = given.turned(at, rest, kicks, key)
                rates.append(rate)
                draws.append(at[-1])
            assert np.mean(rates) > 0.5
            error = sd * np.sqrt(4 / count / np.mean(rates))
            assert np.mean(draws) == pytest.approx(mean, abs=5 * error)
            assert np.std(draws) == pytest.approx(sd, abs=5 * error)


@pytest.mark.ci
def test_an_interrupted_run_says_how_many_draws_it_has():
    def stop(progress):
        if progress.done >= 50:
            raise KeyboardInterrupt

    problem = worlds.linear("plane")[0]
    cut = pc.fit(problem, Gibbs(**SHORT), key=3, start=worlds.resting(problem), progress=stop)
    assert "Interrupted after 25 of 50 draws a chain" in cut.attrs["message"]


@pytest.mark.ci
def test_sums_are_of_every_sweep_after_the_warm_up():
    """Of draws two sweeps apart the sweeps between two are summed too, of all chains."""
    problem = drawn()[0]
    with jax.enable_x64(True):
        runs = chains_of(problem, Gibbs(**SHORT))
        state = runs.init()
        state, _ = runs.advance(state, 1)
        assert int(state.summed) == 0, "the first 25 are warm-up"
        state, first = runs.advance(state, 1)
        assert int(state.summed) == 2 * 25
        state, draws = runs.advance(state, 2)
        assert (int(state.summed), int(state.made)) == (2 * 75, 100)
        assert np.shape(draws.theta) == (2, 25, problem.model.biases)
        assert not np.array_equal(draws.theta, first.theta)


def chains_of(problem, method):
    context = Context(jax.random.key(0))
    return GibbsChains(method, problem, pc.Horseshoe(), automatic_start(problem), context)


@pytest.mark.slow
def test_draws_of_states_that_take_much_room_are_not_kept(monkeypatch):
    """Their moments are, the same as with them; draws of states are refused in one sentence."""
    problem = drawn()[0]
    kept = pc.fit(problem, Gibbs(**SHORT), save=("states",))
    assert kept["track/car"]["state"].shape[:2] == (2, 50)
    monkeypatch.setattr("probcal.inference.joint_gibbs.NUMBERS", 1000)
    bare = pc.fit(problem, Gibbs(**SHORT))
    assert "local_scale" in kept["posterior"]
    assert "local_scale" not in bare["posterior"], "2 chains of 50 draws of 11 biases"
    np.testing.assert_array_equal(bare["calibration"]["mean"], kept["calibration"]["mean"])
    np.testing.assert_array_equal(bare["track/van"]["mean"], kept["track/van"]["mean"])
    states = kept["track/van"]["state"].values.reshape(100, -1)
    np.testing.assert_allclose(kept["track/van"]["mean"].values.ravel(), states.mean(0), atol=1e-9)
    np.testing.assert_allclose(kept["track/van"]["sd"].values.ravel(), states.std(0), rtol=1e-6)
    with pytest.raises(InputError, match="keeps draws of states up to 1,000 numbers, 2 x 50 draws"):
        pc.fit(problem, Gibbs(**SHORT), save=("states",))


@pytest.mark.slow
def test_tracks_of_a_longer_run_are_those_of_all_its_sweeps():
    """Sums of the states are of every sweep after the warm-up, whatever the steps from one draw to the next."""
    problem = worlds.linear("plane")[0]
    start = worlds.resting(problem)
    with patch("probcal.inference.sampling.effective_draws", lambda *_: Effective(1.0, False)):
        longer = pc.fit(problem, Gibbs(chains=2, warmup=0, draws=150, patience=2), key=3, start=start)
    whole = pc.fit(problem, Gibbs(chains=2, warmup=0, draws=300, patience=1), key=3, start=start)
    assert (longer.attrs["thin"], longer["posterior"].sizes["draw"]) == (2, 150)
    for name in ("gamma", "precision"):
        np.testing.assert_allclose(longer["calibration"][name].values, whole["calibration"][name].values, rtol=1e-9)
    np.testing.assert_allclose(longer["track/one"]["sd"].values, whole["track/one"]["sd"].values, rtol=1e-9)


def test_a_chain_leaves_where_the_model_has_no_density():
    """From a place of density zero the first one with a density is taken."""
    problem = worlds.linear("plane")[0]
    with jax.enable_x64(True):
        reference = reference_of(problem)
        given, start = SplitGaussian.of(reference, np.ones(problem.model.biases)), reference.variables
        at, rest, rate, _ = given.turned(start, -np.inf, 1, jax.random.key(0))
        assert rate == 1.0
        assert np.isfinite(rest)
        assert not np.array_equal(at, start)


def test_a_turn_that_diverges_ends_before_numbers_overflow(monkeypatch):
    """Beyond the Gaussian stands a quartic, steeper than kicks can follow: the turn is refused."""
    problem = worlds.linear("plane")[0]
    with jax.enable_x64(True):
        reference = reference_of(problem)
        given = SplitGaussian.of(reference, np.ones(problem.model.biases))

        def quartic(self, at):
            return -1e6 * np.sum((at - self.variables) ** 4), -4e6 * (at - self.variables) ** 3

        monkeypatch.setattr(Reference, "rest", quartic)
        start = reference.variables + 1.0
        with np.errstate(over="raise", invalid="raise"):
            at, rest, rate, _ = given.turned(start, quartic(reference, start)[0], 64, jax.random.key(0))
    assert rate == 0.0
    assert rest == quartic(reference, start)[0]
    assert np.array_equal(at, start)


@pytest.mark.ci
def test_chains_that_take_no_turn_are_no_answer(monkeypatch):
    turned = SplitGaussian.turned

    def stuck(self, at, rest, kicks, key):
        _, _, _, speed = turned(self, at, rest, kicks, key)
        return at, rest, 0.0, speed

    monkeypatch.setattr(SplitGaussian, "turned", stuck)
    problem = worlds.linear("plane")[0]
    tree = pc.fit(problem, Gibbs(**SHORT), start=worlds.resting(problem))
    assert tree.attrs["status"] == "not converged"
    assert "A chain takes 0.0% of its turns" in tree.attrs["message"]


def test_what_it_does_not_take_is_said():
    problem = drawn()[0]
    with pytest.raises(InputError, match="Gibbs takes one start: its chains begin at different draws"):
        pc.fit(problem, Gibbs(), starts=2)
    with pytest.raises(InputError, match="Gibbs does not take the prior BernoulliGaussian"):
        pc.fit(problem, Gibbs(), prior=pc.BernoulliGaussian())
    with pytest.raises(InputError, match=r"Gibbs\(chains=0\): it must be at least 1"):
        Gibbs(chains=0)


@pc.sensor(range=pc.Channel("m", std=pc.Unknown(1.0), noise=pc.noise.Mixture(pc.Unknown(0.2, 2.0), 8.0)))
def echoing(target, pose, *, offset=pc.Bias("m", 1.0)):
    """Range of unknown noise with an unknown share of echoes."""
    return dict(range=norm(target.position - pose.position) + offset)


@cache
def echoes():
    """Two sensors with echoes and a walk of known noise."""
    network = pc.Network([echoing.on(pc.Node(name, (x, 0.0))) for name, x in (("a", 0.0), ("b", 90.0))])
    run = pc.simulate(network, pc.ConstantVelocity(1.0), np.arange(10.0), key=0, tracks={"t": np.full((10, 2), 40.0)})
    return pc.Problem(network, pc.ConstantVelocity(1.0), run.table)


@pytest.mark.ci
@pytest.mark.parametrize(("made", "single"), [(loud, 1), (echoes, 1)])
def test_a_step_of_the_noise_leaves_the_joint_density_alone(made, single):
    """Levels, noises and data are drawn from the model, then the levels given the rest: they have their prior."""
    model = made().model
    with jax.enable_x64(True):
        point, alone = automatic_start(made()), levels_alone(model)

        @jax.jit
        @jax.vmap
        def after(key):
            keys = jax.random.split(key, 4)
            levels = model.level_spread * jax.random.normal(keys[0], model.level_spread.shape)
            noises = tuple(model.draw_noises(keys[1], r, 1)[:, :, 0] for r in range(len(model.recursions)))
            states = model.each(lambda part, u: driven_states(part, levels, u), noises)
            at = Point(states, noises, point.z, levels)
            given = model.with_values(model.sample(at, keys[2]))
            changed, drawn = draw_noise(given, at, keys[3], alone)
            again = changed.each(lambda part, u: driven_states(part, drawn.levels, u), drawn.noises)
            return levels, drawn.levels, jax.tree.leaves(changed.mixing), again[0] - drawn.states[0]

        before, levels, weights, apart = jax.tree.map(np.asarray, after(jax.random.split(jax.random.key(0), 400)))
    assert len(alone) == single, "the std of the motion, and the share of echoes"
    for h, spread in enumerate(np.asarray(model.level_spread)):
        assert stats.kstest(levels[:, h] / spread, "norm").pvalue > 1e-3
        assert np.abs(levels[:, h] - before[:, h]).max() > 0.1
    assert all(stats.kstest(4.0 * own[:, 3], stats.chi2(4).cdf).pvalue > 1e-3 for own in weights)
    assert np.abs(apart).max() < 1e-6


@pc.sensor(range=pc.Channel("m", std=pc.Unknown(1.0, 2.0), noise=pc.StudentT(pc.Unknown(4.0, 3.0))))
def tailed(target, pose, *, offset=pc.Bias("m", 1.0)):
    """Range of unknown std and unknown tails."""
    return dict(range=norm(target.position - pose.position) + offset)


def test_a_level_beside_an_unknown_parameter_has_the_posterior_of_a_grid():
    """Std and degrees of freedom of 24 residuals: mean and sd of 4,000 steps; limits five standard errors."""
    network, motion = pc.Network([tailed.on(pc.Node("a", (0.0, 0.0)))]), pc.ConstantVelocity(1.0)
    table = pd.DataFrame({"time": np.arange(24.0), "sensor": "a"})
    table["range"] = np.abs(10.0 + stats.t(2.5).rvs(24, random_state=4))
    problem = pc.Problem(network, motion, table)
    model, point = problem.model, worlds.resting(problem)
    point.states[0][:, 0] = 10.0

    @jax.jit
    def steps(keys):
        def one(levels, key):
            levels = draw_noise(model, point._replace(levels=levels), key, levels_alone(model))[1].levels
            return levels, levels

        return jax.lax.scan(one, jnp.zeros(2), keys)[1]

    with jax.enable_x64(True):
        drawn = level_values(problem.levels, steps(jax.random.split(jax.random.key(1), 4000)))
    std, df = np.meshgrid(np.exp(np.linspace(-2.5, 2.0, 181)), 4.0 * np.exp(np.linspace(-4.0, 5.0, 181)), indexing="ij")
    log = stats.t.logpdf(table["range"].to_numpy()[:, None, None] - 10.0, df, scale=std).sum(0)
    log -= 0.5 * (np.log(std) / np.log(2.0)) ** 2 + 0.5 * (np.log(df / 4.0) / np.log(3.0)) ** 2
    weight = np.exp(log - log.max()) / np.exp(log - log.max()).sum()
    assert [level.label for level in problem.levels] == ["tailed.range_std", "tailed.range_df"]
    for own, grid in zip(np.log(drawn).T, (np.log(std), np.log(df)), strict=True):
        mean = (weight * grid).sum()
        sd = np.sqrt((weight * (grid - mean) ** 2).sum())
        effective = float(array_stats.ess(own[None], method="mean"))
        assert own.mean() == pytest.approx(mean, abs=5 * sd / np.sqrt(effective))
        assert own.std() / sd == pytest.approx(1.0, abs=5 / np.sqrt(effective))


def test_correlated_surveys_have_their_exact_posterior():
    """Of a linear world: means and sds within 5 standard errors of those of the mode."""
    problem, start = worlds.linear("plane")[0], worlds.resting(worlds.linear("plane")[0])
    prior = pc.Gaussian(correlation={"a.position_*": -0.7})
    ours, exact = (
        calibrate(problem, method, prior=prior, start=start)[0]["calibration"].to_dataset()
        for method in (Gibbs(chains=2, warmup=0, draws=250, patience=1), pc.MAP())
    )
    np.testing.assert_allclose((ours["mean"] - exact["mean"]) / exact["sd"], 0.0, atol=5 * 1.1 / np.sqrt(500))
    np.testing.assert_allclose(ours["sd"] / exact["sd"], 1.0, atol=5 * 1.1 / np.sqrt(1000))


@pytest.mark.ci
def test_memory_that_does_not_hold_a_factor_is_said(monkeypatch):
    def refused(*_):
        raise MemoryError

    monkeypatch.setattr("probcal.inference.joint_gibbs.HostClimb.step", refused)
    with pytest.raises(pc.FitError, match="does not fit in memory: take fewer sensors or a shorter time"):
        pc.fit(drawn()[0], Gibbs(**SHORT))


def test_a_precision_lost_in_rounding_is_said(monkeypatch):
    def lost(*_):
        raise np.linalg.LinAlgError

    monkeypatch.setattr(SplitGaussian, "of", lost)
    problem = worlds.linear("plane")[0]
    with pytest.raises(pc.FitError, match="under some draw of the hyper-parameters is singular in double precision"):
        pc.fit(problem, Gibbs(**SHORT), start=worlds.resting(problem))


def test_a_flat_prior_on_what_no_row_tells_has_no_posterior():
    problem = drawn()[0]
    table = problem.measurements.table.frame.copy()
    table.loc[table["sensor"] == "b", "azimuth"] = np.nan
    with pytest.raises(pc.FitError, match=r"diverged: no row tells b\.heading"):
        pc.fit(pc.Problem(problem.network, problem.motion, table), Gibbs(**SHORT), prior=pc.Flat())
