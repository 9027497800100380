"""Are the readings of a sensor counted another way: to the other side, from another axis, with the other sign?

Where a fit leaves the data far off, the readings of all of a type, and of its worst sensors, are turned as another
convention counts them, and the joint mode is looked for again.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress

import numpy as np

from probcal.analysis.check import Case, Checked, check
from probcal.analysis.findings import Finding
from probcal.analysis.parts import LOOKED
from probcal.errors import InputError
from probcal.gaussian.engine import Expansion
from probcal.inference.fitted import Judged
from probcal.inference.residuals import PRACTICAL
from probcal.misfit import STANDS_OUT
from probcal.model.rows import standardised
from probcal.modes import optima
from probcal.problem import Problem
from probcal.sensor import Channel

LONGEST = 20.0  # s after which no other way is tried
# checks that only speak of it
SIGNS = ("levels", "process", "channels", "sensors", "rows", "slopes", "shape", "segments")

Way = Callable[[np.ndarray], np.ndarray]


def ways(channel: Channel, signed: bool) -> Mapping[str, Way]:
    """The other ways to count the values of a channel, `signed` where it has both signs, by what is said of them."""
    if channel.period is None:
        return {"have the other sign": np.negative} if signed else {}
    quarter, other = channel.period / 4, "unit-circle angles" if channel.compass else "compass bearings"
    return {
        f"look like {other}": lambda value: quarter - value,
        "are counted the other way round": np.negative,
        "point the other way": lambda value: value + 2 * quarter,
    }


@check(causes=["misfit", "other"])
def check_recoded(case: Case) -> Checked:
    """A finding on readings of a sensor, or a type, that fit if they are counted another way, and not as they are."""
    linear = all(form is None for form in case.fit.problem.model.sampled)
    if not (case.fit.engine.cheap and linear and case.innovations.spread(slice(None)) >= STANDS_OUT):
        return Checked()
    with suppress(MemoryError, np.linalg.LinAlgError, InputError):
        begun, stated = time.monotonic(), min(_square(case.fit.expansion, case.fit), _left(case.fit, case.fit.problem))
        for name, said, values in _tried(case) if stated >= STANDS_OUT else ():
            if time.monotonic() - begun > LONGEST:
                break
            square = _left(case.fit, case.fit.problem.redrawn(values))
            if square < PRACTICAL:
                text = (
                    f"{name}: its values {said}: counted so, the mean square of what a fit leaves is {square:.2g} and"
                    f" not {stated:.2g}"
                )
                return Checked(findings=[Finding("recoded", name, text)], explains=SIGNS)
    return Checked()


def _left(fit: Judged, problem: Problem) -> float:
    """Mean square of the standardised residuals at the first joint mode of a problem, at the levels of the fit."""
    point = optima(problem, lambda: True)[0].point._replace(levels=fit.point.levels)
    return _square(fit.engine.at(problem.model, point), fit)


def _square(at: Expansion, fit: Judged) -> float:
    """Mean square of the standardised residuals at a point."""
    return float(np.mean(fit.flat([standardised(lin.score, lin.weight) for lin in at.rows]) ** 2))


def _tried(case: Case) -> Iterator[tuple[str, str, list[np.ndarray]]]:
    """Channels and ways to count them, each way of a type and of its worst sensors, and the values (N, C) of each
    block then."""
    problem, data = case.fit.problem, case.fit.data
    names = np.array([placed.name for placed in problem.network.sensors])
    squares = data.assign(square=case.innovations.value**2).groupby("sensor", sort=False)["square"].mean()
    for kind in problem.network.types:
        alike = tuple(placed.name for placed in problem.network.sensors if placed.type == kind)
        worst = squares[squares.index.isin(alike)].sort_values(ascending=False).index[:LOOKED].astype(str)
        groups: dict[str, tuple[str, ...]] = ({kind.name: alike} if len(alike) > 1 else {}) | {
            own: (own,) for own in worst
        }
        for c, (channel, declared) in enumerate(kind.expand(problem.network.dimension)):
            own = [np.asarray(rows.y)[:, c] for block, rows, _ in problem.model.each_block() if block.type == kind]
            if not any(values.any() for values in own):
                continue
            signed = {-1.0, 1.0} <= {*np.sign(np.concatenate([np.zeros(1), *own])).tolist()}
            for said, way in ways(declared, signed).items():
                for name, sensors in groups.items():
                    values = []
                    for block, rows, _, index in problem.model.each_block(problem.row_index):
                        y = np.array(rows.y)
                        mine = np.isin(names[problem.measurements.sensor[index]], sensors) & (block.type == kind)
                        y[mine, c] = way(y[mine, c])
                        values.append(y)
                    yield f"{name}.{channel}", said, values
