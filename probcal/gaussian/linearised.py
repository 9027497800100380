"""The problem linearised at a point: made once, asked for everything that follows from it.

Rows carry the expected information. Given the biases each trajectory is Gaussian; with the trajectories marginalised
so are the biases, `Eliminated`, and what a prior makes of these is solved by `Dense` (Schur complement).
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from probcal import linalg
from probcal.gaussian import recursion as rec
from probcal.gaussian.mode import (
    Compressed,
    Eliminated,
    Point,
    compress,
    eliminate,
    eliminate_compressed,
    factors,
    log_density,
    mixing_gain,
    tilted,
)
from probcal.gaussian.solves import Dense
from probcal.model.model import Data, Model, Where
from probcal.model.rows import Linearised
from probcal.priors import Precision


class LaplaceApproximation(NamedTuple):
    """Gaussian approximation of the posterior of z at one consistent point, trajectories marginalised."""

    information: jax.Array  # (M, M) of the data about z
    covariance: jax.Array  # (M, M) of z
    gamma: jax.Array  # (M,) 1 - alpha Sigma: 0 prior only, 1 data only
    evidence: jax.Array  # log p(data | alpha, levels), Laplace (exact on a linear-Gaussian problem)


class Trajectory(NamedTuple):
    """Trajectories of one recursion given the biases: Gaussian around a mean that follows z."""

    L: jax.Array  # (E, n, n) noise factors at the levels of the point
    half: jax.Array  # (E, n, n) root of the information of the rows
    response: jax.Array  # (E, n, M) derivative of the states by z
    driven: jax.Array  # (E, n, M) derivative of the whitened noises by z
    covariance: jax.Array  # (E, n, n) of the states given z
    spread: jax.Array  # (E, n) variance of each whitened noise given z


class Linearisation(NamedTuple):
    """A problem linearised at a point with the expected information; a pytree."""

    model: Model
    point: Point
    rows: tuple[Linearised, ...]  # of each block
    system: Compressed
    solved: Eliminated
    trajectories: tuple[Trajectory, ...]  # of each recursion

    @property
    def information(self) -> jax.Array:
        """Information (M, M) of the data about the biases, trajectories marginalised."""
        return self.solved.information

    def laplace(self, prior: Precision) -> LaplaceApproximation:
        """Covariance of the biases, gamma and evidence under a prior (see `laplace`)."""
        return laplace_of(self.model, self.point, self.solved, prior)

    def variances(self, covariance: jax.Array) -> tuple[jax.Array, ...]:
        """Variance (E, n) of every state of each recursion, for a covariance (M, M) of z."""
        return state_variances(self.trajectories, covariance)

    @jax.jit
    def noise_variances(self, covariance: jax.Array) -> tuple[jax.Array, ...]:
        """Variance (E, n) of every whitened noise of each recursion, for a covariance (M, M) of z."""
        return tuple(
            own.spread + jnp.einsum("eni,ij,enj->en", own.driven, covariance, own.driven) for own in self.trajectories
        )

    @jax.jit
    def predicted_variances(self, covariance: jax.Array) -> Data:
        """Variance (N, C) of each predicted value, biases and trajectories both uncertain."""
        alone = self.model.state_variance(self.rows, [own.covariance for own in self.trajectories])
        return jax.tree.map(jnp.add, alone, self._by_bias(covariance))

    @jax.jit
    def leverages(self, covariance: jax.Array) -> Data:
        """What every datum (N, C) of each block tells about the biases, trajectories marginalised.

        The leverage is w c' Sigma c, c the derivative of the predicted value by z with the trajectory following. Those
        of all data and a rest, what the motion tells, add up to tr(Sigma G), the number of biases that are determined.
        """
        return tuple(lin.weight * own for *_, lin, own in self.model.each_block(self.rows, self._by_bias(covariance)))

    def _by_bias(self, covariance: jax.Array) -> Data:
        """Variance (N, C) of each predicted value by the biases, trajectories following."""
        root = linalg.factor(covariance)
        return self.model.spread(self.rows, [own.response @ root for own in self.trajectories], root)

    def draw(self, z: jax.Array, key: jax.Array) -> tuple[jax.Array, ...]:
        """Trajectories (D, E, n) of each recursion given biases z (D, M): draws from the prior, less their smoothed
        selves.

        All draws are columns of one pass of the simulation smoother (Durbin and Koopman 2002).
        """
        return self._around(z, self._simulated(key, len(z)))

    @jax.jit
    def _around(self, z: jax.Array, simulated: list[tuple[jax.Array, rec.Smoothed]]) -> tuple[jax.Array, ...]:
        drawn = []
        for _, own, mean, (prior, smooth) in self.model.each_layout(self.trajectories, self.point.states, simulated):
            free = prior - smooth.states + own.response @ (z - self.point.z[None, :]).T
            drawn.append(jnp.moveaxis(mean[:, :, None] + free, 2, 0))
        return tuple(drawn)

    def _simulated(self, key: jax.Array, count: int) -> list[tuple[jax.Array, rec.Smoothed]]:
        roots = [(own.L, own.half) for own in self.trajectories]
        return simulated(self.model, self.solved, roots, key, count)


@partial(jax.jit, static_argnames="count")
def simulated(
    model: Model, solved: Eliminated, roots: Sequence[tuple[jax.Array, jax.Array]], key: jax.Array, count: int
) -> list[tuple[jax.Array, rec.Smoothed]]:
    """Trajectories (E, n, count) drawn from the motion, less its drift, and what smoothing makes of their data.

    `roots` (E, n, n) of each recursion are those of its process noise and of the information of its rows.
    """
    found = []
    for r, (part, (L, half), kept) in enumerate(model.each_layout(roots, solved.parts)):
        noise = jax.random.normal(jax.random.fold_in(key, r), (2, *part.drift.shape, count))
        prior = rec.trajectory(part.F, L, jnp.zeros((*part.drift.shape, 1)), noise[0])
        found.append((prior, rec.smooth(part.F, kept.gain, kept.J @ prior + half @ noise[1])))
    return found


@jax.jit
def roots_of(model: Model, levels: jax.Array, solved: Eliminated) -> list[tuple[jax.Array, jax.Array]]:
    """Roots (E, n, n) of the process noise and of the information of the rows."""
    return [(factors(part, levels), _half(kept.J)) for part, kept in model.each_layout(solved.parts)]


@jax.jit
def held_noises(model: Model, levels: jax.Array, solved: Eliminated) -> tuple[jax.Array, ...]:
    """Variance (E, n) of every whitened noise of each recursion, the biases known."""
    return model.each(
        lambda part, kept: jnp.diagonal(rec.covariances(part.F, factors(part, levels), kept.gain)[1], axis1=1, axis2=2),
        solved.parts,
    )


def _half(J: jax.Array) -> jax.Array:
    values, vectors = linalg.spectrum(J)
    return vectors * jnp.sqrt(jnp.maximum(values, 0.0))[:, None, :]


@jax.jit
def linearise_rows(model: Model, point: Where) -> tuple[Linearised, ...]:
    """All rows linearised at a point with the expected information."""
    return model.linearise(point, expected=True)


@jax.jit
def compress_and_eliminate(model: Model, point: Point, rows: tuple[Linearised, ...]) -> tuple[Compressed, Eliminated]:
    """Linearised rows compressed, and the system without its trajectories."""
    system = tilted(model, point.z, compress(model, rows))
    return system, eliminate_compressed(model, point.noises, point.levels, system)


def linearise(model: Model, point: Point) -> Linearisation:
    """Linearise a problem at a consistent point and eliminate its trajectories; three kernels that others share."""
    rows = linearise_rows(model, point)
    system, solved = compress_and_eliminate(model, point, rows)
    return Linearisation(model, point, rows, system, solved, trajectories_of(model, point.levels, solved))


@jax.jit
def trajectories_of(model: Model, levels: jax.Array, solved: Eliminated) -> tuple[Trajectory, ...]:
    """Trajectories of each recursion given the biases, where they were eliminated at log levels (H,)."""
    found = []
    for part, kept in model.each_layout(solved.parts):
        L = factors(part, levels)
        half = _half(kept.J)
        response = rec.smooth(part.F, kept.gain, kept.cross)
        states, noises = rec.covariances(part.F, L, kept.gain)
        spread = jnp.diagonal(noises, axis1=1, axis2=2)
        found.append(Trajectory(L, half, -response.states, -response.noises, states, spread))
    return tuple(found)


@jax.jit
def state_variances(trajectories: tuple[Trajectory, ...], covariance: jax.Array) -> tuple[jax.Array, ...]:
    """Variance (E, n) of every state of each recursion, for a covariance (M, M) of z."""
    return tuple(
        jnp.diagonal(own.covariance, axis1=1, axis2=2)
        + jnp.einsum("eni,ij,enj->en", own.response, covariance, own.response)
        for own in trajectories
    )


@jax.jit
def marginal_information(model: Model, point: Point) -> jax.Array:
    """Expected information (M, M) of the data about the biases at a point, trajectories marginalised."""
    return eliminate(model, point, expected=True).information


def laplace(model: Model, point: Point, prior: Precision) -> LaplaceApproximation:
    """Evidence and covariance with every trajectory marginalised exactly, at the mode for a prior.

    A precision of 0 is a flat prior: its density counts as one. The expected information is used throughout. Where
    process noise is not Gaussian it is the variational lower bound of the evidence (see `mixing_gain`).
    """
    return laplace_of(model, point, compress_and_eliminate(model, point, linearise_rows(model, point))[1], prior)


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
