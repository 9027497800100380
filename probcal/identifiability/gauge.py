"""Gauge directions: combinations of biases that no row can tell where the state of every epoch is free.

The rule of rank is free of scales: a direction is a gauge where freeing the states leaves less than `NULL` of the
information that known states would give about it.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal import linalg
from probcal.gaussian.mode import Point, compress
from probcal.linalg import orthogonalise, spectrum
from probcal.model import variants
from probcal.model.model import Model
from probcal.motion import Known, as_motion
from probcal.problem import Problem

NULL = 1e-10  # share of information left below which a direction is a gauge
CLOSE = 1e-6  # share below which a direction is looked at again, without cancellation
HELD = 1e30  # precision of a state that is known
ENOUGH = 0.5  # share of the data in epochs with more data than unknowns from which on a gauge can be counted


class FreeStates(NamedTuple):
    """Information (M, M) of the biases with the states of every epoch free, and with them known; ranks by epoch."""

    information: jax.Array
    known: jax.Array
    ranks: tuple[jax.Array, ...]  # (E,) unknowns that the data of an epoch fix


class Gauge(NamedTuple):
    """The gauge directions of a problem at a point."""

    basis: np.ndarray  # (M, k) in z, orthonormal
    countable: bool  # whether enough epochs have more data than unknowns


@jax.jit
def free_states(model: Model, point: Point, hold: tuple[jax.Array, ...]) -> FreeStates:
    """Information about the biases with the state of every epoch free but for the precisions `hold` (E, n)."""
    lins = model.linearise(point, expected=True)
    compressed = compress(model, lins)
    known = information = compressed.information
    ranks = []
    for _, (J, _), cross, precision in model.each_layout(compressed.states, compressed.crosses, hold):
        root = linalg.semi_cholesky(J + jax.vmap(jnp.diag)(precision))
        flat = linalg.forward(root, cross).reshape(-1, cross.shape[2])
        information = information - linalg.gram(flat)
        ranks.append(jnp.sum((jnp.diagonal(root, axis1=1, axis2=2) > 0) & (precision < HELD), 1))
    return FreeStates(information, known, tuple(ranks))


@jax.jit
def within(model: Model, point: Point, hold: tuple[jax.Array, ...], basis: jax.Array) -> jax.Array:
    """Information (k, k) of combinations (M, k) with free states, from the residuals of rows: no cancellation."""
    lins = model.linearise(point, expected=True)
    pulled = tuple(lin.weight[:, :, None] * own for lin, own in zip(lins, model.by_bias(lins, basis), strict=True))
    moved = [
        linalg.semi_solve(J + jax.vmap(jnp.diag)(precision), column)
        for (J, _), column, precision in zip(model.of_states(lins), model.onto_states(lins, pulled), hold, strict=True)
    ]
    total = jnp.zeros((basis.shape[1], basis.shape[1]))
    for lin, left in zip(lins, model.responses(lins, [-x for x in moved], basis), strict=True):
        total = total + jnp.einsum("nck,nc,ncl->kl", left, lin.weight, left)
    for x, precision in zip(moved, hold, strict=True):
        total = total + jnp.einsum("enk,en,enl->kl", x, precision, x)
    return total


def held_states(problem: Problem) -> tuple[jax.Array, ...]:
    """Precision (E, n) of the states that are known beforehand: those of `Known` targets."""
    found = []
    for part, epochs in problem.model.each_layout(problem.epochs):
        precision = np.zeros(part.drift.shape)
        spread = np.asarray(jnp.sum(part.L**2, 2))
        for name in dict.fromkeys(epochs.target):
            mine = epochs.target == name
            row = 0
            linear, _ = as_motion(problem.target(str(name)).motion).split
            for component in () if linear is None else linear.components:
                d = problem.network.dimension
                size = sum(d if per_axis else 1 for _, per_axis in component.names())
                if isinstance(component, Known):
                    here = np.ix_(mine, np.arange(row, row + size))
                    precision[here] = np.minimum(1 / np.maximum(spread[here], 1 / HELD), HELD)
                row += size
        found.append(jnp.asarray(precision))
    return tuple(found)


def gauge(problem: Problem, point: Point) -> Gauge:
    """Directions that no row fixes: the null space of the Jacobian of the rows with the states free at each epoch.

    Surveys count as rows. The count is exact where the epochs have more data than unknowns; where most have not,
    as with one range at a time, `countable` is False: what is fixed there hangs on the motion.
    """
    model, hold = problem.model, held_states(problem)
    free = free_states(model, point, hold)
    survey = problem.surveyed.astype(float)
    information = np.asarray(free.information) + np.diag(survey)
    alone = np.diag(np.asarray(free.known)) + survey
    unit = 1 / np.sqrt(np.where(alone > 0, alone, 1.0))
    values, vectors = spectrum(information * np.outer(unit, unit))
    near = unit[:, None] * vectors[:, values < CLOSE]
    exact = np.asarray(within(model, point, hold, jnp.asarray(near))) + near.T @ (survey[:, None] * near)
    values, turned = spectrum(0.5 * (exact + exact.T))
    return Gauge(orthogonalise(near @ turned[:, values < NULL]), _countable(problem, free.ranks))


@jax.jit
def beside_free_states(
    model: Model, point: Point, hold: tuple[jax.Array, ...], basis: jax.Array
) -> tuple[jax.Array, tuple[jax.Array, ...]]:
    """Information (k,) of combinations (M, k) with the states known, and the ranks of `FreeStates`."""
    lins = model.linearise(point, expected=True)
    known = jnp.zeros(basis.shape[1])
    for lin, own in zip(lins, model.by_bias(lins, basis), strict=True):
        known = known + jnp.einsum("nck,nc,nck->k", own, lin.weight, own)
    ranks = []
    for (J, _), precision in zip(model.of_states(lins), hold, strict=True):
        root = linalg.semi_cholesky(J + jax.vmap(jnp.diag)(precision))
        ranks.append(jnp.sum((jnp.diagonal(root, axis1=1, axis2=2) > 0) & (precision < HELD), 1))
    return known, tuple(ranks)


def unfixed(problem: Problem, point: Point, vectors: np.ndarray) -> np.ndarray:
    """Which of some combinations (M, k) no row fixes: each by itself, where the biases are too many for `gauge`."""
    hold, basis = held_states(problem), jnp.asarray(vectors)
    known, ranks = beside_free_states(problem.model, point, hold, basis)
    survey = (problem.surveyed[:, None] * vectors**2).sum(0)
    left = np.diagonal(np.asarray(within(problem.model, point, hold, basis))) + survey
    share = left / np.maximum(np.asarray(known) + survey, np.finfo(float).tiny)
    return (share < CLOSE) & _countable(problem, ranks)


def _countable(problem: Problem, ranks: Sequence[jax.Array]) -> bool:
    """Whether at least half of the data stand in epochs with more data than unknowns."""
    inside = total = 0.0
    counts = variants.counts(problem.model, lambda mask: mask.sum(1))
    for count, rank in zip(counts, ranks, strict=True):
        inside += count[count > np.asarray(rank)].sum()
        total += count.sum()
    return inside >= ENOUGH * total
