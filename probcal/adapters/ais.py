"""AIS: the positions that ships report, from NMEA sentences through pyais (`probcal[ais]`)."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from probcal.adapters.shared import KNOT, check_frame, extra, file_bytes, instant, reports
from probcal.errors import InputError
from probcal.files import AnyPath
from probcal.geodesy import LocalFrame
from probcal.lazy import pd

SENTENCE = re.compile(r"[!$][A-Z]{2}VD[MO],[^*]*\*[0-9A-Fa-f]{2}")
TAG = re.compile(r"\\([^\\]*)\\")
RECEIVED = re.compile(r"(?:^|,)c:(\d+)")
BESIDE = " \t,;|"  # what parts a column of times from a sentence
REPORTS = (1, 2, 3, 18, 19, 27)  # messages with the position of a ship
NO_SPEED = {27: 63.0}  # knots at or above which a speed is not reported, 102.3 elsewhere


def read_ais(
    source: AnyPath | Iterable[str | bytes],
    frame: LocalFrame,
    *,
    sensor: str = "ais",
    columns: Sequence[str] = ("position", "speed", "course"),
    messages: Sequence[int] = REPORTS,
    times: Sequence[Any] | None = None,
    start: Any = None,
) -> pd.DataFrame:
    """Positions that ships report by AIS, as a table: time (s), sensor, target (the MMSI), and the asked for columns.

    `source` is a file of NMEA sentences (`!AIVDM,...`) or an iterable of them. The time of reception is that of a tag
    block (`c:`), of a column beside the sentence (Unix seconds or ISO), or of `times`, one a line. `columns` are of
    position (`position_x`, `position_y`, m), velocity (m/s), speed (m/s) and course (rad from the x axis of the frame,
    counter-clockwise; AIS reports degrees clockwise from north). Messages of several parts are joined. What is not
    available (91 and 181 degrees) is left out; so are sentences with a wrong checksum. `.attrs["left_out"]` counts
    these, `.attrs["start"]` is the instant of time 0: the first report, or `start` (datetime, ISO text, Unix seconds).
    With `columns="position"` a `Problem` takes it, the ships as targets of `sensors.position`; `Known` and `Truth` take
    the rows of a ship. Raises `InputError`.

    >>> import probcal.adapters as adapters
    >>> adapters.read_ais("none.nmea", LocalFrame(54.3, 10.1))
    Traceback (most recent call last):
    ...
    probcal.errors.InputError: none.nmea: no such file
    """
    check_frame("read_ais", frame)
    what, lines = _lines(source)
    decode = extra("pyais", "reading AIS", "ais").decode
    if times is not None and len(times) != len(lines):
        raise InputError(f"{what} has {len(lines)} lines, but {len(times)} times are given; give one a line")
    left: Counter[str] = Counter()
    rows = []
    for stamp, parts in _joined(lines, times, left):
        try:
            message = decode(*parts)
        except Exception:  # whatever pyais says of bits that are no message
            left["unreadable"] += 1
            continue
        if int(message.msg_type) not in messages or not hasattr(message, "lat"):
            left["other messages"] += 1
        elif not (abs(message.lat) <= 90 and abs(message.lon) <= 180):
            left["without a position"] += 1
        elif stamp is None:
            left["without a time"] += 1
        else:
            rows.append((stamp, f"{int(message.mmsi):09d}", float(message.lat), float(message.lon), *_motion(message)))
    counted = {name: left[name] for name in COUNTED}
    stamps, target, *numbers = zip(*rows, strict=True) if rows else ((), ())
    values = np.asarray(numbers, float)
    return reports(
        what, np.array(stamps, np.int64), target, list(values[:2]), list(values[2:]), frame,
        sensor=sensor, columns=columns, start=start, left_out=counted,
    )  # fmt: skip


COUNTED = ("bad checksum", "incomplete", "unreadable", "without a position", "without a time", "other messages")


def _motion(message: Any) -> tuple[float, float]:
    """Speed in m/s and course in degrees from north, NaN where not reported."""
    speed, course = float(getattr(message, "speed", np.nan)), float(getattr(message, "course", np.nan))
    known = speed < NO_SPEED.get(int(message.msg_type), 102.25)
    return (speed * KNOT if known else np.nan), (course if course < 360.0 else np.nan)


def _lines(source: Any) -> tuple[str, list[str]]:
    """Name of a source, and its lines."""
    if isinstance(source, (str, PathLike)):
        return Path(source).name, file_bytes(source).decode("ascii", "replace").splitlines()
    try:
        return "AIS", [line.decode("ascii", "replace") if isinstance(line, bytes) else str(line) for line in source]
    except TypeError:
        raise InputError(f"read_ais: give a path or lines of NMEA sentences, got {type(source).__name__}") from None


def _joined(lines: Sequence[str], times: Any, left: Counter[str]) -> Iterator[tuple[int | None, list[str]]]:
    """Time (ns) and sentences of every whole message; counts those of bad checksum, or that lack a part."""
    open_: dict[tuple[str, ...], tuple[int | None, list[str]]] = {}
    for n, line in enumerate(lines):
        match = SENTENCE.search(line)
        if match is None:
            left["unreadable"] += bool(line.strip()) and "!" in line
            continue
        sentence = match.group()
        if _checksum(sentence) != int(sentence[-2:], 16):
            left["bad checksum"] += 1
            continue
        stamp = _stamp(line, match, n) if times is None else instant(times[n], f"times[{n}]")
        _, count, number, sequence, channel, *_ = (*sentence.split(","), "", "", "")
        if count in ("", "1"):
            yield stamp, [sentence]
            continue
        key = (sentence[1:3], count, sequence, channel)
        if number == "1":
            left["incomplete"] += key in open_
            open_[key] = (stamp, [sentence])
        elif key in open_ and number == str(len(open_[key][1]) + 1):
            first, parts = open_[key]
            open_[key] = (stamp if first is None else first, [*parts, sentence])
            if number == count:
                yield open_.pop(key)
        else:
            left["incomplete"] += 1
            open_.pop(key, None)
    left["incomplete"] += len(open_)


def _checksum(sentence: str) -> int:
    """Exclusive or of what stands between the first sign and the star."""
    found = 0
    for byte in sentence[1:-3].encode("ascii", "replace"):
        found ^= byte
    return found


def _stamp(line: str, match: re.Match[str], n: int) -> int | None:
    """Time of reception of a line in ns: of its tag block, or of what stands before or behind the sentence."""
    for tag in TAG.findall(line):
        received = RECEIVED.search(tag.partition("*")[0])
        if received:
            digits = received.group(1)
            seconds, rest = divmod(int(digits), 1000) if len(digits) > 11 else (int(digits), 0)  # ms or s
            return instant(seconds, f"line {n + 1}: the time of its tag block") + rest * 1_000_000
    for text in (TAG.sub("", line[: match.start()]).strip(BESIDE), line[match.end() :].strip(BESIDE)):
        if text:
            try:
                return instant(float(text), "time")
            except ValueError:
                return instant(text, f"line {n + 1}: what stands beside the sentence")
    return None
