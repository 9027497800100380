"""Objects and biases in turn, until they agree: what `SelfConfiguration` does with detections that name no target."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from probcal.errors import FitError
from probcal.inference.method import Context, Method
from probcal.inference.solve import solve, with_room
from probcal.lazy import pd
from probcal.priors import Prior
from probcal.problem import Problem
from probcal.tracking.objects import Objects, track_objects
from probcal.tracking.poses.propagation import Beliefs, propagate_beliefs
from probcal.tracking.rates import rated

WIDER = 4.0  # times the variance of a belief that is granted at the start
ALIKE = 0.02  # by which the weight of no pair may change from one round to the next
LITTLE = 0.5  # sds that rounds which go in a circle may move


class Rounds(NamedTuple):
    """The settings of `configure`."""

    name: str  # of the method, for messages
    method: Method  # fits labelled rows
    iterations: int
    tolerance: float
    beliefs: bool  # whether beliefs say where to start
    window: float | None
    expected: dict[str, Any]  # of objects
    chances: dict[str, Any]  # the settings of `track_objects`


@dataclass(frozen=True, eq=False)
class Configured:
    """The objects of the last round, the rounds, and whether they came to rest."""

    objects: Objects
    problem: Problem  # with the rates of the last round
    rates: pd.DataFrame
    rounds: int
    rests: bool
    beliefs: Beliefs | None = None  # with which it started

    @property
    def labelled(self) -> Problem:
        """The problem whose rows name their objects."""
        return self.problem.assigned(self.objects.rows)


def configure(problem: Problem, how: Rounds, prior: Prior, context: Context) -> Configured:
    """Track and fit in turn; raises `FitError` where no object is confirmed."""
    M = len(problem.labels)
    z, covariance, beliefs = np.zeros(M), np.eye(M), None
    if how.beliefs:
        beliefs = propagate_beliefs(problem, window=how.window, **how.expected)
        wider = np.sqrt(np.clip(1.0 / np.diagonal(beliefs.covariance), 1.0, WIDER))  # to the prior at most
        z, covariance = beliefs.z, wider[:, None] * beliefs.covariance * wider
    held: list[pd.DataFrame] = []
    moves: list[float] = []
    stated = problem
    for k in range(how.iterations):
        context.monitor.enter(f"objects, round {k + 1}", how.name)
        objects = track_objects(problem, z, covariance, **how.chances)
        if not objects.names:
            raise FitError(
                f"no object is confirmed in {len(problem.scans or ())} scans (round {k + 1}): nothing is seen often"
                " enough to tell it from clutter. Check the noise std, probability and clutter of Detection(...), the"
                " start of the motion, and objects=, births= of SelfConfiguration"
            )
        problem, rates = rated(stated, objects, z)
        again = [back for back, rows in enumerate(reversed(held)) if _same(rows, objects.rows)]
        if again and max(moves[len(moves) - again[0] :], default=0.0) < LITTLE:  # rounds that go in a circle
            return Configured(objects, problem, rates, k, True, beliefs)
        held.append(objects.rows)
        labelled, _ = with_room(problem.assigned(objects.rows), how.method, None)
        summary = solve(labelled, how.method, prior, context).posterior.summary
        sd = np.sqrt(np.maximum(np.diagonal(summary.covariance.matrix()), 1e-300))
        moves.append(float(np.max(np.abs(summary.mean - z) / sd, initial=0.0)))
        z, covariance = summary.mean, summary.covariance.matrix()
        if k and moves[-1] < how.tolerance:
            return Configured(objects, problem, rates, k + 1, True, beliefs)
        if context.monitor.stopped:
            break
    return Configured(objects, problem, rates, k + 1, False, beliefs)


def _same(before: pd.DataFrame, after: pd.DataFrame) -> bool:
    """True if no pair of detection and track has another weight than before."""
    both = before.merge(after, on=["row", "track"], how="outer", suffixes=("", "_after")).fillna(0.0)
    return bool(np.all(np.abs(both["weight"] - both["weight_after"]) < ALIKE))
