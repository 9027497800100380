"""Draws of a chain, and the kernels that run many steps of it between two checkpoints."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from probcal.inference.hierarchy import Phi
from probcal.inference.posed import Form, Posed, conditional, log_prior
from probcal.smoothing.frame import place


class Sample(NamedTuple):
    """One draw as a sampler sees it, and what it says about itself."""

    theta: jax.Array  # (Q,)
    eps: tuple[jax.Array, ...]
    phi: Phi
    joint: jax.Array  # () log density of data and eps given theta
    stats: dict[str, jax.Array]


class Draw(NamedTuple):
    """One draw as it is kept; a pytree of arrays, with leading dims (draws,) in a chunk."""

    theta: jax.Array  # (Q,) biases, log levels
    phi: Phi
    gamma: jax.Array  # (M,) 1 - alpha Sigma given phi
    variance: jax.Array  # (M,) of each z given phi
    states: tuple[jax.Array, ...]  # (E, n) of each recursion
    density: jax.Array  # () log density of data, eps and theta given phi
    stats: dict[str, jax.Array]


def keep(form: Form, posed: Posed, sample: Sample) -> Draw:
    """What is kept of a draw: gamma and the variance given its hyper-parameters, its trajectories."""
    M = form.biases
    given = conditional(form, posed, sample.phi)
    variance = given.variance[:M]
    gamma = jnp.where(given.active[:M], jnp.clip(1.0 - given.alpha[:M] * variance, 0.0, 1.0), 0.0)
    point = place(posed.model, posed.frame, sample.theta, sample.eps)
    density = sample.joint + log_prior(form, posed, sample.theta, sample.phi)
    return Draw(sample.theta, sample.phi, gamma, variance, point.states, density, sample.stats)


@partial(jax.jit, static_argnames=("method", "form"))
def run_chunk(method: Any, form: Form, posed: Posed, chain: Any) -> tuple[Any, Draw]:
    """`method.chunk` steps of one chain, all kept; leading dims of the draws are (chunk,)."""

    def one(chain: Any, _: None) -> tuple[Any, Draw]:
        chain, sample = method.step(form, posed, chain)
        return chain, keep(form, posed, sample)

    return jax.lax.scan(one, chain, None, length=method.chunk)


run_chunks = jax.jit(jax.vmap(run_chunk, in_axes=(None, None, None, 0)), static_argnums=(0, 1))
