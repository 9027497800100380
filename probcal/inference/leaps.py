"""Leaps from one sparse answer to another, proposed by Gibbs on the frame and taken by the joint posterior."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from probcal.gaussian.frame import log_weight
from probcal.gaussian.search import chosen
from probcal.inference.gibbs import reversible_sweeps
from probcal.inference.hierarchy import Phi
from probcal.inference.posed import Form, Posed
from probcal.model.trajectories import States


class Place(NamedTuple):
    """The position of a chain, in the coordinates of the Gaussian reference."""

    theta: jax.Array  # (Q,)
    eps: States
    phi: Phi
    weight: jax.Array  # log weight


def leap(form: Form, posed: Posed, at: Place, key: jax.Array, tries: int, sweeps: int) -> tuple[Place, jax.Array]:
    """Some tries to leap from a place: where they end, and the mean acceptance.

    A try is a few Gibbs sweeps on the frame's Gaussian likelihood, which move hyper-parameters and biases together,
    taken or refused by the weight of the joint posterior (surrogate transition, Liu 2001; delayed acceptance, Christen,
    Fox 2005): a gradient leads from one sparse answer to another only through what fits neither.
    """

    def one(at: Place, key: jax.Array) -> tuple[Place, jax.Array]:
        run, lot = jax.random.split(key)
        theta, phi = reversible_sweeps(form, posed, at.theta, at.phi, run, sweeps)
        tried = Place(theta, at.eps, phi, log_weight(posed.model, posed.frame, theta, at.eps))
        rate = jnp.exp(jnp.minimum(tried.weight - at.weight, 0.0))
        taken = jax.random.uniform(lot) < rate
        return chosen(taken, tried, at), jnp.nan_to_num(rate)

    at, rates = jax.lax.scan(one, at, jax.random.split(key, tries))
    return at, jnp.mean(rates)
