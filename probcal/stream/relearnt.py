"""Sparse priors laid on what a filter of Gaussian priors knows: the likelihood of the biases is taken out of it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from probcal.errors import InputError
from probcal.inference.hierarchy import held as held_biases
from probcal.inference.hierarchy import hierarchy_of, learnt_groups
from probcal.inference.integrate import KEPT, Moments, begin, moments, run_sweeps
from probcal.inference.posed import Form, Natural
from probcal.linalg import invert
from probcal.priors import ARD, PRECISION_BOUNDS, Gaussian, Precision, Prior
from probcal.problem import Problem
from probcal.results.answer import HALF

SWEEPS = 500  # most updates of maximised precisions
STILL = 1e-4  # change of a log precision at which they rest


def relearnt(problem: Problem, prior: Prior, held: Precision, mean: np.ndarray, root: np.ndarray, key: int) -> Moments:
    """Moments of the biases z (M,) under a prior, from N(mean, root root') which they have under the precision `held`.

    Raises `InputError` for a prior that has no precisions.
    """
    inverse = invert(root)
    whole = inverse.T @ inverse
    information, pull = whole - np.asarray(held.matrix()), whole @ mean
    first = problem.first_precision(prior)
    if isinstance(prior, ARD) and prior.rate == 0.0:
        return _maximised(problem, prior, first, information, pull)
    if not prior.hierarchical or isinstance(prior, Gaussian):
        raise InputError(f"under({type(prior).__name__}()): give a prior with precisions, Horseshoe() or ARD()")
    form = Form(problem.model.biases, hierarchy_of(prior, problem))
    known = Natural(jnp.asarray(information), jnp.asarray(pull), jnp.zeros(0), first)
    _, swept = run_sweeps(form, known, begin(form), jax.random.key(key), KEPT)
    return Moments(*(np.asarray(part) for part in moments(form, known, swept.phi)))


def _maximised(problem: Problem, prior: ARD, first: Precision, information: np.ndarray, pull: np.ndarray) -> Moments:
    """Precisions of largest evidence (Paper B 24-25), by the fixed points of MacKay."""
    group, surveyed = learnt_groups(prior, problem), held_biases(prior, problem)
    alpha, coupling = np.asarray(first.alpha), np.asarray(first.coupled())
    for _ in range(SWEEPS):
        covariance = invert(information + coupling + np.diag(alpha))
        mean, variance = covariance @ pull, np.diag(covariance)
        gamma = np.clip(1.0 - alpha * variance, 0.0, 1.0)
        learnt = prior.learn(jnp.asarray(gamma), jnp.asarray(variance), jnp.asarray(mean), jnp.asarray(group), "mackay")
        after = np.where(surveyed, alpha, np.clip(np.asarray(learnt), *PRECISION_BOUNDS))
        change = np.abs(np.log(after / alpha)).max(initial=0.0)
        alpha = after
        if change < STILL:
            break
    sd = np.sqrt(variance)
    return Moments(mean, covariance, mean - HALF * sd, mean + HALF * sd, gamma)
