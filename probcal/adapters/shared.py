"""The shared parts of the adapters: late imports, instants, and reported positions in a local
frame."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from probcal.errors import InputError, nearest
from probcal.files import AnyPath
from probcal.geodesy import LocalFrame
from probcal.labels import AXES
from probcal.lazy import pd

SECOND = 1_000_000_000  # ns
LATEST = 146 * 365 * 86400 * SECOND  # ns before and after 1970 of what counts as an instant
KNOT = 1852.0 / 3600.0  # m/s
QUANTITIES = ("position", "velocity", "speed", "course")  # of a reported position; the first two by axis


def extra(module: str, what: str, name: str) -> Any:
    """A module of an optional package; raises `InputError` saying which extra brings it where it is missing."""
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        root = module.split(".")[0]
        if (error.name or "").split(".")[0] not in (root, ""):
            raise
        raise InputError(f'{what} needs the package {root}: pip install "probcal[{name}]"') from None


def file_bytes(path: AnyPath) -> bytes:
    """The content of a file; raises `InputError` naming the file if it cannot be read."""
    try:
        return Path(path).read_bytes()
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read: {getattr(error, 'strerror', None) or error}") from None


def check_frame(what: str, frame: Any) -> None:
    """Raise `InputError` unless a frame takes degrees to metres."""
    if not isinstance(frame, LocalFrame):
        raise InputError(
            f"{what}: frame is {type(frame).__name__}; give LocalFrame(latitude, longitude), that of the nodes"
        )


def instant(value: Any, what: str) -> int:
    """An instant in ns since 1970 (UTC): of a datetime (UTC where it states no zone), ISO text or Unix seconds."""
    found = LATEST
    try:
        if isinstance(value, (int, float, np.number)) and not isinstance(value, bool):
            whole = int(np.floor(value))
            found = whole * SECOND + round((float(value) - whole) * SECOND)
        elif isinstance(value, (str, datetime, np.datetime64)):
            stamp = pd.Timestamp(datetime.fromisoformat(value.strip()) if isinstance(value, str) else value)
            stamp = stamp.tz_localize("UTC") if stamp.tzinfo is None else stamp.tz_convert("UTC")
            found = int(stamp.as_unit("ns").value)
    except (TypeError, ValueError, OverflowError):
        pass
    if not abs(found) < LATEST:
        raise InputError(f"{what} is {value!r}; give a datetime, ISO text or Unix seconds")
    return found


def since(stamps: np.ndarray, start: Any) -> tuple[np.ndarray, str]:
    """Seconds (N,) of instants (N,) in ns since a start (the first of them by default), and that start as ISO text."""
    zero = int(stamps.min()) if start is None else instant(start, "start")
    return (stamps - zero) / SECOND, pd.Timestamp(zero, tz="UTC").isoformat()


def reports(
    what: str,
    stamps: Sequence[int] | np.ndarray,
    target: Iterable[str],
    place: Sequence[np.ndarray],
    motion: Sequence[np.ndarray],
    frame: LocalFrame,
    *,
    sensor: str,
    columns: Sequence[str],
    start: Any,
    left_out: Mapping[str, int],
) -> pd.DataFrame:
    """Reported positions as a table in order of time: time (s), sensor, target and the asked for quantities.

    `place` is latitude and longitude in degrees and perhaps height in m, `motion` speed over ground in m/s, course in
    degrees clockwise from true north and, with heights, climb in m/s, (N,) each and NaN where not reported. A second
    report of one target at one time is left out and counted.
    """
    chosen = _columns(what, columns)
    if not len(stamps):
        counts = ", ".join(f"{number} {name}" for name, number in left_out.items() if number) or "nothing was read"
        raise InputError(f"{what} holds no position with a time: {counts}")
    time, zero = since(np.asarray(stamps, np.int64), start)
    parts = [np.asarray(part, float) for part in place]
    position = frame.to_local(*parts)
    speed, course, climb = (np.asarray(part, float) for part in (*motion, *([np.zeros(len(time))] * 2))[:3])
    angle = np.deg2rad(90.0 - course)
    velocity = _velocity(frame, parts, speed, angle, climb)
    along = _velocity(frame, parts, np.ones(len(time)), angle, np.zeros(len(time)))
    found: dict[str, Any] = {"time": time, "sensor": sensor, "target": list(target)}
    for name in chosen:
        if name in ("position", "velocity"):
            values = position if name == "position" else velocity
            found |= {f"{name}_{axis}": column for axis, column in zip(AXES, values.T, strict=False)}
        else:
            found[name] = speed if name == "speed" else np.arctan2(along[:, 1], along[:, 0])
    table = pd.DataFrame(found).sort_values("time", kind="stable")
    again = table.duplicated(["time", "target"])
    table = table[~again].reset_index(drop=True)
    table.attrs = {"start": zero, "left_out": {**left_out, "repeated": int(again.sum())}}
    return table


def _columns(what: str, columns: Sequence[str]) -> tuple[str, ...]:
    for name in (columns,) if isinstance(columns, str) else columns:
        if name not in QUANTITIES:
            raise InputError(f'{what}: columns names "{name}"{nearest(str(name), QUANTITIES)}')
    return (columns,) if isinstance(columns, str) else tuple(columns)


def _velocity(
    frame: LocalFrame, place: Sequence[np.ndarray], speed: np.ndarray, angle: np.ndarray, climb: np.ndarray
) -> np.ndarray:
    """Velocities (N, d) in the frame of speeds along an angle from the east of each place, and a climb."""
    axes = frame.axes(place[0], place[1])
    local = np.stack([speed * np.cos(angle), speed * np.sin(angle), climb], -1)
    if len(place) == 3:
        return np.einsum("ni,nij->nj", local, axes)
    turn = np.arctan2(axes[:, 0, 1], axes[:, 0, 0])  # of the meridians
    c, s = np.cos(turn), np.sin(turn)
    return np.stack([c * local[:, 0] - s * local[:, 1], s * local[:, 0] + c * local[:, 1]], -1)
