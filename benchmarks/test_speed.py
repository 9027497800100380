"""Benchmarks: run time of compiled kernels, and scaling; compile time apart. Not part of the tests.

    uv run --group bench pytest benchmarks --benchmark-only -n 0

Peers are measured beside them with their own scripts (`stonesoup_eks.py`, `gtsam_map.py 10 100`) in the same
session on the same machine: quote ratios.
"""

import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

from probcal import ARD, EMEA, Bias, ConstantVelocity, Drift, Network, Node, Problem, fit, study
from probcal.analysis import next_passes, observability
from probcal.gaussian.linearised import laplace
from probcal.gaussian.mode import Point, find_mode
from probcal.inference.method import Context
from probcal.modes import automatic_start
from probcal.modes.grid import project, track_mode
from probcal.priors import Precision
from probcal.sensors import radar

sys.path.insert(0, str(Path(__file__).parents[1] / "models"))
import radars


def network(N, K, seed=0):
    """N radars and K scans of the C1 path, as in the GTSAM peer script; the start follows the true path."""
    rng = np.random.default_rng(seed)
    stated = rng.uniform(size=(N, 2)) * 500
    u = np.linspace(0, 1, K)
    position = np.stack([50 + 400 * u, 250 + 150 * np.sin(3 * np.pi * u)], 1)
    scale = {"position": 10.0, "heading": np.deg2rad(10.0)}
    placed = Network([radar.on(Node(f"radar_{n}", p, scale=scale)) for n, p in enumerate(stated)])
    line = position[:, None] - stated[None]
    time_, name = np.repeat(np.arange(K), N), [f"radar_{n}" for n in range(N)] * K
    table = pd.DataFrame({"time": time_.astype(float), "sensor": name})
    table["range"] = (np.hypot(line[..., 0], line[..., 1]) + 10 * rng.normal(size=(K, N))).ravel()
    table["azimuth"] = (np.arctan2(line[..., 1], line[..., 0]) + 0.17 * rng.normal(size=(K, N))).ravel()
    problem = Problem(placed, ConstantVelocity(1.0), table, fix=["*.range_offset"])
    states = np.hstack([position, np.gradient(position, axis=0)])
    with jax.enable_x64(True):
        return problem, project(problem, [states], [np.full_like(states, 1e2)])


SIZES = [(10, 100), (20, 100), (40, 100), (100, 1000), (300, 300)]  # GTSAM: gtsam_map.py N K


def mode(problem, start):
    """Joint MAP of all poses and states."""
    prior = Precision(jnp.ones(len(problem.labels)))
    found = find_mode(problem.model, start, prior, 50, 1e-5)
    return jax.block_until_ready(found.point)


def mode_and_marginals(problem, start):
    """Joint MAP and the marginal covariances of all biases."""
    prior = Precision(jnp.ones(len(problem.labels)))
    point = mode(problem, start)
    return jax.block_until_ready(laplace(problem.model, point, prior).covariance)


@pytest.mark.parametrize("work", [mode, mode_and_marginals], ids=lambda work: work.__name__)
@pytest.mark.parametrize(("N", "K"), SIZES)
def test_joint_map(benchmark, N, K, work):
    problem, start = network(N, K)
    with jax.enable_x64(True):
        began = time.perf_counter()
        work(problem, start)
        benchmark.extra_info["compile_s"] = time.perf_counter() - began
        benchmark.pedantic(work, (problem, start), rounds=5 if N * K > 10_000 else 50, warmup_rounds=1)


@pytest.mark.parametrize("K", [200, 400, 800, 1600])
def test_one_elimination_grows_with_epochs_and_rows(benchmark, K):
    problem, start = network(10, K)
    with jax.enable_x64(True):
        alpha = Precision(jnp.ones(len(problem.labels)))
        benchmark(lambda: jax.block_until_ready(laplace(problem.model, start, alpha).covariance))


@pytest.mark.parametrize("pieces", [1, 5, 20, 50])
def test_drifting_headings(benchmark, pieces):
    """MAP and marginals of 10 x 100 where every heading walks in so many pieces: 30 biases and 10 more a step."""
    problem, start = network(10, 100)
    if pieces > 1:
        drift = Drift(np.linspace(0, 100, pieces + 1)[:-1], std=0.01)
        scale = {"position": 10.0, "heading": Bias("rad", np.deg2rad(10.0), drift=drift)}
        nodes = [Node(node.name, node.position, scale=scale) for node in problem.network.nodes]
        table = problem.measurements.table
        problem = Problem(Network([radar.on(n) for n in nodes]), problem.motion, table, fix=["*.range_offset"])
        start = start._replace(z=np.zeros(len(problem.labels)))
    with jax.enable_x64(True):
        mode_and_marginals(problem, start)
        benchmark.pedantic(mode_and_marginals, (problem, start), rounds=20, warmup_rounds=1)


@pytest.mark.parametrize("plan", [observability, next_passes], ids=lambda plan: plan.__name__)
@pytest.mark.parametrize(("N", "K"), [(10, 100), (100, 1000)])
def test_check(benchmark, N, K, plan):
    problem, start = network(N, K)
    began = time.perf_counter()
    plan(problem, point=start)
    benchmark.extra_info["compile_s"] = time.perf_counter() - began
    benchmark.pedantic(plan, (problem,), {"point": start}, rounds=3, warmup_rounds=0)


def test_fifty_em_ea_iterations_of_c1(benchmark):
    problem, _ = radars.setting(0, 0.3, "C1")
    with jax.enable_x64(True):
        start = automatic_start(problem)
        method, context = EMEA(iterations=50), Context(jax.random.key(0))
        benchmark(lambda: jax.block_until_ready(method.climb(problem, ARD(), start, context)[0].point.z))


def test_one_smoothing_pass_of_c1(benchmark):
    problem, _ = radars.setting(0, 0.3, "C1")
    with jax.enable_x64(True):
        start: Point = track_mode(problem, automatic_start(problem))
        alpha = Precision(jnp.ones(len(problem.labels)))
        arguments = (problem.model, start, alpha, 1, 0.0)
        benchmark(lambda: jax.block_until_ready(find_mode(*arguments, joint=False).cost))


def test_ten_runs_of_a_study(benchmark):
    grid, methods = {"scenario": ["B"], "share": [0.3]}, ["ml", "ea", "oracle"]
    benchmark.pedantic(lambda: study(radars.setting, grid, methods, runs=10), rounds=3, warmup_rounds=1)


def test_whole_fit_of_c1(benchmark):
    problem, _ = radars.setting(0, 0.3, "C1")
    benchmark(lambda: fit(problem, EMEA()))
