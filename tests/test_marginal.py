"""The mode of the marginal density of the biases: its gradient, linear problems, and scenes of bearings."""

from functools import partial
from types import SimpleNamespace
from typing import NamedTuple

import bent
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from worlds import linear, resting

import probcal
from probcal import EA, MAP, Channel, ConstantVelocity, Gaussian, Network, Node, Problem, sensor, simulate
from probcal.errors import InputError
from probcal.gaussian.climb import find_marginal_mode
from probcal.gaussian.linearised import laplace
from probcal.gaussian.marginal import volume_slope
from probcal.gaussian.mode import Point, cost, eliminate, find_mode
from probcal.gaussian.search import between, climb_on_host, climb_traced, halved
from probcal.geometry import bearing
from probcal.linalg import library
from probcal.modes import automatic_start
from probcal.priors import Precision

STEP = 3e-4  # of z in the differences


@partial(jax.jit, static_argnames="slope")
def at(model, point, prior, z, *, slope):
    """Negative log marginal density at z with the trajectories at their mode, or its gradient."""
    flat = Precision(jnp.zeros_like(z))
    point = find_mode(model, point._replace(z=z), flat, 200, 0.0, joint=False).point
    solved = eliminate(model, point, expected=True)
    if slope:
        return prior.pull(z) - solved.pull + 0.5 * volume_slope(model, point, solved)[0]
    return cost(model, point, prior) + 0.5 * solved.logdet


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["pair", *(pytest.param(n, marks=pytest.mark.slow) for n in bent.WORLDS if n != "pair")]
)
def test_the_gradient_is_that_of_differences(name):
    """Radars, directions, ranges, times and events, in 2-D and 3-D, two targets: central differences of l itself."""
    world = bent.WORLDS[name]()
    network = world.network()
    biases = dict.fromkeys(network.labels, 0.0)
    table = simulate(network, world.motion(), np.array(world.time), key=1, biases=biases).table
    problem = world.problem(table)
    with jax.enable_x64(True):
        model, prior = problem.model, Precision(jnp.ones(problem.model.biases))
        point = find_mode(model, automatic_start(problem), prior, 50, 1e-10).point
        found = np.asarray(at(model, point, prior, point.z, slope=True))
        shifts = STEP * np.eye(len(found))
        up, down = (
            np.array([float(at(model, point, prior, point.z + sign * one, slope=False)) for one in shifts])
            for sign in (1, -1)
        )
        mode, _ = find_marginal_mode(model, point, prior, 50, 1e-9)
        slope = np.asarray(at(model, mode.point, prior, mode.point.z, slope=True))
    assert bool(mode.converged)
    assert np.abs(slope).max() < 1e-3, "the gradient vanishes at the mode"
    expected = (up - down) / (2 * STEP)
    np.testing.assert_allclose(found, expected, atol=1e-4 * max(1.0, np.abs(expected).max()))


def test_on_a_linear_problem_it_is_the_joint_mode():
    problem, _ = linear("plane")
    with jax.enable_x64(True):
        prior = Precision(jnp.ones(problem.model.biases))
        joint = find_mode(problem.model, resting(problem), prior, 50, 1e-12)
        marginal, _ = find_marginal_mode(problem.model, resting(problem), prior, 50, 1e-10)
        evidence = laplace(problem.model, joint.point, prior).evidence
        again = laplace(problem.model, marginal.point, prior).evidence
    assert bool(marginal.converged)
    np.testing.assert_allclose(marginal.point.z, joint.point.z, atol=1e-7)
    assert float(evidence) == pytest.approx(float(again), abs=1e-8)


def test_steps_are_halved_apart_and_none_is_taken_where_none_would_do():
    """Of three steps along (t - a)^2 the first is whole, the second an eighth; the third only rises."""
    valley, bound = np.array([0.5, 0.1, -1.0]), np.array([0.25, 0.01, 1.0])
    share, value, _ = jax.jit(lambda bound: halved(lambda t: ((t - valley) ** 2, t), bound))(bound)
    np.testing.assert_array_equal(share, [1.0, 0.125, 0.0])
    np.testing.assert_allclose(value, [0.25, 0.025**2, 1.0], rtol=1e-6)
    assert jax.jit(between)(1.0, np.nan, share[2]) == 1.0


def test_what_it_refuses():
    with pytest.raises(InputError, match=r'MAP\(trajectory="smoothed"\): give one of joint, marginal'):
        MAP(trajectory="smoothed")


# A scene of bearings: motion noise and surveys fix its size


@sensor(azimuth=Channel("rad", std=0.02, wrap=True))
def camera(target, pose):
    return dict(azimuth=bearing(target.position - pose.position) - pose.heading)


PLACES = np.array([(0, 0), (60, 0), (60, 40), (0, 40), (30, -10), (30, 50)], float)
LABELS = [f"cam_{k}.position_{axis}" for k in range(len(PLACES)) for axis in "xy"]


def scene(seed):
    """Six cameras surveyed to 2 m, headings to be found, a target whose motion noise is known; and the true biases."""
    rng = np.random.default_rng(seed)
    spread = {"survey": {"position": 2.0}, "scale": {"heading": 0.05}}
    network = Network([camera.on(Node(f"cam_{k}", p, **spread)) for k, p in enumerate(PLACES)])
    biases = dict.fromkeys(network.labels, 0.0) | dict(zip(LABELS, 2.0 * rng.standard_normal(12), strict=True))
    motion = probcal.Target(ConstantVelocity(0.03), {"position": ((30.0, 20.0), 0.01), "velocity": ((0.2, -0.1), 0.01)})
    drawn = simulate(network, motion, 0.5 * np.arange(400.0), key=seed, biases=biases)
    return Problem(network, ConstantVelocity(0.03), drawn.table), np.array([biases[label] for label in LABELS])


def dilation(biases, other):
    """Log of the size of a scene with biases (12,) over that with others, by least squares."""
    one, two = (PLACES + b.reshape(-1, 2) for b in (biases, other))
    one, two = one - one.mean(0), two - two.mean(0)
    turned = [a[:, 0] + 1j * a[:, 1] for a in (one, two)]
    return float(np.log(abs(np.vdot(turned[1], turned[0]) / np.vdot(turned[1], turned[1]))))


@pytest.mark.slow
def test_a_scene_of_bearings_keeps_its_size():
    """40 scenes from the model: the marginal mode within 2.5 standard errors of no dilation, the joint one beyond 4."""
    logs, held = {"joint": [], "marginal": []}, {"joint": [], "marginal": []}
    errors = {"joint": [], "marginal": []}
    for seed in range(40):
        problem, true = scene(seed)
        for trajectory in logs:
            tree = probcal.fit(problem, EA(trajectory=trajectory, precisions="maximised"))
            assert tree.attrs["status"] == "converged"
            group = tree["calibration"].to_dataset().sel(bias_label=LABELS)
            logs[trajectory].append(dilation(group["mean"].values, true))
            held[trajectory].append(np.mean((group["lower"] <= true) & (true <= group["upper"])))
            errors[trajectory].append(np.sqrt(np.mean((group["mean"] - true) ** 2)))
    found = {}
    for name, values in logs.items():
        mean, error = np.mean(values), np.std(values, ddof=1) / np.sqrt(len(values))
        found[name] = mean / error
        print(
            f"\n{name}: log dilation {mean:.4f} ({error:.4f}), 89 % intervals hold {np.mean(held[name]):.3f},"
            f" rms error {np.mean(errors[name]):.2f} m"
        )
    assert abs(found["marginal"]) < 2.5
    assert found["joint"] < -4


@pytest.mark.ci
def test_a_fit_of_the_marginal_says_what_it_is():
    problem, true = scene(0)
    trees = {name: probcal.fit(problem, MAP(trajectory=name), prior=Gaussian()) for name in ("joint", "marginal")}
    size = {name: dilation(t["calibration"]["mean"].sel(bias_label=LABELS).values, true) for name, t in trees.items()}
    assert size["marginal"] > size["joint"] + 0.01, "the joint mode prefers a smaller scene"
    assert trees["marginal"].attrs["log_evidence"] > trees["joint"].attrs["log_evidence"]
    assert "trajectory='marginal'" in trees["marginal"].attrs["settings"]


class Wells:
    """Two wells of (x^2 - 1)^2 / 4 + y^2 at x = 1 and -1, a ridge between them; steps know half the curvature by y."""

    def expand(self, point):
        return SimpleNamespace(point=point, z=point.z) if isinstance(point.z, np.ndarray) else Looked(point, point.z)

    def moved(self, at, dz):
        return at.point._replace(z=at.z + dz)

    def value(self, at):
        return (at.z[0] ** 2 - 1) ** 2 / 4 + at.z[1] ** 2

    def slope(self, at):
        return -library(at.z).stack([at.z[0] * (at.z[0] ** 2 - 1), 2 * at.z[1]])

    def solve(self, at, right, damping):
        xp = library(at.z)
        curved = xp.stack([3 * at.z[0] ** 2 - 1, xp.full((), 1.0)]) + damping
        return xp.where(curved > 0, right / curved, xp.nan)


class Looked(NamedTuple):
    point: Point
    z: jax.Array


@pytest.mark.parametrize("far", [0.1, -0.4, 40.0])
def test_a_search_from_the_host_is_the_traced_one_and_damped_where_no_precision_is_positive(far):
    with jax.enable_x64(True):
        start = Point((), (), np.array([far, 3.0]), np.zeros(0))
        host, trace, _ = climb_on_host(Wells(), start, 2, 60, 1e-12)
        traced = jax.device_get(jax.jit(lambda start: climb_traced(Wells(), start, 2, 60, 1e-12))(start))
        nowhere, *_ = climb_on_host(Wells(), start._replace(z=np.full(2, np.nan)), 2, 60, 1e-12)
    assert host.converged
    np.testing.assert_allclose(np.abs(host.at.z), [1.0, 0.0], atol=1e-5)
    assert (host.taken, host.count) == (traced.taken, traced.count)
    np.testing.assert_allclose(traced.at.z, host.at.z, atol=1e-9)
    assert np.all(np.diff(trace) >= 0)
    assert nowhere.done
    assert not nowhere.converged
