"""Numbers that are well formed and cannot be meant: refused at the door, with the row and what to do.

A wrong unit or a sentinel is no outlier: robust noise explains it away, and the fit converges on nothing.
"""

from collections.abc import Iterable, Mapping

import numpy as np

from probcal.errors import InputError
from probcal.network import BiasRecord, Network
from probcal.noise import Bernoulli, guess_of
from probcal.table import Measurements, header, unit_factor

EPOCHS = (("ns", 1e17), ("us", 1e14), ("ms", 1e11))  # a bare time from here on counts these since 1970
GAP = 3.2e9  # s between two rows of one table: a hundred years
TURNS = 20.0  # rad in a wrapped channel of no stated unit: more than three turns
SENTINELS = (-9999.0, -999.0, -99999.0, 9999.0, 99999.0, 999999.0, -999999.0, 32767.0, -32768.0, 65535.0, -1e30, 1e30)
APART = 20.0  # spreads of its column from which a sentinel is one
FAR = 1e6  # spreads from which any value is nonsense
FEW = 8  # values below which a column has no spread
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


def check_plausible(data: Measurements, network: Network) -> None:
    """Raise `InputError` for times, values and stds that cannot be meant, naming row, column and remedy."""
    units = header(data.table)[1]
    _check_times(data, units.get("time"))
    kinds = np.array([network.types.index(placed.type) for placed in network.sensors])[data.sensor]
    for j, name in enumerate(data.channels):
        for k, kind in enumerate(network.types):
            rows = np.flatnonzero((kinds == k) & data.measured[:, j])
            channel = dict(kind.expand(network.dimension)).get(name)
            if channel is None or not len(rows):
                continue
            _check_unit(data, name, units, channel.unit)
            if isinstance(channel.noise, Bernoulli):
                continue
            if channel.wrap and channel.unit == "rad":
                _check_angles(data, name, j, rows, units.get(name))
            _check_powers(data, name, j, rows, channel.unit, units.get(name))
            _check_values(data, name, j, rows, unit_factor(data.table, name, units.get(name), channel.unit))
            _check_sizes(data, name, j, rows)


def _check_times(data: Measurements, unit: str | None) -> None:
    """Epochs in another unit than seconds, and gaps of centuries."""
    first = int(np.abs(data.time).argmax())
    if unit is None:
        for name, least in EPOCHS:
            if abs(data.time[first]) >= least:
                raise InputError(
                    f'{data.table.where(first)} column "time": {data.time[first]:.6g} s looks like {name} since 1970;'
                    f" write the header as time [{name}]"
                )
    order = np.argsort(data.time, kind="stable")
    gaps = np.diff(data.time[order])
    if len(gaps) and gaps.max() > GAP:
        k = int(gaps.argmax())
        raise InputError(
            f'{data.table.where(int(order[k + 1]))} column "time": {gaps[k]:.3g} s after the row before it in time'
            f" ({data.table.where(int(order[k]))}); check the time and its unit"
        )


def _check_unit(data: Measurements, name: str, units: Mapping[str, str | None], wanted: str) -> None:
    """A value column with a unit of its own beside a std column without one."""
    own = units.get(name)
    if own is not None and own != wanted and f"{name}_std" in units and units[f"{name}_std"] is None:
        raise InputError(
            f'{data.table.source} column "{name}_std" has no unit beside "{name} [{own}]": write {name}_std [{own}], or'
            f" {name}_std [{wanted}]"
        )


def _check_powers(data: Measurements, name: str, j: int, rows: np.ndarray, unit: str, stated: str | None) -> None:
    """Powers in a channel of decibels, and decibels in one of powers."""
    value = data.value[rows, j]
    if len(rows) < FEW or stated is not None:
        return
    shown = f'{data.table.where(int(rows[0]))} column "{name}": {value[0]:g}'
    if unit in ("dB", "dBm") and value.min() > 0 and value.max() < FAINT and value.max() > RANGE * value.min():
        raise InputError(f"{shown} {unit} looks like power in W, as all of the column; write 10 log10 of it")
    if unit in ("W", "mW", "V^2") and np.median(value) < 0:
        raise InputError(f"{shown} {unit}: most of the column is negative, which no power is; it looks like dB")


def _check_angles(data: Measurements, name: str, j: int, rows: np.ndarray, unit: str | None) -> None:
    """Degrees in a channel of radians."""
    worst = rows[int(np.abs(data.value[rows, j]).argmax())]
    if unit is None and abs(data.value[worst, j]) > TURNS:
        raise InputError(
            f'{data.table.where(int(worst))} column "{name}": {data.value[worst, j]:g} rad looks like degrees; write'
            f" the header as {name} [deg], or as {name} [rad] where radians are meant"
        )


def _check_values(data: Measurements, name: str, j: int, rows: np.ndarray, factor: float) -> None:
    """Sentinels for a missing value, and cells many orders of magnitude from their column."""
    if len(rows) < FEW:
        return
    value = data.value[rows, j]
    middle = float(np.median(value))
    low, high = np.quantile(value, [0.1, 0.9])
    spread = max(float(high - low), 1e-3 * abs(middle))
    if spread == 0.0:
        return
    away = np.abs(value - middle) / spread
    raw = value / factor  # as it stands in the table
    mark = np.isclose(raw[:, None], SENTINELS, rtol=1e-12, atol=0.0).any(1) & (away > APART)
    for chosen, words in ((mark, "looks like a mark for a missing value"), (away > FAR, "is far from all others")):
        if chosen.any():
            k = int(np.flatnonzero(chosen)[0])
            raise InputError(
                f'{data.table.where(int(rows[k]))} column "{name}": {raw[k]:g} {words} (the usual is about'
                f" {middle / factor:.4g}); leave the cell blank"
            )


def _check_sizes(data: Measurements, name: str, j: int, rows: np.ndarray) -> None:
    """Stds that are absurd beside the values that they belong to."""
    rows = rows[data.has_std[rows, j]]
    if len(rows) < FEW:
        return
    value = data.value[rows, j]
    size = max(float(np.quantile(np.abs(value), 0.9)), float(np.ptp(np.quantile(value, [0.1, 0.9]))))
    if size == 0.0:
        return
    std, own = data.std[rows, j], np.maximum(np.abs(value), 1e-300)
    for words, off, alone in (
        ("smaller", std < NARROW * size, std < NARROW * own),
        ("larger", std > WIDE * size, std > WIDE * own),
    ):
        if off.any():  # of large values that make a proper std small, their row is named
            row = int(rows[np.flatnonzero(off & alone if (off & alone).any() else off)[0]])
            raise InputError(
                f'{data.table.where(row)} column "{name}_std": a std of {data.std[row, j]:g} is many orders of'
                f" magnitude {words} than the values (here {data.value[row, j]:.3g}); check the units of both, or"
                " leave the cell blank"
            )
