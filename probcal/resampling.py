"""Systematic resampling in the form of cuthbert's, kept on the device.

cuthbert's own calls back to the host on a CPU, one call a filter: under `vmap` these run one after the other, and the
callback leaves double precision.
"""

from typing import Any

import jax
import jax.numpy as jnp


def systematic(key: jax.Array, logits: jax.Array, positions: Any, n: int) -> tuple[jax.Array, jax.Array, Any]:
    """Indices (n,), zero log weights and the states of n particles chosen by their log weights."""
    chosen = chosen_at(logits, (jax.random.uniform(key) + jnp.arange(n)) / n)
    return chosen, jnp.zeros(n), jax.tree.map(lambda leaf: leaf[chosen], positions)


def multinomial(key: jax.Array, log_weights: jax.Array, count: int) -> jax.Array:
    """Independent indices (count,), drawn by the weights."""
    return chosen_at(log_weights, jax.random.uniform(key, (count,)))


def chosen_at(log_weights: jax.Array, places: jax.Array) -> jax.Array:
    """The indices of the particles at places in [0, 1) of the cumulative weights."""
    cumulative = jnp.cumsum(jax.nn.softmax(log_weights))
    return jnp.searchsorted(cumulative, places * cumulative[-1], side="right").clip(0, len(log_weights) - 1).astype(int)
