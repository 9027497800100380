"""Each sensor by itself: its own scans, and what a filter that heeds no other sensor knows after each of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from probcal.model.epochs import Move, Seen
from probcal.model.motions import Levels, chain
from probcal.problem import Problem
from probcal.table import OBJECT
from probcal.tracking.scan import Scan, View, Watch, alone, watch_of


@dataclass(frozen=True, eq=False)
class Alone:
    """The scans of one sensor, padded to K scans of D slots, as if it were the only one.

    `watch` reads the model of one object with the rows of this sensor type alone; `there` (K,) marks the true scans.
    """

    name: str
    watch: Watch
    views: tuple[View, ...]
    time: np.ndarray  # (K,) in s
    there: np.ndarray  # (K,)

    @property
    def form(self) -> Any:
        """The form that sensors share if one compiled kernel serves them."""
        return jax.tree.structure(self.watch), self.views


def each_alone(problem: Problem) -> list[Alone]:
    """Every sensor that reports detections, by itself; those of one type and view are padded to one form."""
    whole = alone(problem)
    data, network = whole.measurements, whole.network
    found = []
    for s, placed in enumerate(network.sensors):
        mine = data.sensor == s
        if placed.detection is None or not mine.any():
            continue
        own = whole.select(mine)
        watch, views = watch_of(own)
        assert own.scans is not None
        found.append(Alone(placed.name, _slim(watch), views, own.scans.time, np.ones(len(own.scans), bool)))
    sizes: dict[Any, tuple[int, int]] = {}
    for one in found:
        K, D = one.watch.scans.number.shape
        old = sizes.get(one.form, (0, 0))
        sizes[one.form] = max(old[0], K), max(old[1], D)
    return [_padded(one, *sizes[one.form]) for one in found]


def _slim(watch: Watch) -> Watch:
    """The watch, on the host, with a model that holds one row and one epoch: scans bring their own."""
    model = watch.model
    rows = [
        data._replace(**{k: getattr(data, k)[:1] for k in ("epoch", "sensor", "pose", "y", "mask", "std", "level")})
        for data in jax.device_get(model.rows)
    ]
    parts = jax.tree.map(lambda leaf: leaf[:1], jax.device_get(model.recursions))
    return jax.device_get(watch._replace(model=replace(model, rows=tuple(rows), recursions=parts)))


def _padded(one: Alone, K: int, D: int) -> Alone:
    """The same scans and `K` in all, those added without rows, of `D` slots each."""
    scans = one.watch.scans
    own, slots = scans.number.shape

    def last(leaf: Any) -> Any:
        return np.concatenate([leaf, np.repeat(leaf[-1:], K - own, 0)])

    def none(leaf: Any) -> Any:
        return np.concatenate([leaf, np.zeros((K - own, *leaf.shape[1:]), leaf.dtype)])

    rows = []
    for seen in scans.epoch.rows:
        wider = [last(np.concatenate([leaf, np.repeat(leaf[:, :1], D - slots, 1)], 1)) for leaf in seen]
        mask = none(np.pad(seen.mask, ((0, 0), (0, D - slots), (0, 0))))
        rows.append(Seen(*jax.device_get(wider))._replace(mask=mask))
    (move,), n = scans.epoch.move, len(one.watch.mean)
    F: Any = np.concatenate([move.F, np.tile(np.eye(n), (K - own, 1, 1))])
    epoch = jax.tree.map(last, scans.epoch._replace(rows=(), move=()))
    still = Move(F, none(move.L), last(move.level), none(move.drift))
    density = np.pad(scans.density, ((0, 0), (0, D - slots)), constant_values=1.0)
    number: Any = np.pad(scans.number, ((0, K - own), (0, D - slots)), constant_values=-1)
    padded = Scan(
        epoch._replace(rows=tuple(rows), move=(still,)), none(scans.elapsed), last(scans.block),
        none(scans.probability), none(scans.clutter), last(density), last(scans.view), number,
    )  # fmt: skip
    time = np.concatenate([one.time, np.full(K - own, one.time[-1])])
    return replace(one, watch=one.watch._replace(scans=padded), time=time, there=np.arange(K) < own)


def carried(problem: Problem, dt: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """F, L and drift by which the state of an object gets on by times dt (K,) in s, levels at their first guess."""
    target = problem.target(OBJECT)
    F, L, _, drift = chain("object", target, np.cumsum(dt), Levels(), 0.0, problem.area)
    still = np.flatnonzero(dt == 0)
    F[still], L[still], drift[still] = np.eye(F.shape[1]), 0.0, 0.0
    return F, L, drift
