"""The best answer of a method whose trajectories are particles, from several starts."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from probcal.gaussian.mode import Point
from probcal.inference.method import Context, Method
from probcal.inference.methods import MAP
from probcal.inference.solve import each_start, noting_unseen, rank, solve_timed, starts_unseen
from probcal.modes.explore import Mirrored
from probcal.priors import Gaussian, Prior
from probcal.problem import Problem
from probcal.results.answer import Answer
from probcal.simulate import chance_of

TRIES = 3  # climbs by particles from one start


def solve_by_particles(
    problem: Problem, method: Method, prior: Prior, context: Context, start: Point | None, starts: int
) -> Answer:
    """The answer of a method whose trajectories are particles: it begins at biases, whatever the states of a start.

    Where none is given it is the joint mode, mirrors seen to, with motions of a linear form in the place of others
    (`Motion.loose`), and zero where there is none. Further starts are draws of the biases within their scales; the one
    of the greatest evidence is the answer. A climb that particles threw off is tried again with others. Mirrored
    answers are those of the joint mode, of an answer that began there.
    """
    linear = all(form is None for form in problem.model.sampled)
    near = problem if linear else problem.loosened()
    mirrors: tuple[Mirrored, ...] = ()
    if start is None and near is not None:
        silent = context._replace(monitor=context.monitor.silent())
        first = solve_timed(near, MAP(trajectory="joint", engine="dense"), Gaussian(), silent, None, 1)
        start = first.posterior.point if first.status.valid and first.posterior.sound else None
        mirrors = first.mirrors if linear and start is not None and method.climbs else ()
    drawn = chance_of(jax.random.fold_in(context.key, 1))
    begin = problem.first_z if start is None else np.asarray(start.z)
    places = [begin, *drawn.standard_normal((starts - 1, len(begin)))]
    answers = []
    for k, z in each_start(places, method, context.monitor):
        key = context.key if k == 0 else jax.random.fold_in(context.key, 1 + k)
        point = Point((), (), jnp.asarray(z), jnp.zeros(len(problem.levels)))
        tries = [method.answer(problem, prior, point, context._replace(key=key))]
        while method.climbs and tries[-1].status.again and len(tries) < TRIES:
            if context.monitor.stopped:
                break
            other = context._replace(key=jax.random.fold_in(key, len(tries)))
            tries.append(method.answer(problem, prior, point, other))
        answers.append(max(tries, key=rank))
    best = max(range(len(answers)), key=lambda k: rank(answers[k]))
    found = noting_unseen(answers[best], starts_unseen(len(answers), starts), context.monitor)
    mean = found.posterior.here[0]
    seen = [o._replace(shift=np.asarray(o.point.z) - mean, status="") for o in mirrors if best == 0]
    return replace(found, optima=tuple(answers) if len(answers) > 1 else (), best=best, mirrors=tuple(seen))
