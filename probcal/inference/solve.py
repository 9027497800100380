"""Solve a problem by a method, from one start or several: the answer that `fit`, `study` and `sbc` read."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np

from probcal.errors import FitError, InputError
from probcal.gaussian.choose import choose, choose_fast, engine_of, estimates, factoriser
from probcal.gaussian.mode import Point
from probcal.gaussian.room import check_room
from probcal.inference.method import Context, Method
from probcal.inference.methods import MAP
from probcal.inference.profile import profiled
from probcal.inference.progress import Monitor, Stopped
from probcal.inference.run import Maximiser
from probcal.labels import listed
from probcal.model.padding import longer
from probcal.modes import further_starts
from probcal.modes import optima as optima_of
from probcal.modes.clocks import ROUNDS, first_times, settled_times, taken_there
from probcal.modes.explore import MORE, NEAR, SAME, Mirrored, SideClimb, Sides, new, reach
from probcal.modes.grid import follow_states, grid_start
from probcal.modes.mirrors import other_sides
from probcal.priors import Gaussian, Prior
from probcal.problem import Problem
from probcal.results.answer import Answer
from probcal.simulate import derived_keys
from probcal.wings import of_wing

STILL = 0.1  # sd by which no clock moves at the end of them


def with_room(problem: Problem, method: Method, start: Point | None) -> tuple[Problem, Point | None]:
    """The problem with room for a few more rows and epochs where that changes no answer, and a start in its form."""
    if not method.roomy or method.by_particles or not choose_fast(problem.model).cheap:
        return problem, start
    problem = problem.padded()
    return problem, start if start is None else start._replace(trajectories=longer(start.trajectories))


def solve(
    problem: Problem, method: Method, prior: Prior, context: Context, *, start: Point | None = None, starts: int = 1
) -> Answer:
    """The answer of a method, the best of several starts; its `optima` are all of them where there are several.

    Rows of free clocks are taken where the answer puts them: its problem is then the given one `retimed`, solved again
    until no clock moves by `STILL` sd. A sampler takes them where the joint mode does.
    """
    if starts < 1:
        raise InputError(f"starts={starts}: at least one start is needed")
    if (suited := method.suited(problem)) is not method:
        return replace(solve(problem, suited, prior, context, start=start, starts=starts), requested=method)
    if not problem.clocks.any():
        return solve_timed(problem, method, prior, context, start, starts)
    monitor = context.monitor
    monitor.enter("clocks", method.name)
    if start is not None:
        problem, start = taken_there(problem, start)
    else:
        problem = first_times(problem, lambda: bool(monitor.stopped))
        if all(form is None for form in problem.model.sampled) and choose(problem.model).cheap:
            found = optima_of(problem, stopped=lambda: bool(monitor.stopped))
            problem, point = settled_times(problem, found[0].point)
            start = point if len(found) == 1 and starts == 1 else None
    for _ in range(ROUNDS):
        answer = solve_timed(problem, method, prior, context, start, starts)
        if not (method.climbs and answer.posterior.sound and answer.motion == "used"):
            return answer
        summary = answer.posterior.summary
        later = problem.retimed(summary.mean)
        away = np.abs(later.first_z - problem.first_z)
        if np.all(away <= STILL * summary.sd) or monitor.stopped:
            return answer
        problem, start = taken_there(problem, answer.posterior.point)
    moving = [problem.labels[m] for m in np.flatnonzero(away > STILL * summary.sd)]
    return answer.judged(clocks=listed(moving, 3))


def solve_timed(
    problem: Problem, method: Method, prior: Prior, context: Context, start: Point | None, starts: int
) -> Answer:
    """The answer of a method with every row at its time.

    A sampler starts at the best joint mode under the declared scales where there are several
    starts, or noise levels that are unknown. The context's key seeds draws and further starts; its
    monitor may end the search for other answers than the first.
    """
    monitor = context.monitor
    monitor.enter("start", method.name)
    if method.by_particles:
        return of_wing("solve_by_particles")(problem, method, prior, context, start, starts)
    given, problem = problem, method.prepare(problem)
    engined = _on_engine(problem, method, prior, starts)
    method, large = engined or method, engined is not None
    if start is not None:
        points = [_suited(given, problem, start)]
    elif large:
        points = [grid_start(problem)]
    else:
        points = [o.point for o in optima_of(problem, stopped=lambda: bool(monitor.stopped))]
    if method.engined:
        return _sampled_on_best_side(problem, method, prior, points[0], context)
    if not (monitor.stopped or large):
        points += further_starts(problem, starts - len(points), derived_keys(context.key, [1])[0])
    climber, own = (method, prior) if method.climbs else (MAP(trajectory="joint", engine="dense"), Gaussian())
    optima, unseen = list[Answer](), ""
    if method.climbs or len(points) > 1 or problem.levels or problem.model.tailed:
        optima = [climber.answer(problem, own, point, context) for _, point in each_start(points, method, monitor)]
        unseen = starts_unseen(len(optima), max(len(points), starts))
        points = [optimum.posterior.point for optimum in optima]
    best = max(range(len(optima)), key=lambda k: rank(optima[k]), default=0)
    if method.climbs:
        found = optima[best]
    else:  # with the precisions that its process noise has there
        found = method.answer(optima[best].problem if optima else problem, prior, points[best], context)
    several = tuple(optima) if len(points) > 1 else ()
    found = replace(found, motion="used" if problem is given else "left out", optima=several, best=best)
    found = noting_unseen(found, unseen, monitor)
    if not method.climbs or found.motion != "used":
        return found
    try:
        ran = cast("Maximiser", found.method)
        found = first = _beside_mirrors(found, ran, context)

        def answered(held: Problem, point: Point) -> Answer | None:
            monitor.check()
            return _like_first(first, held, ran, point, context)

        return profiled(first, answered, monitor)
    except MemoryError:
        return found.noted("Memory did not hold what looking at other answers takes.")


def each_start[T](places: Sequence[T], method: Method, monitor: Monitor) -> Iterator[tuple[int, T]]:
    """Number and place of each start in turn, until the call is stopped."""
    for k, place in enumerate(places):
        if k and monitor.stopped:
            return
        if method.climbs:
            monitor.enter(f"start {k + 1} of {len(places)}" if k else "climb", answering=True)
        yield k, place


def starts_unseen(climbed: int, wanted: int) -> str:
    """The starts that were not climbed from, in words; empty where all were."""
    return "" if climbed >= wanted else f"{wanted - climbed} of {wanted} starts"


def noting_unseen(answer: Answer, unseen: str, monitor: Monitor) -> Answer:
    """The answer with a sentence on other answers that were not looked for, since the search was
    ended."""
    if not unseen:
        return answer
    said = f"{monitor.stopped} before {unseen} were looked at: there may be other answers."
    return answer.noted(said)


def _on_engine(problem: Problem, method: Method, prior: Prior, starts: int) -> Method | None:
    """The method where an engine of large networks solves the problem; raises `InputError` for what it lacks."""
    if method.engined:
        if starts > 1:
            raise InputError(f"{method.name} takes one start: its chains begin at different draws (chains=...)")
        return method
    if isinstance(method, Maximiser):
        lacks = method.lacking(prior, starts)
        if method.expands_by(problem.model) is not None:
            if lacks and estimates(method.engine):
                raise InputError(f'{method.name}(engine="iterative") takes {lacks}')
            if lacks:
                raise InputError(
                    f"{method.name} on a network of this size is solved in sparse form, which takes {lacks}"
                )
            return method
        if not lacks and method.expands_by(problem.model, fast=True) is not None:
            sparse: Any = method  # of those that have an engine
            return replace(sparse, engine=factoriser())
    check_room(problem.model)
    return None


def _sampled_on_best_side(problem: Problem, method: Method, prior: Prior, start: Point, context: Context) -> Answer:
    """The answer of a sampler on an engine: it starts on the side that fits best, and tells of the others."""
    climb = SideClimb.on(problem, choose_fast(problem.model))
    try:
        sides = other_sides(problem, climb.mode(start)[0], climb)
    except MemoryError:  # which the method says
        sides = Sides(start, False, ())
    found = method.answer(problem, prior, sides.point, context)
    mean = found.posterior.summary.mean
    return replace(found, mirrors=tuple(o._replace(shift=np.asarray(o.point.z) - mean) for o in sides.others))


def _beside_mirrors(answer: Answer, method: Maximiser, context: Context) -> Answer:
    """The answer on the side of a mirror that fits best, and those of other sides that fit about as well.

    Sides are found under the declared scales, without what integrated places add, which is known near this answer
    only. Those that fit about as well, or better, are fitted by the method, whose own answers are compared; one that
    comes back to where another stands is none.
    """
    if not (answer.status.valid and answer.posterior.sound):
        return answer
    problem, here, monitor = answer.problem.untilted, answer.posterior.point, context.monitor
    if monitor.stopped:
        return answer if answer.interrupted else noting_unseen(answer, "mirror images", monitor)
    climb = SideClimb.on(problem, engine_of(method.engine, problem.model))
    sides = _sides_in_time(problem, here, climb, monitor)
    if sides is None:
        return noting_unseen(answer, "mirror images", monitor)
    places = [Mirrored(sides.name, 0.0, sides.point, np.zeros(0), sides.kind)] if sides.moved else []
    places = [other._replace(gain=other.gain + sides.gain) for other in (*places, *sides.others)]
    first, unseen, skipped = _weight(answer), "", 0
    alone = Mirrored("", 0.0, here, answer.posterior.summary.mean, status=str(answer.status))
    found: list[tuple[Mirrored, Answer | None]] = [(alone, answer)]
    for k, other in enumerate(places):
        fits, own = other.gain > -SAME, None
        if fits and not monitor.stopped:
            monitor.enter(f"mirror image {k + 1} of {len(places)}", answering=True)
            own = _like_first(answer, problem, method, other.point, context)
        late = fits and own is None and bool(monitor.stopped)
        skipped += late
        if own is None and other.gain > MORE:
            unseen = f"Under the declared scales another place fits better ({other.name}), from which no fit came."
        elif own is None:
            found.append((other._replace(shift=np.asarray(other.point.z)), None))
        else:
            known = [mode.point for mode, one in found if one is not None]
            if new(problem, own.posterior.point, known, reach(problem, other.point, here)):
                place, gain = own.posterior, _weight(own) - first
                found.append(
                    (Mirrored(other.name, gain, place.point, place.summary.mean, other.kind, str(own.status)), own)
                )
    way, best = alone, answer
    for mode, one in found:
        if one is not None and one.status.settled >= answer.status.settled and mode.gain > max(way.gain, MORE):
            way, best = mode, one
    seen = [
        (mode if mode.name else mode._replace(name=way.name, kind=way.kind))._replace(
            gain=mode.gain - way.gain, shift=mode.shift - way.shift
        )
        for mode, one in found
        if one is not best
    ]
    mirrors = sorted((mode for mode in seen if mode.gain > -NEAR), key=lambda mode: -mode.gain)
    best = best.noted(unseen, motion=answer.motion, optima=answer.optima, best=answer.best, mirrors=tuple(mirrors))
    return noting_unseen(best, f"{skipped} of {len(places)} mirror images" if skipped else "", monitor)


def _sides_in_time(problem: Problem, here: Point, climb: SideClimb, monitor: Monitor) -> Sides | None:
    """The other modes of a problem; None where the call is stopped while they are looked for."""

    def mode(point: Point) -> tuple[Point, float]:
        monitor.check()
        return climb.mode(point)

    monitor.enter("mirror images", answering=True)
    try:
        return other_sides(problem, here, climb._replace(mode=mode))
    except Stopped:
        return None


def _like_first(
    first: Answer,
    problem: Problem,
    method: Method,
    point: Point,
    context: Context,
) -> Answer | None:
    """The answer from a point, if it is valid, whole and in the form of the first."""
    try:
        found = method.answer(problem, first.prior, point, context)
    except FitError:
        return None
    whole = found.status.valid and found.posterior.sound and not found.interrupted
    return found if found.method == first.method and whole else None


def _weight(answer: Answer) -> float:
    """The score for comparing modes: the evidence, or if that is estimated the log marginal density
    of the biases."""
    if estimates(getattr(answer.method, "engine", "dense")) and answer.trace is not None:
        return float(answer.trace[-1])
    return answer.objective


def _suited(given: Problem, problem: Problem, start: Point) -> Point:
    """A start for the problem that a method solves in the place of the given one."""
    if problem is given:
        return start
    states = [np.asarray(x) for x in start.states]
    return follow_states(problem, states)._replace(z=start.z)


def rank(answer: Answer) -> tuple[bool, bool, float]:
    """Order of optima: an answer before none, a converged one before others, then evidence (density if flat)."""
    return answer.status.valid and np.isfinite(answer.objective), answer.status.settled, answer.objective
