"""Ways on at the nodes of a network, and the paths that lead from one edge to another within a reach."""

from __future__ import annotations

import heapq
from collections.abc import Mapping
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from probcal.errors import InputError
from probcal.roads.checks import edge_names
from probcal.roads.network import RoadNetwork

LARGEST = 20_000_000  # entries of a path table
SAME = 1e-6  # m within which the lengths of two paths are equal
Turns = tuple[tuple[tuple[str, str], float], ...]


class Exits(NamedTuple):
    """Ways on at the end of a directed edge: 2e travels edge e from its start to its end, 2e + 1 back."""

    onto: np.ndarray  # (2E, W) directed edges, the last one repeated
    cumulative: np.ndarray  # (2E, W) probability of this way or one before, 1 from the last on


class PathTable(NamedTuple):
    """Paths from each edge to each it reaches: displacement -along + shift + sign * along', speed' = sign * path speed.

    D is the largest number of edges reached from one, P the largest number of paths between two: memory E D P.
    """

    edges: np.ndarray  # (E, D) edges reached, in order, filled up with E
    shift: np.ndarray  # (E, D, P) in m
    sign: np.ndarray  # (E, D, P) 1 where the edge is travelled as the first one was, else -1
    log_probability: np.ndarray  # (E, D, P), -inf where there is no path


def turns_of(turns: Mapping[tuple[str, str], float] | None, network: RoadNetwork) -> Turns:
    """Turn weights as pairs; raises `InputError` naming a turn that cannot be made."""
    for pair, weight in (turns or {}).items():
        if not (isinstance(pair, tuple) and len(pair) == 2):
            raise InputError(f"turns: {pair!r} is no turn; write {{(from_edge, to_edge): weight}}")
        edge_names(pair, network.names, "turns")
        a, b = (network.number(name) for name in pair)
        shared = set(network.ends[a]) & set(network.ends[b])
        if network.oneway[b]:
            shared &= {network.ends[b][0]}
        if a == b or not shared:
            raise InputError(f'turns: no turn leads from edge "{pair[0]}" into edge "{pair[1]}"; leave it out')
        if not (np.isfinite(weight) and weight >= 0):
            raise InputError(f"turns: the weight of {pair!r} is {weight!r}; it must be 0 or a positive number")
    return tuple(sorted((pair, float(weight)) for pair, weight in (turns or {}).items()))


@lru_cache(maxsize=16)
def exits_of(network: RoadNetwork, turns: Turns) -> Exits:
    """Ways on at the end of every directed edge, by turn weights, or uniform; a dead end turns back."""
    ends, names = network.ends, network.names
    weights = dict(turns)
    leaving: dict[int, list[int]] = {}
    for e, (start, end) in enumerate(ends):
        leaving.setdefault(int(start), []).append(2 * e)
        if not network.oneway[e]:
            leaving.setdefault(int(end), []).append(2 * e + 1)
    ways = []
    for k in range(2 * len(names)):
        e, back = divmod(k, 2)
        onward = [way for way in leaving.get(int(ends[e][1 - back]), []) if way // 2 != e]
        given = [weights.get((names[e], names[way // 2])) for way in onward]
        if all(weight is None for weight in given):
            chances = [1.0] * len(onward)
        elif sum(weight or 0.0 for weight in given) > 0:
            chances = [weight or 0.0 for weight in given]
        else:
            raise InputError(
                f'turns: the weights from edge "{names[e]}" at one end are all 0; give one way on a positive weight'
            )
        pairs = [(way, chance) for way, chance in zip(onward, chances, strict=True) if chance > 0]
        ways.append(pairs or [(k ^ 1, 1.0)])
    width = max(map(len, ways))
    onto, cumulative = np.zeros((len(ways), width), int), np.ones((len(ways), width))
    for k, pairs in enumerate(ways):
        onto[k] = [way for way, _ in pairs] + [pairs[-1][0]] * (width - len(pairs))
        total = np.cumsum([chance for _, chance in pairs])
        cumulative[k, : len(pairs) - 1] = total[:-1] / total[-1]
    return Exits(onto, cumulative)


@lru_cache(maxsize=8)
def path_table(network: RoadNetwork, turns: Turns, reach: float) -> PathTable:
    """All paths from every edge up to `reach` m beyond its ends; those of equal length and sense are one.

    Time and memory grow with the number of edges times the paths from one, which on an irregular map is exponential in
    the number of junctions within reach. Raises `InputError` where the table would exceed 2e7 entries.
    """
    exits, E = exits_of(network, turns), len(network.names)
    chances = np.diff(exits.cumulative, axis=1, prepend=0.0)
    ways = [
        [(int(way), float(p)) for way, p in zip(own, chance, strict=True) if p > 0]
        for own, chance in zip(exits.onto, chances, strict=True)
    ]
    every: list[dict[int, list[tuple[float, int, float]]]] = []
    wide = deep = 0
    for e in range(E):
        reached: dict[int, list[tuple[float, int, float]]] = {e: [(0.0, 1, 1.0)]}
        count = 1
        for back in (0, 1):
            for gone, way, probability in _onward(network.lengths, ways, 2 * e + back, reach, LARGEST // E):
                into, length = way // 2, float(network.lengths[way // 2])
                sign = 1 if way % 2 == back else -1
                far = gone if way % 2 == 0 else gone + length
                shift = -far if back else float(network.lengths[e]) + far
                reached.setdefault(into, []).append((shift, sign, probability))
                count += 1
        wide, deep = max(wide, len(reached)), max(deep, *(len(paths) for paths in reached.values()))
        if E * wide * deep > LARGEST or E * count > LARGEST:
            raise InputError(
                f'edge "{network.names[e]}": {count} paths lead on within {reach:.0f} m, more than a table of all roads'
                " can hold; take shorter steps, a smaller fastest or a part of the network"
            )
        every.append(reached)
    edges = np.full((E, wide), E)
    paths = np.tile([0.0, 1.0, 0.0], (E, wide, deep, 1))
    for e, reached in enumerate(every):
        for slot, into in enumerate(sorted(reached)):
            edges[e, slot] = into
            paths[e, slot, : len(reached[into])] = reached[into]
    with np.errstate(divide="ignore"):
        return PathTable(edges, paths[..., 0].copy(), paths[..., 1].copy(), np.log(paths[..., 2]))


def _onward(lengths: np.ndarray, ways: Any, first: int, reach: float, most: int) -> list[tuple[float, int, float]]:
    """Distance beyond the end of a directed edge, directed edge entered there and probability, within reach."""
    found: list[tuple[float, int, float]] = []
    queue: list[tuple[int, int]] = []
    waiting: dict[tuple[int, int], list[float]] = {}  # (distance in SAME, directed edge): distance, probability

    def enter(gone: float, before: int, probability: float) -> None:
        for way, p in ways[before]:
            key = (round(gone / SAME), way)
            if key in waiting:
                waiting[key][1] += probability * p
            else:
                waiting[key] = [gone, probability * p]
                heapq.heappush(queue, key)

    enter(0.0, first, 1.0)
    while queue and len(found) <= most:
        key = heapq.heappop(queue)
        gone, probability = waiting.pop(key)
        way = key[1]
        found.append((gone, way, probability))
        if gone + lengths[way // 2] <= reach:
            enter(gone + float(lengths[way // 2]), way, probability)
    return found
