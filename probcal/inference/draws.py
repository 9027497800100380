"""Random draws that jax does not have, and the kernels that Gibbs samplers are made of."""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

WIDTH = 12.0  # first interval of a slice, in the units of its variable (a logarithm)
SHRINKINGS = 40  # most places that it tries
TOGETHER = 64  # uniform draws are made in multiples: one computation serves several calls


def uniforms(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Uniform draws from [0, 1)."""
    count = math.prod(shape)
    return jax.random.uniform(key, (-(-count // TOGETHER) * TOGETHER,))[:count].reshape(shape)


def normals(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Standard normal draws (Box and Muller 1958); those of jax take ten times as much to compile."""
    first, second = uniforms(key, (2, *shape))
    return jnp.sqrt(-2.0 * jnp.log1p(-first)) * jnp.cos(2.0 * jnp.pi * second)


def accepted(key: jax.Array, gain: jax.Array) -> jax.Array:
    """True if proposals whose log densities gain so much are taken (Metropolis)."""
    return jnp.log(jax.random.uniform(key)) < jnp.where(jnp.isfinite(gain), gain, -jnp.inf)


def inverse_gaussian(key: jax.Array, mean: jax.Array, shape: float) -> jax.Array:
    """Inverse Gaussian draws of mean (L,) and a shape (Michael, Schucany, Haas 1976), without cancellation."""
    keys = jax.random.split(key)
    y = mean * normals(keys[0], mean.shape) ** 2
    # the smaller root mean + (mean y - sqrt(4 mean shape y mean + ...)) / (2 shape), written as a quotient
    small = mean * 2 * shape / (2 * shape + y + jnp.sqrt(y * (4 * shape + y)))
    first = uniforms(keys[1], mean.shape) * (mean + small) <= mean
    return jnp.where(first, small, mean * (mean / small))


def slice_step(key: jax.Array, x: jax.Array, density: Callable[[jax.Array], jax.Array]) -> jax.Array:
    """One slice-sampling update of independent variables x, each under its own log density (Neal
    2003: an interval of one width, shrinkage)."""
    draws = uniforms(key, (SHRINKINGS + 2, *x.shape))

    def shrink(state: Any) -> Any:
        """The density at the next place; at the first, x, it gives the level of the slice."""
        low, high, k, level, at, _ = state
        value = density(at)
        level = jnp.where(k == 0, value + jnp.log1p(-draws[0]), level)
        found = (k > 0) & (value >= level)
        low, high = jnp.where(at < x, at, low), jnp.where(at > x, at, high)
        return low, high, k + 1, level, jnp.where(found, at, low + (high - low) * draws[k + 1]), found

    low = x - WIDTH * draws[-1]
    first = (low, low + WIDTH, jnp.zeros((), int), x, x, jnp.zeros(x.shape, bool))
    last = jax.lax.while_loop(lambda s: ~jnp.all(s[5]) & (s[2] <= SHRINKINGS), shrink, first)
    return jnp.where(last[5], last[4], x)
