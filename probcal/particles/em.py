"""Expectation maximisation whose E-step is a particle smoother (Paper A, Algorithms 1-4): the loop behind `EM`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal import linalg
from probcal.gaussian.mode import Point
from probcal.gaussian.search import halved
from probcal.inference.em import EM, RIDGE
from probcal.inference.loop import Pause, Trace
from probcal.inference.method import Context, Given, MethodTask
from probcal.inference.run import CHUNK, bare, check_method, given_of, learn
from probcal.model.model import At, Model
from probcal.particles.ensemble import (
    Ensemble,
    Expectation,
    at_states,
    conditional_ensemble,
    ensemble,
    first_paths,
    log_likelihood_over,
    moved_levels,
    nearest_states,
    over_paths,
)
from probcal.particles.settings import ParticleSettings
from probcal.particles.targets import Targets, weigh_rows
from probcal.particles.weighted import Ended, check_learnt, conclude_particles, prepared
from probcal.priors import Gaussian, Precision, Prior
from probcal.problem import Problem
from probcal.results.answer import Answer

SETTLING = 10  # iterations of stochastic approximation before it averages
POWER = 0.7  # by which the weights of later passes fall
COOL = 0.02  # by which the log-likelihood counts at first, where it is tempered
WINDOW = 20  # iterations that are compared with as many before them
DRIFT = 4.0  # standard errors by which these may differ, beside
NEAR = 0.25  # so many sd of a bias
CROWD = 500  # least particles of the pass that a conditional filter begins with


class Climb(NamedTuple):
    """The state of the loop."""

    z: jax.Array  # (M,)
    levels: jax.Array  # (H,)
    alpha: jax.Array  # (M,)
    information: jax.Array  # (M, M) averaged, of the biases at given states
    pull: jax.Array  # (M,) averaged, of its linear term about zero
    k: jax.Array  # () passes done
    key: jax.Array
    paths: tuple[Any, ...]  # that the next conditional filter of each recursion holds; none where it is not one
    variance: jax.Array  # (M,) of each bias at given states
    log_likelihood: jax.Array  # () before the last step, trajectories integrated, or given where averaged


@partial(jax.jit, static_argnames=("prior", "how"))
def em_chunk(
    model: Model, targets: tuple[Targets, ...], prior: Prior, given: Given, state: Climb, last: jax.Array,
    how: ParticleSettings,
) -> tuple[Climb, Trace]:  # fmt: skip
    """A few iterations, none after the `last`."""

    def one(state: Climb, _: None) -> tuple[Climb, Trace]:
        going = state.k < last
        state = jax.lax.cond(going, lambda: iterate(model, targets, prior, given, state, how), lambda: state)
        return state, Trace(state.log_likelihood, state.z, state.alpha)

    return jax.lax.scan(one, state, None, length=CHUNK)


def iterate(
    model: Model, targets: tuple[Targets, ...], prior: Prior, given: Given, state: Climb, how: ParticleSettings
) -> Climb:
    """One E-step and one M-step, with the prior of the biases (Paper A 20-21), then precisions and levels."""
    keys, now = jax.random.split(state.key), given.prior._replace(alpha=state.alpha)
    share = COOL ** jnp.maximum(1.0 - state.k / max(how.tempered, 1), 0.0) if how.tempered else jnp.ones(())
    model = model.weighted([jnp.full_like(there, share) for there in model.measured])
    targets = tuple(weigh_rows(own, share) for own in targets)
    if how.m_step == "averaged":
        found, paths = conditional_ensemble(model, targets, state.paths, state.z, state.levels, keys[0], how)
        state = state._replace(paths=paths)
        told = log_likelihood_over(model, found, state.z, state.levels)
    else:
        found = ensemble(model, targets, state.z, state.levels, keys[0], how)
        told = found.log_evidence
    states = nearest_states(model, found) if how.m_step == "mean" else None
    expected = over_paths(model, found, state.z, state.levels) if states is None else at_states(
        model, states, state.z, state.levels
    )  # fmt: skip
    state = _averaged(state, expected, how)
    matrix = state.information + now.matrix() + RIDGE * jnp.eye(model.biases)
    step = linalg.solve_positive(matrix, state.pull - matrix @ state.z + RIDGE * state.z)
    step = jnp.where(jnp.all(jnp.isfinite(step)), step, jnp.zeros_like(step))
    if how.m_step != "averaged":
        step = _shortened(model, found, states, state, now, step)
    z = state.z + step
    variance = jnp.diagonal(linalg.inverse_and_logdet(matrix)[0])
    alpha = learn(prior, given, state.alpha, jnp.zeros_like(z), variance, z, "em")
    levels = state.levels
    if model.level_spread.shape[0]:
        levels = moved_levels(model, targets, found, z, levels)
    done = {"k": state.k + 1, "variance": variance, "log_likelihood": told}
    return state._replace(z=z, levels=levels, alpha=alpha, key=keys[1], **done)


def _averaged(state: Climb, expected: Expectation, how: ParticleSettings) -> Climb:
    """The state with what this pass says of the biases, averaged with earlier ones if that is asked for."""
    share = jnp.ones(())
    if how.m_step == "averaged":
        passed = state.k - how.tempered - SETTLING
        share = jnp.where(passed < 0, 1.0, (1.0 + jnp.maximum(passed, 0)) ** -POWER)
    pull = expected.score + expected.information @ state.z
    information = state.information + share * (expected.information - state.information)
    return state._replace(information=information, pull=state.pull + share * (pull - state.pull))


def _shortened(model: Model, found: Ensemble, states: Any, state: Climb, now: Precision, step: jax.Array) -> jax.Array:
    """The longest of the halved steps that does not lower the expectation."""

    def lost(share: Any) -> tuple[jax.Array, Any]:
        z = state.z + share * step
        if states is None:
            told = log_likelihood_over(model, found, z, state.levels)
        else:
            told = sum((jnp.sum(part) for part in model.log_likelihood(At(states, z, state.levels))), jnp.zeros(()))
        return 0.5 * now.square(z) - told, z

    share, *_ = halved(lost, lost(0.0)[0])
    return share * step


@dataclass(frozen=True)
class Wandering:
    """The comparison of the last iterations with as many before them."""

    still: bool
    worst: int  # the bias that moved most
    moved: float  # by so many of its sd


def wandering(trace: np.ndarray, sd: np.ndarray) -> Wandering:
    """True if the biases of the last iterations (I, M) scatter about a place, False if they still move."""
    size = min(WINDOW, len(trace) // 2)
    if size < 5:
        return Wandering(False, 0, np.inf)
    late, before = trace[-size:], trace[-2 * size : -size]
    away = np.abs(late.mean(0) - before.mean(0))
    error = np.sqrt(_variance_of_mean(late) + _variance_of_mean(before))
    over = (away - DRIFT * error) / np.maximum(sd, 1e-12)
    worst = int(np.argmax(over))
    return Wandering(bool((over < NEAR).all()), worst, float(away[worst] / max(sd[worst], 1e-12)))


def _variance_of_mean(trace: np.ndarray) -> np.ndarray:
    """Variance (M,) of the mean of a stretch of the trace about its own line, neighbours correlated to first order."""
    k = np.arange(len(trace)) - 0.5 * (len(trace) - 1)
    around = trace - trace.mean(0) - k[:, None] * (k @ trace / (k @ k))
    r = np.clip((around[1:] * around[:-1]).mean(0) / np.maximum(around.var(0), 1e-300), 0.0, 0.9)
    return np.asarray(around.var(0) * (1 + r) / (1 - r) / len(trace))


@dataclass(eq=False)
class ParticleClimb(MethodTask):
    """The iterations of EM by particles, from the biases of a start; it ends where these only scatter about a place."""

    how: ParticleSettings
    key: jax.Array | None = None  # of the iterations; one of the context's if None

    def __post_init__(self) -> None:
        check_method(self.method)
        check_learnt(self.problem)
        self.targets = prepared(self.problem, self.how)
        if self.problem.model.driven and self.how.smoother == "marginal":
            self.how = replace(self.how, smoother="exact")  # levels of process noise are learnt along paths
        if np.any(np.asarray(self.start.z)):  # a start that is known is not left again
            self.how = replace(self.how, tempered=0)
        self.given, self.bare = given_of(self.method, self.problem, self.prior), bare(self.prior)

    def init(self) -> Climb:
        """The state before the first iteration."""
        for own in self.targets if self.how.m_step == "averaged" else ():
            own.model.check_density()
        alpha, z = self.given.prior.alpha, np.asarray(self.start.z, float)
        key = jax.random.split(self.context.key)[0] if self.key is None else self.key
        return _beginning(self.problem.model, self.targets, alpha, z, key, self.how)

    def step(self, state: Climb, count: int, pause: Pause) -> tuple[Climb, Trace]:
        """A chunk of iterations."""
        last, left = jnp.asarray(self.iterations), self.iterations - count
        state, trace = em_chunk(self.problem.model, self.targets, self.bare, self.given, state, last, self.how)
        return state, jax.tree.map(lambda leaf: np.asarray(leaf)[:left], trace)

    def ended(self, state: Climb, trace: Trace) -> bool:
        """True where the biases only scatter."""
        settles = self.method.tolerance > 0 and trace.iterations >= 2 * WINDOW
        return settles and self.wandering(state, trace).still

    def wandering(self, state: Climb, trace: Trace) -> Wandering:
        """The comparison of the last iterations with as many before them."""
        return wandering(trace.z, np.sqrt(state.variance))

    def outcome(self, state: Climb, course: Trace) -> Answer:
        """A Gaussian about the biases, its information by scores."""
        still = self.wandering(state, course)
        over = course.iterations >= self.iterations or self.ended(state, course)
        stopped = "" if over else self.context.monitor.stopped
        if still.still and self.how.m_step != "averaged":  # what is left is the noise of the particles
            state = state._replace(z=jnp.asarray(course.z[-min(WINDOW, len(course.z) // 2) :].mean(0)))
        ended = Ended(state.z, state.levels, state.alpha, course, still.still, _moved(self.problem, still), stopped)
        own, key = (self.problem, self.method, self.how, self.prior), jax.random.split(self.context.key)[1]
        return conclude_particles(*own, self.given, self.targets, ended, key)


def searched(problem: Problem, how: Any, start: Point, iterations: int, key: jax.Array) -> Climb:
    """The state after some iterations from the biases of a start, of unit scales: a start for a sampler."""
    context = Context(key)
    task = ParticleClimb(EM(how, iterations, 0.0), problem, Gaussian(), start, context, how, key)
    state: Climb = context.run(task)[0]
    return state


@partial(jax.jit, static_argnames="how")
def _beginning(
    model: Model, targets: tuple[Targets, ...], alpha: jax.Array, z: Any, key: jax.Array, how: ParticleSettings
) -> Climb:
    M, keys, paths = model.biases, jax.random.split(key), tuple[Any, ...]()
    levels = jnp.zeros(model.level_spread.shape)
    if how.m_step == "averaged":
        crowd = replace(how, count=max(how.count, CROWD))
        cool = tuple(weigh_rows(own, jnp.asarray(COOL if how.tempered else 1.0)) for own in targets)
        paths = first_paths(targets, ensemble(model, cool, z, levels, keys[1], crowd))
    nothing, none = jnp.zeros((M, M)), jnp.zeros(M)
    return Climb(z, levels, alpha, nothing, none, jnp.zeros((), int), keys[0], paths, none, jnp.zeros(()))


def _moved(problem: Problem, still: Wandering) -> str:
    """Describes the bias that has not converged, in words."""
    if not np.isfinite(still.moved):
        return "too few iterations to tell whether they settled"
    return f"{problem.labels[still.worst]} still moves by {still.moved:.2g} sd in {WINDOW} iterations"
