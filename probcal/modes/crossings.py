"""Nodes alone on the other side of the paths that they hear.

What passes a node on a nearly straight line (in 3-D in nearly a plane) tells how far off it stands, not on which side.
Where its place is known to no better than that, each side is a place of its own.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from probcal.gaussian.mode import Point
from probcal.labels import NODE
from probcal.linalg import solve_square, spectrum
from probcal.model.model import At, Model
from probcal.model.rows import Linearised
from probcal.modes.explore import WORSE, Candidate
from probcal.modes.reflections import FAR, SHIFTED, Plane, node_places, place_biases
from probcal.problem import Problem

FEW = 3  # rows without which a node hears no path
STILL = 1e-3  # extent of a path, over how far off a node stands, below which it is none
STEPS, STRIDE = 8, 1.0  # by which a node settles on its other side, and scales that one may move a bias
LEVEL = 0.25  # square of the part of a normal that lies along the free axes of a node, below which it cannot cross
SETS = 40  # of nodes that are moved together, one set after the other
NEAR = 2.0  # scales from its path within which a node may have settled on neither side
ASIDE = 5.0  # sd from where it settles on its own side at which it stands on another: below, it came back


def nodes(problem: Problem, point: Point, most: float = np.inf) -> Iterator[Candidate]:
    """Each node on the other side of its path, tracks as they are, those first that fit best.

    Only where its free axes let it, within the reach of its scales. Its biases, and those of its sensors, settle there;
    what then fits more than `WORSE` nats a datum worse, or more than `most` nats, is left out. A node within `NEAR`
    scales of its path may have settled on neither side, and begins at so many on both too.
    """
    z, members, place = np.asarray(point.z), place_biases(problem), node_places(problem, np.asarray(point.z))
    if not members:
        return
    names = list(members)
    heard = _heard(problem, [members[name][0] for name in names])
    paths = dict(_paths(problem, point, heard, np.array([place[name] for name in names])))
    starts = {k: _starts(problem, z, place[names[k]], members[names[k]], plane) for k, plane in paths.items()}
    starts = {k: own for k, own in starts.items() if own}
    if not starts:
        return
    own = _Own.of(problem, names, heard)
    drop, settled = np.full(len(names), np.inf), dict[int, np.ndarray]()
    likely = sorted(starts, key=lambda k: float(np.abs(starts[k][0]).max()))
    sets = _parted(heard, likely)[:SETS]
    for together in sets:
        home = own.settled(problem.model, point, z, together)[0]
        here = np.minimum(*(own.losses(problem.model, point, at) for at in (home, z)))
        for turn in range(max(len(starts[k]) for k in together)):
            moving = [k for k in together if turn < len(starts[k])]
            other = z.copy()
            for k in moving:
                other[members[names[k]]] = starts[k][turn]
            other, information = own.settled(problem.model, point, other, moving)
            away = np.append(other - home, 0.0)[own.biases[moving]]
            aside = np.sqrt(np.einsum("kp,kpq,kq->k", away, information, away))
            worth = own.losses(problem.model, point, other) - here
            for k, apart in zip(moving, aside, strict=True):
                if apart > ASIDE and worth[k] < drop[k]:
                    drop[k], settled[k] = worth[k], other[own.of_node(k)]
    better = [[k for k in together if drop[k] < 0.0] for together in sets]
    if len(most_of := max(better, key=len)) > 1:
        whole = z.copy()
        for k in most_of:
            whole[own.of_node(k)] = settled[k]
        name = f"{len(most_of)} nodes elsewhere beside the paths that they hear"
        yield Candidate(name, NODE, point._replace(z=jnp.asarray(whole)))
    for k in sorted(settled, key=lambda k: drop[k]):
        if drop[k] < min(WORSE * own.count[k], most):
            other = z.copy()
            other[own.of_node(k)] = settled[k]
            now = node_places(problem, other)[names[k]]
            crossed = paths[k].distance(now) * paths[k].distance(place[names[k]]) < 0
            where = "on the other side of the path" if crossed else "elsewhere beside the path"
            yield Candidate(f'node "{names[k]}" {where} that it hears', NODE, point._replace(z=jnp.asarray(other)))


def _starts(
    problem: Problem, z: np.ndarray, place: np.ndarray, members: list[int], plane: Plane
) -> list[np.ndarray]:  # fmt: skip
    """Where a node at `place` (d,) may stand beside a plane, by its free axes: biases z, the other side first.

    None where these axes do not lead there, or it lies `FAR` scales off. A path is a plane by least squares only: how
    exactly a node is reflected does not matter, since it settles there.
    """
    normal, scales = plane.normal[[problem.biases[m].axis for m in members]], problem.scales[members]
    if normal @ normal < LEVEL:
        return []
    now = float(plane.distance(place))
    reach = NEAR * float(np.linalg.norm(normal * scales) / np.sqrt(normal @ normal))
    wanted = [-now] if abs(now) > reach else [-now, reach, -reach]
    found = [z[members] + (there - now) * normal / (normal @ normal) / scales for there in wanted]
    return [own for own in found if np.abs(own).max() < FAR and np.abs(own - z[members]).max() > SHIFTED]


@dataclass(frozen=True)
class _Own:
    """Which biases and which data are those of one node alone, of K nodes."""

    biases: np.ndarray  # (K, P), M of none
    place: np.ndarray  # (M + 1, 2) node and position in `biases` of each bias, -1 of none
    nodes: list[np.ndarray]  # of each block the nodes (N, p) of the sensor of each row, -1 of none
    count: np.ndarray  # (K,) data

    @classmethod
    def of(cls, problem: Problem, names: list[str], heard: list[np.ndarray]) -> "_Own":
        """Of named nodes: their own biases, and those of sensors that have no other node."""
        number, M = {name: k for k, name in enumerate(names)}, problem.model.biases
        alone = {sensor.name: sensor.nodes[0].name for sensor in problem.network.sensors if len(sensor.nodes) == 1}
        lists: list[list[int]] = [[] for _ in names]
        place = np.full((M + 1, 2), -1)
        for m, bias in enumerate(problem.biases):
            k = number.get(bias.owner, number.get(alone.get(bias.owner, ""), -1))
            if k >= 0:
                place[m] = k, len(lists[k])
                lists[k].append(m)
        biases = np.full((len(names), max(map(len, lists))), M)
        for k, listed in enumerate(lists):
            biases[k, : len(listed)] = listed
        data = problem.model.rows
        nodes = [own[np.asarray(rows.sensor)] for own, rows in zip(heard, data, strict=True)]
        count = np.zeros(len(names))
        for own, rows in zip(nodes, data, strict=True):
            _add(count, own, np.asarray(rows.mask).sum(1))
        return cls(biases, place, nodes, count)

    def of_node(self, k: int) -> np.ndarray:
        """Biases of one node."""
        return self.biases[k][self.biases[k] < len(self.place) - 1]

    def settled(self, model: Model, point: Point, z: np.ndarray, moving: list[int]) -> tuple[np.ndarray, np.ndarray]:
        """Biases (M,) after all steps of some nodes, and the information (moving, P, P) about those of each."""
        for _ in range(STEPS):
            z, information = self.step(model, point, z, moving)
        return z, information

    def losses(self, model: Model, point: Point, z: np.ndarray) -> np.ndarray:
        """Cost (K,) of the data of each node and of its own biases under their scales."""
        found = 0.5 * np.sum(np.append(z, 0.0)[self.biases] ** 2, 1)
        for own, loss in zip(self.nodes, _by_row(model, point, jnp.asarray(z)), strict=True):
            _add(found, own, np.nan_to_num(np.asarray(loss), nan=1e9, posinf=1e9))
        return found

    def step(
        self, model: Model, point: Point, z: np.ndarray, moving: list[int]
    ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
        """Biases (M,) after a Gauss-Newton step of some nodes each by itself, tracks and other biases held.

        And the information (moving, P, P) about the biases of each, that of their scales with it.
        """
        (K, P), M = self.biases.shape, len(z)
        number = np.full(K + 1, -1)
        number[moving] = np.arange(len(moving))
        node = number[self.place[:, 0]]  # (M + 1,) which of those that move, by bias
        size = len(moving) * P * P
        much, pull = np.zeros(size), -np.append(z, 0.0)[self.biases[moving]].ravel()
        for read, lin in zip(model.read, _linearised(model, point, jnp.asarray(z)), strict=True):
            on = np.flatnonzero((node[np.asarray(read)] >= 0).any(1))
            read, slope, weight, score = (np.asarray(own)[on] for own in (read, lin.bias, lin.weight, lin.score))
            whose, at = node[read], self.place[read, 1]
            for a in range(read.shape[1]):
                mine = whose[:, a] >= 0
                first = whose[:, a] * P + at[:, a]
                pull += np.bincount(first[mine], np.sum(score * slope[:, :, a], 1)[mine], len(pull))
                for b in range(read.shape[1]):
                    both = mine & (whose[:, b] == whose[:, a])
                    own = np.sum(weight * slope[:, :, a] * slope[:, :, b], 1)
                    much += np.bincount((first * P + at[:, b])[both], own[both], size)
        information = much.reshape(-1, P, P) + np.eye(P)
        change = solve_square(information, pull.reshape(-1, P, 1))[:, :, 0]
        change *= STRIDE / np.maximum(np.abs(np.nan_to_num(change)).max(1, keepdims=True), STRIDE)
        after = np.append(z, 0.0)
        after[self.biases[moving]] += np.nan_to_num(change)
        return after[:M], information


def _add(total: np.ndarray, node: np.ndarray, value: np.ndarray) -> None:
    """Add a value (N,) of each row to the total (K,) of each of its nodes (N, p), -1 of none."""
    for slot in range(node.shape[1]):
        mine = node[:, slot] >= 0
        np.add.at(total, node[mine, slot], value[mine])


def _heard(problem: Problem, first: list[int]) -> list[np.ndarray]:
    """Of each block which nodes (S, p) each sensor has, -1 for what is none; `first` is a bias of each node."""
    key = np.full(problem.model.biases + 1, -1)
    key[first] = np.arange(len(first))
    return [key[np.asarray(data.bias)] for data in problem.model.rows]


def _paths(problem: Problem, point: Point, heard: list[np.ndarray], place: np.ndarray) -> Iterator[tuple[int, Plane]]:
    """Line (in 3-D plane) of least squares of the places of targets that each node hears, `place` (nodes, d) theirs."""
    d, n, model = problem.network.dimension, len(place), problem.model
    count, total, square = np.zeros(n), np.zeros((n, d)), np.zeros((n, d, d))
    places = problem.positions(point.states)
    for _, data, r, own in model.each_block(heard):
        there = places[r][np.asarray(data.epoch)]
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
    values, axes = spectrum(square[enough] / count[enough, None, None] - mean[:, :, None] * mean[:, None, :])
    for k, centre, value, axis in zip(enough.tolist(), mean, values, axes, strict=True):
        if value[-1] > STILL**2 * np.sum(centre**2):
            yield k, Plane("its path", place[k] + centre, axis[:, 0])


def _parted(heard: list[np.ndarray], moved: list[int]) -> list[list[int]]:
    """Nodes that are moved in sets of which no sensor has two."""
    beside: dict[int, set[int]] = {k: set() for k in moved}
    for own in heard:
        for sensor in np.unique(own, axis=0):
            both = [k for k in sensor.tolist() if k in beside]
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


@jax.jit
def _by_row(model: Model, point: Point, z: jax.Array) -> tuple[jax.Array, ...]:
    """Negative log-likelihood (N,) of the rows of each block."""
    return tuple(-jnp.sum(own, 1) for own in model.log_likelihood(At(point.states, z, point.levels)))


@jax.jit
def _linearised(model: Model, point: Point, z: jax.Array) -> tuple[Linearised, ...]:
    return model.linearise_biases(At(point.states, z, point.levels), expected=False)
