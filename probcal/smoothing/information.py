"""What follows from a point: noise levels, and the mean square of what is left."""

import jax
import jax.numpy as jnp

from probcal.model.model import Data, Model
from probcal.smoothing import recursion as rec
from probcal.smoothing.linearised import linearise
from probcal.smoothing.mode import Point, factors


@jax.jit
def squares_of(model: Model, point: Point) -> Data:
    """Square of what a point leaves of every datum (N, C) of each block, 1 expected, zero where missing."""
    return model.square(point)


@jax.jit
def mean_square(model: Model, point: Point) -> jax.Array:
    """Squares of all data and whitened noises a datum: about 1 at most where the model is right."""
    count = sum(jnp.sum(there) for there in model.measured)
    squares = sum(jnp.sum(part) for part in squares_of(model, point))
    return (squares + sum(jnp.sum(u**2) for u in point.noises)) / jnp.maximum(count, 1)


def state_covariances(model: Model, point: Point) -> list[jax.Array]:
    """Covariances (E, n, n) of every smoothed state at held biases, linearised at a point."""
    compressed = model.of_states(model.linearise(point, expected=True))
    found = []
    for r, (part, (J, _)) in enumerate(zip(model.recursions, compressed, strict=True)):
        L = factors(part, point.levels)
        found.append(rec.covariances(part.F, L, rec.gains(part.F, L, J, model.entries(r)))[0])
    return found


def update_levels(model: Model, point: Point, covariance: jax.Array) -> Point:
    """One MacKay step of every unknown noise level, kept within its declared factor by its log-normal prior.

    A level sigma of N whitened residuals v solves N - sum Var v = sum v^2 (Paper B 25, for noise). The
    trajectory stays; its whitened noises are rescaled.
    """
    H = point.levels.shape[0]
    at = linearise(model, point)
    spread = at.predicted_variances(covariance)
    count, square = model.by_level(model.measured), model.by_level(model.level_score(point))
    variance = model.by_level(jax.tree.map(jnp.multiply, model.information(point), spread))
    for part, u, own in zip(model.recursions, point.noises, at.noise_variances(covariance), strict=True):
        active = jnp.any(part.L != 0, 1)
        count = count.at[part.level].add(active)
        square = square.at[part.level].add(active * u**2)
        variance = variance.at[part.level].add(active * own)
    free = jnp.maximum(count - variance, 1e-3 * count + 1e-9)[:H]
    step = jnp.zeros(H)
    for _ in range(8):  # Newton: -free t - square/2 exp(-2 t) - (level + t)^2 / (2 spread^2) is concave
        pull = square[:H] * jnp.exp(-2 * step)
        gradient = -free + pull - (point.levels + step) / model.level_spread**2
        step = step + gradient / (2 * pull + 1 / model.level_spread**2)
    return at_levels(model, point, point.levels + jnp.clip(step, -1.0, 1.0))


def at_levels(model: Model, point: Point, levels: jax.Array) -> Point:
    """The same trajectories and biases at other noise levels: the whitened noises are rescaled."""
    ratio = jnp.concatenate([jnp.exp(point.levels - levels), jnp.ones(1)])
    noises = tuple(u * ratio[part.level] for part, u in zip(model.recursions, point.noises, strict=True))
    return point._replace(levels=levels, noises=noises)
