"""The posterior of a climb: a Gaussian, or a mixture: over precisions, or of several answers."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
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
    Tracks,
    blocks_under,
    few_draws,
    precisions_of,
    tracks_at,
)
from probcal.results.blocks import SensorBlocks
from probcal.results.schema import INTERVAL, ROPE
from probcal.simulate import as_key, derived_keys


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


def mixture_of(first: Posterior, parts: Sequence[Posterior], weights: np.ndarray) -> Posterior:
    """The mixture of posteriors by their weights (K,), expanded at the point of the first."""
    drawn = [own.draws(as_key(0), ()).z for own in parts]

    def moments(of_part: Sequence[Tracks]) -> Tracks:
        mean = _averaged(weights, (own.mean for own in of_part))
        square = _averaged(weights, (own.sd**2 + (own.mean - mean) ** 2 for own in of_part))
        return Tracks(mean, np.sqrt(square))

    def precisions() -> np.ndarray | None:
        known = [own.precisions() if own.precisions else own.summary.precision for own in parts]
        whole = [z * 0 + own for z, own in zip(drawn, known, strict=True) if own is not None]
        return _picked(weights, whole) if len(whole) == len(parts) else None

    variables = {
        name: (dims, _picked(weights, [own.variables[name][1] for own in parts]), *coords)
        for name, (dims, _, *coords) in first.variables.items()
    }
    return replace(
        first,
        summary=_summary([own.summary for own in parts], first.summary, drawn, weights),
        draw=partial(_drawn, parts=tuple(parts), weights=weights),
        moments=list(map(moments, zip(*(own.tracks() for own in parts), strict=True))),
        hyper={k: _picked(weights, [own.hyper[k] for own in parts]) for k in first.hyper},
        precisions=precisions,
        variables=variables,
    )


def _summary(parts: list[Summary], first: Summary, drawn: list[Any], weights: Any) -> Summary:
    """Moments of the mixture, and intervals of its draws."""
    mean = _averaged(weights, (own.mean for own in parts))
    square = (own.covariance.matrix() + np.outer(own.mean - mean, own.mean - mean) for own in parts)
    covariance = SensorBlocks.of(_averaged(weights, square))
    precision = _averaged(weights, (own.precision for own in parts))
    columns = {k: _averaged(weights, (own.columns[k] for own in parts)) for k in first.columns}
    columns |= {k: own for k, own in covariance.contraction().items() if k in columns}
    flat, count = np.concatenate([z.reshape(-1, len(mean)) for z in drawn]), drawn[0][..., 0].size
    shares = np.repeat(weights / count, count)[:, None] + 0.0 * mean
    ends = 0.5 - INTERVAL / 2, 0.5 + INTERVAL / 2
    lower, upper = np.quantile(flat, ends, axis=0, weights=shares, method="inverted_cdf")
    return replace(
        first,
        kind="mixture",
        mean=mean,
        covariance=covariance,
        lower=lower,
        upper=upper,
        gamma=np.clip(1.0 - precision * covariance.variance, 0.0, 1.0),  # a factor is no datum
        precision=precision,
        levels=_averaged(weights, (own.levels for own in parts)),
        columns=columns,
    )


def _averaged(weights: np.ndarray, values: Iterable[Any]) -> np.ndarray:
    """Mean of the values (...) of the parts (K) by their weights."""
    return np.tensordot(weights, np.stack([np.asarray(value) for value in values]), 1)


def _picked(weights: np.ndarray, values: Sequence[Any]) -> np.ndarray:
    """Values (chain, draw, ...), each of one of the parts (K), as often as its weight says."""
    found, shape = np.array(values[0]), np.shape(values[0])[:2]
    order = np.random.default_rng(0).permutation(shape[0] * shape[1]).reshape(shape) + 0.5
    part = np.searchsorted(np.cumsum(weights)[:-1] * order.size, order)
    for k, own in enumerate(values):
        found[part == k] = np.asarray(own)[part == k]
    return found


def _drawn(
    _: Posterior,
    key: jax.Array,
    keep: tuple[str, ...],
    *,
    parts: Sequence[Posterior],
    weights: np.ndarray,
) -> Draws:
    """Draws, each of one of the parts."""
    drawn = [part.draws(key, keep) for part in parts]

    def picked(name: str) -> list[np.ndarray]:
        whole = zip(*(getattr(own, name) for own in drawn), strict=True)
        return [_picked(weights, own) for own in whole]

    z = _picked(weights, [own.z for own in drawn])
    levels = _picked(weights, [own.levels for own in drawn])
    states, likelihood, replicas = map(picked, ("states", "log_likelihood", "replicas"))
    return Draws(z, levels, states, drawn[0].kept, likelihood, replicas)
