"""Road networks: edges between nodes, each a polyline in metres, laid end to end for fast lookup."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from probcal.errors import InputError
from probcal.geodesy import LocalFrame
from probcal.roads.checks import as_points, check_connected, check_crossings, check_ends, check_lines, edge_names
from probcal.roads.coordinates import projection
from probcal.roads.extra import shapely
from probcal.roads.graphs import EdgeList, as_graph, pieces_of

CHUNK = 1_000_000  # pairs of points and segments that are compared at once


class Segments(NamedTuple):
    """The straight pieces of all edges in order, S of them."""

    edge: np.ndarray  # (S,) which edge
    begin: np.ndarray  # (S,) arc length in m on the edge where the piece begins
    length: np.ndarray  # (S,) in m
    origin: np.ndarray  # (S, d) its first point
    tangent: np.ndarray  # (S, d) unit vector along it


@dataclass(frozen=True, eq=False, repr=False)
class RoadNetwork:
    """Roads as edges between nodes: names (E), polylines (k, d) in local metres, end nodes, one-way flags.

    Made by `from_lines`, `from_graph` or `read_roads`, which check them. The arc length of an edge counts from its
    first point; a one-way edge is entered there only. Edges in `bridges` may cross others without a node.
    """

    names: tuple[str, ...]
    lines: tuple[np.ndarray, ...]
    ends: np.ndarray  # (E, 2) numbers of the first and the last node
    nodes: np.ndarray  # (N, d) in m
    oneway: np.ndarray  # (E,)
    bridges: frozenset[str] = frozenset()

    def __repr__(self) -> str:
        return f"RoadNetwork({len(self.names)} edges, {len(self.nodes)} nodes, {self.lengths.sum():.0f} m)"

    @classmethod
    def from_lines(
        cls,
        lines: Mapping[str, Any],
        *,
        oneway: Collection[str] = (),
        snap: float = 0.01,
        connected: bool = True,
        bridges: Collection[str] = (),
    ) -> RoadNetwork:
        """Network of polylines (k, d) in m by name; ends within `snap` m of each other are one node.

        Raises `InputError` naming the edge where roads cross without a node (but for those named in `bridges` and for
        heights 1 m apart), are in several parts (but with `connected=False`), or are no roads.

        >>> roads = RoadNetwork.from_lines({"main": [(0, 0), (90, 0)], "side": [(90, 0), (90, 40)]}, oneway=["side"])
        >>> roads
        RoadNetwork(2 edges, 3 nodes, 130 m)
        """
        names = [str(name) for name in lines]
        points = [as_points(str(name), line) for name, line in lines.items()]
        single = edge_names(oneway, names, "oneway")
        return cls.from_pieces(joined(names, points, [n in single for n in names], snap), snap, connected, bridges)

    @classmethod
    def from_graph(
        cls,
        graph: Any,
        *,
        frame: LocalFrame | None = None,
        crs: Any = None,
        dimension: int | None = None,
        snap: float = 0.01,
        connected: bool = True,
        bridges: Collection[str] = (),
    ) -> RoadNetwork:
        """Network of a networkx graph, of osmnx say: x, y[, z] or pos of nodes; geometry, oneway and name of edges.

        Two directed edges back and forth along one geometry are one two-way edge. Coordinates are in `crs`, by default
        the `crs` of the graph; longitude and latitude need a `frame`. Edges that say bridge or tunnel may cross others.
        """
        stated = getattr(graph, "graph", {}).get("crs") if crs is None else crs
        found = pieces_of(graph, projection(stated, frame), dimension)
        return cls.from_pieces(found, snap, connected, bridges)

    @classmethod
    def from_pieces(cls, pieces: EdgeList, snap: float, connected: bool, bridges: Collection[str]) -> RoadNetwork:
        """The network of pieces; raises `InputError` where they are no network."""
        over = edge_names(bridges, pieces.names, "bridges") | frozenset(pieces.bridges)
        check_lines(pieces.names, pieces.lines, snap)
        lines = tuple(_without_repeats(line) for line in pieces.lines)
        check_ends(pieces.names, lines, pieces.ends)
        if connected:
            check_connected(pieces.names, pieces.ends)
        check_crossings(pieces.names, lines, pieces.ends, pieces.nodes, over, snap)
        return cls(tuple(pieces.names), lines, pieces.ends, pieces.nodes, np.array(pieces.oneway, bool), over)

    def to_graph(self) -> Any:
        """networkx MultiGraph with x, y[, z] of nodes, and name, geometry, oneway and length of edges."""
        edges = EdgeList([*self.names], [*self.lines], self.ends, self.nodes, [*self.oneway], [*self.bridges])
        return as_graph(edges, self.lengths)

    @property
    def dimension(self) -> int:
        """Number of axes."""
        return self.nodes.shape[1]

    @cached_property
    def segments(self) -> Segments:
        """The straight pieces of all edges, end to end."""
        steps = [np.diff(line, axis=0) for line in self.lines]
        lengths = [np.linalg.norm(step, axis=1) for step in steps]
        length = np.concatenate(lengths)
        return Segments(
            np.repeat(np.arange(len(self.lines)), [len(own) for own in lengths]),
            np.concatenate([np.cumsum(own) - own for own in lengths]),
            length,
            np.concatenate([line[:-1] for line in self.lines]),
            np.concatenate(steps) / length[:, None],
        )

    @cached_property
    def lengths(self) -> np.ndarray:
        """Length of each edge in m, shape (E,)."""
        return np.bincount(self.segments.edge, self.segments.length)

    @cached_property
    def offsets(self) -> np.ndarray:
        """The start of each edge on the line of all edges end to end, in m, shape (E,)."""
        return np.cumsum(self.lengths) - self.lengths

    @cached_property
    def marks(self) -> np.ndarray:
        """The start of each segment on that line, in m, shape (S,)."""
        return self.offsets[self.segments.edge] + self.segments.begin

    @cached_property
    def spans(self) -> np.ndarray:
        """First and last segment of each edge, shape (E, 2)."""
        numbers = np.arange(len(self.lines))
        edge = self.segments.edge
        return np.stack([np.searchsorted(edge, numbers), np.searchsorted(edge, numbers, "right") - 1], 1)

    def number(self, name: str) -> int:
        """Number of an edge by name; raises `InputError` for one that there is not."""
        edge_names(name, self.names, "roads")
        return self.names.index(name)

    def nearest(self, points: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Edge number, arc length in m and distance in m of the nearest place on the roads, for points (n, d)."""
        points = np.atleast_2d(np.asarray(points, float))
        if points.shape[1:] != (self.dimension,) or not np.isfinite(points).all():
            raise InputError(f"nearest takes finite points of shape (n, {self.dimension}) in m, not {points.shape}")
        if self.dimension == 2:
            found = self.tree.query_nearest(shapely.points(points), all_matches=False)[1]
        else:
            size = max(CHUNK // len(self.segments.edge), 1)
            blocks = [points[k : k + size] for k in range(0, len(points), size)]
            every = np.arange(len(self.segments.edge))[None]
            found = np.concatenate([np.zeros(0, int), *(self.feet(p[:, None], every)[1].argmin(1) for p in blocks)])
        along, distance = self.feet(points, found)
        return self.segments.edge[found], along, distance

    def feet(self, points: np.ndarray, segment: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Arc length on the edge and distance, both in m, of the place on a segment that is nearest to a point."""
        own = Segments(*(part[segment] for part in self.segments))
        gone = np.clip(((points - own.origin) * own.tangent).sum(-1), 0.0, own.length)
        return own.begin + gone, np.linalg.norm(points - own.origin - gone[..., None] * own.tangent, axis=-1)

    @cached_property
    def tree(self) -> Any:
        """Spatial index of the segments in the plane."""
        begin, step = self.segments.origin[:, :2], self.segments.tangent * self.segments.length[:, None]
        return shapely.STRtree(shapely.linestrings(np.stack([begin, begin + step[:, :2]], 1)))

    def __getstate__(self) -> dict[str, Any]:
        """Without the spatial index, which is made again where it is used."""
        return {name: value for name, value in self.__dict__.items() if name != "tree"}


def joined(
    names: list[str], lines: list[np.ndarray], oneway: list[bool], snap: float, bridges: Collection[str] = ()
) -> EdgeList:
    """Polylines with their ends joined: those within `snap` m of each other become one node at their mean."""
    check_lines(names, lines, snap)
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    places = np.concatenate([line[[0, -1]] for line in lines])
    i, j = cKDTree(places).query_pairs(snap, output_type="ndarray").T
    count, own = connected_components(coo_array((np.ones(len(i)), (i, j)), shape=(len(places),) * 2), directed=False)
    sums = np.stack([np.bincount(own, column, count) for column in places.T], 1)
    nodes = sums / np.bincount(own, minlength=count)[:, None]
    ends = own.reshape(-1, 2)
    moved = [
        np.concatenate([nodes[a][None], line[1:-1], nodes[b][None]]) for (a, b), line in zip(ends, lines, strict=True)
    ]
    return EdgeList(names, moved, ends, nodes, oneway, list(bridges))


def _without_repeats(line: np.ndarray) -> np.ndarray:
    """Points (k, d) without those that repeat the one before."""
    keep = np.ones(len(line), bool)
    keep[1:] = np.linalg.norm(np.diff(line, axis=0), axis=1) > 0
    return line[keep]
