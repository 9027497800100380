"""The scans of a model of one object, stacked: how its state reaches each, its rows padded, what its sensor sees."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal.model.epochs import Epoch, Move, Seen, padded_rows
from probcal.model.model import Model
from probcal.model.rows import look
from probcal.problem import Problem
from probcal.scans import detection_limits


class Scan(NamedTuple):
    """One scan, or K of them stacked: F, L, drift from the scan before, the rows of each block, and its sensor."""

    epoch: Epoch
    elapsed: jax.Array  # () s since the scan before
    block: jax.Array  # () of the rows
    probability: jax.Array  # () of detection in view
    clutter: jax.Array  # () mean number of false detections
    density: jax.Array  # (D,) of one of them that has the channels of a slot, in their units
    view: jax.Array  # () which of the views
    number: jax.Array  # (D,) row of the table behind each slot of all blocks, -1 of none


class Watch(NamedTuple):
    """The inputs of a tracker: the model of one object, its scans and its start."""

    model: Model
    scans: Scan
    mean: jax.Array  # (n,) of the start
    root: jax.Array  # (n, n)


View = Callable[[Any, Any], Any] | None


def watch_of(problem: Problem) -> tuple[Watch, tuple[View, ...]]:
    """Scans of a problem's detections in time order, and the different views of its sensors."""
    own = alone(problem)
    model, data, scans = own.model, own.measurements, own.scans
    assert scans is not None
    limits, network = detection_limits(own.network, data), own.network
    K, part, part_time = len(scans), model.recursions[0], np.asarray(model.recursions[0].time)
    places = np.minimum(np.searchsorted(part_time, scans.time), len(part_time) - 1)  # a static motion has one epoch
    fresh = np.r_[True, np.diff(scans.time) > 0]
    n = part.drift.shape[1]
    F, L, drift = (np.asarray(a)[places] for a in (part.F, part.L, part.drift))
    still = ~fresh | (places == 0)  # at the time of the scan before, or nothing before
    F, L = np.where(still[:, None, None], np.eye(n), F), np.where(still[:, None, None], 0.0, L)
    drift = np.where(still[:, None], 0.0, drift)
    move = Move(*jax.device_put((F, L, np.asarray(part.level)[places], drift)))
    views = tuple(dict.fromkeys(s.detection.view for s in network.sensors if s.detection is not None))
    kinds = [network.types.index(s.type) for s in network.sensors]
    of_type = {network.types.index(block.type): b for b, block in enumerate(model.blocks)}
    told = [network.sensors[s].detection for s in scans.sensor]
    numbers, rows, density = [], [], []
    for block, data_, _, index, names in model.each_block(own.row_index, own.columns):
        of = scans.of_row[index]
        size = int(np.bincount(of, minlength=K).max())
        rows.append(padded_rows(data_, of, K, size, data_, block))
        numbers.append(_slots(of, index, K, size))
        width = np.diff(limits[:, [data.channels.index(name) for name in names]], axis=2)[scans.sensor, :, 0]  # (K, C)
        density.append(1.0 / np.prod(np.where(np.asarray(rows[-1].mask) > 0, width[:, None], 1.0), 2))
    number = np.concatenate(numbers, 1)
    zero = np.zeros(K)
    stamped: Any = (scans.time, zero, zero.astype(bool), zero.astype(int), (zero.astype(int),), (move,), tuple(rows))
    stacked = Scan(
        Epoch(*stamped),
        *jax.device_put(
            (
                np.diff(scans.time, prepend=scans.time[0]),
                np.array([of_type[kinds[s]] for s in scans.sensor]),
                np.array([d.chance for d in told]),
                np.array([d.rate for d in told], float),
                np.concatenate(density, 1),
                np.array([views.index(d.view) for d in told]),
                number,
            )
        ),
    )
    return Watch(model, jax.device_put(stacked), part.drift[0], part.L[0]), views


def heeded(watch: Watch, kept: np.ndarray) -> Watch:
    """The same scans, those that are not kept (K,) of sensors that see nothing; shapes stay."""
    scans = watch.scans
    rows = tuple(seen._replace(mask=seen.mask * kept[:, None, None]) for seen in scans.epoch.rows)
    epoch, chance = scans.epoch._replace(rows=rows), scans.probability * kept
    return watch._replace(scans=scans._replace(epoch=epoch, probability=chance))


def alone(problem: Problem) -> Problem:
    """The problem of the detections alone, all of one object."""
    found = problem.measurements.detection
    return problem if found.all() else problem.select(found)


def _slots(of: np.ndarray, index: np.ndarray, count: int, size: int) -> np.ndarray:
    """Row of the table behind each of the `size` slots of every scan, -1 of none."""
    found = np.full((count, size), -1)
    order = np.argsort(of, kind="stable")
    taken = np.bincount(of, minlength=count)
    slot = np.arange(len(of)) - np.repeat(np.cumsum(taken) - taken, taken)
    found[of[order], slot] = index[order]
    return found


def detected(model: Model, scan: Scan, views: tuple[View, ...], x: jax.Array, z: jax.Array) -> jax.Array:
    """Probability () that the sensor of a scan detects an object at state x (n,)."""

    def through(b: int, view: View) -> jax.Array:
        if view is None:
            return jnp.ones(())
        seen = scan.epoch.rows[b]
        first = Seen(*(leaf[:1] for leaf in seen))
        data = first.rows_of(model.rows[b])
        return jnp.clip(jnp.asarray(look(model.blocks[b], data, model.vectors(0, x[None]), z, view)[0], float), 0, 1)

    pairs = [(b, view) for b in range(len(model.blocks)) for view in views]
    which = scan.block * len(views) + scan.view
    return scan.probability * jax.lax.switch(which, [lambda b=b, v=v: through(b, v) for b, v in pairs])


def present(scan: Scan) -> jax.Array:
    """The mask (D,) of the slots that hold a detection."""
    return jnp.concatenate([jnp.any(seen.mask > 0, 1) for seen in scan.epoch.rows])
