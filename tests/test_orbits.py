"""Moves along a gauge: similarities that go back, their volume, and what chains make of them."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import probcal
from probcal import ARD, ConstantVelocity, Horseshoe, Laplace, Network, Node, Problem, Target, Unknown, simulate
from probcal.gaussian.frame import frame_at, log_weight, place, unit_normals, volume
from probcal.inference.hierarchy import hierarchy_of
from probcal.inference.leaps import Place
from probcal.inference.orbits import orbits_of, roam
from probcal.inference.posed import Form, Posed, prior_precision
from probcal.modes import automatic_start
from probcal.motion import RandomWalk
from probcal.sensors import doa, ranger


@cache
def posed(dimension=2, singular=False, unknown=False):
    """Bearings (in 3-D ranges) of nodes that are all free, and the orbits of the problem."""
    corners = np.array([(0, 0, 0), (40, 0, 3), (40, 30, 0), (0, 30, 4)], float)[:, :dimension]
    kind = doa if dimension == 2 else ranger
    free = {"position": 2.0, **({"heading": 0.05} if dimension == 2 else {})}
    network = Network([kind.on(Node(f"n{k}", place, scale=free)) for k, place in enumerate(corners)])
    motion = ConstantVelocity(Unknown(0.3) if unknown else 0.3, singular=singular)
    motion = motion + RandomWalk("power", "dB", 0.5, (3.0, 1.0))
    start = {"position": ((15.0, 10.0, 2.0)[:dimension], 5.0), "velocity": ((1.0, 0.5, 0.0)[:dimension], 1.0)}
    target = Target(motion, start)
    held = ["*.range_*"] if dimension == 3 else []
    problem = Problem(network, target, simulate(network, target, np.arange(12.0), key=1).table, fix=held)
    with jax.enable_x64(True):
        point = automatic_start(problem)
        prior = Horseshoe()
        made = Posed(problem.model, frame_at(problem.model, point), prior.precision(problem.labels, problem.surveyed))
        M = problem.model.biases
        orbits = orbits_of(problem, made, np.eye(M))
        form = Form(M, hierarchy_of(prior, problem))
    return problem, form, made, orbits


CASES = [
    (2, False, False),
    *(pytest.param(case, marks=pytest.mark.ci) for case in ((2, True, False), (3, False, True))),
]


@pytest.mark.ci
@pytest.mark.parametrize("case", CASES)
def test_an_orbit_is_a_group_that_leaves_what_the_sensors_see(case):
    problem, _, made, orbits = posed(*case)
    d = case[0]
    kinds = [orbit.kind for orbit in orbits]
    assert kinds == ["turn"] * (1 if d == 2 else 3) + ["shift"] * d + ["size"] * (2 if case[2] else 1)
    with jax.enable_x64(True):
        random = np.random.default_rng(0)
        theta = jnp.asarray(made.frame.theta + 0.1 * random.normal(size=made.frame.theta.shape))
        eps = tuple(jnp.asarray(random.normal(size=x.shape)) for x in made.frame.point.states)
        point = jax.device_put(place(problem.model, made.frame, theta, eps))
        before = problem.model.predict(point)
        for orbit in orbits:
            there = orbit.moved(made, jnp.asarray(0.3), point)
            back = orbit.moved(made, jnp.asarray(-0.3), there)
            for a, b in zip(jax.tree.leaves(back), jax.tree.leaves(point), strict=True):
                np.testing.assert_allclose(a, b, atol=1e-7)
            after = problem.model.predict(there)
            if orbit.kind != "size" or d == 2:  # a range is not free of scale
                for a, b in zip(after, before, strict=True):
                    gone = np.asarray(a) - np.asarray(b)
                    np.testing.assert_allclose(np.sin(gone) if d == 2 else gone, 0.0, atol=1e-9)


@pytest.mark.ci
@pytest.mark.parametrize("case", CASES)
def test_its_volume_is_the_determinant_of_its_derivative(case):
    problem, _, made, orbits = posed(*case)
    with jax.enable_x64(True):
        shapes = [x.shape for x in made.frame.point.states]
        sizes = [int(np.prod(shape)) for shape in shapes]
        random = np.random.default_rng(2)
        Q = len(made.frame.theta)

        def coordinates(flat, orbit, r):
            theta, rest = flat[:Q], flat[Q:]
            parts = jnp.split(rest, np.cumsum(sizes)[:-1].tolist())
            eps = tuple(part.reshape(shape) for part, shape in zip(parts, shapes, strict=True))
            moved = orbit.moved(made, r, place(problem.model, made.frame, theta, eps))
            new = unit_normals(problem.model, made.frame, moved)
            return jnp.concatenate([moved.z, moved.levels, *(e.ravel() for e in new)])

        flat = jnp.concatenate([made.frame.theta, jnp.asarray(random.normal(size=sum(sizes)))])
        for orbit in orbits:
            matrix = jax.jacfwd(coordinates)(flat, orbit, jnp.asarray(0.2))
            sign, value = np.linalg.slogdet(np.asarray(matrix))
            assert sign > 0
            change = made_volume(problem, made, flat[:Q], orbit, 0.2)
            assert abs(value - (0.2 * orbit.volume - change)) < 1e-6


def made_volume(problem, made, theta, orbit, r):
    """How the frame's own volume changes where the levels move."""
    levels = theta[made.frame.point.z.shape[0] :]
    if not orbit.levels:
        return 0.0
    moved = theta.at[made.frame.point.z.shape[0] + jnp.asarray(orbit.levels)].add(r)
    assert levels.shape
    return float(volume(problem.model, made.frame, moved) - volume(problem.model, made.frame, theta))


@pytest.mark.ci
@pytest.mark.needs("studies")
@pytest.mark.parametrize(
    ("case", "prior", "runs"),
    [
        ((2, False, False), Horseshoe(), 1000),
        pytest.param((3, False, True), Horseshoe(), 400, marks=pytest.mark.slow),
        pytest.param((2, False, False), probcal.Gaussian(), 1000, marks=pytest.mark.slow),
        pytest.param((2, False, False), ARD(2.0, 2.0, by="node"), 1000, marks=pytest.mark.slow),
        pytest.param((2, False, False), Laplace(), 1000, marks=pytest.mark.slow),
    ],
)
def test_a_draw_of_the_posterior_stays_one(case, prior, runs):
    """Truths from the prior, each with its own data, and ten proposals an orbit: together still the prior."""
    from probcal.studies.prior_draws import draw_prior

    problem, _, made, orbits = posed(*case)
    with jax.enable_x64(True):
        form = Form(problem.model.biases, hierarchy_of(prior, problem))
        first = prior.precision(problem.labels, problem.surveyed)

        def one(key):
            drawn = draw_prior(form, problem.model, first, key)
            own = Posed(problem.model.with_values(drawn.y), made.frame, first, orbits)
            theta = jnp.concatenate([drawn.point.z, drawn.point.levels])
            eps = unit_normals(own.model, made.frame, drawn.point)
            at = Place(theta, eps, drawn.phi, log_weight(own.model, made.frame, theta, eps))

            def again(at, k):
                return roam(form, own, at, jax.random.fold_in(key, k))

            last, taken = jax.lax.scan(again, at, jnp.arange(10))
            there = place(own.model, made.frame, last.theta, last.eps)
            begin = jnp.concatenate([u[0] for u in there.noises])
            alpha, _ = prior_precision(form, own, last.phi)
            return last, jnp.sqrt(alpha) * last.theta, begin, jnp.mean(taken), jnp.max(jnp.abs(last.theta - theta))

        last, unit, begin, taken, moved = jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(4), runs))
        laws = form.hierarchy.hyper()
        hyper = [np.asarray(jax.vmap(law.cdf)(last.phi[name])).reshape(runs, -1) for name, law in laws.items()]
    assert float(np.mean(np.asarray(taken))) > 0.05
    assert float(np.median(np.asarray(moved))) > 0.02
    columns = [*np.asarray(unit).T, *np.asarray(begin).T]
    worst = [stats.kstest(column, "norm").pvalue for column in columns]
    worst += [stats.kstest(column, "uniform").pvalue for values in hyper for column in values.T]
    assert min(worst) > 1e-3 / len(worst)
    assert abs((np.stack(columns) ** 2).mean() - 1.0) < 0.05
