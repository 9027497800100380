"""Objects and biases in turn, until they agree: what `SelfConfiguration` does with detections that name no target."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from probcal.errors import FitError
from probcal.inference.method import Context, Method
from probcal.inference.solve import solve
from probcal.lazy import pd
from probcal.priors import Prior
from probcal.problem import Problem
from probcal.tracking.objects import Objects, track_objects
from probcal.tracking.poses.propagation import Beliefs, propagate_beliefs
from probcal.tracking.rates import rated

WIDER = 4.0  # times the variance of a belief that is granted at the start
ALIKE = 0.02  # by which the weight of no pair may change from one round to the next
LITTLE = 0.5  # sds that rounds which go in a circle may move
SPARE = 0.05  # room for the rows and epochs of later rounds


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
    room, stated = Room(problem), problem
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
        summary = solve(problem.assigned(room.filled(objects.rows)), how.method, prior, context).posterior.summary
        sd = np.sqrt(np.maximum(np.diagonal(summary.covariance.matrix()), 1e-300))
        moves.append(float(np.max(np.abs(summary.mean - z) / sd, initial=0.0)))
        z, covariance = summary.mean, summary.covariance.matrix()
        if k and moves[-1] < how.tolerance:
            return Configured(objects, problem, rates, k + 1, True, beliefs)
        if context.monitor.stopped:
            break
    return Configured(objects, problem, rates, k + 1, False, beliefs)


class Room:
    """Sizes that the labelled problems of all rounds share, so that what one round compiles serves the next.

    What is left over is filled with detections of weight 0, which say nothing.
    """

    def __init__(self, problem: Problem):
        scans = problem.scans
        assert scans is not None
        data, network = problem.measurements, problem.network
        self.time = data.time
        kinds = np.array([network.types.index(sensor.type) for sensor in network.sensors])
        self.kind = kinds[data.sensor]  # type of each row
        rows = np.flatnonzero(scans.of_row >= 0)
        self.times, first = np.unique(self.time[rows], return_index=True)
        self.row_at = rows[first]
        self.epochs: dict[int, int] = {}  # by the number of tracks
        self.rows: dict[tuple[int, int], int] = {}  # and by type

    def filled(self, pairs: pd.DataFrame) -> pd.DataFrame:
        """The pairs of row and track, and others of weight 0: at other times of the tracks, and over again."""
        names = pairs["track"].unique()
        there = np.zeros((len(names), len(self.times)), bool)
        at = np.searchsorted(self.times, self.time[pairs["row"]])
        there[pd.Index(names).get_indexer(pairs["track"]), at] = True
        used = int(there.sum())
        if self.epochs.get(len(names), 0) < used:
            self.epochs[len(names)] = min(_roomy(used), there.size)
        more = np.argwhere(~there)[: self.epochs[len(names)] - used]
        whole = pd.DataFrame({"row": self.row_at[more[:, 1]], "track": names[more[:, 0]], "weight": 0.0})
        whole = pd.concat([pairs, whole], ignore_index=True)
        kind, added = self.kind[whole["row"]], [whole]
        for number in np.unique(kind):
            own = whole[kind == number]
            if self.rows.get((len(names), number), 0) < len(own):
                self.rows[len(names), number] = _roomy(len(own))
            size = self.rows[len(names), number]
            added.append(own.iloc[np.arange(size - len(own)) % len(own)].assign(weight=0.0))
        return pd.concat(added, ignore_index=True)


def _roomy(count: int) -> int:
    return int((1.0 + SPARE) * count) + 8


def _same(before: pd.DataFrame, after: pd.DataFrame) -> bool:
    """Whether no pair of detection and track has another weight than before."""
    both = before.merge(after, on=["row", "track"], how="outer", suffixes=("", "_after")).fillna(0.0)
    return bool(np.all(np.abs(both["weight"] - both["weight_after"]) < ALIKE))
