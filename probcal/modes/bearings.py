"""Starts for sensors that see directions: triangulation for open headings, similar triangles for open places too."""

from collections.abc import Iterator

import numpy as np

from probcal.errors import InputError
from probcal.gaussian.mode import Point
from probcal.geometry import attitude
from probcal.labels import AXES
from probcal.linalg import nearest_rotation
from probcal.modes.array import Array, DirectionTrack, match
from probcal.modes.recognise import Directions, kinds, members, seen_directions
from probcal.modes.reflections import node_places
from probcal.modes.straight import StraightTrack, straight_track, wrapped
from probcal.problem import Problem

Turning = dict[str, tuple[int, float]]  # bias that turns the directions of a node, and its sign

WIDE = 0.3  # rad, spread of a heading from which the grid alone is not trusted
LOOSE = 0.2  # spread of a place, in extents of the network, from which triangulation is not
KNOWN = 1e-3  # spread of what is known, in rad and in extents
BENT = 4.0  # weighted square of a bearing above which a target is cut in two
SHORT = 8  # bearings of a piece of a path
TURNED = 4.0  # standard deviations that a bearing must turn to tell a path
PIECES = 8  # pieces of a path
HEADINGS = 72  # headings a circle that are tried for each of two sensors
PAIRS = 3  # pairs of sensors from which the others are found
KEPT = 2  # headings of a pair that are kept
SAMPLES = 60  # crossings of lines of sight that are looked at


def by_directions(problem: Problem) -> Iterator[np.ndarray]:
    """Biases (M,) that may stand for a network whose headings, or places too, are open: none where they are not."""
    own = members(problem)
    spread = {node: {name: problem.scales[m] for name, m in part.items()} for node, part in own.items()}
    turning = _turning(problem)
    wide = [n for n, (m, _) in turning.items() if problem.scales[m] > WIDE]
    loose = [n for n, part in spread.items() if max((s for c, s in part.items() if c.startswith("position")), default=0)
             > LOOSE * _extent(problem)]  # fmt: skip
    if not wide and not loose:
        return
    seen = seen_directions(problem)
    if len({s.node for s in seen}) < 2:
        return
    matched = list(_matched(problem, seen, turning)) if loose else []
    yield from matched
    if wide and not matched:
        yield from _triangulated(problem, seen, turning)


def _extent(problem: Problem) -> float:
    """Diagonal of the stated places in m, or 1 where they are all one."""
    return float(np.linalg.norm(np.ptp(problem.node_positions, axis=0))) or 1.0


def _turning(problem: Problem) -> Turning:
    """Bias that turns the directions of each node, by its number, and the sign with which it adds to the heading."""
    own, known = members(problem), kinds(problem)
    found = {node: (part["heading"], 1.0) for node, part in own.items() if "heading" in part}
    for m, bias in enumerate(problem.biases):
        for sensor in problem.network.sensors:
            if sensor.name != bias.owner or len(sensor.nodes) != 1 or sensor.nodes[0].name in found:
                continue
            for (kind, _), what in known.items():
                if kind == sensor.type.name and what.family == "azimuth" and abs(what.by.get(bias.component, 0)) == 1:
                    found[sensor.nodes[0].name] = (m, -what.sign * what.by[bias.component])
    return found


def _stated(problem: Problem) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """Stated places (d,) and headings of the nodes at rest, held biases added."""
    place = node_places(problem, np.zeros(problem.model.biases))
    turning = {n.name for s in problem.network.sensors if "heading" in s.type.pose_components for n in s.nodes}
    turn = {
        n.name: float(n.components["heading"]) + problem.fixed.get(f"{n.name}.heading", 0.0)
        for n in problem.network.nodes
        if n.name in place
    }
    return place, {name: angle if name in turning else 0.0 for name, angle in turn.items()}


def turned(problem: Problem, point: Point) -> np.ndarray | None:
    """Biases z (M,) of a point with wide headings turned so that the directions agree with its track; None without any.

    A sensor that sees a range too has a good track whatever its heading; where that is off by half a turn the wrapped
    innovations of the directions cancel, and no descent moves it.
    """
    turning = {n: t for n, t in _turning(problem).items() if problem.scales[t[0]] > WIDE}
    if not turning:
        return None
    place, turn = _stated(problem)
    z = np.array(point.z)
    total: dict[str, complex] = {}
    tracks = {name: (time, track) for name, time, track in problem.tracks(problem.positions(point.states))}
    for s in seen_directions(problem):
        if s.node in turning:
            time, track = tracks[s.target]
            line = track[np.searchsorted(time, s.time).clip(0, len(time) - 1)] - place[s.node]
            off = np.arctan2(line[:, 1], line[:, 0]) - s.angles[:, 0]
            total[s.node] = total.get(s.node, 0.0) + complex(np.exp(1j * off).sum())
    for name, sum_ in total.items():
        _turn(problem, z, turning, name, float(np.angle(sum_)) - turn[name])
    return z if total else None


# -- headings: crossings of lines of sight ---------------------------------------------------------------------------


def _triangulated(problem: Problem, seen: list[Directions], turning: Turning) -> Iterator[np.ndarray]:
    """Headings for which the lines of sight of all sensors cross, the places taken as stated (triangulation)."""
    place, turn = _stated(problem)
    names = list(dict.fromkeys(s.node for s in seen))
    # azimuths (rows, sensors) at times that two or more sensors share, interpolated between
    # neighbours; else NaN
    shared = list[np.ndarray]()
    for target in dict.fromkeys(s.target for s in seen):
        mine = [s for s in seen if s.target == target]
        times = np.unique(np.concatenate([s.time for s in mine]))
        table = np.full((len(times), len(names)), np.nan)
        for s in mine:
            gap = 3 * np.median(np.diff(s.time)) if len(s.time) > 1 else 0.0
            angle = np.interp(times, s.time, np.unwrap(s.angles[:, 0]))
            near = np.abs(times[:, None] - s.time).min(1) <= gap
            table[:, names.index(s.node)] = np.where(near & (times >= s.time[0]) & (times <= s.time[-1]), angle, np.nan)
        shared.append(table[np.isfinite(table).sum(1) >= 2])
    table = np.concatenate(shared) if shared else np.zeros((0, len(names)))
    if not len(table):
        return
    there = np.isfinite(table)
    pairs = [(i, j, int((there[:, i] & there[:, j]).sum())) for i in range(len(names)) for j in range(i)]
    reach = [(n * np.linalg.norm(place[names[i]][:2] - place[names[j]][:2]), i, j) for i, j, n in pairs if n >= 2]
    tried: list[tuple[float, np.ndarray]] = []
    for _, i, j in sorted(reach, reverse=True)[:PAIRS]:
        grids = [_headings(problem, names[k], turn, turning) for k in (i, j)]
        rows = np.flatnonzero(there[:, i] & there[:, j])
        rows = rows[np.linspace(0, len(rows) - 1, min(SAMPLES, len(rows))).astype(int)]
        places = np.array([place[n][:2] for n in names])
        for loss, headings in _crossed(table[rows], places, i, j, grids)[:KEPT]:
            tried.append((loss, headings))
    for _, headings in sorted(tried, key=lambda pair: pair[0])[: 2 * KEPT]:
        z = np.zeros(len(problem.labels))
        for name, heading in zip(names, headings, strict=True):
            _turn(problem, z, turning, name, heading - turn[name])
        yield z


def _turn(problem: Problem, z: np.ndarray, turning: Turning, name: str, by: float) -> None:
    """Turn a node by an angle in rad, where a bias of it does."""
    if name in turning and np.isfinite(by):
        m, sign = turning[name]
        unit = np.pi / 180 if problem.biases[m].unit == "deg" else 1.0
        z[m] = sign * wrapped(by) / unit / problem.scales[m]


def _headings(problem: Problem, name: str, turn: dict[str, float], turning: Turning) -> np.ndarray:
    """Headings of a node that are tried: around the stated one, as far as its spread goes."""
    spread = problem.scales[turning[name][0]] if name in turning else 0.0
    if spread == 0.0:
        return np.array([turn[name]])
    half = min(3 * spread, np.pi)
    count = max(int(HEADINGS * half / np.pi), 5)
    return turn[name] + np.linspace(-half, half, count, endpoint=half < np.pi)


def _crossed(
    table: np.ndarray, places: np.ndarray, i: int, j: int, grids: list[np.ndarray]
) -> list[tuple[float, np.ndarray]]:
    """Losses and headings (sensors,) for the headings of two sensors on a grid, the best that lie apart first."""
    A, B = (own.ravel() for own in np.meshgrid(*grids, indexing="ij"))
    sight_i, sight_j = (np.exp(1j * (own[:, None] + table[:, k])) for own, k in ((A, i), (B, j)))
    place, sine = places @ [1.0, 1j], np.imag(sight_i.conj() * sight_j)
    sine = np.where(np.abs(sine) < 1e-3, 1e-3, sine)
    base = np.conj(place[j] - place[i])
    reach = np.imag(base * sight_j) / sine
    behind = (reach < 0) | (np.imag(base * sight_i) / sine < 0)
    crossing, loss = place[i] + reach * sight_i, behind.mean(1)  # (grid, rows), (grid,)
    headings = np.full((len(loss), len(place)), np.nan)
    headings[:, i], headings[:, j] = A, B
    for k in range(len(place)):
        there = np.isfinite(table[:, k])
        if k not in (i, j) and there.any():
            off = np.angle(crossing[:, there] - place[k]) - table[there, k]
            mean = (np.exp(1j * off) * ~behind[:, there]).mean(1)
            headings[:, k] = np.angle(mean)
            loss = loss + (1 - np.abs(mean)) * there.mean()
    order = np.argsort(loss, kind="stable")
    kept: list[tuple[float, np.ndarray]] = []
    for o in order:
        apart = all(np.abs(np.exp(1j * (headings[o, [i, j]] - other[[i, j]])) - 1).max() > 0.5 for _, other in kept)
        if apart:
            kept.append((float(loss[o]), headings[o]))
        if len(kept) == KEPT:
            break
    return kept


# -- places too: similar triangles -----------------------------------------------------------------------------------


def _matched(problem: Problem, seen: list[Directions], turning: Turning) -> Iterator[np.ndarray]:
    """Places and turns of the sensors by similar triangles, laid on what is stated of the network (DOA paper)."""
    level = problem.network.dimension == 3 and not any(
        {"pitch", "roll"} & set(part) for part in members(problem).values()
    )
    tracks: dict[tuple[str, str], DirectionTrack] = {}
    for target in dict.fromkeys(s.target for s in seen):
        for piece, own in enumerate(_straight([s for s in seen if s.target == target])):
            tracks |= {(node, f"{target} {piece}"): track for node, track in own.items()}
    try:
        array = match(tracks, level=level)
    except InputError:
        return
    yield from laid(problem, array, turning)


def _straight(seen: list[Directions]) -> Iterator[dict[str, StraightTrack]]:
    """Single-sensor tracks by node of the pieces of one target that are nearly straight."""
    low, high = min(s.time[0] for s in seen), max(s.time[-1] for s in seen)
    waiting = [(low, high, 1)]
    while waiting:
        a, b, parts = waiting.pop(0)
        found, bent = {}, 0.0
        for s in seen:
            mine = (s.time >= a) & (s.time <= b)
            if mine.sum() < SHORT:
                continue
            angles = s.angles[mine]
            turned = np.ptp(np.unwrap(angles[:, 0])) / np.median(s.std[mine, 0])
            if turned < TURNED:
                continue
            track = straight_track(s.time[mine], angles, s.std[mine])
            found[s.node] = track
            bent = max(bent, 2 * track.cost / mine.sum() / angles.shape[1])
        if bent > BENT and parts < PIECES:
            middle = 0.5 * (a + b)
            waiting += [(a, middle, 2 * parts), (middle, b, 2 * parts)]
        elif len(found) > 1:
            yield found


def laid(problem: Problem, array: Array, turning: Turning) -> Iterator[np.ndarray]:
    """Biases (M,) for which the network is the matched array, moved, turned and scaled onto what is stated of it."""
    place, turn = _stated(problem)
    own, d, extent = members(problem), problem.network.dimension, _extent(problem)
    names, stated = list(array.position), {node.name: node for node in problem.network.nodes}
    P, S = np.array([array.position[n] for n in names]), np.array([place[n] for n in names])
    free = [np.mean([problem.scales[m] for c, m in own[n].items() if c.startswith("position")] or [0.0]) for n in names]
    wp = 1.0 / (np.array(free) ** 2 + (KNOWN * extent) ** 2)
    spread = np.array([problem.scales[turning[n][0]] if n in turning else 0.0 for n in names])
    wh = 1.0 / (spread**2 + KNOWN**2)
    own_turn = np.array([np.arctan2(array.rotation[n][1, 0], array.rotation[n][0, 0]) for n in names])
    want = np.array([turn[n] for n in names]) - own_turn
    w = wp / wp.sum()
    a, b = S - w @ S, P - w @ P
    Q = _turns(a, b, w, want, wh)
    turned = b @ Q.mT
    scale = np.sum(w @ (a * turned), 1) / np.maximum(np.sum(w @ turned**2, 1), 1e-300)
    off = wrapped(np.arctan2(Q[:, 1, :1], Q[:, 0, :1]) - want)
    loss = np.sum(wp @ (a - scale[:, None, None] * turned) ** 2, 1) + off**2 @ wh
    loss = np.where(np.isfinite(loss) & (scale > 0), loss, np.inf)
    best = int(loss.argmin())
    if not np.isfinite(loss[best]):
        return
    similar = scale[best] * Q[best]
    shift = w @ S - similar @ (w @ P)
    z = np.zeros(len(problem.labels))
    for n, p in zip(names, P, strict=True):
        moved = shift + similar @ p - place[n]
        for k in range(d):
            if (m := own[n].get(f"position_{AXES[k]}")) is not None:
                z[m] = moved[k] / problem.scales[m]
        angles = attitude(Q[best] @ array.rotation[n])
        _turn(problem, z, turning, n, float(angles["heading"]) - turn[n])
        for name in ("pitch", "roll"):
            if name in own[n] and name in angles:
                m = own[n][name]
                z[m] = (float(angles[name]) - stated[n].components[name]) / problem.scales[m]
    yield z


def _turns(a: np.ndarray, b: np.ndarray, w: np.ndarray, want: np.ndarray, wh: np.ndarray) -> np.ndarray:
    """Turns (K, d, d) that are tried for the whole array: all around, by its headings, and by its places."""
    (ax, ay), (bx, by) = a[:, :2].T, b[:, :2].T
    own = np.arctan2(w @ (bx * ay - by * ax), w @ (bx * ax + by * ay))
    angles = [*np.linspace(-np.pi, np.pi, 360, endpoint=False), np.angle(wh @ np.exp(1j * want)), *want, own]
    Q = np.tile(np.eye(a.shape[1]), (len(angles), 1, 1))
    c, s = np.cos(angles), np.sin(angles)
    Q[:, :2, :2] = np.moveaxis(np.array([[c, -s], [s, c]]), 2, 0)
    return np.concatenate([Q, nearest_rotation((a * w[:, None]).T @ b)[0][None]]) if len(Q[0]) == 3 else Q
