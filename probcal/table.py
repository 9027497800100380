"""The long table of rows, `time, sensor, [target], <a column a channel>`, checked at the door."""

import re
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from probcal.network import Network
from probcal.noise import Bernoulli
from probcal.types import InputError, nearest

# unit -> (quantity, factor to its base); offsets do not occur
UNITS = {
    "m": ("length", 1.0), "km": ("length", 1e3), "cm": ("length", 1e-2), "mm": ("length", 1e-3),
    "ft": ("length", 0.3048), "mi": ("length", 1609.344), "nmi": ("length", 1852.0),
    "rad": ("angle", 1.0), "mrad": ("angle", 1e-3), "deg": ("angle", np.pi / 180), "°": ("angle", np.pi / 180),
    "s": ("time", 1.0), "ms": ("time", 1e-3), "us": ("time", 1e-6), "ns": ("time", 1e-9), "min": ("time", 60.0),
    "h": ("time", 3600.0), "m/s": ("speed", 1.0), "km/h": ("speed", 1 / 3.6), "Hz": ("frequency", 1.0),
    "kHz": ("frequency", 1e3), "dB": ("level", 1.0), "dBm": ("power level", 1.0), "1": ("ratio", 1.0),
    "%": ("ratio", 1e-2), "T": ("magnetic field", 1.0), "uT": ("magnetic field", 1e-6),
    "nT": ("magnetic field", 1e-9),
}  # fmt: skip
HEADER = re.compile(r"^\s*(?P<name>[^\[\]]+?)\s*(\[\s*(?P<unit>[^\]]*?)\s*\])?\s*$")


@dataclass(frozen=True, eq=False)
class Table:
    """A table as read, not yet checked against a network: the frame, its name, and the line of each row."""

    frame: pd.DataFrame
    source: str
    lines: np.ndarray

    def where(self, row: int) -> str:
        """Name of a row in complaints: the line of the file (the header is line 1), or the index of a frame."""
        return f"{self.source} row {self.lines[row]}"


@dataclass(frozen=True, eq=False)
class Measurements:
    """Checked rows: times (N,) in s, sensor and target numbers (N,), values and stds (N, channels), no NaN.

    `measured` marks the data that exist; `std` is NaN-free with `has_std` marking rows that bring their own.
    """

    time: np.ndarray
    sensor: np.ndarray
    target: np.ndarray
    target_names: tuple[str, ...]
    channels: tuple[str, ...]
    value: np.ndarray
    measured: np.ndarray
    std: np.ndarray
    has_std: np.ndarray
    table: Table


def read_table(source: str | PathLike[str] | pd.DataFrame | Table) -> Table:
    """Read a CSV file or take a DataFrame; raises `InputError` naming the file if it is not a table."""
    if isinstance(source, Table):
        return source
    if isinstance(source, pd.DataFrame):
        return Table(source.reset_index(drop=True), "data", np.asarray(source.index))
    if not isinstance(source, (str, PathLike)):
        raise InputError(f"data must be a path or a DataFrame, got {type(source).__name__}")
    path = Path(source)
    try:
        frame = pd.read_csv(path, skip_blank_lines=False, encoding="utf-8-sig", low_memory=False)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (UnicodeDecodeError, pd.errors.ParserError, pd.errors.EmptyDataError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"{path.name} is not a CSV table with a header line: {reason}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    lines = np.arange(2, len(frame) + 2)
    blank = frame.isna().all(axis=1).to_numpy()
    return Table(frame[~blank].reset_index(drop=True), path.name, lines[~blank])


def measure(table: Table, network: Network) -> Measurements:
    """Check a table against a network; every complaint names file, row and column and says what to do."""
    names, units = _header(table)
    frame = table.frame.set_axis(names, axis=1)
    for column in ("time", "sensor"):
        if column not in names:
            raise InputError(f'{table.source} has no column "{column}"{nearest(column, names)}')
    channels = network.channel_names
    allowed = ["time", "sensor", "target", *channels, *(f"{c}_std" for c in channels)]
    for name in names:
        if name not in allowed:
            raise InputError(f'{table.source} column "{name}" is not a channel of the network{nearest(name, allowed)}')
    if frame.empty:
        raise InputError(f"{table.source} has no rows")
    sensor = _sensors(table, frame["sensor"], network)
    time = _times(table, frame["time"], units["time"])
    target_names, target = _targets(table, frame.get("target"), len(frame))
    shape = (len(frame), len(channels))
    value, std = np.zeros(shape), np.zeros(shape)
    measured, has_std = np.zeros(shape, bool), np.zeros(shape, bool)
    for j, name in enumerate(channels):
        if name in names:
            value[:, j], measured[:, j] = _numbers(table, frame[name], name)
        if f"{name}_std" in names:
            std[:, j], has_std[:, j] = _numbers(table, frame[f"{name}_std"], f"{name}_std")
        _check_stds(table, f"{name}_std", std[:, j], has_std[:, j])
        _to_channel(table, network, name, j, sensor, units, value, std, measured)
    result = Measurements(time, sensor, target, target_names, channels, value, measured, std, has_std & measured, table)
    _check_duplicates(result, network)
    return result


def _header(table: Table) -> tuple[list[str], dict[str, str | None]]:
    names, units = [], {}
    for column in table.frame.columns:
        found = HEADER.match(str(column))
        if found is None:
            raise InputError(f'{table.source} column "{column}": write the header as name or name [unit]')
        name, unit = found["name"], found["unit"]
        if name in units:
            raise InputError(f'{table.source} has the column "{name}" twice')
        if unit is not None and unit not in UNITS:
            raise InputError(f'{table.source} column "{name}": unit "{unit}" is not known{nearest(unit, UNITS)}')
        names.append(name)
        units[name] = unit
    return names, units


def _numbers(table: Table, column: pd.Series, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Values with zeros where blank, and which are there."""
    numbers = pd.to_numeric(column, errors="coerce").to_numpy(float, na_value=np.nan)
    text = np.flatnonzero(np.isnan(numbers) & column.notna().to_numpy())
    if len(text):
        raise InputError(
            f'{table.where(text[0])} column "{name}": "{column.iloc[text[0]]}" is no number; leave it blank'
        )
    infinite = np.flatnonzero(np.isinf(numbers))
    if len(infinite):
        raise InputError(f'{table.where(infinite[0])} column "{name}": the value is infinite; leave it blank')
    there = ~np.isnan(numbers)
    return np.where(there, numbers, 0.0), there


def _times(table: Table, column: pd.Series, unit: str | None) -> np.ndarray:
    dates = pd.api.types.is_datetime64_any_dtype(column)
    if pd.api.types.is_timedelta64_dtype(column):
        column = column.dt.total_seconds()
    numeric = pd.Series(np.nan, column.index) if dates else pd.to_numeric(column, errors="coerce")
    if numeric.isna().all() and column.notna().any():  # a column of dates: seconds since the first one
        stamps = pd.to_datetime(column, errors="coerce", utc=True, format=None if dates else "ISO8601")
        if stamps.notna().any():
            numeric = (stamps - stamps.min()).dt.total_seconds()
            unit = "s"
    values = numeric.to_numpy(float, na_value=np.nan)
    bad = np.flatnonzero(~np.isfinite(values))
    if len(bad):
        given = column.iloc[bad[0]]
        raise InputError(
            f'{table.where(bad[0])} column "time": {given} is not a finite time; give seconds or ISO dates'
        )
    quantity, factor = UNITS[unit or "s"]
    if quantity != "time":
        raise InputError(f'{table.source} column "time": unit "{unit}" is not a time; use s, ms, us, ns, min or h')
    return values * factor


def _name(value: Any) -> str:
    """A sensor or target name as text: 1, 1.0 and " 1" are one name."""
    return str(int(value)) if isinstance(value, float) and value.is_integer() else str(value).strip()


def _sensors(table: Table, column: pd.Series, network: Network) -> np.ndarray:
    number = {placed.name: k for k, placed in enumerate(network.sensors)}
    text = column.map(_name)
    found = text.map(number)
    unknown = np.flatnonzero(found.isna().to_numpy())
    if len(unknown):
        name = "blank" if pd.isna(column.iloc[unknown[0]]) else f'"{text.iloc[unknown[0]]}"'
        raise InputError(
            f"{table.where(unknown[0])}: sensor {name} is not in the network{nearest(text.iloc[unknown[0]], number)}"
        )
    return found.to_numpy(int)


def _targets(table: Table, column: pd.Series | None, rows: int) -> tuple[tuple[str, ...], np.ndarray]:
    if column is None:
        return ("target",), np.zeros(rows, int)
    blank = np.flatnonzero(column.isna().to_numpy())
    if len(blank):
        raise InputError(f'{table.where(blank[0])} column "target" is blank; name the target or drop the column')
    codes, names = pd.factorize(column.map(_name))
    return tuple(names), codes


def _check_stds(table: Table, name: str, std: np.ndarray, given: np.ndarray) -> None:
    bad = np.flatnonzero(given & (std <= 0))
    if len(bad):
        raise InputError(f'{table.where(bad[0])} column "{name}": std is {std[bad[0]]:g}; it must be positive')


def _to_channel(
    table: Table, network: Network, name: str, j: int, sensor: np.ndarray, units: dict[str, str | None],
    value: np.ndarray, std: np.ndarray, measured: np.ndarray,
) -> None:  # fmt: skip
    """Convert a column to the unit of each sensor's channel, in place, and check that the sensors have it."""
    for k, placed in enumerate(network.sensors):
        rows = (sensor == k) & measured[:, j]
        channel = dict(placed.type.expand(network.dimension)).get(name)
        if channel is None:
            if rows.any():
                row = int(np.flatnonzero(rows)[0])
                own = ", ".join(n for n, _ in placed.type.expand(network.dimension))
                raise InputError(
                    f'{table.where(row)} column "{name}": sensor "{placed.name}" ({placed.type.name}) has no such '
                    f"channel, it measures {own}; leave the cell blank"
                )
            continue
        for column, array in ((name, value), (f"{name}_std", std)):
            array[sensor == k, j] *= _factor(table, column, units.get(column), channel.unit)
        if isinstance(channel.noise, Bernoulli):
            wrong = np.flatnonzero(rows & ~channel.noise.check(value[:, j]))
            if len(wrong):
                raise InputError(f'{table.where(wrong[0])} column "{name}": {value[wrong[0], j]:g} is not 0 or 1')


def _factor(table: Table, name: str, unit: str | None, wanted: str) -> float:
    if unit is None or unit == wanted:
        return 1.0
    if wanted not in UNITS:
        raise InputError(f'{table.source} column "{name}": unit "{unit}", but the channel is in "{wanted}"')
    quantity, factor = UNITS[unit]
    if quantity != UNITS[wanted][0]:
        raise InputError(
            f'{table.source} column "{name}": unit "{unit}" is no {UNITS[wanted][0]}; the channel is in {wanted}'
        )
    return factor / UNITS[wanted][1]


def _check_duplicates(data: Measurements, network: Network) -> None:
    for j, name in enumerate(data.channels):
        rows = np.flatnonzero(data.measured[:, j])
        columns = (data.time[rows], data.sensor[rows], data.target[rows])
        frame = pd.DataFrame(dict(zip(("time", "sensor", "target"), columns, strict=True)))
        repeated = np.flatnonzero(frame.duplicated().to_numpy())
        if len(repeated):
            again = rows[repeated[0]]
            same = (
                (data.time == data.time[again])
                & (data.sensor == data.sensor[again])
                & (data.target == data.target[again])
            )
            first = int(np.flatnonzero(same & data.measured[:, j])[0])
            raise InputError(
                f'{data.table.where(again)}: sensor "{network.sensors[data.sensor[again]].name}" has a second '
                f'"{name}" at time {data.time[again]:g} (first in row {data.table.lines[first]}); keep one'
            )
