"""Every classical method against what defines it: exact posteriors, stationarity, fixed points; noise families."""

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
import reference
from contracts import check_tree, close
from worlds import linear, resting

import probcal
from probcal import ARD, EA, EM, EMEA, MAP, Cubature, Extended, Flat, Gaussian, Laplace, Mixture, StudentT, Unscented
from probcal.errors import InputError
from probcal.gaussian.dense import DenseEngine
from probcal.gaussian.draws import draw_trajectories
from probcal.gaussian.esteps import EStep, Expected
from probcal.gaussian.mode import cost, find_mode
from probcal.inference import METHODS, table
from probcal.inference.method import Context
from probcal.inference.methods import choose_prior
from probcal.inference.sampler import Sampler
from probcal.model import sigma
from probcal.model.model import At
from probcal.noise import AdditiveNoise, Normal
from probcal.priors import PRIORS, Precision, Prior
from probcal.results.modes import started
from probcal.results.schema import TYPE_II

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks" / "papers"))
from paper_b import PaperB, paper_b


def solve(method, prior=None, **options):
    """The shifted world, its naive form, and its fit from the start without noise."""
    problem, naive = linear("shifted")
    return (
        naive,
        problem,
        probcal.fit(problem, method, prior=prior, start=resting(problem), **options),
    )


def z_of(tree, linear):
    group = tree["calibration"].to_dataset().sel(bias_label=linear.labels)
    return group["mean"].values / group["scale"].values, group


@pytest.mark.parametrize(
    "method",
    [MAP(), pytest.param(EM(tolerance=1e-13, iterations=3000), marks=pytest.mark.slow)],
    ids=lambda m: m.name,
)
def test_correlated_biases_have_the_exact_posterior(method):
    prior = Gaussian(correlation={"*.position_x": 0.8, "*.position_y": -0.3})
    linear, _, tree = solve(method, prior)
    covariance = np.eye(len(linear.labels))
    for axis, value in (("x", 0.8), ("y", -0.3)):
        members = [m for m, label in enumerate(linear.labels) if label.endswith(f"position_{axis}")]
        assert len(members) == 3, "two free nodes and a surveyed one"
        covariance[np.ix_(members, members)] = np.where(np.eye(3) > 0, 1.0, value)
    exact = reference.dense(linear, covariance)
    z, group = z_of(tree, linear)
    close(z, exact.z[0], 1e-10 if isinstance(method, MAP) else 1e-5)
    close(group["sd"].values / group["scale"].values, np.sqrt(np.diag(exact.z[1])), 1e-9)
    assert tree.attrs["log_evidence"] == pytest.approx(exact.evidence, rel=1e-10 if isinstance(method, MAP) else 1e-6)
    assert "log_prior" not in tree.children, "correlated biases have no density of their own"


@pytest.mark.parametrize(
    "method",
    [
        MAP(iterations=3000, tolerance=1e-12),
        pytest.param(EM(iterations=5000, tolerance=1e-12), marks=pytest.mark.slow),
    ],
    ids=lambda m: m.name,
)
def test_l1_is_stationary(method):
    """Gradient of the marginal log-likelihood: lambda sign(z) at a bias that is kept, within lambda at a zero one."""
    linear, _, tree = solve(method, Laplace())
    z, group = z_of(tree, linear)
    free = group["status"].values != "survey"
    exact = reference.dense(linear, np.ones(len(z)))
    information = np.linalg.inv(exact.z[1]) - np.eye(len(z))
    slope = np.linalg.inv(exact.z[1]) @ exact.z[0] - information @ z
    kept = free & (np.abs(z) > 1e-3)
    gone = free & ~kept
    assert kept.any()
    assert gone.any(), "the case must hold a bias that l1 sets to zero"
    np.testing.assert_allclose(slope[kept], np.sqrt(2) * np.sign(z[kept]), atol=1e-3)
    assert (np.abs(slope[gone]) < np.sqrt(2) * (1 + 1e-6)).all()
    np.testing.assert_allclose(slope[~free], z[~free], atol=1e-4)
    assert (group["status"].values[gone] == "pruned").all()
    assert "log_evidence" not in tree.attrs
    assert "log_prior" not in tree.children, "the draws are not of that density"
    assert tree.attrs["intervals"].startswith("l1")


@pytest.mark.parametrize("by", ["node", "owner", "type", "component", "vector"])
def test_group_ard_shares_a_precision_at_the_fixed_point(by):
    linear, _, tree = solve(EA(iterations=5000, tolerance=1e-12, precisions="maximised"), ARD(by=by))
    z, group = z_of(tree, linear)
    alpha, gamma, free = group["precision"].values, group["gamma"].values, group["status"].values != "survey"
    wanted = 2 if by in ("node", "owner", "vector") else 1
    assert len(np.unique(alpha[free].round(9))) == wanted
    for value in np.unique(alpha[free]):
        mine = free & (alpha == value)
        if gamma[mine].sum() > 0.1:
            assert value * (z[mine] ** 2).sum() == pytest.approx(gamma[mine].sum(), rel=1e-3)
    exact = reference.dense(linear, alpha)
    close(z, exact.z[0], 1e-8)


@pytest.mark.slow
def test_mackay_and_em_updates_share_fixed_points():
    linear, _, fast = solve(EA(iterations=5000, tolerance=1e-12, precisions="maximised"))
    _, _, slow = solve(EA(iterations=5000, tolerance=1e-8, update="em", precisions="maximised"))
    a, b = z_of(fast, linear), z_of(slow, linear)
    kept = a[1]["gamma"].values > 0.3
    assert kept.any()
    np.testing.assert_allclose(a[0][kept], b[0][kept], rtol=0.01)
    assert len(fast["optimisation"]["objective"]) < len(slow["optimisation"]["objective"])
    trace = slow["optimisation"]["objective"].values
    assert (np.diff(trace) > -1e-8).all(), "EM never lowers the evidence"


@pytest.mark.parametrize(
    "method",
    [
        EMEA(iterations=3),
        EA.as_printed(iterations=3),
    ],
    ids=repr,
)
def test_iterations_are_a_cap_and_what_is_reported_belongs_together(method):
    linear, problem, tree = solve(method)
    _, group = z_of(tree, linear)
    assert tree["optimisation"].sizes["iteration"] == 3
    information = tree["calibration"]["information"].values
    covariance = np.linalg.inv(information + np.diag(tree["calibration"]["precision"].values))
    sd = tree["calibration"]["sd"].values / problem.scales
    close(sd, np.sqrt(np.diag(covariance)), 1e-9)
    gamma = 1 - group["precision"] * (group["sd"] / group["scale"]) ** 2
    np.testing.assert_allclose(group["gamma"], np.clip(gamma, 0, 1), atol=1e-9)
    if isinstance(method, EMEA):
        assert tree.attrs["message"].startswith("All 3 iterations were run, as asked; the last moved the objective by")


@pytest.mark.slow
def test_least_squares_does_not_know_the_origin():
    """Shifting the world to a map's northings moves nothing: the free positions are centred on the nodes."""
    kind, found = probcal.sensors.ranger, []
    corners = np.array([(0, 0), (60, 0), (60, 60), (0, 60)], float)
    path = np.stack([np.linspace(5, 55, 12), 30 + 20 * np.sin(np.linspace(0, 6, 12))], 1)
    for shift in (0.0, 4e6):
        nodes = [probcal.Node(f"n{k}", p + shift) for k, p in enumerate(corners)]
        network = probcal.Network([kind.on(node) for node in nodes])
        run = probcal.simulate(network, probcal.ConstantVelocity(0.5), np.arange(12.0), key=1, biases={},
                               tracks={"target": path + shift})  # fmt: skip
        problem = probcal.Problem(network, probcal.ConstantVelocity(0.5), run.table, fix=["*.range_scale"])
        found.append(probcal.fit(problem, probcal.LeastSquares()))
    means = [tree["calibration"]["mean"].values for tree in found]
    np.testing.assert_allclose(means[1], means[0], atol=1e-3)


@pytest.mark.parametrize(
    "prior", [Gaussian(), pytest.param(Flat(), marks=pytest.mark.ci)], ids=lambda p: type(p).__name__
)
def test_em_reaches_the_mode_and_the_maximum_likelihood(prior):
    _, _, by_em = solve(EM(iterations=20_000, tolerance=1e-13), prior)
    linear, _, by_mode = solve(MAP(), prior)
    np.testing.assert_allclose(z_of(by_em, linear)[0], z_of(by_mode, linear)[0], atol=1e-4)


@pytest.mark.parametrize("rule", [Unscented(), pytest.param(Cubature(), marks=pytest.mark.slow)], ids=repr)
@pytest.mark.parametrize("name", ["plane", pytest.param("extras", marks=pytest.mark.slow)])
def test_sigma_points_change_nothing_where_sensors_are_linear(name, rule):
    problem, _ = linear(name)
    methods = [EM(step, iterations=40, tolerance=0.0) for step in (Extended(), rule)]
    found = [probcal.fit(problem, method, start=resting(problem))["calibration"]["mean"].values for method in methods]
    np.testing.assert_allclose(found[1], found[0], atol=1e-6)


@pytest.mark.parametrize("rule", [sigma.unscented, sigma.cubature])
def test_sigma_points_do_not_turn_with_rounding(rule):
    """Axes of equal variance: any eigenvectors are theirs, and two machines take others."""
    covariance, crossed = 4e4 * np.eye(2), 1e-9 * (1.0 - np.eye(2))
    found = [sigma.sigma_points(jnp.asarray(covariance + sign * crossed), rule) for sign in (-1.0, 0.0, 1.0)]
    assert max(abs(points.shift - found[1].shift).max() for points in found) < 1e-9


@pytest.mark.parametrize("rule", [Unscented(), Cubature()], ids=repr)
@pytest.mark.parametrize("method", [EM, EMEA])
@pytest.mark.slow
def test_sigma_points_where_sensors_are_bent(method, rule):
    """Radars near a target: other answers than by derivatives, but closer to them than their intervals are wide."""
    kind = probcal.sensors.radar
    nodes = [probcal.Node(f"n{k}", p, scale={"heading": 0.1}) for k, p in enumerate([(0, 0), (60, 0), (30, 50)])]
    network = probcal.Network([kind.on(node) for node in nodes])
    path = np.stack([np.linspace(5, 55, 30), 20 + 8 * np.sin(np.linspace(0, 6, 30))], 1)
    run = probcal.simulate(network, probcal.ConstantVelocity(1.0), np.arange(30.0), key=3, tracks={"target": path})
    problem = probcal.Problem(network, probcal.ConstantVelocity(1.0), run.table)
    found = [probcal.fit(problem, method(step)) for step in (Extended(), rule)]
    means = [tree["calibration"]["mean"].values for tree in found]
    moved = np.abs(means[1] - means[0]) / problem.scales
    assert moved.max() > 1e-6, "the rule must matter"
    assert moved.max() < 0.3
    assert probcal.scores(found[1], run.truth)["position_rmse_after"] < 5.0


@dataclass(frozen=True)
class Drawn(EStep):
    """Monte Carlo: trajectories drawn around their mode, with the draws counted (Wei and Tanner 1990)."""

    count: int

    def begin(self, model, point):
        return jnp.zeros((), int)

    def __call__(self, model, point, prior, carry, key):
        mode = find_mode(model, point, prior, 20, 1e-9, joint=False).point
        states = draw_trajectories(DenseEngine().at(model, mode), jnp.tile(mode.z, (self.count, 1)), key)
        at = At(states, mode.z, mode.levels)
        found = jax.vmap(lambda x: model.of_sensors(model.linearise(at._replace(states=x), expected=False)))(states)
        information, score = jax.tree.map(lambda part: part.mean(0), found)
        return Expected(mode, information, score, jnp.inf, jnp.zeros((), bool)), carry + self.count


def test_an_e_step_draws_by_its_key_and_keeps_its_carry():
    """400 draws a step: the biases scatter around those of the exact E-step by 1/20 of their sd at fixed tracks."""
    problem, _ = linear("plane")
    with jax.enable_x64(True):
        start = resting(problem)

        def end(step, seed):
            method = EM(step, iterations=40, tolerance=0.0)
            return method.climb(problem, Gaussian(), start, Context(jax.random.key(seed)))[0]

        exact, runs = end(Extended(), 0), [end(Drawn(400), seed) for seed in (0, 0, 1)]
        sd = np.sqrt(np.diagonal(exact.found.covariance))
        density = -float(jax.jit(cost)(problem.model, exact.point, Precision(np.ones(problem.model.biases))))
    assert float(exact.objective) == pytest.approx(density), "the objective is the joint density, the prior once"
    z = np.stack([run.point.z for run in runs])
    assert [int(run.carry) for run in runs] == [16_000] * 3
    np.testing.assert_array_equal(z[0], z[1])
    assert (z[0] != z[2]).all()
    assert (np.abs(z - np.asarray(exact.point.z)) < 0.3 * sd).all()  # six of 1/20: less than one alarm in 10^6


@pytest.mark.ci
def test_paper_b_marginalises_each_epoch_alone():
    """R-bar = R + H P H' built row by row (Paper B 10-17) gives the covariance, mean step and evidence reported."""
    from probcal.gaussian.mode import smooth_tracks
    from probcal.priors import Precision

    problem, naive = linear("shifted")
    alpha, M = np.full(len(naive.labels), 0.7), len(naive.labels)
    with jax.enable_x64(True):
        point = smooth_tracks(problem.model, jax.tree.map(jnp.asarray, resting(problem)))
        found, step = jax.jit(paper_b)(problem.model, point, Precision(jnp.asarray(alpha)))
    held = reference.dense(naive, None, hold=np.zeros(M))
    order = [problem.labels.index(label) for label in naive.labels]
    information, pull = np.zeros((M, M)), np.zeros(M)
    offsets, offset = {}, M
    for c, chain in enumerate(naive.chains):
        for e in range(len(chain.times)):
            offsets[c, e] = slice(offset, offset + len(chain.names))
            offset += len(chain.names)
    for key, here in offsets.items():
        data = [d for d in naive.data if (d.chain, d.epoch) == key]
        if not data:
            continue
        G, H = np.stack([d.G for d in data]), np.stack([d.H for d in data])
        P = held.covariance[here, here]
        R = np.diag([d.std**2 for d in data]) + H @ P @ H.T
        residual = np.array([d.y - d.offset for d in data]) - H @ held.mean[here]
        information += G.T @ np.linalg.solve(R, G)
        pull += G.T @ np.linalg.solve(R, residual)
    covariance = np.linalg.inv(information + np.diag(alpha))
    close(np.asarray(found.information)[np.ix_(order, order)], information, 1e-9)
    close(np.asarray(step)[order], covariance @ pull, 1e-9)
    _, _, tree = solve(PaperB())
    exact = solve(EA.as_printed())[2]
    group, true = tree["calibration"].to_dataset(), exact["calibration"].to_dataset()
    kept = true["gamma"].values > 0.5
    assert (group["sd"].values[kept] < true["sd"].values[kept]).all(), "the data count twice"


def test_every_optimum_is_reported_the_best_first():
    tree = solve(EA(precisions="maximised"), starts=3, key=1)[2]
    optima = started(tree)
    assert optima["bias"].dims == ("mode", "bias_label")
    assert sorted(optima["start"].values) == [0, 1, 2]
    assert optima["objective"].values.argmax() == 0
    assert optima.attrs["objective"] == TYPE_II
    assert tree.attrs[TYPE_II] == optima["objective"].values[0]
    np.testing.assert_array_equal(optima["bias"].values[0], tree["calibration"]["mean"].values)
    again = solve(EA(precisions="maximised"), starts=3, key=1)[2]
    np.testing.assert_array_equal(again["mode"]["bias"].values, tree["mode"]["bias"].values)


@dataclass(frozen=True)
class Logistic(AdditiveNoise):
    """A family as a user writes it: all but density and draw is derived."""

    def log_density(self, e):
        return -2.0 * jnp.logaddexp(0.5 * e, -0.5 * e)

    def draw(self, key, shape):
        return jax.random.logistic(key, shape)


@dataclass(frozen=True)
class Skewed(AdditiveNoise):
    """A density that is not symmetric (logistic of type I, shape 2): score and residual may differ in sign."""

    def log_density(self, e):
        return jnp.log(2.0) + e + 3.0 * -jnp.logaddexp(e, 0.0) + e

    def draw(self, key, shape):
        return jax.scipy.special.logit(jnp.sqrt(jax.random.uniform(key, shape)))


FAMILIES = [Logistic(), Skewed(), Normal(), StudentT(4.0), Mixture(0.2, 8.0), Mixture(0.1, 5.0, delay=6.0)]


@pytest.mark.parametrize("family", FAMILIES, ids=repr)
def test_noise_families_agree_with_their_density(family):
    """Score, level score and expected information follow from the log density; it integrates to one."""
    std, r = 0.7, np.linspace(-40, 40, 160_001)

    @jax.jit
    def laws(y, zero, level, key):
        def density(predicted, s):
            return family.log_likelihood(y, predicted, s, None)

        slopes = [
            jax.jvp(lambda m: density(m, level), (zero,), (jnp.ones_like(y),))[1],
            jax.jvp(lambda s: density(zero, s), (level,), (level,))[1],
        ]
        own = [law(y, zero, level, None) for law in (family.score, family.level_score, family.weight, family.reliance)]
        drawn = family.sample(key, jnp.zeros(200_000), jnp.full(200_000, std))
        return jnp.exp(density(zero, level)), *slopes, *own, family.information(zero, level), drawn

    with jax.enable_x64(True):
        found = laws(r, np.zeros_like(r), np.full_like(r, std), jax.random.key(0))
    p, by_predicted, by_level, score, level_score, weight, reliance, information, drawn = map(np.asarray, found)
    np.testing.assert_allclose(score, by_predicted, atol=1e-9)
    np.testing.assert_allclose(level_score, 1 + by_level, atol=1e-9)
    assert np.trapezoid(p, r) == pytest.approx(1.0, abs=1e-3)  # a Student-t has its tails beyond
    assert np.trapezoid(p * by_predicted**2, r) == pytest.approx(float(information[0]), rel=1e-3)
    assert (weight > 0).all()
    assert ((reliance >= 0) & (reliance <= 1)).all()
    if not isinstance(family, Skewed):
        assert reliance[np.abs(r) < 0.1].min() > 0.8
    if not isinstance(family, (Normal, Skewed)):
        assert reliance[np.abs(r) > 20].max() < 0.1
    edges = np.array([-2.0, -0.7, 0.0, 0.7, 2.0, 5.0])
    cumulative = np.interp(edges, r, np.cumsum(p) * (r[1] - r[0]))
    # six empirical probabilities of 200000 draws: sd at most 0.0011, five of them fail in 4e-6 of seeds
    np.testing.assert_allclose([(drawn < e).mean() for e in edges], cumulative, atol=0.0056)


@probcal.sensor(range=probcal.Channel("m", std=0.5))
def gauge(target, pose, *, range_offset=probcal.Bias("m", 3.0)):
    return dict(range=probcal.geometry.norm(target.position - pose.position) + range_offset)


NOISES = (Mixture(0.1, 5.0, delay=15.0), StudentT(4.0), Mixture(0.1, 10.0))


@pytest.mark.parametrize(
    ("noise", "method"),
    [
        pytest.param(noise, method, id=f"{noise!r}-{method.name}", marks=pytest.mark.slow)
        for noise in NOISES
        for method in (EA(), EM(), EMEA())
    ],
)
def test_outlying_rows_are_listed(noise, method):
    kind = replace(gauge, channels={"range": replace(gauge.channels["range"], noise=noise)})
    corners = [(0, 0), (60, 0), (60, 60), (0, 60), (30, -10), (75, 30)]
    network = probcal.Network([kind.on(probcal.Node(f"gauge_{k}", p)) for k, p in enumerate(corners)])
    path = np.stack([np.linspace(5, 55, 40), 30 + 20 * np.sin(np.linspace(0, 6, 40))], 1)
    tracks, motion = {"target": path}, probcal.ConstantVelocity(0.5)
    run = probcal.simulate(network, motion, np.arange(40.0), key=4, share=0.5, tracks=tracks)
    table = run.table.copy()
    clean = np.hypot(*(path[table["time"].astype(int)] - np.array(corners)[table["sensor"].str[-1].astype(int)]).T)
    clean = clean + table["sensor"].map(lambda s: run.truth.biases[f"{s}.range_offset"])
    table["range"] = clean + 0.5 * np.random.default_rng(1).normal(size=len(table))
    hit = np.arange(3, len(table), 17)
    table.loc[hit, "range"] += 8.0
    tree = probcal.fit(probcal.Problem(network, motion, table), method)
    listed = probcal.outliers(tree)
    assert set(listed["row"][: len(hit)]) == set(hit), "the rows that were hit stand first"
    assert (np.diff(listed["weight"]) >= 0).all()
    assert len(listed) < 2 * len(hit)
    assert probcal.scores(tree, run.truth)["bias_rmse"] < 0.3


@pytest.mark.parametrize("name", METHODS)
def test_a_prior_that_a_method_does_not_take_is_refused(name):
    method, _ = METHODS[name]
    for prior in PRIORS.values():
        if not method.takes(prior):
            with pytest.raises(InputError, match=f"does not take the prior {type(prior).__name__}; it takes: "):
                choose_prior(method, prior)
        else:
            assert choose_prior(method, prior) is prior


def check_pair(name, prior):
    """The contract of results."""
    method, own = METHODS[name]
    _, problem, tree = solve(method, prior or own)
    check_tree(tree, problem)
    assert tree.attrs["prior"] == type(choose_prior(method, prior or own)).__name__
    # so many iterations, as in the papers; by particles they may have settled by then
    asked = getattr(method, "tolerance", 1.0) == 0.0 and not method.by_particles
    assert tree.attrs["status"] == ("iterations spent" if asked else "converged")
    assert tree.attrs["requested"] == tree.attrs["method"]


OFTEN = ("ea", "ea-em", "em-ea", "em", "map", "map-l1")  # other tests of this file fit them too


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name in OFTEN else pytest.mark.ci)
        for name, (method, _) in METHODS.items()
        if not isinstance(method, Sampler)
    ],
)
def test_every_method_fits_with_its_own_prior(name):
    check_pair(name, None)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name, (method, _) in METHODS.items() if not isinstance(method, Sampler)])
def test_every_pair_of_prior_and_method_fits(name):
    """Every prior that a method takes, groups of ARD apart; samplers stand in `test_samplers.py`."""
    for prior in PRIORS.values():
        if METHODS[name][0].takes(prior) and getattr(prior, "by", None) is None:
            check_pair(name, prior)


def test_precisions_follow_from_what_was_found():
    """MacKay's rule and EM's, biases alone and in groups, with and without a hyper-prior, by hand; and l1's."""
    gamma, variance, z = np.array([0.9, 0.5, 0.1]), np.array([0.1, 0.5, 0.9]), np.array([2.0, -0.5, 0.1])
    alone, pair = np.arange(3), np.array([0, 0, 2])
    with jax.enable_x64(True):
        for prior, group, shape, rate in (
            (ARD(), alone, 1.0, 0.0), (ARD(2.0, 1.5), alone, 2.0, 1.5), (ARD(by="node"), pair, 1.0, 0.0),
            (ARD(3.0, 0.5, by="type"), pair, 3.0, 0.5),
        ):  # fmt: skip
            learn = jax.jit(prior.learn, static_argnums=4)
            mackay, em = (np.asarray(learn(gamma, variance, z, group, rule)) for rule in ("mackay", "em"))
            for m in range(3):
                mine = group == group[m]
                square = (z[mine] ** 2).sum()
                assert mackay[m] == pytest.approx((gamma[mine].sum() + 2 * (shape - 1)) / (square + 2 * rate))
                square += variance[mine].sum()
                assert em[m] == pytest.approx((mine.sum() + 2 * (shape - 1)) / (square + 2 * rate))
        found = jax.jit(Laplace().learn, static_argnums=4)(gamma, variance, z, group, "mackay")
        np.testing.assert_allclose(found, np.sqrt(2) / np.abs(z))


def test_the_table_of_pairs_is_that_of_the_guide():
    text = (Path(__file__).parents[1] / "notebooks" / "extend" / "method.md").read_text()
    for name, row in table().iterrows():
        cells = " | ".join(row)
        assert f"| `{name}()` | {cells} |" in text


@pytest.mark.parametrize(
    "tied", [pytest.param(True, marks=pytest.mark.ci), pytest.param(False, marks=pytest.mark.slow)]
)
def test_least_squares_with_known_targets_is_the_closed_form(tied):
    """Known targets: the normal equations; with an unknown target beside them, its states are free at every epoch."""
    kind = probcal.sensors.position
    nodes = [probcal.Node("a", (0.0, 0.0), scale=5.0), probcal.Node("b", (9.0, 1.0), scale=5.0)]
    network = probcal.Network([kind.on(node) for node in nodes])
    time = np.arange(12.0)
    path = pd.DataFrame({"time": time, "position_x": 3 * time, "position_y": 5 - time})
    motion = {"car": probcal.Known(path), "bird": probcal.ConstantVelocity(0.1)}
    random, rows = np.random.default_rng(2), []
    for target, at in (("car", path[["position_x", "position_y"]].to_numpy()), ("bird", np.zeros((12, 2)))):
        for t, p in zip(time, at, strict=True):
            for node in nodes:
                x, y = p - node.position + 3 * random.standard_normal(2)
                rows.append((t, node.name, target, x, y))
    data = pd.DataFrame(rows, columns=["time", "sensor", "target", "position_x", "position_y"])
    for chosen in (data,) if tied else (data[data["target"] == "car"],):
        problem = probcal.Problem(network, motion, chosen)
        tree = probcal.fit(problem, probcal.LeastSquares())
        known = chosen[chosen["target"] == "car"].reset_index(drop=True)
        stated = known["sensor"].map({"a": 0, "b": 1}).to_numpy()
        truth = path[["position_x", "position_y"]].to_numpy()[known["time"].astype(int)]
        offset = truth - np.stack([n.position for n in nodes])[stated] - known[["position_x", "position_y"]].to_numpy()
        pull, count = np.zeros((2, 2)), np.zeros(2)
        for n in range(2):
            pull[n], count[n] = offset[stated == n].sum(0), (stated == n).sum()
        information = np.diag(count)
        if len(chosen) == len(data):  # a free position seen by both ties the two nodes together: half an epoch each
            free = chosen[chosen["target"] == "bird"]
            sides = [free[free["sensor"] == name][["position_x", "position_y"]].to_numpy() for name in "ab"]
            apart = (sides[0] + nodes[0].position - sides[1] - nodes[1].position).sum(0) / 2
            information = information + 6 * np.array([[1, -1], [-1, 1]])
            pull = pull + np.stack([-apart, apart])
        expected = np.linalg.solve(information, pull).ravel()
        assert tree.attrs["status"] == "converged"
        np.testing.assert_allclose(tree["calibration"]["mean"].values, expected, atol=2e-3)


ERRORS = [
    (lambda: Mixture(1.2), "the share of echoes must lie between 0 and 1"),
    (lambda: Mixture(0.1, -1.0), "the scale of echoes must lie between 0.001 and 1000 stds"),
    (lambda: Mixture(0.1, 1.0), "an echo must differ from an inlier"),
    (lambda: EA(update="newton"), 'EA\\(update="newton"\\): give one of mackay, em'),
    (lambda: EA(trajectory="none"), 'EA\\(trajectory="none"\\): give one of joint, marginal'),
    (lambda: EM("cubature"), r"EM\(e_step='cubature'\): give an E-step such as Extended\(\), Cubature"),
    (lambda: EMEA(inner=0), "EM-EA\\(inner=0\\): at least one inner iteration is needed"),
    (
        lambda: ARD(by="nod"),
        'ARD\\(by="nod"\\): give one of owner, node, type, component, vector; did you mean "node"?',
    ),
    (lambda: ARD(shape=0.5), "shape must be 1 or more"),
    (lambda: solve(EA(iterations=0)), "EA\\(iterations=0\\): at least one iteration is needed"),
    (lambda: solve(MAP(tolerance=float("nan"))), "MAP\\(tolerance=nan\\): give a finite number that is not negative"),
    (lambda: probcal.Channel("m", noise=Gaussian()), "give a noise family such as StudentT"),
    (lambda: Gaussian(correlation={"a": 1.5}), 'correlation "a" is 1.5: it must lie between -1 and 1'),
    (lambda: probcal.Horseshoe(expected=2.0), "the share must lie between 0 and 1"),
    (lambda: probcal.Horseshoe(slab_scale=0.0), "slab_scale=0.0\\): it must be positive"),
    (lambda: solve(MAP(), Gaussian(correlation={"nothing": 0.5})), 'correlation "nothing" reaches 0 bias'),
    (lambda: solve(EA(), ARD(correlation={"*.position_x": 0.5})), "a.position_x, which has no survey"),
    (lambda: solve(MAP(), Gaussian(correlation={"*_x": 0.5, "a.*": 0.1})), "a.position_x, which another pattern"),
    (lambda: solve(MAP(), Gaussian(correlation={"*_x": -0.7})), "too negative for 3 biases"),
    (lambda: solve(MAP(), starts=0), "starts=0: at least one start is needed"),
]


@pytest.mark.parametrize(("call", "text"), ERRORS, ids=[text[:30] for _, text in ERRORS])
def test_error_texts(call, text):
    with pytest.raises(InputError, match=text):
        call()


def test_a_prior_whose_hyper_parameters_nobody_draws_is_refused():
    @dataclass(frozen=True)
    class Scales(Prior):
        hierarchical = True

    with pytest.raises(InputError, match="Scales has hyper-parameters but no class that draws them"):
        probcal.fit(linear("plane")[0], probcal.EA(), prior=Scales())
