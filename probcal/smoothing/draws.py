"""Independent draws of biases and trajectories from the Laplace approximation at a point."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal import linalg, rows
from probcal.problem import Spec, System
from probcal.smoothing import recursion as rec
from probcal.smoothing.information import Moments, moments_of
from probcal.smoothing.mode import Point, factors, linearise, of_both, of_states
from probcal.tree import Residuals


@partial(jax.jit, static_argnames=("spec", "count"))
def draw(
    spec: Spec, system: System, point: Point, covariance: jax.Array, key: jax.Array, count: int
) -> tuple[jax.Array, tuple[jax.Array, ...], list[Moments]]:
    """`count` joint draws, z (D, M) and states (D, E, n) of each recursion, and the exact moments behind them.

    Trajectories given z come from the simulation smoother (draw from the prior, subtract its smoothed
    self): all draws are columns of one pass. The response of the trajectory to z is linear.
    """
    keys = jax.random.split(key, 1 + len(system.recursions))
    M = spec.biases
    root = linalg.factor(covariance) if M else jnp.zeros((0, 0))
    dz = jax.random.normal(keys[0], (count, M)) @ root.T
    lins = linearise(spec, system, point, expected=True)
    compressed, crosses = of_states(spec, system, lins, point.states), of_both(spec, system, lins, point.states)
    trajectories, found = [], []
    for r, (part, (J, _), cross) in enumerate(zip(system.recursions, compressed, crosses, strict=True)):
        E, n = part.drift.shape
        L = factors(part, point.levels)
        gain = rec.gains(part.F, L, J)
        noise = jax.random.normal(keys[r + 1], (2, E, n, count))
        prior = rec.trajectory(part.F, L, jnp.zeros((E, n, 1)), noise[0])
        values, vectors = linalg.spectrum(J)
        half = vectors * jnp.sqrt(jnp.maximum(values, 0.0))[:, None, :]
        measured = J @ prior + half @ noise[1]
        columns = jnp.concatenate([measured, cross], 2)
        smooth = rec.smooth(part.F, L, J, gain, columns)
        free = prior - smooth.states[:, :, :count] - smooth.states[:, :, count:] @ dz.T
        trajectories.append(jnp.moveaxis(point.states[r][:, :, None] + free, 2, 0))
        found.append(
            moments_of(
                part, L, J, gain, rec.Smoothed(smooth.states[:, :, count:], smooth.noises[:, :, count:]), covariance
            )
        )
    return point.z[None, :] + dz, tuple(trajectories), found


@partial(jax.jit, static_argnames="spec")
def predictive(
    spec: Spec, system: System, levels: jax.Array, z: jax.Array, states: tuple[jax.Array, ...], key: jax.Array
) -> tuple[list[jax.Array], list[jax.Array]]:
    """Log-likelihood and replicas (D, N, C) of each block at draws of levels (D, H), z (D, M) and states (D, E, n)."""

    def one(draw):
        levels_d, z_d, states_d, seed = draw
        found = []
        for b, (block, data, r) in enumerate(zip(spec.blocks, system.rows, spec.recursion, strict=True)):
            predicted = rows.predict(block, data, states_d[r], z_d)
            replica = rows.sample(block, data, predicted, levels_d, jax.random.fold_in(seed, b))
            found.append((rows.log_likelihood(block, data, predicted, levels_d), replica))
        return [f[0] for f in found], [f[1] for f in found]

    return jax.lax.map(one, (levels, z, states, jax.random.split(key, z.shape[0])))


class Remainder(NamedTuple):
    """What is left of every datum of a block at a point, each (N, C), zero where missing."""

    innovation: jax.Array
    std: jax.Array  # noise level
    reliance: jax.Array  # 1 inlying, towards 0 outlying


@partial(jax.jit, static_argnames="spec")
def residuals(spec: Spec, system: System, point: Point) -> list[Remainder]:
    """Innovation, noise level and reliance of every datum of each block at a point."""
    found = []
    for block, data, r in zip(spec.blocks, system.rows, spec.recursion, strict=True):
        predicted = rows.predict(block, data, point.states[r], point.z)
        found.append(
            Remainder(
                rows.innovation(block, data, predicted),
                rows.noise_std(data, point.levels),
                rows.reliance(block, data, predicted, point.levels),
            )
        )
    return found


def residuals_of(spec: Spec, system: System, before: Point, after: Point) -> Residuals:
    """Residuals without and with calibration, at two points."""
    old, new = residuals(spec, system, before), residuals(spec, system, after)
    return Residuals(
        before=[np.asarray(r.innovation) for r in old],
        after=[np.asarray(r.innovation) for r in new],
        std=[np.asarray(r.std) for r in new],
        weight=[np.asarray(r.reliance) for r in new],
    )
