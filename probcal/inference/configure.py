"""Objects and biases in turn, until they agree: what `SelfConfiguration` does with detections that name no target."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from probcal.association.objects import Objects, track_objects
from probcal.association.registration import Registration, in_frame, register_tracks
from probcal.errors import FitError, InputError
from probcal.inference.run import Context
from probcal.inference.selfconfig import SelfConfiguration
from probcal.inference.solve import solve
from probcal.labels import AXES
from probcal.lazy import Later
from probcal.priors import Prior
from probcal.problem import Problem

if TYPE_CHECKING:
    import pandas as pd
else:
    pd = Later("pandas")

SURE = 0.9  # existence from which on the path of a track is used
WIDER = 4.0  # times the variance of a registration that is granted at the start
ALIKE = 0.02  # by which the weight of no pair may change from one round to the next


@dataclass(frozen=True, eq=False)
class Configured:
    """The objects of the last round, the labelled problem, the rounds, and whether they came to rest."""

    objects: Objects
    problem: Problem
    rounds: int
    rests: bool
    apart: tuple[str, ...] = ()  # sensors of unknown pose whose tracks do not tell how they stand to the others


def configure(problem: Problem, method: SelfConfiguration, prior: Prior, context: Context) -> Configured:
    """Track and fit in turn; raises `FitError` where no object is confirmed."""
    M, before = len(problem.labels), None
    z, covariance, apart = np.zeros(M), np.eye(M), tuple[str, ...]()
    if method.start == "tracks":
        z, covariance, apart = registered(problem, method)
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
            return Configured(objects, labelled, k, True, apart)
        before = objects
        summary = solve(labelled, method.method, prior, context).posterior.summary
        moved = np.abs(summary.mean - z) / np.sqrt(np.maximum(np.diagonal(summary.covariance), 1e-300))
        z, covariance = summary.mean, summary.covariance
        if k and moved.max(initial=0.0) < method.tolerance:
            return Configured(objects, labelled, k + 1, True, apart)
    return Configured(objects, labelled, method.iterations, False, apart)


def registered(problem: Problem, method: SelfConfiguration) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Biases z (M,) and their covariance by the tracks of each sensor alone, from sensors of known pose outward.

    A tree of the pairs that explain most seconds of tracks carries poses from sensor to sensor; a pair with a rival
    frame is left out. Third, the sensors that it does not reach, which stay as stated. Raises `FitError` where no
    pose is known.
    """
    M = len(problem.labels)
    z, variance = np.zeros(M), np.ones(M)
    network, d = problem.network, problem.network.dimension
    sensors = [s for s in network.sensors if s.detection is not None and len(s.nodes) == 1]
    free = {s.name: [f"{s.nodes[0].name}.{part}" for part in ("heading", *(f"position_{a}" for a in AXES[:d]))]
            for s in sensors}  # fmt: skip
    found = {s.name: track_objects(problem, sensors=[s.name], **method.chances).path for s in sensors}
    placed = {
        s.name: (0.0, np.zeros(d), np.zeros(1 + d)) for s in sensors if not set(free[s.name]) & set(problem.labels)
    }
    if not placed:
        raise FitError(
            'SelfConfiguration(start="tracks"): no sensor has a known pose, from which the others could be told; leave'
            " out the survey and scale of one node"
        )
    tried: dict[tuple[str, str], Any] = {}
    while len(placed) < len(sensors):
        best: Any = None
        for known in placed:
            for name in found:
                if name in placed:
                    continue
                if (known, name) not in tried:
                    tried[known, name] = _between(found[known], found[name], method.cut)
                pair = tried[known, name]
                if pair is not None and (best is None or pair.pairs["seconds"].sum() > best[0].pairs["seconds"].sum()):
                    best = (pair, known, name)
        if best is None:
            break
        pair, known, name = best
        heading, position, square = placed[known]
        place = in_frame(pair.position[None], heading, position)[0]
        spread = square + np.r_[pair.sd["heading"], pair.sd["position"]] ** 2
        placed[name] = (float(np.angle(np.exp(1j * (heading + pair.heading)))), place, spread)
    for s in sensors:
        if s.name in placed:
            heading, position, spread = placed[s.name]
            own = s.nodes[0].position
            values = np.r_[heading, in_frame(own[None], heading, position)[0] - own]
            lever = spread[0] * np.sum(own**2)  # of the heading about the origin
            for label, value, square in zip(free[s.name], values, spread + np.r_[0.0, np.full(d, lever)], strict=True):
                if label in problem.labels:
                    m = problem.labels.index(label)
                    z[m], variance[m] = value / problem.scales[m], WIDER * square / problem.scales[m] ** 2
    return z, np.diag(np.minimum(variance, 1.0)), tuple(name for name in found if name not in placed)


def _between(first: pd.DataFrame, second: pd.DataFrame, cut: float) -> Registration | None:
    """How the tracks of two sensors lie to each other; None where they do not say."""
    first, second = (path[path["existence"] > SURE] for path in (first, second))
    if first.empty or second.empty:
        return None
    try:
        found = register_tracks(first, second, cut=cut)
    except InputError:
        return None
    return found if found.sound else None


def _same(before: pd.DataFrame, after: pd.DataFrame) -> bool:
    """Whether no pair of detection and track has another weight than before."""
    both = before.merge(after, on=["row", "track"], how="outer", suffixes=("", "_after")).fillna(0.0)
    return bool(np.all(np.abs(both["weight"] - both["weight_after"]) < ALIKE))
