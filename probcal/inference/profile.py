"""Answers that are mixtures: along a ridge where no Gaussian holds, and over two sides of tracks.

Tracks near the plane of all anchors, say, tell their height by its square only, and a common
offset of the ranges makes up for that: the posterior is a long ridge, and its mode, at the plane,
seems sure. What rows change by to second order, when all tracks are shifted along one component of
their state, tells such a ridge (Bates and Watts 1980): the biases that make up for it are its
direction u. The biases are held along u by Gaussian factors at equal steps, the method answers
under each, and these answers are weighed by their evidence, as INLA does over its grid (Rue,
Martino and Chopin 2009); factors of an sd of half a step add up to one. Off the plane the height
has two modes, where the second order undoes the first: both are answered. Reflected positions are
left to `modes`, which reports them.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from probcal.gaussian.choose import engine_of
from probcal.gaussian.draws import residuals
from probcal.gaussian.engine import Factors
from probcal.gaussian.information import at_levels
from probcal.gaussian.mode import Point
from probcal.inference.mixture import mixture_of
from probcal.inference.progress import Monitor, Stopped
from probcal.labels import listed
from probcal.linalg import pseudo_inverse
from probcal.model.model import TILTED, Model, Tilt
from probcal.modes.explore import MOST, SAME, Mirrored, SideClimb
from probcal.modes.grid import follow_states
from probcal.problem import Problem
from probcal.results.answer import Answer, Posterior, Tracks

FAR = 1.5  # sds of the biases that a ridge goes at two sd of the tracks, from which it counts
ALIKE = 0.25  # sds by which a mixture must move a mean, or widen its sd, to be another answer

Answered = Callable[[Problem, Point], Answer | None]  # of a method, if there is a valid one


def profiled(answer: Answer, answered: Answered, monitor: Monitor) -> Answer:
    """The answer, or a mixture of those along a ridge or on two sides that fit about as well."""
    posterior, problem = answer.posterior, answer.problem
    known = answer.status.valid and posterior.sound and answer.prior.proper
    known = known and posterior.summary.covariance.whole
    if monitor.stopped or not known or problem.model.rests or problem.model.biases > TILTED:
        return answer
    curves = [Curve.of(posterior, component) for component in _components(problem)]
    ridge = max(curves, key=lambda one: one.length, default=None)
    try:
        if ridge is not None and ridge.length > FAR:
            monitor.enter(f"answers along {ridge.component}", answering=True)
            held = _held(answer, ridge, monitor)
            found = [own for place in held if (own := answered(*place)) is not None]
            return _mixed(answer, found, ridge, f"The data hardly tell {ridge.component}")
        for curve in curves:
            monitor.check()
            apart = curve.component.startswith("position")
            side = None if apart else _other_side(answer, curve)
            if side is not None and (own := answered(problem, side)) is not None:
                why = f"The data do not tell on which side {curve.component} lies"
                return _mixed(answer, [answer, own], curve, why)
    except Stopped:
        said = f"{monitor.stopped} before other answers were looked at"
        return answer.noted(f"{said}: intervals may be too short.")
    return answer


def _mixed(answer: Answer, found: Sequence[Answer], curve: "Curve", why: str) -> Answer:
    """The answer with the mixture of those found, where that is another posterior than its own."""
    if len(found) < 2:
        return answer
    weights = np.exp([own.objective - max(one.objective for one in found) for own in found])
    weights /= weights.sum()
    mixed = mixture_of(answer.posterior, [own.posterior for own in found], weights)
    pairs = list(zip(_moments(answer.posterior), _moments(mixed), strict=True))
    wider = [b.sd > (1 + ALIKE) * a.sd for a, b in pairs]
    moved = [abs(b.mean - a.mean) > ALIKE * a.sd for a, b in pairs]
    if not any(np.any(own) for own in (*wider, *moved)):
        return answer
    kept = (_part(own, curve, weight) for own, weight in zip(found, weights, strict=True))
    mixed = replace(mixed, parts=tuple(kept))
    labels = [answer.problem.labels[m] for m in np.flatnonzero(wider[0])]
    trades = f", which trades with {listed(labels, MOST)}" if labels else ""
    said = f"means, intervals and tracks are those of {len(found)} answers, weighed by evidence"
    told = f"declare a closer start of {curve.component} where one is known"
    return replace(answer, posterior=mixed).noted(f"{why}{trades}: {said}; {told}.")


def _part(answer: Answer, curve: "Curve", weight: float) -> Mirrored:
    """An answer as one of a mixture, named by where its tracks are along the component."""
    point, summary = answer.posterior.point, answer.posterior.summary
    pairs = answer.problem.model.each_layout(point.states, curve.shift)
    place = np.median(np.concatenate([np.asarray(x)[shift > 0] for _, x, shift in pairs]))
    name, gain = f"{curve.component} {place:.4g}", float(np.log(weight))
    return Mirrored(name, gain, point, summary.mean, status=str(answer.status))


def _moments(posterior: Posterior) -> list[Tracks]:
    """Mean and sd of the biases, and of all states."""
    return [Tracks(posterior.summary.mean, posterior.summary.sd), *posterior.tracks()]


# Curves


class Curve(NamedTuple):
    """Changes of the rows when all tracks are shifted along one component of the states."""

    component: str
    shift: tuple[np.ndarray, ...]  # (E, n) of each recursion: two sd, the median one of each target
    first: tuple[np.ndarray, ...]  # (N, C) of each block, by how much at a shift to first order
    second: tuple[np.ndarray, ...]  # (N, C) to second order
    along: np.ndarray  # (M,) biases that make up for the second order, tracks following
    functional: np.ndarray  # (M,) whose product with biases is their place along these
    length: float  # of these, in sds

    @classmethod
    def of(cls, posterior: Posterior, component: str) -> "Curve":
        """At the point of a posterior."""
        problem, summary, at = posterior.problem, posterior.summary, posterior.expansion
        tracks = enumerate(posterior.tracks())
        shift = tuple(_shift(problem, r, component, own.sd) for r, own in tracks)
        moved = (_shifted(at.model, at.point, shift, by) for by in (0, 1, -1))
        left = [residuals(at.model, own).innovation for own in moved]
        first, second, rows = list[np.ndarray](), list[np.ndarray](), list[Any]()
        for _, _, _, lin, *parts in at.model.each_block(at.rows, *left):
            middle, above, below = map(np.asarray, parts)
            first.append(np.nan_to_num((below - above) / 2))
            second.append(np.nan_to_num(middle - (above + below) / 2))
            score: Any = np.asarray(lin.score) - np.asarray(lin.weight) * second[-1]
            rows.append(lin._replace(score=score))
        pulled = engine_of("dense", at.model).at(at.model, at.point, tuple(rows))
        slope = np.asarray(pulled.slope()) - np.asarray(at.slope())
        along = np.asarray(at.solve(Factors.alone(summary.precision), slope))
        weighed = pseudo_inverse(summary.covariance.matrix(), symmetric=True) @ along
        square = max(float(along @ weighed), np.finfo(float).tiny)
        functional = weighed / square
        return cls(component, shift, tuple(first), tuple(second), along, functional, square**0.5)

    def apart(self, model: Model, a: Point, b: Point) -> bool:
        """Whether the tracks of two points lie more than a shift apart."""
        pairs = model.each_layout(a.states, b.states, self.shift)
        square = [np.sum((np.asarray(x) - y)[s > 0] ** 2) - np.sum(s**2) for _, x, y, s in pairs]
        return sum(square) > 0


def _components(problem: Problem) -> list[str]:
    """Components of states that rows read, but for derivatives: "position_x", "height"."""
    found = dict[str, None]()
    for r, epochs in enumerate(problem.epochs):
        for entry in problem.model.entries(r):
            if not epochs.components[entry].startswith(("velocity", "acceleration")):
                found[epochs.components[entry]] = None
    return list(found)


def _shift(problem: Problem, r: int, component: str, sd: np.ndarray) -> np.ndarray:
    """Two sd, the median one of each target, along a component of the states (E, n)."""
    epochs, found = problem.epochs[r], np.zeros_like(sd)
    if component in epochs.components:
        entry = epochs.components.index(component)
        for mine in epochs.members.values():
            found[mine, entry] = 2.0 * np.median(sd[mine, entry])
    return found


def _shifted(model: Model, point: Point, shift: Iterable[np.ndarray], by: float) -> Point:
    """The point with its states moved, whatever the motion says."""
    pairs = model.each_layout(point.states, shift)
    return point._replace(states=tuple(np.asarray(x) + by * own for _, x, own in pairs))


def _followed(problem: Problem, point: Point, shift: Iterable[np.ndarray], by: float) -> Point:
    """The point with its states moved as far as the motion follows."""
    moved = follow_states(problem, list(_shifted(problem.model, point, shift, by).states))
    return at_levels(problem.model, moved._replace(z=point.z), point.levels)


# The other side


def _other_side(answer: Answer, curve: Curve) -> Point | None:
    """The mode where the second order undoes the first, if that fits about as well."""
    problem, here = answer.problem, answer.posterior.point
    by = _undone(answer.posterior, curve)
    if not any(np.any(own) for own in by):
        return None
    shift = (own[:, None] * whole for own, whole in zip(by, curve.shift, strict=True))
    climb = SideClimb.on(problem, engine_of("dense", problem.model))
    (here, first), (there, second) = map(climb.mode, (here, _followed(problem, here, shift, 1.0)))
    alike = climb.evidence(there, second) > climb.evidence(here, first) - SAME
    return there if alike and curve.apart(problem.model, here, there) else None


def _undone(posterior: Posterior, curve: Curve) -> list[np.ndarray]:
    """Shifts (E,) of each recursion then; 0 for targets whose rows would not stay as they are."""
    problem, at = posterior.problem, posterior.expansion
    sums = [np.zeros((3, len(epochs.time))) for epochs in problem.epochs]
    for _, rows, r, lin, a, b in at.model.each_block(at.rows, curve.first, curve.second):
        for whole, product in zip(sums[r], (a * a, a * b, b * b), strict=True):
            np.add.at(whole, np.asarray(rows.epoch), (np.asarray(lin.weight) * product).sum(1))
    found = []
    for _, epochs, own in at.model.each_layout(problem.epochs, sums):
        for mine in epochs.members.values():
            own[:, mine] = own[:, mine].sum(1, keepdims=True)
        first, both, second = own
        by = -both / np.where(second > 0, second, np.inf)
        left = first + 2 * by * both + by**2 * second
        found.append(np.where((abs(by) > 1) & (left < 0.2 * first), by, 0.0))
    return found


# A ridge


def _held(answer: Answer, curve: Curve, monitor: Monitor) -> Iterator[tuple[Problem, Point]]:
    """Problems held along a ridge, with each of their modes that fits about as well as the best."""
    line, least = _Line(answer, curve), 2.0 / curve.length
    low, high = (line.reach(sign, least, monitor) for sign in (-1, 1))
    step = max(least, (low + high) / 5)  # at most ten answers, of two sides each
    for k in range(-round(low / step), round(high / step) + 1):
        held, modes = line.modes(k * step, step / 2)
        kept = list[Point]()
        for point, value in modes:
            monitor.check()
            new = not any(not curve.apart(held.model, point, other) for other in kept)
            if new and value > modes[0][1] - SAME:
                kept.append(point)
                yield held, point


@dataclass(frozen=True)
class _Line:
    """Places along a ridge, numbered by squares of shifts from the answer."""

    answer: Answer
    curve: Curve

    def modes(self, away: float, sd: float) -> tuple[Problem, list[tuple[Point, float]]]:
        """The problem held at a place within an sd; its modes and their evidence, the best first.

        They are climbed to from tracks as they are, and as far to both sides as the place asks.
        """
        point, curve, problem = self.answer.posterior.point, self.curve, self.answer.problem
        z, along = np.asarray(point.z) + away * curve.along, curve.functional
        curvature = np.outer(along, along) / sd**2
        held = problem.with_tilt(Tilt(z, np.zeros(()), np.zeros(len(z)), curvature))
        climb = SideClimb.on(held, engine_of("dense", held.model))
        starts = [
            _followed(problem, point._replace(z=z), curve.shift, side * abs(away) ** 0.5)
            for side in ((0, 1, -1) if away > 0 else (0,))
        ]
        found = [(own, climb.evidence(own, value)) for own, value in map(climb.mode, starts)]
        return held, sorted(found, key=lambda one: -one[1])

    def reach(self, sign: int, least: float, monitor: Monitor) -> float:
        """Length of the ridge until the evidence falls by `SAME` nats, in steps that double."""
        away, top = 0.0, -np.inf
        while away < least * 2.0**12:
            monitor.check()
            value = self.modes(sign * away, least / 2)[1][0][1]
            if value < top - SAME:
                break
            away, top = max(2 * away, least), max(top, value)
        return away / 2
