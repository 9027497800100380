"""Moments at a point where the rows are linearised and trajectories eliminated: functions that can be traced.

Rows carry the expected information. Given the biases each trajectory is Gaussian; with the trajectories marginalised
so are the biases, `Eliminated`, and what a prior makes of these is solved by `Dense` (Schur complement).
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp

from probcal import linalg
from probcal.gaussian import recursion as rec
from probcal.gaussian.mode import (
    Eliminated,
    Point,
    eliminate,
    factors,
    log_density,
    mixing_gain,
    rows_at,
)
from probcal.gaussian.solves import Dense
from probcal.model.model import Data, Model, Where
from probcal.model.rows import Linearised, LinearRows
from probcal.model.trajectories import States
from probcal.priors import Precision


class LaplaceApproximation(NamedTuple):
    """Gaussian approximation of the posterior of z at one consistent point, trajectories marginalised."""

    information: jax.Array  # (M, M) of the data about z
    covariance: jax.Array  # (M, M) of z
    gamma: jax.Array  # (M,) 1 - alpha Sigma: 0 prior only, 1 data only
    evidence: jax.Array  # log p(data | alpha, levels), Laplace (exact on a linear-Gaussian problem)


class GivenBiases(NamedTuple):
    """Trajectories of one recursion given the biases."""

    L: jax.Array  # (E, n, n) noise factors at the levels of the point
    half: jax.Array  # (E, n, n) root of the information of the rows
    spread: jax.Array  # (E, n) variance of each whitened noise


class Trajectory(NamedTuple):
    """Trajectories of one recursion given the biases: Gaussian around a mean that follows z."""

    L: jax.Array  # (E, n, n) noise factors at the levels of the point
    half: jax.Array  # (E, n, n) root of the information of the rows
    response: jax.Array  # (E, n, M) derivative of the states by z
    driven: jax.Array  # (E, n, M) derivative of the whitened noises by z
    covariance: jax.Array  # (E, n, n) of the states given z
    spread: jax.Array  # (E, n) variance of each whitened noise given z


@jax.jit
def state_variances(trajectories: Sequence[Trajectory], covariance: jax.Array) -> States:
    """Variance (E, n) of every state of each recursion, for a covariance (M, M) of z."""
    return tuple(
        jnp.diagonal(own.covariance, axis1=1, axis2=2)
        + jnp.einsum("eni,ij,enj->en", own.response, covariance, own.response)
        for own in trajectories
    )


@jax.jit
def marginal_variances(
    model: Model, rows: Sequence[Linearised], trajectories: Sequence[Trajectory], covariance: jax.Array
) -> tuple[Data, States]:
    """Variance (N, C) of each predicted value and (E, n) of every whitened noise, for a covariance (M, M) of z."""
    alone = model.state_variance(rows, [own.covariance for own in trajectories])
    predicted = jax.tree.map(jnp.add, alone, _by_bias(model, rows, trajectories, covariance))
    return predicted, tuple(own.spread + jnp.sum(own.driven @ covariance * own.driven, 2) for own in trajectories)


@jax.jit
def leverages(
    model: Model, rows: Sequence[Linearised], trajectories: Sequence[Trajectory], covariance: jax.Array
) -> Data:
    """Leverage of every datum (N, C) of each block on the biases, trajectories marginalised.

    It is w c' Sigma c, c the derivative of the predicted value by z with the trajectory following. Those of all data
    and a rest, what the motion tells, add up to tr(Sigma G), the number of biases that are determined.
    """
    both = _by_bias(model, rows, trajectories, covariance)
    return tuple(lin.weight * own for *_, lin, own in model.each_block(rows, both))


def _by_bias(
    model: Model, rows: Sequence[Linearised], trajectories: Sequence[Trajectory], covariance: jax.Array
) -> Data:
    """Variance (N, C) of each predicted value by the biases, trajectories following."""
    root = linalg.factor_and_inverse(covariance)[0]
    return model.spread(rows, [own.response @ root for own in trajectories], root)


@jax.jit
def given_biases(model: Model, levels: jax.Array, solved: Eliminated) -> tuple[GivenBiases, ...]:
    """The trajectories of each recursion given the biases, eliminated at log levels (H,)."""
    found = []
    for part, kept in model.each_layout(solved.parts):
        L = factors(part, levels)
        spread = jnp.diagonal(rec.covariances(part.F, L, kept.gain)[1], axis1=1, axis2=2)
        found.append(GivenBiases(L, linalg.root_of(kept.J), spread))
    return tuple(found)


def linearise_rows(model: Model, point: Where) -> LinearRows:
    """All rows linearised at a point with the expected information."""
    return rows_at(model, point, True)


@jax.jit
def trajectories_of(model: Model, levels: jax.Array, solved: Eliminated) -> tuple[Trajectory, ...]:
    """Trajectories of each recursion given the biases, where they were eliminated at log levels (H,)."""
    found = []
    for part, kept in model.each_layout(solved.parts):
        L = factors(part, levels)
        half = linalg.root_of(kept.J)
        response = rec.smooth(part.F, kept.gain, kept.cross)
        states, noises = rec.covariances(part.F, L, kept.gain)
        spread = jnp.diagonal(noises, axis1=1, axis2=2)
        found.append(Trajectory(L, half, -response.states, -response.noises, states, spread))
    return tuple(found)


def laplace(model: Model, point: Point, prior: Precision) -> LaplaceApproximation:
    """Evidence and covariance with every trajectory marginalised exactly, at the mode for a prior.

    A precision of 0 is a flat prior: its density counts as one. The expected information is used throughout. Where
    process noise is not Gaussian it is the variational lower bound of the evidence (see `mixing_gain`).
    """
    return laplace_of(model, point, eliminate(model, point, expected=True), prior)


@jax.jit
def laplace_of(model: Model, point: Point, solved: Eliminated, prior: Precision) -> LaplaceApproximation:
    """Evidence and covariance at a mode, of the system eliminated there with the expected information."""
    biases = Dense.of(solved.information + prior.matrix())
    own = 0.5 * prior.log_determinant() - 0.5 * prior.square(point.z)
    spread = -0.5 * jnp.sum((point.levels / model.level_spread) ** 2)
    density = log_density(model, point) + mixing_gain(model)
    evidence = density + own + spread - 0.5 * (solved.logdet + biases.log_determinant())
    covariance = biases.covariance()
    gamma = jnp.clip(1.0 - prior.alpha * jnp.diagonal(covariance), 0.0, 1.0)
    return LaplaceApproximation(solved.information, covariance, gamma, evidence)
