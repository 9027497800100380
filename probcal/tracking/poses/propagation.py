"""Poses of sensors from detections without names, as tables: `propagate_beliefs`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from probcal.errors import InputError, nearest
from probcal.lazy import pd
from probcal.problem import Problem
from probcal.tracking.entry import asked, cloud_of
from probcal.tracking.poses.beliefs import Field, spread_beliefs
from probcal.tracking.poses.messages import MESSAGES
from probcal.tracking.poses.separable import TERMS
from probcal.tracking.poses.vertices import Graph, graph_of
from probcal.types import float64


@dataclass(frozen=True, eq=False)
class Beliefs:
    """The beliefs from all detections: bias means z (M,) and covariance (M, M), in scales.

    Each detection counts in the likelihood of every pair of its sensor; the covariance is widened by the number of
    pairs. `sensors` has a line a vertex (sensors that share a node), how it was placed and with which evidence, in nats
    over no object in common; `edges` the pairs; `trace` mean and sd of every bias by iteration, in units, and seconds
    since the first search. `apart` names those that no pair places, `rivals` counts for each other how many poses
    explain as much. `rests` says whether the beliefs came to rest.
    """

    z: np.ndarray
    covariance: np.ndarray
    sensors: pd.DataFrame
    edges: pd.DataFrame
    trace: pd.DataFrame
    apart: tuple[str, ...]
    rivals: dict[str, int]
    iterations: int
    rests: bool


@float64
def propagate_beliefs(
    problem: Problem,
    *,
    iterations: int = 15,
    messages: str = "gaussian",
    terms: str = "dual",
    window: float | None = None,
    tolerance: float = 0.05,
    objects: float = 3.0,
    births: float = 0.02,
    lifetime: float = 600.0,
    most: int = 16,
    key: int = 0,
) -> Beliefs:
    """Find where sensors stand from detections that name no object, by belief propagation over their pairs.

    Every sensor is filtered alone (`phd_filter`, settings as there). For a pair the separable likelihood says how well
    the objects of one explain the detections of the other, wherever the two stand (Uney, Mulgrew, Clark 2016; Separable
    likelihoods 4, `terms="quad"` 6), on scans of both within `window` s (15, 16; three times the longest time between
    two scans by default). A tree grows from the sensors of known pose, each searched for within its prior; then
    `messages`, "gaussian" or "kernel" mixtures (10 to 14), go along all edges for at most `iterations`, until no mean
    moves by more than `tolerance` sds. Raises `InputError` where rows name their targets, or a setting is none.

    >>> seen = probcal.Detection(0.9, clutter=0.1, view=probcal.Sector(range=500.0))
    >>> pair = probcal.Network([s.type.on(*s.nodes, detection=seen) for s in network.sensors[:2]])
    >>> boats = probcal.Target(motion, {"position": ((100.0, 100.0), 100.0), "velocity": ((0.0, 0.0), 10.0)})
    >>> unnamed = Problem(pair, boats, run.table[run.table["sensor"] != "sonar_2"])
    >>> found = probcal.propagate_beliefs(unnamed)
    >>> found.apart, list(found.sensors["by"])
    ((), ['', 'sonar_0'])
    """
    if messages not in MESSAGES or terms not in TERMS:
        raise InputError(
            f'propagate_beliefs(messages="{messages}", terms="{terms}"): messages are {" or ".join(MESSAGES)}, terms'
            f" {' or '.join(TERMS)}"
        )
    if not (isinstance(iterations, int) and iterations >= 1 and tolerance > 0):
        raise InputError(
            f"propagate_beliefs(iterations={iterations}, tolerance={tolerance}): take 1 or more and a positive number"
        )
    graph = _graph("propagate_beliefs", problem, terms, window, objects, births, lifetime, most)
    return _listed(spread_beliefs(graph, key, iterations, messages, tolerance))


@float64
def separable_likelihood(
    problem: Problem,
    first: str,
    second: str,
    z: Any = None,
    *,
    terms: str = "dual",
    window: float | None = None,
    objects: float = 3.0,
    births: float = 0.02,
    lifetime: float = 600.0,
    most: int = 16,
) -> np.ndarray:
    """Log of the separable likelihood of two sensors at biases z (L, M) in their scales: (L,) over no common object.

    `terms` is "dual" (Separable likelihoods 4) or "quad" (6). Settings as in `propagate_beliefs`. Raises `InputError`
    for a sensor without detections, or of another shape.

    >>> seen = probcal.Detection(0.9, clutter=0.1, view=probcal.Sector(range=500.0))
    >>> pair = probcal.Network([s.type.on(*s.nodes, detection=seen) for s in network.sensors[:2]])
    >>> boats = probcal.Target(motion, {"position": ((100.0, 100.0), 100.0), "velocity": ((0.0, 0.0), 10.0)})
    >>> unnamed = Problem(pair, boats, run.table[run.table["sensor"] != "sonar_2"])
    >>> z = np.zeros((2, len(unnamed.labels)))
    >>> z[1, unnamed.labels.index("sonar_1.heading")] = 3.0  # turned by 15 degrees
    >>> right, wrong = probcal.separable_likelihood(unnamed, "sonar_0", "sonar_1", z)
    >>> bool(right > wrong)
    True
    """
    if terms not in TERMS:
        raise InputError(f'separable_likelihood(terms="{terms}"): terms are {" or ".join(TERMS)}')
    graph = _graph("separable_likelihood", problem, terms, window, objects, births, lifetime, most)
    names = [one.name for one in graph.sensors]
    for name in (first, second):
        if name not in names:
            raise InputError(f'separable_likelihood: "{name}" is no sensor with detections{nearest(name, names)}')
    M = len(problem.labels)
    points = np.zeros((1, M)) if z is None else np.atleast_2d(np.asarray(z, float))
    if points.shape[1] != M:
        raise InputError(f"separable_likelihood: z has shape {points.shape}, the problem {M} free biases")
    return graph.pair(names.index(first), names.index(second), np.zeros(M), np.arange(M)).values(points)


def _graph(
    verb: str, problem: Problem, terms: str, window: float | None, objects: float, births: float, lifetime: float,
    most: int,
) -> Graph:  # fmt: skip
    if window is not None and not window > 0:
        raise InputError(f"{verb}(window={window}): give seconds above 0, or None")
    found = asked(verb, problem, None, None, objects=objects, births=births, lifetime=lifetime, most=most, sensors=())
    return graph_of(found.problem, found.chances, cloud_of(found.watch), most, window, terms)


def _listed(found: Field) -> Beliefs:
    """The tables of what was found."""
    graph = found.graph
    problem = graph.problem
    M, vertices = len(problem.labels), graph.vertices
    covariance = np.eye(M)
    for v, belief in found.beliefs.items():
        degree = max(sum(v in pair[:2] for pair in found.edges), 1)
        at = vertices[v].at
        covariance[np.ix_(at, at)] = belief.covariance * (1 if vertices[v].known else degree)
    by = {v: (u, evidence) for u, v, evidence in found.tree}
    apart = tuple(vertex.name for v, vertex in enumerate(vertices) if v not in found.beliefs)
    rows = []
    for v, vertex in enumerate(vertices):
        u, evidence = by.get(v, (-1, np.nan))
        rows.append({
            "sensor": vertex.name, "placed": v in found.beliefs, "by": vertices[u].name if u >= 0 else "",
            "evidence": evidence, "rivals": len(found.rivals.get(v, ())),
        })  # fmt: skip
    edges = pd.DataFrame(
        [(vertices[u].name, vertices[v].name, gain) for u, v, gain in found.edges], columns=["first", "second", "gain"]
    )
    trace = pd.DataFrame(found.trace, columns=["iteration", "phase", "seconds", "bias", "mean", "sd"])
    scale = problem.scales[trace["bias"].to_numpy(int)]
    trace["mean"], trace["sd"] = trace["mean"] * scale, trace["sd"] * scale
    trace["bias"] = np.array(problem.labels, object)[trace["bias"].to_numpy(int)]
    rivals = {vertices[v].name: len(modes) for v, modes in found.rivals.items() if modes}
    last = int(trace["iteration"].max()) if len(trace) else 0
    return Beliefs(found.z, covariance, pd.DataFrame(rows), edges, trace, apart, rivals, last, found.rests)
