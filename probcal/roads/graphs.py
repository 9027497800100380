"""Road networks from and to networkx, in the form of osmnx."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from probcal.errors import InputError
from probcal.roads.checks import as_points
from probcal.roads.coordinates import Projection
from probcal.roads.extra import networkx, shapely

NEAR = 1.0  # m that the geometry of an edge may end away from its node
YES, BACKWARD, NO = ("yes", "true", "1"), ("-1", "reverse", "reversed"), ("no", "false", "0", "none", "nan", "")


@dataclass(frozen=True, eq=False)
class EdgeList:
    """Edges as read: names, polylines, numbers of the end nodes, node places, one-way flags and bridges."""

    names: list[str]
    lines: list[np.ndarray]
    ends: np.ndarray  # (E, 2)
    nodes: np.ndarray  # (N, d)
    oneway: list[bool]
    bridges: list[str]


def direction(name: str, value: Any) -> int:
    """The direction of `oneway`: 1 from start to end, -1 from end to start, 0 both ways."""
    text = str(value).strip().lower()
    for answer, words in ((1, YES), (-1, BACKWARD), (0, NO)):
        if text in words:
            return answer
    raise InputError(f'edge "{name}": oneway is {value!r}; write yes, no or -1')


def unique(names: Sequence[str]) -> list[str]:
    """Names in order, those that come again with a number: `Main Street`, `Main Street#2`."""
    found: dict[str, int] = {}
    taken, result = set(names), []
    for name in names:
        found[name] = found.get(name, 0) + 1
        own = name
        while found[name] > 1 and (own := f"{name}#{found[name]}") in taken:
            found[name] += 1
        taken.add(own)
        result.append(own)
    return result


def name_of(data: Any, keys: Sequence[str], default: str) -> str:
    """Name of an edge by the first of its attributes that says one."""
    for key in keys:
        value = data.get(key)
        value = value[0] if isinstance(value, (list, tuple)) and value else value
        if value is not None and str(value).strip().lower() not in ("", "nan", "none"):
            return str(value)
    return default


def pieces_of(graph: Any, to_metres: Projection, dimension: int | None) -> EdgeList:
    """Edges of a Graph, DiGraph, MultiGraph or MultiDiGraph; two directed edges back and forth are one."""
    if not (hasattr(graph, "edges") and hasattr(graph, "is_directed")):
        raise InputError(f"from_graph takes a networkx graph, not {type(graph).__name__}")
    if not graph.number_of_edges():
        raise InputError("the graph has no edges; a road network needs at least one")
    places = [_place_of(node, data) for node, data in graph.nodes(data=True)]
    d = dimension or min(map(len, places))
    if min(map(len, places)) < d:
        raise InputError("the graph has nodes without z; give every node one, or dimension=2")
    nodes = to_metres(np.array([place[:d] for place in places]))
    number = {node: k for k, node in enumerate(graph)}
    labels: list[str] = []
    lines: list[np.ndarray] = []
    ends: list[tuple[int, int]] = []
    oneway: list[bool] = []
    over: list[bool] = []
    waiting: dict[tuple[int, int], list[int]] = {}
    for u, v, data in graph.edges(data=True):
        a, b = number[u], number[v]
        name = name_of(data, ("name", "osmid", "id"), f"{u}-{v}")
        line = _line_of(name, data.get("geometry"), nodes[[a, b]], to_metres)
        if line is None:
            line = nodes[[a, b]]
        elif _miss(line, nodes[[a, b]]) > _miss(line[::-1], nodes[[a, b]]):
            a, b = (a, b) if graph.is_directed() else (b, a)
            line = line[::-1] if graph.is_directed() else line
        if _miss(line, nodes[[a, b]]) > NEAR:
            raise InputError(
                f'edge "{name}": its geometry ends {_miss(line, nodes[[a, b]]):.1f} m from its node; check them'
            )
        line = np.concatenate([nodes[a][None], line[1:-1], nodes[b][None]])
        twin = next((e for e in waiting.get((b, a), ()) if _same(lines[e], line[::-1])), None)
        if graph.is_directed() and twin is not None:
            waiting[b, a].remove(twin)
            oneway[twin] = False
            continue
        way = direction(name, data.get("oneway", graph.is_directed()))
        if way < 0:
            a, b, line = b, a, line[::-1]
        waiting.setdefault((a, b), []).append(len(lines))
        labels.append(name)
        lines.append(line)
        ends.append((a, b))
        oneway.append(way != 0)
        over.append(any(name_of(data, (key,), "no") != "no" for key in ("bridge", "tunnel")))
    used, ends_used = np.unique(ends, return_inverse=True)
    labels = unique(labels)
    bridges = [name for name, high in zip(labels, over, strict=True) if high]
    return EdgeList(labels, lines, ends_used.reshape(-1, 2), nodes[used], oneway, bridges)


def as_graph(edges: EdgeList, lengths: np.ndarray) -> Any:
    """networkx MultiGraph of edges and lengths (E,): x, y[, z] of nodes; name, geometry, oneway, length of edges."""
    graph = networkx.MultiGraph()
    for k, place in enumerate(edges.nodes):
        graph.add_node(k, **dict(zip("xyz", map(float, place), strict=False)))
    for e, name in enumerate(edges.names):
        start, end = map(int, edges.ends[e])
        graph.add_edge(
            start,
            end,
            name=name,
            geometry=shapely.LineString(edges.lines[e]),
            oneway=bool(edges.oneway[e]),
            length=float(lengths[e]),
            **({"bridge": "yes"} if name in edges.bridges else {}),
        )
    return graph


def _place_of(node: Any, data: Any) -> tuple[float, ...]:
    """Coordinates of a node by its attributes x, y[, z] or pos."""
    try:
        given = data["pos"] if "pos" in data and "x" not in data else [data[k] for k in ("x", "y", "z") if k in data]
        place = tuple(float(value) for value in given)
    except (TypeError, ValueError):
        place = ()
    if len(place) not in (2, 3) or not np.isfinite(place).all():
        raise InputError(f'node "{node}" of the graph has no place; give it the attributes x and y, or pos')
    return place


def _line_of(name: str, geometry: Any, between: np.ndarray, to_metres: Projection) -> np.ndarray | None:
    """Points (k, d) in m of the geometry of an edge; heights that it lacks run evenly between its nodes."""
    if geometry is None:
        return None
    if isinstance(geometry, str):
        parsed = shapely.from_wkt(geometry, on_invalid="ignore")
        if parsed is None:
            raise InputError(f'edge "{name}": its geometry is no WKT: {geometry[:40]}')
        geometry = parsed
    points = as_points(name, list(getattr(geometry, "coords", geometry)))
    d = between.shape[1]
    if points.shape[1] >= d:
        return to_metres(points[:, :d])
    flat = to_metres(points)
    gone = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(flat, axis=0), axis=1))])
    ends = between if _miss(flat, between[:, :2]) <= _miss(flat[::-1], between[:, :2]) else between[::-1]
    return np.column_stack([flat, np.interp(gone, [0.0, gone[-1]], ends[:, 2])])


def _miss(line: np.ndarray, between: np.ndarray) -> float:
    """Largest distance in m of the ends of a line from its two nodes (2, d)."""
    return float(np.linalg.norm(line[[0, -1]] - between, axis=1).max())


def _same(line: np.ndarray, other: np.ndarray) -> bool:
    return line.shape == other.shape and bool(np.allclose(line, other, rtol=0, atol=0.01))
