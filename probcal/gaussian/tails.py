"""Process noise that is not Gaussian: the weights of its scale mixture, by their expectation over the trajectories.

u_k ~ N(0, I / w_k) with w_k drawn anew at every epoch. Given all w everything is Gaussian; given the
trajectory each w_k has a posterior of its own. A climb alternates: w_k is the mean of its posterior
at the expected square of u_k, its smoothed variance (biases and trajectory) included, which
maximises a lower bound of the evidence (variational Bayes).
Weights at the mode of u alone would prefer small noises, the error of the joint mode again.
The bound counts u and w as independent: where data tell little of each u, an unknown level comes
out too large. `Gibbs` and `NUTS` have no such error.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal.gaussian.dense import DenseExpansion
from probcal.gaussian.engine import Engine, Expansion, Factors
from probcal.gaussian.factor import COLUMNS
from probcal.gaussian.information import update_levels
from probcal.gaussian.jointly import follow_biases
from probcal.gaussian.linearised import marginal_variances
from probcal.gaussian.mode import Point
from probcal.model.model import Data, Mixing, Model, Recursion
from probcal.model.rows import LinearRows
from probcal.model.trajectories import States
from probcal.problem import Problem

ROUNDS, STILL = 50, 1e-3  # of precisions and trajectories in turn, and change of log precision at which they end


class Variances(NamedTuple):
    """Posterior variances at a point, from which noise levels and precisions follow."""

    predicted: Data  # (N, C) of each predicted value
    noises: States  # (E, n) of each whitened noise

    @classmethod
    def of(cls, at: Expansion, factors: Factors) -> "Variances":
        """Those that the factors of a prior leave."""
        return cls(tuple(at.predicted(factors)), tuple(at.noises(factors)))

    @classmethod
    def dense(cls, at: DenseExpansion, covariance: jax.Array) -> "Variances":
        """Those for a covariance (M, M) of z; it can be traced."""
        return cls(*marginal_variances(at.model, at.rows, at.trajectories, covariance))


@jax.jit
def renewed_noise(model: Model, point: Point, variances: Variances) -> tuple[Model, Point]:
    """Model and point with the unknown levels and precisions of tails that follow."""
    weights = expected_mixing(model, point, variances.noises)
    point = update_levels(model, point, *variances) if point.levels.shape[0] else point
    return model.with_mixing(weights), rewhitened(model, point, weights)


def expected_mixing(model: Model, point: Point, variances: States) -> Mixing:
    """Mean precisions (E,) of every tail, for variances (E, n) of the whitened noises."""

    def means(part: Recursion, u: jax.Array, variance: jax.Array) -> tuple[jax.Array, ...]:
        squares = [jnp.sum((u**2 + variance)[:, slice(*tail.columns)], 1) / tail.weight for tail in part.tails]
        means = [tail.family.mixing_mean(s, tail.size) for tail, s in zip(part.tails, squares, strict=True)]
        return tuple(jnp.where(tail.on, w, 1.0) for tail, w in zip(part.tails, means, strict=True))

    return model.each(means, point.noises, variances)


def rewhitened(model: Model, point: Point, weights: Mixing) -> Point:
    """The same states at other precisions of the process noise: the whitened noises are rescaled."""
    if not model.tailed:
        return point
    after = model.with_mixing(weights).recursions
    noises = model.each(lambda old, new, u: u * jnp.sqrt(new.weight / old.weight), after, point.noises)
    return point._replace(noises=noises)


def settle(engine: Engine, problem: Problem, point: Point, root: Any) -> tuple[Problem, Point]:
    """Problem and point whose precisions and trajectories agree, at held biases of the covariance
    root root', root (M, R)."""
    for _ in range(ROUNDS if problem.model.tailed else 0):
        at = engine.settled(problem.model, point)
        # variance (E, n) of every whitened noise, biases of the covariance root root', root (M, R)
        gains = tuple(kept.gain for kept in at.eliminated.parts)
        found = tuple(own.spread for own in at.given_biases())
        for start in range(0, root.shape[1], COLUMNS):
            own = root[:, start : start + COLUMNS]
            found = _driven(at.model, at.rows, gains, found, own @ np.eye(own.shape[1]))
        point, weights = at.point, expected_mixing(problem.model, at.point, found)
        pairs = zip(jax.tree.leaves(problem.model.mixing), jax.tree.leaves(weights), strict=True)
        moved = max(float(np.abs(np.log(np.asarray(b) / np.asarray(a))).max(initial=0.0)) for a, b in pairs)
        point, problem = rewhitened(problem.model, point, weights), problem.with_mixing(weights)
        if moved < STILL:
            break
    return problem, point


@jax.jit
def _driven(model: Model, rows: LinearRows, gains: Any, found: States, columns: Any) -> States:
    moved = follow_biases(model, rows, gains, columns)
    return jax.tree.map(lambda own, by: own + jnp.sum(by.noises**2, 2), found, moved)
