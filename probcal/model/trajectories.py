"""The trajectories of all targets as one value, and the loops over state layouts and blocks that
everything shares.

Targets whose states have the same components share a state layout: their epochs stand in one
recursion. A model has one entry per state layout in `recursions`, and one entry per block in
`blocks`, `rows` and `recursion`. The loops over these entries stand here; elsewhere a function is
applied to each.
"""

from collections.abc import Callable, Iterable, Iterator
from functools import partial
from itertools import starmap
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

States = tuple[jax.Array, ...]  # of every epoch: (E, n), or (E, ...), for each recursion


class Trajectories(NamedTuple):
    """States and whitened noises of all targets, one entry per state layout; a pytree."""

    states: tuple[Any, ...]  # (E, n), or a pytree (E leading) where a motion has no linear form
    noises: tuple[Any, ...]  # (E, n)

    @classmethod
    def of(cls, pairs: Iterable[tuple[Any, Any]]) -> "Trajectories":
        """The trajectories of states and whitened noises, one pair per state layout."""
        both = tuple(pairs)
        return cls(tuple(x for x, _ in both), tuple(u for _, u in both))

    def map(self, function: Callable[..., tuple[Any, Any]], *of_each: Iterable[Any]) -> "Trajectories":
        """The trajectories `function(states, noises, *own)` of each state layout.

        `own` is the entry of each sequence in `of_each`.
        """
        return Trajectories.of(starmap(function, zip(*self, *of_each, strict=True)))

    @property
    def square(self) -> jax.Array:
        """Sum of squares of all whitened noises."""
        return sum((jnp.sum(u**2) for u in self.noises), jnp.zeros(()))


class Loops:
    """The loops of a `Model` over its state layouts and blocks."""

    blocks: tuple[Any, ...]
    rows: tuple[Any, ...]
    recursion: tuple[int, ...]
    recursions: tuple[Any, ...]
    targets: tuple[int, ...]

    def each_layout(self, *of_each: Iterable[Any]) -> Iterator[tuple[Any, ...]]:
        """The recursion of each state layout, followed by its entry of each sequence in `of_each`."""
        return zip(self.recursions, *of_each, strict=True)

    def each(self, function: Callable[..., Any], *of_each: Iterable[Any]) -> tuple[Any, ...]:
        """`function(recursion, *own)` for each state layout, `own` its entry of each sequence in
        `of_each`."""
        return tuple(starmap(function, self.each_layout(*of_each)))

    def each_block(self, *of_each: Iterable[Any]) -> Iterator[tuple[Any, ...]]:
        """Each block, its rows, and the number of the recursion that it reads; then its entry of
        each of `of_each`."""
        return zip(self.blocks, self.rows, self.recursion, *of_each, strict=True)

    def by_target(self, values: Iterable[jax.Array]) -> States:
        """Sums (T, ...) of values (E, ...) over the epochs of each target, one per state layout."""
        return self.each(lambda part, own, T: _sums(own, part.target, T), values, self.targets)


@partial(jax.jit, static_argnums=2, inline=True)
def _sums(values: jax.Array, group: jax.Array, groups: int) -> jax.Array:
    return jax.ops.segment_sum(values, group, groups)
