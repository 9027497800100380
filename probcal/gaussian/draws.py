"""Independent draws of trajectories from the Laplace approximation at a point, and what the data say at each."""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal import linalg
from probcal.gaussian import recursion as rec
from probcal.gaussian.engine import Expansion
from probcal.gaussian.mode import Eliminated, Point
from probcal.model.model import At, Data, Model
from probcal.model.rows import Linearised
from probcal.model.trajectories import States
from probcal.simulate import derived_keys, standard_normals

PASS = 200  # draws that are made at once
VALUES = 4_000_000  # of all states that are drawn at once, at most
LEAST, MOST = 10, 250  # draws of a chain
DATA = 10_000_000  # values by datum and draw up to which every chain has the most draws
LARGE = 500_000  # data above which only the sum of their log-likelihoods is kept of a draw


class JointDraws(NamedTuple):
    """Draws of trajectories and of what hangs on them; empty where it was not asked for."""

    states: States  # (D, E, n) of each recursion
    log_likelihood: Data  # (D, N, C) of each block, (D, 1, 1) in sum where data are many (`many_data`)
    replicas: Data  # (D, N, C) of each block


def many_data(model: Model) -> bool:
    """True if data are too many for a value of each and of each draw to be kept."""
    return sum(int(np.asarray(mask).sum()) for mask in model.measured) > LARGE


def draws_a_chain(data: int, chains: int) -> int:
    """The number of draws per chain of an approximation: fewer where the data are many, without a jump."""
    return int(np.clip(DATA // max(chains * data, 1), LEAST, MOST))


@partial(jax.jit, static_argnames="count")
def draw_biases(point: Point, covariance: jax.Array, key: jax.Array, count: int) -> jax.Array:
    """Draws (D, M) of the biases from a Gaussian around a point."""
    M = point.z.shape[0]
    root = linalg.factor_and_inverse(covariance)[0] if M else jnp.zeros((0, 0))
    return point.z[None, :] + jax.random.normal(key, (count, M)) @ root.T


def draw(
    at: Expansion, z: jax.Array, levels: jax.Array, key: jax.Array, keep: tuple[str, ...] = ("states",)
) -> JointDraws:
    """A trajectory for each draw of the biases z (D, M), and what is to be kept of them.

    `levels` (H,) or (D, H) are those of the densities and replicas. `keep` names "states", "log_likelihood",
    "replicas". Draws are made in passes of one size, whatever their number, and of each only what is kept stays.
    """
    count = z.shape[0]
    size = max(1, min(PASS, count, VALUES // at.model.state_size))
    biases, log_levels = np.asarray(z), np.broadcast_to(np.asarray(levels), (count, at.point.levels.shape[0]))
    passes, large = [], many_data(at.model)
    for k, start in enumerate(range(0, count, size)):
        chosen = np.minimum(np.arange(start, start + size), count - 1)  # the last pass is filled with its last draw
        seeds = derived_keys(key, (2 * k, 2 * k + 1))
        mine = jax.device_put(biases[chosen])
        states = draw_trajectories(at, mine, seeds[0])
        by_datum = ((), ())
        if {"log_likelihood", "replicas"} & set(keep):
            told, again = predictive(at.model, log_levels[chosen], mine, states, seeds[1], keep)
            by_datum = tuple(part.sum((1, 2), keepdims=True) for part in told) if large else told, again
        kept = JointDraws(states if "states" in keep else (), *by_datum)
        passes.append(jax.tree.map(lambda leaf, most=count - start: np.asarray(leaf)[:most], kept))
    return jax.tree.map(lambda *parts: np.concatenate(parts), *passes)


def draw_trajectories(at: Expansion, z: jax.Array, key: jax.Array) -> States:
    """Trajectories (D, E, n) of each recursion given biases z (D, M).

    Draws from the motion, less their smoothed selves, all as columns of one pass (Durbin and Koopman 2002).
    """
    drawn = simulated(at, _pulled(at.model, at.point, at.rows, z), key)
    xp = linalg.library(*jax.tree.leaves(drawn))
    pairs = at.model.each_layout(at.point.states, drawn)
    return tuple(xp.moveaxis(xp.asarray(x)[:, :, None] + xp.asarray(apart), 2, 0) for _, x, (apart, _) in pairs)


def simulated(at: Expansion, pulls: Sequence[Any], key: jax.Array) -> list[tuple[jax.Array, jax.Array]]:
    """Trajectories (E, n, D) drawn from the motion less the smoothed ones of their data, and the noises of these.

    `pulls` (E, n, D) are added to the scores of the states.
    """
    given = [(own.L, own.half) for own in at.given_biases()]
    noises = standard_normals(key, [(2, *pull.shape) for pull in pulls])
    return _simulated(at.model, at.eliminated, given, tuple(pulls), noises)


@jax.jit
def _simulated(
    model: Model,
    solved: Eliminated,
    roots: Sequence[tuple[jax.Array, jax.Array]],
    pulls: Sequence[Any],
    noises: Sequence[Any],
) -> list[tuple[jax.Array, jax.Array]]:
    found = []
    for part, (L, half), kept, pull, (moves, scores) in model.each_layout(roots, solved.parts, pulls, noises):
        prior = rec.trajectory(part.F, L, jnp.zeros((*part.drift.shape, 1)), moves)
        smooth = rec.smooth(part.F, kept.gain, kept.J @ prior + half @ scores + pull)
        found.append((prior - smooth.states, smooth.noises))
    return found


@jax.jit
def _pulled(model: Model, point: Point, rows: Sequence[Linearised], z: jax.Array) -> States:
    """The pull on the states (E, n, D) of biases z (D, M) in the place of a point's."""
    along = model.by_bias(rows, (z - point.z[None, :]).T)
    weighted = tuple(lin.weight[:, :, None] * own for *_, lin, own in model.each_block(rows, along))
    return tuple(model.onto_states(rows, weighted))


@partial(jax.jit, static_argnames="keep")
def predictive(
    model: Model, levels: jax.Array, z: jax.Array, states: States, key: jax.Array, keep: tuple[str, ...]
) -> tuple[Data, Data]:
    """Log-likelihood and replicas (D, N, C) of every datum at draws, one draw after the other; empty if not kept."""

    def one(draw: Any) -> tuple[Data, Data]:
        levels, z, states, number = draw
        at = At(states, z, levels)
        density = model.log_likelihood(at) if "log_likelihood" in keep else ()
        return density, model.sample(at, jax.random.fold_in(key, number)) if "replicas" in keep else ()

    return jax.lax.map(one, (levels, z, states, jnp.arange(len(z))))


class Remainder(NamedTuple):
    """The residual statistics of every datum at a point, zero where missing."""

    innovation: Data
    std: Data  # noise level
    reliance: Data  # 1 inlying, towards 0 outlying
    square: Data  # 1 expected
    log_likelihood: Data


@jax.jit
def residuals(model: Model, point: Point) -> Remainder:
    """Remainders of every datum at a point."""
    parts = model.innovation, model.spread_of_noise, model.reliance, model.square, model.log_likelihood
    return Remainder(*(part(point) for part in parts))
