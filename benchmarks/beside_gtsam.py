"""The joint mode and all marginals beside GTSAM (C++), in one run: the same rows, priors, motion and start.

    uv run --with gtsam python benchmarks/beside_gtsam.py 10x100 100x1000 300x300

N radars of unknown place and heading (10 m, 10 deg) watch one target for K epochs, every pair seen: range (10 m) and
azimuth (10 deg). GTSAM: Levenberg-Marquardt, then `Marginals` of every radar. Here: `find_mode`, then
the covariance of all biases. A line a size: seconds of both (the best of some runs; of compiling once), by how much
modes and sds differ, in sds.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass

import jax
import numpy as np
import pandas as pd

import probcal as pc
from probcal.gaussian.linearised import laplace
from probcal.gaussian.mode import cost, find_mode
from probcal.geometry import bearing, norm
from probcal.modes.grid import follow_states
from probcal.motion import Component
from probcal.motion.components import blocks

RANGE, AZIMUTH, PLACE = 10.0, np.deg2rad(10.0), 10.0
MOVED, BENT = 0.3, 1.0  # sds of the noise of position and velocity, a step
TOLERANCE = 1e-5  # of the cost, at which both stop; GTSAM's default is that or 1e-5 of the cost (`--loose`)
FIRST = 2.5, 1.0  # sds of the first position and velocity


@dataclass(frozen=True)
class Walking(Component):
    """Position and velocity with a noise each: what two factors of GTSAM say."""

    std: float = 1.0

    def names(self):
        return (("position", True), ("velocity", True))

    def transition(self, dt, dimension):
        return blocks([[1.0, dt], [0.0, 1.0]], dimension, dt)

    def noise_factor(self, dt, dimension):
        return blocks([[MOVED + 0.0 * dt, 0.0], [0.0, BENT + 0.0 * dt]], dimension, dt)


@pc.sensor(range=pc.Channel("m", std=RANGE), azimuth=pc.Channel("rad", std=AZIMUTH, wrap=True))
def radar(target, pose):
    line = pose.local(target.position)
    return dict(range=norm(line), azimuth=bearing(line))


def drawn(N: int, K: int, seed: int = 0):
    """Places (N, 2), path and velocity (K, 2), ranges and azimuths (K, N); three biases of five are zero."""
    rng = np.random.default_rng(seed)
    places = 500.0 * rng.uniform(size=(N, 2))
    t = np.linspace(0, 1, K)
    path = np.stack([50 + 400 * t, 250 + 150 * np.sin(3 * np.pi * t)], 1)
    bias = rng.normal(size=(N, 3)) * [PLACE, PLACE, AZIMUTH] * (rng.uniform(size=(N, 3)) < 0.4)
    line = path[:, None] - places - bias[:, :2]
    ranges = np.hypot(*np.moveaxis(line, 2, 0)) + RANGE * rng.normal(size=(K, N))
    azimuths = np.arctan2(line[..., 1], line[..., 0]) - bias[:, 2] + AZIMUTH * rng.normal(size=(K, N))
    return places, path, np.gradient(path, axis=0), ranges, azimuths


def best(run: Callable[[], object], times: int) -> float:
    """Seconds of the best of some runs."""
    found = []
    for _ in range(times):
        begun = time.perf_counter()
        jax.block_until_ready(run())
        found.append(time.perf_counter() - begun)
    return min(found)


def built(places, path, velocity, ranges, azimuths):
    """The problem, and the point whose trajectory is the true one."""
    K, N = ranges.shape
    scale = {"position": PLACE, "heading": AZIMUTH}
    network = pc.Network([radar.on(pc.Node(f"s{n}", place, scale=scale)) for n, place in enumerate(places)])
    start = {"position": (path[0], FIRST[0]), "velocity": (velocity[0], FIRST[1])}
    epoch, sensor = np.divmod(np.arange(K * N), N)
    table = pd.DataFrame({"time": epoch.astype(float), "sensor": [f"s{n}" for n in sensor], "target": "t"})
    table["range"], table["azimuth"] = ranges.ravel(), azimuths.ravel()
    problem = pc.Problem(network, pc.Target(Walking(), start=start), table)
    order = [name for name, *_ in problem.epochs[0].layout]
    states = np.concatenate([{"position": path, "velocity": velocity}[name] for name in order], 1)
    with jax.enable_x64(True):
        return problem, follow_states(problem, [states])


def here(places, path, velocity, ranges, azimuths, times, loose):
    """Mode (N, 3), sds (N, 3), seconds of the mode and of the covariance, and of compiling both."""
    N = len(places)
    problem, point = built(places, path, velocity, ranges, azimuths)
    with jax.enable_x64(True):
        model, prior = problem.model, pc.Gaussian().precision(problem.labels, problem.surveyed)
        tolerance = TOLERANCE * float(cost(model, point, prior)) if loose else TOLERANCE
        begun = time.perf_counter()
        mode = jax.block_until_ready(find_mode(model, point, prior, 100, tolerance))
        found = jax.block_until_ready(laplace(model, mode.point, prior))
        cold = time.perf_counter() - begun
        seconds = best(lambda: find_mode(model, point, prior, 100, tolerance), times)
        marginals = best(lambda: laplace(model, mode.point, prior), times)
        z = np.asarray(mode.point.z) * problem.scales
        sd = np.sqrt(np.diag(np.asarray(found.covariance))) * problem.scales
    index = {label: m for m, label in enumerate(problem.labels)}
    at = [[index[f"s{n}.{name}"] for name in ("position_x", "position_y", "heading")] for n in range(N)]
    return z[at], sd[at], seconds, marginals, cold - seconds - marginals, int(mode.iterations)


def there(places, path, velocity, ranges, azimuths, times, loose):
    """The same by GTSAM; it compiles nothing."""
    import gtsam
    from gtsam import noiseModel, symbol

    K, N = ranges.shape
    graph, values, eye = gtsam.NonlinearFactorGraph(), gtsam.Values(), np.eye(2)
    spread = noiseModel.Diagonal.Sigmas(np.array([PLACE, PLACE, AZIMUTH]))
    for n in range(N):
        stated = gtsam.Pose2(*places[n], 0.0)
        graph.add(gtsam.PriorFactorPose2(symbol("s", n), stated, spread))
        values.insert(symbol("s", n), stated)
    noise = noiseModel.Diagonal.Sigmas(np.array([AZIMUTH, RANGE]))
    for k in range(K):
        values.insert(symbol("p", k), gtsam.Point2(*path[k]))
        values.insert(symbol("v", k), velocity[k])
        for n in range(N):
            seen = gtsam.Rot2(azimuths[k, n]), ranges[k, n]
            graph.add(gtsam.BearingRangeFactor2D(symbol("s", n), symbol("p", k), *seen, noise))
    graph.add(gtsam.PriorFactorPoint2(symbol("p", 0), gtsam.Point2(*path[0]), noiseModel.Isotropic.Sigma(2, FIRST[0])))
    graph.add(gtsam.PriorFactorVector(symbol("v", 0), velocity[0], noiseModel.Isotropic.Sigma(2, FIRST[1])))
    for k in range(K - 1):
        at = gtsam.Values()
        for q in (k, k + 1):
            at.insert(symbol("p", q), gtsam.Point2(*path[q]))
            at.insert(symbol("v", q), velocity[q])
        off, bent = path[k] + velocity[k] - path[k + 1], velocity[k] - velocity[k + 1]
        moves = (symbol("p", k), -eye, symbol("v", k), -eye, symbol("p", k + 1), eye, off)
        graph.add(gtsam.LinearContainerFactor(gtsam.JacobianFactor(*moves, noiseModel.Isotropic.Sigma(2, MOVED)), at))
        turns = (symbol("v", k), -eye, symbol("v", k + 1), eye, bent)
        graph.add(gtsam.LinearContainerFactor(gtsam.JacobianFactor(*turns, noiseModel.Isotropic.Sigma(2, BENT)), at))

    settings = gtsam.LevenbergMarquardtParams()
    settings.setAbsoluteErrorTol(TOLERANCE)
    settings.setRelativeErrorTol(TOLERANCE if loose else 1e-12)

    def climb():
        return gtsam.LevenbergMarquardtOptimizer(graph, values, settings)

    def spreads():
        marginals = gtsam.Marginals(graph, found)
        return [np.sqrt(np.diag(marginals.marginalCovariance(symbol("s", n)))) for n in range(N)]

    optimizer = climb()
    found = optimizer.optimize()
    seconds = best(lambda: climb().optimize(), times)
    begun = time.perf_counter()
    sd = np.array(spreads())
    marginals = time.perf_counter() - begun
    poses = [found.atPose2(symbol("s", n)) for n in range(N)]
    z = np.array([[p.x(), p.y(), p.theta()] for p in poses]) - np.pad(places, ((0, 0), (0, 1)))
    return z, sd, seconds, marginals, optimizer.iterations()


def main():
    """Both, size by size."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("size", nargs="*", default=["10x100", "100x1000", "300x300"], help="radars x epochs")
    parser.add_argument("--times", type=int, default=3)
    parser.add_argument("--loose", action="store_true", help="stop where the cost falls by 1e-5 of itself")
    chosen = parser.parse_args()
    for size in chosen.size:
        N, K = map(int, size.split("x"))
        data = drawn(N, K)
        z, sd, seconds, marginals, cold, steps = here(*data, chosen.times, chosen.loose)
        other, spread, slow, long, iterations = there(*data, chosen.times, chosen.loose)
        off = np.abs(z - other) / sd
        apart = np.abs(np.hypot(*sd[:, :2].T) / np.hypot(*spread[:, :2].T) - 1.0)
        print(
            f"{size}: mode {seconds:.4f} s ({steps} steps; compiling {cold:.1f} s), GTSAM {slow:.3f} s ({iterations}):"
            f" {slow / seconds:.1f} times; marginals {marginals:.4f} s, GTSAM {long:.3f} s:"
            f" {long / marginals:.0f} times; modes differ by {off.max():.1e} sd, sds by {apart.max():.1e}",
            flush=True,
        )


if __name__ == "__main__":
    main()
