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
from probcal.gaussian.linearised import linearise_rows
from probcal.gaussian.mode import Point
from probcal.linalg import orthogonalise, spectrum
from probcal.model import variants
from probcal.model.model import Model
from probcal.model.motions import by_component, linear_of
from probcal.model.rows import LinearRows
from probcal.model.trajectories import States
from probcal.motion import Known, as_motion
from probcal.problem import Problem

NULL = 1e-10  # share of information left below which a direction is a gauge
CLOSE = 1e-6  # the same of a direction that is given, and may lie near one
HELD = 1e30  # precision of a state that is known
ENOUGH = 0.5  # share of the data in epochs with more data than unknowns from which on a gauge can be counted


class Within(NamedTuple):
    """Combinations (M, k) of the biases with the states of every epoch free."""

    left: jax.Array  # (k, k) information about them
    known: jax.Array  # (k,) the same with the states known
    ranks: States  # (E,) unknowns that the data of an epoch fix


class Gauge(NamedTuple):
    """The gauge directions of a problem at a point."""

    basis: np.ndarray  # (M, k) in z, orthonormal
    countable: bool  # whether enough epochs have more data than unknowns


@jax.jit
def within(model: Model, lins: LinearRows, hold: States, basis: jax.Array) -> Within:
    """Information about combinations with free states, from the residuals of rows: no cancellation."""
    own = model.by_bias(lins, basis)
    pulled = tuple(lin.weight[:, :, None] * row for lin, row in zip(lins, own, strict=True))
    left, known, moved, ranks = jnp.zeros((basis.shape[1],) * 2), jnp.zeros(basis.shape[1]), [], []
    for (J, _), column, precision in zip(model.of_states(lins), model.onto_states(lins, pulled), hold, strict=True):
        root = linalg.semi_cholesky(J + jax.vmap(jnp.diag)(precision))
        ranks.append(jnp.sum((jnp.diagonal(root, axis1=1, axis2=2) > 0) & (precision < HELD), 1))
        x = linalg.semi_solve(root, column)
        left = left + jnp.einsum("enk,en,enl->kl", x, precision, x)
        moved.append(-x)
    for lin, alone, response in zip(lins, own, model.responses(lins, moved, basis), strict=True):
        known = known + jnp.einsum("nck,nc,nck->k", alone, lin.weight, alone)
        left = left + jnp.einsum("nck,nc,ncl->kl", response, lin.weight, response)
    return Within(left, known, tuple(ranks))


def held_states(problem: Problem) -> States:
    """Precision (E, n) of the states that are known beforehand: those of `Known` targets."""
    found = []
    for part, epochs in problem.model.each_layout(problem.epochs):
        precision, spread = np.zeros(part.drift.shape), np.asarray(jnp.sum(part.L**2, 2))
        for name, mine in epochs.members.items():
            components = linear_of(as_motion(problem.target(name).motion))
            for component, own, _ in by_component(components, problem.network.dimension):
                if isinstance(component, Known):
                    here = np.ix_(mine, np.arange(own.start, own.stop))
                    precision[here] = np.minimum(1 / np.maximum(spread[here], 1 / HELD), HELD)
        found.append(jax.device_put(precision))
    return tuple(found)


def gauge(problem: Problem, point: Point) -> Gauge:
    """Directions that no row fixes: the null space of the Jacobian of the rows with the states free at each epoch.

    Surveys count as rows. The count is exact where the epochs have more data than unknowns; where most have not,
    as with one range at a time, `countable` is False: what is fixed there hangs on the motion.
    """
    found = _within(problem, point, np.eye(problem.model.biases))
    survey = problem.surveyed.astype(float)
    known = np.asarray(found.known) + survey
    unit = 1 / np.sqrt(np.where(known > 0, known, 1.0))
    values, vectors = spectrum((np.asarray(found.left) + np.diag(survey)) * np.outer(unit, unit))
    return Gauge(orthogonalise(unit[:, None] * vectors[:, values < NULL]), _countable(problem, found.ranks))


def _within(problem: Problem, point: Point, basis: np.ndarray) -> Within:
    model = problem.model
    return within(model, linearise_rows(model, point), held_states(problem), jax.device_put(basis))


def unfixed(problem: Problem, point: Point, vectors: np.ndarray) -> np.ndarray:
    """A mask (k,) of combinations (M, k) that no row fixes, each alone: for biases too many for
    `gauge`."""
    found = _within(problem, point, vectors)
    survey = (problem.surveyed[:, None] * vectors**2).sum(0)
    left, known = np.diagonal(np.asarray(found.left)) + survey, np.asarray(found.known) + survey
    return (left < CLOSE * np.maximum(known, np.finfo(float).tiny)) & _countable(problem, found.ranks)


def _countable(problem: Problem, ranks: Sequence[jax.Array]) -> bool:
    """True if at least half of the data stand in epochs with more data than unknowns."""
    inside = total = 0.0
    counts = variants.counts(problem.model, lambda mask: mask.sum(1))
    for count, rank in zip(counts, ranks, strict=True):
        inside += count[count > np.asarray(rank)].sum()
        total += count.sum()
    return inside >= ENOUGH * total
