"""Particle filters and smoothers alone: against dense Gaussians, quadrature, and identities that hold for any model.

Numbers of runs are chosen so that a comparison fails by chance with a probability below 1e-4 (5 standard errors of
some dozens of means); what size of a defect it would see stands with each test. All are of fixed keys.
"""

import sys
from functools import cache, partial
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
import reference
from gliders import CV, PLANE, POWER, POWERED, START, TIMES, Glider, plan_of
from worlds import fix

from probcal import (
    Channel,
    ConstantVelocity,
    InputError,
    Network,
    Node,
    Problem,
    Static,
    Target,
    Unknown,
    resampling,
    sensor,
    simulate,
)
from probcal.noise import StudentT
from probcal.particles import settings
from probcal.particles.conditional import conditional_path, conditional_paths
from probcal.particles.ensemble import (
    ensemble,
    log_likelihood_over,
    log_motion_over,
    moved_levels,
    nearest_states,
    over_paths,
    state_moments,
)
from probcal.particles.filtering import run_filter
from probcal.particles.particles import Particles
from probcal.particles.proposals import check_proposal
from probcal.particles.settings import SMOOTHERS
from probcal.particles.targets import along_targets, place_by_epoch, targets_of, weigh_rows

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks" / "papers"))
from paris import smoothed_sum

pytest.importorskip("cuthbert", reason="cuthbert is not installed: uv sync --group test")

LEVEL = 0.3  # log of the true process noise over its guess, wherever a level is unknown
WILD = StudentT(3.0)


@sensor(distance=Channel("m", std=0.5))
def tape(target, pose):
    away = target.position - pose.position
    return {"distance": jnp.sqrt(jnp.sum(away**2) + 1e-6)}


@sensor(root=Channel("m", std=1.0))
def broken(target, pose):
    return {"root": jnp.sqrt(target.position[0] - pose.position[0])}


@cache
def table_of(powered):
    """Rows of two asynchronous targets of 5 and 4 epochs, some values missing, one epoch of the second without any."""
    network, motion = (POWERED, CV + POWER) if powered else (PLANE, CV)
    motion = {name: Target(motion, START) for name in TIMES}
    table = simulate(network, motion, [0.0], key=3, schedule=plan_of(network, TIMES), biases={}).table
    table.loc[np.arange(len(table)) % 5 == 3, "position_x"] = np.nan
    columns = [name for name in table if name.startswith(("position", "level"))]
    table.loc[(table["target"] == "two") & (table["time"] == 0.5), columns] = np.nan
    return table


@cache
def world(name, level=LEVEL):
    """A problem of two targets with an unknown process noise, and the dense Gaussian of the same data."""
    powered, unknown = name == "joint", Unknown(0.8)
    linear, glider = ConstantVelocity(unknown), Glider(unknown)
    motions = {
        "linear": {target: Target(linear, START) for target in TIMES},
        "glider": dict.fromkeys(TIMES, glider),
        "joint": {"one": POWER + glider, "two": Target(linear + POWER, START)},
    }[name]
    network, table = POWERED if powered else PLANE, table_of(powered)
    problem = Problem(network, motions, table)

    def naive_at(level):
        moving = ConstantVelocity(0.8 * np.exp(level))
        moving = moving + POWER if powered else moving
        return reference.Linear(network, {target: Target(moving, START) for target in TIMES}, table, {})

    def evidence(z, level):
        return reference.dense(naive_at(level), None, hold=z).evidence

    naive = naive_at(level)
    z = 0.2 * np.linspace(-1.0, 1.0, problem.model.biases)
    held = reference.dense(naive, None, hold=z)
    starts = np.cumsum([0, *(len(chain.names) * len(chain.times) for chain in naive.chains)])
    index = []
    for epochs in problem.epochs:
        own = np.zeros((len(epochs.time), len(epochs.components)), int)
        for e, (time, target) in enumerate(zip(epochs.time, epochs.target, strict=True)):
            k = next(k for k, chain in enumerate(naive.chains) if chain.target == target)
            first = starts[k] + len(naive.chains[k].names) * naive.chains[k].times.index(time)
            own[e] = [first + naive.chains[k].names.index(part) for part in epochs.components]
        index.append(own)
    mean, sd = held.states
    with jax.enable_x64(True):
        targets = targets_of(problem.model)
    return SimpleNamespace(
        problem=problem, model=problem.model, targets=targets, z=z, levels=np.array([level]), evidence=evidence,
        exact=held.evidence, index=index, mean=[mean[k] for k in index], sd=[sd[k] for k in index],
        whole=mean, covariance=held.covariance[held.biases :, held.biases :],
    )  # fmt: skip


@cache
def still():
    """A target that rests among three tapes: one epoch, not linear; evidence and moments by quadrature on a grid."""
    nodes = [Node(name, place) for name, place in (("a", (0.0, 0.0)), ("b", (5.0, 0.0)), ("c", (1.0, 6.0)))]
    measured = np.array([3.1, 4.2, 3.4])
    table = pd.DataFrame({"time": 0.0, "sensor": list("abc"), "target": "rock", "distance": measured})
    network = Network([tape.on(node, name=node.name) for node in nodes])
    problem = Problem(network, Target(Static(), {"position": ((2.0, 2.0), 1.5)}), table)
    grid = np.linspace(-5.0, 9.0, 1401)
    x, y = np.meshgrid(grid, grid, indexing="ij")
    log = -0.5 * ((x - 2) ** 2 + (y - 2) ** 2) / 1.5**2 - np.log(2 * np.pi * 1.5**2)
    for node, value in zip(nodes, measured, strict=True):
        away = (value - np.sqrt((x - node.position[0]) ** 2 + (y - node.position[1]) ** 2 + 1e-6)) / 0.5
        log += -0.5 * away**2 - 0.5 * np.log(2 * np.pi * 0.25)
    share = np.exp(log)
    return problem, np.log(share.sum() * (grid[1] - grid[0]) ** 2)


@cache
def wild():
    """One target whose velocity jumps: process noise with heavy tails, nothing of it linear and Gaussian."""
    plan = plan_of(PLANE, {"one": [0.0, 0.5, 1.5, 2.0, 4.0]})
    run = simulate(PLANE, Target(CV, START), [0.0], key=5, schedule=plan, biases={})
    return Problem(PLANE, Target(ConstantVelocity(0.8, noise=WILD), START), run.table)


@cache
def restless():
    """The same with noise so wide that ancestors are many, and tails as heavy as those of a Cauchy."""
    table = wild().measurements.table.frame
    return Problem(PLANE, Target(ConstantVelocity(3.0, noise=StudentT(1.0)), START), table)


@cache
def ranging():
    """One target of linear motion that tapes see, which are not linear."""
    nodes = [Node("a", (-1.0, -3.0)), Node("b", (5.0, 0.0))]
    network = Network([tape.on(node, name=node.name) for node in nodes])
    run = simulate(network, Target(CV, START), np.array([0.0, 0.5, 1.5, 2.0]), key=5)
    return Problem(network, Target(CV, START), run.table)


@partial(jax.jit, static_argnames=("how", "runs"))
def evidences(targets, z, levels, key, how, runs):
    """Estimates (runs,) of the log evidence of all targets."""

    def one(key):
        keys = jax.random.split(key, len(targets.there))
        each = jax.vmap(lambda e, there, k: run_filter(targets.model, e, there, z, levels, k, how).log_evidence)
        return jnp.sum(each(targets.epochs, targets.there, keys))

    return jax.lax.map(one, jax.random.split(key, runs), batch_size=50)


@partial(jax.jit, static_argnames=("how", "runs"))
def smoothings(model, targets, z, levels, centre, key, how, runs):
    """SmoothedParticles means and mean squares about `centre` of what rows see, of every run."""

    def one(key):
        found = state_moments(model, ensemble(model, targets, z, levels, key, how))
        return [(own.mean, own.variance + (own.mean - c) ** 2) for own, c in zip(found, centre, strict=True)]

    return jax.lax.map(one, jax.random.split(key, runs), batch_size=10)


def near(drawn, exact, slack=0.0, errors=5.0):
    """Whether the mean of runs (R, ...) is the exact value within its standard errors and some slack."""
    drawn = np.asarray(drawn)
    away = np.abs(drawn.mean(0) - exact)
    return bool((away <= errors * drawn.std(0, ddof=1) / np.sqrt(len(drawn)) + slack).all())


# evidence


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "proposal"),
    [("linear", "bootstrap"), ("linear", "extended"), pytest.param("joint", "auto", marks=pytest.mark.slow)],
)
def test_the_evidence_is_unbiased(name, proposal):
    """1,000 filters of 100 particles, targets of 5 and 4 epochs: sees a bias of some 10 % (bootstrap), 3 % (extended).

    Of the joint world each recursion is asked by itself. False alarms below 1e-5.
    """
    found, w = 0.0, world(name)
    with jax.enable_x64(True):
        for r, targets in enumerate(w.targets):
            how = Particles(100, proposal=proposal)
            found = found + np.asarray(evidences(targets, w.z, w.levels, jax.random.key(r), how, 1000))
    ratio = np.exp(found - w.exact)
    assert ratio.std() < 1.0, "the particles are enough for the comparison to mean something"
    assert abs(ratio.mean() - 1) < 4.5 * ratio.std(ddof=1) / np.sqrt(len(ratio))


@pytest.mark.parametrize("proposal", ["bootstrap", "extended", "laplace"])
def test_the_evidence_of_a_scene_that_is_not_linear_is_that_of_quadrature(proposal):
    """1,000 filters of 100 particles, one epoch: sees a bias of 3 % (bootstrap), 1 % (guided); false alarms 1e-5."""
    problem, exact = still()
    with jax.enable_x64(True):
        (targets,) = targets_of(problem.model)
        how = Particles(100, proposal=proposal)
        found = evidences(targets, np.zeros(0), np.zeros(0), jax.random.key(1), how, 1000)
    ratio = np.exp(np.asarray(found) - exact)
    assert ratio.std() < 0.3
    assert abs(ratio.mean() - 1) < 4.5 * ratio.std(ddof=1) / np.sqrt(len(ratio))


@pytest.mark.slow
def test_heavy_tails_have_one_evidence_by_either_proposal():
    """1,000 filters of 300 particles each way: sees 10 % between them; false alarms 1e-5."""
    problem, found = wild(), []
    with jax.enable_x64(True):
        (targets,) = targets_of(problem.model)
        for k, proposal in enumerate(("bootstrap", "extended")):
            how, z = Particles(300, proposal=proposal), np.zeros(problem.model.biases)
            found.append(np.asarray(evidences(targets, z, np.zeros(0), jax.random.key(k), how, 1000)))
    one, other = np.exp(np.array(found) - np.mean(found[1]))
    error = np.sqrt((one.var() + other.var()) / 1000)
    assert error < 0.03 * one.mean()
    assert abs(one.mean() - other.mean()) < 4.5 * error


# smoothers


BOTH = [("linear", "backward"), ("linear", "marginal"), ("glider", "backward"), ("joint", "marginal")]
FEW = [pytest.param(*pair, marks=() if pair == BOTH[0] else pytest.mark.ci) for pair in BOTH]
OTHERS = [
    pytest.param(name, smoother, marks=pytest.mark.slow)
    for name in ("linear", "glider", "joint") for smoother in SMOOTHERS if (name, smoother) not in BOTH
]  # fmt: skip


@pytest.mark.parametrize(("name", "smoother"), [*FEW, *OTHERS])
def test_smoothed_means_and_sds_are_exact(name, smoother):
    """200 runs of 200 particles; rows missing, epochs without any, targets of unequal length, two recursions.

    A mean may lack 3 % of its sd, a variance 6 %, beside 5 standard errors (some 3 % and 5 %): false alarms below
    1e-4; sees a mean that is off by a tenth of its sd.
    """
    w = world(name)
    how = Particles(200, smoother=smoother)
    with jax.enable_x64(True):
        found = smoothings(w.model, w.targets, w.z, w.levels, w.mean, jax.random.key(2), how, 200)
    for (mean, square), exact, sd in zip(found, w.mean, w.sd, strict=True):
        assert near(mean, exact, 0.03 * sd)
        assert near(square, sd**2, 0.06 * sd**2)
        assert (np.asarray(mean).std(0) < 0.5 * sd).all(), "the particles are enough to say something"


def test_each_particle_keeps_to_its_path():
    """Paths drawn backward: product of neighbours in time, as exact; 200 runs of 200, 5 errors and 4 % of its size."""
    w = world("linear")

    def product(key):
        (states,) = ensemble(w.model, w.targets, w.z, w.levels, key, Particles(200)).states
        away = states - jnp.asarray(w.mean[0])[:, None]
        return jnp.mean(away[:-1] * away[1:], 1)

    with jax.enable_x64(True):
        run = jax.jit(lambda key: jax.lax.map(product, jax.random.split(key, 200), batch_size=10))
        found = run(jax.random.key(3))
    index, sd = w.index[0], w.sd[0]
    exact = w.covariance[index[:-1], index[1:]]
    assert (np.abs(exact) > 0.1 * sd[:-1] * sd[1:]).sum() > 8
    assert near(found, exact, 0.04 * sd[:-1] * sd[1:])


# densities


@pytest.mark.parametrize("name", ["linear", "wild", "joint"])
def test_densities_of_all_pairs_are_those_of_each(name):
    """Linear with an unknown level, heavy tails, and a motion without linear form: 3 states before, 4 after."""
    model_of = world(name) if name != "wild" else None
    with jax.enable_x64(True):
        targets = model_of.targets[0] if model_of else targets_of(wild().model)[0]
        model, levels = targets.model, np.full(targets.model.level_spread.shape, 0.4)
        one = jax.jit(lambda x, after, epoch, i, j: model.log_step(pick(x, i), pick(after, j), epoch, levels))
        pick = partial(lambda x, i: jax.tree.map(lambda leaf: leaf[i], x))
        both = jax.jit(lambda x, after, epoch: model.log_steps(x, after, epoch, levels))

        @jax.jit
        def drawn(key):
            def go(x, pair):
                epoch, k = pair
                after = jax.vmap(lambda k, x: model.step(k, x, epoch, levels))(jax.random.split(k, 4), x)
                return after, after

            start = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (4, *leaf.shape)), model.initial())
            epochs = jax.tree.map(lambda leaf: leaf[0], targets.epochs)
            return jax.lax.scan(go, start, (epochs, jax.random.split(key, len(epochs.time))))[1]

        states = jax.tree.map(np.asarray, drawn(jax.random.key(0)))
        for k in (1, 3):
            epoch = jax.tree.map(lambda leaf, k=k: np.asarray(leaf)[0, k], targets.epochs)
            before = jax.tree.map(lambda leaf, k=k: leaf[k - 1, :3], states)
            after = jax.tree.map(lambda leaf, k=k: leaf[k], states)
            found = np.asarray(both(before, after, epoch))
            assert found.shape == (3, 4)
            expected = [[float(one(before, after, epoch, i, j)) for j in range(4)] for i in range(3)]
            np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
            assert np.ptp(found) > 1.0


def test_a_motion_without_noise_in_some_direction_has_no_pairs():
    problem = Problem(PLANE, Target(ConstantVelocity(0.8, singular=True), START), wild().measurements.table.frame)
    with jax.enable_x64(True):
        (targets,) = targets_of(problem.model)
        x = targets.model.initial()
        stacked = jax.tree.map(lambda leaf: np.zeros((2, *leaf.shape)), x)
        epoch = jax.tree.map(lambda leaf: np.asarray(leaf)[0, 1], targets.epochs)
        with pytest.raises(InputError, match="the motion has no density"):
            targets.model.log_steps(stacked, stacked, epoch, np.zeros(0))


# sums


def steps_of(before, after, epoch):
    """What is summed over the epochs: the position, its step, and the product of neighbours."""
    (old,), (new,) = before, after
    later = jnp.where(epoch.first, 0.0, 1.0)
    return {"place": new[0, 0], "product": later * new[0, 0] * old[0, 0], "step": later * (new[0] - old[0])}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("smoother", "draws"),
    [
        ("backward", 2),
        pytest.param("backward", 1, marks=pytest.mark.slow),
        pytest.param("exact", 2, marks=pytest.mark.slow),
    ],
)
def test_a_sum_smoothed_on_the_way_is_exact(smoother, draws):
    """400 runs of 200 particles, targets of 5 and 4 epochs: 5 errors and 4 % of the sd of the sum; false alarms 1e-5.

    The evidence comes along: 5 standard errors of its ratio.
    """
    w = world("linear")
    (targets,) = w.targets
    how = Particles(200, smoother=smoother)

    def one(key):
        keys = jax.random.split(key, 2)
        return jax.vmap(
            lambda e, there, k: smoothed_sum(targets.model, e, there, w.z, w.levels, k, how, steps_of, draws)
        )(targets.epochs, targets.there, keys)

    with jax.enable_x64(True):
        run = jax.jit(lambda key: jax.lax.map(one, jax.random.split(key, 400), batch_size=20))
        found, evidence = jax.tree.map(np.asarray, run(jax.random.key(4)))
    assert near(np.exp(evidence.sum(1) - w.exact), 1.0)
    owner = np.asarray(w.problem.epochs[0].target)
    for k, name in enumerate(TIMES):
        index = w.index[0][owner == name]
        place, C = w.whole[index], w.covariance
        x = index[:, 0]
        assert near(found["place"][:, k], place[:, 0].sum(), 0.04 * np.sqrt(C[np.ix_(x, x)].sum()))
        product = (place[1:, 0] * place[:-1, 0] + C[x[1:], x[:-1]]).sum()
        spread = np.sqrt((place[:, 0] ** 2 * np.diag(C)[x]).sum() * 4)
        assert near(found["product"][:, k], product, 0.04 * spread)
        sd = np.sqrt(np.diag(C)[index[0]] + np.diag(C)[index[-1]])
        assert near(found["step"][:, k], place[-1] - place[0], 0.04 * sd)


# conditional filters


@pytest.mark.slow
@pytest.mark.parametrize(("name", "proposal"), [("linear", "extended"), ("linear", "bootstrap")])
def test_a_kernel_leaves_exact_paths_exact(name, proposal):
    """20,000 paths of the exact posterior, four steps of 4 particles each: means, variances, products of neighbours.

    All 100 lie within 5 standard errors: false alarms 6e-5; sees 4 % of an sd, 5 % of a variance. A fifth of the paths
    begins anew at every step, where a filter that keeps the ancestors of its path renews a thirtieth.
    """
    w, runs = world(name, 1.8), 20_000  # so restless that ancestors are many
    (targets,) = w.targets
    draws = np.random.default_rng(1).multivariate_normal(w.whole, w.covariance, runs)[:, w.index[0]]
    how, E = Particles(4, proposal=proposal), len(w.index[0])

    def one(states, key):
        paths = along_targets(targets.place, states)[:, :, None]

        def sweep(paths, key):
            keys = jax.random.split(key, len(targets.there))
            (after,), new = jax.vmap(
                lambda e, there, path, k: conditional_paths(targets.model, e, there, (path,), w.z, w.levels, k, how, 3)
            )(targets.epochs, targets.there, paths, keys)
            return after[:, :, 1], new[:, :, 1]

        paths, new = jax.lax.scan(sweep, paths, jax.random.split(key, 4))
        return place_by_epoch(targets.place, paths[:, :, 0], E), place_by_epoch(targets.place, new[0], E)

    with jax.enable_x64(True):
        run = jax.jit(lambda states, key: jax.lax.map(
            lambda pair: one(*pair), (states, jax.random.split(key, runs)), batch_size=500
        ))  # fmt: skip
        after, new = (np.asarray(leaf) for leaf in run(draws, jax.random.key(5)))
    mean, sd, index = w.mean[0], w.sd[0], w.index[0]
    away = (after - mean) / sd
    correlation = w.covariance[index[:-1], index[1:]] / sd[:-1] / sd[1:]
    assert near(away, 0.0)
    assert near(away**2, 1.0)
    assert near(away[:, 1:] * away[:, :-1], correlation)
    share = new.mean(0)
    assert (share[[0, 5]] > 0.2).all()
    assert (share < 1.0).all()
    moved = (np.abs(after - draws) > 0).any(2).mean(0)
    assert (moved >= share - 0.02).all(), "what is said to be new has moved"


@partial(jax.jit, static_argnames=("how", "runs"))
def renewed(targets, key, how, runs):
    """Residuals and steps of paths from the prior, whose data are drawn along, and after three steps of the kernel."""
    model, levels, z = targets.model, jnp.zeros(0), jnp.zeros(targets.model.biases)
    epochs, there = jax.tree.map(lambda leaf: leaf[0], (targets.epochs, targets.there))

    def one(key):
        keys = jax.random.split(key, 3)

        def go(x, pair):
            epoch, k = pair
            after = model.step(k, x, epoch, levels)
            return after, (after, model.predict_at(epoch, after, z))

        _, (path, predicted) = jax.lax.scan(go, model.initial(), (epochs, jax.random.split(keys[0], len(there))))
        rows = tuple(
            seen._replace(y=p + seen.std * jax.random.normal(jax.random.fold_in(keys[1], b), p.shape))
            for b, (seen, p) in enumerate(zip(epochs.rows, predicted, strict=True))
        )
        seen = epochs._replace(rows=rows)

        def told(path):
            by_row = jax.vmap(lambda epoch, x: model.predict_at(epoch, x, z))(seen, path)
            left = [((own.y - p) / own.std * own.mask).reshape(-1) for own, p in zip(seen.rows, by_row, strict=True)]
            return jnp.concatenate(left), jnp.tanh(path[0][:, 0]), jnp.tanh(jnp.diff(path[0][:, 0], axis=0))

        def sweep(path, key):
            return conditional_path(model, seen, there, path, z, levels, key, how)[0], None

        after, _ = jax.lax.scan(sweep, path, jax.random.split(keys[2], 3))
        return told(path), told(after)

    return jax.lax.map(one, jax.random.split(key, runs), batch_size=500)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("made", "proposal"),
    [(restless, "auto"), (ranging, "laplace"), pytest.param(ranging, "auto", marks=pytest.mark.slow)],
)
def test_a_kernel_leaves_paths_from_the_prior_to_the_prior(made, proposal):
    """8,000 paths and data drawn together, then three steps of 5 particles given the data (Geweke 2004).

    What data leave stays a unit normal, and bounded functions of states and steps keep their means: within 5 standard
    errors of the differences, false alarms 4e-5; sees 3 % of an sd.
    """
    with jax.enable_x64(True):
        (targets,) = targets_of(made().model)
        before, after = renewed(targets, jax.random.key(6), Particles(5, proposal=proposal), 8000)
    (left, place, step), (other, there, moved) = jax.tree.map(np.asarray, (before, after))
    assert near(other - left, 0.0)
    assert near(other**2 - left**2, 0.0)
    assert near(there - place, 0.0)
    assert near(moved - step, 0.0)
    assert near(moved**2 - step**2, 0.0)
    assert ((there != place).any((1, 2))).mean() > 0.8


# biases and levels


@partial(jax.jit, static_argnames=("how", "runs"))
def expectations(model, targets, z, levels, key, how, runs):
    """Score and marginal information of the biases, and the slope by the levels, of every run."""

    def one(key):
        found = ensemble(model, targets, z, levels, key, how)
        own = over_paths(model, found, z, levels, observed=True)

        def value(levels):
            return log_likelihood_over(model, found, z, levels) + log_motion_over(targets, found, levels)

        return own.score, own.information - own.spread, jax.grad(value)(levels)

    return jax.lax.map(one, jax.random.split(key, runs), batch_size=10)


@pytest.mark.ci
@pytest.mark.parametrize("name", ["linear", "glider"])
def test_score_information_and_slope_are_those_of_the_marginal_likelihood(name):
    """Fisher's and Louis' identities: 100 runs of 300 particles against the dense evidence, which is quadratic in z.

    Five standard errors and 2 % of the root of the information: false alarms 1e-5; sees a tenth of it.
    """
    w, M = world(name), len(world(name).z)
    unit = np.eye(M)

    def at(dz, dl=0.0):
        return w.evidence(w.z + dz, LEVEL + dl)

    score = np.array([at(e) - at(-e) for e in unit]) / 2
    information = -np.array([[at(a + b) - at(a - b) - at(b - a) + at(-a - b) for a in unit] for b in unit]) / 4
    slope = (at(0.0 * unit[0], 1e-4) - at(0.0 * unit[0], -1e-4)) / 2e-4
    with jax.enable_x64(True):
        found = expectations(w.model, w.targets, w.z, w.levels, jax.random.key(7), Particles(300), 100)
    root = np.sqrt(np.diag(information))
    assert near(found[0], score, 0.02 * root)
    assert near(found[1], information, 0.04 * np.outer(root, root))
    assert near(found[2], slope, 0.05)
    assert np.asarray(found[2]).std() > 0


@pytest.mark.ci
def test_levels_stay_at_the_top_of_the_evidence_and_climb_to_it():
    """300 Newton steps of 200 particles each from the exact mode and from both sides, targets of 5 and 4 epochs.

    At the mode their mean is zero within 5 standard errors and 0.01: false alarms below 1e-6. A step is that of EM,
    some hundredths long: from 0.7 above and below they go back on average, by more than 5 standard errors.
    """
    w = world("linear")
    spread = float(np.asarray(w.model.level_spread)[0])
    grid = np.linspace(-2.5, 1.5, 41)
    top = np.polynomial.Polynomial.fit(
        grid, [w.evidence(w.z, level) - 0.5 * (level / spread) ** 2 for level in grid], 12
    )
    fine = np.linspace(-2.0, 1.0, 3001)
    best = fine[np.argmax(top(fine))]

    def step(levels, key):
        found = ensemble(w.model, w.targets, w.z, levels, key, Particles(200))
        return moved_levels(w.model, w.targets, found, w.z, levels) - levels

    with jax.enable_x64(True):
        run = jax.jit(lambda levels, keys: jax.lax.map(lambda k: step(levels, k), keys, batch_size=10))
        moved = {
            away: np.asarray(run(np.array([best + away]), jax.random.split(jax.random.key(8), 300)))
            for away in (0.0, 0.7, -0.7)
        }
    assert near(moved[0.0], 0.0, 0.01)
    for away in (0.7, -0.7):
        steps = moved[away][:, 0] * -np.sign(away)
        assert steps.mean() > 5 * steps.std(ddof=1) / np.sqrt(300) > 0


# particles that are lost


def checked(problem, how, seed=0):
    """Smoothed particles, asked to be finite."""
    with jax.enable_x64(True):
        targets = targets_of(problem.model)
        z, levels = np.zeros(problem.model.biases), np.zeros(len(problem.levels))
        found = ensemble(problem.model, targets, z, levels, jax.random.key(seed), how)
        seen = state_moments(problem.model, found)
        nearest = nearest_states(problem.model, found)
    for leaf in jax.tree.leaves((found, seen, nearest)):
        assert np.isfinite(np.asarray(leaf)).all()
    for weights in found.weights:
        np.testing.assert_allclose(np.asarray(weights).sum(1), 1.0, rtol=1e-9)
    return jax.tree.map(np.asarray, found)


RUINED = [
    ("bootstrap", "backward"), ("extended", "marginal"), *(
        pytest.param(*pair, marks=pytest.mark.ci)
        for pair in (("bootstrap", "marginal"), ("extended", "exact"), ("laplace", "backward"))
    ),
]  # fmt: skip


@pytest.mark.parametrize(("proposal", "smoother"), RUINED)
def test_a_value_that_nothing_explains_leaves_what_is_finite(proposal, smoother):
    """A position of 1e6 m, another of 1e9 m that by no draw can be, in the midst of a track."""
    table = wild().measurements.table.frame.copy()
    for time, value in ((1.5, 1e6), (2.0, 1e9)):
        table.loc[(table["time"] == time) & (table["sensor"] == "a"), "position_x"] = value
    found = checked(Problem(PLANE, Target(CV, START), table), Particles(50, proposal=proposal, smoother=smoother))
    np.testing.assert_array_equal(found.lost[0][[0, 1, 3]], [False, False, True])


@pytest.mark.parametrize(("proposal", "smoother"), RUINED)
def test_a_sensor_that_has_no_value_for_some_states_leaves_those_out(proposal, smoother):
    """A root of what may be negative: nan for some particles at one place of the sensor, for all at another."""
    for place, everywhere in ((1.0, False), (1e3, True)):
        network = Network([broken.on(Node("a", (place, 0.0))), fix.on(Node("b", (5.0, -2.0)))])
        rows = []
        for time in (0.0, 1.0, 2.0):
            rows.append({"time": time, "sensor": "b", "target": "one", "position_x": -4.0, "position_y": 1.0})
            if time == 1.0:
                rows.append({"time": time, "sensor": "a", "target": "one", "root": 1.0})
        problem = Problem(network, Target(CV, START), pd.DataFrame(rows))
        found = checked(problem, Particles(50, proposal=proposal, smoother=smoother))
        np.testing.assert_array_equal(found.lost[0], [False, everywhere, False])
        if not everywhere and smoother != "marginal":
            assert (found.states[0][1, :, 0] > place).all()


# resampling


@jax.jit
def counted(log_weights, key):
    """How often each of the particles is chosen, both ways, 4 weights under vmap."""

    def one(logits, key):
        keys = jax.random.split(key)
        n = len(logits)
        chosen, zeros, held = resampling.systematic(keys[0], logits, {"own": jnp.arange(n)}, n)
        other = resampling.multinomial(keys[1], logits, n)
        return [jnp.bincount(k, length=n) for k in (chosen, other, held["own"])], zeros

    return jax.vmap(one, (0, None))(log_weights, key)


def test_particles_are_chosen_by_their_weights():
    """4,000 choices of 8: means within 5 errors of expectation; systematic counts are its floor or ceiling."""
    weights = np.array([
        [0.3, 0.0, 0.1, 0.05, 0.0, 0.25, 0.3, 0.0], [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [0.125] * 8, [1e-300, 0.2, 0.8, 0.0, 0.0, 0.0, 0.0, 0.0],
    ])  # fmt: skip
    with jax.enable_x64(True), np.errstate(divide="ignore"):
        logits = np.log(weights) + np.array([[0.0], [-1e6], [700.0], [3.0]])  # whose scale says nothing
        once = partial(counted, logits)
        run = jax.jit(lambda key: jax.lax.map(once, jax.random.split(key, 4000), batch_size=500))
        (drawn, other, held), zeros = jax.tree.map(np.asarray, run(jax.random.key(9)))
    np.testing.assert_array_equal(drawn, held)
    assert (zeros == 0).all()
    expected = 8 * weights / weights.sum(1, keepdims=True)
    assert (np.abs(drawn - expected) < 1 + 1e-9).all()
    for counts in (drawn, other):
        assert (counts.sum(2) == 8).all()
        assert (counts[:, weights == 0] == 0).all()
        assert near(counts, expected, 1e-9)
    variance = 8 * (expected / 8) * (1 - expected / 8)
    assert near((other - expected) ** 2, variance, 1e-9), "independent draws"


def test_places_fall_on_particles_with_weight():
    """The ends of [0, 1): a first or last particle of weight zero is not chosen."""
    with jax.enable_x64(True):
        logits = np.array([-np.inf, 0.0, -1e12, np.log(3.0), -np.inf, -np.inf])
        places = np.array([0.0, 0.2499, 0.2501, 0.9999, np.nextafter(1.0, 0.0)])
        np.testing.assert_array_equal(jax.jit(resampling.chosen_at)(logits, places), [1, 1, 3, 3, 3])
        many = np.log(np.r_[np.random.default_rng(0).uniform(size=999), 1e-320])
        many[-1] = -np.inf
        assert (np.asarray(jax.jit(resampling.chosen_at)(many, places)) < 999).all()


# targets


@pytest.mark.slow
def test_targets_hold_every_row_once_and_find_back_to_their_epochs():
    """Two worlds, and one whose second target has a single epoch."""
    w = world("linear")
    table = table_of(False)
    few = Problem(PLANE, w.problem.motion, table[(table["target"] == "one") | (table["time"] == 0.2)])
    with jax.enable_x64(True):
        short = SimpleNamespace(problem=few, model=few.model, targets=targets_of(few.model))
    for w in (world("linear"), world("joint"), short):
        for r, targets in enumerate(w.targets):
            there, place = np.asarray(targets.there), np.asarray(targets.place)
            E = len(w.problem.epochs[r].time)
            assert sorted(place[there]) == list(range(E))
            assert (place[~there] == E).all()
            time = w.problem.epochs[r].time[place[there]]
            np.testing.assert_array_equal(np.asarray(targets.epochs.time)[there], time)
            assert (np.asarray(targets.epochs.first) == (np.arange(there.shape[1]) == 0)).all()
            own = [data for data, k in zip(w.model.rows, w.model.recursion, strict=True) if k == r]
            for seen, data in zip(targets.epochs.rows, own, strict=True):
                y, mask = np.asarray(data.y), np.asarray(data.mask)
                assert np.asarray(seen.mask).sum() == mask.sum()
                assert not np.asarray(seen.mask)[~there].any()
                assert (np.asarray(seen.y) * np.asarray(seen.mask)).sum() == pytest.approx((y * mask).sum())
            with jax.enable_x64(True):
                leaf = np.random.default_rng(0).normal(size=(E, 2))
                spread = along_targets(targets.place, jnp.asarray(leaf))
                np.testing.assert_array_equal(place_by_epoch(targets.place, spread, E), leaf)
                half = weigh_rows(targets, 0.5)
            for seen, other in zip(targets.epochs.rows, half.epochs.rows, strict=True):
                np.testing.assert_array_equal(np.asarray(other.mask), 0.5 * np.asarray(seen.mask))


# settings


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"count": 1}, r"Particles\(count=1\): take at least 2, some hundred as a rule"),
        ({"proposal": "extendd"}, r'Particles\(proposal="extendd"\): unknown proposal; did you mean "extended"'),
        ({"smoother": "forward"}, r'Particles\(smoother="forward"\): unknown smoother'),
        ({"m_step": "median"}, r'Particles\(m_step="median"\): unknown m_step'),
        ({"threshold": 1.5}, r"Particles\(threshold=1.5\): give a share of the particles, 0 to 1"),
        ({"threshold": -0.1}, r"threshold=-0.1\): give a share of the particles"),
        ({"threshold": np.nan}, r"threshold=nan\): give a share of the particles"),
        ({"tempered": -1}, r"Particles\(tempered=-1\): give a number of iterations, 0 for none"),
        ({"moves": 0}, r"Particles\(moves=0\): at least one step is needed"),
    ],
)
def test_settings_out_of_range_are_refused(wrong, said):
    with pytest.raises(InputError, match=said):
        Particles(**wrong)


def test_settings_at_the_ends_of_their_ranges_are_taken():
    assert Particles(2, threshold=0.0, tempered=0, moves=1) != Particles(2, threshold=1.0)
    assert len({Particles(), Particles(), Particles(7)}) == 2


def test_proposals_ask_of_motions_what_they_have():
    glider, tailed, linear = world("glider").model, wild().model, ranging().model
    for proposal in ("extended", "laplace"):
        how = Particles(proposal=proposal)
        said = rf'Particles\(proposal="{proposal}"\): Glider has no linear form.*; take proposal="bootstrap"'
        with pytest.raises(InputError, match=said):
            check_proposal(glider, how)
        with pytest.raises(InputError, match="heavy tails has no density by which a given state is weighed"):
            check_proposal(tailed, how, conditional=True)
        check_proposal(tailed, how)
        check_proposal(linear, how, conditional=True)
    for proposal in ("auto", "bootstrap"):
        for model in (glider, tailed, linear):
            check_proposal(model, Particles(proposal=proposal), conditional=True)


def test_smoothing_without_density_is_refused_but_for_the_genealogy():
    """A process noise that leaves out a direction: its ancestors are all that a smoother has."""
    problem = Problem(PLANE, Target(ConstantVelocity(0.8, singular=True), START), wild().measurements.table.frame)
    for smoother in ("backward", "exact", "marginal"):
        with pytest.raises(InputError, match="the motion has no density: its noise does not reach"):
            checked(problem, Particles(20, smoother=smoother))
    assert not checked(problem, Particles(20, smoother="genealogy")).lost[0].any()


def test_what_is_not_installed_is_asked_for(monkeypatch):
    settings.check_installed()
    monkeypatch.setattr(settings, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r'particles need cuthbert: pip install "probcal\[particles\]"'):
        settings.check_installed()
