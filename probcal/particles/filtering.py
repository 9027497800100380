"""The particle filter of one target (Paper A, Algorithms 2 and 3), by cuthbert."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from probcal.model.epochs import Epoch, State
from probcal.model.model import Model
from probcal.particles.proposals import lost, propagated
from probcal.particles.settings import ParticleSettings
from probcal.resampling import systematic


class FilteredParticles(NamedTuple):
    """The output of a filter for each of K epochs: M particles as drawn, before resampling."""

    states: State  # (K, M) leading
    log_weights: jax.Array  # (K, M) normalised
    ancestors: jax.Array  # (K, M) which particle of the epoch before each comes from
    log_evidence: jax.Array  # () an estimate that is unbiased without the logarithm
    lost: jax.Array  # (K,) whether no particle could have given the rows


def built(model: Model, how: ParticleSettings, z: jax.Array, levels: jax.Array) -> Any:
    """The filter as cuthbert has it: a particle is a state and the log weight it gained last, an input is an epoch."""
    from cuthbert.smc.particle_filter import build_filter
    from cuthbertlib.resampling.adaptive import ess_decorator

    def propagate(key: jax.Array, particle: tuple[State, jax.Array], inputs: tuple[Epoch, jax.Array]) -> Any:
        epoch, there = inputs
        after, gain = propagated(model, how, key, particle[0], epoch, z, levels)
        held = jax.tree.map(lambda new, old: jnp.where(there, new, old), after, particle[0])
        return held, jnp.where(there, gain, 0.0)

    return build_filter(
        init_sample=lambda key: (model.initial(), jnp.zeros(())),
        propagate_sample=propagate,
        log_potential=lambda before, after, inputs: after[1],
        n_filter_particles=how.count,
        resampling_fn=ess_decorator(systematic, how.threshold),
    )


def run_filter(
    model: Model,
    epochs: Epoch,
    there: jax.Array,
    z: jax.Array,
    levels: jax.Array,
    key: jax.Array,
    how: ParticleSettings,
) -> FilteredParticles:
    """Particles of one target over its epochs (K leading)."""
    import cuthbert

    filter_, keys = built(model, how, z, levels), jax.random.split(key)
    found = cuthbert.filter(filter_, (epochs, there), filter_.init_prepare(key=keys[0]), key=keys[1])
    states, gains = jax.tree.map(lambda leaf: leaf[1:], found.particles)
    return FilteredParticles(
        states,
        jax.nn.log_softmax(found.log_weights[1:], -1),
        found.ancestor_indices[1:],
        found.log_normalizing_constant[-1],
        lost(gains),
    )
