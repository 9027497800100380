"""The long table of rows, `time, sensor, [target], <a column a channel>`, checked at the door."""

from __future__ import annotations

import io
import warnings
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from decimal import Decimal
from numbers import Number
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from probcal.errors import InputError, check_known, nearest
from probcal.files import AnyPath
from probcal.labels import NOBODY, check_name, escaped, unescaped
from probcal.lazy import pd
from probcal.network import Network
from probcal.noise import Bernoulli, Censored, Heard
from probcal.sensor import Channel, meant_unit

# unit -> (quantity, factor to its base); offsets do not occur
UNITS = {
    unit: (quantity, factor)
    for quantity, units in {
        "length": {
            "m": 1.0, "km": 1e3, "cm": 1e-2, "mm": 1e-3, "ft": 0.3048, "mi": 1609.344, "nmi": 1852.0,
        },
        "angle": {"rad": 1.0, "mrad": 1e-3, "deg": np.pi / 180, "°": np.pi / 180},
        "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0},
        "speed": {"m/s": 1.0, "km/h": 1 / 3.6},
        "frequency": {"Hz": 1.0, "kHz": 1e3},
        "level": {"dB": 1.0},
        "power level": {"dBm": 1.0},
        "ratio": {"1": 1.0, "%": 1e-2},
        "magnetic field": {"T": 1.0, "uT": 1e-6, "nT": 1e-9},
    }.items()
    for unit, factor in units.items()
}  # fmt: skip
BLANK = ("", "nan", "NaN", "NA", "N/A", "n/a", "#N/A", "<NA>", "null", "NULL", "None", "-nan")  # cells without a number
LARGEST = 1e100  # of a cell: what is computed from it, squares included, stays finite
OBJECT = "object"  # the target of detections that name none
NAMES = ("sensor", "target", "node", "name")  # columns whose cells are read as text: 01 stays 01, NA is a name


@dataclass(frozen=True, eq=False)
class Table:
    """A table as read, not yet checked: the frame, its name, the line of each row and what a row is called.

    Rows that are `admitted` have passed the checks of `probcal.plausible` among others that the table lacks.
    """

    frame: pd.DataFrame
    source: str
    lines: np.ndarray
    word: str = "row"
    admitted: bool = False

    def where(self, row: int) -> str:
        """Name of a row in complaints: line of the file (the header is line 1), label or position
        in the frame."""
        return f"{self.source} {self.word} {self.lines[row]}"

    def refuse(self, wrong: np.ndarray, column: str, why: str, values: Any = ()) -> None:
        """Raise `InputError` for the first of some rows (N,) bool; `why` is formatted with its value (N,), if given."""
        if wrong.any():
            row = int(np.argmax(wrong))
            text = why.format(values[row]) if len(values) else why
            raise InputError(f'{self.where(row)} column "{column}"{text}')


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
    weight: np.ndarray  # (N,) how much each row counts, 1 where nothing is said
    detection: np.ndarray  # (N,) whether a row names no target
    floors: Mapping[tuple[int, str], float] = field(default_factory=dict)  # found, by number of the type and channel


def read_table(source: AnyPath | pd.DataFrame | Table) -> Table:
    """Read a CSV file or take a DataFrame; raises `InputError` naming the file if it is not a table.

    >>> import pandas as pd
    >>> table = read_table(pd.DataFrame({"time": [0.0, 1.0], "sensor": "sonar_0", "range": [52.1, None]}))
    >>> table.source
    'data'
    """
    if isinstance(source, Table):
        return source
    if isinstance(source, pd.DataFrame):
        frame = _plain(source.reset_index(drop=True))
        if not source.index.is_unique:  # as of several frames joined: a label would name several rows
            return Table(frame, "data", np.arange(len(frame)), "row at position")
        return Table(frame, "data", np.asarray(source.index))
    if not isinstance(source, (str, PathLike)):
        raise InputError(f"data must be a path or a DataFrame, got {type(source).__name__}")
    path = Path(source)
    try:
        return _parsed(path, path)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None


def _plain(frame: pd.DataFrame) -> pd.DataFrame:
    """Replace cells that pandas cannot compare: an array without axes is its value, masked and
    signalling NaN blank."""
    for k, dtype in enumerate(frame.dtypes):
        column = frame.iloc[:, k] if dtype.kind == "O" else ()
        if {*map(type, column)} & {np.ndarray, type(np.ma.masked), Decimal}:
            blank = [cell is np.ma.masked or (isinstance(cell, Decimal) and cell.is_snan()) for cell in column]
            cells = [None if gone else cell[()] if np.shape(cell) == () and isinstance(cell, np.ndarray) else cell
                     for cell, gone in zip(column, blank, strict=True)]  # fmt: skip
            frame.isetitem(k, pd.Series(cells, dtype=object).array)
    return frame


def read_lines(header: bytes, lines: bytes, name: str, first: int) -> Table:
    """Lines of a CSV file under its header line, the first of them of number `first`; raises `InputError`."""
    return _parsed(Path(name), header.rstrip(b"\r\n") + b"\n" + lines, first)


def _parsed(path: Path, content: Path | bytes, number: int = 2) -> Table:
    form: dict[str, Any] = dict(index_col=False, skip_blank_lines=False, encoding="utf-8-sig", low_memory=False)

    def source() -> Any:
        return io.BytesIO(content) if isinstance(content, bytes) else content

    try:
        first = pd.read_csv(source(), header=None, nrows=1, dtype=str, keep_default_na=False, **form)
        columns = _once(path, first.iloc[0].tolist())
        for mark, name in ((";", "semicolons"), ("\t", "tabs"), ("|", "bars")):
            if any(mark in column for column in columns):
                raise InputError(
                    f"{path.name}: its columns are parted by {name}; write commas, with decimal"
                    f" points in the numbers, or give the DataFrame of pandas.read_csv(path,"
                    f" sep={mark!r}), with decimal=',' where commas are decimal"
                )
        text = [column for column in columns if split_header(column)[0] in NAMES]
        form |= {"na_values": dict.fromkeys(columns, BLANK) | dict.fromkeys(text, ("",)), "keep_default_na": False}
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)
            frame = pd.read_csv(source(), names=columns, header=0, dtype=dict.fromkeys(text, str), **form)
    except (InputError, OSError):
        raise
    except pd.errors.ParserWarning:
        raise InputError(f"{path.name} has rows with more cells than its header; give every column a name") from None
    except Exception as error:  # whatever pandas and the packages that unpack files say of foreign bytes
        raise InputError(f"{path.name} is not a CSV table with a header line: {error}") from None
    lines = np.arange(number, len(frame) + number)
    filled = frame.notna().any(axis=1).to_numpy()
    return Table(frame[filled].reset_index(drop=True), path.name, lines[filled])


def _once(path: Path, columns: list[str]) -> list[str]:
    """Headers of a file, each once."""
    column, count = Counter(columns).most_common(1)[0]
    if count > 1:
        raise InputError(f'{path.name} has the column "{column}" twice')
    return columns


def measure(table: Table, network: Network, *, repeated: bool = False) -> Measurements:
    """Check a table against a network; every complaint names file, row and column and says what to do.

    Data may come twice where rows may be `repeated`.
    """
    names, units = header(table)
    frame = table.frame.set_axis(names, axis=1)
    for column in ("time", "sensor"):
        check_known(column, names, f'{table.source} has no column "{column}"')
    channels = network.channel_names
    allowed = ["time", "sensor", "target", *channels, *(f"{c}_std" for c in channels), "weight"]
    for name in names:
        check_known(name, allowed, f'{table.source} column "{name}" is not a channel of the network')
    if frame.empty:
        raise InputError(f"{table.source} has no rows")
    sensor = _sensors(table, frame["sensor"], network)
    time = _times(table, frame["time"], units["time"])
    detecting = np.array([placed.detection is not None for placed in network.sensors])[sensor]
    reading = np.array([placed.type.reads_target for placed in network.sensors])[sensor]
    target_names, target, unnamed = _targets(table, frame.get("target"), detecting, reading)
    weight = _weights(table, frame["weight"] if "weight" in names and "weight" not in channels else None)
    shape = (len(frame), len(channels))
    value, std = np.zeros(shape), np.zeros(shape)
    measured, has_std = np.zeros(shape, bool), np.zeros(shape, bool)
    floors: dict[tuple[int, str], float] = {}
    for j, name in enumerate(channels):
        below = np.zeros(len(frame), bool)
        if name in names:
            cells, below = _limits(frame[name])
            value[:, j], measured[:, j] = numbers(table, cells, name)
        if f"{name}_std" in names:
            std[:, j], has_std[:, j] = numbers(table, frame[f"{name}_std"], f"{name}_std")
        small = has_std[:, j] & (std[:, j] < 1 / LARGEST)
        table.refuse(small, f"{name}_std", ": std is {:g}; it must be positive, 1e-100 or more", std[:, j])
        _to_channel(table, network, name, j, sensor, units, value, std, measured, below, floors)
    own = has_std & measured
    result = Measurements(
        time, sensor, target, target_names, channels, value, measured, std, own, table, weight, unnamed, floors
    )
    if not repeated:
        _check_duplicates(result, network)
    return result


def split_header(column: object) -> tuple[str, str | None]:
    """Name and unit of a header such as `azimuth [deg]`; the name is empty where it cannot be read."""
    text, unit = str(column).strip(), None
    if text.endswith("]"):
        text, _, unit = text[:-1].partition("[")
        unit = unit.strip()
    return ("" if set("[]") & set(text + (unit or "")) else unescaped(text.strip())), unit


def csv_text(frame: pd.DataFrame, *, header: bool = True) -> str:
    """A table as CSV. Every writer of tables calls it: no text in it is a formula to a spreadsheet
    (`escaped`)."""
    cells = frame.rename(columns=lambda name: escaped(str(name)))
    for k, dtype in enumerate(frame.dtypes):
        if not pd.api.types.is_numeric_dtype(dtype):
            own = frame.iloc[:, k].astype(object)
            cells.isetitem(k, own.map(lambda cell: escaped(cell) if isinstance(cell, str) else cell).array)
    return cells.to_csv(index=False, header=header)


def header(table: Table) -> tuple[list[str], dict[str, str | None]]:
    """Names of the columns in order, and the unit (or None) of each; raises `InputError` naming the column."""
    names: list[str] = []
    units: dict[str, str | None] = {}
    for column in table.frame.columns:
        name, unit = split_header(column)
        if not name:
            raise InputError(f'{table.source} column "{column}": write the header as name or name [unit]')
        check_name(f"{table.source}: a column", name)
        if name in units:
            raise InputError(f'{table.source} has the column "{name}" twice')
        if unit is not None and unit not in UNITS:
            hint = nearest(meant_unit(unit) or unit, UNITS)
            raise InputError(f'{table.source} column "{name}": unit "{unit}" is not known{hint}')
        names.append(name)
        units[name] = unit
    return names, units


def _floats(column: pd.Series) -> np.ndarray:
    """Cells as floats, NaN where a cell is blank or no number."""
    if column.dtype.kind in "mMc" or isinstance(column.dtype, pd.PeriodDtype):  # pandas would count their ticks
        return np.full(len(column), np.nan)
    with np.errstate(over="ignore"):
        try:
            found = pd.to_numeric(column, errors="coerce")
            if found.dtype.kind != "c":
                return found.to_numpy(float, na_value=np.nan)
        except OverflowError:
            pass
        return np.array([_float(cell) for cell in column])


def _float(cell: Any) -> float:
    try:
        return float(cell)
    except (TypeError, ValueError, OverflowError):
        return np.nan


def numbers(table: Table, column: pd.Series, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Values (N,) with zeros where blank, and which are there; raises `InputError` naming row and column."""
    found = _floats(column)
    text = np.isnan(found) & column.notna().to_numpy()
    table.refuse(text, name, ': "{}" is no number; leave it blank', column.to_numpy(object))
    table.refuse(np.isinf(found), name, ": the value is infinite; leave it blank")
    table.refuse(np.abs(found) > LARGEST, name, ": {:g} is too large; leave it blank", found)
    there = ~np.isnan(found)
    return np.where(there, found, 0.0), there


def _times(table: Table, column: pd.Series, unit: str | None) -> np.ndarray:
    values = _floats(column)
    if np.isnan(values).all() and column.notna().any():  # durations or dates
        values, unit = _seconds(column), None
    wrong = ~(np.abs(values) <= LARGEST)
    table.refuse(wrong, "time", ": {} is not a finite time; give seconds or ISO dates", column.to_numpy())
    quantity, factor = UNITS[unit or "s"]
    if quantity != "time":
        raise InputError(f'{table.source} column "time": unit "{unit}" is not a time; use s, ms, us, ns, min or h')
    return values * factor


def _seconds(column: pd.Series) -> np.ndarray:
    """A column of durations in seconds, or of dates in seconds since the first one; NaN where it is neither."""
    if column.dtype.kind == "m":
        return column.dt.total_seconds().to_numpy(float)
    try:
        stamps = _dates(column)
        return (stamps - stamps.min()).dt.total_seconds().to_numpy(float)
    except (TypeError, ValueError, OverflowError):  # objects that are no dates, or dates too far apart
        return np.full(len(column), np.nan)


def _dates(column: pd.Series) -> pd.Series:
    """Dates in UTC, blank where a cell is none."""
    if isinstance(column.dtype, pd.CategoricalDtype):
        column = column.astype(object)
    if column.dtype == object:  # a number among dates is none
        column = column.map(lambda cell: None if isinstance(cell, Number) else cell)
    return pd.to_datetime(column, errors="coerce", utc=True, format=None if column.dtype.kind == "M" else "ISO8601")


def first_date(table: Table) -> str:
    """The date from which the times of a checked table are counted; empty where they are no dates."""
    column = table.frame.iloc[:, header(table)[0].index("time")]
    dated = column.dtype.kind != "m" and np.isnan(_floats(column)).all()
    return str(_dates(column).min().isoformat()) if dated else ""


def name_as_text(value: Any) -> str:
    """A sensor, target or node name as text: 1, 1.0 and " 1" are one name, 01 is another."""
    text = unescaped(str(value).strip())
    whole, _, rest = text.partition(".")
    return whole if rest and not rest.strip("0") and whole.lstrip("-").isdigit() else text


def names_as_text(column: pd.Series) -> np.ndarray:
    """`name_as_text` of every cell (N,), each kind of cell looked at once."""
    alike = column.dtype.kind in "iuf" or pd.api.types.infer_dtype(column, skipna=False) == "string"
    if not alike:
        return np.array([name_as_text(value) for value in column], dtype=object)
    codes, kinds = pd.factorize(column, use_na_sentinel=False)
    return np.array([name_as_text(value) for value in kinds], dtype=object)[codes]


def _sensors(table: Table, column: pd.Series, network: Network) -> np.ndarray:
    number = {name_as_text(placed.name): k for k, placed in enumerate(network.sensors)}
    text = names_as_text(column)
    codes, kinds = pd.factorize(text)
    found = np.array([number.get(name, -1) for name in kinds], int)[codes]
    blank = column.isna().to_numpy()
    found[blank] = -1
    unknown = np.flatnonzero(found < 0)
    if len(unknown):
        row = unknown[0]
        name = "blank" if blank[row] else f'"{text[row]}"'
        raise InputError(f"{table.where(row)}: sensor {name} is not in the network{nearest(text[row], number)}")
    return found


def _targets(
    table: Table, column: pd.Series | None, detecting: np.ndarray, reading: np.ndarray
) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """Names of the targets, number of that of each row (N,), and which rows (N,) are detections that name none.

    Detections have the target `OBJECT`, which stands for every object. Rows that name none and
    whose sensors are not `reading` any (N,) have the target `NOBODY`.
    """
    unnamed = np.where(detecting, OBJECT, np.where(reading, "target", NOBODY))
    if column is None:
        text, blank = pd.Series(unnamed, dtype=object), np.ones(len(reading), bool)
    else:
        text = pd.Series(names_as_text(column), dtype=object)
        blank = column.isna().to_numpy() | (text == "").to_numpy()
        table.refuse(
            blank & ~detecting & reading, "target",
            " is blank; name the target or drop the column, or place the sensor with detection=Detection(...)",
        )  # fmt: skip
        same = np.flatnonzero((text == OBJECT).to_numpy())
        if (blank & detecting).any() and len(same):
            raise InputError(f'{table.where(same[0])}: "{OBJECT}" stands for the detections; rename the target')
        same = np.flatnonzero((text == NOBODY).to_numpy() & reading)
        if len(same):
            raise InputError(f'{table.where(same[0])}: "{NOBODY}" stands for rows without a target; name the target')
        text[blank] = unnamed[blank]
    codes, names = pd.factorize(text)
    for name, row in zip(names, np.unique(codes, return_index=True)[1], strict=True):
        check_name(f"{table.where(row)}: the target", name)
    return tuple(names), codes, blank & detecting


def _weights(table: Table, column: pd.Series | None) -> np.ndarray:
    if column is None:
        return np.ones(len(table.frame))
    value, there = numbers(table, column, "weight")
    wrong = there & ~((value >= 0) & (value <= 1))
    table.refuse(wrong, "weight", ": {:g} does not lie between 0 and 1", value)
    return np.where(there, value, 1.0)


def _to_channel(
    table: Table, network: Network, name: str, j: int, sensor: np.ndarray, units: dict[str, str | None],
    value: np.ndarray, std: np.ndarray, measured: np.ndarray, below: np.ndarray, floors: dict[tuple[int, str], float],
) -> None:  # fmt: skip
    """Convert a column to the unit of each sensor's channel, in place, and check that the sensors have it.

    `below` (N,) says which cells are limits such as `<-95`, under which nothing was heard. A floor that the channel
    does not state is found here and kept in `floors`.
    """
    kinds = np.array([network.types.index(placed.type) for placed in network.sensors])[sensor]
    for k, kind in enumerate(network.types):
        rows = (kinds == k) & measured[:, j]
        channel = dict(kind.expand(network.dimension)).get(name)
        if channel is None:
            if rows.any():
                row = int(np.flatnonzero(rows)[0])
                own = ", ".join(n for n, _ in kind.expand(network.dimension))
                raise InputError(
                    f'{table.where(row)} column "{name}": sensor "{network.sensors[sensor[row]].name}" ({kind.name})'
                    f" has no such channel, it measures {own}; leave the cell blank"
                )
            continue
        for column, array in ((name, value), (f"{name}_std", std)):
            array[kinds == k, j] *= unit_factor(table, column, units.get(column), channel.unit)
        value[rows, j] = channel.turned(value[rows, j])
        if isinstance(channel.noise, Heard) and channel.noise.floor is None:
            known = channel.noise.found(value[rows & ~below, j], value[rows & below, j])
            channel, floors[k, name] = replace(channel, noise=known), known.known()
        if isinstance(channel.noise, Censored) and channel.noise.blanks:
            blank = (kinds == k) & ~measured[:, j]
            value[blank, j], measured[blank, j] = channel.noise.floor, True
        _check_limits(table, name, channel, value[:, j], rows & below)
        wrong = rows & ~channel.noise.check(value[:, j])
        unfit = f"does not suit {channel.noise!r}; leave it blank, or move the floor below it"
        unfit = "is not 0 or 1" if isinstance(channel.noise, Bernoulli) else unfit
        table.refuse(wrong, name, f": {{:g}} {unfit}", value[:, j])


def _limits(column: pd.Series) -> tuple[pd.Series, np.ndarray]:
    """A column whose limits such as `<-95` are numbers, and which cells (N,) were limits."""
    if column.dtype.kind not in "OUST":
        return column, np.zeros(len(column), bool)
    text = column.astype(str).str.strip()
    below = (text.str.startswith("<") & column.notna()).to_numpy(bool)
    if not below.any():
        return column, below
    return column.astype(object).where(~below, text.str.removeprefix("<")), below


def _check_limits(table: Table, name: str, channel: Channel, value: np.ndarray, below: np.ndarray) -> None:
    """Raise `InputError` for limits (N,) bool of a channel that hears all, or above its floor."""
    if not isinstance(channel.noise, Censored):
        limit = ': "<{:g}" is a limit, but the channel hears all; declare it with noise=Censored(floor)'
        table.refuse(below, name, limit, value)
        return
    floor = channel.noise.floor
    above = f"lies above the floor {floor:g} of its channel; declare the highest limit of such sensors as their floor"
    table.refuse(below & (value > floor), name, f': "<{{:g}}" {above}', value)


def unit_factor(table: Table, name: str, unit: str | None, wanted: str) -> float:
    """The factor from a column's unit (None: no change) to the wanted one; raises `InputError`."""
    if unit is None or unit == wanted:
        return 1.0
    if wanted not in UNITS:
        raise InputError(f'{table.source} column "{name}": unit "{unit}", but the channel is in "{wanted}"')
    quantity, size = UNITS[unit]
    if quantity != UNITS[wanted][0]:
        raise InputError(f'{table.source} column "{name}": unit "{unit}" is no {UNITS[wanted][0]}; give it in {wanted}')
    return size / UNITS[wanted][1]


def _check_duplicates(data: Measurements, network: Network) -> None:
    keys = ["time", "sensor", "target"]
    frame = pd.DataFrame({name: getattr(data, name) for name in (*keys, "weight")})[~data.detection]
    if not frame[data.measured.any(1)[frame.index]].duplicated(keys).any():
        return
    for j, name in enumerate(data.channels):
        own = frame[data.measured[frame.index, j]]
        repeated = own.duplicated(keys)
        if repeated.any() and (own["weight"] < 1).any():  # shares of one datum add up to one at most
            repeated &= own.groupby(keys)["weight"].transform("sum") > 1 + 1e-3
        if repeated.any():
            again: Any = repeated.idxmax()
            first = (own[keys] == own.loc[again, keys]).all(axis=1).idxmax()
            raise InputError(
                f'{data.table.where(again)}: sensor "{network.sensors[data.sensor[again]].name}" has a second '
                f'"{name}" at time {data.time[again]:g} (first in row {data.table.lines[first]}); keep one, '
                'or name two targets in the column "target", or place the sensor with detection=Detection(...)'
            )
