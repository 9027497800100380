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
from probcal.model.model import At, Data, Model
from probcal.model.rows import LinearRows
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


def crossed_nodes(problem: Problem, point: Point, most: float = np.inf) -> Iterator[Candidate]:
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
                    drop[k], settled[k] = worth[k], other[own.of_node(k, len(z))]
    better = [[k for k in together if drop[k] < 0.0] for together in sets]
    if len(most_of := max(better, key=len)) > 1:
        whole = z.copy()
        for k in most_of:
            whole[own.of_node(k, len(z))] = settled[k]
        name = f"{len(most_of)} nodes elsewhere beside the paths that they hear"
        yield Candidate(name, NODE, point._replace(z=jax.device_put(whole)))
    for k in sorted(settled, key=lambda k: drop[k]):
        if drop[k] < min(WORSE * own.count[k], most):
            other = z.copy()
            other[own.of_node(k, len(z))] = settled[k]
            now = node_places(problem, other)[names[k]]
            crossed = paths[k].distance(now) * paths[k].distance(place[names[k]]) < 0
            where = "on the other side of the path" if crossed else "elsewhere beside the path"
            yield Candidate(f'node "{names[k]}" {where} that it hears', NODE, point._replace(z=jax.device_put(other)))


def _starts(
    problem: Problem, z: np.ndarray, place: np.ndarray, members: list[int], plane: Plane
) -> list[np.ndarray]:  # fmt: skip
    """The starts z of a node at `place` (d,) near a plane, by its free axes, the reflection first.

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
    """The biases and the data that belong to one node alone, for each of K nodes."""

    biases: np.ndarray  # (K, P), M of none
    nodes: list[np.ndarray]  # of each block the nodes (N, p) of the sensor of each row, -1 of none
    count: np.ndarray  # (K,) data

    @classmethod
    def of(cls, problem: Problem, names: list[str], heard: list[np.ndarray]) -> "_Own":
        """Of named nodes: their own biases, and those of sensors that have no other node."""
        alone = {sensor.name: sensor.nodes[0].name for sensor in problem.network.sensors if len(sensor.nodes) == 1}
        lists: dict[str, list[int]] = {name: [] for name in names}
        for m, bias in enumerate(problem.biases):
            lists.get(bias.owner, lists.get(alone.get(bias.owner, ""), [])).append(m)
        biases = np.full((len(names), max(map(len, lists.values()))), problem.model.biases)
        for row, own in zip(biases, lists.values(), strict=True):
            row[: len(own)] = own
        data = problem.model.rows
        nodes = [own[np.asarray(rows.sensor)] for own, rows in zip(heard, data, strict=True)]
        counts = [np.asarray(rows.mask).sum(1) for rows in data]
        return cls(biases, nodes, _by_node(nodes, counts, len(names)))

    def of_node(self, k: int, M: int) -> np.ndarray:
        """Biases of one node, of M biases."""
        return self.biases[k][self.biases[k] < M]

    def losses(self, model: Model, point: Point, z: np.ndarray) -> np.ndarray:
        """Cost (K,) of the data of each node and of its own biases under their scales."""
        found = [
            np.nan_to_num(loss, nan=1e9, posinf=1e9)
            for loss in map(np.asarray, _by_row(model, point, jax.device_put(z)))
        ]
        own = 0.5 * np.sum(np.append(z, 0.0)[self.biases] ** 2, 1)
        return own + _by_node(self.nodes, found, len(own))

    def settled(self, model: Model, point: Point, z: np.ndarray, moving: list[int]) -> tuple[np.ndarray, np.ndarray]:
        """Biases (M,) after Gauss-Newton steps of some nodes each by itself, tracks and other biases held.

        And the information (moving, P, P) about the biases of each at the last step, that of their scales with it. No
        sensor has two of these nodes, so that a node's information is its block of that of all biases.
        """
        own, after, node = self.biases[moving], np.append(z, 0.0), np.full(len(z) + 1, -1)
        node[own] = np.arange(len(own))[:, None]
        node[-1] = -1
        each = [node[np.asarray(read)].max(1, initial=-1) for read in model.read]  # the node of each row, -1 of none
        information = np.eye(own.shape[1])
        for _ in range(STEPS):
            information, pull = np.tile(np.eye(own.shape[1]), (len(own), 1, 1)), -after[own]
            linearised = _linearised(model, point, jax.device_put(after[:-1]))
            for read, k, lin in zip(model.read, each, linearised, strict=True):
                on = np.flatnonzero(k >= 0)
                k, read, along, weight, score = (np.asarray(x)[on] for x in (k, read, lin.bias, lin.weight, lin.score))
                slope = along @ (read[:, :, None] == own[k][:, None, :])
                np.add.at(information, k, np.einsum("nc,nca,ncb->nab", weight, slope, slope))
                np.add.at(pull, k, np.einsum("nc,nca->na", score, slope))
            change = np.nan_to_num(solve_square(information, pull[:, :, None])[:, :, 0])
            after[own] += change * STRIDE / np.maximum(np.abs(change).max(1, keepdims=True), STRIDE)
        return after[:-1], information


def _by_node(nodes: list[np.ndarray], values: list[np.ndarray], count: int) -> np.ndarray:
    """Total (count,) of the values (N,) of each row over its nodes (N, p), -1 of none."""
    total = np.zeros(count + 1)
    for own, value in zip(nodes, values, strict=True):
        np.add.at(total, own, value[:, None])
    return total[:count]


def _heard(problem: Problem, first: list[int]) -> list[np.ndarray]:
    """Of each block which nodes (S, p) each sensor has, -1 for what is none; `first` is a bias of each node."""
    key = np.full(problem.model.biases + 1, -1)
    key[first] = np.arange(len(first))
    return [key[np.asarray(data.bias)] for data in problem.model.rows]


def _paths(problem: Problem, point: Point, heard: list[np.ndarray], place: np.ndarray) -> Iterator[tuple[int, Plane]]:
    """Line (in 3-D plane) of least squares of the places of targets that each node hears, `place` (nodes, d) theirs."""
    seen: list[list[np.ndarray]] = [[] for _ in place]
    places = problem.positions(point.states)
    for _, data, r, own in problem.model.each_block(heard):
        used, node = np.asarray(data.mask).any(1), own[np.asarray(data.sensor)]
        for k in np.unique(node[node >= 0]):
            mine = np.flatnonzero((node == k) & used[:, None]) // node.shape[1]
            seen[k].append(places[r][np.asarray(data.epoch)[mine]] - place[k])
    for k, parts in enumerate(seen):
        away = np.concatenate([np.zeros((0, place.shape[1])), *parts])
        if len(away) < FEW:
            continue
        centre = away.mean(0)
        value, axis = spectrum(away.T @ away / len(away) - np.outer(centre, centre))
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
def _by_row(model: Model, point: Point, z: jax.Array) -> Data:
    """Negative log-likelihood (N,) of the rows of each block."""
    return tuple(-jnp.sum(own, 1) for own in model.log_likelihood(At(point.states, z, point.levels)))


@jax.jit
def _linearised(model: Model, point: Point, z: jax.Array) -> LinearRows:
    return model.linearise_biases(At(point.states, z, point.levels), expected=False)
