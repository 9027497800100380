"""The mode of the marginal density of the biases, as in `marginal`, where only the sparse form fits.

The step is that of the joint precision of states and biases, solved by one sparse factor, and what the secants of the
last steps say of log det W (L-BFGS around it); tracks are settled by their recursion, which also gives log det W.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal.gaussian import recursion as rec
from probcal.gaussian.cholesky import Factor
from probcal.gaussian.joint import JointPrecision
from probcal.gaussian.linearised import linearise_rows
from probcal.gaussian.marginal import ENOUGH, HALVINGS, LEAST_CURVED, SETTLED, TRACK_STEPS, volume_slope
from probcal.gaussian.mode import Eliminated, Point, cost, eliminate, eliminate_rows, factors, follow
from probcal.model.model import Model
from probcal.model.rows import Linearised
from probcal.priors import Precision

KEPT = 8  # secants
COLUMNS = 256  # of a root of the covariance at once
SMALL = 1e-9  # of the density: what a step that promises less cannot show


@dataclass(frozen=True, eq=False)
class SparseSystem:
    """A problem linearised at a point whose tracks are settled, as a sparse system.

    `pull` (M,) is the slope of the marginal log-likelihood there, log det W with it.
    """

    point: Point
    joint: JointPrecision
    rows: tuple[Linearised, ...]
    solved: Eliminated  # of the tracks at held biases
    entries: np.ndarray  # of the joint precision, the biases without prior
    density: float  # log density of data and whitened noises, less 1/2 log det W
    pull: np.ndarray

    def factor(self, alpha: np.ndarray) -> Factor:
        """The joint precision with prior precisions alpha (M,), factorised."""
        return self.joint.factor(self.entries, alpha)

    def moved(self, model: Model, dz: np.ndarray) -> Point:
        """The point with other biases, every track following."""
        return _followed(model, self.point, self.rows, self.solved, jnp.asarray(dz))

    def information(self, model: Model, z: jax.Array) -> jax.Array:
        """Information of the data about the biases, trajectories marginalised, times z (M,)."""
        return _informed(model, self.rows, self.solved, z)


def system_at(model: Model, joint: JointPrecision, point: Point) -> SparseSystem:
    """The system at a point, its tracks settled first."""
    point = settle_each(model, point)
    rows = linearise_rows(model, point)
    solved, slope, density = _held(model, point, rows)
    volume, _ = volume_slope(model, point, solved)
    return SparseSystem(
        point, joint, rows, solved, joint.values(model, rows, point.levels), float(density),
        np.asarray(slope - 0.5 * volume),
    )  # fmt: skip


@jax.jit
def settle_each(model: Model, point: Point) -> Point:
    """Every track at its mode for the biases, each with a step length of its own: none waits for another.

    A track that no part of a step improves stays where it is: on a cusp, where it grazes a sensor.
    """

    def costs(at: Point) -> list[jax.Array]:
        """Negative log density (T,) of the tracks of each recursion."""
        sums = model.by_epoch(model.log_likelihood(at))
        return [
            jax.ops.segment_sum(0.5 * jnp.sum(u**2, 1) - own, part.target, count)
            for own, u, part, count in zip(sums, at.noises, model.recursions, model.targets, strict=True)
        ]

    def part_way(at: Point, full: Point, shares: list[jax.Array]) -> Point:
        def go(old: tuple[jax.Array, ...], new: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
            parts = zip(old, new, model.recursions, shares, strict=True)
            return tuple(a + share[part.target][:, None] * (b - a) for a, b, part, share in parts)

        return at._replace(states=go(at.states, full.states), noises=go(at.noises, full.noises))

    def body(carry: Any) -> Any:
        at, before, _, count = carry
        solved = eliminate(model, at, expected=False, joint=False)
        full = follow(model, at, solved, jnp.zeros_like(at.z))

        def shorter(state: Any) -> Any:
            shares, after, tries = state
            shares = [jnp.where(new <= old, s, 0.5 * s) for s, new, old in zip(shares, after, before, strict=True)]
            return shares, costs(part_way(at, full, shares)), tries + 1

        def worse(state: Any) -> jax.Array:
            some = [jnp.any(~(new <= old)) for new, old in zip(state[1], before, strict=True)]
            return (state[2] < HALVINGS) & jnp.any(jnp.stack(some))

        whole = [jnp.ones(count) for count in model.targets]
        shares, after, _ = jax.lax.while_loop(worse, shorter, (whole, costs(full), 0))
        shares = [jnp.where(new <= old, s, 0.0) for s, new, old in zip(shares, after, before, strict=True)]
        after = [jnp.where(new <= old, new, old) for new, old in zip(after, before, strict=True)]
        gain = jnp.max(jnp.stack([jnp.max(old - new) for new, old in zip(after, before, strict=True)]))
        return part_way(at, full, shares), after, gain, count + 1

    first = (point, costs(point), jnp.full((), jnp.inf), 0)
    return jax.lax.while_loop(lambda c: (c[2] > SETTLED) & (c[3] < TRACK_STEPS), body, first)[0]


@jax.jit
def _held(model: Model, point: Point, rows: tuple[Linearised, ...]) -> tuple[Eliminated, jax.Array, jax.Array]:
    """Tracks eliminated at held biases, slope (M,) of the log-likelihood by these, and the marginal log density."""
    solved = eliminate_rows(model, point, rows, joint=False)
    g = jnp.zeros(model.biases + 1)
    for data, lin in zip(model.rows, rows, strict=True):
        own = jax.ops.segment_sum(jnp.einsum("ncp,nc->np", lin.bias, lin.score), data.sensor, data.bias.shape[0])
        g = g.at[data.bias].add(own)
    flat = Precision.single(jnp.zeros_like(point.z))
    return solved, g[: model.biases], -cost(model, point, flat) - 0.5 * solved.logdet


@jax.jit
def _followed(model: Model, point: Point, rows: tuple[Linearised, ...], solved: Eliminated, dz: jax.Array) -> Point:
    """Tracks at their smoothed response to a step of the biases, by columns of the rows: no (E, n, M) is made."""
    bent = model.by_bias(rows, dz[:, None])
    columns = model.onto_states(rows, tuple(-lin.weight[:, :, None] * own for lin, own in zip(rows, bent, strict=True)))
    states, noises = [], []
    for part, kept, x, u, column in zip(
        model.recursions, solved.parts, point.states, point.noises, columns, strict=True
    ):
        L = factors(part, point.levels)
        smooth = rec.smooth(part.F, kept.gain, kept.pull[:, :, None] + column, -(L @ u[:, :, None]))
        states.append(x + smooth.states[:, :, 0])
        noises.append(smooth.noises[:, :, 0])
    return point._replace(states=tuple(states), noises=tuple(noises), z=point.z + dz)


@jax.jit
def _informed(model: Model, rows: tuple[Linearised, ...], solved: Eliminated, z: jax.Array) -> jax.Array:
    """Information about the biases times z (M,): the rows' own, less what the tracks take up."""
    bent = model.by_bias(rows, z[:, None])
    columns = model.onto_states(rows, tuple(-lin.weight[:, :, None] * own for lin, own in zip(rows, bent, strict=True)))
    parts = zip(model.recursions, solved.parts, columns, strict=True)
    states = [rec.smooth(part.F, kept.gain, column).states for part, kept, column in parts]
    g = jnp.zeros(model.biases + 1)
    for data, lin, own in zip(model.rows, rows, model.responses(rows, states, z[:, None]), strict=True):
        moved = jnp.einsum("ncp,nc->np", lin.bias, lin.weight * own[:, :, 0])
        g = g.at[data.bias].add(jax.ops.segment_sum(moved, data.sensor, data.bias.shape[0]))
    return g[: model.biases]


def settled_variances(model: Model, point: Point, root: Any) -> list[np.ndarray]:
    """Variances (E, n) of the states of each recursion at settled tracks, the biases of covariance root root' (M, R).

    What each column of the root moves is found for some columns at a time. Raises `numpy.linalg.LinAlgError` where a
    track is open.
    """
    joint = JointPrecision.of(model)
    entries = joint.values(model, linearise_rows(model, point), point.levels)
    factor, across = joint.states_alone(entries), joint.across(entries)
    variance, _ = factor.inverse_diagonal()
    for start in range(0, root.shape[1], COLUMNS):
        pulled = across @ root[:, start : start + COLUMNS]
        variance += np.sum(factor.solve(pulled if isinstance(pulled, np.ndarray) else pulled.toarray()) ** 2, 1)
    return joint.state_values(variance)


class SparseMode(NamedTuple):
    """Where the search ended: the system there, negative log marginal density with prior, and how it went."""

    system: SparseSystem
    factor: Factor
    value: float
    trace: np.ndarray  # minus that after every step
    converged: bool
    refused: bool  # no step raised the density, though one promised to


def find_sparse_mode(
    model: Model, joint: JointPrecision, start: Point, alpha: np.ndarray, iterations: int, tolerance: float,
    told: Callable[[int, float], bool] | None = None,
) -> SparseMode:  # fmt: skip
    """Climb to the mode of the marginal density under precisions alpha (M,) until a step promises less than tolerance.

    A step that does not bring its share of what it promises is halved. It ends where `told`, called
    with the number of steps and the density, says so. Raises `numpy.linalg.LinAlgError` where the
    precision is not positive definite: a flat prior on what no data tell.
    """

    def looked(point: Point) -> tuple[SparseSystem, float]:
        system = system_at(model, joint, point)
        z = np.asarray(system.point.z)
        return system, 0.5 * float(z @ (alpha * z)) - system.density

    here, value = looked(start)
    secants: list[tuple[np.ndarray, np.ndarray]] = []
    trace, converged, ended = [-value], False, False
    while True:
        factor = here.factor(alpha)
        slope = here.pull - alpha * np.asarray(here.point.z)
        step = _direction(factor, joint, slope, secants)
        promised = 0.5 * float(slope @ step)
        converged = promised <= max(tolerance, SMALL * 1e-3 * abs(value)) and np.isfinite(value)
        if converged or ended or len(trace) > iterations or not np.isfinite(value):
            break
        share, better = 1.0, False
        for _ in range(HALVINGS):
            there, after = looked(here.moved(model, share * step))
            better = bool(value - after >= ENOUGH * share * promised and after <= value)
            if better:
                break
            share *= 0.5
        if not better:
            converged = promised <= SMALL * abs(value)
            break
        moved = np.asarray(there.point.z) - np.asarray(here.point.z)
        change = slope - (there.pull - alpha * np.asarray(there.point.z))
        if moved @ change > LEAST_CURVED * share * (moved @ slope):
            secants = [*secants, (moved, change)][-KEPT:]
        here, value = there, after
        trace.append(-value)
        ended = told is not None and told(len(trace) - 1, -value)
    return SparseMode(here, factor, value, np.array(trace), converged, not converged and len(trace) == 1)


def _direction(
    factor: Factor, joint: JointPrecision, slope: np.ndarray, secants: list[tuple[np.ndarray, np.ndarray]]
) -> np.ndarray:
    """The step of L-BFGS around an inverse curvature (Nocedal, Wright 2006, algorithm 7.4)."""
    q, parts = slope.copy(), []
    for moved, change in reversed(secants):
        scale = 1.0 / (moved @ change)
        share = scale * (moved @ q)
        q = q - share * change
        parts.append((moved, change, scale, share))
    step = factor.solve(joint.of_biases(q))[joint.states :]
    for moved, change, scale, share in reversed(parts):
        step = step + moved * (share - scale * (change @ step))
    return step
