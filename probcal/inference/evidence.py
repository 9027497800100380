"""The evidence of a problem under a prior, hyper-parameters integrated: which sensor model, prior, drift or none."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal.errors import FitError, InputError
from probcal.gaussian.choose import choose
from probcal.gaussian.mode import Point
from probcal.inference.gibbs import gibbs_sweep
from probcal.inference.hierarchy import Phi
from probcal.inference.method import Context
from probcal.inference.methods import MAP, check_problem
from probcal.inference.pose import pareto_khat, pose, weights
from probcal.inference.posed import Form, Posed, conditional, draw_given, prior_precision
from probcal.inference.psis import smoothed
from probcal.inference.solve import solve
from probcal.modes import automatic_start
from probcal.priors import AnyPrior, Flat, Horseshoe, Prior, as_prior
from probcal.problem import Problem
from probcal.simulate import Key, as_key
from probcal.types import float64

RUNS, PARTICLES = 8, 50  # independent runs, and the hyper-parameters that each of them carries
SWEEPS = 3  # Gibbs sweeps at every temperature, times those between two draws of a sampler
LEAST = 0.5  # effective share of the particles that the step to the next temperature leaves
GROWTH = 8.0  # most times that such a step is longer than the one before
SHORTEST = 1e-30  # step that is taken whatever it leaves


class Evidence(NamedTuple):
    """Log evidence in nats, its standard error, and the Pareto k-hat of its correction.

    The k-hat is NaN where nothing is corrected.
    """

    value: float
    error: float
    khat: float


@float64
def log_evidence(problem: Problem, *, prior: AnyPrior = None, key: Key = 0, start: Point | None = None) -> Evidence:
    """Log of the density of the data under a prior (`Horseshoe()` by default), everything unknown integrated.

    The frame marginalises trajectories (Laplace), and biases and noise levels given the hyper-parameters, in closed
    form; the latter are integrated by sequential Monte Carlo from their prior to their posterior (Del Moral, Doucet,
    Jasra 2006). Importance weights correct what the frame leaves out: where `khat` is above 0.7 they, and the error,
    are not to be trusted. Under a `Gaussian` prior a linear-Gaussian problem has its evidence to rounding.
    A large network has that of Laplace's formula at the mode, under a `Gaussian` prior.
    Raises `InputError` for a flat prior, which has no evidence, for process noise that is not
    Gaussian, and for a large network with another prior or with noise levels that are unknown.
    """
    chosen = as_prior(prior, Horseshoe(), problem.network.labels)
    if isinstance(chosen, Flat):
        raise InputError("log_evidence: a flat prior has no evidence; give a proper one")
    check_problem(problem)
    if problem.model.tailed:
        raise InputError(
            "log_evidence: the frame is no match for process noise that is not Gaussian; compare the"
            " log predictive densities of two fits, as `probcal compare` does"
        )
    if not choose(problem.model).cheap:
        return _at_mode(problem, chosen, key, start)
    keys = jax.random.split(as_key(key), 3)
    point = automatic_start(problem) if start is None else start
    form, posed, _, _ = pose(problem, chosen, point, keys[0], whole=True)
    runs = tempered_runs(form, posed, keys[1])
    corrections = np.asarray(weights(posed, runs.theta, jax.random.split(keys[2], len(runs.theta))))
    khat = pareto_khat(corrections)
    if khat > 0:
        smooth = smoothed(corrections[None])[0][0]
        corrections = smooth + (corrections - smooth)[corrections.argmin()]  # smoothing leaves the small weights alone
    value, spread = combined(runs.evidence + _log_mean(corrections.reshape(RUNS, PARTICLES)))
    return Evidence(value, max(spread, runs.error), khat)


def _at_mode(problem: Problem, prior: Prior, key: Key, start: Point | None) -> Evidence:
    """The evidence under a Gaussian prior by Laplace's formula at the mode, on an engine."""
    method = MAP()
    if not method.takes(prior) or prior.learns or problem.levels:
        raise InputError(
            "log_evidence on a network of this size takes precisions and noise levels that are given:"
            " Gaussian(), and a std for every noise"
        )
    answer = solve(problem, method, prior, Context(as_key(key)), start=start)
    if not answer.status.valid:
        raise FitError(answer.message)
    error = answer.posterior.attrs.get("log_evidence_error", 0.0)
    return Evidence(answer.objective, float(error), float("nan"))


def combined(logs: np.ndarray) -> tuple[float, float]:
    """Log of the mean of independent estimates whose logs (R,) are given, and its standard error.

    The error is the sd of Student's t of R - 1 degrees of freedom, sqrt((R - 1) / (R - 3)) times the usual one.
    """
    relative, count = np.exp(logs - logs.max()), len(logs)
    usual = relative.std(ddof=1) / relative.mean() / np.sqrt(count)
    return float(_log_mean(logs)), float(usual * np.sqrt((count - 1) / (count - 3)))


class Runs(NamedTuple):
    """Runs of sequential Monte Carlo from the prior to the frame's posterior."""

    evidence: np.ndarray  # (RUNS,) log evidence of the frame by each
    error: float  # of the log of their mean, at the least: that of independent particles of the ESS of every step
    theta: jax.Array  # (RUNS * PARTICLES, Q) draws of the frame's posterior, run by run


def tempered_runs(form: Form, posed: Posed, key: jax.Array) -> Runs:
    """Integrate the hyper-parameters, the frame's likelihood raised to a power that goes from 0 to 1.

    Each step is as long as `LEAST` allows. Particles are weighed by the likelihood with theta integrated, resampled
    within their run, and moved by Gibbs sweeps.
    """
    keys, count = jax.random.split(key), RUNS * PARTICLES
    phi = _drawn(form, jax.random.split(keys[0], count))
    power, step, rung, variance = 0.0, 1.0, 0, 0.0
    before, total = np.zeros(count), np.zeros(RUNS)
    while power < 1.0:
        step = min(GROWTH * step, 1.0 - power)
        gain = _marginals(form, tempered(posed, power + step), phi) - before
        while effective(gain) < LEAST * count and step > SHORTEST:
            step /= 2.0
            gain = _marginals(form, tempered(posed, power + step), phi) - before
        power, rung = power + step, rung + 1
        total += _log_mean(gain.reshape(RUNS, PARTICLES))
        variance += 1.0 / effective(gain) - 1.0 / count
        own, now = jax.random.split(jax.random.fold_in(keys[1], rung)), tempered(posed, power)
        phi, theta = _moved(form, now, resampled(phi, gain, own[0]), jax.random.split(own[1], count))
        before = _marginals(form, now, phi)
    return Runs(total, float(np.sqrt(max(variance, 0.0))), theta)


def tempered(posed: Posed, power: float) -> Posed:
    """The posterior with the frame's likelihood to a power."""
    frame = posed.frame
    information, score, height = (power * part for part in (frame.information, frame.score, frame.height))
    return posed._replace(frame=frame._replace(information=information, score=score, height=height))


def log_marginal(form: Form, posed: Posed, phi: Phi) -> jax.Array:
    """Log density of the data given the hyper-parameters, theta integrated in closed form."""
    given = conditional(form, posed, phi)
    _, coupling = prior_precision(form, posed, phi)
    square = jnp.sum(given.alpha * given.mean**2) + given.mean @ (coupling @ given.mean)
    prior = jnp.sum(jnp.where(given.active, jnp.log(given.alpha), 0.0)) + posed.first.logdet
    volume = jnp.sum(jnp.log(jnp.diagonal(given.factor)))
    return posed.frame.log_likelihood(given.mean) - 0.5 * square + 0.5 * prior - volume


def effective(logs: np.ndarray) -> float:
    """Effective number of particles of log weights (D,)."""
    weight = np.exp(logs - logs.max())
    return float(weight.sum() ** 2 / (weight**2).sum())


def resampled(phi: Phi, logs: np.ndarray, key: jax.Array) -> Phi:
    """Particles drawn anew by their log weights (RUNS * PARTICLES,), systematically within each run."""
    logs = logs.reshape(RUNS, PARTICLES)
    above = np.cumsum(np.exp(logs - logs.max(1, keepdims=True)), 1)
    marks = (np.arange(PARTICLES) + np.asarray(jax.random.uniform(key, (RUNS, 1)))) / PARTICLES * above[:, -1:]
    picks = np.sum(above[:, None, :] < marks[:, :, None], 2) + PARTICLES * np.arange(RUNS)[:, None]
    return jax.tree.map(lambda leaf: np.asarray(leaf)[picks.ravel()], phi)


def _log_mean(logs: np.ndarray) -> np.ndarray:
    """Log of the mean of exponentials along the last axis."""
    most = logs.max(-1, keepdims=True)
    return most[..., 0] + np.log(np.exp(logs - most).mean(-1))


@partial(jax.jit, static_argnames="form")
def _drawn(form: Form, keys: jax.Array) -> Phi:
    """Hyper-parameters from their prior, a draw for every key."""
    return jax.vmap(form.hierarchy.draw)(keys)


def _marginals(form: Form, posed: Posed, phi: Phi) -> np.ndarray:
    """`log_marginal` of every particle, (RUNS * PARTICLES,)."""
    return np.asarray(_all_marginals(form, posed, phi))


@partial(jax.jit, static_argnames="form")
def _all_marginals(form: Form, posed: Posed, phi: Phi) -> jax.Array:
    numbers = jnp.arange(RUNS * PARTICLES)  # a known prior has no hyper-parameters to map over
    return jax.lax.map(lambda pair: log_marginal(form, posed, pair[0]), (phi, numbers))


@partial(jax.jit, static_argnames="form")
def _moved(form: Form, posed: Posed, phi: Phi, keys: jax.Array) -> tuple[Phi, jax.Array]:
    """Hyper-parameters after some Gibbs sweeps, and theta (D, Q) given them."""

    def one(pair: tuple[Phi, jax.Array]) -> tuple[jax.Array, Phi]:
        phi, key = pair
        keys = jax.random.split(key, SWEEPS * form.hierarchy.sweeps + 1)
        theta = draw_given(form, posed, phi, keys[0])

        def again(carry: tuple[jax.Array, Phi], own: jax.Array) -> tuple[tuple[jax.Array, Phi], None]:
            return gibbs_sweep(form, posed, *carry, own, backwards=False), None

        return jax.lax.scan(again, (theta, phi), keys[1:])[0]

    theta, phi = jax.lax.map(one, (phi, keys))
    return phi, theta
