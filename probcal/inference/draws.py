"""Random draws that jax does not have, and the kernels that Gibbs samplers are made of."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

WIDTH = 1.5  # first interval of a slice, in the units of its variable (a logarithm)
WIDENINGS = 12  # most times that it grows
SHRINKINGS = 60  # most times that it shrinks


def inverse_gaussian(key: jax.Array, mean: jax.Array, shape: float) -> jax.Array:
    """Inverse Gaussian draws of mean (L,) and a shape (Michael, Schucany, Haas 1976), without cancellation."""
    keys = jax.random.split(key)
    y = mean * jax.random.normal(keys[0], mean.shape) ** 2
    # the smaller root mean + (mean y - sqrt(4 mean shape y mean + ...)) / (2 shape), written as a quotient
    small = mean * 2 * shape / (2 * shape + y + jnp.sqrt(y * (4 * shape + y)))
    first = jax.random.uniform(keys[1], mean.shape) * (mean + small) <= mean
    return jnp.where(first, small, mean * (mean / small))


def slice_step(key: jax.Array, x: jax.Array, density: Callable[[jax.Array], jax.Array]) -> jax.Array:
    """One slice-sampling update of independent variables x, each under its own log density (Neal
    2003: stepping out, shrinkage)."""
    keys = jax.random.split(key, 4)
    level = density(x) - jax.random.exponential(keys[0], x.shape)
    low = x - WIDTH * jax.random.uniform(keys[1], x.shape)
    below = jax.random.randint(keys[2], x.shape, 0, WIDENINGS + 1)  # how many of the widenings may go down

    def widen(start: jax.Array, step: float, most: jax.Array) -> jax.Array:
        def further(state: Any) -> Any:
            end, count, _ = state
            end = jnp.where(inside := (count < most) & (density(end) > level), end + step, end)
            return end, count + 1, jnp.any(inside)

        first = (start, jnp.zeros((), int), jnp.ones((), bool))
        return jax.lax.while_loop(lambda state: state[2], further, first)[0]

    high = widen(low + WIDTH, WIDTH, WIDENINGS - below)
    low = widen(low, -WIDTH, below)

    def shrink(state: Any) -> Any:
        low, high, k, key, at, found = state
        key, draw = jax.random.split(key)
        at = jnp.where(found, at, low + (high - low) * jax.random.uniform(draw, x.shape))
        found = density(at) >= level
        return jnp.where(at < x, at, low), jnp.where(at < x, high, at), k + 1, key, at, found

    first = (low, high, jnp.zeros((), int), keys[3], x, jnp.zeros(x.shape, bool))
    last = jax.lax.while_loop(lambda s: ~jnp.all(s[5]) & (s[2] < SHRINKINGS), shrink, first)
    return jnp.where(last[5], last[4], x)
