"""Solve a problem by a method, from one start or several: the answer that `fit`, `study` and `sbc` read."""

from dataclasses import replace

import jax
import numpy as np

from probcal.inference.methods import MAP
from probcal.inference.run import Context, Method
from probcal.priors import Gaussian, Prior
from probcal.problem import Problem
from probcal.results.answer import Answer
from probcal.smoothing.mode import Point
from probcal.smoothing.start import automatic_start, follow_states, further_starts


def solve(
    problem: Problem, method: Method, prior: Prior, context: Context, *, start: Point | None = None, starts: int = 1
) -> Answer:
    """The answer of a method, the best of several starts; its `optima` are all of them where there are several.

    A sampler starts at the best joint mode under the declared scales where there are several starts, or noise levels
    that are unknown. The context's key seeds draws and further starts.
    """
    given, problem = problem, method.prepare(problem)
    first = automatic_start(problem) if start is None else _suited(given, problem, start)
    points = [first, *further_starts(problem, starts - 1, jax.random.fold_in(context.key, 1))]
    climber, own = (method, prior) if method.climbs else (MAP(trajectory="joint"), Gaussian())
    optima: list[Answer] = []
    if method.climbs or starts > 1 or problem.levels:
        optima = [climber.answer(problem, own, point, context) for point in points]
        points = [optimum.posterior.point for optimum in optima]
    best = max(range(starts), key=lambda k: _rank(optima[k])) if len(optima) > 1 else 0
    found = optima[best] if method.climbs else method.answer(problem, prior, points[best], context)
    motion = "used" if problem is given else "left out"
    return replace(found, motion=motion, optima=tuple(optima) if starts > 1 else (), best=best)


def _suited(given: Problem, problem: Problem, start: Point) -> Point:
    """A start for the problem that a method solves in the place of the given one."""
    if problem is given:
        return start
    states = [np.asarray(x) for x in start.states]
    return follow_states(problem, states)._replace(z=start.z)


def _rank(answer: Answer) -> tuple[bool, bool, float]:
    """Order of optima: an answer before none, a converged one before others, then evidence (density if flat)."""
    return answer.status.valid and np.isfinite(answer.objective), answer.status.settled, answer.objective
