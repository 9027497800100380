"""Messages of belief propagation between vertices: Gaussian by the curvature of the potentials, or kernel mixtures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from probcal.linalg import marginalise, root_of, solve_square, spectrum
from probcal.tracking.poses.search import Potential
from probcal.tracking.poses.vertices import Vertex

MESSAGES = ("gaussian", "kernel")
MOVED = 0.3  # sds of an edge by which its biases move before it is expanded anew
POINTS = 200  # pairs of points of a kernel mixture
FLOOR = 1e-12
HEAVY = 0.1  # share of the points that must count, else their weights are tempered


class Belief(NamedTuple):
    """Mean (p,) and covariance (p, p) of the biases of a vertex, and points (L, p) of equal weight where they are."""

    mean: np.ndarray
    covariance: np.ndarray
    points: Any = None


class Edge(NamedTuple):
    """Two vertices and their potential, whose biases are those of the first and then of the second."""

    first: int
    second: int
    potential: Potential


def _normal(precision: np.ndarray, pull: np.ndarray) -> Belief:
    """The Gaussian exp(-x'Px/2 + x'h)."""
    covariance = solve_square(precision, np.eye(len(pull)))
    return Belief(covariance @ pull, 0.5 * (covariance + covariance.T))


def _forms(belief: Belief) -> tuple[np.ndarray, np.ndarray]:
    """Precision and pull of a belief."""
    precision = solve_square(belief.covariance, np.eye(len(belief.mean)))
    return precision, precision @ belief.mean


class Normals:
    """Gaussian messages: each potential is expanded where the beliefs are, and again where they have moved."""

    def __init__(self, vertices: Sequence[Vertex], edges: Sequence[Edge]):
        self.vertices, self.edges = vertices, edges
        self.beliefs: dict[int, Belief] = {}
        self.expanded: dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}  # place, information, pull
        self.sent: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = {}  # edge, to: precision, pull

    def step(self, beliefs: dict[int, Belief], z: np.ndarray) -> float:
        """One message each way along every edge, all at once; returns how far a mean moved, in sds, or a sd."""
        before = dict(beliefs)
        for e, edge in enumerate(self.edges):
            self._expand(e, z[edge.potential.at])
        sent = {}
        for e, edge in enumerate(self.edges):
            place, H, pull = self.expanded[e]
            p = len(self.vertices[edge.first].at)
            first, second = slice(0, p), slice(p, len(place))
            ways = (edge.first, first, edge.second, second), (edge.second, second, edge.first, first)
            for source, mine, to, theirs in ways:
                if not len(place[theirs]):
                    continue
                precision, h = self._gathered(source, e) if self.sent else _forms(before[source])
                whole = H.copy()
                whole[mine, mine] += precision
                left, gain = marginalise(whole, theirs, 0.0)
                sent[e, to] = left, pull[theirs] - gain.T @ (pull[mine] + h)
        self.sent |= sent
        moved = 0.0
        for v, old in before.items():
            new = _normal(*self._gathered(v, None)) if len(old.mean) else old
            sd, was = (np.sqrt(np.diagonal(one.covariance)) for one in (new, old))
            changed = np.maximum(np.abs(new.mean - old.mean) / sd, np.abs(np.log(sd / was)))
            moved = max(moved, float(np.max(changed, initial=0.0)))
            self.beliefs[v] = new
        return moved

    def _gathered(self, v: int, without: int | None) -> tuple[np.ndarray, np.ndarray]:
        """Precision and pull of a vertex by its prior and what it was sent, but along one edge."""
        p = len(self.vertices[v].at)
        precision, pull = np.eye(p), np.zeros(p)
        for (e, to), (P, h) in self.sent.items():
            if to == v and e != without:
                precision, pull = precision + P, pull + h
        return precision, pull

    def _expand(self, e: int, place: np.ndarray) -> None:
        if e in self.expanded:
            old, H, _ = self.expanded[e]
            away = place - old
            if away @ H @ away < MOVED**2 * len(place):
                return
        _, slope, H = self.edges[e].potential.expanded(place)
        self.expanded[e] = place, H, slope + H @ place


class Kernels:
    """Kernel mixtures (Separable likelihoods 12 to 14): an edge is known at pairs of points drawn from both beliefs."""

    def __init__(self, vertices: Sequence[Vertex], edges: Sequence[Edge], rng: np.random.Generator):
        self.vertices, self.edges, self.rng = vertices, edges, rng
        self.beliefs: dict[int, Belief] = {}

    def step(self, beliefs: dict[int, Belief], z: np.ndarray) -> float:
        """New points of every vertex by the messages of its neighbours; returns how far a mean moved, in sds."""
        rng, points = self.rng, {}
        for v, belief in beliefs.items():
            points[v] = belief.points
            if belief.points is None:
                root = root_of(belief.covariance)
                points[v] = belief.mean + rng.standard_normal((POINTS, len(belief.mean))) @ root.T
        sent: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {v: [] for v in beliefs}
        for edge in self.edges:
            u, v = edge.first, edge.second
            pairs = np.concatenate([points[u], points[v][rng.permutation(POINTS)]], 1)
            value = edge.potential.values(pairs)
            p = points[u].shape[1]
            for to, own in ((u, pairs[:, :p]), (v, pairs[:, p:])):
                if own.shape[1]:
                    sent[to].append((own, value - _log_density(own, own, np.ones(POINTS) / POINTS)))
        moved = 0.0
        for v, old in beliefs.items():
            if not len(old.mean) or not sent[v]:
                self.beliefs[v] = old._replace(points=points[v])
                continue
            self.beliefs[v] = self._product(sent[v])
            sd = np.sqrt(np.diagonal(self.beliefs[v].covariance))
            moved = max(moved, float(np.max(np.abs(self.beliefs[v].mean - old.mean) / sd)))
        return moved

    def _product(self, messages: list[tuple[np.ndarray, np.ndarray]]) -> Belief:
        """Points of the product of the prior and the messages, drawn from their mixture and weighed."""
        rng = self.rng
        weighed = [(own, _tempered(value)) for own, value in messages]
        drawn = np.concatenate([
            own[rng.choice(POINTS, POINTS, p=w)] + rng.standard_normal(own.shape) @ root_of(_width(own, w)).T
            for own, w in weighed
        ])  # fmt: skip
        logs = np.stack([_log_density(drawn, own, w) for own, w in weighed])
        mixture = np.logaddexp.reduce(logs, 0) - np.log(len(logs))
        weight = _tempered(logs.sum(0) - 0.5 * np.sum(drawn**2, 1) - mixture)
        mean = weight @ drawn
        off = drawn - mean
        covariance = (off * weight[:, None]).T @ off + FLOOR * np.eye(len(mean))
        return Belief(mean, covariance, drawn[rng.choice(len(drawn), POINTS, p=weight)])


def _tempered(value: np.ndarray) -> np.ndarray:
    """Weights exp(power value) that add up to one, the power 1 or such that a share of them counts."""
    low, high, whole = 0.0, 1.0, np.exp(value - value.max())
    if whole.sum() ** 2 / np.sum(whole**2) > HEAVY * len(value):
        return whole / whole.sum()
    for _ in range(40):
        power = 0.5 * (low + high)
        w = np.exp(power * (value - value.max()))
        low, high = (power, high) if w.sum() ** 2 / np.sum(w**2) > HEAVY * len(value) else (low, power)
    w = np.exp(low * (value - value.max()))
    return w / w.sum()


def _width(points: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Covariance (p, p) of the kernel: the rule of Silverman for points of these weights."""
    L, p = 1.0 / np.sum(weight**2), points.shape[1]
    off = points - weight @ points
    factor = (4.0 / ((p + 2.0) * L)) ** (1.0 / (p + 4.0))
    return factor**2 * (off * weight[:, None]).T @ off + FLOOR * np.eye(p)


def _log_density(at: np.ndarray, points: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Log density (N,) of a kernel mixture, up to nothing."""
    width = _width(points, weight)
    lengths, axes = spectrum(width)
    white = axes / np.sqrt(lengths)
    square = np.sum(((at @ white)[:, None] - (points @ white)[None]) ** 2, 2)
    logs = np.log(np.maximum(weight, 1e-300))[None] - 0.5 * square
    return np.logaddexp.reduce(logs, 1) - 0.5 * np.sum(np.log(2.0 * np.pi * lengths))
