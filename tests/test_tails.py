"""Process noise that is not Gaussian: families, expected weights, exact densities, simulation, results, findings."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from contracts import only
from scipy import integrate, stats

import probcal
from probcal import Bias, Channel, ConstantVelocity, Known, Network, Node, Problem, Target, simulate
from probcal.errors import InputError
from probcal.gaussian.mode import mixed_density
from probcal.gaussian.recursion import trajectory
from probcal.gaussian.tails import rewhitened
from probcal.inference.fit import calibrate
from probcal.inference.fitted import take_up
from probcal.inference.model import Mixed
from probcal.modes import automatic_start
from probcal.motion import ConstantAcceleration, CoordinatedTurn, RandomWalk, White
from probcal.noise import Bernoulli, Mixture, StudentT
from probcal.results.read import each_track
from probcal.types import float64

FAMILIES = [StudentT(3.0), Mixture(0.2, 6.0)]
START = {"position": ((0.0, 0.0), 2.0), "velocity": ((1.0, 0.0), 1.0)}
TIME = np.array([0.0, 1.0, 2.0, 2.5, 4.0, 5.0, 6.0])


@probcal.sensor(east=Channel("m", std=0.3), north=Channel("m", std=0.4))
def finder(target, pose, *, shift=Bias("m", 1.0)):
    place = target.position - pose.position
    return {"east": place[0] + shift, "north": place[1] - 0.5 * shift}


PATH = np.where(TIME[:, None] < 3.0, np.c_[TIME, 0 * TIME], np.c_[3 + 0 * TIME, 3.0 * (TIME - 3.0)])


def reported(std, noise):
    """The path of the target as it was reported, 5 m off at 4 s."""
    return Known((TIME, PATH + np.where(TIME == 4.0, 5.0, 0.0)[:, None]), std, noise)


@cache
def turned(family=FAMILIES[0], motion=ConstantVelocity, df=None):
    """A target that turns sharply once, seen by a biased finder and one that is known."""
    network = Network([finder.on(Node("a", (0.0, 0.0))), finder.on(Node("b", (5.0, 1.0)))])
    random, rows = np.random.default_rng(5), []
    for t, (x, y) in zip(TIME, PATH, strict=True):
        for name, (px, py), b in (("a", (0, 0), 0.8), ("b", (5, 1), 0.0)):
            noise = random.normal(size=2)
            gone = name == "b" and t == 2.5
            rows.append((t, name, np.nan if gone else x - px + b + 0.3 * noise[0], y - py - 0.5 * b + 0.4 * noise[1]))
    table = pd.DataFrame(rows, columns=["time", "sensor", "east", "north"])
    made = motion(0.4) if family is None else motion(0.4, noise=StudentT(df) if df else family)
    return Problem(network, Target(made, {} if made.memoryless else START), table, fix=["b.shift"])


class Dense:
    """The same problem as one dense Gaussian of whitened noises and the bias, by columns."""

    def __init__(self, problem):
        (part,) = problem.model.recursions
        F, L, drift = (np.asarray(a) for a in (part.F, part.L, part.drift))
        self.E, self.n = drift.shape
        size = self.E * self.n
        unit = np.eye(size).reshape(self.E, self.n, size)
        states = np.zeros((self.E, self.n, size + 1))
        for e in range(self.E):
            source = np.concatenate([L[e] @ unit[e], drift[e][:, None]], 1)
            states[e] = source + (F[e] @ states[e - 1] if e else 0)
        frame = problem.measurements
        epoch = np.searchsorted(TIME, frame.time)
        rows, y, std, bias = [], [], [], []
        for k in range(len(frame.time)):
            name = frame.table.frame["sensor"][k]
            where = (0.0, 0.0) if name == "a" else (5.0, 1.0)
            for c, (s, effect) in enumerate(((0.3, 1.0), (0.4, -0.5))):
                if frame.measured[k, c]:
                    rows.append(states[epoch[k], c, :size])
                    y.append(frame.value[k, c] - (states[epoch[k], c, size] - where[c]))
                    std.append(s)
                    bias.append(effect if name == "a" else 0.0)
        self.H = np.c_[np.array(rows), bias] / np.array(std)[:, None]
        self.y = np.array(y) / np.array(std)
        self.constant = -np.log(std).sum() - 0.5 * len(y) * np.log(2 * np.pi)

    def given(self, weight):
        """Mean and covariance of noises and bias, and the log evidence, for weights (E,) of the noises."""
        precision = np.append(np.repeat(weight, self.n), 1.0)
        matrix = self.H.T @ self.H + np.diag(precision)
        covariance = np.linalg.inv(matrix)
        mean = covariance @ self.H.T @ self.y
        square = self.y @ self.y - mean @ (self.H.T @ self.y)
        determinant = np.linalg.slogdet(matrix)[1] - np.log(precision).sum()
        return mean, covariance, self.constant - 0.5 * square - 0.5 * determinant


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("size", [2, 4])
def test_a_family_is_the_scale_mixture_that_it_draws(family, size):
    drawn = np.asarray(family.mixing_draw(jax.random.key(0), (400_000,)))
    square = np.array([0.3, 2.0, 9.0, 40.0])
    like = drawn[:, None] ** (size / 2) * np.exp(-0.5 * (drawn[:, None] - 1.0) * square)
    error = like.std(0) / like.mean(0) / np.sqrt(len(drawn))
    density_of, mean_of = (jax.jit(own, static_argnums=1) for own in (family.mixing_density, family.mixing_mean))
    density = np.asarray(density_of(square, size))
    assert np.all(np.abs(density - np.log(like.mean(0))) < 5 * error + 1e-4)
    mean = (drawn[:, None] * like).sum(0) / like.sum(0)
    np.testing.assert_allclose(np.asarray(mean_of(square, size)), mean, rtol=0.05)
    u = np.random.default_rng(1).normal(size=(400_000, size)) / np.sqrt(drawn)[:, None]
    whole = (u**2).sum(1)
    score = np.asarray(mean_of(whole, size)) ** 2 * whole / size
    told = float(np.asarray(family.mixing_information(size)))
    assert abs(told - score.mean()) < 5 * score.std() / np.sqrt(len(u)) + 1e-3


def test_the_gain_of_a_student_is_its_divergence():
    family, size, weight = StudentT(3.0), 4, np.array([0.2, 1.0, 3.0])
    shape = 0.5 * (3.0 + size)
    for w, found in zip(weight, np.asarray(family.mixing_gain(jnp.asarray(weight), size)), strict=True):
        q, p = stats.gamma(shape, scale=w / shape), stats.gamma(1.5, scale=1 / 1.5)

        def inner(x, q=q, p=p, w=w):
            return q.pdf(x) * (p.logpdf(x) - q.logpdf(x) + 0.5 * size * (np.log(x) - np.log(w)))

        value, _ = integrate.quad(inner, 1e-9, 20 * w, limit=200)
        assert abs(found - value) < 1e-6


def test_the_gain_of_a_mixture_is_its_divergence():
    family, size, kept = Mixture(0.2, 6.0), 4, np.array([0.05, 0.5, 0.99])
    low = 1 / 36
    weight = kept + (1 - kept) * low
    share = kept * np.log(0.8 / kept) + (1 - kept) * np.log(0.2 / (1 - kept))
    expected = share + 0.5 * size * ((1 - kept) * np.log(low) - np.log(weight))
    np.testing.assert_allclose(np.asarray(family.mixing_gain(jnp.asarray(weight), size)), expected, atol=1e-6)


@pytest.mark.ci
@pytest.mark.parametrize(
    ("family", "motion"),
    [
        (FAMILIES[0], ConstantVelocity),
        pytest.param(FAMILIES[0], reported, marks=pytest.mark.ci),
        pytest.param(FAMILIES[1], ConstantVelocity, marks=pytest.mark.ci),
    ],
)
def test_a_climb_ends_where_naive_variational_bayes_does(family, motion):
    problem = turned(family, motion)
    tail = problem.model.recursions[0].tails[0]
    driven, on = slice(*tail.columns), np.asarray(tail.on)
    tree, answer = calibrate(problem, probcal.MAP(iterations=500, tolerance=1e-9), prior=probcal.Gaussian())
    dense, weight = Dense(problem), np.ones(len(TIME))
    for _ in range(2000):
        mean, covariance, evidence = dense.given(weight)
        square = (mean**2 + np.diag(covariance))[:-1].reshape(dense.E, dense.n)[on, driven].sum(1)
        weight[on] = np.asarray(family.mixing_mean(jnp.asarray(square), tail.size))
    assert tree.attrs["status"] == "converged"
    found = only(tree)[f"weight_{tail.name}"].values
    np.testing.assert_allclose(found, weight, rtol=1e-3)
    assert (found[0] == 1.0) == (not on[0])  # a start is as declared
    assert weight.min() < 0.5
    np.testing.assert_allclose(tree["calibration"]["mean"].values, mean[-1], atol=1e-4)
    np.testing.assert_allclose(tree["calibration"]["sd"].values, np.sqrt(covariance[-1, -1]), rtol=1e-4)
    bound = evidence + float(np.asarray(family.mixing_gain(jnp.asarray(weight[on]), tail.size)).sum())
    assert abs(tree.attrs["log_evidence_bound"] - bound) < 1e-3
    assert "log_evidence" not in tree.attrs
    assert answer.problem.model.tailed
    again = float64(take_up)(problem, tree).problem  # with room for more epochs, of no target, which weigh as declared
    (whole,), (mine,) = again.model.mixing[0], again.epochs[0].members.values()
    np.testing.assert_array_equal(np.asarray(whole)[mine], found)
    assert len(mine) > len(TIME)
    assert (np.asarray(whole)[~mine] == 1.0).all()


def sampled(family, count=60_000):
    """Posterior mean and sd of the bias, and log evidence, by weights drawn from their prior."""
    problem = turned(family)
    dense = Dense(problem)
    drawn = np.array(family.mixing_draw(jax.random.key(1), (count, dense.E)))
    logs, means, variances = np.zeros(count), np.zeros(count), np.zeros(count)
    for k, weight in enumerate(drawn):
        weight[0] = 1.0
        mean, covariance, logs[k] = dense.given(weight)
        means[k], variances[k] = mean[-1], covariance[-1, -1]
    share = np.exp(logs - logs.max())
    share /= share.sum()
    centre = share @ means
    return centre, np.sqrt(share @ (variances + (means - centre) ** 2)), 1 / (share @ share)


@pytest.mark.slow
@pytest.mark.parametrize(
    "method", [probcal.NUTS(chains=4, warmup=300, draws=500), probcal.Collapsed(chains=4, warmup=200, draws=1500)]
)
def test_samplers_draw_the_exact_posterior(method):
    centre, sd, effective = sampled(FAMILIES[0])
    assert effective > 300
    tree = probcal.fit(turned(), method, prior=probcal.Gaussian(), key=2)
    found = tree["calibration"].to_dataset()
    error = sd / np.sqrt(min(float(found["ess"].min()), effective))
    assert float(found["r_hat"].max()) < 1.02
    assert abs(float(found["mean"][0]) - centre) < 4 * error
    assert abs(float(found["sd"][0]) - sd) < 4 * error


@pytest.mark.ci
def test_the_density_is_one_at_whatever_weights_and_that_of_numpyro():
    with jax.enable_x64(True):
        problem = turned()
        point = automatic_start(problem)
        weights = ((jnp.linspace(0.1, 3.0, len(TIME)).at[0].set(1.0),),)
        other = problem.model.with_mixing(weights)
        moved = rewhitened(problem.model, point, weights)
        (part,) = other.recursions
        L = part.L / jnp.sqrt(part.weight)[:, None, :]
        states = trajectory(part.F, L, part.drift[:, :, None], moved.noises[0][:, :, None])[:, :, 0]
        np.testing.assert_allclose(states, point.states[0], atol=1e-9)
        here = float(mixed_density(problem.model, point))
        there = float(mixed_density(other, moved)) + 0.5 * 4 * float(jnp.sum(jnp.log(weights[0][0][1:])))
        assert abs(here - there) < 1e-9
        likelihood = sum(float(jnp.sum(v)) for v in problem.model.log_likelihood(point))
        own = float(Mixed(problem.model, 0).log_prob(point.noises[0]))
        assert abs(likelihood + own + 0.5 * np.log(2 * np.pi) * point.noises[0].size - here) < 1e-9


@pytest.mark.slow
def test_steps_have_the_density_of_the_motion_and_its_tails():
    with jax.enable_x64(True):
        problem = turned()
        model, motion = problem.model, probcal.motion.as_motion(problem.motion.motion)
        epochs = model.epochs()
        one = jax.tree.map(lambda leaf: leaf[3], epochs)
        before, after = jnp.array([0.0, 1.0, 2.0, -1.0]), jnp.array([0.9, 1.2, 2.1, -4.0])
        levels = jnp.zeros(0)
        value = model.log_step((before[None],), (after[None],), one, levels)
        assert abs(float(value) - float(motion.log_density(before, after, 0.5, {}))) < 1e-9
        gauss = probcal.motion.as_motion(ConstantVelocity(0.4)).log_density(before, after, 0.5, {})
        assert float(value) > float(gauss) + 5  # far out
        keys = jax.random.split(jax.random.key(0), 4000)
        drawn = jax.vmap(lambda k: model.step(k, (before[None],), one, levels)[0][0])(keys)
        again = jax.vmap(lambda k: motion.sample(k, before, 0.5, {}))(keys)
        for states in (drawn, again):
            centred = np.asarray(states)[:, 3] + 1.0
            assert stats.kurtosis(centred, fisher=False) > 6
            scaled = centred / (0.4 * np.sqrt(0.5))
            assert stats.kstest(scaled, stats.t(3.0).cdf).pvalue > 1e-3


@pytest.mark.slow
def test_a_family_of_many_degrees_of_freedom_is_the_gaussian():
    gauss, heavy = (probcal.fit(turned(df=df) if df else turned(None), probcal.EA()) for df in (None, 1e7))
    for name in ("mean", "sd", "gamma"):
        np.testing.assert_allclose(heavy["calibration"][name], gauss["calibration"][name], rtol=1e-2, atol=2e-3)
    np.testing.assert_allclose(only(heavy)["mean"], only(gauss)["mean"], atol=2e-2)


def test_simulated_tracks_and_prior_draws_have_the_tails():
    problem = turned()
    with jax.enable_x64(True):
        drawn = np.asarray(jax.jit(lambda key: problem.model.draw_noises(key, 0, 4000))(jax.random.key(3)))
    assert stats.kstest(drawn[3].ravel()[::7], stats.t(3.0).cdf).pvalue > 1e-3
    assert stats.kstest(drawn[0].ravel()[::7], stats.norm.cdf).pvalue > 1e-3
    with jax.enable_x64(True):
        model = turned(motion=reported).model
        known = np.asarray(jax.jit(lambda key: model.draw_noises(key, 0, 4000))(jax.random.key(4)))
    assert stats.kstest(known[:, :2].ravel()[::14], stats.t(3.0).cdf).pvalue > 1e-3  # the first epoch too
    together = np.corrcoef(drawn[3, 0] ** 2 > 4, drawn[3, 1] ** 2 > 4)[0, 1]
    assert together > 0.1  # the axes share their precision


@pytest.mark.parametrize("before", [ConstantVelocity(0.5, singular=True), ConstantVelocity(0.5)])
def test_tails_drive_their_own_component_behind_noise_of_lower_rank(before):
    @probcal.sensor(range=Channel("m", std=1.0), level=Channel("dB", std=1.0))
    def listener(target, pose):
        return {"range": jnp.linalg.norm(target.position - pose.position + 1e-3), "level": target.power}

    network = Network([listener.on(Node("a", (0.0, 0.0))), listener.on(Node("b", (50.0, 0.0)))])
    motion = before + RandomWalk("power", "dB", 1.0, (90.0, 0.1), noise=StudentT(2.5))
    run = simulate(network, motion, np.arange(400.0), key=0)
    (part,) = Problem(network, motion, run.table).model.recursions
    (tail,) = part.tails
    driving = np.flatnonzero(np.asarray(part.L)[3, -1])
    assert driving.tolist() == list(range(*tail.columns))
    assert stats.kurtosis(np.diff(run.truth.tracks["power"])) > 3.0


def test_what_it_refuses():
    for motion in (ConstantVelocity, ConstantAcceleration):
        with pytest.raises(InputError, match="cannot drive a motion"):
            motion(1.0, noise=Bernoulli())
    for make in (
        lambda noise: CoordinatedTurn(1.0, 0.1, noise=noise),
        lambda noise: RandomWalk("power", "dB", 1.0, (0.0, 1.0), noise=noise),
        lambda noise: White("emission", "m", 1.0, noise=noise),
    ):
        with pytest.raises(InputError, match=r"give noise.Normal\(\), StudentT\(df\) or Mixture"):
            make(Mixture(0.1, 10.0, delay=2.0))
        make(StudentT(4.0))
    with pytest.raises(InputError, match="Known: noise is Bernoulli"):
        Known((TIME, np.zeros((len(TIME), 2))), 0.3, Bernoulli())
    with pytest.raises(InputError, match="process noise"):
        probcal.log_evidence(turned(), prior=probcal.Gaussian())


@pytest.mark.slow
def test_targets_of_several_families_and_motions_stand_side_by_side():
    network = Network([finder.on(Node("a", (0.0, 0.0))), finder.on(Node("b", (5.0, 1.0)))])
    motion = {
        "plain": Target(ConstantVelocity(0.4), START),
        "heavy": Target(ConstantVelocity(0.4, noise=StudentT(2.0)), START),
        "jumpy": Target(ConstantVelocity(0.4, noise=Mixture(0.1, 20.0)), START),
        "bent": Target(ConstantVelocity(0.4, singular=True, noise=StudentT(3.0)), START),
    }
    drawn = simulate(network, motion, TIME, key=3)
    problem = Problem(network, motion, drawn.table)
    tree = probcal.fit(problem)
    assert tree.attrs["status"] == "converged"
    tracked = dict(each_track(tree))
    moved = {
        target: {str(name) for name, own in track.data_vars.items() if "weight" in str(name) and (own != 1).any()}
        for target, track in tracked.items()
    }
    assert not moved.pop("plain")
    assert all(len(names) == 1 for names in moved.values())
    assert len(set.union(*moved.values())) == 3
    em = probcal.fit(problem, probcal.EM(), prior=probcal.Gaussian())
    assert em.attrs["status"] == "converged"


def turning(noise, run=0):
    """A target that goes straight for 10 s, then turns for 1 s, again and again."""
    time = 0.5 * np.arange(120)
    angle = np.cumsum(np.where((time % 11) > 10, np.pi / 4, 0.0))
    path = np.cumsum(1.5 * np.stack([np.cos(angle), np.sin(angle)], 1), 0)
    network = Network([finder.on(Node("a", (0.0, 0.0))), finder.on(Node("b", (5.0, 1.0)))])
    drawn = simulate(network, ConstantVelocity(0.5), time, key=run, tracks={"target": path}, biases={"a.shift": 0.7})
    return Problem(network, ConstantVelocity(probcal.Unknown(0.5), noise=noise), drawn.table)


@pytest.mark.slow
def test_heavy_tails_are_found_and_gone_where_they_are_declared():
    kinds = []
    for noise in (probcal.motion.base.GAUSSIAN, StudentT(3.0)):
        problem = turning(noise)
        tree, _ = calibrate(problem)
        findings = probcal.assess(problem, tree)["finding"].to_dataset()
        kinds.append(findings["sentence"].values[findings["kind"].values == "motion"].tolist())
    assert "heavy tails" in kinds[0][0]
    assert "noise=StudentT(4)" in kinds[0][0]
    assert kinds[1] == []


@pytest.mark.slow
def test_a_target_that_keeps_turning_has_noises_that_go_together():
    time = 0.5 * np.arange(120)
    path = np.stack([20 * np.cos(time / 6), 20 * np.sin(time / 6)], 1)
    network = Network([finder.on(Node("a", (0.0, 0.0))), finder.on(Node("b", (5.0, 1.0)))])
    drawn = simulate(network, ConstantVelocity(0.5), time, key=0, tracks={"target": path})
    problem = Problem(network, ConstantVelocity(0.3), drawn.table)
    tree, _ = calibrate(problem)
    findings = probcal.assess(problem, tree)["finding"].to_dataset()
    texts = findings["sentence"].values[findings["kind"].values == "motion"].tolist()
    assert len(texts) == 1
    assert "is correlated in time" in texts[0]
    assert texts[0].endswith("declare ConstantAcceleration(std)")


def test_a_start_keeps_its_density_where_the_noise_goes_by_its_information():
    ((weight,),) = turned().model.by_information().mixing
    np.testing.assert_allclose(np.asarray(weight), [1.0, *(len(TIME) - 1) * [7 / 9]])


@pytest.mark.ci
def test_bounds_take_the_fisher_information_of_the_family():
    """Student-t noise of 3 degrees tells as Gaussian noise of sqrt(9 / 7) times the std: 4 entries an epoch."""
    problem = turned()
    width = np.sqrt(9.0 / 7.0)
    wide = ConstantVelocity(0.4 * width)
    like = Problem(problem.network, Target(wide, START), problem.measurements.table, fix=["b.shift"])
    own, other = (probcal.bounds(p, kind="parametric")["bias"]["sd"].values for p in (problem, like))
    np.testing.assert_allclose(own, other, rtol=1e-3)  # the automatic starts differ a little
    plain = probcal.bounds(turned(family=None), kind="parametric")["bias"]["sd"].values
    assert (own > plain).all()
