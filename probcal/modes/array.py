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
    """A path: times (T,), places (T, d), covariances (T, d, d)."""

    time: np.ndarray
    place: np.ndarray
    spread: np.ndarray

    def at(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Places and covariances, interpolated."""
        place = np.stack([np.interp(time, self.time, column) for column in self.place.T], -1)
        return place, self.spread[np.searchsorted(self.time, time).clip(0, len(self.time) - 1)]

    def common(self, other: "_Path") -> np.ndarray | None:
        """Times that both have, or None."""
        low, high = max(self.time[0], other.time[0]), min(self.time[-1], other.time[-1])
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
    scene = _Scene({key: _Path(own.time, own.place, own.spread) for key, own in tracks.items()}, sensors, first, level)
    while scene.grown():
        pass
    if len(scene.position) < 2:
        raise InputError("no two sensors see a target at a common time: bearings alone cannot place them")
    time, track = ({name: path[k] for name, path in scene.paths.items()} for k in (0, 1))
    lost = tuple(s for s in sensors if s not in scene.position)
    return Array(first, scene.position, scene.rotation, time, track, tuple(scene.opened), lost)


class _Scene:
    """Sensors and targets placed so far in the axes of the first sensor."""

    def __init__(self, tracks: dict[tuple[str, str], _Path], sensors: list[str], first: str, level: bool):
        d = next(iter(tracks.values())).place.shape[1]
        self.tracks, self.sensors, self.first, self.level = tracks, sensors, first, level
        self.targets = list(dict.fromkeys(k for _, k in tracks))
        self.position, self.rotation = {first: np.zeros(d)}, {first: np.eye(d)}
        self.paths, self.opened = dict[str, _Path](), list[str]()

    def grown(self) -> bool:
        """Place targets whose scale two placed sensors tell, then sensors that share one; whether any was placed."""
        before = len(self.paths) + len(self.position)
        if not self.paths:  # the first one of all
            own = [k for k in self.targets if (self.first, k) in self.tracks]
            best = max(own, key=lambda k: sum((s, k) in self.tracks for s in self.sensors))
            self.paths[best] = self.tracks[self.first, best]
        for target in self.targets:
            if target not in self.paths:
                self._place_target(target, [s for s in self.position if (s, target) in self.tracks])
        for sensor in self.sensors:
            if sensor not in self.position:
                self._place_sensor(sensor)
        return len(self.paths) + len(self.position) > before

    def _place_target(self, target: str, seers: list[str]) -> None:
        """Put a target where one sensor sees it, at the range that the others tell."""
        if len(seers) < 2:
            return
        a = max(seers, key=lambda s: len(self.tracks[s, target].time))
        track, sizes, weights = self.tracks[a, target], [], []
        for b in seers:
            other = self.tracks[b, target]
            time = None if b == a else track.common(other)
            if time is None:
                continue
            (A, CA), (B, CB) = track.at(time), other.at(time)
            found = similarity(B, A, CB, CA, rotation=self.rotation[a].T @ self.rotation[b])
            square = float(found.position @ found.position)
            size = float((self.position[b] - self.position[a]) @ self.rotation[a] @ found.position)
            if size > 0:
                sizes.append(size / max(square, 1e-300))
                weights.append(square / max(float(np.trace(found.spread)), 1e-300))
        if sizes:
            turn = float(np.average(sizes, weights=weights)) * self.rotation[a]
            self.paths[target] = _Path(
                track.time, self.position[a] + track.place @ turn.T, turn @ track.spread @ turn.T
            )

    def _place_sensor(self, sensor: str) -> None:
        """Place a sensor that shares a target with those placed.

        A target of which only the first sensor knows the scale tells of the turn.
        """
        turns, pairs = [], []
        for target in self.targets:
            own = self.tracks.get((sensor, target))
            known = self.paths.get(target, self.tracks.get((self.first, target)))
            time = None if own is None or known is None else known.common(own)
            if own is None or known is None or time is None:
                continue
            (B, CB), (A, CA) = own.at(time), known.at(time)
            turns.append((B, A, 1.0 / np.maximum(np.trace(CB, axis1=1, axis2=2), 1e-300)))
            if target in self.paths:
                pairs.append((B, A, CB, CA))
        if not pairs:
            return
        turn, sure = turn_of(turns, self.level)
        found = [similarity(*pair, rotation=turn) for pair in pairs]
        found = [f for f in found if f.scale > 0] or found
        information = [pseudo_inverse(f.spread, symmetric=True) for f in found]
        total = pseudo_inverse(sum(information), symmetric=True)
        self.position[sensor] = total @ sum(J @ f.position for J, f in zip(information, found, strict=True))
        self.rotation[sensor] = turn
        self.opened += [sensor] * (not sure)
