"""Evidence approximation and MAP: the joint Laplace evidence with every trajectory marginalised."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from probcal.inference.run import CHUNK, Outcome, Progress, finish, first_precisions, run_chunks
from probcal.priors import ARD, PRECISION_BOUNDS, Flat, Gaussian, Prior
from probcal.problem import Problem, Spec, System
from probcal.smoothing.information import Laplace, laplace, update_levels
from probcal.smoothing.mode import Point, cost, find_mode

MODE_STEPS = 30  # Gauss-Newton steps between two updates of the precisions


class _State(NamedTuple):
    point: Point
    alpha: jax.Array  # precisions at which the point is the mode, once done
    found: Laplace
    done: jax.Array


@partial(jax.jit, static_argnames=("spec", "prior"))
def _chunk(
    spec: Spec, prior: Prior, system: System, state: _State, surveyed: jax.Array, tolerance: float
) -> tuple[_State, tuple[jax.Array, jax.Array]]:
    """A few outer iterations: mode, evidence at that mode, then new precisions and levels; stops when done."""

    def iterate(state: _State) -> _State:
        mode = find_mode(spec, system, state.point, state.alpha, MODE_STEPS, 1e-2 * tolerance)
        found = laplace(spec, system, mode.point, state.alpha)
        still = jnp.abs(found.evidence - state.found.evidence) < tolerance
        learning = isinstance(prior, ARD) or mode.point.levels.shape[0] > 0
        # where a target grazes a sensor the density has a cusp: no step lowers the cost, and none is needed
        settled = mode.converged | (cost(spec, system, state.point, state.alpha) - mode.cost < tolerance)
        done = still & settled if learning else mode.converged
        point, alpha = mode.point, state.alpha
        if isinstance(prior, ARD):
            learnt = jnp.clip(prior.mackay(found.gamma, point.z), *PRECISION_BOUNDS)
            alpha = jnp.where(done | surveyed, alpha, learnt)
        if point.levels.shape[0]:
            moved = update_levels(spec, system, point, found.covariance)
            point = jax.tree.map(lambda new, old: jnp.where(done, old, new), moved, point)
        return _State(point, alpha, found, done)

    def body(state: _State, _: None) -> tuple[_State, tuple[jax.Array, jax.Array]]:
        after = jax.lax.cond(state.done, lambda s: s, iterate, state)
        return after, (after.found.evidence, state.done)

    return jax.lax.scan(body, state, length=CHUNK)


def _maximise(method: "EA | MAP", problem: Problem, prior: Prior, start: Point, progress: Progress | None) -> Outcome:
    alpha = first_precisions(problem, prior)
    M = len(problem.labels)
    blank = Laplace(jnp.zeros((M, M)), jnp.zeros((M, M)), jnp.zeros(M), jnp.full((), -jnp.inf, float))
    state = _State(start, alpha, blank, jnp.zeros((), bool))
    surveyed = jnp.asarray(problem.surveyed)

    def step(state: _State) -> tuple[_State, tuple[jax.Array, jax.Array]]:
        return _chunk(problem.spec, prior, problem.system, state, surveyed, method.tolerance)

    state, trace = run_chunks(step, state, method.iterations, method.name, progress)
    return finish(problem, prior, state.point, state.alpha, state.found, bool(state.done), trace)


@dataclass(frozen=True)
class EA:
    """Evidence approximation (MacKay updates of Paper B 25, trajectories marginalised exactly): the default.

    `tolerance` is the change of log evidence, in nats, at which it stops; `iterations` caps the outer loop.
    """

    iterations: int = 200
    tolerance: float = 1e-3

    name: ClassVar[str] = "EA"
    priors: ClassVar[tuple[type, ...]] = (ARD,)
    intervals: ClassVar[str] = (
        "plug-in: the precisions (and unknown levels) are taken as known, so the intervals are too narrow"
    )
    maximise: ClassVar[Callable[..., Outcome]] = _maximise


@dataclass(frozen=True)
class MAP:
    """Joint mode of trajectories and biases under a given prior (`Flat` is maximum likelihood), Laplace covariance."""

    iterations: int = 100
    tolerance: float = 1e-6

    name: ClassVar[str] = "MAP"
    priors: ClassVar[tuple[type, ...]] = (Gaussian, Flat)
    intervals: ClassVar[str] = "Laplace: exact for the given prior where the problem is linear and Gaussian"
    maximise: ClassVar[Callable[..., Outcome]] = _maximise
