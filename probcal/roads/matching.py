"""Map matching: the roads that a finished track most probably followed."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from probcal.errors import InputError, nearest
from probcal.labels import AXES
from probcal.lazy import pd
from probcal.roads.extra import networkx, shapely
from probcal.roads.network import RoadNetwork

MATCHED, FAR, UNREACHED, AGAIN = "matched", "far from roads", "unreachable", "matched after a gap"
BACK = 3.0  # std that a target may seem to go back on a one-way edge


class Candidates(NamedTuple):
    """Places on the roads near one position, C of them, the nearest of each edge."""

    edge: np.ndarray  # (C,)
    along: np.ndarray  # (C,) in m
    distance: np.ndarray  # (C,) in m


def match_track(
    track: Any,
    network: RoadNetwork,
    *,
    std: float,
    radius: float | None = None,
    beta: float | None = None,
    detour: float = 500.0,
) -> pd.DataFrame:
    """Roads that each target of a track most probably followed, by the hidden Markov model of Newson and Krumm (2009).

    `track` is a DataFrame as of `probcal.tracks`, or the DataTree itself. The distance to the road is Gaussian of `std`
    m; the route between two places exceeds the straight line by an exponential length of mean `beta` m (`std` by
    default). Candidates lie within `radius` m (5 std by default); no route is over `detour` m longer than straight.

    One row an epoch: time, target, edge, along, position_x, position_y[, position_z], distance, status. Without a road
    in reach edge is missing and status `far from roads`; a single epoch that no route joins to its neighbours is
    `unreachable`, and where more follow the first of them is `matched after a gap`.
    """
    for name, value in (("std", std), ("radius", radius), ("beta", beta), ("detour", detour)):
        if value is not None and not (np.isfinite(value) and value > 0):
            raise InputError(f"match_track: {name} is {value!r}; give a positive number of metres")
    frame = _table(track, network.dimension)
    routes = Routes(network)
    columns = [f"position_{axis}" for axis in AXES[: network.dimension]]
    parts = []
    for target, own in frame.groupby("target", sort=False):
        own = own.sort_values("time", kind="stable")
        points = own[columns].to_numpy(float)
        found = _candidates(network, points, 5 * std if radius is None else radius)
        chosen, status = _viterbi(found, points, routes, std, std if beta is None else beta, detour)
        edge, along, away = (np.array(column) for column in zip(*chosen, strict=True))
        there = edge >= 0
        place = np.full(points.shape, np.nan)
        place[there] = _positions(network, edge[there], along[there])
        names = [network.names[e] if e >= 0 else None for e in edge]
        head = {"time": own["time"].to_numpy(), "target": target, "edge": pd.array(names, "str"), "along": along}
        parts.append(
            pd.DataFrame({**head, **dict(zip(columns, place.T, strict=True)), "distance": away, "status": status})
        )
    return pd.concat(parts, ignore_index=True)


class Routes:
    """Shortest routes in driving direction between places on the roads."""

    def __init__(self, network: RoadNetwork):
        self.network = network
        self.graph = networkx.DiGraph()
        self.known: dict[int, tuple[float, dict[int, float]]] = {}
        for e, (start, end) in enumerate(network.ends.tolist()):
            for a, b in [(start, end)] if network.oneway[e] else [(start, end), (end, start)]:
                length = min(float(network.lengths[e]), self.graph.get_edge_data(a, b, {}).get("length", np.inf))
                self.graph.add_edge(a, b, length=length)

    def between(self, first: int, last: int, most: float) -> float:
        """Length in m of the shortest route between two nodes; infinite where it is longer than `most`."""
        within, lengths = self.known.get(first, (-1.0, {}))
        if within < most:
            lengths = networkx.single_source_dijkstra_path_length(self.graph, first, cutoff=most, weight="length")
            self.known[first] = most, lengths
        return lengths.get(last, np.inf)

    def lengths(self, before: Candidates, after: Candidates, most: float, back: float) -> np.ndarray:
        """Route lengths in m between candidates, shape (C, C'); on a one-way edge `back` m backward count as driven."""
        net, found = self.network, np.full((len(before.edge), len(after.edge)), np.inf)
        for i, (e, a) in enumerate(zip(before.edge, before.along, strict=True)):
            leave = [(net.ends[e][1], net.lengths[e] - a)] + ([] if net.oneway[e] else [(net.ends[e][0], a)])
            for j, (f, b) in enumerate(zip(after.edge, after.along, strict=True)):
                enter = [(net.ends[f][0], b)] + ([] if net.oneway[f] else [(net.ends[f][1], net.lengths[f] - b)])
                ways = [
                    gone + rest + self.between(int(p), int(q), most)
                    for p, gone in leave
                    for q, rest in enter
                    if gone + rest <= most
                ]
                if e == f and (not net.oneway[e] or b >= a - back):
                    ways.append(abs(b - a))
                found[i, j] = min(ways, default=np.inf)
        return np.where(found <= most, found, np.inf)


def _viterbi(
    found: list[Candidates], points: np.ndarray, routes: Routes, std: float, beta: float, detour: float
) -> tuple[list[tuple[int, float, float]], list[str]]:
    """Edge, arc length and distance of each epoch, by the most probable chain of candidates, and its status."""
    chosen, status = [(-1, np.nan, np.nan)] * len(points), [FAR] * len(points)
    chains: list[list[tuple[int, np.ndarray, np.ndarray | None]]] = []  # epoch, score, which candidate it came from
    for k, own in enumerate(found):
        if not len(own.edge):
            continue
        seen = -0.5 * (own.distance / std) ** 2
        if chains:
            before, score, _ = chains[-1][-1]
            straight = float(np.linalg.norm(points[k] - points[before]))
            length = routes.lengths(found[before], own, straight + detour, BACK * std)
            total = score[:, None] - np.abs(length - straight) / beta
            if np.isfinite(total).any():
                chains[-1].append((k, total.max(0) + seen, total.argmax(0)))
                continue
        chains.append([(k, seen, None)])
    for n, chain in enumerate(chains):
        if len(chain) == 1 and len(chains) > 1:
            status[chain[0][0]] = UNREACHED
            continue
        best = int(chain[-1][1].argmax())
        for k, _, back in reversed(chain):
            edge, along, distance = (part[best] for part in found[k])
            chosen[k] = (int(edge), float(along), float(distance))
            status[k] = AGAIN if back is None and n else MATCHED
            best = best if back is None else int(back[best])
    return chosen, status


def _candidates(network: RoadNetwork, points: np.ndarray, radius: float) -> list[Candidates]:
    """The nearest place on each edge within `radius` m of each point (n, d)."""
    pairs = network.tree.query(shapely.points(points[:, :2]), predicate="dwithin", distance=radius)
    along, distance = network.feet(points[pairs[0]], pairs[1])
    edge = network.segments.edge[pairs[1]]
    order = np.lexsort((distance, edge, pairs[0]))
    order = order[distance[order] <= radius]
    _, first = np.unique(np.stack([pairs[0][order], edge[order]]), axis=1, return_index=True)
    order = order[first]
    return [
        Candidates(*(part[order[pairs[0][order] == k]] for part in (edge, along, distance))) for k in range(len(points))
    ]


def _positions(network: RoadNetwork, edge: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Positions (n, d) in m at arc lengths on edges."""
    own = np.searchsorted(network.marks, network.offsets[edge] + along, side="right") - 1
    own = np.clip(own, network.spans[edge, 0], network.spans[edge, 1])
    part = network.segments
    return part.origin[own] + (along - part.begin[own])[:, None] * part.tangent[own]


def _table(track: Any, dimension: int) -> Any:
    """The track as a DataFrame with time, target and positions; raises `InputError` for a column that it lacks."""
    if hasattr(track, "children") and "track" in track.children:
        rows = []
        for node in track["track"].children.values():
            group = node.to_dataset(inherit=False)
            columns = {str(c): group["mean"].sel(component=c).values for c in group["component"].values}
            rows.append(pd.DataFrame({"time": group["time"].values, "target": str(node.attrs["target"]), **columns}))
        track = pd.concat(rows, ignore_index=True)
    if not isinstance(track, pd.DataFrame):
        raise InputError(f"match_track takes a DataFrame as of probcal.tracks, or a fit, not {type(track).__name__}")
    for column in ("time", "target", *(f"position_{axis}" for axis in AXES[:dimension])):
        if column not in track:
            raise InputError(f'match_track: the track has no column "{column}"{nearest(column, track.columns)}')
    own = track[[f"position_{axis}" for axis in AXES[:dimension]]].to_numpy(float)
    if not len(track) or not np.isfinite(own).all():
        raise InputError("match_track: the track needs rows, each with finite positions; drop the others")
    return track
