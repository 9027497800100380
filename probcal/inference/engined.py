"""A climb from the host to the marginal or joint mode, on any engine, and the answer there.

`EA()` and `MAP()` come here where kernels of the dense engine do not climb (`gaussian.choose`).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple, cast

import numpy as np

from probcal.errors import FitError
from probcal.gaussian.climb import climb_to_mode
from probcal.gaussian.engine import Engine, Expansion, Factors, evidence
from probcal.gaussian.mode import Point
from probcal.gaussian.search import Search
from probcal.gaussian.tails import Variances, renewed_noise
from probcal.inference.ending import conclude_at, diverged, fallen
from probcal.inference.integrate import by_propagation
from probcal.inference.loop import Pause, Trace
from probcal.inference.method import Context, MethodTask
from probcal.inference.mixture import gaussian_at, mixture
from probcal.inference.placed import Reached, with_places
from probcal.model.model import Mixing, Model
from probcal.modes.explore import CLIMB
from probcal.priors import Flat, Gaussian, Precision, Prior
from probcal.problem import Problem
from probcal.results.answer import Answer


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
class Engined(MethodTask):
    """A climb on an engine."""

    engine: Engine = field(kw_only=True)

    def beyond_memory(self, error: MemoryError) -> Answer:
        """The answer without a factor where memory does not hold one; raises what to do where there is none."""
        method, engine, prior = self.method, self.engine, self.prior
        if not (engine.exact and method.engine == "auto" and isinstance(prior, (Gaussian, Flat))):
            raise _memory(engine, self.problem.model) from None
        other = replace(method, engine="iterative")
        return cast("Answer", other.answer(self.problem, prior, self.start, self.context))

    def singular(self, error: np.linalg.LinAlgError) -> Answer:
        """Raises that the fit diverged, and which biases no row informs."""
        problem, own = self.problem, self.problem.first_precision(self.prior)
        at = self.engine.at(problem.model, self.start)
        raise diverged(problem, at, Factors.of(own)) from None


@dataclass(eq=False)
class HostClimb(Engined):
    """Climbs in turn to the mode of the biases and, where noise is not known, to that of largest evidence.

    An iteration is a step of the biases where noise is known, else a turn; it ends where a turn moves the evidence by
    less than the tolerance. Its iterations are steps, and the start.
    """

    scales: Precision  # of the climb
    factors: Factors  # of the prior
    turns: int
    tolerance: float
    marginal: bool = True
    here: Expansion | None = None  # at the point of the last state

    def __post_init__(self) -> None:
        self.model, self.most = self.problem.model, min(CLIMB, self.turns)

    @classmethod
    def of(
        cls, method: Any, problem: Problem, prior: Prior, start: Point, context: Context, engine: Engine
    ) -> HostClimb:
        """The climb of a method that reports a Gaussian, or a mixture, at the mode."""
        scales = problem.first_precision(method.climbs_under(prior))
        own = method.iterations, method.tolerance, method.integrates_places
        return cls(method, problem, prior, start, context, scales, Factors.of(scales), *own, engine=engine)

    @property
    def iterations(self) -> int:
        """Turns, or steps and the start."""
        return self.turns if self.model.learns_noise else self.most + 1

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
            return after, self.course_at(mode.trace, mode.places)
        if not over:
            return after, self.course_at([], mode.places[:0])
        worth = evidence(mode.at, self.scales, self.factors).value
        still = abs(worth - float(state.worth)) < self.tolerance
        after = after._replace(worth=worth, converged=converged and still, done=still or not np.isfinite(worth))
        return after, self.course_at([worth], mode.places[-1:])

    def course_at(self, worth: Any, z: np.ndarray) -> Trace:
        """The course of iterations that end at biases z (I, M), whose precisions are given."""
        return Trace(np.asarray(worth, float), z, np.broadcast_to(np.asarray(self.scales.alpha), z.shape))

    def ended(self, state: HostState, trace: Trace) -> bool:
        """True where the mode is reached, and the noise stays as it is."""
        return bool(state.done)

    def reached(self, state: HostState, trace: Trace) -> Reached:
        """The end of the climb, with the course up to there where it was stopped within a turn."""
        at, problem = self.at(state), self.problem.with_mixing(state.mixing)
        if self.model.learns_noise and not state.over:
            worth = evidence(at, self.scales, self.factors).value
            trace = trace.and_then(self.course_at([worth], np.asarray(at.point.z)[None]))
        return Reached(problem, at, self.factors, float(trace.objective[-1]), (state, trace))

    def outcome(self, state: HostState, course: Trace) -> Answer:
        """The Gaussian at the mode, or the mixture where precisions are integrated.

        Places that are far from Gaussian are integrated there, and it climbs again with what they add.
        """
        method, prior, context, engine = self.method, self.prior, self.context, self.engine

        def climb(problem: Problem, start: Point) -> Reached:
            task = replace(self, problem=problem, start=start, here=None)
            return task.reached(*context.run(task))

        end, settled = self.reached(state, course), True
        if self.model.rests and self.marginal:
            end, settled = with_places(climb, end, engine, lambda: context.monitor.stopped)
        problem, at, (state, course) = end.problem, end.at, end.state
        first, how = problem.first_precision(prior), method.integration(problem, prior)
        worth = evidence(at, self.scales, self.factors)
        if how is None:
            posterior = gaussian_at(problem, prior, at, worth)
        else:
            mixed, work = by_propagation(how.form, first, engine, at, context, marginal=self.marginal)
            posterior = mixture(problem, prior, how.form, first.alpha, mixed, worth.value, work)
            settled = settled and bool(mixed.settled)
        worths = course.objective
        lost = fallen(prior, len(problem.levels), worths.max(), worths[-1]) if self.model.learns_noise else 0.0
        return conclude_at(
            problem, method, prior, posterior, course, converged=bool(state.converged) and settled,
            evidence=worth.value, lost=lost, stopped=context.monitor.stopped, refused=bool(state.refused),
        )  # fmt: skip


def _memory(engine: Engine, model: Model) -> FitError:
    """The error that memory does not hold what an engine makes of a model, and what to do."""
    size = f"{model.state_size} state entries and {model.biases} biases"
    if engine.exact:
        return FitError(
            f"the sparse factor of {size} does not fit in memory:"
            ' MAP(engine="iterative") makes none; or take fewer sensors or a shorter time'
        )
    return FitError(f"memory does not hold {size}, not even without a factor: take fewer sensors or a shorter time")
