"""A climb from the host to the marginal or joint mode, on any engine, and the answer there.

`EA()` and `MAP()` come here where kernels of the dense engine do not climb (`gaussian.choose`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np

from probcal.errors import FitError
from probcal.gaussian.climb import climb_with_noise
from probcal.gaussian.engine import Engine, Estimate, Expansion, Factors, evidence
from probcal.gaussian.information import mean_square
from probcal.gaussian.mode import Point
from probcal.inference.ending import conclude_at, diverged, fallen
from probcal.inference.integrate import by_propagation
from probcal.inference.method import Context
from probcal.inference.mixture import gaussian, mixture
from probcal.inference.placed import Reached, with_places
from probcal.model.model import Model
from probcal.modes.mirrors import CLIMB
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
    steps = min(CLIMB, method.iterations)

    def told(k: int, value: float) -> bool:
        context.monitor.tell(method.name, min(k, method.iterations), method.iterations, value, bound=True)
        return bool(context.monitor.stopped)

    def climb(problem: Problem, start: Point) -> Reached:
        turns, tolerance = method.iterations, method.tolerance
        settings = (steps, turns, tolerance, told)
        mode = climb_with_noise(engine, problem.model, start, scales, factors, *settings, marginal=marginal)
        value = float(mode.trace[-1])  # without unknown noise the density
        return Reached(problem.with_mixing(mode.at.model.mixing), mode.at, factors, value, mode)

    try:
        end, settled = climb(problem, start), True
        if model.rests and marginal:
            end, settled = with_places(climb, end, engine, lambda: context.monitor.stopped)
        problem, at, mode = end.problem, end.at, end.state
        worth = evidence(at, scales, factors)
        if how is None:
            posterior = _normal(problem, prior, at, first, worth)
        else:
            mixed, work = by_propagation(how.form, first, engine, at, context.key, told, marginal=marginal)
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
    lost = fallen(prior, len(problem.levels), mode.trace.max(), mode.trace[-1]) if model.learns_noise else 0.0
    return conclude_at(
        problem, method, prior, posterior, mode.trace, square, len(mode.trace), refused=mode.refused, lost=lost,
        converged=mode.converged and settled, evidence=worth.value, stopped=context.monitor.stopped,
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
