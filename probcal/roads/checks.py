"""The faults that make a road network unusable, each in one sentence that names the edge."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from itertools import combinations

import numpy as np

from probcal.errors import InputError, nearest
from probcal.labels import listed
from probcal.roads.extra import shapely
from probcal.table import LARGEST

CLEARANCE = 1.0  # m of height between two roads above which they pass over each other
SHOWN = 5  # edges that a sentence names


def as_points(name: str, points: object) -> np.ndarray:
    """Points (k, d) of an edge without repetitions; raises `InputError` where they are no polyline."""
    try:
        line = np.asarray(points, float)
    except (TypeError, ValueError, OverflowError):
        line = np.zeros(0)
    if line.ndim != 2 or line.shape[1] not in (2, 3):
        raise InputError(f'edge "{name}": its points must be numbers of shape (k, 2) or (k, 3) in m')
    if not (np.abs(line) <= LARGEST).all():
        raise InputError(f'edge "{name}" has a point that is not finite or beyond {LARGEST:g} m; give numbers in m')
    return line


def edge_names(given: Collection[str], names: Collection[str], what: str) -> frozenset[str]:
    """The edges that a name or a collection of names means; raises `InputError` for a name that is no edge."""
    found = [given] if isinstance(given, str) else list(given)
    for name in found:
        if name not in names:
            raise InputError(f'{what}: no edge is called "{name}"{nearest(name, names)}')
    return frozenset(found)


def check_lines(names: Sequence[str], lines: Sequence[np.ndarray], snap: float) -> None:
    """Raise `InputError` for no edges, mixed dimensions, an edge without length, and degrees in place of metres."""
    if not names:
        raise InputError("a road network needs at least one edge")
    if not (np.isfinite(snap) and snap > 0):
        raise InputError(f"snap is {snap!r}; give the distance in m within which two ends are one node, as 0.01")
    for name, line in zip(names, lines, strict=True):
        if line.shape[1] != lines[0].shape[1]:
            raise InputError(
                f'edge "{name}" is {line.shape[1]}-D and edge "{names[0]}" {lines[0].shape[1]}-D;'
                " give all points the same number of coordinates"
            )
    points = np.concatenate(lines)
    if (np.abs(points[:, :2]) <= (180, 90)).all() and 0 < np.ptp(points[:, :2], 0).max() < 1:
        raise InputError(
            f'edge "{names[0]}" and all others lie within {np.ptp(points[:, :2], 0).max():.2g} m, which looks like'
            " longitude and latitude; give frame=LocalFrame(latitude, longitude) to read_roads or from_graph"
        )
    for name, line in zip(names, lines, strict=True):
        if np.linalg.norm(np.diff(line, axis=0), axis=1).sum() <= snap:
            raise InputError(f'edge "{name}" has no length; leave it out')


def check_ends(names: Sequence[str], lines: Sequence[np.ndarray], ends: np.ndarray) -> None:
    """Raise `InputError` for an edge whose ends are one node, and for an edge that stands twice."""
    for name, (start, end) in zip(names, ends, strict=True):
        if start == end:
            raise InputError(f'edge "{name}" ends where it starts; split the loop in two edges')
    twins: dict[tuple[int, ...], list[int]] = {}
    for e, pair in enumerate(ends):
        twins.setdefault(tuple(sorted(map(int, pair))), []).append(e)
    for group in twins.values():
        for i, j in combinations(group, 2):
            other = lines[j] if ends[i][0] == ends[j][0] else lines[j][::-1]
            if lines[i].shape == other.shape and np.allclose(lines[i], other, rtol=0, atol=1e-3):
                raise InputError(f'edge "{names[j]}" is edge "{names[i]}" once more; leave one of them out')


def check_connected(names: Sequence[str], ends: np.ndarray) -> None:
    """Raise `InputError` naming the edges of the smaller parts of a network in several."""
    root = list(range(int(ends.max()) + 1))

    def find(node: int) -> int:
        while root[node] != node:
            root[node] = root[root[node]]
            node = root[node]
        return node

    for start, end in ends:
        root[find(int(start))] = find(int(end))
    part = np.array([find(int(start)) for start, _ in ends])
    kinds, counts = np.unique(part, return_counts=True)
    if len(kinds) > 1:
        rest = [f'"{name}"' for name, own in zip(names, part, strict=True) if own != kinds[counts.argmax()]]
        shown = listed(rest, SHOWN)
        raise InputError(
            f"the roads are in {len(kinds)} parts, {shown} apart from the others; join them (a larger snap?),"
            " leave them out or give connected=False"
        )


def check_crossings(
    names: Sequence[str],
    lines: Sequence[np.ndarray],
    ends: np.ndarray,
    nodes: np.ndarray,
    bridges: Collection[str],
    snap: float,
) -> None:
    """Raise `InputError` for edges that meet in the plane, or one that meets itself, away from a node."""
    flat = shapely.linestrings(
        np.concatenate([line[:, :2] for line in lines]), indices=np.repeat(np.arange(len(lines)), [*map(len, lines)])
    )
    tree = shapely.STRtree(flat)
    over = np.isin(names, list(bridges))
    for e in map(int, np.flatnonzero(~shapely.is_simple(flat) & ~over)):
        if nodes.shape[1] == 2:
            raise InputError(f'edge "{names[e]}" crosses itself; split it where it does, or name it in bridges')

    def clear(i: int, j: int, point: np.ndarray) -> bool:
        """True if one edge passes over the other at a point."""
        if over[i] or over[j]:
            return True
        if nodes.shape[1] == 2:
            return False
        heights = [_height(lines[e], point) for e in (i, j)]
        return abs(heights[0] - heights[1]) > CLEARANCE

    ended = shapely.points(nodes[:, :2])
    for node, e in tree.query(ended, predicate="dwithin", distance=snap).T:
        if node not in ends[e]:
            other = int(np.nonzero((ends == node).any(1))[0][0])
            if not clear(other, e, nodes[node, :2]):
                raise InputError(
                    f'edge "{names[other]}" ends on edge "{names[e]}" at {_place(nodes[node])}, away from its ends;'
                    f' split "{names[e]}" there, or name one of them in bridges'
                )
    first, second = tree.query(flat, predicate="intersects")
    pairs = np.stack([first, second], 1)[first < second]
    meets = shapely.intersection(flat[pairs[:, 0]], flat[pairs[:, 1]])
    for (i, j), meet in zip(pairs, meets, strict=True):
        shared = nodes[np.intersect1d(ends[i], ends[j])][:, :2]
        points = shapely.get_coordinates(meet)
        apart = np.linalg.norm(points[:, None] - shared[None], axis=-1).min(1, initial=np.inf) > snap
        for point in points[apart]:
            if not clear(i, j, point):
                raise InputError(
                    f'edges "{names[i]}" and "{names[j]}" cross at {_place(point)} without a node;'
                    " split both there, or name the one that passes over in bridges"
                )


def _height(line: np.ndarray, point: np.ndarray) -> float:
    """Height of a polyline (k, 3) where it is nearest to a point (2,) of the plane."""
    step = np.diff(line, axis=0)
    square = np.maximum((step[:, :2] ** 2).sum(1), 1e-12)
    share = np.clip(((point - line[:-1, :2]) * step[:, :2]).sum(1) / square, 0.0, 1.0)
    foot = line[:-1] + share[:, None] * step
    return float(foot[np.linalg.norm(foot[:, :2] - point, axis=1).argmin(), 2])


def _place(point: np.ndarray) -> str:
    return f"({', '.join(f'{value:.1f}' for value in point)})"
