"""A network as a graph: sensors that share biases are one vertex, and an edge is what two vertices tell each other."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import jax
import numpy as np

from probcal.network import ANGLES
from probcal.problem import Problem
from probcal.tracking.bernoulli import filter_tracks
from probcal.tracking.phd import Intensity, filter_intensity
from probcal.tracking.poses.local import Alone, each_alone
from probcal.tracking.poses.quad import paired
from probcal.tracking.poses.search import Potential, Term
from probcal.tracking.poses.separable import explained, matched_scans
from probcal.tracking.update import Biases, Chances

POSE = ("position", *ANGLES)
MOST = 8  # components of a mixture that explain another sensor


@dataclass(frozen=True, eq=False)
class Vertex:
    """Sensors with the biases `at` (p,) of z that they read; `known` where none of these is of a pose."""

    name: str
    sensors: tuple[int, ...]
    at: np.ndarray
    known: bool


@dataclass(frozen=True, eq=False)
class Graph:
    """The sensors by themselves, what each knows after its own scans, and the vertices that they form."""

    problem: Problem
    sensors: list[Alone]
    after: list[Intensity]
    count: list[np.ndarray]  # (K,) of objects that a sensor holds
    vertices: list[Vertex]
    window: float
    lifetime: float
    terms: str
    held: dict[tuple[int, int], float] = field(default_factory=dict)  # of `common`

    @cached_property
    def placed(self) -> dict[str, Any]:
        """The sensors as they are placed, by name."""
        return {sensor.name: sensor for sensor in self.problem.network.sensors}

    def nearest(self, v: int, others: list[int], z: np.ndarray) -> list[int]:
        """Other vertices, those first whose nodes stand nearest to its own at biases z."""
        scales, biases = self.problem.scales, self.problem.biases
        moved = {(b.owner, b.axis): z[m] * scales[m] for m, b in enumerate(biases) if b.component == "position"}

        def place(u: int) -> np.ndarray:
            node = self.placed[self.sensors[self.vertices[u].sensors[0]].name].nodes[0]
            return node.position + [moved.get((node.name, axis), 0.0) for axis in range(node.dimension)]

        return sorted((u for u in others if u != v), key=lambda u: float(np.sum((place(u) - place(v)) ** 2)))

    def common(self, u: int, v: int) -> float:
        """Scans of the sensors of two vertices that have a partner, each counted by the objects that both hold."""
        if (u, v) in self.held:
            return self.held[u, v]
        total = 0.0
        for i in self.vertices[u].sensors:
            for j in self.vertices[v].sensors:
                for a, b in ((i, j), (j, i)):
                    one, other = self.sensors[a], self.sensors[b]
                    pair = matched_scans(one, other, self.window, before=True)
                    held = np.minimum(self.count[a], self.count[b][pair])
                    total += float(np.sum(held[pair >= 0]))
        self.held[u, v] = self.held[v, u] = total
        return total

    def pair(self, i: int, j: int, z: np.ndarray, at: np.ndarray) -> Potential:
        """The potential between two sensors, as a function of the biases z[at]."""
        terms, quad = [], []
        settings = self.window, self.lifetime
        for a, b in ((i, j), (j, i)):
            one, other = self.sensors[a], self.sensors[b]
            dual = self.terms == "dual"
            each = explained(self.problem, one, other, self.after[b], self.count[a], *settings, before=dual)
            terms.append(Term(each, one.views, 1.0 if dual else 0.5))
        if self.terms == "quad":
            quad.append(paired(self.problem, self.sensors[i], self.sensors[j], self.after[i], self.after[j], *settings))
        return Potential(tuple(terms), z, at, self._periods(at), tuple(quad))

    def _periods(self, at: np.ndarray) -> np.ndarray:
        """Period (p,) of each bias in its scale, inf where it is no angle of a node."""
        biases, scales = self.problem.biases, self.problem.scales
        return np.array([2 * np.pi / scales[m] if biases[m].component in ANGLES else np.inf for m in at])

    def potential(self, u: int, v: int, z: np.ndarray, at: np.ndarray) -> Potential:
        """The potential between the sensors of two vertices, as a function of the biases z[at]."""
        own, others = self.vertices[u].sensors, self.vertices[v].sensors
        parts = [self.pair(i, j, z, at) for i in own for j in others]
        terms = tuple(term for part in parts for term in part.terms)
        return Potential(terms, z, at, self._periods(at), tuple(each for part in parts for each in part.quad))


def graph_of(
    problem: Problem, chances: Chances, cloud: Any, most: int, window: float | None, terms: str = "dual"
) -> Graph:
    """Filter every sensor by itself and find the vertices; quad terms take tracks, dual ones an intensity."""
    sensors = each_alone(problem)
    vertices = vertices_of(problem, [one.name for one in sensors])
    M = len(problem.labels)
    pose = np.array([bias.component in POSE for bias in problem.biases], bool)
    covariance = np.diag(np.where(pose, 0.0, 1.0))  # a sensor measures in its own axes, wherever it stands
    known = Biases(*jax.device_put((np.zeros(M), covariance, np.zeros(len(problem.levels)))))
    after, count = [], []
    for one in sensors:
        if terms == "dual":
            held = jax.device_get(filter_intensity(one.watch, one.views, known, chances, cloud, most).after)
        else:
            held = Intensity(
                *jax.device_get(filter_tracks(one.watch, one.views, known, chances, cloud, most).after[:3])
            )
        heavy = np.argsort(-held.weight, axis=1)[:, :MOST]
        after.append(held._replace(**{name: _taken(leaf, heavy) for name, leaf in held._asdict().items()}))
        count.append(held.weight.sum(1))
    if window is None:
        gaps = [np.median(np.diff(one.time[one.there])) for one in sensors if one.there.sum() > 1]
        window = 3.0 * float(max(gaps, default=1.0))
    return Graph(problem, sensors, after, count, vertices, window, float(chances.lifetime), terms)


def _taken(leaf: np.ndarray, which: np.ndarray) -> np.ndarray:
    return np.take_along_axis(leaf, which.reshape(which.shape + (1,) * (leaf.ndim - 2)), 1)


def vertices_of(problem: Problem, names: list[str]) -> list[Vertex]:
    """Sensors joined where they read the same bias of a node; biases of a type or of a time belong to none."""
    placed = {sensor.name: sensor for sensor in problem.network.sensors}
    reads: list[set[int]] = []
    for name in names:
        owners = {name, *(node.name for node in placed[name].nodes)}
        reads.append({m for m, bias in enumerate(problem.biases) if bias.owner in owners and bias.since is None})
    groups: list[tuple[set[int], list[int]]] = []
    for s, own in enumerate(reads):
        joined = [group for group in groups if group[0] & own]
        groups = [group for group in groups if not group[0] & own]
        biases = own.union(*(group[0] for group in joined))
        groups.append((biases, sorted([s, *(other for group in joined for other in group[1])])))
    groups.sort(key=lambda group: group[1])
    found = []
    for biases, sensors in groups:
        pose: Any = [problem.biases[m].component in POSE for m in biases]
        name = " and ".join(names[s] for s in sensors)
        found.append(Vertex(name, tuple(sensors), np.array(sorted(biases), int), not any(pose)))
    return found
