"""Tracks of objects that nobody named, as tables: which detection is of which, and where and how surely each is."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from probcal.association.bernoulli import Biases, Chances, Step, filter_tracks
from probcal.association.scan import alone, heeded, watch_of
from probcal.errors import InputError, nearest
from probcal.lazy import Later
from probcal.problem import Problem, check_linear
from probcal.types import float64

if TYPE_CHECKING:
    import pandas as pd
else:
    pd = Later("pandas")

CLOUD = 512  # states among which that behind a first detection is looked for
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
    if problem.scans is None:
        raise InputError("track_objects: every row names its target; use fit, or track with a calibration")
    check_linear(problem)
    for name, value in (("objects", objects), ("births", births), ("lifetime", lifetime)):
        if not (isinstance(value, (int, float)) and np.isfinite(value) and value > 0):
            raise InputError(f"track_objects({name}={value!r}): give a positive number")
    if not (isinstance(most, int) and most >= 1 and 0 < confirmed <= 1):
        raise InputError("track_objects: most is a number of tracks, confirmed a probability")
    own = alone(problem)
    watch, views = watch_of(problem)
    if sensors:
        names = [placed.name for placed in problem.network.sensors]
        for name in sensors:
            if name not in names:
                raise InputError(f'track_objects: sensors names "{name}"{nearest(name, names)}')
        own_scans = own.scans
        assert own_scans is not None
        watch = heeded(watch, np.isin(np.array(names)[own_scans.sensor], list(sensors)))
    z = np.zeros(len(problem.labels)) if z is None else np.asarray(z, float)
    if z.shape != (len(problem.labels),):
        raise InputError(f"track_objects: z has shape {z.shape}, the problem {len(problem.labels)} free biases")
    covariance = np.zeros((len(z), len(z))) if covariance is None else np.asarray(covariance, float)
    from scipy.stats import norm, qmc

    n = len(np.asarray(watch.mean))
    cloud = norm.ppf(np.clip(qmc.Sobol(n, scramble=False).random(CLOUD), 1e-3, 1 - 1e-3))
    used = np.any(np.asarray(watch.root) != 0, 0)
    chances = Chances(*jax.device_put((float(objects), float(births), float(lifetime))))
    known = Biases(*jax.device_put((z, covariance, np.zeros(len(own.levels)))))
    found = filter_tracks(watch, views, known, chances, cloud * used, most)
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
