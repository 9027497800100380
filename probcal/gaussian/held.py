"""The information about the biases from trajectories eliminated at held ones: nothing of size (M, M) or (E, n, M)."""

from typing import Any

import jax
import numpy as np

from probcal.gaussian.jointly import follow_biases, times_weights
from probcal.gaussian.mode import Eliminated, Point, eliminate_rows
from probcal.model.model import Model
from probcal.model.rows import LinearRows

TOGETHER = 40_000_000  # numbers (320 MB) that rows make of the columns of biases that they are asked about together


@jax.jit
def hold(model: Model, point: Point, rows: LinearRows) -> Eliminated:
    """The trajectories eliminated at held biases."""
    return eliminate_rows(model, point, rows, joint=False)


def inform(model: Model, rows: LinearRows, held: Eliminated, z: Any) -> np.ndarray:
    """Information about the biases times z (M, K): the rows' own, less what the tracks take up."""
    z, read = np.asarray(z), sum(lin.state.size + lin.bias.size for lin in rows)
    width = max(1, TOGETHER // max(read, 1))
    if z.shape[1] <= width:
        return np.asarray(_inform(model, rows, held, z))
    padded = np.pad(z, ((0, 0), (0, -z.shape[1] % width)))  # one shape, one kernel
    parts = [_inform(model, rows, held, own) for own in np.split(padded, padded.shape[1] // width, axis=1)]
    return np.concatenate(parts, 1)[:, : z.shape[1]]


@jax.jit
def _inform(model: Model, rows: LinearRows, held: Eliminated, z: jax.Array) -> jax.Array:
    moved = follow_biases(model, rows, tuple(kept.gain for kept in held.parts), z)
    along = model.responses(rows, [own.states for own in moved], z)
    found = model.onto_biases(rows, times_weights(model, rows, along))
    return found if model.tilt is None else found + model.tilt.times(z)
