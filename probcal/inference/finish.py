"""From an answer to the tree of a fit: what the data leave open, what is said of it, and what the tree keeps."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import jax
import numpy as np

from probcal.errors import FitError, InputError
from probcal.identifiability.directions import alone_directions, screened_directions, weak_directions
from probcal.identifiability.remedies import Direction
from probcal.identifiability.watch import runs, strained_starts
from probcal.inference.progress import Monitor
from probcal.inference.widen import judge_fit
from probcal.labels import NODE, START, listed
from probcal.modes.explore import SAME
from probcal.problem import Problem
from probcal.results.answer import Answer
from probcal.results.build import build, modes_of
from probcal.results.modes import AGAIN, PART, REJECTED, apart
from probcal.results.schema import DIFFERENT

if TYPE_CHECKING:
    import xarray as xr

SAVE = ("states", "predictive")
NAMED = 4  # directions, or biases, that a message names


def finished(answer: Answer, key: jax.Array, keep: tuple[str, ...], monitor: Monitor) -> tuple[xr.DataTree, Answer]:
    """The tree of an answer with the draws of `keep`, made with `key`, and the answer with its whole message.

    Raises `FitError` where a flat prior leaves a singular problem without any interval.
    """
    answer = _interrupted(answer, monitor)
    directions, count = _directions(answer)
    answer = _watched(replace(answer, message=_advised(answer, directions, count)))
    if not answer.posterior.sound:
        raise FitError(answer.message)
    found = build(answer, directions, key, keep)
    found.attrs["weak"] = count
    if monitor.signal:
        found.attrs["interrupted"] = 1
    return found, answer


def kept(save: Collection[str]) -> tuple[str, ...]:
    """The parts of every draw that are kept, in the words of `gaussian.draws`; raises `InputError` for other names."""
    names = (save,) if isinstance(save, str) else tuple(save)
    for name in names:
        if name not in SAVE:
            raise InputError(
                f'fit: save names "{name}", which is no group of draws; give "states", "predictive" or both'
            )
    return ("log_likelihood", *(word for name, word in zip(SAVE, ("states", "replicas"), strict=True) if name in names))


def _interrupted(answer: Answer, monitor: Monitor) -> Answer:
    """The answer, marked where Ctrl-C ended the search for it or for others."""
    if not monitor.signal:
        return answer
    unseen = "" if monitor.stopped in answer.message else monitor.stopped
    return replace(answer.judged(interrupted=True, unseen=unseen), interrupted=True)


def _directions(answer: Answer) -> tuple[tuple[Direction, ...], int]:
    """The directions that the data leave open at the answer, and their number; some have no name."""
    posterior, information = answer.posterior, answer.posterior.summary.information
    if (blocks := posterior.declared) is not None:
        if not answer.prior.proper:  # a flat prior leaves no room for more
            return alone_directions(answer.problem, posterior.point, blocks)
        return screened_directions(answer.problem, posterior.expansion, blocks)
    if information is None or not linear_form(answer) or not np.isfinite(information).all():
        return (), 0
    found = weak_directions(answer.problem, information, posterior.point)
    return found, len(found)


def judged_problem(problem: Problem, answer: Answer) -> Problem | None:
    """The problem by which the tree of an answer is judged, its rows named; None where a motion has no linear form."""
    if not linear_form(answer):
        return None
    return problem if problem.scans is None else answer.problem


def judged_tree(problem: Problem, answer: Answer, tree: xr.DataTree) -> xr.DataTree:
    """The tree of an answer, its intervals widened where the innovations reject the model."""
    judged = judged_problem(problem, answer)
    return tree if judged is None else judge_fit(judged, tree)


def linear_form(answer: Answer) -> bool:
    """True where the states of an answer are those of linear motions, which the search for gauges needs."""
    states, noises = jax.tree.map(np.shape, answer.posterior.point.trajectories)
    return states == noises


def _advised(answer: Answer, directions: Sequence[Direction], count: int) -> str:
    """The message of an answer, with what the data leave open; a misfit is not for lack of data."""
    if not directions or not answer.status.explains:
        return answer.message
    named = "; ".join(direction.sentence for direction in directions[:NAMED])
    named += f"; and {count - NAMED} more" if count > NAMED else ""
    about = "Weakly determined by the data" if answer.status.settled else "The data do not fix"
    return f"{answer.message} {about}: {named}.".strip()


def _watched(answer: Answer) -> Answer:
    """The answer with what it ran along: no estimate where no row fixes that, else a sentence."""
    problem, point = answer.problem, answer.posterior.point
    if not linear_form(answer) or not answer.status.valid or not np.isfinite(np.asarray(point.z)).all():
        return answer
    found = answer
    for run in runs(problem, point, many=not answer.posterior.summary.covariance.whole):
        found = found.judged(**{"gauge" if run.gauge else "along": run})
    for strained in strained_starts(problem, point) if answer.motion == "used" else ():
        found = found.judged(strained=strained)
    reported, *others = modes_of(answer)[0]
    others = [other for other in others if other.kind not in (AGAIN, REJECTED, PART)]
    sd = answer.posterior.here[1] * problem.scales
    for other in others:
        away = apart(other.bias, reported.bias, sd)
        labels = [problem.labels[m] for m in np.argsort(-away) if away[m] > DIFFERENT]
        place = f"{other.name}, " + (f"with other {listed(labels, NAMED)}" if labels else "the biases alike")
        found = found.judged(**{"worse" if other.gain <= -SAME else "equal": (abs(other.gain), place)})
    alike = {other.kind for other in others if other.gain > -SAME}
    side = "line" if problem.network.dimension == 2 else "plane"
    return found.judged(node=NODE in alike, side=side if alike - {NODE, START} else "")
