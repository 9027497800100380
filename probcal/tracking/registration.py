"""Two finished lists of tracks, each in its own frame: which tracks are the same, and how the frames lie."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from probcal.errors import InputError
from probcal.labels import AXES
from probcal.lazy import pd
from probcal.linalg import least_squares, pseudo_inverse

FEW = 5  # instants that two tracks share at least
RIVAL = 0.8  # of the seconds explained by the best frame that make another one a rival
ROUNDS = 10  # of matching and least squares
APART = 3.0  # cuts by which the tracks of a rival lie elsewhere


@dataclass(frozen=True, eq=False)
class Registration:
    """The place of the second frame in the first: `first = turn(heading) second + position`, at times
    `second + clock`.

    `sd` holds the standard deviations of heading (rad), position (d,) in m and clock (s), those of straight tracks with
    independent errors of `std` m. `pairs` lists first, second, seconds and rms in m. `rivals` counts other frames that
    explain nearly as much: with one or more the answer is not to be relied on.
    """

    heading: float
    position: np.ndarray
    clock: float
    sd: dict[str, Any]
    std: float
    pairs: pd.DataFrame
    rivals: int

    @property
    def sound(self) -> bool:
        """True if two tracks or more agree, and no other frame explains nearly as much."""
        return len(self.pairs) >= 2 and self.rivals == 0

    def apply(self, tracks: Any) -> pd.DataFrame:
        """Tracks of the second frame in the first one, times put right; other columns stay."""
        frame = pd.DataFrame(tracks).copy()
        columns = [f"position_{axis}" for axis in AXES[: len(self.position)]]
        frame[columns] = in_frame(frame[columns].to_numpy(float), self.heading, self.position)
        frame["time"] = frame["time"] + self.clock
        return frame


def register_tracks(first: Any, second: Any, *, cut: float = 30.0, clock: float = 0.0) -> Registration:
    """Find how two lists of tracks lie to each other, which of them are the same not being known.

    Each is a table (or a path to a CSV file) with the columns time in s, track or target, position_x, position_y
    (position_z) in m: a radar's tracks and a log of AIS or ADS-B, say. The second is turned about the vertical and
    shifted, its clock put right by up to `clock` s. Every pair of tracks that share time proposes a frame (rigid
    least squares, Umeyama 1991); that which lays most seconds of tracks within `cut` m of each other, one to one, is
    refined on all of them. Raises `InputError` for tables without tracks, or where none share enough time.

    >>> import numpy as np, pandas as pd
    >>> t = np.arange(50.0)
    >>> a = pd.DataFrame({"time": t, "track": "a", "position_x": 10 * t, "position_y": 0.1 * t**2})
    >>> b = a.assign(track="b", position_x=a["position_y"], position_y=-a["position_x"])  # turned right by a quarter
    >>> round(float(np.rad2deg(register_tracks(a, b).heading)), 3)
    90.0
    """
    if not (cut > 0 and clock >= 0 and np.isfinite([cut, clock]).all()):
        raise InputError(f"register_tracks(cut={cut}, clock={clock}): give metres above 0 and seconds from 0")
    a, b = _read(first, "first"), _read(second, "second")
    d = next(iter(a.values()))[1].shape[1]
    if next(iter(b.values()))[1].shape[1] != d:
        raise InputError("register_tracks: one table has position_z, the other has not; give both or neither")
    step = 0.5 * cut / max(_speed(a), _speed(b), 1e-9)
    shifts = np.arange(-np.ceil(clock / step), np.ceil(clock / step) + 1) * step if clock > 0 else np.zeros(1)
    proposals = []
    for shift in shifts[np.abs(shifts) <= clock + 1e-9]:
        for x in a.values():
            for y in b.values():
                common = _common(x, y, shift)
                if common is not None:
                    frame = _rigid(*common)
                    if _rms(*common, *frame) < cut:
                        proposals.append((*frame, float(shift)))
    if not proposals:
        raise InputError(
            f"register_tracks: no two tracks share {FEW} instants along which they agree within {cut:g} m; give tracks"
            " of the same time, a wider cut, or a clock"
        )
    found = [(*_matched(a, b, p, cut), p) for p in proposals]
    found.sort(key=lambda f: -f[0])
    kept: list[Any] = []
    for seconds, _pairs, proposal in found[:50]:
        if kept and seconds < RIVAL * found[0][0]:
            break
        refined = _refined(a, b, proposal, cut, clock)
        if all(_far(b, refined.frame, other.frame, cut) for other in kept):
            kept.append(refined)
    kept.sort(key=lambda own: -own.seconds)
    best = kept[0]
    rivals = sum(own.seconds >= RIVAL * best.seconds for own in kept[1:])
    heading, position, shift = best.frame
    sd = {"heading": best.sd[0], "position": best.sd[1 : 1 + d], "clock": best.sd[-1] if clock > 0 else 0.0}
    return Registration(heading, position, shift, sd, best.std, best.pairs, rivals)


Track = tuple[np.ndarray, np.ndarray]  # times (T,), places (T, d)
Frame = tuple[float, np.ndarray, float]  # heading, position, clock


@dataclass(frozen=True, eq=False)
class _Refined:
    frame: Frame
    seconds: float
    sd: np.ndarray
    std: float
    pairs: Any


def _read(source: Any, name: str) -> dict[str, Track]:
    """Tracks by name, in time order."""
    if isinstance(source, (list, dict, pd.DataFrame)):
        frame = pd.DataFrame(source)
    else:
        try:
            frame = pd.read_csv(source)
        except (OSError, ValueError) as error:
            raise InputError(f"register_tracks: the {name} table cannot be read ({error})") from None
    own = "track" if "track" in frame else "target"
    columns = [c for c in ("position_x", "position_y", "position_z") if c in frame]
    for column in ("time", own, "position_x", "position_y"):
        if column not in frame:
            raise InputError(f'register_tracks: the {name} table has no column "{column}"')
    frame = frame[["time", own, *columns]].dropna()
    if frame.empty:
        raise InputError(f"register_tracks: the {name} table has no rows")
    found = {}
    for key, part in frame.groupby(own):
        time, index = np.unique(part["time"].to_numpy(float), return_index=True)
        found[str(key)] = (time, part[columns].to_numpy(float)[index])
    return found


def _speed(tracks: dict[str, Track]) -> float:
    """A speed that most tracks do not exceed, in m/s."""
    steps = [np.linalg.norm(np.diff(x, axis=0), axis=1) / np.diff(t) for t, x in tracks.values() if len(t) > 1]
    return float(np.quantile(np.concatenate(steps), 0.9)) if steps else 0.0


def _common(x: Track, y: Track, shift: float) -> tuple[np.ndarray, np.ndarray] | None:
    """Places (K, d) of both at the instants of the second, put right, that the first covers; None where too few."""
    time = y[0] + shift
    inside = (time >= x[0][0]) & (time <= x[0][-1])
    if inside.sum() < FEW:
        return None
    return np.stack([np.interp(time[inside], x[0], c) for c in x[1].T], 1), y[1][inside]


def _rigid(x: np.ndarray, y: np.ndarray) -> tuple[float, np.ndarray]:
    """Heading and position by which y (K, d) comes closest to x."""
    dx, dy = x - x.mean(0), y - y.mean(0)
    turned = (dy[:, 0] - 1j * dy[:, 1]) @ (dx[:, 0] + 1j * dx[:, 1])
    heading = float(np.angle(turned))
    return heading, x.mean(0) - in_frame(y.mean(0)[None], heading, np.zeros(x.shape[1]))[0]


def in_frame(y: np.ndarray, heading: float, position: np.ndarray) -> np.ndarray:
    """Places (K, d) turned about the vertical through the origin by a heading in rad, then shifted."""
    c, s = np.cos(heading), np.sin(heading)
    plane = np.stack([c * y[:, 0] - s * y[:, 1], s * y[:, 0] + c * y[:, 1], *y[:, 2:].T], 1)
    return plane + position


def _rms(x: np.ndarray, y: np.ndarray, heading: float, position: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum((x - in_frame(y, heading, position)) ** 2, 1))))


def _matched(a: dict[str, Track], b: dict[str, Track], frame: Frame, cut: float) -> tuple[float, list[Any]]:
    """Seconds that a frame explains, and its pairs: first, second, places of both, seconds; one to one."""
    from scipy.optimize import linear_sum_assignment

    heading, position, shift = frame
    seconds = np.zeros((len(a), len(b)))
    held: dict[tuple[int, int], Any] = {}
    for i, x in enumerate(a.values()):
        for j, y in enumerate(b.values()):
            common = _common(x, y, shift)
            if common is not None:
                rms = _rms(*common, heading, position)
                if rms < cut:
                    spent = len(common[1]) * float(np.median(np.diff(y[0])))
                    seconds[i, j] = spent * (1.0 - 0.5 * (rms / cut) ** 2)
                    held[i, j] = common
    rows, columns = linear_sum_assignment(-seconds)
    chosen = [(i, j) for i, j in zip(rows, columns, strict=True) if seconds[i, j] > 0]
    return float(sum(seconds[p] for p in chosen)), [(i, j, *held[i, j], seconds[i, j]) for i, j in chosen]


def _refined(a: dict[str, Track], b: dict[str, Track], frame: Frame, cut: float, clock: float) -> _Refined:
    """The least-squares frame of all pairs that it lays together, and these."""
    names, others = list(a), list(b)
    d = len(frame[1])
    for _ in range(ROUNDS):
        seconds, pairs = _matched(a, b, frame, cut)
        if not pairs:
            break
        heading, position, shift = frame
        J, r = [], []
        for i, j, x, y, _ in pairs:
            off = x - in_frame(y, heading, position)
            turned = in_frame(y, heading, np.zeros(d))
            by = np.zeros((len(y), d, 2 + d))
            by[:, 0, 0], by[:, 1, 0] = -turned[:, 1], turned[:, 0]
            by[:, :, 1 : 1 + d] = np.eye(d)
            if clock > 0:  # a later clock meets the first track where it is later
                time = others[j]
                later = b[time][0] + shift
                inside = (later >= a[names[i]][0][0]) & (later <= a[names[i]][0][-1])
                speed = np.stack([np.gradient(c, a[names[i]][0]) for c in a[names[i]][1].T], 1)
                by[:, :, -1] = -np.stack([np.interp(later[inside], a[names[i]][0], c) for c in speed.T], 1)
            J.append(by.reshape(-1, 2 + d))
            r.append(off.ravel())
        whole, left = np.concatenate(J), np.concatenate(r)
        used = slice(0, 2 + d if clock > 0 else 1 + d)
        step = least_squares(whole[:, used], left)
        step = np.concatenate([step, np.zeros(2 + d - len(step))])
        frame = (heading + step[0], position + step[1 : 1 + d], float(np.clip(shift + step[-1], -clock, clock)))
        if np.abs(step).max() < 1e-9:
            break
    seconds, pairs = _matched(a, b, frame, cut)
    std, sd = np.nan, np.full(2 + d, np.nan)
    rows = []
    for i, j, x, y, spent in pairs:
        rows.append((names[i], others[j], spent, _rms(x, y, frame[0], frame[1])))
    if pairs:
        std = float(np.sqrt(np.sum(left**2) / max(len(left) - whole[:, used].shape[1], 1)))
        covariance = pseudo_inverse(whole[:, used].T @ whole[:, used]) * std**2
        sd[: covariance.shape[0]] = np.sqrt(np.diagonal(covariance))
    table = pd.DataFrame(rows, columns=["first", "second", "seconds", "rms"])
    heading = float((frame[0] + np.pi) % (2 * np.pi) - np.pi)
    return _Refined((heading, frame[1], frame[2]), seconds, sd, std, table)


def _far(b: dict[str, Track], one: Frame, other: Frame, cut: float) -> bool:
    """True if two frames lay the tracks of the second list elsewhere."""
    places = np.concatenate([x for _, x in b.values()])
    away = in_frame(places, one[0], one[1]) - in_frame(places, other[0], other[1])
    return bool(np.sqrt(np.mean(np.sum(away**2, 1))) > APART * cut)
