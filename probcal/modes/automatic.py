"""The automatic start: the grid at what is stated, what families of sensors tell of wide biases, exchanged nodes."""

import operator
from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import numpy as np

from probcal.gaussian.mode import Point, cost, find_mode
from probcal.model import variants
from probcal.model.model import Model
from probcal.modes.bearings import by_directions, turned
from probcal.modes.grid import grid_start
from probcal.modes.swaps import TRIED, best_fitting, exchanged, swaps
from probcal.priors import Precision
from probcal.problem import Problem, check_linear
from probcal.types import float64

FAMILIES: tuple[Callable[[Problem], Iterator[np.ndarray]], ...] = (by_directions,)
"""Geometric starts: each yields biases z (M,) for a problem whose spread makes the grid at z = 0 uncertain."""
SAME = 1e-2  # nats within which two starts have come to one optimum
NEAR = 15.0  # nats under a sparse prior within which another optimum is climbed too
MOST = 3  # optima that are
DRAWN = 3  # draws of the biases that are tried for one further start
SPARSE = 0.3  # share of the biases that a draw moves


class Optimum(NamedTuple):
    """A joint mode at the declared scales, its cost under a sparse prior, by which modes are ordered, if it settled."""

    problem: Problem
    value: float
    point: Point
    settled: bool = True


@float64
def automatic_start(problem: Problem) -> Point:
    """Trajectories and biases from the data alone, near the joint mode at the declared scales: the best of `optima`."""
    return optima(problem)[0].point


@float64
def optima(problem: Problem, stopped: Callable[[], bool] = lambda: False) -> list[Optimum]:
    """Joint modes at the declared scales that the data alone lead to: the best, and those that may be better.

    The grid, Viterbi path, motion model and iterated EKS at zero biases, then a few joint steps; the same at the biases
    that the geometry of a family of sensors tells (`FAMILIES`), where the stated network is too uncertain for the grid;
    and, where a node ends far from its stated place, at places exchanged. Modes are ordered by their cost under a
    Cauchy prior of the declared scales, to which one gross error costs little: a Gaussian one would rather spread it.
    Once `stopped` no other start than the first is tried.
    """
    check_linear(problem)
    measured = problem.at_measured()
    first = grid_start(problem)
    found = list[Optimum]()

    def proposed() -> Iterator[tuple[Point, bool]]:
        """Starts, and whether what they are polished to counts for them and does not take their place."""
        yield first, False
        if (z := turned(measured, first)) is not None:
            yield first._replace(z=jax.device_put(z)), False
        for family in FAMILIES:
            for z in family(problem):
                yield grid_start(problem, problem.first_z + z), False
        best = min(found, key=_value)
        for tracked in exchanged(measured, first, best.point, best.settled):
            yield tracked, True

    for start, kept in proposed():
        one = polished(problem, start)
        if kept:
            one = one._replace(value=min(sparse_cost(problem.model, start), one.value), point=start)
        found.append(one)
        if stopped():
            break
    chosen = list[Optimum]()
    for one in sorted(found, key=_value):
        if len(chosen) < MOST and not any(abs(one.value - other.value) < SAME for other in chosen):
            chosen.append(one)
    return [one for one in chosen if one is chosen[0] or one.value < chosen[0].value + NEAR]


def further_starts(problem: Problem, count: int, key: jax.Array) -> list[Point]:
    """`count` other starts: of swapped pairs of nodes and of sparse draws of the biases, those that fit best.

    A swap is the field's commonest gross error, and no local search finds it; draws move a share of the biases by
    two scales. Each comes with the track that suits it; half of the starts are swaps where there are any.
    """
    if count < 1:
        return []
    seeds, pairs = jax.random.split(key, 3), [*swaps(problem).values()]
    some = np.sort(np.asarray(jax.random.permutation(seeds[0], len(pairs)))[:TRIED])
    shape = (DRAWN * count, len(problem.labels))
    moved = np.asarray(jax.random.uniform(seeds[1], shape)) < SPARSE
    drawn = np.where(moved, 2.0 * np.asarray(jax.random.normal(seeds[2], shape)), 0.0)
    swapped, others = (
        best_fitting(problem, [grid_start(problem, problem.first_z + z) for z in every])
        for every in ([pairs[k] for k in some], drawn)
    )
    half = swapped[: (count + 1) // 2]
    return [point for _, point in [*half, *others[: count - len(half)]]]


def polished(problem: Problem, start: Point, iterations: int = 30) -> Optimum:
    """The joint mode at the declared scales next to a start, by that with growing stds at the measured values."""
    model = problem.model
    scales = Precision(jax.device_put(np.ones(model.biases)))
    if (measured := variants.at_measured(model)) is not model:
        start = find_mode(measured, start, scales, iterations, 1e-3).point
    mode = find_mode(model, start, scales, iterations, 1e-3)
    return Optimum(problem, sparse_cost(model, mode.point), mode.point, bool(mode.converged))


def sparse_cost(model: Model, point: Point) -> float:
    """Joint cost of a point with a Cauchy prior of scale one for each bias, infinite where there is none."""
    flat = Precision(jax.device_put(np.zeros(model.biases)))
    found = float(cost(model, point, flat) + np.log1p(np.asarray(point.z) ** 2).sum())
    return found if np.isfinite(found) else np.inf


_value = operator.attrgetter("value")
