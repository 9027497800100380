"""Benchmarks of bounds: the cells of a map in one kernel against a Python loop over single cells; compile time apart.

uv run --group bench pytest benchmarks/test_bounds.py --benchmark-only -n 0
"""

import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from probcal import Truth
from probcal.analysis.bounds import bounds
from probcal.analysis.maps import BiasBlocks, bound_map, snapshot, spectra
from probcal.analysis.sensitivity import sensitivity
from probcal.gaussian.mode import Point
from probcal.results.blocks import SensorBlocks

sys.path.insert(0, str(Path(__file__).parents[1] / "models"))
import radars

CELLS, SAMPLE = 100, 500  # along each side of the map; cells that the loop goes through
AREA = ((0.0, radars.AREA), (0.0, radars.AREA))


def first(benchmark, work):
    """Run once, note the time with compilation, then measure."""
    began = time.perf_counter()
    work()
    benchmark.extra_info["first_s"] = time.perf_counter() - began
    benchmark.pedantic(work, rounds=5, warmup_rounds=1)


@pytest.mark.parametrize("biases", ["known", "unknown"])
def test_a_map_of_100_x_100_cells(benchmark, biases):
    """All cells in one call; `ratio` is what a Python loop over the compiled bound of one cell takes over it."""
    problem, _ = radars.setting()
    first(benchmark, lambda: bound_map(problem, AREA, cells=CELLS, biases=biases))
    at = snapshot(problem)
    M = len(at.labels)
    places = np.random.default_rng(0).uniform(0, radars.AREA, (1 + SAMPLE, 1, 2))
    with jax.enable_x64(True):
        point = Point((), (), jnp.zeros(M), jnp.zeros(0))
        alone = SensorBlocks(M, np.arange(M)[:, None], np.ones((M, 1, 1)))
        blocks = BiasBlocks.of(at.model, alone) if biases == "unknown" else None

        def cell(place):
            return spectra(at.model, (0, 2), point, blocks, jnp.asarray(place)).block_until_ready()

        cell(places[0])  # compiles
        began = time.perf_counter()
        for place in places[1:]:
            cell(place)
    loop = (time.perf_counter() - began) * CELLS**2 / SAMPLE
    benchmark.extra_info["ratio"] = loop / np.median(benchmark.stats.stats.data)


def test_the_posterior_bound_of_c1(benchmark):
    problem, truth = radars.setting()
    first(benchmark, lambda: bounds(problem, truth=Truth(truth.tracks)))


def test_a_sensitivity_of_4_x_4_cells_and_50_runs(benchmark):
    problem, truth = radars.setting(scenario="C2")
    stds = {"*.position_*": np.arange(4) * 10.0, "*.range_offset": np.arange(4) * 10.0}
    first(benchmark, lambda: sensitivity(problem, stds, truth=Truth(truth.tracks)))
