"""The automatic start: the grid at what is stated, what families of sensors tell of wide biases, exchanged nodes."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal.gaussian.mode import Mode, Point, cost, find_mode
from probcal.model import variants
from probcal.model.model import Model
from probcal.modes.bearings import by_directions, turned
from probcal.modes.grid import grid_start
from probcal.modes.swaps import exchanged
from probcal.priors import Precision
from probcal.problem import Problem, check_linear
from probcal.types import float64

FAMILIES: tuple[Callable[[Problem], Iterator[np.ndarray]], ...] = (by_directions,)
"""Geometric starts: each yields biases z (M,) for a problem whose spread makes the grid at z = 0 uncertain."""
SAME = 1e-2  # nats within which two starts have come to one optimum
NEAR = 15.0  # nats under a sparse prior within which another optimum is climbed too
MOST = 3  # optima that are


class Optimum(NamedTuple):
    """A joint mode at the declared scales, its cost under a sparse prior, by which modes are ordered, if it settled."""

    value: float
    point: Point
    settled: bool = True


@float64
def automatic_start(problem: Problem, iterations: int = 30) -> Point:
    """Trajectories and biases from the data alone, near the joint mode at the declared scales: the best of `optima`."""
    return optima(problem, iterations)[0].point


@float64
def optima(problem: Problem, iterations: int = 30, stopped: Callable[[], bool] = lambda: False) -> list[Optimum]:
    """Joint modes at the declared scales that the data alone lead to: the best, and those that may be better.

    The grid, Viterbi path, motion model and iterated EKS at zero biases, then a few joint steps; the same at the biases
    that the geometry of a family of sensors tells (`FAMILIES`), where the stated network is too uncertain for the grid;
    and, where a node ends far from its stated place, at places exchanged. Modes are ordered by their cost under a
    Cauchy prior of the declared scales, to which one gross error costs little: a Gaussian one would rather spread it.
    Once `stopped` no other start than the first is tried.
    """
    check_linear(problem)
    measured = problem.at_measured()
    first = grid_start(problem, jax.device_put(problem.first_z), iterations)
    found = [_polished(problem, first, iterations)]
    if (z := turned(measured, first)) is not None:
        found.append(_polished(problem, first._replace(z=jax.device_put(z)), iterations))
    for family in FAMILIES:
        for z in family(problem):
            if stopped():
                break
            placed = grid_start(problem, jax.device_put(problem.first_z + z), iterations)
            found.append(_polished(problem, placed, iterations))
    best = min(found, key=_order)
    for tracked in exchanged(measured, first, best.point, best.settled):
        if stopped():
            break
        value = min(float(sparse_cost(problem.model, tracked)), _polished(problem, tracked, iterations).value)
        found.append(Optimum(value, tracked))
    if len(found) == 1:
        return found
    kept: list[Optimum] = []
    for one in sorted(found, key=_order):
        if len(kept) < MOST and not any(abs(one.value - other.value) < SAME for other in kept):
            kept.append(one)
    return [one for one in kept if one is kept[0] or one.value < kept[0].value + NEAR]


def _order(optimum: Optimum) -> float:
    return optimum.value if np.isfinite(optimum.value) else np.inf


def _polished(problem: Problem, tracked: Point, iterations: int) -> Optimum:
    """The joint mode at the declared scales next to a point."""
    mode = mode_from_start(problem.model, tracked, iterations)
    return Optimum(float(sparse_cost(problem.model, mode.point)), mode.point, bool(mode.converged))


def mode_from_start(model: Model, start: Point, iterations: int) -> Mode:
    """The joint mode at the declared scales next to a start, by that with growing stds at the measured values."""
    scales = Precision(jnp.ones(model.biases))
    if (measured := variants.at_measured(model)) is not model:
        start = find_mode(measured, start, scales, iterations, 1e-3).point
    return find_mode(model, start, scales, iterations, 1e-3)


@jax.jit
def sparse_cost(model: Model, point: Point) -> jax.Array:
    """Joint cost of a point with a Cauchy prior of scale one for each bias."""
    flat = Precision(jnp.zeros(model.biases))
    return cost(model, point, flat) + jnp.sum(jnp.log1p(point.z**2))
