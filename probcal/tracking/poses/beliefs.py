"""Poses of a network by belief propagation: each pair of sensors tells how they stand, and the graph what follows.

A Markov random field over the vertices of `vertices.py`, its edge potentials separable likelihoods (Separable
likelihoods 7 to 11). First a tree grows from what is known, each vertex searched for by one that is placed; then
messages go along all edges until no belief moves.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from probcal.tracking.poses.messages import Belief, Edge, Kernels, Normals
from probcal.tracking.poses.search import Peak, Potential, search
from probcal.tracking.poses.vertices import Graph

DECISIVE = 10.0  # nats of evidence over no common object from which a pair tells how it stands
STRONG = 0.2  # of the most evidence of a hop that is enough to be placed in it
RIVAL = 15.0  # nats within which another mode may be the right one: a pair counts its detections twice
TRIED = 4  # placed vertices by which one is searched for at most
NEIGHBOURS = 4  # edges of a vertex, besides those that others choose
NEAR = 16  # vertices that are looked at for one, the nearest


@dataclass
class Field:
    """Beliefs of all vertices while they are found."""

    graph: Graph
    z: np.ndarray  # (M,) means; 0 where nothing is known
    beliefs: dict[int, Belief] = field(default_factory=dict)  # of the vertices that are placed
    rivals: dict[int, list[Peak]] = field(default_factory=dict)  # other modes that explain as much
    tree: list[tuple[int, int, float]] = field(default_factory=list)
    edges: list[tuple[int, int, float]] = field(default_factory=list)
    trace: list[dict[str, Any]] = field(default_factory=list)
    rests: bool = False
    begun: float = field(default_factory=time.perf_counter)

    def put(self, v: int, belief: Belief) -> None:
        """Take a belief of a vertex."""
        self.beliefs[v] = belief
        self.z[self.graph.vertices[v].at] = belief.mean

    def note(self, iteration: int, phase: str) -> None:
        """Keep where the beliefs are, and since when."""
        seconds = time.perf_counter() - self.begun
        for v, belief in self.beliefs.items():
            sd = np.sqrt(np.diagonal(belief.covariance))
            for m, mean, one in zip(self.graph.vertices[v].at, belief.mean, sd, strict=True):
                self.trace.append({
                    "iteration": iteration, "phase": phase, "seconds": seconds, "bias": int(m), "mean": mean, "sd": one
                })  # fmt: skip


def spread_beliefs(graph: Graph, seed: int, iterations: int, messages: str, tolerance: float) -> Field:
    """Beliefs after a tree phase and at most `iterations` in all."""
    rng = np.random.default_rng(seed)
    found = Field(graph, np.zeros(len(graph.problem.labels)))
    roots = [v for v, vertex in enumerate(graph.vertices) if vertex.known]
    for v in roots or [_best_known(graph)]:
        p = len(graph.vertices[v].at)
        found.put(v, Belief(np.zeros(p), np.eye(p)))
    hops = _grow(found, rng)
    edges = _edges(found)
    passing = Kernels(graph.vertices, edges, rng) if messages == "kernel" else Normals(graph.vertices, edges)
    for k in range(hops, iterations):
        moved = passing.step(found.beliefs, found.z)
        for v, belief in passing.beliefs.items():
            found.put(v, belief)
        found.note(k + 1, "loopy")
        if moved < tolerance and k > hops:  # the first messages know of the priors alone
            found.rests = True
            break
    check_rivals(found, edges)
    return found


def _best_known(graph: Graph) -> int:
    """The vertex whose position is stated best, where none is known."""
    scales = graph.problem.scales
    parts = [[m for m in v.at if graph.problem.biases[m].component == "position"] for v in graph.vertices]
    return int(np.argmin([np.max(scales[own]) if own else 0.0 for own in parts]))


def _grow(found: Field, rng: np.random.Generator) -> int:
    """Place vertices from those that are placed, a hop an iteration; returns the hops."""
    graph = found.graph
    tried: set[tuple[int, int]] = set()
    kept: dict[int, tuple[list[Peak], int]] = {}
    hop = 0
    while True:
        placed, fresh = list(found.beliefs), list[int]()
        for v in range(len(graph.vertices)):
            if v in found.beliefs:
                continue
            near = graph.nearest(v, placed, np.zeros_like(found.z))[:NEAR]
            worth = sorted(((graph.common(u, v), u) for u in near if (u, v) not in tried), key=lambda pair: -pair[0])
            ways = [u for common, u in worth if common > 0]
            for u in ways[: TRIED - sum(pair[1] == v for pair in tried)]:
                tried.add((u, v))
                vertex = graph.vertices[v]
                modes = search(graph.potential(u, v, found.z, vertex.at), rng)
                if modes and (v not in kept or modes[0].evidence > kept[v][0][0].evidence):
                    kept[v] = (modes, u)
                if v in kept and _clear(kept[v][0]):
                    break
            if v in kept and _clear(kept[v][0]):
                fresh.append(v)
        best = max((kept[v][0][0].evidence for v in fresh), default=0.0)
        fresh = [v for v in fresh if kept[v][0][0].evidence >= STRONG * best]  # the others may be told better later
        if not fresh:  # what is not clear is taken where nothing clearer comes
            open_ = [v for v, (modes, _) in kept.items() if v not in found.beliefs and modes[0].evidence > DECISIVE]
            fresh = open_[:1]
        if not fresh:
            return hop
        hop += 1
        for v in fresh:
            modes, u = kept[v]
            found.put(v, Belief(modes[0].theta, modes[0].covariance))
            found.rivals[v] = [mode for mode in modes[1:] if mode.evidence > modes[0].evidence - RIVAL]
            found.tree.append((u, v, modes[0].evidence))
        found.note(hop, "tree")


def _clear(modes: list[Peak]) -> bool:
    """True if a search has one answer."""
    return modes[0].evidence > DECISIVE and all(mode.evidence < modes[0].evidence - RIVAL for mode in modes[1:])


def _edges(found: Field) -> list[Edge]:
    """The edges of the loopy phase: for each vertex those that tell most where the beliefs stand now."""
    graph, placed = found.graph, sorted(found.beliefs)
    gains: dict[tuple[int, int], tuple[float, Potential]] = {}
    near = {(min(u, v), max(u, v)) for v in placed for u in graph.nearest(v, placed, found.z)[:NEAR]}
    for u, v in sorted(near | {(min(u, v), max(u, v)) for u, v, _ in found.tree}):
        at = np.concatenate([graph.vertices[u].at, graph.vertices[v].at])
        if len(at) and graph.common(u, v) > 0:
            potential = graph.potential(u, v, found.z, at)
            gains[u, v] = float(potential.values(found.z[at][None])[0]), potential
    chosen: set[tuple[int, int]] = set()
    for v in placed:
        mine = sorted((pair for pair in gains if v in pair), key=lambda pair: -gains[pair][0])
        chosen |= {pair for pair in mine[:NEIGHBOURS] if gains[pair][0] > DECISIVE}
    chosen |= {pair for u, v, _ in found.tree if (pair := (min(u, v), max(u, v))) in gains}
    found.edges = [(*pair, gains[pair][0]) for pair in sorted(chosen)]
    return [Edge(*pair, gains[pair][1]) for pair in sorted(chosen)]


def check_rivals(found: Field, edges: list[Edge]) -> None:
    """Of the other modes keep those that all edges together do not refute."""
    for v, modes in found.rivals.items():
        mine = [edge for edge in edges if v in (edge.first, edge.second)]
        at = found.graph.vertices[v].at
        kept = []
        for mode in modes:
            z, total = found.z.copy(), 0.0
            z[at] = mode.theta
            for edge in mine:
                there = edge.potential.at
                here, other = edge.potential.values(np.stack([found.z[there], z[there]]))
                total += float(other - here)
            if total > -RIVAL:
                kept.append(mode)
        found.rivals[v] = kept
