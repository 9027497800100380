"""Smoothing behind a particle filter: paths drawn backward in time, or the filter's particles weighed again."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from probcal.model.epochs import Epoch, State
from probcal.model.model import Model
from probcal.particles.filtering import FilteredParticles
from probcal.particles.settings import ParticleSettings
from probcal.resampling import multinomial, systematic

Sampler = Callable[..., tuple[Any, jax.Array]]  # `cuthbertlib.smc.smoothing.protocols.BackwardSampling`


class SmoothedParticles(NamedTuple):
    """Smoothed particles of one target at K epochs, N each."""

    states: State  # (K, N) leading
    weights: jax.Array  # (K, N) that sum to 1 at each epoch; all alike where the particles form N paths
    log_evidence: jax.Array  # ()
    lost: jax.Array  # (K,)


def metropolis(
    key: jax.Array, x0_all: Any, x1_all: Any, log_weight_x0_all: jax.Array, log_density: Any,
    x1_ancestor_indices: jax.Array, moves: int,
) -> tuple[Any, jax.Array]:  # fmt: skip
    """Backward sampling of linear cost, in the form of cuthbert's samplers.

    Independent Metropolis steps from the ancestor, with proposals by the filter's weights (Bunch, Godsill 2013; Dau,
    Chopin 2023). cuthbert's own resamples by a callback to the host.
    """
    density, count = jax.vmap(log_density), len(x1_ancestor_indices)

    def at(chosen: jax.Array) -> jax.Array:
        value = density(jax.tree.map(lambda leaf: leaf[chosen], x0_all), x1_all)
        return jnp.where(jnp.isnan(value), -jnp.inf, value)

    def move(state: tuple[jax.Array, jax.Array], own: jax.Array) -> tuple[tuple[jax.Array, jax.Array], None]:
        chosen, value = state
        keys = jax.random.split(own)
        other = multinomial(keys[0], log_weight_x0_all, count)
        proposed = at(other)
        taken = jnp.log(jax.random.uniform(keys[1], (count,))) < proposed - value
        return (jnp.where(taken, other, chosen), jnp.where(taken, proposed, value)), None

    start = (x1_ancestor_indices, at(x1_ancestor_indices))
    (chosen, _), _ = jax.lax.scan(move, start, jax.random.split(key, moves))
    return jax.tree.map(lambda leaf: leaf[chosen], x0_all), chosen


def sampler_of(how: ParticleSettings) -> Sampler:
    """The backward sampler of a smoother."""
    if how.smoother == "exact":
        from cuthbertlib.smc.smoothing.exact_sampling import simulate

        return simulate
    if how.smoother == "genealogy":
        from cuthbertlib.smc.smoothing.tracing import simulate

        return simulate
    return partial(metropolis, moves=how.moves)


def draw_paths(
    model: Model,
    found: FilteredParticles,
    epochs: Epoch,
    there: jax.Array,
    levels: jax.Array,
    key: jax.Array,
    how: ParticleSettings,
) -> State:
    """As many paths as particles, (K, M) leading, drawn from a target's smoothing distribution."""
    sampler, keys = sampler_of(how), jax.random.split(key, 3)
    last, _, _ = systematic(keys[0], found.log_weights[-1], (), how.count)
    last = jax.random.permutation(keys[2], last)  # so that each path by itself is a draw

    def back(chosen: jax.Array, inputs: Any) -> tuple[jax.Array, jax.Array]:
        before, weights, after, ancestors, epoch, really, own = inputs
        x1, parents = jax.tree.map(lambda leaf: leaf[chosen], after), ancestors[chosen]
        _, drawn = sampler(
            own, before, x1, weights, lambda a, b: model.log_step(a, b, epoch, levels), parents
        )  # fmt: skip
        drawn = jnp.where(really, drawn, parents)  # behind a target's last epoch nothing moves
        return drawn, drawn

    pairs = (
        _cut(found.states, None, -1), found.log_weights[:-1], _cut(found.states, 1, None), found.ancestors[1:],
        _cut(epochs, 1, None), there[1:], jax.random.split(keys[1], len(there) - 1),
    )  # fmt: skip
    _, chosen = jax.lax.scan(back, last, pairs, reverse=True)
    chosen = jnp.concatenate([chosen, last[None]])
    return jax.tree.map(lambda leaf: jax.vmap(lambda own, k: own[k])(leaf, chosen), found.states)


def marginal_weights(
    model: Model, found: FilteredParticles, epochs: Epoch, there: jax.Array, levels: jax.Array
) -> jax.Array:
    """Smoothed weights (K, M) of the filter's particles, in O(M^2) an epoch (Paper A, Algorithm 4, 38-39)."""

    def back(weights: jax.Array, inputs: Any) -> tuple[jax.Array, jax.Array]:
        before, filtered, after, ancestors, epoch, really = inputs
        density = filtered[:, None] + model.log_steps(before, after, epoch, levels)
        highest = jnp.max(density, 0)
        shares = jnp.exp(density - jnp.where(jnp.isfinite(highest), highest, 0.0)[None, :])
        total = jnp.sum(shares, 0)
        smoothed = shares @ jnp.where(total > 0, weights / jnp.where(total > 0, total, 1.0), 0.0)
        held = jnp.zeros_like(weights).at[ancestors].add(weights)
        sound = really & (jnp.sum(smoothed) > 0)
        smoothed = jnp.where(sound, smoothed, held)
        smoothed = smoothed / jnp.sum(smoothed)
        return smoothed, smoothed

    last = jnp.exp(found.log_weights[-1])
    pairs = (
        _cut(found.states, None, -1), found.log_weights[:-1], _cut(found.states, 1, None), found.ancestors[1:],
        _cut(epochs, 1, None), there[1:],
    )  # fmt: skip
    _, weights = jax.lax.scan(back, last, pairs, reverse=True)
    return jnp.concatenate([weights, last[None]])


def smooth_particles(
    model: Model,
    found: FilteredParticles,
    epochs: Epoch,
    there: jax.Array,
    levels: jax.Array,
    key: jax.Array,
    how: ParticleSettings,
) -> SmoothedParticles:
    """The smoother of `how` behind a filter."""
    if how.smoother == "marginal":
        weights = marginal_weights(model, found, epochs, there, levels)
        return SmoothedParticles(found.states, weights, found.log_evidence, found.lost)
    states = draw_paths(model, found, epochs, there, levels, key, how)
    return SmoothedParticles(states, jnp.full(found.log_weights.shape, 1.0 / how.count), found.log_evidence, found.lost)


def _cut(tree: Any, start: int | None, stop: int | None) -> Any:
    """Some of what leads in every array."""
    return jax.tree.map(lambda leaf: leaf[start:stop], tree)
