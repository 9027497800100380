"""Motions by their protocol alone: a state that is a pytree, what composes with it, and what asks for a linear form.

`Glider` is constant velocity said again as a motion without linear form, so that the exact answers are known; `Road`
is one that has no other form. Written with public names only.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
import xarray as xr
from gliders import CV, PLANE, POWER, POWERED, START, TIMES, Glider, plan_of
from scipy import stats
from worlds import fix

import probcal
from probcal import (
    Channel,
    ConstantAcceleration,
    ConstantVelocity,
    CoordinatedTurn,
    InputError,
    Known,
    Motion,
    Network,
    Node,
    Problem,
    Static,
    Target,
    Unknown,
    White,
    sensor,
    simulate,
)
from probcal.model.model import At
from probcal.motion import Component


@dataclass(frozen=True)
class Tone(Motion):
    """The power of a target alone, a random walk said again; it composes with what has a position."""

    @property
    def levels(self):
        return {"tone_std": POWER.std}

    def view(self, state):
        return {"power": state["db"]}

    def initial(self, key):
        return {"db": POWER.initial[0] + POWER.initial[1] * jax.random.normal(key)}

    def sample(self, key, state, dt, levels):
        return {"db": state["db"] + levels["tone_std"] * jnp.sqrt(dt) * jax.random.normal(key)}

    def log_density(self, before, state, dt, levels):
        return jax.scipy.stats.norm.logpdf(state["db"], before["db"], levels["tone_std"] * jnp.sqrt(dt))

    def log_initial(self, state):
        return jax.scipy.stats.norm.logpdf(state["db"], *POWER.initial)


@dataclass(frozen=True, eq=False)
class Road(Motion):
    """A walk along a polyline (V, d), back and forth: the edge, the metres gone on it, the speed along it."""

    corners: Any
    std: float = 0.3

    @property
    def levels(self):
        return {"speed_std": self.std}

    def view(self, state):
        ends, starts = np.asarray(self.corners, float)[1:], np.asarray(self.corners, float)[:-1]
        along = jnp.asarray((ends - starts) / self.lengths[:, None])[state["edge"]]
        return {"position": jnp.asarray(starts)[state["edge"]] + state["gone"] * along}

    @property
    def lengths(self):
        return np.linalg.norm(np.diff(np.asarray(self.corners, float), axis=0), axis=1)

    def initial(self, key):
        return self.at(jax.random.uniform(key, (), float, 0.0, self.lengths.sum()), jnp.array(1.5))

    def sample(self, key, state, dt, levels):
        speed = state["speed"] + levels["speed_std"] * jnp.sqrt(dt) * jax.random.normal(key)
        whole = self.lengths.sum()
        to = jnp.asarray(np.cumsum([0.0, *self.lengths[:-1]]))[state["edge"]] + state["gone"] + dt * speed
        turned = jnp.mod(to, 2 * whole)
        return self.at(jnp.minimum(turned, 2 * whole - turned), jnp.where(turned > whole, -speed, speed))

    def at(self, metres, speed):
        ends = np.cumsum(self.lengths)
        edge = jnp.minimum(jnp.searchsorted(jnp.asarray(ends), metres), len(ends) - 1)
        return {"edge": edge, "gone": metres - jnp.asarray(ends - self.lengths)[edge], "speed": speed}


@sensor(position=Channel("m", std=1.0, per_axis=True))
def spot(target, pose):
    return {"position": target.position - pose.position}


PLANE_ROAD = ((0.0, 0.0), (30.0, 0.0), (30.0, 20.0), (50.0, 20.0))
SPACE_ROAD = ((0.0, 0.0, 0.0), (30.0, 0.0, 5.0), (30.0, 20.0, 9.0))


@cache
def table_of(powered=False):
    """Rows of two asynchronous targets that move as `CV` does, from the motion itself."""
    network, motion = (POWERED, CV + POWER) if powered else (PLANE, CV)
    plan = plan_of(network, TIMES)
    motion = {name: Target(motion, START) for name in TIMES}
    return simulate(network, motion, [0.0], key=3, schedule=plan, biases={}).table


LINEAR = {name: Target(CV, START) for name in TIMES}
CASES = {  # motions without linear form, and the linear ones that they are
    "alone": (PLANE, {name: Glider() for name in TIMES}, LINEAR),
    "mixed": (PLANE, LINEAR | {"two": Glider()}, LINEAR),
    "composed": (
        POWERED,
        {"one": Glider() + POWER, "two": POWER + Glider()},
        {name: Target(CV + POWER, START) for name in TIMES},
    ),
    "started": (
        POWERED,
        {name: Target(CV + Tone(), START) for name in TIMES},
        {name: Target(CV + POWER, START) for name in TIMES},
    ),
}


def both(case):
    """The problem with its motions as declared, and with the linear ones in their place."""
    network, motion, linear = CASES[case]
    table = table_of(network is POWERED)
    return Problem(network, motion, table), Problem(network, linear, table)


def as_linear(x):
    """The vector of a state of `Glider`, alone or with a power in front, or of `CV` and a `Tone`."""
    if isinstance(x, tuple) and "db" in x[1]:
        return (jnp if isinstance(x[0], jax.Array) else np).concatenate([x[0], x[1]["db"][..., None]], -1)
    vector, glider = (None, x) if isinstance(x, dict) else x
    parts = [glider["place"], glider["pace"]] + ([] if vector is None else [vector])
    return (jnp if any(isinstance(part, jax.Array) for part in parts) else np).concatenate(parts, -1)


def as_declared(model, states):
    """States of the linear problem in the form of the declared one."""
    found = []
    for like, x in zip(jax.eval_shape(model.initial), states, strict=True):
        glider = {"place": x[..., :2], "pace": x[..., 2:4]}
        if isinstance(like, tuple):
            found.append((x[..., :4], {"db": x[..., 4]}) if "db" in like[1] else (x[..., 4:], glider))
        else:
            found.append(glider if isinstance(like, dict) else x)
    return tuple(found)


SOME = ["composed", *(pytest.param(case, marks=pytest.mark.ci) for case in CASES if case != "composed")]
OTHER = (CV, ConstantAcceleration(0.7), CoordinatedTurn(0.8, 0.3))


@pytest.mark.parametrize("case", SOME)
def test_a_pytree_predicts_and_weighs_what_its_linear_form_does(case):
    """Whole trajectories: equal to the last digit, alone, with a linear target beside it, and composed."""
    declared, linear = both(case)
    random = np.random.default_rng(1)
    with jax.enable_x64(True):
        tracks = {}
        for epochs, part in zip(linear.epochs, linear.model.recursions, strict=True):
            for name in dict.fromkeys(epochs.target):
                tracks[str(name)] = random.standard_normal(((epochs.target == name).sum(), part.drift.shape[1]))

        def at(problem):
            states = [np.concatenate([tracks[str(n)] for n in dict.fromkeys(e.target)]) for e in problem.epochs]
            z = np.linspace(-1.0, 1.0, problem.model.biases)
            return At(as_declared(problem.model, states), z, zeros(problem))

        def rows_of(problem, parts):
            """Values of the table's rows in their order, whatever the blocks."""
            found = np.zeros((len(problem.measurements.time), 2))
            for index, own in zip(problem.row_index, parts, strict=True):
                found[index, : own.shape[1]] += np.asarray(own)
            return found

        (mine, drawn), (exact, _) = (whole(p.model, at(p), jax.random.key(0)) for p in (declared, linear))
    for name, parts in mine.items():
        found, there = rows_of(declared, parts), rows_of(linear, exact[name])
        np.testing.assert_array_equal(found, there)
        assert np.abs(there).max() > 0.01
    assert 0.1 < np.abs(rows_of(declared, drawn) - rows_of(declared, mine["predict"])).max() < 30.0


@pytest.mark.parametrize("case", CASES)
def test_a_step_of_a_pytree_has_the_density_of_its_linear_form(case):
    """Epoch by epoch, from drawn states: densities of steps and of rows; the other targets stay as they are."""
    declared, linear = both(case)
    with jax.enable_x64(True):
        one, other = declared.model, linear.model
        epochs, theirs = one.epochs(), other.epochs()
        z, levels = np.linspace(-1.0, 1.0, one.biases), np.zeros(0)
        step, log_step, weigh = jax.jit(one.step), jax.jit(one.log_step), jax.jit(one.log_likelihood_at)
        exact_step, exact_weigh = jax.jit(other.log_step), jax.jit(other.log_likelihood_at)
        first = {name: k for e in declared.epochs for k, name in enumerate(dict.fromkeys(e.target))}
        where = {str(n): r for r, e in enumerate(declared.epochs) for n in dict.fromkeys(e.target)}

        def same(x):
            """The state of the linear problem."""
            held = jax.tree.map(np.asarray, x)
            parts = [as_linear(p) if form is None else p for form, p in zip(one.linear, held, strict=True)]
            found = []
            for e in linear.epochs:
                names = [str(n) for n in dict.fromkeys(e.target)]
                found.append(np.stack([parts[where[n]][first[n]] for n in names]))
            return tuple(found)

        x = one.initial()
        for k in range(len(epochs.time)):
            epoch, their = (jax.tree.map(lambda leaf, k=k: np.asarray(leaf)[k], e) for e in (epochs, theirs))
            after = step(jax.random.key(k), x, epoch, levels)
            assert float(log_step(x, after, epoch, levels)) == pytest.approx(
                float(exact_step(same(x), same(after), their, levels)), rel=1e-9
            )
            mine, exact = weigh(epoch, after, z, levels), exact_weigh(their, same(after), z, levels)
            assert sum(np.sum(p) for p in mine) == pytest.approx(sum(np.sum(p) for p in exact))
            moved = sum(int((a != b).any(1).sum()) for a, b in zip(same(after), same(x), strict=True))
            assert moved == 1, "one target moves at an epoch"
            x = after


@pytest.mark.ci
def test_steps_of_a_pytree_have_the_moments_of_its_linear_form():
    """4000 draws of a first epoch and of a later one; false alarms below 1e-5 by normal limits."""
    declared, linear = both("alone")
    with jax.enable_x64(True):
        epochs, theirs = declared.model.epochs(), linear.model.epochs()
        x = {"place": np.ones((2, 2)), "pace": np.ones((2, 2))}
        steps = jax.jit(jax.vmap(declared.model.step, (0, None, None, None)))
        keys = jax.random.split(jax.random.key(1), 4000)
        for k in (0, 4):
            epoch = jax.tree.map(lambda leaf, k=k: np.asarray(leaf)[k], epochs)
            draws = steps(keys, (x,), epoch, zeros(declared))
            own = as_linear(jax.tree.map(np.asarray, draws[0]))[:, int(epoch.target[0])]
            move = jax.tree.map(lambda leaf, k=k: np.asarray(leaf[k]), theirs.move[0])
            mean, covariance = move.F @ np.ones(4) + move.drift, move.L @ move.L.T
            sd = np.sqrt(np.diag(covariance))
            assert (np.abs(own.mean(0) - mean) < 5.5 * sd / np.sqrt(4000)).all()
            assert (np.abs(np.cov(own.T) - covariance) < 5.5 * np.sqrt(2 / 4000) * np.outer(sd, sd)).all()


@jax.jit
def whole(model, at, key):
    """What a model says of whole trajectories, and data drawn from it."""
    names = ("predict", "log_likelihood", "innovation", "information")
    return {name: getattr(model, name)(at) for name in names}, model.sample(at, key)


def zeros(problem):
    return np.zeros(len(problem.levels))


def systematic(key, log_weights, particles, n):
    places = (jax.random.uniform(key) + jnp.arange(n)) / n
    chosen = jnp.searchsorted(jnp.cumsum(jax.nn.softmax(log_weights)), places).clip(0, n - 1)
    return chosen.astype(int), jnp.zeros(n), jax.tree.map(lambda leaf: leaf[chosen], particles)


def particles_of(model, levels, number, runs):
    """Log evidence (runs,) and last mean states of cuthbert's particle filter at zero biases."""
    cuthbert = pytest.importorskip("cuthbert", reason="cuthbert is not installed: uv sync --group test")
    from cuthbert.smc import particle_filter

    z, epochs = jnp.zeros(model.biases), model.epochs()
    filter_ = particle_filter.build_filter(
        init_sample=lambda key: model.initial(),
        propagate_sample=lambda key, x, epoch: model.step(key, x, epoch, levels),
        log_potential=lambda before, x, epoch: sum(p.sum() for p in model.log_likelihood_at(epoch, x, z, levels)),
        n_filter_particles=number,
        resampling_fn=systematic,
    )

    @jax.jit
    def run(key):
        keys = jax.random.split(key)
        states = cuthbert.filter(filter_, epochs, filter_.init_prepare(key=keys[0]), key=keys[1])
        weights = jax.nn.softmax(states.log_weights[-1])
        means = jax.tree.map(lambda leaf: jnp.tensordot(weights, leaf[-1].astype(float), 1), states.particles)
        return states.log_normalizing_constant[-1], means

    return jax.lax.map(run, jax.random.split(jax.random.key(0), runs))


@pytest.mark.ci
@pytest.mark.parametrize("case", CASES)
def test_the_particle_filter_of_cuthbert_finds_the_exact_evidence_of_a_pytree(case):
    """4000 particles, 30 runs, against the dense joint Gaussian of the linear form.

    The mean of the evidence ratio, which is unbiased, lies within 5 standard errors of 1, the last means within 5 of
    theirs and 2 % of an sd: false alarms below 1e-4.
    """
    network, _, linear = CASES[case]
    declared, _ = both(case)
    naive = reference.Linear(network, linear, table_of(network is POWERED), {})
    held = reference.dense(naive, None, hold=np.zeros(len(naive.labels)))
    with jax.enable_x64(True):
        found, means = particles_of(declared.model, jnp.zeros(0), 4000, 30)
        means = [as_linear(x) if f is None else x for f, x in zip(declared.model.linear, means, strict=True)]
    ratio = np.exp(np.asarray(found) - held.evidence)
    assert abs(ratio.mean() - 1) < 5 * ratio.std(ddof=1) / np.sqrt(len(ratio))
    assert ratio.std() < 1, "the particles are enough for the comparison to mean something"
    starts = np.cumsum([0, *(len(chain.names) * len(chain.times) for chain in naive.chains)])
    for chain, end in zip(naive.chains, starts[1:], strict=True):
        exact, sd = (part[end - len(chain.names) : end] for part in held.states)
        r, k = next(
            (r, list(dict.fromkeys(e.target)).index(chain.target))
            for r, e in enumerate(declared.epochs)
            if chain.target in e.target
        )
        mine = np.asarray(means[r])[:, k]
        spread = mine.std(0, ddof=1) / np.sqrt(len(ratio))
        assert (np.abs(mine.mean(0) - exact) < 5 * spread + 0.02 * sd).all()


@pytest.mark.parametrize(("corners", "d"), [pytest.param(PLANE_ROAD, 2, marks=pytest.mark.ci), (SPACE_ROAD, 3)])
def test_targets_on_a_road_are_simulated_on_it(corners, d):
    """Two targets at asynchronous times: every true position lies on an edge, they move, data scatter about them."""
    nodes = [Node(name, (10.0 * k,) * d) for k, name in enumerate("ab")]
    network = Network([fix.on(node, name=f"fix_{node.name}") for node in nodes])
    run = simulate(network, {name: Road(corners) for name in TIMES}, [0.0], key=4, schedule=plan_of(network, TIMES))
    columns = [f"position_{axis}" for axis in "xyz"[:d]]
    corners = np.array(corners)
    for name, when in TIMES.items():
        track = run.truth.tracks[run.truth.tracks["target"] == name]
        places = track[columns].to_numpy(float)
        np.testing.assert_array_equal(track["time"], when)
        line = np.diff(corners, axis=0)
        t = np.clip(np.einsum("ed,ned->ne", line, places[:, None] - corners[:-1]) / (line**2).sum(1), 0, 1)
        away = np.linalg.norm(places[:, None] - corners[:-1] - t[..., None] * line, axis=2).min(1)
        np.testing.assert_allclose(away, 0, atol=1e-9)
        assert np.linalg.norm(np.diff(places, axis=0), axis=1).min() > 0.05
        seen = run.table[run.table["target"] == name][columns].to_numpy(float).reshape(len(when), 2, d)
        assert np.abs(seen.mean(1) - places).max() < 6.0 * fix.channels["position"].std
    same, other = (simulate(network, {n: Road(corners) for n in TIMES}, [0.0], key=k,
                            schedule=plan_of(network, TIMES)) for k in (4, 5))  # fmt: skip
    assert run.table.equals(same.table)
    assert not run.table.equals(other.table)


@pytest.mark.ci
def test_particles_follow_a_road_through_rows_that_came_later(kept_kernels):
    """A road declared again is equal, and its epochs, of the first rows and of later ones, take one kernel."""
    network = Network([spot.on(Node("a", (0.0, 0.0)))])
    time = np.arange(12.0)
    run = simulate(network, Road(PLANE_ROAD), time, key=2)
    early = run.table["time"] < 8.0
    problems = [Problem(network, Road(PLANE_ROAD), run.table[early]) for _ in range(2)]
    assert problems[0].model.sampled == problems[1].model.sampled
    assert problems[0].model.sampled != Problem(network, Road(PLANE_ROAD[:3]), run.table[early]).model.sampled
    first = problems[1]

    @jax.jit
    def go(model, epochs, x, key):
        def one(carry, epoch):
            x, key = carry
            keys = jax.random.split(key, 3)
            x = jax.vmap(model.step, (0, 0, None, None))(jax.random.split(keys[0], 500), x, epoch, jnp.zeros(0))
            rows = jax.vmap(model.log_likelihood_at, (None, 0, None, None))(
                epoch, x, jnp.zeros(model.biases), jnp.zeros(0)
            )
            _, _, x = systematic(keys[1], sum(p.sum((1, 2)) for p in rows), x, 500)
            return (x, keys[2]), jax.tree.map(lambda leaf: leaf.astype(float).mean(0), x)

        return jax.lax.scan(one, (x, key), epochs)

    with jax.enable_x64(True):
        resting = jax.jit(first.model.initial)()
        x = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (500, *leaf.shape)), resting)
        (x, key), _ = go(problems[0].model, problems[0].model.epochs(), x, jax.random.key(0))
        later = first.later(run.table[~early])
        for k in range(len(later.time)):
            one = jax.tree.map(lambda leaf, k=k: np.asarray(leaf)[k : k + 1], later)
            (x, key), _ = go(first.model, one, x, key)
        found = jax.jit(jax.vmap(lambda own: Road(PLANE_ROAD).view(own)["position"]))(
            jax.tree.map(lambda leaf: np.asarray(leaf)[:, 0], x[0])
        )
    assert go._cache_size() == 2, "one kernel for the eight first epochs, one for those that come alone"
    true = run.truth.tracks[["position_x", "position_y"]].to_numpy(float)[-1]
    # the last row alone has an sd of 1 m along the road: 4 of them in fewer than 1e-4 of seeds
    assert np.linalg.norm(np.asarray(found).mean(0) - true) < 4.0


def test_an_unknown_level_of_a_motion_is_a_level_of_the_problem():
    """Its guess times its factor is what the motion is given: the density of a step as with the linear form."""
    level = Unknown(0.8)
    motions = {name: Glider(level) for name in TIMES}, {n: Target(ConstantVelocity(level), START) for n in TIMES}
    problems = [Problem(PLANE, motion, table_of()) for motion in motions]
    assert [[level.label for level in p.levels] for p in problems] == [["motion.velocity_std"]] * 2
    with jax.enable_x64(True):
        levels = np.array([0.7])
        epochs = [p.model.epochs() for p in problems]
        epoch, their = (jax.tree.map(lambda leaf: np.asarray(leaf)[3], e) for e in epochs)
        assert not bool(epoch.first)
        x = ({"place": np.array([[0.0, 1.0], [2.0, 3.0]]), "pace": np.array([[1.0, 2.0], [-1.0, 0.5]])},)
        after = jax.jit(problems[0].model.step)(jax.random.key(0), x, epoch, levels)
        after = jax.tree.map(np.asarray, after)
        found = jax.jit(problems[0].model.log_step)(x, after, epoch, levels)
        exact = jax.jit(problems[1].model.log_step)((as_linear(x[0]),), (as_linear(after[0]),), their, levels)
    assert float(found) == pytest.approx(float(exact), rel=1e-9)


def calibrated(problem):
    """What `track` reads of a fit."""
    labels, M = list(problem.labels), len(problem.labels)
    values = {"mean": ("bias_label", np.zeros(M)), "covariance": (("bias_label", "bias_label_other"), np.eye(M))}
    group = xr.Dataset(values, {"bias_label": labels, "bias_label_other": labels})
    return xr.DataTree.from_dict({"calibration": group, "constant_data": xr.Dataset()})


OF_WINGS = {"study": ("studies",), "sbc": ("studies",)}
GAUSSIAN = {
    "fit": lambda p: probcal.fit(p, probcal.EA()),
    "fit by a sampler": lambda p: probcal.fit(p, probcal.NUTS()),
    "fit by Collapsed": lambda p: probcal.fit(p, probcal.Collapsed()),
    "fit by SVI": lambda p: probcal.fit(p, probcal.SVI()),
    "log_evidence": lambda p: probcal.log_evidence(p),
    "track": lambda p: probcal.track(p, calibrated(p)),
    "study": lambda p: probcal.study(lambda run, size: (p, probcal.Truth()), {"size": [1]}, ("ea",), runs=1),
    "sbc": lambda p: probcal.sbc(p, probcal.EA(), runs=4),
    "numpyro_model": lambda p: probcal.numpyro_model(p),
    "observability": lambda p: probcal.observability(p),
    "bounds": lambda p: probcal.bounds(p),
    "next_passes": lambda p: probcal.next_passes(p),
    "next_anchors": lambda p: probcal.next_anchors(p),
    "next_sensors": lambda p: probcal.next_sensors(p),
    "sensitivity": lambda p: probcal.sensitivity(p, {"*": [1.0]}),
    "bound_map": lambda p: probcal.bound_map(p, [(0.0, 9.0), (0.0, 9.0)], target="two"),
    "unlinked": lambda p: p.unlinked(),
}


@pytest.mark.parametrize(
    "ask",
    [pytest.param(ask, id=name, marks=pytest.mark.needs(*OF_WINGS.get(name, ()))) for name, ask in GAUSSIAN.items()],
)
def test_what_needs_a_linear_form_says_so(ask):
    problem = Problem(PLANE, LINEAR | {"two": Glider()}, table_of())
    assert [form is None for form in problem.model.linear] == [False, True]
    text = r'target "two" moves by Glider, which has no linear form, as Gaussian methods need it; take motions such as'
    with pytest.raises(InputError, match=text):
        ask(problem)


@pytest.mark.parametrize("motion", [CV + POWER, *(pytest.param(m, marks=pytest.mark.ci) for m in OTHER)], ids=str)
@pytest.mark.parametrize("d", [2, 3])
def test_a_linear_motion_does_by_the_protocol_what_its_matrices_say(motion, d):
    """Traced time steps; the density of a drawn step against scipy, and the view against the layout."""
    start = {"position": (1.0, 2.0), "velocity": (0.5, 1.0), "acceleration": (0.0, 0.3)}
    motion = motion if isinstance(motion, Motion) else probcal.motion.as_motion(motion)
    with jax.enable_x64(True):
        form = motion.linear(np.array([1.3]), d)

        @jax.jit
        def drawn(key, dt, level):
            levels, keys = {"velocity_std": level}, jax.random.split(key)
            x = motion.initial(keys[0], d, start)
            after = motion.sample(keys[1], x, dt, levels)
            shown, density = motion.view(x), motion.log_density(x, after, dt, levels)
            return x, after, density, motion.log_initial(x, start), shown

        x, after, found, begin, shown = jax.tree.map(np.asarray, drawn(jax.random.key(0), 1.3, 1.1))
    std = [1.1 if name == "velocity_std" else motion.levels[name] for name in form.levels]
    L = np.asarray(form.L[0]) * std
    mean = np.asarray(form.F[0]) @ np.asarray(x)
    exact = stats.multivariate_normal(mean, L @ L.T).logpdf(np.asarray(after))
    assert float(found) == pytest.approx(exact, rel=1e-8)
    known = {"power": POWER.initial} | start
    begins = sum(stats.norm(*known[name]).logpdf(np.asarray(shown[name])).sum() for name in shown)
    assert float(begin) == pytest.approx(begins, rel=1e-9)
    np.testing.assert_array_equal(shown["position"], x[:d])
    assert np.shape(shown["velocity"]) == (d,)


def test_what_composes_with_a_pytree_keeps_the_protocol():
    """States side by side, draws, views and densities those of the parts; `+` takes them in any order."""
    first, second = POWER + Glider(), Glider() + POWER
    assert first == second
    levels = {"velocity_std": 0.8}

    @jax.jit
    def drawn(key):
        x = first.initial(key)
        y = first.sample(key, x, 0.5, levels)
        own = Glider().log_density(x[1], y[1], 0.5, levels), Glider().log_initial(x[1])
        return x, y, first.view(x), first.log_density(x, y, 0.5, levels), first.log_initial(x), own

    with jax.enable_x64(True):
        x, y, shown, density, begin, own = jax.tree.map(np.asarray, drawn(jax.random.key(0)))
    assert set(shown) == {"position", "velocity", "power"}
    power = stats.norm(x[0][0], 0.5 * np.sqrt(0.5)).logpdf(y[0][0])
    assert density == pytest.approx(own[0] + power)
    assert begin == pytest.approx(own[1] + stats.norm(*POWER.initial).logpdf(x[0][0]))
    assert isinstance(POWER + White("x", "m", 1.0), Motion)
    two = Glider() + Road(PLANE_ROAD)
    assert [set(part) for part in jax.eval_shape(two.initial, jax.random.key(0))] == [
        {"place", "pace"}, {"edge", "gone", "speed"},
    ]  # fmt: skip


class Wrong(Glider):
    """A glider with one method in another form."""

    def __init__(self, **changes):
        super().__init__()
        for name, change in changes.items():
            object.__setattr__(self, name, change)


def refuse(*_):
    raise ArithmeticError("no wind today")


def problem(motion):
    return Problem(PLANE, motion, table_of())


REFUSED = [
    (lambda: problem(Wrong(initial=refuse)), 'target "one": motion Wrong: initial failed on a trial call: no wind'),
    (lambda: problem(Wrong(sample=refuse)), "motion Wrong: the motion failed on a trial call: no wind today"),
    (lambda: problem(Wrong(sample=lambda key, state, dt, levels: state["place"])),
     "motion Wrong: sample returns a state of another form than initial"),
    (lambda: problem(Wrong(view=lambda state: {"position": jnp.zeros(3)})),
     r'motion Wrong: its view shows "position" of shape \(3,\), the network is 2-D; show a number or shape \(2,\)'),
    (lambda: problem(Wrong(view=lambda state: {"velocity": state["pace"]})), "the motion has no position; add"),
    (lambda: problem(Glider() + CV), 'motion: level "velocity_std" is declared twice'),
    (lambda: problem(Glider(name="own") + CV), 'motion: component "position" is declared twice'),
    (lambda: problem(Target(Glider(), START)), "Glider draws its own, write it in initial"),
    (lambda: Road(PLANE_ROAD).log_density(0, 0, 1.0, {}), "Road does not say its density; write its log_density"),
    (lambda: Road(PLANE_ROAD).log_initial(0), "Road does not say the density of its start; write its log_i"),
    (lambda: Road(PLANE_ROAD).linear(np.ones(1), 2), "Road has no linear form; one that has is composed of"),
    (lambda: (CV + POWER).initial(jax.random.key(0)), 'the motion states no start of "position"; give it, as in'),
    (lambda: (ConstantVelocity(1.0, singular=True) + POWER).log_density(np.zeros(5), np.zeros(5), 1.0, {}),
     "a density needs noise in every component of the state; take a motion"),
    (lambda: (ConstantVelocity(0.0) + POWER).log_density(np.zeros(5), np.zeros(5), 1.0, {}), "a density needs noise"),
    (lambda: (Known(([0.0, 1.0], [(0, 0), (1, 1)])) + POWER).sample(jax.random.key(0), jnp.zeros(5), 1.0, {}),
     "Known is known at the times of a table only; draw from problem.model"),
]  # fmt: skip


@pytest.mark.parametrize(("ask", "text"), REFUSED, ids=[text[:40] for _, text in REFUSED])
def test_a_motion_that_cannot_says_what_to_do(ask, text):
    with pytest.raises(InputError, match=text):
        ask()


def test_a_model_without_jacobians_or_densities_says_so():
    road = Problem(PLANE, Road(PLANE_ROAD), table_of())
    with jax.enable_x64(True):
        model, epoch = road.model, jax.tree.map(lambda leaf: np.asarray(leaf)[0], road.model.epochs())
        x, z, levels = jax.jit(model.initial)(), np.zeros(model.biases), np.zeros(0)
        with pytest.raises(InputError, match="Road has no linear form, so that nothing is linearised by its state"):
            model.linearise_at(epoch, x, z, levels)
        with pytest.raises(InputError, match="Road has no linear form, so that nothing is linearised by its state"):
            model.linearise(At(x, z, levels), expected=True)
        with pytest.raises(InputError, match="motion Road states no density of its steps; give it both"):
            model.log_step(x, x, epoch, levels)


def test_a_static_component_stays_static_and_a_component_is_a_base_class():
    assert issubclass(ConstantVelocity, Component)
    assert Problem(PLANE, Static(), table_of()).model.recursions[0].time.shape == (2,)
