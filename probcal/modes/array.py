"""Self-calibration of an array from directions alone: each sensor's own tracks, matched by similar triangles."""

from collections.abc import Mapping
from typing import NamedTuple, Protocol

import numpy as np

from probcal.errors import InputError
from probcal.linalg import pseudo_inverse
from probcal.modes.triangles import similarity, turn_of

POINTS = 20  # times at which two tracks are compared


class DirectionTrack(Protocol):
    """A target in the axes of one sensor, up to scale."""

    @property
    def time(self) -> np.ndarray:
        """Times (T,)."""

    @property
    def place(self) -> np.ndarray:
        """Places (T, d) relative to the sensor."""

    @property
    def velocity(self) -> np.ndarray:
        """Velocities (T, d)."""

    @property
    def spread(self) -> np.ndarray:
        """Covariances (T, d, d) of the places."""


class Array(NamedTuple):
    """Sensors and targets in the axes of a reference sensor, in units of the first range of its first target.

    `position` (d,) and `rotation` (d, d; own axes to those of the reference) by sensor, `time` (T,) and `track` (T, d)
    by target; `open` names the sensors whose turn a straight path in space leaves open, `lost` those not reached.
    """

    reference: str
    position: dict[str, np.ndarray]
    rotation: dict[str, np.ndarray]
    time: dict[str, np.ndarray]
    track: dict[str, np.ndarray]
    open: tuple[str, ...]
    lost: tuple[str, ...]


class _Path(NamedTuple):
    """A path in a common frame: times (T,), places (T, d), covariances (T, d, d)."""

    time: np.ndarray
    place: np.ndarray
    spread: np.ndarray

    def at(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Places and covariances, interpolated."""
        place = np.stack([np.interp(time, self.time, column) for column in self.place.T], -1)
        return place, self.spread[np.searchsorted(self.time, time).clip(0, len(self.time) - 1)]


def _at(track: DirectionTrack, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places (T, d) of a sensor's own track at times within it, straight on from the nearest, covariances (T, d, d)."""
    near = np.abs(time[:, None] - track.time).argmin(1)
    return track.place[near] + (time - track.time[near])[:, None] * track.velocity[near], track.spread[near]


def _common(a: np.ndarray, b: np.ndarray) -> np.ndarray | None:
    """Times that two tracks share, or None."""
    low, high = max(a[0], b[0]), min(a[-1], b[-1])
    return np.linspace(low, high, POINTS) if high > low else None


def match(
    tracks: Mapping[tuple[str, str], DirectionTrack], *, reference: str | None = None, level: bool = False
) -> Array:
    """Places and turns of sensors from their own tracks of the same targets (similar triangles; DOA paper, section 3).

    `tracks` by (sensor, target), each up to scale, at times of its own. The `reference` (the sensor with the most
    bearings) is the origin; its axes and the first range of its first target are the frame and the unit, as directions
    alone leave them open. Each further sensor is matched on all targets that it shares with what is known, its turn
    from all of them together, its place averaged over them with their covariances; what shares no target with the
    reference follows through others. `level` says that pitch and roll are known: only headings turn. Raises
    `InputError` where there is one sensor only, or no two share a target at a common time.

    >>> t = np.arange(30.0)
    >>> path = np.stack([4.0 + 0.1 * t, 3.0 - 0.3 * t], 1)
    >>> from probcal.doa import bearing_track
    >>> seen = {"a": path, "b": path - [1.0, 2.0]}  # b is turned by 0.5 rad
    >>> angle = {s: np.arctan2(p[:, 1], p[:, 0]) - 0.5 * (s == "b") for s, p in seen.items()}
    >>> found = match({(s, "boat"): bearing_track(t, a, 1e-4) for s, a in angle.items()}, reference="a")
    >>> np.round(found.position["b"] * 5.0, 2).tolist()  # the first range of sensor a is 5 m
    [1.0, 2.0]
    """
    sensors = list(dict.fromkeys(s for s, _ in tracks))
    if len(sensors) < 2:
        raise InputError("bearings of one sensor alone say nothing of places: give two sensors that see a target")
    rows = {s: sum(len(t.time) for (own, _), t in tracks.items() if own == s) for s in sensors}
    first = max(sensors, key=lambda s: rows[s]) if reference is None else reference
    if first not in sensors:
        raise InputError(f'match: reference "{reference}" has no track; give one of {", ".join(sensors)}')
    d = next(iter(tracks.values())).place.shape[1]
    position, rotation = {first: np.zeros(d)}, {first: np.eye(d)}
    paths: dict[str, _Path] = {}
    opened: list[str] = []
    while True:
        moved = _reach_targets(tracks, position, rotation, paths)
        moved |= _reach_sensors(tracks, position, rotation, paths, opened, level)
        if not moved:
            break
    if len(position) < 2:
        raise InputError("no two sensors see a target at a common time: bearings alone cannot place them")
    lost = tuple(s for s in sensors if s not in position)
    return Array(
        first,
        position,
        rotation,
        {k: p.time for k, p in paths.items()},
        {k: p.place for k, p in paths.items()},
        tuple(opened),
        lost,
    )


def _targets(tracks: Mapping[tuple[str, str], DirectionTrack], sensor: str) -> list[str]:
    return [target for s, target in tracks if s == sensor]


def _reach_targets(
    tracks: Mapping[tuple[str, str], DirectionTrack],
    position: dict[str, np.ndarray],
    rotation: dict[str, np.ndarray],
    paths: dict[str, _Path],
) -> bool:
    """Put targets into the frame whose scale two placed sensors tell, or the first one of all; whether any was."""
    moved = False
    if not paths:
        (first,) = position
        own = _targets(tracks, first)
        if own:
            best = max(own, key=lambda k: sum(k in _targets(tracks, s) for s in dict.fromkeys(s for s, _ in tracks)))
            track = tracks[first, best]
            paths[best] = _Path(track.time, track.place, track.spread)
            moved = True
    for target in dict.fromkeys(k for _, k in tracks):
        seers = [s for s in position if (s, target) in tracks]
        if target in paths or len(seers) < 2:
            continue
        a = max(seers, key=lambda s: len(tracks[s, target].time))
        track, sizes, weights = tracks[a, target], [], []
        for b in seers:
            time = None if b == a else _common(track.time, tracks[b, target].time)
            if time is None:
                continue
            (A, CA), (B, CB) = _at(track, time), _at(tracks[b, target], time)
            turn = rotation[a].T @ rotation[b]
            found = similarity(B, A, CB, CA, rotation=turn)
            apart = rotation[a].T @ (position[b] - position[a])
            sizes.append(float(apart @ found.position) / max(float(found.position @ found.position), 1e-300))
            weights.append(float(found.position @ found.position) / max(float(np.trace(found.spread)), 1e-300))
        good = [k for k, size in enumerate(sizes) if size > 0]
        if good:
            scale = float(np.average([sizes[k] for k in good], weights=[weights[k] for k in good]))
            place = position[a] + scale * track.place @ rotation[a].T
            paths[target] = _Path(track.time, place, scale**2 * rotation[a] @ track.spread @ rotation[a].T)
            moved = True
    return moved


def _reach_sensors(
    tracks: Mapping[tuple[str, str], DirectionTrack],
    position: dict[str, np.ndarray],
    rotation: dict[str, np.ndarray],
    paths: dict[str, _Path],
    opened: list[str],
    level: bool,
) -> bool:
    """Place the sensors that share a target with those placed; whether any was.

    A target of which only the reference sensor knows the scale may serve too: its scale is found with the places.
    """
    moved = False
    (first, *_) = position
    for sensor in dict.fromkeys(s for s, _ in tracks):
        if sensor in position:
            continue
        pairs, turns = [], []
        for target in _targets(tracks, sensor):
            own = tracks[sensor, target]
            known = paths.get(target)
            if known is None and (first, target) in tracks:  # its scale is open, its shape is not
                other = tracks[first, target]
                known = _Path(other.time, other.place, other.spread)
            time = None if known is None else _common(known.time, own.time)
            if known is None or time is None:
                continue
            (B, CB), (A, CA) = _at(own, time), known.at(time)
            weight = 1.0 / np.maximum(np.trace(CB, axis1=1, axis2=2), 1e-300)
            turns.append((B, A, weight))
            if target in paths:
                pairs.append((B, A, CB, CA))
        if not pairs:
            continue
        turn, sure = turn_of(turns, level)
        found = [similarity(B, A, CB, CA, rotation=turn) for B, A, CB, CA in pairs]
        found = [f for f in found if f.scale > 0] or found
        information = [pseudo_inverse(f.spread, symmetric=True) for f in found]
        total = pseudo_inverse(sum(information), symmetric=True)
        position[sensor] = total @ sum(J @ f.position for J, f in zip(information, found, strict=True))
        rotation[sensor] = turn
        if not sure:
            opened.append(sensor)
        moved = True
    return moved
