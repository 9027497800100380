"""The likely cause of a fit that explains nothing, read from what it leaves of every datum.

A wrong sensor bends tracks and biases, so that every other sensor leaves large residuals too.
Causes are looked for from the special to the general: values that repeat, single data, a jump in
time, a sensor, channel or target whose mean square stands out, and there the factor of another
unit.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from probcal.labels import listed
from probcal.table import UNITS

MOST = 0.5  # share of all squares that a few data, or one repeated value, hold to be named
FEW = 0.01  # share of all data up to which data are few
STANDS_OUT = 10.0  # mean square of a group over that of the rest, from which it is named
STEP = 0.5  # share of a channel's squares about their mean that a step explains to be named
NEAR = 5  # data on either side of a step whose medians are compared
# times the usual change of such medians, from which a step is one (1.3 % of random walks)
SUDDEN = 6.0
LOOSE = 0.15  # relative tolerance of the log of a factor: a wrong unit bends the predictions too
APART = 3.0  # log of a factor between units from which sizes of values tell it
WITHIN = 0.7  # of such a log: distances differ by two from sensor to sensor
HUGE = 1e300  # largest square: sums of it stay finite
LOOSE_BIASES = "Use a prior, narrower scales, or fix some biases."
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


class Rejected(NamedTuple):
    """A channel of a sensor whose data a robust fit sets aside."""

    sensor: str
    channel: str
    below: int  # data of less than half weight
    data: int
    expected: float  # fraction of such data under the noise family, or of most sensors


def misfit_text(mean: float, points: Iterable[MisfitData]) -> str:
    """The mean square of a misfit, the worst datum, and the likely cause with its remedy.

    Of several points, asked for one by one, the first that shows a special cause counts, else the
    first. A mean that is not finite says that the fit has no answer, and that the points have the
    biases as stated.
    """
    first, cause = None, ""
    for left in points:
        lost = np.isnan(left.square)
        if first is None and lost.any():
            return _lost(left, int(np.argmax(lost)), int(lost.sum()))
        left = left._replace(square=np.nan_to_num(np.minimum(left.square, HUGE), nan=HUGE))
        first = left if first is None else first
        worst = int(np.argmax(left.square))
        if cause := _repeated(left, worst) or _single(left) or _jump(left) or _sizes(left):
            break
    assert first is not None
    worst = int(np.argmax(first.square))
    said = f"The fit explains nothing: mean square a datum {mean:.2g}"
    if not np.isfinite(mean):
        stated = float(first.square.mean())
        said = f"The fit found no finite answer: with the biases as stated the mean square a datum is {stated:.2g}"
        cause = cause or (LOOSE_BIASES if stated < STANDS_OUT else "")
    return (
        f"{said} where 1 is expected, worst {first.sensor[worst]}.{first.channel[worst]} at"
        f" {first.time[worst]:.6g} s. {cause or _group(first) or UNEXPLAINED}"
    )


def rejection_text(rejected: Sequence[Rejected]) -> str:
    """The channels that robust noise rejects and what to check; empty where it rejects none."""
    if not rejected:
        return ""
    named = [f"{one.sensor}.{one.channel} ({one.below} of {one.data})" for one in rejected]
    return (
        "The robust noise gives less than half weight to most data of"
        f" {listed(named)}, where {rejected[0].expected:.0%} is expected. Check whether labels of"
        " sensors are exchanged, then their positions, units, clocks and std."
    )


def _lost(left: MisfitData, first: int, count: int) -> str:
    """The advice where predictions are not numbers, even with the biases as stated."""
    return (
        f"The fit explains nothing: the predictions of {count} data are not numbers, the first"
        f" {left.sensor[first]}.{left.channel[first]} at {left.time[first]:.6g} s. Check the sensor's function (a"
        " division by zero, the root of a negative number), units, the start and sentinels such as -9999."
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
        (
            (left.target,),
            "the rows that name this target, its motion and its start, and that no two targets share it",
        ),
        ((left.channel,), "the unit in its header, its std and its formula"),
        (
            (left.sensor,),
            "its units, clock, position and heading, and the sensor that its rows name",
        ),
        (
            (left.sensor, left.channel),
            "its units, std and formula, and the sensor that its rows name",
        ),
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
    """The unit that a constant factor between measured and predicted values tells.

    Empty where none does.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = np.log(left.value[mine] / (left.value[mine] - left.residual[mine]))
    logs = logs[np.isfinite(logs)]
    if len(logs) < 0.8 * mine.sum():
        return ""
    own, middle = str(left.unit[mine][0]), float(np.median(logs))
    unit, factor = _nearest_unit(own, middle)
    near = max(abs(middle - factor), float(np.median(np.abs(logs - middle)))) < LOOSE * abs(factor)
    return f"{unit} instead of {own}" if near else ""


def _sizes(left: MisfitData) -> str:
    """A sensor whose values are larger or smaller than those of the others of its channel by the
    factor of a unit."""
    names, code = _codes(left.sensor, left.channel)
    _, first = np.unique(code, return_index=True)
    channel = left.channel[first]
    size = np.log([max(float(np.median(np.abs(left.value[code == k]))), 1e-300) for k in range(len(names))])
    for k, name in enumerate(names):
        others = size[(channel == channel[k]) & (np.arange(len(names)) != k)]
        if len(others) < 2:
            continue
        away, own = float(size[k] - np.median(others)), str(left.unit[first[k]])
        unit, factor = _nearest_unit(own, away)
        if abs(factor) > APART and abs(away - factor) < WITHIN:
            return (
                f"Values of {name} are {np.exp(away):.2g} times those of the other sensors: they look like {unit}"
                f" instead of {own}, convert them."
            )
    return ""


def _nearest_unit(own: str, log: float) -> tuple[str, float]:
    """The unit of the same quantity whose numbers are nearest to a factor, and the log of its own.

    0 where none is.
    """
    quantity, size = UNITS.get(own, ("", 1.0))
    factors = {unit: float(np.log(size / other)) for unit, (kind, other) in UNITS.items() if kind == quantity}
    factors = {unit: factor for unit, factor in factors.items() if factor}
    unit = min(factors, key=lambda name: abs(factors[name] - log), default="")
    return unit, factors.get(unit, 0.0)
