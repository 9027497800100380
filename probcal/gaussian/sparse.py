"""Sparse engines: the joint precision of all states and biases, by a library that factorises it."""

from __future__ import annotations

import operator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from probcal.gaussian import recursion as rec
from probcal.gaussian.engine import Engine, Estimate, Factors, Sampled, Spread, density_of
from probcal.gaussian.factor import COLUMNS, Factor, Library
from probcal.gaussian.held import hold, inform
from probcal.gaussian.joint import JointPrecision
from probcal.gaussian.jointly import times_weights
from probcal.gaussian.linearised import GivenBiases, given_biases, linearise_rows
from probcal.gaussian.marginal import volume_slope
from probcal.gaussian.mode import Eliminated, Point, factors, inverse_factors
from probcal.model.model import Model
from probcal.model.rows import LinearRows
from probcal.model.trajectories import States
from probcal.simulate import chance_of

WHOLE = 600  # biases up to which a matrix of all is made on request (its eigenvalues take 0.2 s)


@dataclass(frozen=True)
class SparseEngine(Engine):
    """Nothing of size (M, M) or (E, n, M): what an epoch sees of the biases is few entries of a
    sparse matrix."""

    library: Library
    # of the last form of a model
    _patterns: list[tuple[list[Any], JointPrecision]] = field(default_factory=list, compare=False)

    cheap = False

    @property
    def exact(self) -> bool:
        """True where log determinants and variances are exact."""
        return self.library.exact

    def at(self, model: Model, point: Point, rows: LinearRows | None = None) -> SparseExpansion:
        """The posterior at a consistent point; rows as the caller linearised them."""
        form = jax.tree.leaves(replace(model, recursions=tuple(own._replace(tails=()) for own in model.recursions)))
        kept = self._patterns[0][0] if self._patterns else ()
        if not (len(kept) == len(form) and all(map(operator.is_, kept, form))):
            self._patterns[:] = [(form, JointPrecision.of(model))]
        joint = self._patterns[0][1]
        rows = linearise_rows(model, point) if rows is None else tuple(rows)
        return SparseExpansion(model, point, rows, joint, self.library)


@dataclass(frozen=True, eq=False)
class _Solved:
    """The joint precision with some factors, factorised."""

    of: Factors
    joint: JointPrecision
    factor: Factor

    def biases(self, right: Any) -> np.ndarray:
        """Covariance of the biases times right, (M,) or (M, K)."""
        return self.factor.solve(self.joint.of_biases(np.asarray(right)))[self.joint.states :]


@dataclass(frozen=True, eq=False)
class SparseExpansion:
    """The posterior at a point, as `engine.Expansion`; of the factors that were asked for last the
    factor is kept."""

    model: Model
    point: Point
    rows: LinearRows
    joint: JointPrecision
    library: Library
    _kept: list[_Solved] = field(default_factory=list)

    @cached_property
    def entries(self) -> np.ndarray:
        """Entries of the joint precision, the biases without prior."""
        return self.joint.values(self.model, self.rows, self.point.levels)

    @cached_property
    def eliminated(self) -> Eliminated:
        """The trajectories eliminated at held biases."""
        return hold(self.model, self.point, self.rows)

    def given_biases(self) -> tuple[GivenBiases, ...]:
        """The trajectories of each recursion given the biases."""
        return self._given

    @cached_property
    def _given(self) -> tuple[GivenBiases, ...]:
        return given_biases(self.model, self.point.levels, self.eliminated)

    @cached_property
    def held_states(self) -> States:
        """Covariance (E, n, n) of every state of each recursion, the biases known."""
        return _held_states(self.model, self.point, self.eliminated)

    @cached_property
    def _relaxed(self) -> jax.Array:
        return _relaxed(self.model, self.point, self.rows, self.eliminated)

    def solved(self, factors: Factors) -> _Solved:
        """The joint precision with factors; pairs of biases that are new to its pattern are given a
        place there."""
        if not (self._kept and self._kept[0].of is factors):
            self._kept.clear()
            joint, entries = self.joint.with_pairs(self.model, factors.members), self.entries
            if joint is not self.joint:
                entries = joint.values(self.model, self.rows, self.point.levels)
            self._kept.append(_Solved(factors, joint, self.library(joint.places, joint.under(entries, factors))))
        return self._kept[0]

    @cached_property
    def known(self) -> np.ndarray:
        """The inverse of the precision of the states alone, biases known, at the place of each
        entry; 0 elsewhere."""
        found = np.zeros(len(self.entries))
        inside = self.joint.places.column < self.joint.states
        found[inside] = self.library(*self.joint.of_states(self.entries)).inverse
        return found

    @cached_property
    def _density(self) -> float:
        return density_of(self.model, self.point, self.eliminated.logdet)

    def density(self) -> float:
        """Log density of the data given the biases at the point, up to the constant of the noises."""
        return self._density

    @cached_property
    def _slope(self) -> jax.Array:
        return self._relaxed - 0.5 * volume_slope(self.model, self.point, self.eliminated)[0]

    def score(self) -> jax.Array:
        """Its slope (M,) by the biases, the volume of the trajectories with it."""
        return self._slope

    def slope(self) -> jax.Array:
        """Slope (M,) of the log-likelihood by the biases, tracks following, without it."""
        return self._relaxed

    def log_det(self, factors: Factors) -> Estimate:
        """Log determinant of the precision of the biases."""
        whole, error = self.solved(factors).factor.log_determinant()
        own = float(self.eliminated.logdet) - self.joint.correction(self.model, self.point.levels)
        return Estimate(whole - own, error)

    def solve(self, factors: Factors, right: Any) -> np.ndarray:
        """Covariance of the biases times right, (M,) or (M, K)."""
        return self.solved(factors).biases(right)

    def apply(self, columns: Any) -> np.ndarray:
        """Information of the data about the biases times columns, (M,) or (M, K)."""
        columns = np.asarray(columns)
        found = inform(self.model, self.rows, self.eliminated, columns.reshape(len(columns), -1))
        return found.reshape(columns.shape)

    def information(self) -> np.ndarray | None:
        """The information (M, M) itself; None of more than `WHOLE` biases."""
        if self.model.biases > WHOLE:
            return None
        found = self.apply(np.eye(self.model.biases))
        return 0.5 * (found + found.T)

    def moved(self, dz: Any) -> Point:
        """The point with the biases moved by dz (M,), all tracks following."""
        return _followed(self.model, self.point, self.rows, self.eliminated, jax.device_put(dz))

    def marginals(self, factors: Factors, members: np.ndarray) -> np.ndarray:
        """Covariances (B, p, p) of biases (B, p), M of none: 1 on its diagonal.

        Where the pattern lacks a pair of them, or its inverse is not exact, all are solved for.
        """
        found, M = self.solved(factors), self.model.biases
        if self.library.exact and found.joint.holds(members):
            return found.joint.block_values(members, found.joint.pairs(members), found.factor.inverse)
        asked, none = np.unique(members[members < M]), members == M
        block = none[:, :, None] * np.eye(members.shape[1])[None]
        for start in range(0, len(asked), COLUMNS):
            own = asked[start : start + COLUMNS]
            unit = np.zeros((M, len(own)))
            unit[own, np.arange(len(own))] = 1.0
            whole = np.concatenate([found.biases(unit), np.zeros((1, len(own)))])
            b, j = np.nonzero(np.isin(members, own))
            block[b, :, j] = whole[members[b], np.searchsorted(own, members[b, j])[:, None]]
        return block

    def spread(self, factors: Factors) -> Spread:
        """Variance of every bias and state; estimated where the library is not exact."""
        variance, error = self.solved(factors).factor.inverse_diagonal()
        states = tuple(self.joint.state_values(variance))
        return Spread(variance[self.joint.states :], error[self.joint.states :], states)

    def states(self, factors: Factors) -> tuple[np.ndarray, ...]:
        """Covariance (E, n, n) of every state of each recursion."""
        found = self.solved(factors)
        return tuple(own for own, _, _ in found.joint.steps(self.model, found.factor.inverse))

    def noises(self, factors: Factors) -> tuple[np.ndarray, ...]:
        """Variance (E, n) of every whitened noise of each recursion."""
        found = self.solved(factors)
        steps = tuple(tuple(map(jax.device_put, own)) for own in found.joint.steps(self.model, found.factor.inverse))
        variances = _noise_variances(self.model, self.point, steps)
        return self.model.each(lambda _, on, own: np.where(on[:, None], own, 1.0), self.joint.driven, variances)

    def predicted(self, factors: Factors) -> tuple[np.ndarray, ...]:
        """Variance (N, C) of each predicted value."""
        found = self.solved(factors)
        return tuple(found.joint.predicted_variances(self.model, self.rows, found.factor.inverse))

    def leverages(self, factors: Factors) -> tuple[np.ndarray, ...]:
        """Leverage of every datum (N, C) on the biases: w times the part of its variance that the
        biases cause."""
        both = self.predicted(factors)
        alone = self.joint.predicted_variances(self.model, self.rows, self.known)
        parts = self.model.each_block(self.rows, both, alone)
        return tuple(np.asarray(lin.weight) * (own - held) for *_, lin, own, held in parts)

    def deviations(self, factors: Factors, key: jax.Array, count: int) -> Sampled:
        """Biases and states drawn around zero, as they differ from their mean."""
        found, rng = self.solved(factors), chance_of(key)
        drawn = found.factor.draw(rng, count)
        padded = np.concatenate([drawn, np.zeros((count, 1))], 1)  # no variable: -1
        states = tuple(jax.device_put(padded[:, own]) for own in self.joint.slots)
        return Sampled(jax.device_put(drawn[:, self.joint.states :]), states)

    def followed(self, root: Any) -> list[np.ndarray]:
        """Variance (E, n) of every state where the biases have the covariance root root', root (M,
        R).

        What each column of the root moves is found for some columns at a time. Raises
        `numpy.linalg.LinAlgError` where a track is open.
        """
        factor, across = self.library(*self.joint.of_states(self.entries)), self.joint.across(self.entries)
        moved = np.zeros(self.joint.states)
        for start in range(0, root.shape[1], COLUMNS):
            pulled = across @ root[:, start : start + COLUMNS]
            moved += np.sum(factor.solve(pulled if isinstance(pulled, np.ndarray) else pulled.toarray()) ** 2, 1)
        parts = self.model.each_layout(self.held_states, self.joint.state_values(moved))
        return [np.diagonal(np.asarray(held), axis1=1, axis2=2) + own for _, held, own in parts]


@jax.jit
def _held_states(model: Model, point: Point, held: Eliminated) -> States:
    return model.each(lambda part, kept: rec.covariances(part.F, factors(part, point.levels), kept.gain)[0], held.parts)


@jax.jit
def _followed(model: Model, point: Point, rows: LinearRows, held: Eliminated, dz: jax.Array) -> Point:
    """Tracks at their smoothed response to a step of the biases, by columns of the rows: no (E, n,
    M) is made."""
    columns = model.onto_states(rows, times_weights(model, rows, model.by_bias(rows, -dz[:, None])))

    def one(x: jax.Array, u: jax.Array, part: Any, kept: Any, column: jax.Array) -> tuple[jax.Array, jax.Array]:
        drift = -(factors(part, point.levels) @ u[:, :, None])
        smooth = rec.smooth(part.F, kept.gain, kept.pull[:, :, None] + column, drift)
        return x + smooth.states[:, :, 0], smooth.noises[:, :, 0]

    moved = point.trajectories.map(one, model.recursions, held.parts, columns)
    return point._replace(trajectories=moved, z=point.z + dz)


@jax.jit
def _relaxed(model: Model, point: Point, rows: LinearRows, held: Eliminated) -> jax.Array:
    """Slope (M,) of the log-likelihood by the biases with every track at its mode."""
    free = _followed(model, point, rows, held, jnp.zeros_like(point.z))
    away = [(after - before)[:, :, None] for _, after, before in model.each_layout(free.states, point.states)]
    moved = times_weights(model, rows, model.by_state(rows, away))
    scores = tuple(lin.score - own[:, :, 0] for *_, lin, own in model.each_block(rows, moved))
    pull = model.onto_biases(rows, tuple(own[:, :, None] for own in scores))[:, 0]
    return pull if model.tilt is None else pull + model.tilt.pull(point.z)


@jax.jit
def _noise_variances(model: Model, point: Point, steps: tuple[tuple[jax.Array, ...], ...]) -> tuple[jax.Array, ...]:
    """Variances (E, n) of whitened noises, of the covariances of a state, of the one before, and
    between them."""

    def one(part: Any, step: tuple[jax.Array, ...]) -> jax.Array:
        own, before, across = step
        both, inverse = part.F @ across, inverse_factors(part, point.levels)
        spread = own - both - both.mT + part.F @ before @ part.F.mT
        return jnp.einsum("eij,ejk,eik->ei", inverse, spread, inverse)

    return model.each(one, steps)
