"""The end of a climb to a point: the answer, its status, and one sentence on what to do."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from probcal.errors import FitError
from probcal.gaussian.choose import choose
from probcal.gaussian.draws import residuals
from probcal.gaussian.engine import Expansion, Factors, told_alone
from probcal.gaussian.information import growing_square, mean_square, rejected
from probcal.gaussian.mode import Point
from probcal.inference.integrate import Integrated, Integration
from probcal.inference.loop import Trace
from probcal.inference.method import Iterated, State
from probcal.inference.mixture import gaussian, mixture
from probcal.labels import listed
from probcal.misfit import MisfitData, misfit_text, rejection_text
from probcal.modes import automatic_start
from probcal.modes.grid import track_mode
from probcal.priors import ARD, PRECISION_BOUNDS, Flat, Prior
from probcal.problem import Problem
from probcal.results.answer import Answer, Posterior, Summary, uncalibrated
from probcal.results.blocks import SensorBlocks
from probcal.results.groups import data_columns, datum_of, gather
from probcal.status import CLIMB, judge

NAMED = 20  # biases that no row tells, of which a message says so
FAR = 10.0  # scales from the stated value beyond which an estimate is none
FALL = 1.0  # nats below its best at which an evidence may end
# Monte Carlo error of a mean in sd, or of an sd over it, above which a message states it
INEXACT = 0.03
ABSURD = 100.0  # mean square a datum, 1 expected, beyond which a fit explains nothing
# the same of data whose std grows, which is then known to a factor of three: wrong modes leave 8 to 80
GROWN = 9.0
DOUBTED = 2.0  # the same, from which the automatic start is looked at: a wrong mode leaves twice as much


def conclude(
    problem: Problem,
    method: Iterated,
    prior: Prior,
    state: State,
    course: Trace,
    how: Integration | None = None,
    mixed: Integrated | None = None,
    stopped: str = "",
) -> Answer:
    """The answer of a method whose outer loop ended in a state after a course.

    Where precisions were integrated after it, `mixed` is what came of it; `stopped` says why it was
    ended early.
    """
    alpha, worth = np.asarray(state.alpha), float(state.found.evidence)
    if how is None or mixed is None:
        covariance, information = SensorBlocks.of(np.asarray(state.found.covariance)), state.found.information
        posterior = gaussian(problem, prior, state.point, covariance, alpha, information=information, evidence=worth)
    else:
        alpha = np.asarray(problem.first_precision(prior).alpha)
        posterior = mixture(problem, prior, how.form, alpha, mixed, worth)
    answer = conclude_at(
        problem, method, prior, posterior, course, evidence=worth, stopped=stopped,
        converged=bool(state.done) and (mixed is None or bool(mixed.settled)), refused=bool(state.refused),
        lost=fallen(prior, len(problem.levels), state.best, state.worth),
    )  # fmt: skip
    said = uncertain(problem.labels, mixed) if mixed is not None and answer.status.valid else ""
    return answer.noted(said)


def diverged(problem: Problem, at: Expansion, factors: Factors) -> FitError:
    """The error that the precision of the biases is not positive definite.

    It names the biases that no row informs.
    """
    told = told_alone(at) + np.asarray(factors.diagonal(problem.model.biases))
    nothing = np.flatnonzero(told == 0)
    silent = ", ".join([problem.labels[m] for m in nothing][:NAMED])
    why = f"no row tells {silent}" if silent else "the information matrix is singular"
    return FitError(f"The fit diverged: {why}; the estimate is invalid. Use a prior, or fix some biases.")


def uncertain(labels: Sequence[str], mixed: Integrated) -> str:
    """A sentence on the Monte Carlo error of integrated precisions, where it is large.

    Else nothing.
    """
    errors = np.broadcast_arrays(mixed.mean_error, mixed.sd_error, np.zeros(len(labels)))[:2]
    mean, sd = (float(np.max(part, initial=0.0)) for part in errors)
    if max(mean, sd) <= INEXACT:
        return ""
    worst = labels[int(np.argmax(np.maximum(*errors)))]
    return (
        f"Precisions are integrated by draws: their Monte Carlo error is up to {mean:.2f} sd of a mean and {sd:.0%} of"
        f" an sd, largest for {worst}. Fit again with another key to see it, or take collapsed."
    )


def conclude_at(
    problem: Problem, method: Iterated, prior: Prior, posterior: Posterior, course: Trace, *, converged: bool,
    evidence: float, lost: float = 0.0, stopped: str = "", **others: Any,
) -> Answer:  # fmt: skip
    """The answer of a climb that ended at a posterior: whether it converged, never left its start, lost evidence.

    `others` are further facts that `probcal.status.CLIMB` knows, or the same otherwise.
    """
    summary, trace, iterations = posterior.summary, course.objective, course.iterations
    low, far = low_and_far(prior, summary, problem.surveyed)
    cut = bool(stopped) and not converged and iterations < method.iterations
    asked = method.tolerance == 0.0 and not cut  # to run so many iterations, whatever they reach
    moved = trace[-1] - trace[-2] if len(trace) > 1 else np.nan
    beyond = "outside" if summary.precisions == "integrated" else "low"

    def named(mask: np.ndarray) -> str:
        return listed([label for label, hit in zip(problem.labels, mask, strict=True) if hit], 12)

    facts = {
        "iterations": iterations, "limit": FAR, "far": named(far),
        "singular": not (posterior.sound and np.isfinite(evidence)), beyond: named(low),
        "fallen": 0.0 if cut or lost <= FALL else lost, "converged": converged,
        "cut": f"{stopped} after {iterations} iteration{'s' * (iterations > 1)}" if cut else "",
        "moved": f"the last moved the objective by {moved:.2g}" if asked and np.isfinite(moved) else "",
        "spent": asked, **others,
    }  # fmt: skip
    if "misfit" not in others:
        facts["misfit"] = misfit_sentence(problem, posterior.point)
    status, message = judge(CLIMB, facts)
    pruned = (summary.gamma < 1e-2) & (summary.precisions == "maximised")
    ended = bias_status(problem, {"at bound": low, "diverged": far, "pruned": pruned})
    message = " ".join(part for part in (message, method.remark(prior)) if part)
    return Answer(
        problem, method, method, prior, posterior, status, message, ended, iterations, *course, interrupted=cut,
    )  # fmt: skip


def bias_status(problem: Problem, masks: Mapping[str, np.ndarray]) -> tuple[str, ...]:
    """The end of each bias, by masks (M,) of those that are "not mixed", "at bound", "diverged" and "pruned"."""
    kind = np.array([bias.kind for bias in problem.biases], str)
    cases = {"not mixed": kind == "", "survey": kind == "survey", "drift": kind == "drift", **masks}
    return tuple(np.select(list(cases.values()), list(cases), "estimated").tolist())


def low_and_far(prior: Prior, summary: Summary, surveyed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Masks (M,) of biases at the bound that their precision sets, and of those that ran away
    without a prior."""
    none, mean = np.zeros(len(surveyed), bool), np.nan_to_num(summary.mean, nan=np.inf)
    far = astray(prior, mean, surveyed)
    if summary.precisions == "integrated":
        return (np.abs(mean) > FAR) & ~surveyed, far
    low = (summary.precision <= PRECISION_BOUNDS[0] * (1 + 1e-9)) & ~surveyed if isinstance(prior, ARD) else none
    return low, far


def astray(prior: Prior, mean: Any, surveyed: Any) -> Any:
    """A mask (M,) of means, over their scales, that ran away: possible only without prior
    scales."""
    return (abs(mean) > FAR) & ~surveyed & isinstance(prior, Flat)


def fallen(prior: Prior, levels: int, best: Any, worth: Any) -> float:
    """Nats by which the last evidence lies below the best, where a method maximises it: precisions or levels learnt."""
    return max(float(best) - float(worth), 0.0) if prior.proper and (prior.learns or levels) else 0.0


def misfit_sentence(problem: Problem, point: Point, square: float | None = None) -> str:
    """The misfit of a point whose residuals have this mean square, its likely cause and what to do.

    Empty where the point explains the data, and robust noise rejects no sensor. A std that grows hides a
    misfit: then the automatic start is compared.
    """
    square = mean_square(problem.model, point) if square is None else square
    grown = growing_square(problem.model, point)
    if square <= ABSURD and grown > DOUBTED and choose(problem.model).cheap and not _drawn(problem):
        least = growing_square(problem.model, automatic_start(problem))
        if 2.0 * least < grown:
            return (
                f"The fit ended in a wrong mode: mean square a datum {grown:.2g}, where the automatic start leaves"
                f" {least:.2g}. Fit again without a start, or with starts=4."
            )
    if square <= ABSURD and grown <= GROWN:
        return rejection_text(rejected(problem, point))
    return misfit_text(max(square, grown), (_remains(problem, at) for at in _points(problem, point, square)))


def _drawn(problem: Problem) -> bool:
    """True where a motion has no linear form, and so no automatic start."""
    return any(part.L.shape[1] == 0 for part in problem.model.recursions)


def _points(problem: Problem, point: Point, square: float) -> Iterator[Point]:
    """The point of a misfit where it is finite, and tracks with the biases as stated, which no
    wrong bias bends."""
    if np.isfinite(square) or _drawn(problem):
        yield point
    if not _drawn(problem):
        yield track_mode(problem, uncalibrated(problem, automatic_start(problem)))


def _remains(problem: Problem, point: Point) -> MisfitData:
    """The residual of every datum at a point, and where it belongs."""
    network, (datum, picks) = problem.network, datum_of(problem)
    names = data_columns(datum)
    units = {
        (placed.name, channel): known.unit
        for placed in network.sensors
        for channel, known in placed.type.expand(network.dimension)
    }
    sensor, channel, target = (np.asarray(names[name], str) for name in ("sensor", "channel", "target"))
    return MisfitData(
        square=gather(residuals(problem.model, point).square, picks),
        residual=gather(residuals(problem.model, point).innovation, picks),
        value=datum["y"],
        sensor=sensor,
        channel=channel,
        target=target,
        time=names["time"],
        unit=np.array([units[pair] for pair in zip(sensor, channel, strict=True)]),
    )
