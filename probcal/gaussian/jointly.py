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
from probcal.model.rows import LinearRows
from probcal.model.trajectories import States

Gains = tuple[rec.Gains, ...]  # of each recursion


class Variables(NamedTuple):
    """K columns of states and biases: changes of them, or slopes by them."""

    states: tuple[Any, ...]  # (E, n, K) of each recursion
    z: Any  # (M, K)


def covariance_times(at: Expansion, factors: Factors, slopes: Variables) -> Variables:
    """Joint posterior covariance of states and biases times slopes by them."""
    gains = tuple(kept.gain for kept in at.eliminated.parts)
    held, left = _held(at.model, at.rows, gains, tuple(at.held_states), slopes)
    dz = jnp.asarray(at.solve(factors, left))
    return Variables(_followed(at.model, at.rows, gains, held, dz), dz)


def times_weights(model: Model, rows: LinearRows, columns: Data) -> Data:
    """Columns (N, C, K) of the data times their weights."""
    return tuple(lin.weight[:, :, None] * own for *_, lin, own in model.each_block(rows, columns))


def follow_biases(model: Model, rows: LinearRows, gains: Gains, dz: jax.Array) -> tuple[rec.Smoothed, ...]:
    """Changes (E, n, K) of states and noises that follow the biases by dz (M, K), by columns of the
    rows: no (E, n, M) is made."""
    pulls = model.onto_states(rows, times_weights(model, rows, model.by_bias(rows, -dz)))
    return model.each(lambda part, gain, b: rec.smooth(part.F, gain, b), gains, pulls)


@jax.jit
def _held(model: Model, rows: LinearRows, gains: Gains, spread: States, slopes: Variables) -> tuple[States, jax.Array]:
    """Changes (E, n, K) of the states at held biases, and the slope (M, K) that these leave to the biases."""
    held = model.each(lambda _, gain, own, b: rec.respond(gain, own, b), gains, spread, slopes.states)
    return held, slopes.z - model.onto_biases(rows, times_weights(model, rows, model.by_state(rows, held)))


@jax.jit
def _followed(model: Model, rows: LinearRows, gains: Gains, held: States, dz: jax.Array) -> States:
    return jax.tree.map(lambda own, by: own + by.states, held, follow_biases(model, rows, gains, dz))
