"""Noise levels and latent scales drawn given trajectories and biases: a step of Gibbs sampling.

A level is drawn with the latent scales of heavy-tailed process noise integrated, then these given
all else. Levels of process noise are drawn twice, at given states and at given whitened noises, which
mixes whatever the data say of the noises (Yu, Meng 2011).
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from probcal.gaussian.information import at_levels
from probcal.gaussian.mode import Point, driven_states
from probcal.gaussian.tails import rewhitened
from probcal.inference.draws import slice_step
from probcal.model.model import At, Model, Recursion


def levels_alone(model: Model) -> tuple[int, ...]:
    """Levels that are drawn one by one: of process noise, and parameters of noise families."""
    driven = {int(h) for part in model.recursions for h in np.unique(part.level)}
    return tuple(sorted(_parameters(model) | driven - {len(model.level_spread)}))


def _parameters(model: Model) -> set[int]:
    return {h for block in model.blocks for own in block.unknown for h in own.number}


def log_prior_levels(model: Model, levels: Any) -> Any:
    """Log density (H,) of each log level, up to a constant."""
    return -0.5 * (levels / model.level_spread) ** 2


@partial(jax.jit, static_argnames="alone")
def draw_noise(model: Model, point: Point, key: jax.Array, alone: tuple[int, ...]) -> tuple[Model, Point]:
    """Model and point with unknown levels and latent scales of process noise drawn anew."""
    keys = jax.random.split(key, 3)
    ones = jax.tree.map(jnp.ones_like, model.mixing)
    model, point = model.with_mixing(ones), rewhitened(model, point, ones)
    if len(point.levels):
        point = _with_levels(model, point, keys[0], keys[1], alone)

    def drawn(part: Recursion, u: jax.Array, own: jax.Array) -> tuple[jax.Array, ...]:
        pairs = zip(part.tails, jax.random.split(own, len(part.tails)), strict=True)
        return tuple(
            jnp.where(tail.on, tail.family.mixing_draw(key, tail.on.shape, tail.squares(u), tail.size), 1.0)
            for tail, key in pairs
        )

    weights = model.each(drawn, point.noises, jax.random.split(keys[2], len(model.recursions)))
    return model.with_mixing(weights), rewhitened(model, point, weights)


def _with_levels(model: Model, point: Point, together: jax.Array, key: jax.Array, alone: tuple[int, ...]) -> Point:
    """The point at levels drawn anew: of std together at given states, then some one by one."""

    held = np.isin(np.arange(point.levels.shape[0]), list(_parameters(model)))

    def by_level(levels: jax.Array) -> jax.Array:
        """Log density (H,) of each level at the states, of data and noises that it multiplies."""
        levels = jnp.where(held, point.levels, levels)  # families keep their parameters
        found = model.by_level(model.log_likelihood(At(point.states, point.z, levels)))
        padded = jnp.append(levels, 0.0)
        for part, u in model.each_layout(at_levels(model, point, levels).noises):
            own = -0.5 * u**2 - jnp.any(part.L != 0, 1) * padded[part.level]
            found = found.at[part.level].add(own)
            for tail in part.tails:
                gain = jnp.where(tail.on, tail.family.mixing_density(tail.squares(u), tail.size), 0.0)
                found = found.at[part.level[:, tail.columns[0]]].add(gain)
        return found[:-1] + log_prior_levels(model, levels)

    levels = jnp.where(held, point.levels, slice_step(together, point.levels, by_level))
    point = at_levels(model, point, levels)

    def moved(levels: jax.Array) -> At:
        """The same whitened noises at other levels."""
        states = model.each(lambda part, u: driven_states(part, levels, u), point.noises)
        return At(states if model.driven else point.states, point.z, levels)

    def total(levels: jax.Array) -> jax.Array:
        found = model.log_likelihood(moved(levels))
        return sum(map(jnp.sum, found), jnp.sum(log_prior_levels(model, levels)))

    def one(levels: jax.Array, pair: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
        h, own = pair
        drawn = slice_step(own, levels[h], lambda value: total(levels.at[h].set(value)))
        return levels.at[h].set(drawn), None

    pairs = jnp.asarray(alone, int), jax.random.split(key, len(alone))
    levels, _ = jax.lax.scan(one, levels, pairs)
    return point._replace(states=moved(levels).states, levels=levels)
