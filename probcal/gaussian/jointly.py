"""The joint Gaussian of states and biases, by what any engine gives.

Trajectories are eliminated: with W the precision of all states given the biases and C that between
both, the covariance times slopes (b, g) is (W^-1 (b - C dz), dz), dz = S (g - C' W^-1 b), S the
covariance of the biases. `held_states` and the gains of `eliminated` answer for W^-1, `solve` for S.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from probcal.gaussian import recursion as rec
from probcal.gaussian.engine import Expansion, Factors
from probcal.model.model import Data, Model
from probcal.model.rows import Linearised

Gains = tuple[rec.Gains, ...]  # of each recursion
Rows = tuple[Linearised, ...]  # of each block


class Variables(NamedTuple):
    """K columns of states and biases: changes of them, or slopes by them."""

    states: tuple[Any, ...]  # (E, n, K) of each recursion
    z: Any  # (M, K)


class Embedded(NamedTuple):
    """The data about K further parameters at zero, the trajectories and biases eliminated."""

    information: jax.Array  # (K, K)
    score: jax.Array  # (K,)


def covariance_times(at: Expansion, factors: Factors, slopes: Variables) -> Variables:
    """Joint posterior covariance of states and biases times slopes by them."""
    gains = tuple(kept.gain for kept in at.eliminated.parts)
    held, left = _held(at.model, at.rows, gains, tuple(at.held_states), slopes)
    dz = jnp.asarray(at.solve(factors, left))
    return Variables(_followed(at.model, at.rows, gains, held, dz), dz)


def embedded(at: Expansion, factors: Factors, columns: Data) -> Embedded:
    """Information and score of K more parameters, by which predicted values change as columns (N, C,
    K)."""
    found = covariance_times(at, factors, slopes_of(at.model, at.rows, columns))
    moved = at.point.states, at.moved(jnp.zeros_like(at.point.z)).states
    slope = jnp.asarray(at.slope() + factors.pull(at.point.z))
    return _embedded(at.model, moved, at.rows, slope, columns, found)


def times_weights(model: Model, rows: Rows, columns: Data) -> Data:
    """Columns (N, C, K) of the data times their weights."""
    return tuple(lin.weight[:, :, None] * own for *_, lin, own in model.each_block(rows, columns))


def follow_biases(model: Model, rows: Rows, gains: Gains, dz: jax.Array) -> tuple[rec.Smoothed, ...]:
    """Changes (E, n, K) of states and noises that follow the biases by dz (M, K), by columns of the
    rows: no (E, n, M) is made."""
    pulls = model.onto_states(rows, times_weights(model, rows, model.by_bias(rows, -dz)))
    return model.each(lambda part, gain, b: rec.smooth(part.F, gain, b), gains, pulls)


@jax.jit
def slopes_of(model: Model, rows: Rows, columns: Data) -> Variables:
    """Slopes by states and biases of what the data say along columns (N, C, K)."""
    own = times_weights(model, rows, columns)
    return Variables(tuple(model.onto_states(rows, own)), model.onto_biases(rows, own))


@jax.jit
def _held(
    model: Model, rows: Rows, gains: Gains, spread: tuple[jax.Array, ...], slopes: Variables
) -> tuple[tuple[jax.Array, ...], jax.Array]:
    """Changes (E, n, K) of the states at held biases, and the slope (M, K) that these leave to the biases."""
    held = model.each(lambda _, gain, own, b: rec.respond(gain, own, b), gains, spread, slopes.states)
    return held, slopes.z - model.onto_biases(rows, times_weights(model, rows, model.by_state(rows, held)))


@jax.jit
def _followed(
    model: Model, rows: Rows, gains: Gains, held: tuple[jax.Array, ...], dz: jax.Array
) -> tuple[jax.Array, ...]:
    return jax.tree.map(lambda own, by: own + by.states, held, follow_biases(model, rows, gains, dz))


@jax.jit
def _embedded(
    model: Model, moved: tuple[Any, ...], rows: Rows, slope: jax.Array, columns: Data, found: Variables
) -> Embedded:
    """Columns less what states and biases make up for, and their score where the tracks have moved to their modes."""
    left = jax.tree.map(jnp.subtract, tuple(columns), model.responses(rows, *found))
    away = [(after - before)[:, :, None] for _, before, after in model.each_layout(*moved)]
    information, score = jnp.zeros((found.z.shape[1],) * 2), -found.z.T @ slope
    parts = model.each_block(rows, columns, times_weights(model, rows, left), model.by_state(rows, away))
    for *_, lin, own, rest, by in parts:
        information = information + jnp.einsum("nck,ncl->kl", own, rest)
        score = score + jnp.einsum("nck,nc->k", own, lin.score - lin.weight * by[:, :, 0])
    return Embedded(information, score)
