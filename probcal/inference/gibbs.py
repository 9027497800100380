"""Gibbs sweeps on a Gaussian likelihood: what the pilot, the samplers and integrated precisions share."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from probcal.inference.hierarchy import Phi
from probcal.inference.posed import Form, Quadratic, draw_given, update_inclusions
from probcal.priors import Precision


@partial(jax.jit, static_argnames="form")
def draw_hyper(form: Form, phi: Phi, z: jax.Array, key: jax.Array) -> Phi:
    """Hyper-parameters drawn anew given the biases (M,)."""
    learnt = jnp.asarray(form.hierarchy.learnt, int)
    for k, update in enumerate(form.hierarchy.updates()):
        phi = update(phi, z[learnt], jax.random.fold_in(key, k))
    return phi


@partial(jax.jit, static_argnames="form")
def precisions(form: Form, phi: Phi, first: Precision) -> jax.Array:
    """Precisions (M,) of the biases given the hyper-parameters."""
    return form.hierarchy.alpha(phi, first.alpha)


def log_prior_of(form: Form, phi: Phi, first: Precision, z: np.ndarray) -> float:
    """Log density of biases (M,) and hyper-parameters, that of a flat prior counting as one."""
    known = first._replace(alpha=precisions(form, phi, first))
    constant = np.log(2 * np.pi) * np.count_nonzero(known.alpha)
    own = float(known.log_determinant() - known.square(jnp.asarray(z))) - constant
    return 0.5 * own + float(form.hierarchy.log_prior(phi))


def gibbs_sweep(
    form: Form, posed: Quadratic, theta: jax.Array, phi: Phi, key: jax.Array, *, backwards: bool
) -> tuple[jax.Array, Phi]:
    """Gibbs on the frame: hyper-parameters given the biases, then theta given them, or `backwards`."""
    kind = form.hierarchy
    learnt = jnp.asarray(kind.learnt, int)

    def hyper(k: int, theta: jax.Array, phi: Phi, key: jax.Array) -> tuple[jax.Array, Phi]:
        return theta, kind.updates()[k](phi, theta[learnt], key)

    def biases(theta: jax.Array, phi: Phi, key: jax.Array) -> tuple[jax.Array, Phi]:
        if kind.spiked:
            phi = update_inclusions(form, posed, phi, jax.random.fold_in(key, 1), backwards=backwards)
        return draw_given(form, posed, phi, key), phi

    steps = [lambda t, p, s, k=k: hyper(k, t, p, s) for k in range(len(kind.updates()))] + [biases]
    for step, own in zip(steps[::-1] if backwards else steps, jax.random.split(key, len(steps)), strict=True):
        theta, phi = step(theta, phi, own)
    return theta, phi


def reversible_sweeps(
    form: Form, posed: Quadratic, theta: jax.Array, phi: Phi, key: jax.Array, sweeps: int
) -> tuple[jax.Array, Phi]:
    """Sweeps, all forwards or all backwards by a coin: reversible under the frame's posterior."""
    keys = jax.random.split(key, sweeps + 1)

    def run(backwards: bool) -> Any:
        def one(carry: tuple[jax.Array, Phi], own: jax.Array) -> tuple[tuple[jax.Array, Phi], None]:
            return gibbs_sweep(form, posed, *carry, own, backwards=backwards), None

        return lambda: jax.lax.scan(one, (theta, phi), keys[1:])[0]

    return jax.lax.cond(jax.random.bernoulli(keys[0]), run(True), run(False))
