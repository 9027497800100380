"""The length of a step: one rule for every search."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

HALVINGS = 12  # lengths of a step that are tried, each half of the one before


def halved(value: Callable[[Any], Any], bound: Any) -> tuple[Any, Any, jax.Array]:
    """Halve a step until its value does not exceed the bound.

    The bound is an array, or a pytree of arrays whose entries have step lengths of their own.
    Returns the fractions of the step, 0 where none would do; their values, there the bound; and how
    many were tried.
    """

    def shorter(state: tuple[Any, Any, jax.Array]) -> tuple[Any, Any, jax.Array]:
        share, before, tries = state
        share = jax.tree.map(
            lambda t, new, old: jnp.where((tries == 0) | (new <= old), t, 0.5 * t), share, before, bound
        )
        return share, value(share), tries + 1

    def worse(state: tuple[Any, Any, jax.Array]) -> jax.Array:
        _, found, tries = state
        above = jax.tree.leaves(jax.tree.map(lambda new, old: jnp.any(~(new <= old)), found, bound))
        return (tries == 0) | (jnp.any(jnp.stack(above)) & (tries < HALVINGS))

    whole = jax.tree.map(jnp.ones_like, bound)
    share, found, tries = jax.lax.while_loop(worse, shorter, (whole, bound, jnp.zeros((), int)))
    share = jax.tree.map(lambda t, new, old: jnp.where(new <= old, t, 0.0), share, found, bound)
    return share, jax.tree.map(lambda new, old: jnp.where(new <= old, new, old), found, bound), tries


def between(a: Any, b: Any, share: Any) -> Any:
    """The pytree a + share (b - a), a itself where the share is 0, whatever b is."""
    return jax.tree.map(lambda p, q: jnp.where(share == 0, p, p + share * (q - p)), a, b)
