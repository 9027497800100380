"""The likely cause of a fit that explains nothing, read from what it leaves of every datum.

A wrong sensor bends tracks and biases, so that every other sensor leaves large residuals too.
Causes are looked for from the special to the general: values that repeat, single data, a jump in
time, a sensor, channel or target whose mean square stands out, and there the factor of another unit.
"""

from typing import NamedTuple

import numpy as np

from probcal.table import UNITS

MOST = 0.5  # share of all squares that a few data, or one repeated value, hold to be named
FEW = 0.01  # share of all data up to which data are few
STANDS_OUT = 10.0  # mean square of a group over that of the rest, from which it is named
STEP = 0.5  # share of a channel's squares about their mean that a step explains to be named
NEAR = 5  # data on either side of a step whose medians are compared
SUDDEN = 6.0  # times the usual change of such medians, from which a step is one (1.3 % of random walks)
LOOSE = 0.15  # relative tolerance of the log of a factor: a wrong unit bends the predictions too
UNEXPLAINED = "Check units, the time column, the target of each row, sentinels such as -9999 and the noise std."


class MisfitData(NamedTuple):
    """The data of a fit and what it leaves of each, all (D,)."""

    square: np.ndarray  # of the standardised residual, 1 expected
    residual: np.ndarray  # measured minus predicted, in the unit of the channel
    value: np.ndarray  # measured
    sensor: np.ndarray
    channel: np.ndarray
    target: np.ndarray
    time: np.ndarray  # s
    unit: np.ndarray  # of the channel


def misfit_text(mean: float, left: MisfitData) -> str:
    """The mean square of a misfit, the worst datum, and the likely cause with its remedy."""
    if (lost := np.isnan(left.square)).any():
        first = int(np.argmax(lost))
        return (
            f"The fit explains nothing: the predictions of {lost.sum()} data are not numbers, the first"
            f" {left.sensor[first]}.{left.channel[first]} at {left.time[first]:.6g} s. Check the sensor's function (a"
            " division by zero, the root of a negative number), units, the start and sentinels such as -9999."
        )
    left = left._replace(square=np.minimum(left.square, 1e300))
    worst = int(np.argmax(left.square))
    name = f"{left.sensor[worst]}.{left.channel[worst]}"
    cause = _repeated(left, worst) or _single(left) or _jump(left) or _group(left) or UNEXPLAINED
    return (
        f"The fit explains nothing: mean square a datum {mean:.2g} where 1 is expected, worst {name} at"
        f" {left.time[worst]:.6g} s. {cause}"
    )


def _repeated(left: MisfitData, worst: int) -> str:
    """A value that marks a missing one: that of the worst datum, several times in its channel."""
    same = (left.channel == left.channel[worst]) & (left.value == left.value[worst])
    if same.sum() < 2 or left.square[same].sum() < MOST * left.square.sum() or _ratio(left, same) < STANDS_OUT:
        return ""
    return (
        f"{same.sum()} values of {left.channel[worst]} are exactly {left.value[worst]:g}: where that marks a missing"
        " value, leave the cells blank."
    )


def _single(left: MisfitData) -> str:
    """A few data, not of one time, that hold most of the squares."""
    held = np.cumsum(np.sort(left.square)[::-1])
    count = 1 + int(np.searchsorted(held, MOST * held[-1]))
    if count > max(1.0, FEW * len(held)):
        return ""
    return (
        f"{count} of {len(held)} data hold most of the squares: leave such cells blank, or declare"
        " Channel(..., noise=StudentT(4)) where outliers are to be expected."
    )


def _jump(left: MisfitData) -> str:
    """A step in the residuals of the channel that is worst explained."""
    names, code = _codes(left.sensor, left.channel)
    mine = np.flatnonzero(code == np.argmax(np.bincount(code, left.square)))
    mine = mine[np.argsort(left.time[mine], kind="stable")]
    n, value = len(mine), left.residual[mine]
    if n < 4 * NEAR:
        return ""
    away = value - value.mean()
    before = np.arange(1, n)
    gain = np.cumsum(away)[:-1] ** 2 * n / (before * (n - before))
    gain[: 2 * NEAR - 1] = gain[n - 2 * NEAR :] = 0.0
    gain[np.diff(left.time[mine]) == 0] = 0.0  # data of one time are on one side
    k = int(np.argmax(gain)) + 1  # the first after the step
    medians = np.median(np.lib.stride_tricks.sliding_window_view(value, NEAR), 1)
    changes = medians[NEAR:] - medians[:-NEAR]  # from the data before each to those after
    size, usual = float(changes[k - NEAR]), float(np.median(np.abs(changes)))
    step = float(value[k:].mean() - value[:k].mean())
    if gain[k - 1] < STEP * np.sum(away**2) or not size * np.sign(step) > max(0.5 * abs(step), SUDDEN * usual):
        return ""
    first, at = float(left.time.min()), float(left.time[mine[k]])
    return (
        f"The residuals of {names[code[mine[0]]]} jump at {at:.6g} s by at least {abs(size):.2g} {left.unit[mine[0]]}:"
        f" leave out the rows on one side, or give the bias that changed drift=Drift(({first:.6g}, {at:.6g}),"
        f" scale={abs(size):.2g})."
    )


def _group(left: MisfitData) -> str:
    """The sensor, channel or target whose mean square stands out most, and what to check there."""
    found = []
    for columns, check in (
        ((left.target,), "the rows that name this target, its motion and its start, and that no two targets share it"),
        ((left.channel,), "the unit in its header, its std and its formula"),
        ((left.sensor,), "its units, clock, position and heading, and the sensor that its rows name"),
        ((left.sensor, left.channel), "its units, std and formula, and the sensor that its rows name"),
    ):
        names, code = _codes(*columns)
        squares, counts = np.bincount(code, left.square), np.bincount(code)
        k = int(np.argmax(squares / counts))
        found.append((_ratio(left, code == k), names[k], code == k, check))
    ratio, name, mine, check = max(found, key=lambda one: one[0])
    if ratio < STANDS_OUT:
        return ""
    mean = left.square[mine].mean()
    unit = _other_unit(left, mine)
    advice = f"its values look like {unit}, convert them" if unit else f"check {check}"
    return f"Most of it is in {name} (mean square {mean:.2g}, {ratio:.2g} times that of the rest): {advice}."


def _ratio(left: MisfitData, mine: np.ndarray) -> float:
    """Mean square of some data (D,) over that of the rest; 0 where nothing is left."""
    rest = left.square[~mine]
    return float(left.square[mine].mean() / max(rest.mean(), 1e-300)) if len(rest) else 0.0


def _codes(*columns: np.ndarray) -> tuple[list[str], np.ndarray]:
    """Names of groups, such as `sensor.channel`, and the number (D,) of the group of each datum."""
    names, code = np.unique([".".join(pair) for pair in zip(*columns, strict=True)], return_inverse=True)
    return names.tolist(), code


def _other_unit(left: MisfitData, mine: np.ndarray) -> str:
    """The unit that a constant factor between measured and predicted values tells; empty where none does."""
    predicted = left.value[mine] - left.residual[mine]
    own = str(left.unit[mine][0])
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = np.log(left.value[mine] / predicted)
    logs = logs[np.isfinite(logs)]
    if own not in UNITS or len(logs) < 0.8 * mine.sum():
        return ""
    quantity, size = UNITS[own]
    factors = {
        unit: np.log(size / other) for unit, (kind, other) in UNITS.items() if kind == quantity and other != size
    }
    middle = float(np.median(logs))
    if not factors:
        return ""
    unit = min(factors, key=lambda name: abs(factors[name] - middle))
    loose = LOOSE * abs(factors[unit])
    near = abs(middle - factors[unit]) < loose and float(np.median(np.abs(logs - middle))) < loose
    return f"{unit} instead of {own}" if near else ""
