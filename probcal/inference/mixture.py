"""The posterior of a fit whose precisions are integrated: a mixture of Gaussians, by its moments and its draws."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from probcal.gaussian.draws import draws_a_chain
from probcal.gaussian.linearised import laplace
from probcal.inference.hierarchy import Hierarchy, drawn_precisions, held, inclusions
from probcal.inference.integrate import Integrated
from probcal.inference.posed import Form
from probcal.inference.propagate import Propagation
from probcal.priors import Prior
from probcal.problem import Problem
from probcal.results.answer import Draws, NormalPosterior, Summary, log_prior_normal, tracks_at
from probcal.results.blocks import SensorBlocks
from probcal.results.schema import ROPE


@dataclass(frozen=True, eq=False)
class MixturePosterior(NormalPosterior):
    """A mixture of Gaussians of the biases around a point, noise levels held."""

    z: np.ndarray  # (chain, draw, M)
    hierarchy: Hierarchy
    first: np.ndarray  # (M,) precisions before the hierarchy governs some

    chained: ClassVar[bool] = True

    @classmethod
    def of(
        cls, problem: Problem, prior: Prior, form: Form, first: Any, found: Integrated, evidence: float,
        work: Propagation | None = None,
    ) -> MixturePosterior:  # fmt: skip
        """The mixture of an integration; `first` (M,) are the precisions of what no hierarchy governs.

        `evidence` is that under the declared scales. `work` is where a propagation ended that holds no covariance of
        all biases.
        """
        mean, spread, *others = found.moments
        mean, lower, upper, gamma = map(np.asarray, (mean, *others))
        covariance = spread if isinstance(spread, SensorBlocks) else SensorBlocks.of(np.asarray(spread))
        known: dict[str, Any] = {}
        if work is None:
            columns = inclusions(form.hierarchy, np.asarray(found.z), found.phi)
        else:
            assert work.found is not None
            assert work.begun is not None
            factors, at = work.found.factors, work.likelihood.here
            known = {"at": at, "factors": factors, "moments": tracks_at(found.point, at.spread(factors).states)}
            known["declared"] = SensorBlocks(len(mean), work.members, work.begun.covariance)
            columns = known["declared"].contraction()
        summary = Summary.of(
            "mixture", "integrated", mean, covariance, first, gamma=gamma, interval=(lower, upper),
            governed=~held(prior, problem), information=found.information, levels=found.point.levels,
            evidence=evidence, columns=columns,
        )  # fmt: skip
        errors = {"mean_error": found.mean_error, "sd_error": found.sd_error} if work is None else {}
        numbers = {"rope": ROPE} | {name: float(np.max(error, initial=0.0)) for name, error in errors.items()}
        chains, count = found.z.shape[:2]  # fewer draws are kept where the data are many
        kept = np.linspace(0, count - 1, min(count, draws_a_chain(problem.model.size, chains))).round().astype(int)
        hyper = {name: np.asarray(values)[:, kept] for name, values in found.phi.items()}
        z, variables = np.asarray(found.z)[:, kept], form.hierarchy.variables(problem.labels, hyper)
        return cls(
            problem, prior, found.point, summary, z, form.hierarchy, np.asarray(first), hyper=hyper,
            variables=variables, attrs=numbers, **known,
        )  # fmt: skip

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
