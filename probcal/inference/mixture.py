"""The posterior of a climb: a Gaussian, or where precisions are integrated a mixture of them."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from probcal.errors import InputError
from probcal.gaussian.draws import draw, draw_biases, draws_a_chain
from probcal.gaussian.engine import Estimate, Expansion, Factors
from probcal.gaussian.mode import Point
from probcal.inference.hierarchy import drawn_precisions, held, inclusions
from probcal.inference.integrate import Integrated
from probcal.inference.posed import Form
from probcal.inference.propagate import Propagation
from probcal.priors import Gaussian, Precision, Prior
from probcal.problem import Problem
from probcal.results.answer import (
    CHAINS,
    Draws,
    Posterior,
    Summary,
    blocks_under,
    few_draws,
    precisions_of,
    tracks_at,
)
from probcal.results.blocks import SensorBlocks
from probcal.results.schema import ROPE
from probcal.simulate import derived_keys


def gaussian(
    problem: Problem,
    prior: Prior,
    point: Point,
    covariance: SensorBlocks,
    alpha: Any,
    *,
    information: Any = None,
    evidence: float = np.nan,
    columns: Mapping[str, np.ndarray] = MappingProxyType({}),
    **known: Any,
) -> Posterior:
    """The Gaussian of the biases at a point, noise levels held, with the precisions alpha (M,) of the end.

    `known` are further fields of the posterior.
    """
    summary = Summary.of(
        "Laplace",
        precisions_of(problem, prior),
        np.asarray(point.z),
        covariance,
        alpha,
        information=information,
        levels=point.levels,
        evidence=evidence if prior.proper else None,
        columns=columns,
    )
    return Posterior(problem, prior, point, summary, known.pop("draw", draw_gaussian), **known)


def gaussian_at(
    problem: Problem, prior: Prior, at: Expansion, worth: Estimate, learnt: Precision | None = None
) -> Posterior:
    """The Gaussian at a mode on any engine, of log evidence `worth`, under precisions `learnt`."""
    first = problem.first_precision(prior) if learnt is None else learnt
    factors = Factors.of(first)
    spread = at.spread(factors)
    blocks = blocks_under(at, factors, spread)
    declared = blocks if prior.proper else blocks.under_scales()
    if prior.learns:
        scales = problem.first_precision(Gaussian(correlation=prior.correlation))
        declared = blocks_under(at, Factors.of(scales))
    errors = {"sd_error": 0.5 * spread.error / spread.biases} if spread.error.any() else {}
    numbers = {"log_evidence_error": worth.error} if prior.proper and worth.error else {}
    return gaussian(
        problem, prior, at.point, blocks, first.alpha, evidence=worth.value, columns=declared.contraction() | errors,
        at=at, factors=factors, moments=tracks_at(at.point, spread.states), declared=declared,
        attrs={"rope": ROPE} | numbers,
    )  # fmt: skip


def gaussian_biases(own: Posterior, key: jax.Array) -> np.ndarray:
    """Independent draws (chain, draw, M), as many as their number and that of the data allow."""
    M = len(own.summary.mean)
    if own.summary.covariance.whole:
        shape = (CHAINS, draws_a_chain(own.problem.model.size, CHAINS))
        covariance = jnp.asarray(own.summary.covariance.matrix())
        middle = own.point._replace(z=jnp.asarray(own.summary.mean))
        z = draw_biases(middle, covariance, key, shape[0] * shape[1])
    else:
        assert own.factors is not None
        shape = (CHAINS, few_draws(M))
        drawn = own.expansion.deviations(own.factors, key, shape[0] * shape[1])
        z = own.summary.mean + np.asarray(drawn.z)
    return np.asarray(z).reshape(*shape, M)


def draw_gaussian(own: Posterior, key: jax.Array, keep: tuple[str, ...]) -> Draws:
    """Independent draws of a Gaussian, as many as the size of the data lets be kept."""
    keys = derived_keys(key)
    return draw_along(own, keys[1], keep, gaussian_biases(own, keys[0]))


def draw_along(own: Posterior, key: jax.Array, keep: tuple[str, ...], z: np.ndarray) -> Draws:
    """Draws of the biases z (chain, draw, M), with a trajectory each where all is held.

    Raises `InputError` for draws of what would take too much memory.
    """
    if not own.summary.covariance.whole:
        if {"states", "replicas"} & set(keep):
            raise InputError(
                "fit(save=...): a fit in sparse form keeps no draws of states or replicas;"
                ' leave save out, or give engine="dense"'
            )
        keep = ()
    shape, M = z.shape[:2], z.shape[2]
    drawn: Any = ((), (), ())
    if keep:
        drawn = draw(own.expansion, jax.device_put(z.reshape(-1, M)), own.point.levels, key, keep)
    states, likelihood, replicas = ([np.asarray(a).reshape(*shape, *a.shape[1:]) for a in part] for part in drawn)
    levels = np.broadcast_to(own.summary.levels, (*shape, len(own.summary.levels)))
    return Draws(z, levels, states, np.arange(shape[1]), likelihood, replicas)


def mixture(
    problem: Problem,
    prior: Prior,
    form: Form,
    first: Any,
    found: Integrated,
    evidence: float,
    work: Propagation | None = None,
) -> Posterior:
    """The mixture of Gaussians of an integration, noise levels held.

    `first` (M,) are the precisions of what no hierarchy governs, `evidence` is that under the
    declared scales, `work` where a propagation ended that holds no covariance of all biases.
    """
    mean, spread, *others = found.moments
    mean, lower, upper, gamma = map(np.asarray, (mean, *others))
    held_whole = not isinstance(spread, SensorBlocks)
    covariance = SensorBlocks.of(np.asarray(spread)) if held_whole else spread
    known: dict[str, Any] = {}
    if work is None:
        columns = inclusions(form.hierarchy, np.asarray(found.z), found.phi)
    else:
        factors, at = work.factors, work.likelihood.here
        known = {
            "at": at,
            "factors": factors,
            "moments": tracks_at(found.point, at.spread(factors).states),
        }
        known["declared"] = SensorBlocks(len(mean), work.members, work.begun)
        columns = known["declared"].contraction()
    summary = Summary.of(
        "mixture",
        "integrated",
        mean,
        covariance,
        first,
        gamma=gamma,
        interval=(lower, upper),
        governed=~held(prior, problem),
        information=found.information,
        levels=found.point.levels,
        evidence=evidence,
        columns=columns,
    )
    numbers = {"rope": ROPE}
    if work is None:
        for name in ("mean_error", "sd_error"):
            numbers[name] = float(np.max(getattr(found, name), initial=0.0))
    chains, count = found.z.shape[:2]  # fewer draws are kept where the data are many
    most = min(count, draws_a_chain(problem.model.size, chains))
    kept = np.linspace(0, count - 1, most).round().astype(int)
    hyper = {name: np.asarray(values)[:, kept] for name, values in found.phi.items()}
    z, variables = np.asarray(found.z)[:, kept], form.hierarchy.variables(problem.labels, hyper)
    return Posterior(
        problem,
        prior,
        found.point,
        summary,
        partial(draw_along, z=z),
        hyper=hyper,
        hierarchy=form.hierarchy,
        precisions=partial(drawn_precisions, prior, form.hierarchy, hyper, np.asarray(first)),
        variables=variables,
        attrs=numbers,
        chained=True,
        **known,
    )
