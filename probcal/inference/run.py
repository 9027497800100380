"""What methods share, and the outer loop of those that climb to a point: jitted chunks, progress, the verdict.

A method is a frozen dataclass that inherits `Maximiser` or `sampler.Sampler`. A `Maximiser` has `iterate`, a pure step
of its outer loop, and where needed `close`, what it computes at the end of a chunk; `maximise` drives one fit and
`inference.study` many at once.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal.errors import InputError
from probcal.model.model import Model
from probcal.priors import ARD, PRECISION_BOUNDS, Flat, Precision, Prior
from probcal.priors import Laplace as LaplacePrior
from probcal.problem import Problem
from probcal.smoothing.directions import Direction, weak_directions
from probcal.smoothing.information import Laplace, mean_square, squares_of
from probcal.smoothing.mode import Point
from probcal.status import Status

CHUNK = 5  # outer iterations between two reports of progress
FAR = 10.0  # scales from the stated value beyond which a bias without prior has diverged
FALL = 1.0  # nats below its best at which an evidence may end
ABSURD = 100.0  # mean square a datum, 1 expected, beyond which a fit explains nothing
Progress = Callable[[str, int, float], None]  # method, iterations done, current objective


class Given(NamedTuple):
    """What stays the same during the outer loop."""

    prior: Precision  # first precisions, and the couplings of correlated biases
    surveyed: jax.Array  # (M,) biases whose precision is never learnt
    group: jax.Array  # (M,) which learnt precision governs each bias
    tolerance: jax.Array  # ()


class State(NamedTuple):
    """Where the outer loop stands: `found` belongs to `point` and `alpha`; an objective of -inf: nothing found yet."""

    point: Point
    alpha: jax.Array  # (M,)
    found: Laplace
    objective: jax.Array  # ()
    best: jax.Array  # () the best evidence so far
    refused: jax.Array  # () whether no step of any search has lowered the cost yet, though one promised to
    done: jax.Array  # ()


class Method:
    """What every method inherits: a frozen dataclass of static fields."""

    name: ClassVar[str]
    priors: ClassVar[tuple[type, ...]]  # the first is its own
    intervals: ClassVar[str]  # what the intervals are worth

    @classmethod
    def takes(cls, prior: Prior) -> bool:
        """Whether the method can be used with a prior."""
        return isinstance(prior, cls.priors)

    def note(self) -> str:
        """What the intervals are worth with these settings."""
        return self.intervals

    def prepare(self, problem: Problem) -> Problem:
        """The problem that is solved in the place of the given one."""
        return problem


class Maximiser(Method, ABC):
    """A method that climbs to a point by a pure `iterate` and reports a Gaussian there."""

    iterations: int  # most outer iterations
    tolerance: float  # change of the objective at which it stops

    @abstractmethod
    def iterate(self, model: Model, prior: Prior, given: Given, state: State) -> State:
        """One outer iteration."""

    def close(self, model: Model, given: Given, state: State) -> State:
        """What is computed once a chunk."""
        return state


class Outcome(NamedTuple):
    """Where a method ended: the point, its precisions and Gaussian approximation, and the verdict in words."""

    point: Point
    alpha: np.ndarray  # (M,)
    laplace: Laplace
    trace: np.ndarray  # objective of every outer iteration
    status: Status  # converged, not converged, at bound, misfit, diverged
    message: str  # one sentence on the status and what to do; empty where nothing is to be said
    bias_status: tuple[str, ...]
    weak: tuple[Direction, ...]


def kernel(method: Any) -> Any:
    """The method without what does not change its kernels, so that these are compiled once."""
    return replace(method, iterations=0, tolerance=0.0)


def bare(prior: Prior) -> Prior:
    """The prior without what reaches kernels as arrays (correlations, groups), so that these are compiled once."""
    return replace(prior, correlation=(), by=None) if isinstance(prior, ARD) else replace(prior, correlation=())


def check_method(method: Maximiser) -> None:
    """Raise `InputError` where a method would run no iteration or never know when to stop."""
    if method.iterations < 1:
        raise InputError(f"{method.name}(iterations={method.iterations}): at least one iteration is needed")
    if not (np.isfinite(method.tolerance) and method.tolerance >= 0):
        raise InputError(f"{method.name}(tolerance={method.tolerance}): give a finite number that is not negative")


def given_of(method: Maximiser, problem: Problem, prior: Prior) -> Given:
    """Arrays of a prior and of the stopping rule for a problem."""
    group = prior.groups(problem.members)
    group = np.where(problem.surveyed, len(group) + np.arange(len(group)), group)  # surveyed biases share none
    group = np.unique(group, return_inverse=True)[1]
    first = prior.precision(problem.labels, problem.surveyed)
    return Given(first, *jax.device_put((problem.surveyed, group, np.array(float(method.tolerance)))))


def first_state(given: Given, start: Point) -> State:
    """State before the first iteration."""
    alpha, low = given.prior.alpha, np.array(-np.inf)
    M = alpha.shape[0]
    nothing = Laplace(*jax.device_put((np.zeros((M, M)), np.zeros((M, M)), np.zeros(M), low)))
    return State(start, alpha, nothing, *jax.device_put((low, low, np.array(True), np.array(False))))


def learn(prior: Prior, given: Given, alpha: jax.Array, gamma: Any, variance: Any, z: jax.Array, rule: str) -> Any:
    """Precisions after one update of the prior, within their bounds; surveyed biases keep theirs."""
    if not isinstance(prior, ARD | LaplacePrior):
        return alpha
    learnt = jnp.clip(prior.learn(gamma, variance, z, given.group, rule), *PRECISION_BOUNDS)
    return jnp.where(given.surveyed, alpha, learnt)


@partial(jax.jit, static_argnames=("method", "prior"))
def chunk(
    method: Any, model: Model, prior: Prior, given: Given, state: State, left: int
) -> tuple[State, tuple[jax.Array, jax.Array]]:
    """A few outer iterations, at most `left`; stops when done. Returns objectives and which steps were idle."""

    def body(state: State, k: jax.Array) -> tuple[State, tuple[jax.Array, jax.Array]]:
        idle = state.done | (k >= left)
        after = jax.lax.cond(idle, lambda s: s, lambda s: method.iterate(model, prior, given, s), state)
        return after, (after.objective, idle)

    state, trace = jax.lax.scan(body, state, jnp.arange(CHUNK))
    return method.close(model, given, state), trace


def maximise(method: Maximiser, problem: Problem, prior: Prior, start: Point, progress: Progress | None) -> Outcome:
    """Run a method from a start until it is done or its iterations are spent."""
    check_method(method)
    given = given_of(method, problem, prior)
    state, trace = first_state(given, start), np.zeros(0)
    while len(trace) < method.iterations and not bool(state.done):
        left = method.iterations - len(trace)
        state, (objective, idle) = chunk(kernel(method), problem.model, bare(prior), given, state, left)
        trace = np.concatenate([trace, np.asarray(objective)[~np.asarray(idle)]])
        if progress is not None:
            progress(method.name, len(trace), float(trace[-1]))
    outcome = finish(problem, prior, state, method.tolerance == 0.0, trace)
    if outcome.status is not Status.SPENT or len(trace) < 2:
        return outcome
    note = (
        f"All {len(trace)} iterations were run, as asked; the last moved the objective by {trace[-1] - trace[-2]:.2g}."
    )
    return outcome._replace(message=f"{note} {outcome.message}".strip())


def finish(problem: Problem, prior: Prior, state: State, asked: bool, trace: np.ndarray) -> Outcome:
    """Say in words what the point and the Laplace approximation are worth where a method ended.

    `asked` is whether it was to run so many iterations, whatever they reach.
    """
    point, found = state.point, state.found
    alpha, z = np.asarray(state.alpha), np.asarray(point.z)
    information = np.asarray(found.information)
    weak = weak_directions(problem, information, point) if np.isfinite(information).all() else ()
    low, far = low_and_far(prior, alpha, z, problem.surveyed)
    end = End(
        bool(state.done),
        asked,
        bool(low.any()),
        bool(far.any()),
        all(np.isfinite(np.asarray(part)).all() for part in (found.covariance, found.evidence, point.z)),
        bool(state.refused),
        fallen(prior, len(problem.levels), state.best, found.evidence),
        float(mean_square(problem.model, point)),
    )
    status = verdict(end)
    bias_status = tuple(
        "survey"
        if s
        else "at bound"
        if b
        else "diverged"
        if f
        else "pruned"
        if g < 1e-2 and prior.learns
        else "estimated"
        for s, b, f, g in zip(problem.surveyed, low, far, np.asarray(found.gamma), strict=True)
    )
    message = _message(problem, point, status, end, low, far, weak, len(trace))
    return Outcome(point, alpha, found, trace, status, message, bias_status, weak)


def low_and_far(prior: Prior, alpha: np.ndarray, z: np.ndarray, surveyed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which biases (..., M) stand at the lower bound of their precision, and which ran away without a prior."""
    none = np.zeros(z.shape, bool)
    low = (alpha <= PRECISION_BOUNDS[0] * (1 + 1e-9)) & ~surveyed if isinstance(prior, ARD) else none
    far = (np.abs(z) > FAR) & ~surveyed if isinstance(prior, Flat) else none
    return low, far


def fallen(prior: Prior, levels: int, best: Any, evidence: Any) -> float:
    """Nats by which the last evidence lies below the best, where a method maximises it: precisions or levels learnt."""
    return max(float(best) - float(evidence), 0.0) if prior.proper and (prior.learns or levels) else 0.0


class End(NamedTuple):
    """What the status of a fit follows from."""

    still: bool  # the method says that it is done
    asked: bool  # it was to run so many iterations, and did
    low: bool  # a precision stands at its lower bound
    far: bool  # a bias without prior ran away
    sound: bool  # everything is finite
    refused: bool  # the search never left its start, though a step promised to
    fallen: float  # nats that the evidence lost
    square: float  # mean square a datum of what is left


def verdict(end: End) -> Status:
    """Status of a fit."""
    if not end.square <= ABSURD:
        return Status.MISFIT
    if end.far or not end.sound or end.refused:
        return Status.DIVERGED
    if end.low:
        return Status.AT_BOUND
    if end.fallen > FALL:
        return Status.NOT_CONVERGED
    return Status.CONVERGED if end.still else Status.SPENT if end.asked else Status.NOT_CONVERGED


def misfit_sentence(problem: Problem, point: Point, square: float) -> str:
    """What to check where a fit explains nothing, and the datum that is worst explained."""
    squares = [np.asarray(part) for part in squares_of(problem.model, point)]
    block = int(np.argmax([np.nan_to_num(part, nan=np.inf).max() for part in squares]))
    n, c = np.unravel_index(np.argmax(np.nan_to_num(squares[block], nan=np.inf)), squares[block].shape)
    row, data = problem.row_index[block][n], problem.measurements
    sensor = problem.network.sensors[data.sensor[row]].name
    channel = problem.columns[block][c]
    return (
        f"The fit explains nothing: mean square a datum {square:.2g} where 1 is expected, worst {sensor}.{channel} at"
        f" {data.time[row]:.6g} s. Check units, the time column, sentinels such as -9999 and the noise std."
    )


def _message(
    problem: Problem,
    point: Point,
    status: Status,
    end: End,
    low: np.ndarray,
    far: np.ndarray,
    weak: tuple[Direction, ...],
    iterations: int,
) -> str:
    def listed(mask: np.ndarray) -> str:
        labels = [label for label, hit in zip(problem.labels, mask, strict=True) if hit]
        return ", ".join(labels[:12]) + (f" and {len(labels) - 12} more" if len(labels) > 12 else "")

    advice = f" The data do not fix: {'; '.join(d.sentence for d in weak[:4])}." if weak else ""
    if status is Status.AT_BOUND:
        return f"The precision of {listed(low)} stands at its lower bound: the estimate is invalid.{advice}"
    if status is Status.MISFIT:
        return misfit_sentence(problem, point, end.square)
    if status is Status.DIVERGED and end.sound and end.refused and not end.far:
        return (
            "The fit diverged: it never left its start, since no step fitted better; the estimate is invalid. Check"
            " units, the time column, sentinels such as -9999 and the noise std, or give a start."
        )
    if status is Status.DIVERGED:
        where = (
            f"{listed(far)} lie more than {FAR:g} scales from the stated value"
            if far.any()
            else "the information matrix is singular"
        )
        return f"The fit diverged: {where}; the estimate is invalid. Use a prior, or fix some biases.{advice}"
    if status is Status.NOT_CONVERGED and end.fallen > FALL:
        return (
            f"The evidence fell by {end.fallen:.3g} nats below its best on the way: the fit ran to a place that the"
            f" data as a whole do not favour. Survey or fix more, state narrower scales, or take a sampler.{advice}"
        )
    if status is Status.NOT_CONVERGED:
        return (
            f"The fit did not converge in {iterations} iterations: allow more, or fix what the data leave open.{advice}"
        )
    return f"Weakly determined by the data: {'; '.join(d.sentence for d in weak[:4])}." if weak else ""
