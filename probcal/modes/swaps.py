"""Exchanged nodes: the commonest gross error of a survey, which no local search undoes."""

import itertools
import operator
from collections.abc import Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from probcal.gaussian.information import rejected
from probcal.gaussian.mode import Point, cost
from probcal.modes.grid import grid_start, track_mode
from probcal.modes.reflections import place_biases
from probcal.priors import Precision
from probcal.problem import Problem

GROSS = 3.0  # scales from its stated place at which a node makes exchanges worth trying
TRIED = 60  # exchanges that are tried
KEPT = 2  # of which so many are kept
SCREENED = 5  # steps of a track by which an exchange is screened
ROUNDS = 3  # exchanges of one network, one after the other
GAIN = 10.0  # nats by which one must fit better than what is stated


def free_places(problem: Problem) -> dict[str, list[int]]:
    """Numbers of the biases (d,) of the place of every node at rest whose place is free in all axes."""
    d, scaled = problem.network.dimension, [bias.kind == "scale" for bias in problem.biases]
    return {name: own for name, own in place_biases(problem).items() if sum(scaled[m] for m in own) == d}


def swaps(problem: Problem, z: np.ndarray | None = None) -> dict[tuple[str, str], np.ndarray]:
    """Biases (M,) that exchange the places of two nodes, by their names, for each free pair.

    The nodes stand at biases `z` (M,) before, as stated if None: several exchanges make a cycle.
    """
    place = free_places(problem)
    shift = np.zeros(len(problem.labels)) if z is None else z * problem.scales
    stated = {n.name: n.position for n in problem.network.nodes if n.name in place}
    found = {}
    for a, b in itertools.combinations(stated, 2):
        moved, apart = shift.copy(), stated[b] + shift[place[b]] - stated[a] - shift[place[a]]
        moved[place[a]] += apart
        moved[place[b]] -= apart
        if apart.any():
            found[a, b] = moved / problem.scales
    return found


def exchanged(problem: Problem, tracked: Point, point: Point, settled: bool) -> Iterator[Point]:
    """Tracked starts with the places of nodes exchanged and all other biases zero, where these fit far better.

    `tracked` is the track at zero biases, `point` the mode that it led to: pairs are tried where that has a node far
    from its stated place, rejects a sensor, or has not `settled`. Each pair is screened by a few steps from the track
    at zero biases, which robust losses keep near the truth; on top of those kept a further pair, while one fits better.
    """
    place, z = free_places(problem), np.asarray(point.z)
    far = {name: float(np.abs(z[own]).max()) for name, own in place.items()}
    doubted = {one.sensor for one in rejected(problem, point)} if far else set()
    doubtful = {node.name for s in problem.network.sensors if s.name in doubted for node in s.nodes}
    far |= dict.fromkeys(doubtful & far.keys(), np.inf)
    if not far or (settled and max(far.values()) < GROSS):
        return
    order = sorted(swaps(problem), key=lambda pair: -max(far[pair[0]], far[pair[1]]))[:TRIED]
    best, starts = best_fitting(problem, [track_mode(problem, tracked, SCREENED)])[0][0], [tracked]
    for _ in range(ROUNDS):
        tried = {
            exchange.round(6).tobytes(): start._replace(z=jax.device_put(exchange))
            for start in starts
            for pair, exchange in swaps(problem, np.asarray(start.z)).items()
            if pair in order
        }
        kept = best_fitting(problem, [track_mode(problem, start, SCREENED) for start in tried.values()])[:KEPT]
        better = [point.z for value, point in kept if value < best - GAIN]
        if not better:
            return
        best = kept[0][0]
        starts = [grid_start(problem, z) for z in better]
        yield from starts


def best_fitting(problem: Problem, points: Sequence[Point]) -> list[tuple[float, Point]]:
    """Points and their joint costs under a flat prior, those first that fit best."""
    flat = Precision(jnp.zeros(len(problem.labels)))
    costs = np.nan_to_num([float(cost(problem.model, point, flat)) for point in points], nan=np.inf)
    return sorted(zip(costs.tolist(), points, strict=True), key=operator.itemgetter(0))
