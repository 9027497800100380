"""Expectation maximisation: EM (ML and MAP) and the double loop EM-EA of Paper C."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from probcal import linalg
from probcal.inference.run import CHUNK, Outcome, Progress, finish, first_precisions, run_chunks
from probcal.priors import ARD, PRECISION_BOUNDS, Flat, Gaussian, Prior
from probcal.problem import Problem, Spec, System
from probcal.smoothing.information import laplace, update_levels
from probcal.smoothing.mode import Point, cost, find_mode, linearise, of_biases

HALVINGS = 8


class _State(NamedTuple):
    point: Point
    alpha: jax.Array
    cost: jax.Array
    done: jax.Array


def _maximisation(spec: Spec, system: System, point: Point, alpha: jax.Array) -> tuple[Point, jax.Array]:
    """M step: biases at the smoothed trajectory (Paper A 21, Paper C 35), shortened while the joint density falls.

    Returns the point and the variances of z at a fixed trajectory (diagonal of Paper C 36).
    """
    information, score = of_biases(spec, system, linearise(spec, system, point, expected=False))
    matrix = information + jnp.diag(alpha + 1e-12)
    step = linalg.solve_positive(matrix, score - alpha * point.z)
    step = jnp.where(jnp.isfinite(step), step, 0.0)
    before = cost(spec, system, point, alpha)

    def worse(state):
        t, tries = state
        return ~(cost(spec, system, point._replace(z=point.z + t * step), alpha) <= before) & (tries < HALVINGS)

    t, tries = jax.lax.while_loop(worse, lambda s: (0.5 * s[0], s[1] + 1), (jnp.ones(()), 0))
    z = point.z + jnp.where(tries < HALVINGS, t, 0.0) * step
    return point._replace(z=z), linalg.inverse_diagonal(matrix)


@partial(jax.jit, static_argnames=("spec", "prior", "inner"))
def _chunk(
    spec: Spec, prior: Prior, system: System, state: _State, surveyed: jax.Array, tolerance: float, inner: int
) -> tuple[_State, tuple[jax.Array, jax.Array]]:
    """A few outer iterations of `inner` E and M steps each, with the update of the precisions (Paper C 40)."""

    def iterate(state: _State) -> _State:
        point, variance = state.point, jnp.zeros_like(state.alpha)
        for _ in range(inner):
            # E step: one damped pass of the extended smoother, linearised at the last trajectory (Paper C, 2c)
            point = find_mode(spec, system, point, state.alpha, 1, 0.0, joint=False).point
            point, variance = _maximisation(spec, system, point, state.alpha)
        alpha = state.alpha
        if isinstance(prior, ARD):
            learnt = jnp.clip(prior.expectation(variance, point.z), *PRECISION_BOUNDS)
            alpha = jnp.where(surveyed, alpha, learnt)
        if point.levels.shape[0]:
            point = update_levels(spec, system, point, jnp.diag(variance))
        value = cost(spec, system, point, alpha) - 0.5 * jnp.sum(jnp.log(jnp.where(alpha > 0, alpha, 1.0)))
        return _State(point, alpha, value, jnp.abs(value - state.cost) < tolerance)

    def body(state: _State, _: None) -> tuple[_State, tuple[jax.Array, jax.Array]]:
        after = jax.lax.cond(state.done, lambda s: s, iterate, state)
        return after, (-after.cost, state.done)

    return jax.lax.scan(body, state, length=CHUNK)


def _maximise(method: "EM | EMEA", problem: Problem, prior: Prior, start: Point, progress: Progress | None) -> Outcome:
    alpha = first_precisions(problem, prior)
    state = _State(start, alpha, jnp.full((), jnp.inf, float), jnp.zeros((), bool))
    surveyed = jnp.asarray(problem.surveyed)

    def step(state: _State) -> tuple[_State, tuple[jax.Array, jax.Array]]:
        return _chunk(problem.spec, prior, problem.system, state, surveyed, method.tolerance, method.inner)

    state, trace = run_chunks(step, state, method.iterations, method.name, progress)
    found = laplace(problem.spec, problem.system, state.point, state.alpha)
    return finish(problem, prior, state.point, state.alpha, found, bool(state.done) or method.tolerance == 0.0, trace)


@dataclass(frozen=True)
class EM:
    """Expectation maximisation of the biases: ML with `Flat`, MAP with `Gaussian` (Paper A 15-21, Paper C 27-36).

    It stops when the joint log density changes by less than `tolerance`; 0 runs all `iterations` and counts
    as converged, as the papers do.
    """

    iterations: int = 500
    tolerance: float = 1e-5
    inner: int = 1

    name: ClassVar[str] = "EM"
    priors: ClassVar[tuple[type, ...]] = (Gaussian, Flat)
    intervals: ClassVar[str] = "Laplace: exact for the given prior where the problem is linear and Gaussian"
    maximise: ClassVar[Callable[..., Outcome]] = _maximise


@dataclass(frozen=True)
class EMEA:
    """The double loop of Paper C (Algorithm 1): `inner` EM steps, then precisions by update (40).

    By default 50 outer iterations are run as in the paper (`tolerance` 0); the reported covariance is
    marginalised over the trajectories, unlike the paper's (36), whose intervals are narrower still.
    """

    iterations: int = 50
    tolerance: float = 0.0
    inner: int = 1

    name: ClassVar[str] = "EM-EA"
    priors: ClassVar[tuple[type, ...]] = (ARD,)
    intervals: ClassVar[str] = "plug-in: the precisions are taken as known, so the intervals are too narrow"
    maximise: ClassVar[Callable[..., Outcome]] = _maximise
