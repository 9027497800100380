"""How biases that nobody calibrates spoil the tracks (thesis 3.4, figure 3.6), by simulation and to first order."""

from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from probcal.analysis.standpoint import draw_states, on_tracks_of
from probcal.errors import InputError, nearest
from probcal.gaussian.linearised import compress_and_eliminate, linearise_rows, trajectories_of
from probcal.gaussian.mode import Point, smooth_tracks
from probcal.model.model import At, Model
from probcal.modes.grid import follow_states
from probcal.problem import Problem
from probcal.simulate import Key, Truth, as_key
from probcal.types import float64

ITERATIONS = 30  # of a track
BATCH = 1024  # tracks worked on at once by an accelerator; a CPU takes one after the other

Spans = tuple[tuple[int, int], ...]


@float64
def sensitivity(
    problem: Problem,
    stds: Mapping[str, Sequence[float]],
    *,
    runs: int = 50,
    key: Key = 0,
    truth: Truth | None = None,
) -> xr.Dataset:
    """RMS position error in m of tracks that take every bias as 0, over a grid of standard deviations of the biases.

    `stds` gives by label pattern (`"*.range_offset"`) the standard deviations, in the unit of the bias, from which
    the biases it matches are drawn; the others are 0. Each run draws biases and noise (and tracks from the motion,
    where `truth.tracks` has none), the same at every grid point up to the stds, at the rows of the problem's table;
    the target is tracked from its true track on.

    Variables over the grid (dims named by the patterns): `rmse` over runs and epochs, `position_rmse` of each `run`,
    and `predicted`, to first order: the covariance of the track plus its response to biases of those stds.
    Raises `InputError` for a pattern that matches no bias or one taken, and for stds that are no list of numbers.
    """
    values = {str(name): np.asarray(value, float) for name, value in stds.items()}
    spread = _spread(problem, values)
    if runs < 1:
        raise InputError(f"sensitivity: runs={runs}; take at least one")
    given = Truth() if truth is None else truth
    keys = jax.random.split(as_key(key), 3)
    true = on_tracks_of(problem, given, draw_states(problem, runs, keys[0]))
    starts = [follow_states(problem, [np.asarray(x[k]) for x in true]) for k in range(runs)]
    start = jax.tree.map(lambda *leaves: jnp.stack(leaves), *starts)
    spans = tuple(epochs.position for epochs in problem.epochs)
    unit = jax.random.normal(keys[1], (runs, problem.model.biases))
    arguments = (problem.model, spans)
    errors = _errors(*arguments, jnp.asarray(spread), unit, true, start, jax.random.split(keys[2], runs))
    alone, gain = _first_order(*arguments, true)
    shape = tuple(len(v) for v in values.values())
    squares, predicted = np.asarray(errors), np.asarray(alone) + spread**2 @ np.asarray(gain)
    dims = tuple(values)
    return xr.Dataset(
        {
            "rmse": (dims, np.sqrt(squares.mean(1)).reshape(shape)),
            "predicted": (dims, np.sqrt(predicted).reshape(shape)),
            "position_rmse": ((*dims, "run"), np.sqrt(squares).reshape(*shape, runs)),
        },
        coords={**values, "run": np.arange(runs)},
        attrs={"data": problem.measurements.table.source},
    )


def _spread(problem: Problem, values: Mapping[str, np.ndarray]) -> np.ndarray:
    """Standard deviations of z (cells, M), the last pattern running fastest."""
    if not values:
        raise InputError("sensitivity: stds is empty; give label patterns with their standard deviations")
    members: dict[str, list[int]] = {}
    taken: set[int] = set()
    for pattern, value in values.items():
        if value.ndim != 1 or not len(value) or not np.isfinite(value).all() or (value < 0).any():
            raise InputError(f'sensitivity: the stds of "{pattern}" must be a list of finite numbers, none negative')
        members[pattern] = [m for m, label in enumerate(problem.labels) if fnmatchcase(label, pattern)]
        if not members[pattern]:
            raise InputError(f'sensitivity: no bias is called "{pattern}"{nearest(pattern, problem.labels)}')
        if both := taken & set(members[pattern]):
            raise InputError(f'sensitivity: "{pattern}" and another pattern both match {problem.labels[min(both)]}')
        taken |= set(members[pattern])
    spread = np.zeros((*(len(v) for v in values.values()), len(problem.labels)))
    for axis, (pattern, value) in enumerate(values.items()):
        mine = members[pattern]
        along = value.reshape(-1, *(1,) * (len(values) - axis))
        spread[..., mine] = along / problem.scales[mine]
    return spread.reshape(-1, len(problem.labels))


@partial(jax.jit, static_argnames="spans")
def _errors(
    model: Model,
    spans: Spans,
    spread: jax.Array,
    unit: jax.Array,
    true: tuple[jax.Array, ...],
    start: Point,
    keys: jax.Array,
) -> jax.Array:
    """Mean squared position error (cells, runs) of tracks at zero biases, true ones spread[cell] * unit[run]."""
    cells, runs = spread.shape[0], unit.shape[0]

    def one(pair: jax.Array) -> jax.Array:
        cell, run = pair[0], pair[1]
        states, z = tuple(x[run] for x in true), spread[cell] * unit[run]
        measured = model.with_values(model.sample(At(states, z, start.levels[run]), keys[run]))
        found = smooth_tracks(measured, jax.tree.map(lambda leaf: leaf[run], start), ITERATIONS)
        parts = model.each_layout(found.states, states, spans)
        squares = [jnp.sum((x - true)[:, slice(*span)] ** 2) for _, x, true, span in parts]
        return jnp.sum(jnp.stack(squares)) / sum(x.shape[0] for x in states)

    pairs = jnp.stack(jnp.meshgrid(jnp.arange(cells), jnp.arange(runs), indexing="ij"), -1).reshape(-1, 2)
    together = None if jax.default_backend() == "cpu" else BATCH
    return jax.lax.map(one, pairs, batch_size=together).reshape(cells, runs)


@partial(jax.jit, static_argnames="spans")
def _first_order(model: Model, spans: Spans, true: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array]:
    """Mean squared position error without biases, and by the square of each z (M,), averaged over runs and epochs."""
    M, levels = model.biases, jnp.zeros(model.level_spread.shape)

    def one(states: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array]:
        point = Point(states, tuple(jnp.zeros_like(x) for x in states), jnp.zeros(M), levels)
        alone, gain = jnp.zeros(()), jnp.zeros(M)
        _, solved = compress_and_eliminate(model, point, linearise_rows(model, point))
        for own, (a, b) in zip(trajectories_of(model, levels, solved), spans, strict=True):
            alone = alone + jnp.sum(jnp.diagonal(own.covariance, axis1=1, axis2=2)[:, a:b])
            gain = gain + jnp.sum(own.response[:, a:b] ** 2, (0, 1))
        epochs = sum(x.shape[0] for x in states)
        return alone / epochs, gain / epochs

    alone, gain = jax.lax.map(one, true)
    return jnp.mean(alone), jnp.mean(gain, 0)
