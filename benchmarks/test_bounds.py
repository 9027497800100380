"""Benchmarks of bounds: the cells of a map in one kernel against a Python loop over single cells; compile time apart.

uv run --group bench pytest benchmarks/test_bounds.py --benchmark-only -n 0
"""

import sys
import time
from pathlib import Path

import numpy as np
import pytest

from probcal import Truth
from probcal.analysis.bounds import bounds
from probcal.analysis.maps import bound_map
from probcal.analysis.sensitivity import sensitivity

sys.path.insert(0, str(Path(__file__).parents[1] / "models"))
import radars

CELLS, SAMPLE = 100, 10  # along each side: of the map, and of the sample that a loop goes through
AREA = ((0.0, radars.AREA), (0.0, radars.AREA))


def first(benchmark, work):
    """Run once, note the time with compilation, then measure."""
    began = time.perf_counter()
    work()
    benchmark.extra_info["first_s"] = time.perf_counter() - began
    benchmark.pedantic(work, rounds=5, warmup_rounds=1)


@pytest.mark.parametrize("biases", ["known", "unknown"])
def test_a_map_of_100_x_100_cells(benchmark, biases):
    """All cells at once; `ratio` is what the same cells one by one would take over it."""
    problem, _ = radars.setting()
    first(benchmark, lambda: bound_map(problem, AREA, CELLS, biases=biases))
    side, cells = radars.AREA / SAMPLE, []
    for k in range(SAMPLE**2):
        x, y = side * (k % SAMPLE), side * (k // SAMPLE)
        cells.append(((x, x + side), (y, y + side)))
    bound_map(problem, cells[0], 1, biases=biases)
    began = time.perf_counter()
    for cell in cells:
        bound_map(problem, cell, 1, biases=biases)
    loop = (time.perf_counter() - began) * (CELLS / SAMPLE) ** 2
    benchmark.extra_info["ratio"] = loop / np.median(benchmark.stats.stats.data)


def test_the_posterior_bound_of_c1(benchmark):
    problem, truth = radars.setting()
    first(benchmark, lambda: bounds(problem, truth=Truth(truth.tracks)))


def test_a_sensitivity_of_4_x_4_cells_and_50_runs(benchmark):
    problem, truth = radars.setting(scenario="C2")
    stds = {"*.position_*": np.arange(4) * 10.0, "*.range_offset": np.arange(4) * 10.0}
    first(benchmark, lambda: sensitivity(problem, stds, truth=Truth(truth.tracks)))
