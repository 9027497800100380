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
    """One slice-sampling update of a scalar under a log density (Neal 2003: stepping out, shrinkage)."""
    keys = jax.random.split(key, 4)
    level = density(x) - jax.random.exponential(keys[0])
    low = x - WIDTH * jax.random.uniform(keys[1])
    below = jax.random.randint(keys[2], (), 0, WIDENINGS + 1)  # how many of the widenings may go down

    def widen(start: jax.Array, step: float, most: jax.Array) -> jax.Array:
        def outside(state: tuple[jax.Array, jax.Array]) -> jax.Array:
            return (state[1] < most) & (density(state[0]) > level)

        return jax.lax.while_loop(outside, lambda s: (s[0] + step, s[1] + 1), (start, jnp.zeros_like(most)))[0]

    high = widen(low + WIDTH, WIDTH, WIDENINGS - below)
    low = widen(low, -WIDTH, below)

    def shrink(state: Any) -> Any:
        low, high, k, key, at, found = state
        key, draw = jax.random.split(key)
        at = low + (high - low) * jax.random.uniform(draw)
        found = density(at) >= level
        return jnp.where(at < x, at, low), jnp.where(at < x, high, at), k + 1, key, at, found

    first = (low, high, jnp.zeros((), int), keys[3], x, jnp.zeros((), bool))
    last = jax.lax.while_loop(lambda s: ~s[5] & (s[2] < SHRINKINGS), shrink, first)
    return jnp.where(last[5], last[4], x)
