"""Are the readings of a sensor counted another way: to the other side, from another axis, with the other sign?

Where a fit leaves the data far off, the readings of all of a type, and of its worst sensors, are turned as another
convention counts them, and the joint mode is looked for again.
"""

import time
from collections.abc import Callable, Iterator, Mapping

import numpy as np

from probcal.analysis.check import Case, Checked, check
from probcal.analysis.findings import Finding
from probcal.analysis.parts import LOOKED
from probcal.gaussian.engine import Expansion
from probcal.inference.fitted import Judged
from probcal.inference.residuals import PRACTICAL
from probcal.model.rows import standardised
from probcal.modes import optima
from probcal.sensor import Channel

FAR = 5.0  # mean square of the innovations from which readings are looked at
LONGEST = 20.0  # s after which no other way is tried
# what else speaks of it
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
    """A finding on the sensor, or the type, whose readings another convention explains where the fit does not."""
    linear = all(form is None for form in case.fit.problem.model.sampled)
    if not (case.fit.engine.cheap and linear) or case.innovations.spread(slice(None)) < FAR:
        return Checked()
    begun = time.monotonic()
    for name, said, values in _tried(case):
        if time.monotonic() - begun > LONGEST:
            break
        again = case.fit.problem.redrawn(values)
        square = _square(case.fit, case.fit.engine.at(again.model, optima(again, lambda: True)[0].point))
        if square < PRACTICAL:
            text = (
                f"{name}: its values {said}: counted so, the mean square of what a fit"
                f" leaves is {square:.2g} and not {_square(case.fit, case.fit.expansion):.2g}"
            )
            return Checked(findings=[Finding("recoded", name, text)], explains=SIGNS)
    return Checked()


def _square(fit: Judged, at: Expansion) -> float:
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
