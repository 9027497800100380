"""The automatic start: the grid at what is stated, and beside it what each family of sensors tells of wide biases."""

from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np

from probcal.priors import Precision
from probcal.problem import Problem, check_linear
from probcal.smoothing.grid import grid_start
from probcal.smoothing.mode import Point, find_mode
from probcal.starts.bearings import by_directions
from probcal.types import float64

FAMILIES: tuple[Callable[[Problem], Iterator[np.ndarray]], ...] = (by_directions,)
"""Geometric starts: each yields biases z (M,) for a problem whose spread makes the grid at z = 0 uncertain."""
SAME = 1e-2  # nats within which two starts have come to one optimum


@float64
def automatic_start(problem: Problem, iterations: int = 30) -> Point:
    """Trajectories and biases from the data alone, near the joint mode at the declared scales: the best of `optima`."""
    return optima(problem, iterations)[0]


def optima(problem: Problem, iterations: int = 30) -> list[Point]:
    """Joint modes at the declared scales that the data alone lead to, the best first.

    The grid, Viterbi path, motion model and iterated EKS at zero biases, then a few joint steps; the same at the biases
    that the geometry of a family of sensors tells (`FAMILIES`), where the stated network is too uncertain for the grid.
    """
    check_linear(problem)
    scales = Precision.single(jnp.ones(problem.model.biases))
    places = [np.zeros(problem.model.biases), *(z for family in FAMILIES for z in family(problem))]
    found: list[tuple[float, Point]] = []
    for z in places:
        tracked = grid_start(problem, jax.device_put(z), iterations)
        mode = find_mode(problem.model, tracked, scales, iterations, 1e-3)
        cost = float(mode.cost)
        if len(places) == 1:
            return [mode.point]
        if np.isfinite(cost) and not any(abs(cost - other) < SAME for other, _ in found):
            found.append((cost, mode.point))
        elif not found:
            found.append((np.inf, mode.point))
    return [point for _, point in sorted(found, key=lambda pair: pair[0])]
