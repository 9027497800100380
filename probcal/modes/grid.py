"""A track found on a grid from the data alone, at given biases: without truth and without a hand-made guess.

Every target is placed on a grid of candidate positions; for each epoch and candidate the other state
components (power, emission range, ...) are profiled out, and the noise is widened by the prior spread of the
biases. The best path through the grid (Viterbi, over windows of epochs) is then smoothed by the motion model
into a consistent trajectory.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from probcal import linalg
from probcal.gaussian import recursion as rec
from probcal.gaussian.mode import Point, apart, factors, gains_of, smooth_tracks
from probcal.gaussian.search import quiet
from probcal.geometry import lattice
from probcal.model import variants
from probcal.model.model import At, Model, Recursion
from probcal.model.rows import Linearised
from probcal.model.trajectories import Trajectories
from probcal.problem import Problem

WINDOWS = 60  # at most so many windows a target
INNER = {2: 24, 3: 10}  # grid points an axis inside the network
OUTER = {2: 48, 3: 60}  # directions of the outer rings
RINGS = (0.8, 1.2, 1.8, 2.8, 5.0, 9.0)  # their radii in extents
CLOSE = 1e6  # precision of every state component at which a trajectory follows given states
NEAR = 0.05  # error of a position found on the grid, in extents
WINDOW_ROWS = 60  # rows of a window that are looked at, where there are more
BEAM = 200  # candidates a window that the path may pass
KINEMATIC = {"position", "velocity", "acceleration"}  # components that a path fixes
ROBUST = 4.0  # degrees of freedom of the start's Student-t loss


def candidates(problem: Problem) -> np.ndarray:
    """Candidate positions, shape (candidates, d): a grid over the network and rings around it."""
    nodes, d, extent = problem.node_positions, problem.network.dimension, problem.extent
    low, high = nodes.min(0), nodes.max(0)
    margin = 0.3 * np.linalg.norm(high - low) + 0.02 * extent
    axes = [np.linspace(a - margin, b + margin, INNER[d]) for a, b in zip(low, high, strict=True)]
    k = np.arange(OUTER[d])
    if d == 2:
        angle = 2 * np.pi * k / OUTER[d]
        directions = np.stack([np.cos(angle), np.sin(angle)], -1)
    else:  # a Fibonacci sphere
        height = 1 - 2 * (k + 0.5) / OUTER[d]
        angle = np.pi * (3 - np.sqrt(5)) * k
        radius = np.sqrt(1 - height**2)
        directions = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], -1)
    rings = [nodes.mean(0) + factor * extent * directions for factor in RINGS]
    return np.concatenate([lattice(axes), *rings])


def _widened(lin: Linearised) -> Linearised:
    """The rows with the prior spread of the biases (one scale each) added to their noise."""
    factor = jnp.where(lin.weight > 0, 1.0 / (1.0 + lin.weight * jnp.sum(lin.bias**2, -1)), 0.0)
    return lin._replace(score=lin.score * factor, weight=lin.weight * factor)


def _misfit(lin: Linearised) -> jax.Array:
    """Robust misfit (N,) of every row, with the prior spread of the biases added to its noise.

    One logarithm of the product of its channels: most of the time of a start goes there.
    """
    residual = lin.score / jnp.maximum(lin.weight, 1e-300) * (lin.weight > 0)
    square = apart(_widened(lin).weight * residual**2 / ROBUST)
    whole = jnp.ones(len(square))
    for c in range(square.shape[1]):
        whole = whole * (1.0 + square[:, c])
    return jnp.where(jnp.isfinite(whole), 0.5 * (ROBUST + 1) * jnp.log(whole), 1e6)


@partial(jax.jit, static_argnames=("r", "span"))
def profile(model: Model, r: int, span: tuple[int, int], z: jax.Array, place: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Loss (E,) and states (E, n) of recursion r with the position at `place` (E, d), other components profiled."""
    part = model.recursions[r]
    n = part.drift.shape[1]
    levels = jnp.zeros(model.level_spread.shape)
    resting = jax.lax.scan(lambda x, k: ((y := k[0] @ x + k[1]), y), jnp.zeros(n), (part.F, part.drift))[1]
    states = resting.at[:, span[0] : span[1]].set(place)
    mine = variants.part(model, r)
    held = np.zeros(n, bool)
    for name, start, stop, _ in mine.blocks[0].layout if mine.blocks else ():
        held[start:stop] = name in KINEMATIC
    first = part.F[:, 0, 0] == 0
    precision = 1.0 / jnp.maximum(jnp.sum(factors(part, levels) ** 2, 2), 1e-12)
    precision = jnp.where(held[None, :], 1e12, jnp.where(first[:, None], precision, jnp.min(precision, 0)[None, :]))
    loose = jnp.asarray(np.flatnonzero(~held), int)
    for _ in range(2 if len(loose) else 0):
        A, b = jax.vmap(jnp.diag)(precision), precision * (resting - states) * ~held[None, :]
        ((J, score),) = mine.of_states(
            [_widened(lin) for lin in mine.linearise(At((states,), z, levels), expected=False)]
        )
        A, b = A + J, b + score
        step = linalg.solve_batched(A[:, loose[:, None], loose[None, :]], b[:, loose])
        states = states.at[:, loose].add(step)
    (loss,) = mine.by_epoch([_misfit(lin)[:, None] for lin in mine.linearise(At((states,), z, levels), expected=False)])
    return loss, states


def _losses(problem: Problem, r: int, z: jax.Array, places: np.ndarray) -> np.ndarray:
    """Loss of every candidate at every epoch, (candidates, E), of rows enough for a place."""
    return np.asarray(_profiled(_thinned(problem, r), r, problem.epochs[r].position, z, places))


@partial(jax.jit, static_argnames=("r", "span"))
def _profiled(model: Model, r: int, span: tuple[int, int], z: jax.Array, places: jax.Array) -> jax.Array:
    """Loss (candidates, E) with all else than the place profiled."""
    E = model.recursions[r].drift.shape[0]
    width = span[1] - span[0]
    return jax.lax.map(lambda c: profile(model, r, span, z, jnp.broadcast_to(c, (E, width)))[0], places)


def _viterbi(loss: np.ndarray, places: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Cheapest path: losses (windows, candidates), places (candidates, d), expected step between windows.

    Only the `BEAM` best candidates of each window are tried, and of these none that is by itself further above the
    best of its window than all the steps of the path through the best cost: no cheaper path passes it.
    """
    best, rows = loss.argmin(1), np.arange(len(loss))
    dearest = loss[rows, best] + _steps(np.diff(places[best], axis=0), steps).sum() * (1 + 1e-9) + 1e-9
    kept = [np.flatnonzero(mine <= most) for mine, most in zip(loss, dearest, strict=True)]
    kept = [k[np.argpartition(loss[j, k], BEAM - 1)[:BEAM]] if len(k) > BEAM else k for j, k in enumerate(kept)]
    total, back = loss[0, kept[0]], []
    for k in range(1, len(loss)):
        a, b = places[kept[k - 1]], places[kept[k]]
        through = total + _steps(b[:, None, :] - a[None, :, :], steps[k - 1])  # (to, from)
        cheapest = through.argmin(1)
        total = through[np.arange(len(b)), cheapest] + loss[k, kept[k]]
        back.append(cheapest)
    path = [int(total.argmin())]
    for cheapest in reversed(back):
        path.append(int(cheapest[path[-1]]))
    return np.array([mine[at] for mine, at in zip(kept, path[::-1], strict=True)])


def _steps(line: np.ndarray, steps: np.ndarray | float) -> np.ndarray:
    """Cost of steps (..., d) where `steps` (...) are expected."""
    return 0.5 * (line**2).sum(-1) / np.square(steps)


def _thinned(problem: Problem, r: int) -> Model:
    """The model with enough rows of every window of recursion r for a place, evenly spaced over its epochs."""
    epochs = problem.epochs[r]
    counts = variants.counts(problem.model, lambda mask: mask.any(1))[r]
    kept = np.zeros(len(counts), bool)
    for mine in epochs.members.values():
        for window in _windows(np.flatnonzero(mine)):
            stride = max(1, int(min(counts[window].sum() / WINDOW_ROWS, len(window) / 2)))
            kept[window[::stride]] = True
    return variants.of_epochs(problem.model, r, kept)


def _windows(epochs: np.ndarray) -> list[np.ndarray]:
    """Epochs of one target (E,) in windows that each get one place."""
    return np.array_split(epochs, min(WINDOWS, len(epochs)))


def _path(problem: Problem, time: np.ndarray, loss: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Positions (E, d) of one target along the cheapest path through the candidates."""
    windows = _windows(np.arange(len(time)))
    centre = np.array([time[w].mean() for w in windows])
    inside = np.stack([loss[:, w].sum(1) for w in windows])
    d = problem.network.dimension
    spacing = max(np.linalg.norm(places[INNER[d] ** axis] - places[0]) for axis in range(d))  # of the inner grid
    span = np.linalg.norm(np.ptp(problem.node_positions, axis=0)) or problem.extent
    pace = 3 * span / max(float(np.ptp(time)), 1e-9)
    path = places[_viterbi(inside, places, 1.5 * spacing + pace * np.diff(centre))]
    return np.stack([np.interp(time, centre, column) for column in path.T], -1)


def known_places(problem: Problem, r: int, span: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Mean positions (E, d) by the motion alone, and the epochs (E,) where they are better than the grid's."""
    part, place = problem.model.recursions[r], slice(*span)
    memory = np.asarray(part.F)[:, place].any((1, 2))
    std = np.linalg.norm(np.asarray(part.L)[:, place], axis=2).max(1)
    return np.array(part.drift)[:, place], ~memory & (std < NEAR * problem.extent)


@jax.jit
def _smoothed(part: Recursion, gain: rec.Gains, pull: jax.Array) -> tuple[jax.Array, jax.Array]:
    """States and whitened noises (E, n) of data compressed to a pull (E, n) on the states."""
    smooth = rec.smooth(part.F, gain, pull[:, :, None], part.drift[:, :, None])
    return smooth.states[:, :, 0], smooth.noises[:, :, 0]


def project(problem: Problem, tracks: list[np.ndarray], precision: list[np.ndarray]) -> Point:
    """Point at zero biases whose trajectories follow the entries of states (E, n) that rows read.

    These have given precisions (E, n); the motion makes the others.
    """
    levels = np.zeros(len(problem.levels))

    def consistent(
        part: Recursion, states: np.ndarray, weight: np.ndarray, used: tuple[int, ...]
    ) -> tuple[jax.Array, jax.Array]:
        gain = gains_of(part, levels, weight[:, :, None] * np.eye(weight.shape[1]), used)
        return _smoothed(part, gain, weight * states)

    read = map(problem.model.entries, range(len(tracks)))
    pairs = problem.model.each(consistent, tracks, precision, read)
    return Point(Trajectories.of(pairs), *jax.device_put((np.zeros(problem.model.biases), levels)))


def follow_states(problem: Problem, states: list[np.ndarray]) -> Point:
    """Point at zero biases whose trajectories closely follow states (E, n), in what rows read."""
    read = (np.isin(np.arange(x.shape[1]), problem.model.entries(r)) for r, x in enumerate(states))
    return project(problem, states, [np.full(x.shape, CLOSE * own) for x, own in zip(states, read, strict=True)])


@quiet
def grid_start(problem: Problem, z: Any = None, iterations: int = 30) -> Point:
    """Trajectories from the data alone at biases z (M,), as stated if None: grid, Viterbi path, motion, iterated EKS.

    A std that grows is that at the measured value: at the prediction it makes far places fit all data about as well.
    """
    z = jax.device_put(problem.first_z if z is None else z)
    problem = problem.at_measured()
    places = candidates(problem)
    tracks, precisions = [], []
    for r, epochs in enumerate(problem.epochs):
        span = epochs.position
        path, known = known_places(problem, r, span)
        unknown = [mine for mine in epochs.members.values() if not known[mine].all()]
        if unknown:
            loss = _losses(problem, r, z, places)
        for mine in unknown:
            path[mine] = _path(problem, epochs.time[mine], loss[:, mine], places)
        if {name for name, *_ in epochs.layout} <= KINEMATIC:
            states = np.pad(path, ((0, 0), (span[0], problem.model.recursions[r].drift.shape[1] - span[1])))
        else:
            states = np.array(profile(problem.model, r, span, z, path)[1])
        spread = np.sum(np.asarray(problem.model.recursions[r].L) ** 2, 2)
        precision = np.where(spread > 0, 1e4 / np.maximum(spread, 1e-300), 1e-9)
        for name, start, stop, _ in epochs.layout:
            if name == "position":
                precision[:, start:stop] = 1.0 / (NEAR * problem.extent) ** 2
            elif name in ("velocity", "acceleration"):
                precision[:, start:stop] = 0.0
        precision[epochs.target == ""] = 0.0  # behind the last epoch a target stays
        tracks.append(states)
        precisions.append(precision)
    return track_mode(problem, project(problem, tracks, precisions)._replace(z=z), iterations)


def track_mode(problem: Problem, point: Point, iterations: int = 100) -> Point:
    """Trajectories at held biases: iterated EKS from a point."""
    return smooth_tracks(problem.model, point, iterations)
