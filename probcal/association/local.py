"""Each sensor by itself: its own scans, and what a filter that heeds no other sensor knows after each of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from probcal.association.scan import Scan, View, Watch, alone, watch_of
from probcal.model.epochs import Move
from probcal.model.motions import Levels, chain
from probcal.problem import Problem
from probcal.table import OBJECT


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
        """What sensors share that one compiled kernel serves."""
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
    """The watch with a model that holds one row and one epoch: scans bring their own."""
    model = watch.model
    rows = [
        data._replace(**{k: getattr(data, k)[:1] for k in ("epoch", "sensor", "pose", "y", "mask", "std", "level")})
        for data in model.rows
    ]
    parts = [jax.tree.map(lambda leaf: leaf[:1], part) for part in model.recursions]
    return watch._replace(model=replace(model, rows=tuple(rows), recursions=tuple(parts)))


def _padded(one: Alone, K: int, D: int) -> Alone:
    """The same scans and `K` in all, those added without rows, of `D` slots each."""
    scans = one.watch.scans
    own, slots = scans.number.shape
    more, wide = K - own, D - slots

    def last(leaf: jax.Array) -> jax.Array:
        return jnp.concatenate([leaf, jnp.repeat(leaf[-1:], more, 0)])

    def none(leaf: jax.Array) -> jax.Array:
        return last(leaf).at[own:].set(0)

    def slot(leaf: jax.Array) -> jax.Array:
        return jnp.concatenate([leaf, jnp.repeat(leaf[:, :1], wide, 1)], 1)

    rows = []
    for seen in scans.epoch.rows:
        wider = jax.tree.map(lambda leaf: last(slot(leaf)), seen)
        rows.append(wider._replace(mask=wider.mask.at[:, slots:].set(0.0).at[own:].set(0.0)))
    n = len(one.watch.mean)
    epoch = jax.tree.map(last, scans.epoch._replace(rows=()))
    move = epoch.move[0]
    start = scans.epoch.move[0]
    still = Move(move.F.at[own:].set(jnp.eye(n)), none(start.L), move.level, none(start.drift))
    padded = Scan(
        epoch._replace(rows=tuple(rows), move=(still,)), none(scans.elapsed), last(scans.block),
        none(scans.probability), none(scans.clutter), last(scans.density), last(scans.view),
        jnp.pad(scans.number, ((0, more), (0, wide)), constant_values=-1),
    )  # fmt: skip
    time = np.concatenate([one.time, np.full(more, one.time[-1])])
    return replace(one, watch=one.watch._replace(scans=padded), time=time, there=np.arange(K) < own)


def stacked(sensors: Sequence[Alone]) -> Watch:
    """Watches of one form with a leading axis of sensors."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *[one.watch for one in sensors])


def carried(problem: Problem, dt: np.ndarray) -> Move:
    """How the state of an object gets on by each of the times dt (K,) in s, unknown levels at their first guess."""
    target = problem.target(OBJECT)
    F, L, level, drift = chain("object", target, np.cumsum(dt), Levels(), 0.0, problem.area)
    still = np.flatnonzero(dt == 0)
    F[still], L[still], drift[still] = np.eye(F.shape[1]), 0.0, 0.0
    return Move(*jax.device_put((F, L, level, drift)))
