"""Numbers that are well formed and cannot be meant: refused at the door, with the row and what to do.

A wrong unit or a sentinel is no outlier: robust noise explains it away, and the fit converges on nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import chain
from typing import NamedTuple

import numpy as np

from probcal.errors import InputError
from probcal.network import BiasRecord, Network
from probcal.noise import Bernoulli, guess_of
from probcal.sensor import Channel
from probcal.table import Measurements, header, unit_factor

EPOCHS = (("ns", 1e17), ("us", 1e14), ("ms", 1e11))  # a bare time from here on counts these since 1970
GAP = 3.2e9  # s between two rows of one table: a hundred years
TURNS = 20.0  # rad in a wrapped channel of no stated unit: more than three turns
SENTINELS = (-9999.0, -999.0, -99999.0, 9999.0, 99999.0, 999999.0, -999999.0, 32767.0, -32768.0, 65535.0, -1e30, 1e30)
APART = 20.0  # spreads of its column from which a sentinel is one
FAR = 1e6  # spreads from which any value is nonsense
FEW = 8  # values below which a column has no spread
LAST = 300  # values per column that a stream remembers: the sd of their 0.1 quantile is a tenth of that of the data
FAINT, RANGE = 0.1, 30.0  # largest value of a column of powers in W, and the ratio to its smallest
NARROW, WIDE = 1e-9, 1e6  # of the size of a column: smallest and largest std

# noise stds in a scale or survey: at 1e7 the sd of three nodes' common shift is 17 % off (radars)
LOOSE = 1e6


def check_scales(biases: Iterable[BiasRecord], network: Network) -> None:
    """Raise `InputError` for a scale or survey so wide that it is lost in the rounding of what the
    rows tell."""
    finest: dict[tuple[str, str], float] = {}
    for placed in network.sensors:
        for channel in placed.type.channels.values():
            std = np.inf if isinstance(channel.noise, Bernoulli) else guess_of(channel.std)
            for owner in (placed.name, placed.type.name, *(node.name for node in placed.nodes)):
                key = (owner, channel.unit)
                finest[key] = min(finest.get(key, np.inf), std)
    for bias in biases:
        std = finest.get((bias.owner, bias.unit), np.inf)
        if bias.scale > LOOSE * std:
            raise InputError(
                f"the {bias.kind} of {bias.label} is {bias.scale:.6g} {bias.unit}, {bias.scale / std:.2g} times the"
                f" noise of its sensors: more than the rounding of numbers allows; state {LOOSE * std:.3g} or less"
            )


class Doubt(NamedTuple):
    """Rows that cannot be meant for one reason."""

    rows: np.ndarray  # their numbers, the first one first
    why: Callable[[int], str]  # the sentence of a row


@dataclass(frozen=True, eq=False)
class Column:
    """The values that one sensor type has in one channel, and those remembered of earlier tables."""

    data: Measurements
    name: str
    rows: np.ndarray  # of the table, those with a value
    channel: Channel
    unit: str | None  # in the header
    earlier: np.ndarray  # in the unit of the channel

    @property
    def number(self) -> int:
        """Number of the channel in the table."""
        return self.data.channels.index(self.name)

    @cached_property
    def value(self) -> np.ndarray:
        """Values in the unit of the channel."""
        return self.data.value[self.rows, self.number]

    def raw(self, value: np.ndarray | float) -> np.ndarray | float:
        """Values as they stand in the table."""
        return self.channel.turned(value) / unit_factor(self.data.table, self.name, self.unit, self.channel.unit)

    @cached_property
    def marked(self) -> np.ndarray:
        """True if each value is one of the sentinels."""
        raw = np.asarray(self.raw(self.value))
        return np.isclose(raw[:, None], SENTINELS, rtol=1e-12, atol=0.0).any(1)

    @cached_property
    def usual(self) -> np.ndarray:
        """Values that tell the spread: earlier ones, and those of this table that are no sentinel."""
        return np.concatenate([self.earlier, self.value[~self.marked]])

    def where(self, row: int, suffix: str = "") -> str:
        """Name of a cell in complaints."""
        return f'{self.data.table.where(row)} column "{self.name}{suffix}":'


def check_plausible(data: Measurements, network: Network) -> None:
    """Raise `InputError` for times, values and stds that cannot be meant, naming row, column and remedy."""
    columns = columns_of(data, network, {})
    for doubt in chain(_times(data, header(data.table)[1]["time"], np.zeros(0)), _doubts(columns)):
        if len(doubt.rows):
            raise InputError(doubt.why(int(doubt.rows[0])))


def implausible(
    data: Measurements, network: Network, earlier: Mapping[str, np.ndarray], unit: str | None
) -> tuple[dict[int, str], dict[str, np.ndarray]]:
    """Rows of a part of a stream that cannot be meant, each with its sentence, and the values to remember.

    `earlier` are the values remembered so far, by column; `unit` is that of the times in the header. Values that are
    refused for their distance are remembered too: a column that has changed for good is taken after some rows. Raises
    `InputError` for a header that cannot be meant.
    """
    columns = columns_of(data, network, earlier)
    times = earlier.get("time", np.zeros(0))
    doubts = [*_times(data, unit, times), *_doubts(columns)]
    found: dict[int, str] = {}
    for doubt in doubts:
        for row in doubt.rows.tolist():
            if row not in found:
                found[row] = doubt.why(row)
    counted = np.setdiff1d(np.arange(len(data.time)), doubts[0].rows)
    latest = {"time": np.concatenate([times, data.time[counted]])[-LAST:]}
    return found, {**earlier, **latest, **{key: column.usual[-LAST:] for key, column in columns.items()}}


def columns_of(data: Measurements, network: Network, earlier: Mapping[str, np.ndarray]) -> dict[str, Column]:
    """The columns of a table by sensor type and channel; raises `InputError` for a unit that cannot be meant."""
    units = header(data.table)[1]
    kinds = np.array([network.types.index(placed.type) for placed in network.sensors])[data.sensor]
    columns = {}
    for j, name in enumerate(data.channels):
        for k, kind in enumerate(network.types):
            rows = np.flatnonzero((kinds == k) & data.measured[:, j])
            channel = dict(kind.expand(network.dimension)).get(name)
            if channel is None or not len(rows):
                continue
            _check_unit(data, name, units, channel.unit)
            if not isinstance(channel.noise, Bernoulli):
                key = f"{kind.name} {name}"
                columns[key] = Column(data, name, rows, channel, units.get(name), earlier.get(key, np.zeros(0)))
    return columns


def _doubts(columns: Mapping[str, Column]) -> Iterator[Doubt]:
    """Rows of all columns that cannot be meant."""
    for column in columns.values():
        yield from _values(column)
        yield from _angles(column)
        yield from _powers(column)
        yield from _sizes(column)


def _times(data: Measurements, unit: str | None, earlier: np.ndarray) -> Iterator[Doubt]:
    """Epochs in another unit than seconds, then rows that centuries part from most others."""
    time, where = data.time, data.table.where
    epochs = np.abs(time) >= (EPOCHS[-1][1] if unit is None else np.inf)

    def epoch(row: int) -> str:
        name = next(name for name, least in EPOCHS if abs(time[row]) >= least)
        return (
            f'{where(row)} column "time": {time[row]:.6g} s looks like {name} since 1970;'
            f" write the header as time [{name}]"
        )

    yield Doubt(np.flatnonzero(epochs), epoch)
    rows = np.flatnonzero(~epochs)
    whole = np.concatenate([earlier, time[rows]])
    order = np.argsort(whole, kind="stable")
    begins = np.flatnonzero(np.diff(whole[order]) > GAP) + 1
    part = np.empty(len(whole), int)
    part[order] = np.searchsorted(begins, np.arange(len(whole)), side="right")
    new = part[len(earlier) :]
    most = int(np.bincount(part).argmax()) if len(part) else 0

    def gap(row: int) -> str:
        own = int(new[np.searchsorted(rows, row)])
        edge = int(order[begins[own - 1] - 1] if own > most else order[begins[own]])
        other = edge - len(earlier)
        return (
            f'{where(row)} column "time": {abs(time[row] - whole[edge]):.3g} s'
            f" {'after the row before' if own > most else 'before the row after'} it in time"
            f"{f' ({where(int(rows[other]))})' if other >= 0 else ''}; check the time and its unit"
        )

    yield Doubt(rows[new != most], gap)


def _check_unit(data: Measurements, name: str, units: Mapping[str, str | None], wanted: str) -> None:
    """A value column with a unit of its own beside a std column without one."""
    own = units.get(name)
    if own is not None and own != wanted and f"{name}_std" in units and units[f"{name}_std"] is None:
        raise InputError(
            f'{data.table.source} column "{name}_std" has no unit beside "{name} [{own}]": write {name}_std [{own}], or'
            f" {name}_std [{wanted}]"
        )


def _powers(column: Column) -> Iterator[Doubt]:
    """Powers in a channel of decibels, and decibels in one of powers."""
    usual, unit = column.usual, column.channel.unit
    if len(usual) < FEW or column.unit is not None:
        return

    def shown(row: int) -> str:
        return f"{column.where(row)} {column.data.value[row, column.number]:g} {unit}"

    if unit in ("dB", "dBm") and usual.min() > 0 and usual.max() < FAINT and usual.max() > RANGE * usual.min():
        yield Doubt(
            column.rows,
            lambda row: f"{shown(row)} looks like power in W, as all of the column; write 10 log10 of it",
        )
    if unit in ("W", "mW", "V^2") and np.median(usual) < 0:
        yield Doubt(
            column.rows,
            lambda row: f"{shown(row)}: most of the column is negative, which no power is; it looks like dB",
        )


def _angles(column: Column) -> Iterator[Doubt]:
    """Degrees in a channel of radians: large values, and all others where most are large."""
    if not column.channel.wrap or column.channel.unit != "rad" or column.unit is not None:
        return
    name = column.name

    def why(row: int) -> str:
        return (
            f"{column.where(row)} {column.data.value[row, column.number]:g} rad looks like degrees; write the header as"
            f" {name} [deg], or as {name} [rad] where radians are meant"
        )

    yield Doubt(column.rows[np.abs(column.value) > TURNS], why)
    if len(column.usual) >= FEW and np.median(np.abs(column.usual)) > TURNS:
        yield Doubt(column.rows, why)


def _values(column: Column) -> Iterator[Doubt]:
    """Sentinels for a missing value, and cells many orders of magnitude from their column."""
    if len(column.usual) < FEW:
        return
    low, middle, high = np.quantile(column.usual, [0.1, 0.5, 0.9])
    spread = max(float(high - low), 1e-3 * abs(float(middle)))
    if spread == 0.0:
        return
    away = np.abs(column.value - middle) / spread

    def why(words: str, row: int) -> str:
        value = column.raw(column.data.value[row, column.number])
        return (
            f"{column.where(row)} {value:g} {words} (the usual is about {column.raw(float(middle)):.4g}); leave the"
            " cell blank"
        )

    mark = column.marked & (away > APART)
    yield Doubt(column.rows[mark], partial(why, "looks like a mark for a missing value"))
    yield Doubt(column.rows[away > FAR], partial(why, "is far from all others"))


def _sizes(column: Column) -> Iterator[Doubt]:
    """Stds that are absurd beside the values that they belong to."""
    data, j, usual = column.data, column.number, column.usual
    own_std = data.has_std[column.rows, j]
    if len(usual) < FEW or not own_std.any():
        return
    rows, value = column.rows[own_std], column.value[own_std]
    size = max(float(np.quantile(np.abs(usual), 0.9)), float(np.ptp(np.quantile(usual, [0.1, 0.9]))))
    if size == 0.0:
        return
    std, own = data.std[rows, j], np.maximum(np.abs(value), 1e-300)
    huge = rows[(std < NARROW * size) & (std < NARROW * own)]

    def why(words: str, row: int) -> str:
        return _jump(column, huge, row) or (
            f"{column.where(row, '_std')} a std of {data.std[row, j]:g} is many orders of magnitude {words} than the"
            f" values (here {data.value[row, j]:.3g}); check the units of both, or leave the cell blank"
        )

    for words, off, alone in (
        ("smaller", std < NARROW * size, std < NARROW * own),
        ("larger", std > WIDE * size, std > WIDE * own),
    ):  # of large values that make a proper std small, their row is named
        yield Doubt(rows[off & alone if (off & alone).any() else off], partial(why, words))


def _jump(column: Column, huge: np.ndarray, row: int) -> str:
    """The one jump that parts the rows `huge` of a sensor from its others; empty without one."""
    data, j = column.data, column.number
    mine = column.rows[data.sensor[column.rows] == data.sensor[row]]
    mine = mine[np.argsort(data.time[mine], kind="stable")]
    edges = np.flatnonzero(np.diff(np.isin(mine, huge)))
    if len(edges) != 1:
        return ""
    k = int(edges[0]) + 1
    before, after = (float(np.median(data.value[part, j])) for part in (mine[:k], mine[k:]))
    return (
        f"{column.where(row)} the values of {data.table.frame['sensor'].iloc[row]} jump at"
        f" {data.time[mine[k]]:.6g} s from about {before:.3g} to {after:.3g} {column.channel.unit};"
        " correct its clock or counter there, or leave out the rows on one side"
    )
