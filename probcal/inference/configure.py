"""Objects and biases in turn, until they agree: what `SelfConfiguration` does with detections that name no target."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from probcal.association.objects import Objects, track_objects
from probcal.association.poses import Beliefs, propagate_beliefs
from probcal.errors import FitError
from probcal.inference.run import Context
from probcal.inference.selfconfig import SelfConfiguration
from probcal.inference.solve import solve
from probcal.lazy import Later
from probcal.priors import Prior
from probcal.problem import Problem

if TYPE_CHECKING:
    import pandas as pd
else:
    pd = Later("pandas")

WIDER = 4.0  # times the variance of a belief that is granted at the start
ALIKE = 0.02  # by which the weight of no pair may change from one round to the next


@dataclass(frozen=True, eq=False)
class Configured:
    """The objects of the last round, the labelled problem, the rounds, and whether they came to rest."""

    objects: Objects
    problem: Problem
    rounds: int
    rests: bool
    beliefs: Beliefs | None = None  # with which it started


def configure(problem: Problem, method: SelfConfiguration, prior: Prior, context: Context) -> Configured:
    """Track and fit in turn; raises `FitError` where no object is confirmed."""
    M, before = len(problem.labels), None
    z, covariance, beliefs = np.zeros(M), np.eye(M), None
    if method.start == "beliefs":
        beliefs = propagate_beliefs(problem, window=method.window, **method.expected)
        wider = np.sqrt(np.clip(1.0 / np.diagonal(beliefs.covariance), 1.0, WIDER))  # to the prior at most
        z, covariance = beliefs.z, wider[:, None] * beliefs.covariance * wider
    for k in range(method.iterations):
        objects = track_objects(problem, z, covariance, **method.chances)
        if not objects.names:
            raise FitError(
                f"no object is confirmed in {len(problem.scans or ())} scans (round {k + 1}): nothing is seen often"
                " enough to tell it from clutter. Check the noise std, probability and clutter of Detection(...), the"
                " start of the motion, and objects=, births= of SelfConfiguration"
            )
        labelled = problem.assigned(objects.rows)
        if before is not None and _same(before.rows, objects.rows):
            return Configured(objects, labelled, k, True, beliefs)
        before = objects
        summary = solve(labelled, method.method, prior, context).posterior.summary
        moved = np.abs(summary.mean - z) / np.sqrt(np.maximum(np.diagonal(summary.covariance), 1e-300))
        z, covariance = summary.mean, summary.covariance
        if k and moved.max(initial=0.0) < method.tolerance:
            return Configured(objects, labelled, k + 1, True, beliefs)
    return Configured(objects, labelled, method.iterations, False, beliefs)


def _same(before: pd.DataFrame, after: pd.DataFrame) -> bool:
    """Whether no pair of detection and track has another weight than before."""
    both = before.merge(after, on=["row", "track"], how="outer", suffixes=("", "_after")).fillna(0.0)
    return bool(np.all(np.abs(both["weight"] - both["weight_after"]) < ALIKE))
