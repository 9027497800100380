"""Tracks of objects that nobody named, as tables: which detection is of which, and where and how surely each is."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from probcal.errors import InputError
from probcal.lazy import pd
from probcal.problem import Problem
from probcal.tracking.bernoulli import Step, filter_tracks
from probcal.tracking.entry import asked
from probcal.types import float64

LEAST = 0.02  # share of a detection below which it is not listed


@dataclass(frozen=True, eq=False)
class Objects:
    """Tracks of the objects in a table of detections.

    `rows` has a line for each pair of detection and track (row of the table, track, weight), which `Problem.assigned`
    takes; `path` one for each scan of a track (time, track, existence, and the mean and sd of each state component).
    """

    rows: pd.DataFrame
    path: pd.DataFrame

    @property
    def names(self) -> list[str]:
        """The tracks in the order in which they begin."""
        return list(dict.fromkeys(self.path["track"]))


@float64
def track_objects(
    problem: Problem,
    z: Any = None,
    covariance: Any = None,
    *,
    objects: float = 3.0,
    births: float = 0.02,
    lifetime: float = 600.0,
    most: int = 32,
    confirmed: float = 0.9,
    sensors: Collection[str] = (),
) -> Objects:
    """Track the objects behind detections that name none, with biases z (M,) held (in their scales; 0 by default).

    What is not known of them, `covariance` (M, M), counts as noise of each detection.

    At the first scan `objects` are expected anywhere in the start of the motion, `births` a second appear later, and
    each stays for `lifetime` s in the mean. `most` tracks are followed at a time; reported are those whose existence
    reaches `confirmed` and which hold two detections. `sensors` are the names of those that are heeded, all by default.
    Association is by belief propagation (Williams, Lau 2014; Williams 2015). Raises `InputError` where every row names
    its target, or the motion has no linear form.
    """
    if not 0 < confirmed <= 1:
        raise InputError(f"track_objects(confirmed={confirmed!r}): give a probability of existence above 0, up to 1")
    own, watch, views, known, chances, cloud = asked(
        "track_objects", problem, z, covariance,
        objects=objects, births=births, lifetime=lifetime, most=most, sensors=sensors,
    )  # fmt: skip
    found = filter_tracks(watch, views, known, chances, cloud, most)
    own_rows = np.flatnonzero(problem.measurements.detection)
    return _listed(jax.device_get(found), np.asarray(watch.scans.number), own_rows, own, confirmed)


def _listed(found: Step, slots: np.ndarray, rows: np.ndarray, problem: Problem, confirmed: float) -> Objects:
    """Tables of the tracks that were confirmed; `rows` are those of the whole table."""
    shares, fresh = np.asarray(found.shares), np.asarray(found.fresh)
    number = np.concatenate([np.broadcast_to(found.number[:, :, None], shares.shape).ravel(), np.ravel(found.first)])
    slot = np.concatenate([np.broadcast_to(slots[:, None], shares.shape).ravel(), slots.ravel()])
    weight = np.concatenate([shares.ravel(), fresh.ravel()])
    there = (number >= 0) & (slot >= 0) & (weight > 0)
    number, slot, weight = number[there], slot[there], weight[there]
    after = found.after
    best = {int(k): float(after.existence[after.number == k].max()) for k in np.unique(after.number) if k >= 0}
    held = pd.Series(weight).groupby(number).sum()
    names = [k for k in sorted(best) if best[k] >= confirmed and held.get(k, 0.0) >= 2.0]
    called = {k: f"track_{i}" for i, k in enumerate(names)}
    listed = np.isin(number, names) & (weight >= LEAST)
    table = pd.DataFrame(
        {"row": rows[slot[listed]], "track": [called[k] for k in number[listed]], "weight": weight[listed]}
    ).sort_values(["row", "track"], ignore_index=True)
    over = table.groupby("row")["weight"].transform("sum").clip(lower=1.0)
    table["weight"] /= over
    k, t = np.nonzero(np.isin(after.number, names) & (after.existence >= LEAST))
    scans = problem.scans
    assert scans is not None
    label = [called[int(i)] for i in after.number[k, t]]
    path = pd.DataFrame({"time": scans.time[k], "track": label, "existence": after.existence[k, t]})
    mean, covariance = np.asarray(after.mean)[k, t], np.asarray(after.covariance)[k, t]
    sd = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0))
    for j, component in enumerate(problem.epochs[0].components):
        path[component], path[f"{component}_sd"] = mean[:, j], sd[:, j]
    return Objects(table, path.sort_values(["track", "time"], kind="stable", ignore_index=True))
