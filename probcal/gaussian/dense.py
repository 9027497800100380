"""The dense engine: matrices of all biases, and the response of every state to each."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from probcal.gaussian.draws import draw_trajectories
from probcal.gaussian.engine import Engine, Estimate, Factors, Sampled, Spread, density_of
from probcal.gaussian.linearised import (
    Trajectory,
    leverages,
    linearise_rows,
    marginal_variances,
    state_variances,
    trajectories_of,
)
from probcal.gaussian.marginal import volume_slope
from probcal.gaussian.mode import Eliminated, Point, eliminate_rows, follow
from probcal.gaussian.solves import Dense
from probcal.linalg import without_negative
from probcal.model.model import Data, Model
from probcal.model.rows import LinearRows
from probcal.model.trajectories import States
from probcal.simulate import derived_keys


@dataclass(frozen=True)
class DenseEngine(Engine):
    """Matrices of all biases: the fastest where they fit."""

    cheap = True
    exact: ClassVar[bool] = True

    def at(self, model: Model, point: Point, rows: LinearRows | None = None) -> DenseExpansion:
        """The posterior at a consistent point; rows as the caller linearised them."""
        rows = linearise_rows(model, point) if rows is None else tuple(rows)
        return DenseExpansion(model, point, rows, eliminate_rows(model, point, rows))


@dataclass(frozen=True, eq=False)
class DenseExpansion:
    """The posterior at a point, as `engine.Expansion`."""

    model: Model
    point: Point
    rows: LinearRows
    eliminated: Eliminated
    _kept: list[Any] = field(default_factory=list)  # the factors asked for last, precision and covariance

    @cached_property
    def trajectories(self) -> tuple[Trajectory, ...]:
        """The trajectories given the biases, with their response to these."""
        return trajectories_of(self.model, self.point.levels, self.eliminated)

    def given_biases(self) -> tuple[Trajectory, ...]:
        """The trajectories of each recursion given the biases."""
        return self.trajectories

    @property
    def held_states(self) -> States:
        """Covariance (E, n, n) of every state of each recursion, the biases known."""
        return tuple(own.covariance for own in self.trajectories)

    @cached_property
    def _density(self) -> float:
        return density_of(self.model, self.point, self.eliminated.logdet)

    def density(self) -> float:
        """Log density of the data given the biases at the point, up to the constant of the noises."""
        return self._density

    @cached_property
    def _slope(self) -> np.ndarray:
        volume, _ = volume_slope(self.model, self.point, self.eliminated)
        return np.asarray(self.eliminated.score) - 0.5 * np.asarray(volume)

    def score(self) -> np.ndarray:
        """Its slope (M,) by the biases, the volume of the trajectories with it."""
        return self._slope

    def slope(self) -> np.ndarray:
        """Slope (M,) of the log-likelihood by the biases, tracks following, without it."""
        return np.asarray(self.eliminated.score)

    def log_det(self, factors: Factors) -> Estimate:
        """Log determinant of the precision of the biases."""
        try:
            return Estimate(2.0 * float(np.sum(np.log(np.diagonal(np.linalg.cholesky(self._precision(factors)))))))
        except np.linalg.LinAlgError:  # it is not positive definite
            return Estimate(np.nan)

    def solve(self, factors: Factors, right: Any) -> np.ndarray:
        """Covariance of the biases times right, (M,) or (M, K)."""
        return np.asarray(self.covariance(factors)) @ np.asarray(right)

    def apply(self, columns: Any) -> jax.Array:
        """Information of the data about the biases times columns, (M,) or (M, K)."""
        return self.eliminated.information @ jnp.asarray(columns)

    def information(self) -> np.ndarray:
        """The information (M, M) itself."""
        return np.asarray(self.eliminated.information)

    def moved(self, dz: Any) -> Point:
        """The point with the biases moved by dz (M,), all tracks following."""
        return follow(self.model, self.point, self.eliminated.parts, jax.device_put(dz))

    def _precision(self, factors: Factors) -> np.ndarray:
        """The precision of the biases; what rounding leaves below zero is no information."""
        if self._kept and self._kept[0] is factors:
            return self._kept[1]
        information, own = self.information(), factors.matrix(self.model.biases)
        try:
            np.linalg.cholesky(information + own)
        except np.linalg.LinAlgError:
            if np.isfinite(information).all():
                information = without_negative(information)
        return information + own

    def covariance(self, factors: Factors) -> jax.Array:
        """Covariance (M, M) of the biases."""
        if not (self._kept and self._kept[0] is factors):
            precision = self._precision(factors)
            inverse = np.linalg.inv(precision)
            self._kept[:] = [factors, precision, jax.device_put(0.5 * (inverse + inverse.T))]
        return self._kept[2]

    def marginals(self, factors: Factors, members: np.ndarray) -> np.ndarray:
        """Covariances (B, p, p) of biases (B, p), M of none: 1 on its diagonal."""
        whole, M = np.pad(np.asarray(self.covariance(factors)), (0, 1)), self.model.biases
        none = (members == M)[:, :, None] * np.eye(members.shape[1])[None]
        return whole[members[:, :, None], members[:, None, :]] + none

    def spread(self, factors: Factors) -> Spread:
        """Variance of every bias and state."""
        covariance = self.covariance(factors)
        own = np.asarray(jnp.diagonal(covariance))
        states = tuple(np.asarray(v) for v in self.variances(covariance))
        return Spread(own, np.zeros_like(own), states)

    def states(self, factors: Factors) -> States:
        """Covariance (E, n, n) of every state of each recursion."""
        return _state_covariances(self.trajectories, self.covariance(factors))

    def noises(self, factors: Factors) -> States:
        """Variance (E, n) of every whitened noise of each recursion."""
        return marginal_variances(self.model, self.rows, self.trajectories, self.covariance(factors))[1]

    def predicted(self, factors: Factors) -> Data:
        """Variance (N, C) of each predicted value."""
        return marginal_variances(self.model, self.rows, self.trajectories, self.covariance(factors))[0]

    def leverages(self, factors: Factors) -> Data:
        """Leverage of every datum (N, C) on the biases: w times the part of its variance that the
        biases cause."""
        return leverages(self.model, self.rows, self.trajectories, self.covariance(factors))

    def deviations(self, factors: Factors, key: jax.Array, count: int) -> Sampled:
        """Biases and states drawn around zero, as they differ from their mean."""
        keys = derived_keys(key)
        dz = _solved(self._precision(factors)).draw(keys[0], count)
        states = draw_trajectories(self, self.point.z[None] + dz, keys[1])
        return Sampled(dz, self.model.each(lambda _, x, mean: x - mean[None], states, self.point.states))

    def followed(self, root: Any) -> list[np.ndarray]:
        """Variance (E, n) of every state where the biases have the covariance root root', root (M,
        R)."""
        root = root if isinstance(root, np.ndarray) else root.toarray()
        moved = (np.sum((np.asarray(own.response) @ root) ** 2, 2) for own in self.trajectories)
        pairs = zip(self.held_states, moved, strict=True)
        return [np.diagonal(np.asarray(held), axis1=1, axis2=2) + own for held, own in pairs]

    def variances(self, covariance: jax.Array) -> States:
        """Variance (E, n) of every state of each recursion, for a covariance (M, M) of the biases."""
        return state_variances(self.trajectories, covariance)


_solved = jax.jit(Dense.of)


@jax.jit
def _state_covariances(trajectories: tuple[Trajectory, ...], covariance: jax.Array) -> States:
    return tuple(
        own.covariance + jnp.einsum("eni,ij,emj->enm", own.response, covariance, own.response) for own in trajectories
    )
