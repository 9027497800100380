"""Sums over the epochs of a target, smoothed while it is filtered: PaRIS (Olsson, Westerborn 2017).

    uv run python benchmarks/papers/paris.py

Two gauges with known biases see a target; the sum of its positions, by 100 runs of 200 particles, beside the sum of
the exactly smoothed track.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import probcal as pc
from probcal.model.epochs import Epoch, State
from probcal.model.model import Model
from probcal.particles.backward import sampler_of
from probcal.particles.filtering import built
from probcal.particles.particles import Particles
from probcal.particles.targets import targets_of

Functional = Callable[[State, State, Epoch], Any]  # the state before, that at an epoch, and the epoch: a pytree


def smoothed_sum(
    model: Model, epochs: Epoch, there: jax.Array, z: jax.Array, levels: jax.Array, key: jax.Array, how: Particles,
    functional: Functional, draws: int = 2,
) -> tuple[Any, jax.Array]:  # fmt: skip
    """Smoothed expectation of a sum of `functional` over a target's epochs, and the log evidence.

    Particles carry the sum along; each goes on from the mean over `draws` of what the particles before it carry, drawn
    backward. Nothing is kept of earlier epochs, so that a stream can be smoothed so; two draws are enough for the
    variance to grow no faster than the number of epochs.
    """
    filter_, sampler, keys = built(model, how, z, levels), sampler_of(how), jax.random.split(key)
    first = filter_.init_prepare(key=keys[0])
    blank = jax.eval_shape(lambda e: functional(model.initial(), model.initial(), e), _row(epochs, 0))
    sums = jax.tree.map(lambda leaf: jnp.zeros((how.count, *leaf.shape), leaf.dtype), blank)

    def one(carry: Any, inputs: Any) -> tuple[Any, None]:
        state, sums = carry
        epoch, really, own = inputs
        seeds = jax.random.split(own, draws + 1)
        state = state._replace(model_inputs=(epoch, really))
        after = filter_.filter_combine(state, filter_.filter_prepare((epoch, really), key=seeds[0]))
        before, there = state.particles[0], after.particles[0]
        parts = []
        for seed in seeds[1:]:
            _, chosen = sampler(
                seed, before, there, state.log_weights, lambda a, b: model.log_step(a, b, epoch, levels),
                after.ancestor_indices,
            )  # fmt: skip
            chosen = jnp.where(really & ~epoch.first, chosen, after.ancestor_indices)
            x0, carried = jax.tree.map(lambda leaf, chosen=chosen: leaf[chosen], (before, sums))
            added = jax.vmap(lambda a, b: functional(a, b, epoch))(x0, there)
            parts.append(jax.tree.map(lambda s, h: s + jnp.where(really, h, 0.0), carried, added))
        sums = jax.tree.map(lambda *leaves: sum(leaves) / draws, *parts)
        return (after, sums), None

    first = first._replace(model_inputs=(_row(epochs, 0), there[0]))
    (last, sums), _ = jax.lax.scan(one, (first, sums), (epochs, there, jax.random.split(keys[1], len(there))))
    weights = jax.nn.softmax(last.log_weights)
    return jax.tree.map(lambda leaf: jnp.tensordot(weights, leaf, 1), sums), last.log_normalizing_constant


def _row(tree: Any, k: int) -> Any:
    return jax.tree.map(lambda leaf: leaf[k], tree)


@pc.sensor(x=pc.Channel("m", std=1.0), y=pc.Channel("m", std=1.0))
def fix(target, pose, *, east=pc.Bias("m", 1e-6)):
    """A position; its bias is known to be none."""
    line = target.position - pose.position
    return dict(x=line[0] + east, y=line[1])


def main() -> None:
    """Print the sum by particles, its standard error and the exact one."""
    network = pc.Network([fix.on(pc.Node(f"n{k}", place)) for k, place in enumerate([(0, 0), (5, 0)])])
    motion = pc.Target(pc.ConstantVelocity(0.8), {"position": ((1.0, -1.0), 6.0), "velocity": ((0.3, 0.3), 1.5)})
    table = pc.simulate(network, motion, np.arange(8.0), key=0, biases={}).table
    exact = pc.tracks(pc.fit(pc.Problem(network, motion, table), pc.MAP()))["position_x"].sum()
    with jax.enable_x64(True):
        model = pc.Problem(network, motion, table).model
        (targets,) = targets_of(model)
        at, how = (jnp.zeros(model.biases), jnp.zeros(0)), Particles(200)

        def once(key: jax.Array) -> jax.Array:
            own = jax.tree.map(lambda leaf: leaf[0], (targets.epochs, targets.there))
            return smoothed_sum(targets.model, *own, *at, key, how, lambda a, b, e: b[0][0, 0])[0]

        found = np.asarray(jax.lax.map(jax.jit(once), jax.random.split(jax.random.key(0), 100)))
    print(f"sum of positions {found.mean():.3f} ± {found.std() / 10:.3f} by particles, {exact:.3f} exactly")


if __name__ == "__main__":
    main()
