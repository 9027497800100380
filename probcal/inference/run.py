"""Methods that climb to a point, and the task of their climb that `inference.loop` runs.

A `Maximiser` has `iterate`, a pure step of its outer loop, and where needed `close`, what it computes at the end of a
chunk; a study climbs many at once.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from probcal.errors import InputError
from probcal.gaussian.choose import engine_of, estimates
from probcal.gaussian.dense import DenseEngine
from probcal.gaussian.engine import Engine, Factors
from probcal.gaussian.linearised import LaplaceApproximation, laplace
from probcal.gaussian.mode import Point
from probcal.gaussian.search import chosen
from probcal.gaussian.tails import Variances, renewed_noise
from probcal.inference.ending import FAR, conclude
from probcal.inference.engined import HostClimb
from probcal.inference.hierarchy import held, learnt_groups
from probcal.inference.integrate import Integration, integrate
from probcal.inference.loop import Pause, Trace
from probcal.inference.method import Context, Given, Iterated, MethodTask, State
from probcal.inference.placed import Reached, with_places
from probcal.linalg import library
from probcal.model.model import Model
from probcal.priors import ARD, PRECISION_BOUNDS, Flat, Gaussian, Prior
from probcal.priors import Laplace as LaplacePrior
from probcal.problem import Problem
from probcal.results.answer import Answer

CHUNK = 5  # outer iterations between two reports of progress
STALLED = 8  # climbs on the host after which one that gains nothing is given up


@dataclass(eq=False)
class KernelClimb(MethodTask):
    """The iterations of a method from a start: in jitted chunks, or one by one where these are long.

    Where precisions are not given, a bias that starts far from its stated value has that of its start: robust
    noise would rather reject a sensor than hold an exchanged place against the declared scale.
    """

    alpha: np.ndarray | None = None  # (M,) precisions to begin with, those of the prior if None

    whole: ClassVar[bool] = True  # whether a state holds matrices of all biases

    def __post_init__(self) -> None:
        self.model, self.given = self.problem.model, given_of(self.method, self.problem, self.prior)
        self.bare = bare(self.method.climbs_under(self.prior))  # without what reaches kernels as arrays

    @property
    def on_host(self) -> bool:
        """True where iterations are made one by one."""
        return bool(self.method.steps_on_host(self.model, self.bare))

    def init(self) -> State:
        """The state before the first iteration."""
        carry = self.method.begin(self.model, self.start)
        state = first_state(self.given, self.model, self.start, carry, self.context.key, self.whole)
        far, alpha = (np.abs(self.start.z) > FAR) & ~held(self.prior, self.problem), self.alpha
        if alpha is None and self.prior.hierarchical and far.any():
            alpha = np.where(far, np.maximum(np.abs(self.start.z), FAR) ** -2.0, self.given.prior.alpha)
        return state if alpha is None else state._replace(alpha=jnp.asarray(alpha))

    def step(self, state: State, count: int, pause: Pause) -> tuple[State, Trace]:
        """A chunk of iterations, or one."""
        fixed = self.model, self.bare, self.given
        if not self.on_host:
            left = self.iterations - count
            state, (course, idle) = chunk(kernel(self.method), *fixed, state, left)
            return state, jax.tree.map(lambda leaf: np.asarray(leaf)[~np.asarray(idle)], course)
        state = stepped(self.method, *fixed, state)
        state = self.method.close(self.model.with_mixing(state.mixing), self.bare, self.given, state)
        return state, single_course(state)

    def ended(self, state: State, trace: Trace) -> bool:
        """True where the method is done, or long iterations gain nothing any more."""
        worth = trace.objective
        if self.on_host and len(worth) > STALLED and not state.done:
            return not max(worth[-STALLED:]) > max(worth[:-STALLED]) + self.method.tolerance
        return bool(state.done)

    def outcome(self, state: State, course: Trace) -> Answer:
        """The Gaussian at the last state, or the mixture where precisions are integrated there.

        Where a method integrates trajectories, places that are far from Gaussian are integrated at the point that was
        reached, and it climbs again with what they add.
        """
        method, problem, prior, context = self.method, self.problem, self.prior, self.context
        state, course = method.further(self, state, course)
        if method.integrates_places and self.model.rests:
            problem, state, course = self._with_places(state, course)
        how, mixed = method.integration(problem, prior), None
        problem = problem.with_mixing(state.mixing)
        if how is not None:
            mixed = integrate(how, problem.model, problem.first_precision(prior), state.point, context.key, search=True)
        return conclude(problem, method, prior, state, course, how, mixed, context.monitor.stopped)

    def _with_places(self, state: State, trace: Trace) -> tuple[Problem, State, Trace]:
        """The problem with what integrated places add, the state there and the course of all climbs."""
        method, prior, engine, stopped = self.method, self.prior, DenseEngine(), self.context.monitor

        def reached(problem: Problem, state: State) -> Reached:
            problem = problem.with_mixing(state.mixing)
            factors = Factors.of(self.given.prior._replace(alpha=state.alpha))
            at, value = engine.at(problem.model, state.point), float(state.worth)
            if not (method.climbs_under(prior).learns or problem.model.learns_noise):
                value = at.density() + factors.value(state.point.z)
            return Reached(problem, at, factors, value, state)

        def climb(problem: Problem, start: Point) -> Reached:
            nonlocal trace
            state, more = method.climb(problem, prior, start, self.context)
            trace = trace.and_then(more)
            return reached(problem, state)

        end, agree = with_places(climb, reached(self.problem, state), engine, lambda: stopped.stopped)
        state = end.state
        if end.problem.tilted:
            found = laplace(end.at.model, state.point, self.given.prior._replace(alpha=state.alpha))
            state = state._replace(found=found)
        done = state.done if agree else jax.device_put(np.array(False))
        return end.problem, state._replace(done=done), trace


class Maximiser(Iterated, ABC):
    """A method that climbs to a point by a pure `iterate` and reports a Gaussian there."""

    trajectory: str = "joint"  # mode of biases and trajectories, or "marginal": of the biases

    def task(self, problem: Problem, prior: Prior, start: Point, context: Context) -> MethodTask:
        """A climb by kernels; of what is too large for the dense engine from the host, on another."""
        check_method(self)
        own = self, problem, prior, start, context
        engine = self.expands_by(problem.model)
        return KernelClimb(*own) if engine is None else HostClimb.of(*own, engine)

    def expands_by(self, model: Model, *, fast: bool = False) -> Engine | None:
        """The engine that a climb from the host asks; None where kernels of the dense one climb.

        Raises `InputError` for an engine that does not take the model.
        """
        engine = engine_of(self.engine, model, fast=fast)
        return None if engine.cheap and engine is not self.engine else engine

    def lacking(self, prior: Prior, starts: int) -> str:
        """The option that such a climb takes instead of the requested one; empty where it takes
        it."""
        if estimates(self.engine) and not isinstance(prior, (Gaussian, Flat)):
            return "precisions that are given (MAP() with Gaussian() or Flat())"
        if not isinstance(self.climbs_under(prior), (Gaussian, Flat)):
            return (
                "precisions that are integrated or given (EA() with Horseshoe() or ARD(rate=0.5),"
                " MAP() with Gaussian())"
            )
        return "one start" if starts > 1 else ""

    def climbs_once(self, problem: Problem, prior: Prior) -> bool:
        """True if an answer is what one climb finds (and an integration there), so that many are one kernel."""
        dense = self.expands_by(problem.model) is None
        return dense and not (self.integrates_places and problem.model.rests)

    @property
    def integrates_places(self) -> bool:
        """True if trajectories are integrated, so that places that are far from Gaussian matter."""
        return self.trajectory == "marginal"

    def climb(
        self, problem: Problem, prior: Prior, start: Point, context: Context, alpha: np.ndarray | None = None
    ) -> tuple[State, Trace]:
        """The last state of the outer loop and its course, from precisions `alpha` (M,) where these are given."""
        task = KernelClimb(self, problem, prior, start, context, alpha)
        return self.further(task, *context.run(task))

    def further(self, task: KernelClimb, state: State, course: Trace) -> tuple[State, Trace]:
        """State and course after what a method does where a climb has ended: nothing, unless said otherwise."""
        return state, course

    def climbs_under(self, prior: Prior) -> Prior:
        """The prior of the climb: where precisions are integrated after it, not that of the fit."""
        return prior

    def integration(self, problem: Problem, prior: Prior) -> Integration | None:
        """The integration of the precisions after the climb, None where they are not integrated."""
        return None

    @abstractmethod
    def iterate(self, model: Model, prior: Prior, given: Given, state: State) -> State:
        """One outer iteration."""

    def steps_on_host(self, model: Model, prior: Prior) -> bool:
        """True if iterations are long and few: those of a climb to the marginal mode alone.

        Kernels shared with the rest of a fit then beat one of their own.
        """
        return self.trajectory == "marginal" and not (prior.learns or model.tailed)

    def begin(self, model: Model, start: Point) -> Any:
        """The state carried into the first iteration, empty by default."""
        return ()

    def close(self, model: Model, prior: Prior, given: Given, state: State) -> State:
        """The state after the computations that are made once per chunk."""
        return state


def kernel(method: Any) -> Any:
    """The method without what does not change its kernels, so that these are compiled once."""
    return replace(method, iterations=0, tolerance=0.0)


def bare(prior: Prior) -> Prior:
    """The prior without what reaches kernels as arrays (correlations, kinds, groups): these are compiled once."""
    alone = {"correlation": (), "kinds": ()} | ({"by": None} if isinstance(prior, ARD) else {})
    return replace(prior, **alone)


def check_method(method: Maximiser) -> None:
    """Raise `InputError` where a method would run no iteration or never know when to stop."""
    if method.iterations < 1:
        raise InputError(f"{method.name}(iterations={method.iterations}): at least one iteration is needed")
    if not (np.isfinite(method.tolerance) and method.tolerance >= 0):
        raise InputError(f"{method.name}(tolerance={method.tolerance}): give a finite number that is not negative")


def given_of(method: Maximiser, problem: Problem, prior: Prior) -> Given:
    """Arrays of a prior and of the stopping rule for a problem."""
    prior = method.climbs_under(prior)
    numbers: Any = held(prior, problem), learnt_groups(prior, problem), np.array(float(method.tolerance))
    return Given(problem.first_precision(prior), *numbers)


def first_state(given: Given, model: Model, start: Point, carry: Any, seed: jax.Array, whole: bool = True) -> State:
    """State before the first iteration."""
    alpha, low = given.prior.alpha, np.array(-np.inf)
    M = alpha.shape[0] if whole else 0
    nothing = LaplaceApproximation(*jax.device_put((np.zeros((M, M)), np.zeros((M, M)), np.zeros(M), low)))
    worst, refused, done = jax.device_put((low, np.array(True), np.array(False)))
    return State(start, alpha, nothing, worst, worst, worst, refused, done, seed, carry, model.mixing)


def valued(prior: Prior, given: Given, state: State) -> State:
    """The state with what the climb maximises, and the best of it so far."""
    worth = state.found.evidence + prior.log_hyper(state.alpha, given.group)
    return state._replace(worth=worth, best=jnp.fmax(state.best, worth))


def renew_noise(model: Model, state: State, covariance: jax.Array, fresh: Any = False) -> tuple[Model, State]:
    """Model and state with the noise that follows from the point, for a covariance of z.

    Where all noise is Gaussian and known, and where the state is `fresh`, they stay.
    """
    if not model.learns_noise:
        return model, state
    after, point = renewed_noise(model, state.point, Variances.dense(DenseEngine().at(model, state.point), covariance))
    point, mixing = chosen(fresh, (state.point, state.mixing), (point, after.mixing))
    return model.with_mixing(mixing), state._replace(point=point, mixing=mixing)


def learn(prior: Prior, given: Given, alpha: jax.Array, gamma: Any, variance: Any, z: jax.Array, rule: str) -> Any:
    """Precisions after one update of the prior, within their bounds; surveyed biases keep theirs."""
    if not isinstance(prior, ARD | LaplacePrior):
        return alpha
    learnt = jnp.clip(prior.learn(gamma, variance, z, given.group, rule), *PRECISION_BOUNDS)
    return jnp.where(given.surveyed, alpha, learnt)


@partial(jax.jit, static_argnames=("method", "prior"))
def chunk(
    method: Any, model: Model, prior: Prior, given: Given, state: State, left: int
) -> tuple[State, tuple[Trace, jax.Array]]:
    """A few outer iterations, at most `left`; stops when done. Returns their course and which steps were idle."""

    def body(state: State, k: jax.Array) -> tuple[State, tuple[Trace, jax.Array]]:
        idle = state.done | (k >= left)
        after = jax.lax.cond(idle, lambda s: s, lambda s: stepped(method, model, prior, given, s), state)
        return after, (course_of(after), idle)

    state, trace = jax.lax.scan(body, state, jnp.arange(CHUNK))
    return method.close(model.with_mixing(state.mixing), prior, given, state), trace


def single_course(state: State) -> Trace:
    """The course of one iteration, by its state."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[None], course_of(state))


def course_of(state: State) -> Trace:
    """The course of a climb as far as one state tells it."""
    return Trace(state.objective, state.point.z, state.alpha)


def stepped(method: Any, model: Model, prior: Prior, given: Given, state: State) -> State:
    """One outer iteration at the precisions of the process noise that a state has; two without an objective end it."""
    after = method.iterate(model.with_mixing(state.mixing), prior, given, state)
    lib = library(after.objective)
    return after._replace(done=lib.logical_or(after.done, lib.isnan(after.objective) & lib.isnan(state.objective)))
