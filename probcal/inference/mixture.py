"""The posterior of a climb: a Gaussian, or where precisions are integrated a mixture of them."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np

from probcal.errors import InputError
from probcal.gaussian.draws import draw, draw_biases, draws_a_chain
from probcal.gaussian.engine import Factors
from probcal.gaussian.linearised import laplace
from probcal.gaussian.mode import Point
from probcal.inference.hierarchy import Hierarchy, drawn_precisions, held, inclusions
from probcal.inference.integrate import Integrated
from probcal.inference.posed import Form
from probcal.inference.propagate import Propagation
from probcal.priors import Prior
from probcal.problem import Problem
from probcal.results.answer import (
    CHAINS,
    Draws,
    Posterior,
    Summary,
    few_draws,
    log_prior_normal,
    precisions_of,
    tracks_at,
)
from probcal.results.blocks import SensorBlocks
from probcal.results.schema import ROPE


@dataclass(frozen=True, eq=False)
class NormalPosterior(Posterior):
    """A Gaussian of the biases around a point, noise levels held."""

    # of the prior, where the expansion is at hand
    factors: Factors | None = field(default=None, kw_only=True)
    chained: ClassVar[bool] = False

    @classmethod
    def on(
        cls,
        problem: Problem,
        prior: Prior,
        point: Point,
        covariance: SensorBlocks,
        alpha: Any,
        *,
        information: Any = None,
        evidence: float = np.nan,
        columns: Any = None,
        **known: Any,
    ) -> Self:
        """The Gaussian at a point, with the precisions alpha (M,) that a method ended with."""
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
        return cls(problem, prior, point, summary, **known)

    def biases(self, key: jax.Array) -> np.ndarray:
        """Independent draws (chain, draw, M), as many as their size and that of the data allow."""
        M = len(self.summary.mean)
        if self.summary.covariance.whole:
            shape = (CHAINS, draws_a_chain(self.problem.model.size, CHAINS))
            covariance = jnp.asarray(self.summary.covariance.matrix())
            z = draw_biases(self.point, covariance, key, shape[0] * shape[1])
        else:
            assert self.factors is not None
            shape = (CHAINS, few_draws(M))
            drawn = self.expansion.deviations(self.factors, key, shape[0] * shape[1])
            z = self.summary.mean + np.asarray(drawn.z)
        return np.asarray(z).reshape(*shape, M)

    def draws(self, key: jax.Array, keep: tuple[str, ...]) -> Draws:
        """Independent draws, as many as the size of the data lets be kept."""
        keys = jax.random.split(key)
        return self.along(self.biases(keys[0]), keys[1], keep)

    def along(self, z: np.ndarray, key: jax.Array, keep: tuple[str, ...]) -> Draws:
        """Draws of the biases z (chain, draw, M), with a trajectory each where all is held.

        Raises `InputError` for draws of what would take too much room.
        """
        if not self.summary.covariance.whole:
            if {"states", "replicas"} & set(keep):
                raise InputError(
                    "fit(save=...): a fit in sparse form keeps no draws of states or replicas;"
                    ' leave save out, or give engine="dense"'
                )
            keep = ()
        shape, M = z.shape[:2], z.shape[2]
        drawn: Any = ((), (), ())
        if keep:
            drawn = draw(self.expansion, jnp.asarray(z.reshape(-1, M)), self.point.levels, key, keep)
        states, likelihood, replicas = ([np.asarray(a).reshape(*shape, *a.shape[1:]) for a in part] for part in drawn)
        levels = np.broadcast_to(self.summary.levels, (*shape, len(self.summary.levels)))
        return Draws(z, levels, states, np.arange(shape[1]), likelihood, replicas)


@dataclass(frozen=True, eq=False)
class MixturePosterior(NormalPosterior):
    """A mixture of Gaussians of the biases around a point, noise levels held."""

    z: np.ndarray  # (chain, draw, M)
    hierarchy: Hierarchy
    first: np.ndarray  # (M,) precisions before the hierarchy governs some

    chained: ClassVar[bool] = True

    @classmethod
    def of(
        cls,
        problem: Problem,
        prior: Prior,
        form: Form,
        first: Any,
        found: Integrated,
        evidence: float,
        work: Propagation | None = None,
    ) -> MixturePosterior:
        """The mixture of an integration.

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
            assert work.found is not None
            assert work.begun is not None
            factors, at = work.found.factors, work.likelihood.here
            known = {
                "at": at,
                "factors": factors,
                "moments": tracks_at(found.point, at.spread(factors).states),
            }
            known["declared"] = SensorBlocks(len(mean), work.members, work.begun.covariance)
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
        return cls(
            problem,
            prior,
            found.point,
            summary,
            z,
            form.hierarchy,
            np.asarray(first),
            hyper=hyper,
            variables=variables,
            attrs=numbers,
            **known,
        )

    @cached_property
    def worth(self) -> float | None:
        """Evidence at the mean with the precisions that the mixture ended with: declared scales would shun a swap."""
        if self.declared is not None:
            return super().worth
        prior = self.prior.precision(self.problem.labels, self.problem.surveyed)
        alpha = jnp.asarray(self.summary.precision)
        with jax.enable_x64(True):
            return float(laplace(self.problem.model, self.point, prior._replace(alpha=alpha)).evidence)

    def draws(self, key: jax.Array, keep: tuple[str, ...]) -> Draws:
        """Draws of the mixture with a trajectory each, as many as the size of the data lets be kept."""
        return self.along(self.z, key, keep)

    def log_prior(self, draws: Draws) -> np.ndarray | None:
        """Log density (chain, draw, M) of each bias given its precision, where every bias has one of its own."""
        alpha = drawn_precisions(self.prior, self.hierarchy, self.hyper, self.first)
        return None if alpha is None else log_prior_normal(draws.z, alpha)
