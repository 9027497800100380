"""Draws from a problem's own prior: hyper-parameters, biases, noise levels, trajectories, and the data they give."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal import linalg
from probcal.errors import InputError
from probcal.gaussian.mode import Point, driven_states
from probcal.inference.hierarchy import Phi
from probcal.inference.posed import Form
from probcal.model.model import Model
from probcal.priors import ARD, Flat, Precision, Prior
from probcal.problem import Problem


class SimulatedTruth(NamedTuple):
    """One simulated truth and its data."""

    phi: Phi
    point: Point
    y: tuple[jax.Array, ...]  # (N, C) of each block


def check_drawable(prior: Prior, problem: Problem) -> None:
    """Raise `InputError` for a prior that is no distribution, of which no truth can be drawn."""
    if problem.surveyed.all():
        return
    parts, part = prior.parts(problem.biases)
    governing = [parts[k][1] for k in set(part[~problem.surveyed].tolist())]
    if any(isinstance(one, Flat) or (isinstance(one, ARD) and one.rate == 0.0) for one in governing):
        raise InputError(
            f"no truth can be drawn from {prior!r}, whose density has no integral: simulate from a proper prior such as"
            " Gaussian(), ARD(rate=0.5), Horseshoe() or BernoulliGaussian()"
        )


@partial(jax.jit, static_argnames="form")
def draw_prior(form: Form, model: Model, first: Precision, key: jax.Array) -> SimulatedTruth:
    """A truth from the prior and its data: hyper-parameters, biases given them, levels, trajectories, every row."""
    keys = jax.random.split(key, 5)
    phi = form.hierarchy.draw(keys[0])
    alpha = form.hierarchy.alpha(phi, first.alpha)
    _, inverse = linalg.factor_and_inverse(jnp.diag(alpha) + first.coupled())
    z = inverse.T @ jax.random.normal(keys[1], alpha.shape)
    z = jnp.where(form.hierarchy.active(phi, form.biases), z, 0.0)
    levels = model.level_spread * jax.random.normal(keys[2], model.level_spread.shape)
    noises = tuple(model.draw_noises(keys[3], r, 1)[:, :, 0] for r in range(len(model.recursions)))
    states = model.each(lambda part, u: driven_states(part, levels, u), noises)
    point = Point(states, noises, z, levels)
    return SimulatedTruth(phi, point, draw_data(model, point, keys[4]))


@jax.jit
def draw_data(model: Model, point: Point, key: jax.Array) -> tuple[jax.Array, ...]:
    """Measured values (N, C) of each block at a point; 0 where the problem has none."""
    return model.with_values(model.sample(point, key)).values


def far_start(problem: Problem) -> float:
    """The width of a target's start in network extents: above 1, prior tracks pass far from it."""
    widest = 0.0
    for part, epochs in problem.model.each_layout(problem.epochs):
        begins = ~np.asarray(part.F).any((1, 2))
        spread = np.sqrt((np.asarray(part.L) ** 2).sum(2))[begins][:, slice(*epochs.position)]
        widest = max(widest, float(spread.max(initial=0.0)))
    return widest / problem.extent
