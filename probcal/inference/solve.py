"""Solve a problem by a method, from one start or several: the answer that `fit`, `study` and `sbc` read."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from probcal.errors import FitError, InputError
from probcal.inference.methods import MAP
from probcal.inference.run import Context, Maximiser, Method
from probcal.inference.sparse import check_sparse, gains_by_sparse, sparse_climb, takes_sparse
from probcal.inference.sparse_gibbs import check_gibbs
from probcal.priors import Gaussian, Prior
from probcal.problem import Problem
from probcal.results.answer import Answer
from probcal.smoothing.grid import follow_states, grid_start
from probcal.smoothing.mirrors import MORE, NEAR, SAME, Mirrored, SideClimb, Sides, distance, other_sides
from probcal.smoothing.mode import Point
from probcal.smoothing.room import check_room
from probcal.starts import further_starts
from probcal.starts import optima as optima_of
from probcal.status import Status

TRIES = 3  # climbs by particles from one start
DIFFERENT = 2.0  # sd by which an answer from another start must differ in some bias to be one of its own
APART = 0.01  # scales that count as an sd where that is smaller


def solve(
    problem: Problem, method: Method, prior: Prior, context: Context, *, start: Point | None = None, starts: int = 1
) -> Answer:
    """The answer of a method, the best of several starts; its `optima` are all of them where there are several.

    A sampler starts at the best joint mode under the declared scales where there are several starts, or noise levels
    that are unknown. The context's key seeds draws and further starts.
    """
    if method.by_particles:
        return _by_particles(problem, method, prior, context, start, starts)
    given, problem = problem, method.prepare(problem)
    used = problem is given
    if (sparse := _sparsely(problem, method, prior, starts)) is not None:
        method = sparse
        first = grid_start(problem, jnp.zeros(problem.model.biases), 30) if start is None else start
        return _in_sparse_form(problem, method, prior, first, context)
    points = [o.point for o in optima_of(problem)] if start is None else [_suited(given, problem, start)]
    points += further_starts(problem, starts - len(points), jax.random.fold_in(context.key, 1))
    climber, own = (method, prior) if method.climbs else (MAP(trajectory="joint"), Gaussian())
    optima: list[Answer] = []
    if method.climbs or len(points) > 1 or problem.levels or problem.model.tailed:
        optima = [climber.answer(problem, own, point, context) for point in points]
        points = [optimum.posterior.point for optimum in optima]
    best = max(range(len(optima)), key=lambda k: _rank(optima[k])) if optima else 0
    if optima and not method.climbs:  # with the precisions that its process noise has there
        problem = optima[best].problem
    found = optima[best] if method.climbs else method.answer(problem, prior, points[best], context)
    motion = "used" if used else "left out"
    found = replace(found, motion=motion, optima=tuple(optima) if len(points) > 1 else (), best=best)
    if not (method.climbs and used):
        return found
    beside = _beside_mirrors(found, method, context)
    return replace(beside, mirrors=(*beside.mirrors, *_beside_optima(beside, (found, *found.optima))))


def _sparsely(problem: Problem, method: Method, prior: Prior, starts: int) -> Method | None:
    """The method where it solves a problem in sparse form; raises `InputError` where it must, and does not take it."""
    if method.sparsely:
        if starts > 1:
            raise InputError(f"{method.name} takes one start: its chains begin at different draws (chains=...)")
        check_gibbs(problem, prior)
        return method
    if isinstance(method, Maximiser) and takes_sparse(method, problem):
        check_sparse(method, prior, starts)
        return method
    if isinstance(method, Maximiser) and gains_by_sparse(method, problem, prior, starts):
        sparse: Any = method  # of those that have a form
        return replace(sparse, form="sparse")
    check_room(problem.model)
    return None


def _in_sparse_form(problem: Problem, method: Method, prior: Prior, start: Point, context: Context) -> Answer:
    """The answer of a method in sparse form, the other sides of a mirror seen to.

    A sampler starts on the side that fits best, and its answer tells of the others.
    """
    if method.climbs:
        found = method.answer(problem, prior, start, context)
        used = cast("Method", found.method)  # "matrix-free" where memory held no factor
        try:
            return _beside_mirrors(found, used, context, sparse_climb(problem, getattr(used, "form", "")))
        except MemoryError:
            unseen = "Memory did not hold what looking at the other side of a mirror takes."
            return replace(found, message=f"{found.message} {unseen}".strip())
    climb = sparse_climb(problem, "sparse")
    try:
        sides = other_sides(problem, climb.mode(start)[0], climb)
    except MemoryError:  # which the method says
        sides = Sides(start, False, ())
    found = method.answer(problem, prior, sides.point, context)
    mean = found.posterior.summary.mean
    return replace(found, mirrors=tuple(o._replace(shift=np.asarray(o.point.z) - mean) for o in sides.others))


def _by_particles(
    problem: Problem, method: Method, prior: Prior, context: Context, start: Point | None, starts: int
) -> Answer:
    """The answer of a method whose trajectories are particles: it begins at biases, whatever the states of a start.

    Where none is given it is the joint mode, mirrors seen to, with motions of a linear form in the place of others
    (`Motion.loose`), and zero where there is none. Further starts are draws of the biases within their scales; the one
    of the greatest evidence is the answer. A climb that particles threw off is tried again with others. Mirrored
    answers are those of the joint mode.
    """
    linear = all(form is None for form in problem.model.sampled)
    near = problem if linear else problem.loosened()
    mirrors: tuple[Mirrored, ...] = ()
    if start is None and near is not None:
        first = solve(near, MAP(trajectory="joint"), Gaussian(), context._replace(progress=None))
        start = first.posterior.point if first.status.valid and first.posterior.sound else None
        mirrors = first.mirrors if linear and start is not None and method.climbs else ()
    drawn = np.random.default_rng(np.asarray(jax.random.key_data(jax.random.fold_in(context.key, 1))))
    begin = np.zeros(problem.model.biases) if start is None else np.asarray(start.z)
    places = [begin, *drawn.standard_normal((starts - 1, len(begin)))]
    answers = []
    for k, z in enumerate(places):
        key = context.key if k == 0 else jax.random.fold_in(context.key, 1 + k)
        point = Point((), (), jnp.asarray(z), jnp.zeros(len(problem.levels)))
        tries = [method.answer(problem, prior, point, context._replace(key=key))]
        while method.climbs and tries[-1].status in (Status.NOT_CONVERGED, Status.MISFIT) and len(tries) < TRIES:
            other = context._replace(key=jax.random.fold_in(key, len(tries)))
            tries.append(method.answer(problem, prior, point, other))
        answers.append(max(tries, key=_rank))
    best = max(range(starts), key=lambda k: _rank(answers[k]))
    return replace(answers[best], optima=tuple(answers) if starts > 1 else (), best=best, mirrors=mirrors)


def _beside_mirrors(answer: Answer, method: Method, context: Context, climb: SideClimb | None = None) -> Answer:
    """The answer on the side of a mirror that fits best, and those of other sides that fit about as well."""
    if not (answer.status.valid and answer.posterior.sound):
        return answer

    def answered(point: Point) -> Answer | None:
        """The answer from a point, if there is one in the form of the first."""
        try:
            found = method.answer(answer.problem, answer.prior, point, context)
        except FitError:
            return None
        return found if found.method == answer.method else None

    sides = other_sides(answer.problem, answer.posterior.point, climb)
    found, rest, again = answer, sides.others, None
    if sides.moved:
        name = sides.others[0].name if sides.others else "pieces of tracks on their other side"
        again = answered(sides.point)
        if again is None:
            unseen = f"Under the declared scales another place fits better ({name}), from which no fit came."
            return replace(answer, message=f"{answer.message} {unseen}".strip())
        if not again.status.valid:
            return answer
        if again.objective > answer.objective:
            found = _in_place_of(answer, again)
        else:  # better under the declared scales, not under the prior
            rest = _seen_from(answer, sides, name, again.objective - answer.objective)
    others: list[tuple[Mirrored, Answer | None]] = []
    for other in rest:
        own = again if other.point is sides.point else answered(other.point) if other.gain > -SAME else None
        own = own if own is not None and own.status.valid and own.posterior.sound else None
        others.append((other if own is None else _beside(found, own, other.name), own))
    best = max((own for _, own in others if own is not None), key=lambda own: own.objective, default=found)
    if best.objective > found.objective + MORE:
        name = next(other.name for other, own in others if own is best)
        gain, shift = best.objective - found.objective, best.posterior.summary.mean - found.posterior.summary.mean
        kept = [
            other._replace(gain=other.gain - gain, shift=other.shift - shift)
            for other, own in others
            if own is not best
        ]
        found, mirrors = _in_place_of(answer, best), [_beside(best, found, name), *kept]
    else:
        mirrors = [other for other, _ in others]
    mirrors = sorted((other for other in mirrors if other.gain > -NEAR), key=lambda other: -other.gain)
    return replace(found, mirrors=tuple(mirrors))


def _in_place_of(answer: Answer, other: Answer) -> Answer:
    """Another answer, with what is known of the search from several starts."""
    return replace(other, motion=answer.motion, optima=answer.optima, best=answer.best)


def _beside(answer: Answer, other: Answer, name: str) -> Mirrored:
    """Another answer of the same method, as seen from one."""
    shift = other.posterior.summary.mean - answer.posterior.summary.mean
    return Mirrored(name, other.objective - answer.objective, other.posterior.point, shift)


def _seen_from(answer: Answer, sides: Sides, name: str, gain: float) -> tuple[Mirrored, ...]:
    """The best side, of that gain, and those beside it, less the one at which the answer stands, as seen from there."""
    mean = answer.posterior.summary.mean
    every = [Mirrored(name, 0.0, sides.point, np.zeros_like(mean)), *sides.others]
    away = [distance(answer.problem, answer.posterior.point, other.point) for other in every if sides.others]
    nearest = int(np.argmin(away)) if away else 0
    here = every.pop(nearest).gain if nearest else -gain
    return tuple(o._replace(gain=o.gain - here, shift=np.asarray(o.point.z) - mean) for o in every)


def _beside_optima(answer: Answer, others: Sequence[Answer]) -> tuple[Mirrored, ...]:
    """Answers from other starts whose evidence is near that of the answer, each once, as answers beside it."""
    if not (answer.status.valid and answer.posterior.sound):
        return ()
    mean, sd = answer.posterior.here
    known = [mean, *(mean + other.shift for other in answer.mirrors)]
    found = []
    for other in sorted(others, key=lambda one: -one.objective):
        gain = other.objective - answer.objective
        if not (other.status.valid and other.posterior.sound and gain > -NEAR):
            continue
        there = other.posterior.here[0]
        if all(np.max(np.abs(there - one) / np.maximum(sd, APART), initial=0.0) > DIFFERENT for one in known):
            found.append(Mirrored("found from another start", gain, other.posterior.point, there - mean))
            known.append(there)
    return tuple(found)


def _suited(given: Problem, problem: Problem, start: Point) -> Point:
    """A start for the problem that a method solves in the place of the given one."""
    if problem is given:
        return start
    states = [np.asarray(x) for x in start.states]
    return follow_states(problem, states)._replace(z=start.z)


def _rank(answer: Answer) -> tuple[bool, bool, float]:
    """Order of optima: an answer before none, a converged one before others, then evidence (density if flat)."""
    return answer.status.valid and np.isfinite(answer.objective), answer.status.settled, answer.objective
