"""A climb from the host to the marginal or joint mode, on any engine, and the answer there.

`EA()` and `MAP()` come here where kernels of the dense engine do not climb (`gaussian.choose`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple, cast

import numpy as np

from probcal.errors import FitError
from probcal.gaussian.climb import climb_to_mode
from probcal.gaussian.engine import Engine, Estimate, Expansion, Factors, evidence
from probcal.gaussian.information import mean_square
from probcal.gaussian.mode import Point
from probcal.gaussian.search import Search
from probcal.gaussian.tails import Variances, renewed_noise
from probcal.inference.ending import conclude_at, diverged, fallen
from probcal.inference.integrate import by_propagation
from probcal.inference.loop import Pause, Task, Trace
from probcal.inference.method import Context
from probcal.inference.mixture import gaussian, mixture
from probcal.inference.placed import Reached, with_places
from probcal.model.model import Mixing, Model
from probcal.modes.explore import CLIMB
from probcal.priors import Flat, Gaussian, Precision, Prior
from probcal.problem import Problem
from probcal.results.answer import Answer, Posterior, blocks_under, tracks_at
from probcal.results.schema import ROPE


def climb_on(engine: Engine, method: Any, problem: Problem, prior: Prior, start: Point, context: Context) -> Answer:
    """The answer of a climb from the host to the marginal or joint mode, on any engine.

    Raises `FitError` where a flat prior leaves no interval, and where memory does not hold it.
    """
    model, first = problem.model, prior.precision(problem.labels, problem.surveyed)
    scales = method.climbs_under(prior).precision(problem.labels, problem.surveyed)
    factors, how = Factors.of(scales), method.integration(problem, prior)
    marginal = method.integrates_places

    def climb(problem: Problem, start: Point) -> Reached:
        own = method.name, method.iterations, method.tolerance
        task = HostClimb.of(*own, engine, problem.model, start, scales, factors, marginal)
        state, trace = context.run(task)
        at, trace = task.reached(state, trace)
        return Reached(problem.with_mixing(state.mixing), at, factors, float(trace.objective[-1]), (state, trace))

    try:
        end, settled = climb(problem, start), True
        if model.rests and marginal:
            end, settled = with_places(climb, end, engine, lambda: context.monitor.stopped)
        problem, at, (state, trace) = end.problem, end.at, end.state
        worth = evidence(at, scales, factors)
        if how is None:
            posterior = _normal(problem, prior, at, first, worth)
        else:
            mixed, work = by_propagation(how.form, first, engine, at, context, marginal=marginal)
            posterior = mixture(problem, prior, how.form, first.alpha, mixed, worth.value, work)
            settled = settled and bool(mixed.settled)
    except MemoryError:
        if not (engine.exact and method.engine == "auto" and isinstance(prior, (Gaussian, Flat))):
            raise _memory(engine, model) from None
        other = replace(method, engine="iterative")
        return cast("Answer", other.answer(problem, prior, start, context))
    except np.linalg.LinAlgError:
        raise diverged(problem, engine.at(model, start), factors) from None
    square = float(mean_square(problem.model, posterior.point))
    worths, count = trace.objective, trace.iterations
    lost = fallen(prior, len(problem.levels), worths.max(), worths[-1]) if model.learns_noise else 0.0
    found = conclude_at(
        problem, method, prior, posterior, worths, square, count, refused=bool(state.refused), lost=lost,
        converged=bool(state.converged) and settled, evidence=worth.value, stopped=context.monitor.stopped,
    )  # fmt: skip
    return replace(found, steps=trace.z, precisions=trace.alpha)


class HostState(NamedTuple):
    """The state of a climb on the host, within a turn or after it; unknown noise is renewed between turns."""

    point: Point
    mixing: Mixing
    search: Search  # of this turn, without its expansion
    over: Any  # true where the turn is
    worth: Any  # evidence after the last turn
    converged: Any
    refused: Any
    done: Any


@dataclass(eq=False)
class HostClimb(Task):
    """Climbs in turn to the mode of the biases and, where noise is not known, to that of largest evidence.

    An iteration is a step of the biases where noise is known, else a turn; it ends where a turn moves the evidence by
    less than the tolerance.
    """

    tolerance: float
    most: int  # steps of a turn
    engine: Engine
    model: Model
    start: Point
    prior: Precision
    factors: Factors  # of the prior
    marginal: bool
    here: Expansion | None = None  # at the point of the last state

    @classmethod
    def of(
        cls, name: str, turns: int, tolerance: float, engine: Engine, model: Model, start: Point, prior: Precision,
        factors: Factors, marginal: bool = True,
    ) -> HostClimb:  # fmt: skip
        """The climb of a method in this many turns at most; its iterations are steps, and the start, without them."""
        most = min(CLIMB, turns)
        iterations = turns if model.learns_noise else most + 1
        return cls(name, iterations, model.biases, tolerance, most, engine, model, start, prior, factors, marginal)

    def init(self) -> HostState:
        """The state before the first turn."""
        search = Search.begin((), self.biases)
        return HostState(self.start, self.model.mixing, search, False, -np.inf, False, False, False)

    def at(self, state: HostState) -> Expansion:
        """The posterior where a state stands, tracks settled already."""
        if self.here is None or self.here.point is not state.point:
            self.here = self.engine.at(self.model.with_mixing(state.mixing), state.point)
        return self.here

    def step(self, state: HostState, count: int, pause: Pause) -> tuple[HostState, Trace]:
        """The rest of a turn up to a pause; before another one unknown noise is renewed."""
        model, start, search = self.model.with_mixing(state.mixing), state.point, None
        if state.over:
            at = self.at(state)
            model, start = renewed_noise(model, at.point, Variances.of(at, self.factors))
            del at
        elif state.search.taken:
            search = state.search._replace(at=self.at(state))
        self.here = None  # it may be large
        mode = climb_to_mode(
            partial(self.engine.settled, model), start, self.factors, self.most, 1e-2 * self.tolerance, pause,
            marginal=self.marginal, search=search,
        )  # fmt: skip
        self.here, search = mode.at, mode.search._replace(at=())
        over, converged = bool(search.done) or int(search.count) > self.most, mode.converged
        refused = int(search.taken) <= 1 and not converged and not count
        done = over and not model.learns_noise
        after = HostState(mode.at.point, model.mixing, search, over, state.worth, converged, refused, done)
        if not model.learns_noise:
            return after, self.course(mode.trace, mode.places)
        if not over:
            return after, self.course([], mode.places[:0])
        worth = evidence(mode.at, self.prior, self.factors).value
        still = abs(worth - float(state.worth)) < self.tolerance
        after = after._replace(worth=worth, converged=converged and still, done=still or not np.isfinite(worth))
        return after, self.course([worth], mode.places[-1:])

    def course(self, worth: Any, z: np.ndarray) -> Trace:
        """The course of iterations that end at biases z (I, M), whose precisions are given."""
        return Trace(np.asarray(worth, float), z, np.broadcast_to(np.asarray(self.prior.alpha), z.shape))

    def ended(self, state: HostState, trace: Trace) -> bool:
        """True where the mode is reached, and the noise stays as it is."""
        return bool(state.done)

    def reached(self, state: HostState, trace: Trace) -> tuple[Expansion, Trace]:
        """The posterior at the end, and the course up to there where it was stopped within a turn."""
        at = self.at(state)
        if state.over or not self.model.learns_noise:
            return at, trace
        worth = evidence(at, self.prior, self.factors).value
        return at, trace.and_then(self.course([worth], np.asarray(at.point.z)[None]))


def _memory(engine: Engine, model: Model) -> FitError:
    """The error that memory does not hold what an engine makes of a model, and what to do."""
    size = f"{model.state_size} state entries and {model.biases} biases"
    if engine.exact:
        return FitError(
            f"the sparse factor of {size} does not fit in memory:"
            ' MAP(engine="iterative") makes none; or take fewer sensors or a shorter time'
        )
    return FitError(f"memory does not hold {size}, not even without a factor: take fewer sensors or a shorter time")


def _normal(problem: Problem, prior: Prior, at: Expansion, first: Precision, worth: Estimate) -> Posterior:
    """The Gaussian at a mode under precisions `first`; `worth` is its log evidence."""
    factors = Factors.of(first)
    spread = at.spread(factors)
    blocks = blocks_under(at, factors, spread)
    declared = blocks if prior.proper else blocks.under_scales()
    errors = {"sd_error": 0.5 * spread.error / spread.biases} if spread.error.any() else {}
    numbers = {"log_evidence_error": worth.error} if prior.proper and worth.error else {}
    return gaussian(
        problem, prior, at.point, blocks, first.alpha, evidence=worth.value, columns=declared.contraction() | errors,
        at=at, factors=factors, moments=tracks_at(at.point, spread.states), declared=declared,
        attrs={"rope": ROPE} | numbers,
    )  # fmt: skip
