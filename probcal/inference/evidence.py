"""The evidence of a problem under a prior, hyper-parameters integrated: which sensor model, prior, drift or none."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal.errors import InputError
from probcal.inference.methods import check_problem
from probcal.inference.pose import PILOTS, Pilot, pareto_khat, pilot, pose, weights
from probcal.inference.posed import Form, Posed
from probcal.inference.psis import smoothed
from probcal.priors import Flat, Horseshoe, Prior
from probcal.problem import Problem
from probcal.simulate import Key, as_key
from probcal.smoothing.mode import Point
from probcal.smoothing.start import automatic_start
from probcal.types import float64

RUNGS, BEND = 24, 4.0  # temperatures, and the power by which they crowd towards the prior


class Evidence(NamedTuple):
    """Log evidence in nats, its Monte Carlo standard error, and the Pareto k-hat of its correction."""

    value: float
    error: float
    khat: float


@float64
def log_evidence(problem: Problem, prior: Prior | None = None, *, key: Key = 0, start: Point | None = None) -> Evidence:
    """Log of the density of the data under a prior (`Horseshoe()` by default), everything unknown integrated.

    Trajectories are marginalised by the frame (Laplace), biases and hyper-parameters by stepping stones from the prior
    to the posterior (Xie and others 2011), and what the frame leaves out by importance weights: where `khat` is above
    0.7 these are not to be trusted. Raises `InputError` for a flat prior, which has no evidence.
    """
    prior = Horseshoe() if prior is None else prior
    if isinstance(prior, Flat):
        raise InputError("log_evidence: a flat prior has no evidence; give a proper one")
    check_problem(problem)
    keys = jax.random.split(as_key(key), 3)
    point = automatic_start(problem) if start is None else start
    form, posed, found, _ = pose(problem, prior, point, keys[0])
    logs = np.asarray(weights(form, posed, found.theta, keys[1]))
    khat = pareto_khat(logs)
    if khat > 0:
        smooth = smoothed(logs[None])[0][0]
        logs = smooth + (logs - smooth)[logs.argmin()]  # smoothing leaves the small weights alone
    relative = np.exp(logs - logs.max())
    correction = float(logs.max() + np.log(relative.mean()))
    own = float(relative.std() / relative.mean() / np.sqrt(len(logs)))
    stones = _stones(form, posed, keys[2])
    value = float(stones.mean()) + correction
    return Evidence(value, float(np.hypot(stones.std(ddof=1) / np.sqrt(len(stones)), own)), khat)


def _tempered(posed: Posed, share: jax.Array) -> Posed:
    """The posterior with the frame's likelihood to the power of `share`."""
    frame = posed.frame
    return posed._replace(frame=frame._replace(information=share * frame.information, score=share * frame.score))


def _stones(form: Form, posed: Posed, key: jax.Array) -> np.ndarray:
    """Log evidence of the frame by each of the independent chains of a ladder of pilots, (PILOTS,)."""
    shares = (np.arange(RUNGS + 1) / RUNGS) ** BEND
    total = np.zeros(PILOTS)
    likelihood = jax.jit(jax.vmap(posed.frame.log_likelihood))
    for k, (low, high) in enumerate(pairwise(shares)):
        drawn: Pilot = pilot(form, _tempered(posed, jnp.asarray(low)), jax.random.fold_in(key, k))
        logs = (high - low) * np.asarray(likelihood(drawn.theta)).reshape(PILOTS, -1)
        most = logs.max(1)
        total += most + np.log(np.exp(logs - most[:, None]).mean(1))
    return total
