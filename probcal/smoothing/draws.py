"""Independent draws of trajectories from the Laplace approximation at a point, and what the data say at each."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal import linalg
from probcal.model.model import At, Data, Model
from probcal.smoothing import recursion as rec
from probcal.smoothing.information import Moments, moments_of
from probcal.smoothing.mode import Point, factors
from probcal.tree import Residuals

VALUES = 4_000_000  # of all states that are drawn at once
LEAST, MOST = 10, 250  # draws of a chain
DATA = 10_000_000  # values by datum and draw up to which every chain has the most draws


class Drawn(NamedTuple):
    """Draws of trajectories and of what hangs on them; empty where it was not asked for."""

    states: tuple[jax.Array, ...]  # (D, E, n) of each recursion
    log_likelihood: Data  # (D, N, C) of each block
    replicas: Data  # (D, N, C) of each block


def draws_a_chain(data: int, chains: int) -> int:
    """How many draws each chain of an approximation has: fewer where the data are many, with no step on the way."""
    return int(np.clip(DATA // max(chains * data, 1), LEAST, MOST))


def _passes(model: Model, count: int) -> int:
    """The least divisor of `count` that keeps the draws of one pass within `VALUES`."""
    most = max(1, VALUES // model.state_size)
    return next(k for k in range(1, count + 1) if count % k == 0 and count // k <= most)


@partial(jax.jit, static_argnames="count")
def draw_biases(point: Point, covariance: jax.Array, key: jax.Array, count: int) -> jax.Array:
    """Draws (D, M) of the biases from a Gaussian around a point."""
    M = point.z.shape[0]
    root = linalg.factor(covariance) if M else jnp.zeros((0, 0))
    return point.z[None, :] + jax.random.normal(key, (count, M)) @ root.T


def draw(
    model: Model, point: Point, covariance: jax.Array, z: jax.Array, levels: jax.Array, key: jax.Array,
    keep: tuple[str, ...] = ("states",),
) -> tuple[Drawn, list[Moments]]:  # fmt: skip
    """A trajectory for each draw of the biases z (D, M), what is to be kept of them, and their exact moments.

    `levels` (H,) or (D, H) are those of the densities and replicas. `keep` names "states", "log_likelihood",
    "replicas". Many draws of many epochs are made in passes, of which only what is kept stays.
    """
    levels = jnp.broadcast_to(levels, (z.shape[0], point.levels.shape[0]))
    return _draw(model, point, covariance, z, levels, key, keep, _passes(model, z.shape[0]))


@partial(jax.jit, static_argnames=("keep", "passes"))
def _draw(
    model: Model, point: Point, covariance: jax.Array, z: jax.Array, levels: jax.Array, key: jax.Array,
    keep: tuple[str, ...], passes: int,
) -> tuple[Drawn, list[Moments]]:  # fmt: skip
    """Trajectories given z by the simulation smoother (draw from the prior, subtract its smoothed self).

    All draws are columns of one pass. The response of the trajectory to z is linear.
    """
    lins = model.linearise(point, expected=True)
    compressed, crosses = model.of_states(lins), model.of_both(lins)
    known, found = [], []
    for part, (J, _), cross in zip(model.recursions, compressed, crosses, strict=True):
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
        log_likelihood, replicas = _by_datum(model, levels, z, states, jax.random.fold_in(seed, 2**31 - 1), keep)
        return Drawn(states if "states" in keep else (), log_likelihood, replicas)

    def split(a: jax.Array) -> jax.Array:
        return a.reshape(passes, a.shape[0] // passes, *a.shape[1:])

    drawn = jax.lax.map(one_pass, (split(z), split(levels), jax.random.split(key, passes)))
    return jax.tree.map(lambda a: a.reshape(z.shape[0], *a.shape[2:]), drawn), found


def _by_datum(
    model: Model, levels: jax.Array, z: jax.Array, states: tuple[jax.Array, ...], key: jax.Array,
    keep: tuple[str, ...],
) -> tuple[Data, Data]:  # fmt: skip
    """Log-likelihood and replicas (D, N, C) of each block at draws, one draw after the other; empty if not kept."""
    wanted = "log_likelihood" in keep, "replicas" in keep
    if not any(wanted):
        return (), ()

    def one(draw: Any) -> tuple[Data, Data]:
        levels, z, states, seed = draw
        at = At(states, z, levels)
        return model.log_likelihood(at) if wanted[0] else (), model.sample(at, seed) if wanted[1] else ()

    return jax.lax.map(one, (levels, z, states, jax.random.split(key, z.shape[0])))


predictive = partial(jax.jit, static_argnames="keep")(_by_datum)


class Remainder(NamedTuple):
    """What is left of every datum at a point, zero where missing."""

    innovation: Data
    std: Data  # noise level
    reliance: Data  # 1 inlying, towards 0 outlying


@jax.jit
def residuals(model: Model, point: Point) -> Remainder:
    """Innovation, noise level and reliance of every datum at a point."""
    return Remainder(model.innovation(point), model.noise_std(point.levels), model.reliance(point))


def residuals_of(model: Model, before: Point, after: Point) -> Residuals:
    """Residuals without and with calibration, at two points."""
    old, new = residuals(model, before), residuals(model, after)
    return Residuals(
        before=[np.asarray(part) for part in old.innovation],
        after=[np.asarray(part) for part in new.innovation],
        std=[np.asarray(part) for part in new.std],
        weight=[np.asarray(part) for part in new.reliance],
    )
