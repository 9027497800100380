"""The effect of uncalibrated biases on the tracks (thesis 3.4, figure 3.6), by simulation and to
first order."""

from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from probcal.analysis.standpoint import draw_states, on_tracks_of
from probcal.errors import InputError, nearest
from probcal.gaussian.choose import choose
from probcal.gaussian.mode import Point, smooth_tracks
from probcal.geometry import lattice
from probcal.model.model import At, Model
from probcal.model.trajectories import States
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
    units = _units(problem, values)
    grid = lattice(list(values.values()))
    if runs < 1:
        raise InputError(f"sensitivity: runs={runs}; take at least one")
    given = Truth() if truth is None else truth
    keys = jax.random.split(as_key(key), 3)
    true = on_tracks_of(problem, given, draw_states(problem, runs, keys[0]))
    starts = [follow_states(problem, [np.asarray(x[k]) for x in true]) for k in range(runs)]
    start = jax.tree.map(lambda *leaves: jnp.stack(leaves), *starts)
    spans = tuple(epochs.position for epochs in problem.epochs)
    unit = jax.random.normal(keys[1], (runs, problem.model.biases))
    spread, seeds = jnp.asarray(grid @ units), jax.random.split(keys[2], runs)
    squares = np.asarray(_errors(problem.model, spans, spread, unit, true, start, seeds))
    # mean squared position error without biases, and by the square of the std of each pattern (P,)
    model, engine, found = problem.model, choose(problem.model), list[list[float]]()
    roots = [np.zeros((model.biases, 0)), *(np.diag(own)[:, own > 0] for own in units)]
    for j in range(len(true[0])):
        states = tuple(x[j] for x in true)
        noises, levels = tuple(jnp.zeros_like(x) for x in states), jnp.zeros(model.level_spread.shape)
        at = engine.at(model, Point(states, noises, jnp.zeros(model.biases), levels))
        variances = (problem.positions(at.followed(root)) for root in roots)
        found.append([sum(float(own.sum()) for own in each) for each in variances])
    alone, *whole = np.mean(found, 0) / sum(x.shape[1] for x in true)
    gain = np.array(whole) - alone
    shape = tuple(len(v) for v in values.values())
    predicted = alone + grid**2 @ gain
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


def _units(problem: Problem, values: Mapping[str, np.ndarray]) -> np.ndarray:
    """Standard deviations of z (P, M) where the std of one pattern is 1 in the unit of its biases."""
    if not values:
        raise InputError("sensitivity: stds is empty; give label patterns with their standard deviations")
    found = np.zeros((len(values), len(problem.labels)))
    for own, (pattern, value) in zip(found, values.items(), strict=True):
        if value.ndim != 1 or not len(value) or not np.isfinite(value).all() or (value < 0).any():
            raise InputError(f'sensitivity: the stds of "{pattern}" must be a list of finite numbers, none negative')
        members = [m for m, label in enumerate(problem.labels) if fnmatchcase(label, pattern)]
        if not members:
            raise InputError(f'sensitivity: no bias is called "{pattern}"{nearest(pattern, problem.labels)}')
        if both := [problem.labels[m] for m in members if found[:, m].any()]:
            raise InputError(f'sensitivity: "{pattern}" and another pattern both match {both[0]}')
        own[members] = 1.0 / problem.scales[members]
    return found


@partial(jax.jit, static_argnames="spans")
def _errors(
    model: Model,
    spans: Spans,
    spread: jax.Array,
    unit: jax.Array,
    true: States,
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
