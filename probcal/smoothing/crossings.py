"""Nodes alone on the other side of the paths that they hear.

What passes a node on a nearly straight line (in 3-D in nearly a plane) tells how far off it stands, not on which side.
Where its place is known to no better than that, each side is a place of its own.
"""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from probcal.model.model import At, Model
from probcal.problem import Problem
from probcal.smoothing.grid import robust_misfit
from probcal.smoothing.mode import Point
from probcal.smoothing.reflections import SHIFTED, Plane, across, node_places, place_biases

FEW = 3  # rows without which a node hears no path
STILL = 1e-3  # extent of a path, over how far off a node stands, below which it is none


def node_sides(problem: Problem, point: Point, worse: float) -> Iterator[tuple[str, Point]]:
    """Each node on the other side of its path, tracks as they are: names and points, those first that fit best.

    Only where its free axes let it, within the reach of its scales, and its data fit at most `worse` nats a datum worse
    with the prior spread of the biases added to the noise.
    """
    z, members, place = np.asarray(point.z), place_biases(problem), node_places(problem, np.asarray(point.z))
    if not members:
        return
    names = list(members)
    heard = _heard(problem, [members[name][0] for name in names])
    moved: dict[int, np.ndarray] = {}
    for k, plane in _paths(problem, point, heard, np.array([place[name] for name in names])):
        mine = members[names[k]]
        there = across(problem, z, place[names[k]], mine, plane)
        if there is not None and np.abs(there - z[mine]).max() > SHIFTED:
            moved[k] = there
    if not moved:
        return
    loss = np.full(len(names), np.inf)
    here = _losses(problem.model, point, point.z, heard, len(names))
    for together in _parted(heard, moved):
        other = z.copy()
        for k in together:
            other[members[names[k]]] = moved[k]
        there = _losses(problem.model, point, jnp.asarray(other), heard, len(names))
        loss[together] = (there - here)[together]
    for k in sorted(moved, key=lambda k: loss[k]):
        if loss[k] < worse:
            other = z.copy()
            other[members[names[k]]] = moved[k]
            yield f'node "{names[k]}" on the other side of the path that it hears', point._replace(z=jnp.asarray(other))


def _heard(problem: Problem, first: list[int]) -> list[np.ndarray]:
    """Of each block which nodes (S, p) each sensor has, -1 for what is none; `first` is a bias of each node."""
    key = np.full(problem.model.biases + 1, -1)
    key[first] = np.arange(len(first))
    return [key[np.asarray(data.bias)] for data in problem.model.rows]


def _paths(problem: Problem, point: Point, heard: list[np.ndarray], place: np.ndarray) -> Iterator[tuple[int, Plane]]:
    """Line (in 3-D plane) of least squares of the places of targets that each node hears, `place` (nodes, d) theirs."""
    d, n, model = problem.network.dimension, len(place), problem.model
    count, total, square = np.zeros(n), np.zeros((n, d)), np.zeros((n, d, d))
    for own, data, r in zip(heard, model.rows, model.recursion, strict=True):
        there = np.asarray(point.states[r])[:, slice(*problem.epochs[r].position)][np.asarray(data.epoch)]
        used = np.asarray(data.mask).any(1)
        for slot in range(own.shape[1]):
            node = own[:, slot][np.asarray(data.sensor)]
            mine = used & (node >= 0)
            away = there[mine] - place[node[mine]]
            np.add.at(count, node[mine], 1.0)
            np.add.at(total, node[mine], away)
            np.add.at(square, node[mine], away[:, :, None] * away[:, None, :])
    enough = np.flatnonzero(count >= FEW)
    mean = total[enough] / count[enough, None]
    values, axes = np.linalg.eigh(square[enough] / count[enough, None, None] - mean[:, :, None] * mean[:, None, :])
    for k, centre, value, axis in zip(enough.tolist(), mean, values, axes, strict=True):
        if value[-1] > STILL**2 * np.sum(centre**2):
            yield k, Plane("its path", place[k] + centre, axis[:, 0])


def _parted(heard: list[np.ndarray], moved: dict[int, np.ndarray]) -> list[list[int]]:
    """Nodes that are moved in sets of which no sensor has two."""
    beside: dict[int, set[int]] = {k: set() for k in moved}
    for own in heard:
        for sensor in np.unique(own, axis=0):
            both = [k for k in sensor.tolist() if k in moved]
            for k in both:
                beside[k].update(both)
    sets: list[list[int]] = []
    for k in moved:
        free = (one for one in sets if not beside[k] & set(one))
        chosen = next(free, None)
        if chosen is None:
            sets.append([k])
        else:
            chosen.append(k)
    return sets


def _losses(model: Model, point: Point, z: jax.Array, heard: list[np.ndarray], nodes: int) -> np.ndarray:
    """Robust misfit (nodes,) a datum of the rows of each node at biases z, tracks as they are."""
    total, count = np.zeros(nodes), np.zeros(nodes)
    for own, data, loss in zip(heard, model.rows, _by_row(model, point, z), strict=True):
        value = np.nan_to_num(np.asarray(loss), nan=1e9, posinf=1e9)
        much = np.asarray(data.mask).sum(1)
        for slot in range(own.shape[1]):
            node = own[:, slot][np.asarray(data.sensor)]
            np.add.at(total, node[node >= 0], value[node >= 0])
            np.add.at(count, node[node >= 0], much[node >= 0])
    return total / np.maximum(count, 1.0)


@jax.jit
def _by_row(model: Model, point: Point, z: jax.Array) -> tuple[jax.Array, ...]:
    """Robust misfit (N,) of the rows of each block."""
    return tuple(robust_misfit(lin) for lin in model.linearise(At(point.states, z, point.levels), expected=False))
