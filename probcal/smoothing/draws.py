"""Independent draws of trajectories from the Laplace approximation at a point, and what the data say at each."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal import linalg, rows
from probcal.problem import Spec, System
from probcal.smoothing import recursion as rec
from probcal.smoothing.information import Moments, moments_of
from probcal.smoothing.mode import Point, factors, linearise, of_both, of_states
from probcal.tree import Residuals

VALUES = 4_000_000  # of all states that are drawn at once
LEAST, MOST = 10, 250  # draws of a chain
DATA = 10_000_000  # values by datum and draw up to which every chain has the most draws


class Drawn(NamedTuple):
    """Draws of trajectories and of what hangs on them; empty where it was not asked for."""

    states: tuple[jax.Array, ...]  # (D, E, n) of each recursion
    log_likelihood: list[jax.Array]  # (D, N, C) of each block
    replicas: list[jax.Array]  # (D, N, C) of each block


def draws_a_chain(data: int, chains: int) -> int:
    """How many draws each chain of an approximation has: fewer where the data are many, with no step on the way."""
    return int(np.clip(DATA // max(chains * data, 1), LEAST, MOST))


def _passes(system: System, count: int) -> int:
    """The least divisor of `count` that keeps the draws of one pass within `VALUES`."""
    most = max(1, VALUES // sum(part.drift.size for part in system.recursions))
    return next(k for k in range(1, count + 1) if count % k == 0 and count // k <= most)


@partial(jax.jit, static_argnames="count")
def draw_biases(point: Point, covariance: jax.Array, key: jax.Array, count: int) -> jax.Array:
    """Draws (D, M) of the biases from a Gaussian around a point."""
    M = point.z.shape[0]
    root = linalg.factor(covariance) if M else jnp.zeros((0, 0))
    return point.z[None, :] + jax.random.normal(key, (count, M)) @ root.T


def draw(
    spec: Spec, system: System, point: Point, covariance: jax.Array, z: jax.Array, levels: jax.Array, key: jax.Array,
    keep: tuple[str, ...] = ("states",),
) -> tuple[Drawn, list[Moments]]:  # fmt: skip
    """A trajectory for each draw of the biases z (D, M), what is to be kept of them, and their exact moments.

    `levels` (H,) or (D, H) are those of the densities and replicas. `keep` names "states", "log_likelihood",
    "replicas". Many draws of many epochs are made in passes, of which only what is kept stays.
    """
    levels = jnp.broadcast_to(levels, (z.shape[0], point.levels.shape[0]))
    return _draw(spec, system, point, covariance, z, levels, key, keep, _passes(system, z.shape[0]))


@partial(jax.jit, static_argnames=("spec", "keep", "passes"))
def _draw(
    spec: Spec, system: System, point: Point, covariance: jax.Array, z: jax.Array, levels: jax.Array, key: jax.Array,
    keep: tuple[str, ...], passes: int,
) -> tuple[Drawn, list[Moments]]:  # fmt: skip
    """Trajectories given z by the simulation smoother (draw from the prior, subtract its smoothed self).

    All draws are columns of one pass. The response of the trajectory to z is linear.
    """
    lins = linearise(spec, system, point, expected=True)
    compressed, crosses = of_states(spec, system, lins, point.states), of_both(spec, system, lins, point.states)
    known, found = [], []
    for part, (J, _), cross in zip(system.recursions, compressed, crosses, strict=True):
        L = factors(part, point.levels)
        gain = rec.gains(part.F, L, J)
        response = rec.smooth(part.F, L, J, gain, cross)
        values, vectors = linalg.spectrum(J)
        half = vectors * jnp.sqrt(jnp.maximum(values, 0.0))[:, None, :]
        known.append((part, L, J, gain, half))
        found.append(moments_of(part, L, J, gain, response, covariance))

    def trajectories(dz: jax.Array, seed: jax.Array) -> tuple[jax.Array, ...]:
        drawn = []
        for r, (part, L, J, gain, half) in enumerate(known):
            noise = jax.random.normal(jax.random.fold_in(seed, r), (2, *part.drift.shape, len(dz)))
            prior = rec.trajectory(part.F, L, jnp.zeros((*part.drift.shape, 1)), noise[0])
            smooth = rec.smooth(part.F, L, J, gain, J @ prior + half @ noise[1])
            free = prior - smooth.states + found[r].response @ dz.T
            drawn.append(jnp.moveaxis(point.states[r][:, :, None] + free, 2, 0))
        return tuple(drawn)

    def one_pass(given: tuple[jax.Array, jax.Array, jax.Array]) -> Drawn:
        z, levels, seed = given
        states = trajectories(z - point.z[None, :], seed)
        log_likelihood, replicas = _by_datum(spec, system, levels, z, states, jax.random.fold_in(seed, 2**31 - 1), keep)
        return Drawn(states if "states" in keep else (), log_likelihood, replicas)

    def split(a: jax.Array) -> jax.Array:
        return a.reshape(passes, a.shape[0] // passes, *a.shape[1:])

    drawn = jax.lax.map(one_pass, (split(z), split(levels), jax.random.split(key, passes)))
    return jax.tree.map(lambda a: a.reshape(z.shape[0], *a.shape[2:]), drawn), found


def _by_datum(
    spec: Spec, system: System, levels: jax.Array, z: jax.Array, states: tuple[jax.Array, ...], key: jax.Array,
    keep: tuple[str, ...],
) -> tuple[list[jax.Array], list[jax.Array]]:  # fmt: skip
    """Log-likelihood and replicas (D, N, C) of each block at draws, one draw after the other; empty if not kept."""
    wanted = "log_likelihood" in keep, "replicas" in keep
    if not any(wanted):
        return [], []

    def one(draw: Any) -> tuple[list[jax.Array], list[jax.Array]]:
        levels_d, z_d, states_d, seed = draw
        density, replicas = [], []
        for b, (block, data, r) in enumerate(zip(spec.blocks, system.rows, spec.recursion, strict=True)):
            predicted = rows.predict(block, data, states_d[r], z_d)
            if wanted[0]:
                density.append(rows.log_likelihood(block, data, predicted, levels_d))
            if wanted[1]:
                replicas.append(rows.sample(block, data, predicted, levels_d, jax.random.fold_in(seed, b)))
        return density, replicas

    return jax.lax.map(one, (levels, z, states, jax.random.split(key, z.shape[0])))


predictive = partial(jax.jit, static_argnames=("spec", "keep"))(_by_datum)


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
