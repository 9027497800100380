"""The posterior of a fit whose precisions are integrated: a mixture of Gaussians, by its moments and its draws."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from probcal.gaussian.draws import draw, draws_a_chain
from probcal.gaussian.linearised import laplace
from probcal.inference.hierarchy import LEAST, MOST, Hierarchy, Phi, held
from probcal.inference.integrate import Integrated
from probcal.inference.posed import Form
from probcal.priors import PRECISION_BOUNDS, Prior
from probcal.problem import Problem
from probcal.results.answer import Draws, Posterior, Summary, Tracks, log_prior_normal, tracks_of
from probcal.results.blocks import SensorBlocks
from probcal.results.schema import ROPE


@dataclass(frozen=True, eq=False)
class MixturePosterior(Posterior):
    """A mixture of Gaussians of the biases around a point, noise levels held."""

    found: Integrated
    hierarchy: Hierarchy
    first: np.ndarray  # (M,) precisions before the hierarchy governs some

    chained: ClassVar[bool] = True
    held: ClassVar[bool] = True

    @classmethod
    def of(
        cls, problem: Problem, prior: Prior, form: Form, first: np.ndarray, found: Integrated, evidence: float
    ) -> MixturePosterior:
        """The mixture of an integration; `first` (M,) are the precisions of what no hierarchy governs.

        `evidence` is that under the declared scales.
        """
        mean, covariance, lower, upper, gamma = (np.asarray(part) for part in found.moments)
        z = np.asarray(found.z)
        columns = {"inclusion": (np.abs(z) > ROPE).mean((0, 1))}
        if "included" in found.phi:
            columns["included"] = np.ones(len(mean))
            columns["included"][list(form.hierarchy.spiked)] = np.asarray(found.phi["included"]).mean((0, 1))
        with np.errstate(invalid="ignore", divide="ignore"):
            own = np.clip((1 - gamma) / np.maximum(np.diag(covariance), 1e-300), *PRECISION_BOUNDS)
        precision = np.where(held(prior, problem), first, own)
        summary = Summary(
            "mixture", "integrated", mean, covariance, lower, upper, gamma, precision, np.asarray(found.information),
            np.asarray(found.point.levels), evidence, columns,
        )  # fmt: skip
        return cls(problem, prior, found.point, summary, found, form.hierarchy, first)

    @cached_property
    def worth(self) -> float | None:
        """Evidence at the mean with the precisions that the mixture ended with: declared scales would shun a swap."""
        prior = self.prior.precision(self.problem.labels, self.problem.surveyed)
        alpha = jnp.asarray(self.summary.precision)
        with jax.enable_x64(True):
            return float(laplace(self.problem.model, self.point, prior._replace(alpha=alpha)).evidence)

    @property
    def states(self) -> Sequence[np.ndarray]:
        """States (E, n) of each recursion at the mean of the biases."""
        return [np.asarray(x) for x in self.point.states]

    def tracks(self) -> Sequence[Tracks]:
        """States at the mean of the biases, and their sd with the biases uncertain."""
        return tracks_of(self.expansion, SensorBlocks.of(self.summary.whole))

    def _kept(self) -> np.ndarray:
        """Which draws of each chain are kept: fewer where the data are many."""
        chains, count = self.found.z.shape[:2]
        return np.linspace(0, count - 1, draws_a_chain(self.problem.model.size, chains)).round().astype(int)

    def draws(self, key: jax.Array, keep: tuple[str, ...]) -> Draws:
        """Draws of the mixture with a trajectory each, as many as the size of the data lets be kept."""
        z = np.asarray(self.found.z)[:, self._kept()]
        shape, M = z.shape[:2], z.shape[2]
        drawn = draw(self.expansion, jnp.asarray(z.reshape(-1, M)), self.point.levels, key, keep)
        states, likelihood, replicas = ([np.asarray(a).reshape(*shape, *a.shape[1:]) for a in part] for part in drawn)
        levels = np.broadcast_to(self.summary.levels, (*shape, len(self.summary.levels)))
        return Draws(z, levels, states, np.arange(shape[1]), likelihood, replicas)

    def log_prior(self, draws: Draws) -> np.ndarray | None:
        """Log density (chain, draw, M) of each bias given its precision, where every bias has one of its own."""
        if self.prior.correlation or self.hierarchy.spiked or not self.found.phi:
            return None
        alpha = np.asarray(_precisions(self.hierarchy, dict(self.hyper), self.first))
        return log_prior_normal(draws.z, np.clip(alpha, LEAST, MOST))

    @property
    def variables(self) -> Mapping[str, Any]:
        """Hyper-parameters of every draw."""
        return self.hierarchy.variables(self.problem.labels, self.hyper)

    @property
    def hyper(self) -> Mapping[str, np.ndarray]:
        """Draws of the hyper-parameters, (chain, draw, ...)."""
        kept = self._kept()
        return {name: np.asarray(values)[:, kept] for name, values in self.found.phi.items()}

    @property
    def attrs(self) -> Mapping[str, float]:
        """The limit of inclusion, and the largest Monte Carlo errors: of a mean in sd, of an sd
        over it."""
        errors = {"mean_error": self.found.mean_error, "sd_error": self.found.sd_error}
        return {"rope": ROPE} | {name: float(np.max(error, initial=0.0)) for name, error in errors.items()}


@partial(jax.jit, static_argnames="hierarchy")
def _precisions(hierarchy: Hierarchy, phi: Phi, first: jax.Array) -> jax.Array:
    """Precisions of all biases for draws of hyper-parameters, (chain, draw, M)."""
    return jax.vmap(jax.vmap(lambda one: hierarchy.alpha(one, first)))(phi)
