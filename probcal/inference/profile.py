"""Answers that are mixtures: along a ridge where no Gaussian holds, and over two sides of tracks.

Tracks near the plane of all anchors, say, tell their height by its square only, and a common
offset of the ranges makes up for that: the posterior is a long ridge, and its mode, at the plane,
seems sure. What rows change by to second order, when all tracks are shifted along one component of
their state, tells such a ridge (Bates and Watts 1980). There the first state of a target is held
by Gaussian factors at equal steps, the method answers under each, and these answers are weighed by
their evidence, as INLA does over its grid (Rue, Martino and Chopin 2009); factors of an sd of half
a step add up to one. Off the plane each height has two modes, where the second order undoes the
first: targets change sides one by one, and what fits about as well is answered. Reflected
positions are left to `modes`, which reports them.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from probcal.gaussian.choose import choose, engine_of
from probcal.gaussian.draws import residuals
from probcal.gaussian.engine import Factors
from probcal.gaussian.information import at_levels
from probcal.gaussian.mode import Point
from probcal.inference.mixture import mixture_of
from probcal.inference.progress import Monitor, Stopped
from probcal.labels import listed
from probcal.linalg import pseudo_inverse
from probcal.model.model import Model, Spot
from probcal.modes.explore import MOST, NEAR, SAME, Mirrored, SideClimb
from probcal.modes.grid import follow_states
from probcal.problem import Problem
from probcal.results.answer import Answer, Posterior, Tracks

FAR = 1.5  # sds of the biases that a ridge goes at two sd of the tracks, from which it counts
ALIKE = 0.25  # sds by which a mixture must move a mean, or widen its sd, to be another answer

Answered = Callable[[Problem, Point], Answer | None]  # of a method, if there is a valid one


def profiled(answer: Answer, answered: Answered, monitor: Monitor) -> Answer:
    """The answer, or a mixture of those along a ridge or on two sides that fit about as well."""
    problem, known = answer.problem, answer.status.valid and answer.posterior.sound
    known = known and answer.prior.proper and answer.posterior.summary.covariance.whole
    if monitor.stopped or not known or problem.model.rests or not choose(problem.model).cheap:
        return answer
    try:
        sides, over = [answer], None
        for component in _components(problem):
            while True:
                curve = Curve.of(answer.posterior, component)
                found = _sides(answer, curve, answered, monitor)
                sides, over = (found, curve) if len(found) > 1 else (sides, over)
                if found[0] is answer:
                    break
                answer = sides[0] = _instead(answer, found[0])
        curves = [Curve.of(answer.posterior, component) for component in _components(problem)]
        ridge = max(curves, key=lambda one: one.length, default=None)
        if ridge is not None and ridge.length > FAR:
            monitor.enter(f"answers along {ridge.component}", answering=True)
            parts = _along(answer, ridge, sides[:MOST], answered)
            more = ", and no end of that was found" if len(parts) >= 16 * MOST else ""
            return _mixed(answer, parts, ridge, f"The data hardly tell {ridge.component}{more}")
        if over is not None:
            apart = [_Part(0, one, one.objective) for one in sides]
            why = f"The data do not tell on which side {over.component} lies"
            return _mixed(answer, apart, over, why)
    except Stopped:
        said = f"{monitor.stopped} before other answers were looked at"
        return answer.noted(f"{said}: intervals may be too short.")
    return answer


def _instead(first: Answer, better: Answer) -> Answer:
    """A better answer with what was found around the first one."""
    gain = better.objective - first.objective
    moved = first.posterior.summary.mean - better.posterior.summary.mean
    mirrors = tuple(m._replace(gain=m.gain - gain, shift=m.shift + moved) for m in first.mirrors)
    return replace(better, motion=first.motion, optima=first.optima, best=first.best, mirrors=mirrors)


def _mixed(answer: Answer, parts: Sequence["_Part"], curve: "Curve", why: str) -> Answer:
    """The answer with the mixture of those found, where that is another posterior than its own."""
    if len(parts) < 2:
        return answer
    worth = np.array([part.worth for part in parts])
    weights = np.exp(worth - worth.max())
    weights, found = weights / weights.sum(), [part.answer for part in parts]
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
    problem, told = answer.problem, list[str]()
    for _, epochs, x, shift in problem.model.each_layout(problem.epochs, point.states, curve.shift):
        for mine in epochs.members.values():
            own = np.asarray(x)[mine][shift[mine] > 0]
            told += [f"{np.median(own):.4g}"] if own.size else []
    name, gain = f"{curve.component} {listed(told, MOST)}", float(np.log(max(weight, 1e-300)))
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
    length: float  # of the biases that make up for the second order, tracks following, in sds

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
        inverse = pseudo_inverse(summary.covariance.matrix(), symmetric=True)
        length = max(float(along @ inverse @ along), 0.0) ** 0.5
        return cls(component, shift, tuple(first), tuple(second), length)

    def apart(self, problem: Problem, a: Point, b: Point) -> bool:
        """Say whether the track of a target is more than a shift apart at two points."""
        pairs = problem.model.each_layout(problem.epochs, a.states, b.states, self.shift)
        return any(
            np.sum((np.asarray(x) - y)[mine] ** 2 * (shift[mine] > 0)) > np.sum(shift[mine] ** 2)
            for _, epochs, x, y, shift in pairs
            for mine in epochs.members.values()
        )


def _components(problem: Problem) -> list[str]:
    """Components of states that rows read, as "height"; no positions, no derivatives."""
    found = dict[str, None]()
    for r, epochs in enumerate(problem.epochs):
        for entry in problem.model.entries(r):
            if not epochs.components[entry].startswith(("position", "velocity", "acceleration")):
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


# Other sides


def _sides(answer: Answer, curve: Curve, answered: Answered, monitor: Monitor) -> list[Answer]:
    """The answers that fit about as well where the second order undoes the first, the best first.

    Targets change sides one by one, from the best place on.
    """
    problem, here = answer.problem, answer.posterior.point
    ways, found = _undone(answer.posterior, curve), [answer]
    if not ways:
        return found
    climb = SideClimb.on(problem, engine_of("dense", problem.model))
    known, seen = dict[frozenset[int], tuple[Point, float]](), set[frozenset[int]]()

    def near(nats: float) -> list[frozenset[int]]:
        least = max(value for _, value in known.values()) - nats
        within = (one for one in known if known[one][1] > least)
        return sorted(within, key=lambda one: -known[one][1])

    def add(side: frozenset[int], start: Point) -> None:
        monitor.check()
        point, value = climb.mode(start)
        alike = any(not curve.apart(problem, point, other) for other, _ in known.values())
        known[side] = point, -np.inf if alike else climb.evidence(point, value)

    add(frozenset(), here)
    changes = [frozenset(range(len(ways))), *(frozenset({k}) for k in range(len(ways)))]
    while len(known) < 16 * MOST:
        side = next((one for one in near(NEAR) if one not in seen), None)
        if side is None:
            break
        seen.add(side)
        for other in (side ^ change for change in changes):
            if other and other not in known:
                moved = zip(*(ways[t] for t in other), strict=True)
                shift = (sum(own, start=np.zeros(1)) for own in moved)
                add(other, _followed(problem, here._replace(z=known[side][0].z), shift, 1.0))
    for side in near(SAME)[: 2 * MOST]:
        if side and (own := answered(problem, known[side][0])) is not None:
            found.append(own)
    return sorted(found, key=lambda one: -one.objective)


def _undone(posterior: Posterior, curve: Curve) -> list[list[np.ndarray]]:
    """Shifts (E, n) of each recursion then, of each target whose rows stay as they are by half."""
    problem, found = posterior.problem, []
    for r, (first, both, second) in enumerate(_sums(posterior, curve)):
        by = -both / np.where(second > 0, second, np.inf)
        left = first + 2 * by * both + by**2 * second
        for mine in problem.epochs[r].members.values():
            if (mine & (abs(by) > 1) & (left < 0.5 * first)).any():
                shifts = [np.zeros_like(own) for own in curve.shift]
                shifts[r][mine] = by[mine, None] * curve.shift[r][mine]
                found.append(shifts)
    return found


def _sums(posterior: Posterior, curve: Curve) -> list[np.ndarray]:
    """Weighed squares (3, E) of the rows of each target: of the first order, both, the second."""
    problem, at = posterior.problem, posterior.expansion
    sums = [np.zeros((3, len(epochs.time))) for epochs in problem.epochs]
    for _, rows, r, lin, a, b in at.model.each_block(at.rows, curve.first, curve.second):
        for whole, product in zip(sums[r], (a * a, a * b, b * b), strict=True):
            np.add.at(whole, np.asarray(rows.epoch), (np.asarray(lin.weight) * product).sum(1))
    for _, epochs, own in at.model.each_layout(problem.epochs, sums):
        for mine in epochs.members.values():
            own[:, mine] = own[:, mine].sum(1, keepdims=True)
    return sums


# A ridge


class _Part(NamedTuple):
    """An answer of a mixture."""

    k: int  # number of the place where a first state is held, 0 where none is
    answer: Answer
    worth: float  # logarithm of its weight


def _along(answer: Answer, curve: Curve, sides: list[Answer], answered: Answered) -> list[_Part]:
    """Answers at equal steps of a first state, from each side, until each way fits worse."""
    line, found = _Line.of(answer, curve), list[_Part]()

    def reached(k: int, start: Point) -> _Part | None:
        """The answer at a place, where the way goes on from it."""
        problem, density = line.held(k)
        own = answered(problem, _followed(problem, start, curve.shift, 0.0))
        if own is None:
            return None
        point, here = own.posterior.point, (one.answer for one in found if one.k == k)
        if not all(curve.apart(problem, point, one.posterior.point) for one in here):
            return None
        worth = own.objective + density if line.follows(point) else -np.inf
        found.append(part := _Part(k, own, worth))
        return part if part.worth > max(one.worth for one in found) - SAME else None

    for side in sides:
        middle = reached(line.number(side.posterior.point), side.posterior.point)
        for sign in (1, -1):
            part = middle
            while part is not None and len(found) < 16 * MOST:  # some have no end
                part = reached(part.k + sign, part.answer.posterior.point)
    follows = all(one.worth > -np.inf for one in found)
    return found if follows else []  # the track leaves such a start


class _Line(NamedTuple):
    """Places of the first state of one target, numbered from an answer."""

    problem: Problem
    where: Spot  # recursion, epoch and entry of the state
    values: np.ndarray  # in the answer, its own and the median of its track
    step: float

    @classmethod
    def of(cls, answer: Answer, curve: Curve) -> "_Line":
        """Of the target that the second order changes most, by two sds of the biases a step."""
        problem, point = answer.problem, answer.posterior.point
        sums = _sums(answer.posterior, curve)
        _, r, epoch, entry = max(
            (own[2, epoch], r, epoch, entry)
            for r, (part, own, shift) in enumerate(problem.model.each_layout(sums, curve.shift))
            for epoch, entry in np.argwhere(np.asarray(part.first)[:, None] & (shift > 0))
        )
        step = float(curve.shift[r][epoch, entry]) * (2.0 / curve.length) ** 0.5
        where = r, epoch, entry
        return cls(problem, where, _first_and_median(problem, where, point), step)

    def number(self, point: Point) -> int:
        """Of the place next to a point."""
        first, _ = _first_and_median(self.problem, self.where, point) - self.values
        return round(first / self.step)

    def follows(self, point: Point) -> bool:
        """Say whether the middle of the track has gone with the first state."""
        first, middle = _first_and_median(self.problem, self.where, point) - self.values
        return abs(middle - first) <= 0.5 * abs(first) + 0.1 * self.step

    def held(self, k: int) -> tuple[Problem, float]:
        """The problem held at a place, and the log density that its evidence lacks."""
        return self.problem.with_start(self.where, self.values[0] + k * self.step, self.step / 2)


def _first_and_median(problem: Problem, where: Spot, point: Point) -> np.ndarray:
    """An entry of the first state of a target, and its median along the track."""
    r, epoch, entry = where
    mine = problem.epochs[r].target == problem.epochs[r].target[epoch]
    track = np.asarray(point.states[r])[mine, entry]
    return np.array([track[0], np.median(track)])
