"""Is what looks well told open along a curve? The biases of each component, moved together.

A height above the plane of the nodes enters by its square: on that plane nothing tells it, and what
it trades with, a range offset of all, looks known far better than it is. So the biases of a
component are held together `FAR` sd away, under the declared scales, and all else climbs, from
tracks that stand an sd from the fit. Where the density falls by less than half of what a Gaussian
falls, that way is followed to where it has fallen by so much.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import numpy as np

from probcal.analysis.check import Case, Checked, check
from probcal.analysis.findings import Finding
from probcal.analysis.pieces import HELD
from probcal.analysis.verdict import in_unit
from probcal.gaussian.climb import Climbed, climb_to_mode
from probcal.gaussian.engine import Expansion, Factors, Group
from probcal.gaussian.information import at_levels
from probcal.gaussian.mode import Point
from probcal.inference.fitted import Judged
from probcal.labels import listed
from probcal.linalg import outer
from probcal.modes.explore import CLIMB
from probcal.modes.grid import follow_states
from probcal.priors import Gaussian
from probcal.problem import Problem

FAR = 4.0  # sd of a move, and the prior sds where moves end
FLAT = 0.5  # share of the fall of a Gaussian below which the density falls too little
CLOSE = 0.1  # rise in nats that ends a climb
TOLD = 0.5  # prior sds from which a combination is not said to be told


class Way(NamedTuple):
    """The biases of a component moved together, from the mode under the declared scales."""

    name: str
    along: np.ndarray  # (M,) of unit length
    expand: Callable[[Point], Expansion]
    factors: Factors
    mode: Climbed
    response: np.ndarray  # (M,) of all biases to a unit move, times the variance of the combination

    @property
    def sd(self) -> float:
        """Standard deviation of the combination."""
        return float(np.sqrt(self.along @ self.response))

    def held(self, away: float, start: Point) -> tuple[Climbed, float]:
        """The mode with the combination held so many sds away, and the fall of the density."""
        along, weight = self.along[None], HELD / self.sd**2
        value = self.along @ np.asarray(self.mode.at.point.z) + away * self.sd
        own = Group(np.arange(len(self.along))[None], weight * outer(along), weight * value * along)
        found = climb_to_mode(self.expand, start, self.factors + Factors((own,)), CLIMB, CLOSE)
        return found, -self.mode.value - found.at.density() - self.factors.value(found.at.point.z)

    def end(self, side: float, near: Point) -> tuple[Climbed, float, float] | None:
        """The end of a ridge on a side, its fall and distance in sds; None where there is none."""
        away, step = side * FAR, self.response / self.sd
        end, fall = self.held(away, near._replace(z=np.asarray(self.mode.at.point.z) + away * step))
        if not fall < FLAT * 0.5 * FAR**2:
            return None
        while abs(away * self.sd) < FAR:
            further, more = self.held(2.0 * away, end.at.moved(away * step))
            if not more < 0.5 * FAR**2:
                break
            away, end, fall = 2.0 * away, further, more
        return end, fall, away


def of_components(problem: Problem) -> Iterator[tuple[str, np.ndarray]]:
    """Unit vectors (M,) of the biases of one name and unit that several nodes or sensors have."""
    pairs = zip(problem.labels, problem.biases, strict=True)
    parts = [(label.partition(".")[2], bias.unit) for label, bias in pairs]
    for part in dict.fromkeys(parts):
        mine = np.array([own == part for own in parts]) & ~problem.surveyed
        if mine.sum() > 1:
            yield part[0], mine / np.sqrt(mine.sum())


def moved_together(fit: Judged, told: float = TOLD) -> Iterator[tuple[Way, Point]]:
    """Each component that the data seem to tell to `told` prior sds, and tracks an sd aside."""
    problem, expand = fit.problem, partial(fit.engine.settled, fit.problem.model)
    factors, asked = Factors.of(problem.first_precision(Gaussian())), list(of_components(problem))
    if not asked:
        return
    mode = climb_to_mode(expand, fit.point, factors, CLIMB, CLOSE)
    point, spread = mode.at.point, map(np.asarray, mode.at.held_states)
    pairs = zip(map(np.asarray, point.states), spread, strict=True)
    aside = [x + np.sqrt(np.diagonal(own, axis1=1, axis2=2)) for x, own in pairs]
    near = at_levels(problem.model, follow_states(problem, aside), point.levels)
    for name, along in asked:
        way = Way(name, along, expand, factors, mode, np.asarray(mode.at.solve(factors, along)))
        if way.sd < told:
            yield way, near


@check("answer", "explained", "factor")
def check_ridges(case: Case) -> Checked:
    """A finding for each component along which the density falls too slowly; what moves is weak.

    It is asked where expansions cost little. Such an answer is one end of a curve of answers.
    """
    fit, findings, doubts = case.fit, list[Finding](), dict[int, str]()
    problem, sd = fit.problem, case.tree["calibration"].to_dataset()["sd"].values
    for way, near in moved_together(fit) if fit.engine.cheap else ():
        found = way.end(-1.0, near) or way.end(1.0, near)
        if found is None:
            continue
        end, fall, away = found
        shift = (np.asarray(end.at.point.z) - np.asarray(way.mode.at.point.z)) * problem.scales
        mine = np.flatnonzero(way.along)
        owners = listed([problem.labels[m].partition(".")[0] for m in mine])
        off = f"{in_unit(np.mean(shift[mine]), problem.biases[mine[0]].unit)} and more"
        text = (
            f"{way.name} of {owners} may be off together by {off}: the density falls by {fall:.2g}"
            f" nats there, that of a Gaussian by {0.5 * away**2:.2g}. Something else moves along, a"
            " height or a distance: survey it, or state where targets start,"
            " Target(motion, start=...), and compare with NUTS()"
        )
        findings.append(Finding("ridge", way.name, text))
        moved = np.flatnonzero(np.abs(shift) > FLAT * FAR * sd)
        why = f"{way.name} of all is open along a curve, on which it moves by"
        doubts |= {int(m): f"{why} {shift[m] / sd[m]:.2g} sd" for m in moved}
    return Checked(findings=findings, doubts={"weak": doubts})
