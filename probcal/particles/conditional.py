"""A particle filter that holds one path: the step of particle Gibbs, with ancestor sampling."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from probcal.model.epochs import Epoch, State
from probcal.model.model import Model
from probcal.particles.proposals import gained, propagated
from probcal.particles.settings import ParticleSettings
from probcal.resampling import multinomial


def conditional_path(
    model: Model, epochs: Epoch, there: jax.Array, path: State, z: jax.Array, levels: jax.Array, key: jax.Array,
    how: ParticleSettings,
) -> tuple[State, jax.Array]:  # fmt: skip
    """A path (K leading) drawn given another by a kernel that leaves its posterior invariant, and where it is new.

    Particle Gibbs with ancestor sampling (Lindsten, Jordan, Schon 2014): the last of the particles is the given path;
    its ancestor is drawn anew at every epoch. Resampled at every epoch, multinomially.
    """
    paths, new = conditional_paths(model, epochs, there, path, z, levels, key, how, 1)
    return jax.tree.map(lambda leaf: leaf[:, 0], paths), new[:, 0]


def conditional_paths(
    model: Model, epochs: Epoch, there: jax.Array, path: State, z: jax.Array, levels: jax.Array, key: jax.Array,
    how: ParticleSettings, draws: int,
) -> tuple[State, jax.Array]:  # fmt: skip
    """Several paths (K, draws leading) of one conditional filter, each by itself a draw of the kernel."""
    M, keys = how.count, jax.random.split(key)

    def one(carry: Any, inputs: Any) -> tuple[Any, Any]:
        states, weights = carry
        epoch, really, given, own = inputs
        seeds = jax.random.split(own, 3)
        chosen = multinomial(seeds[0], weights, M)
        reach = jax.vmap(lambda x: model.log_step(x, given, epoch, levels))(states)
        reach = jnp.where(jnp.isnan(reach), -jnp.inf, reach) + weights
        parent = jax.random.categorical(seeds[1], jnp.where(jnp.isfinite(jnp.max(reach)), reach, weights))
        chosen = jnp.where(really, chosen.at[-1].set(jnp.where(epoch.first, M - 1, parent)), jnp.arange(M))
        before = jax.tree.map(lambda leaf: leaf[chosen], states)
        after, gain = jax.vmap(lambda k, x: propagated(model, how, k, x, epoch, z, levels, conditional=True))(
            jax.random.split(seeds[2], M), before
        )
        last = jax.tree.map(lambda leaf: leaf[-1], before)
        worth = gained(model, how, last, given, epoch, z, levels)
        after = jax.tree.map(lambda leaf, own: leaf.at[-1].set(own), after, given)
        after = jax.tree.map(lambda new, old: jnp.where(really, new, old), after, states)
        weights = jnp.where(really, gain.at[-1].set(worth), weights)
        return (after, weights), (after, chosen)

    start = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (M, *leaf.shape)), model.initial())
    inputs = (epochs, there, path, jax.random.split(keys[0], len(there)))
    (_, weights), (states, ancestors) = jax.lax.scan(one, (start, jnp.zeros(M)), inputs)
    last = jax.random.categorical(keys[1], weights, shape=(draws,))

    def back(chosen: jax.Array, inputs: Any) -> tuple[jax.Array, Any]:
        own, parents = inputs
        return parents[chosen], (jax.tree.map(lambda leaf: leaf[chosen], own), chosen != M - 1)

    _, (drawn, new) = jax.lax.scan(back, last, (states, ancestors), reverse=True)
    return drawn, new
