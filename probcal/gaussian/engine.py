"""The posterior linearised at a point, and who solves it: what every engine gives, whatever its
algebra.

The density of the biases z, trajectories integrated by Laplace's formula, is a Gaussian of the
data, the information S of `model` about z, times a sum of Gaussian factors. `at.solve(factors,
right)` is (S + P)^-1 right, P their precision. An engine is a class with the members of `Engine`
that gives an `Expansion`; `choose` alone knows sizes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Protocol

import jax
import numpy as np

from probcal.gaussian.mode import (
    SETTLED,
    TRACK_STEPS,
    Eliminated,
    Point,
    find_tracks,
    level_square,
    log_density,
    mixing_gain,
)
from probcal.model.model import Data, Model
from probcal.model.rows import LinearRows
from probcal.model.trajectories import States
from probcal.priors import Precision


class Estimate(NamedTuple):
    """A number and its standard error, 0 where it is exact."""

    value: float
    error: float = 0.0


class Group(NamedTuple):
    """Gaussian factors exp(pull' z - z' precision z / 2) of a few biases each."""

    members: Any  # (B, p) biases, M of none
    precision: Any  # (B, p, p)
    pull: Any  # (B, p)


@dataclass(frozen=True, eq=False)
class Factors:
    """A sum of Gaussian factors on few biases each: precisions, correlations, surveys, sites,
    integrated places."""

    groups: tuple[Group, ...] = ()

    @classmethod
    def alone(cls, precision: Any) -> Factors:
        """One factor a bias around zero, of precisions (M,)."""
        own = np.asarray(precision)
        return cls((Group(np.arange(len(own))[:, None], own[:, None, None], np.zeros((len(own), 1))),))

    @classmethod
    def of(cls, prior: Precision) -> Factors:
        """The factors of a Gaussian prior around zero."""
        return cls.alone(prior.alpha) + cls.coupled(prior)

    @classmethod
    def coupled(cls, prior: Precision) -> Factors:
        """The factors that correlations of a Gaussian prior add to `alone`."""
        parts = [(np.asarray(members)[None], np.asarray(own)[None]) for members, own in prior.coupling]
        return cls(tuple(Group(members, own, np.zeros(members.shape)) for members, own in parts))

    def __add__(self, other: Factors) -> Factors:
        return Factors((*self.groups, *other.groups))

    def matrix(self, biases: int) -> np.ndarray:
        """The precision (M, M)."""
        found = np.zeros((biases + 1, biases + 1))
        for own in self.groups:
            np.add.at(found, (own.members[:, :, None], own.members[:, None, :]), np.asarray(own.precision))
        return found[:biases, :biases]

    def pull(self, z: Any) -> Any:
        """Slope (M,) of the sum at z."""
        padded = np.append(np.asarray(z), 0.0)
        found = np.zeros_like(padded)
        for own in self.groups:
            np.add.at(found, own.members, own.pull - np.einsum("bij,bj->bi", own.precision, padded[own.members]))
        return found[:-1]

    def value(self, z: Any) -> float:
        """Logarithm of the product at z, 0 at zero."""
        padded, total = np.append(np.asarray(z), 0.0), 0.0
        for own in self.groups:
            z_own = padded[own.members]
            half = np.einsum("bi,bij,bj->", z_own, own.precision, z_own)
            total += float(np.sum(own.pull * z_own) - 0.5 * half)
        return total

    def diagonal(self, biases: int) -> np.ndarray:
        """Diagonal (M,) of the precision."""
        found = np.zeros(biases + 1)
        for own in self.groups:
            np.add.at(found, own.members, np.diagonal(np.asarray(own.precision), axis1=1, axis2=2))
        return found[:-1]

    @property
    def members(self) -> list[np.ndarray]:
        """Biases (B, p) of each group."""
        return [np.asarray(own.members) for own in self.groups]


class Sampled(NamedTuple):
    """Draws of biases and trajectories together."""

    z: Any  # (D, M)
    states: Sequence[Any]  # (D, E, n) of each recursion


class Spread(NamedTuple):
    """Variances with their standard errors, 0 where they are exact."""

    biases: np.ndarray  # (M,)
    error: np.ndarray  # (M,) of these
    states: tuple[np.ndarray, ...]  # (E, n) of each recursion


class Expansion(Protocol):
    """The posterior expanded about a point, trajectories eliminated.

    Variances are those that the factors leave.
    """

    @property
    def model(self) -> Model:
        """The model."""

    @property
    def point(self) -> Point:
        """The point of the expansion."""

    @property
    def rows(self) -> LinearRows:
        """The linearised rows of each block."""

    @property
    def eliminated(self) -> Eliminated:
        """The trajectories, eliminated at held biases or with these."""

    def given_biases(self) -> Sequence[Any]:
        """The trajectories of each recursion given the biases, as `linearised.GivenBiases`."""

    @property
    def held_states(self) -> tuple[Any, ...]:
        """Covariance (E, n, n) of every state of each recursion, the biases known."""

    def density(self) -> float:
        """Log density of the data given the biases at the point, up to the constant of the noises."""

    def score(self) -> Any:
        """Its slope (M,) by the biases, the volume of the trajectories with it."""

    def slope(self) -> Any:
        """Slope (M,) of the log-likelihood by the biases, tracks following, without it."""

    def log_det(self, factors: Factors) -> Estimate:
        """Log determinant of the precision of the biases."""

    def solve(self, factors: Factors, right: Any) -> Any:
        """Covariance of the biases times right, (M,) or (M, K)."""

    def apply(self, columns: Any) -> Any:
        """Information of the data about the biases times columns, (M,) or (M, K)."""

    def information(self) -> np.ndarray | None:
        """The information (M, M) itself; None where the biases are too many for it."""

    def moved(self, dz: Any) -> Point:
        """The point with the biases moved by dz (M,), all tracks following."""

    def marginals(self, factors: Factors, members: np.ndarray) -> np.ndarray:
        """Covariances (B, p, p) of biases (B, p), M of none: 1 on its diagonal."""

    def spread(self, factors: Factors) -> Spread:
        """Variance of every bias and state; estimated where the engine has no exact ones."""

    def states(self, factors: Factors) -> tuple[Any, ...]:
        """Covariance (E, n, n) of every state of each recursion."""

    def noises(self, factors: Factors) -> tuple[Any, ...]:
        """Variance (E, n) of every whitened noise of each recursion."""

    def predicted(self, factors: Factors) -> tuple[Any, ...]:
        """Variance (N, C) of each predicted value."""

    def leverages(self, factors: Factors) -> tuple[Any, ...]:
        """Leverage of every datum (N, C) on the biases: w times the part of the above that the
        biases cause."""

    def deviations(self, factors: Factors, key: jax.Array, count: int) -> Sampled:
        """Biases and states drawn around zero, as they differ from their mean."""

    def followed(self, root: Any) -> list[np.ndarray]:
        """Variance (E, n) of every state where the biases have the covariance root root', root (M,
        R)."""


class Engine(Protocol):
    """A way to linearise and solve."""

    cheap: ClassVar[bool]  # whether expansions cost so little that many are made without a look first

    @property
    def exact(self) -> bool:
        """True where log determinants and variances are exact.

        Else `log_det` and `spread` estimate them, each with its standard error; `states`, `noises`,
        `predicted` and `leverages` raise `InputError`.
        """

    def at(self, model: Model, point: Point, rows: LinearRows | None = None) -> Expansion:
        """The posterior at a consistent point; rows as the caller linearised them, by default with
        the expected information."""

    def settled(self, model: Model, point: Point) -> Expansion:
        """The same at the modes of its trajectories for its biases."""
        return self.at(model, find_tracks(model, point, TRACK_STEPS, SETTLED))


def told_alone(at: Expansion) -> np.ndarray:
    """Information (M,) of the rows about each bias, all other biases and the tracks known."""
    found = np.zeros(at.model.biases + 1)
    for *_, read, lin in at.model.each_block(at.model.read, at.rows):
        np.add.at(found, read, np.einsum("nc,ncp,ncp->np", lin.weight, lin.bias, lin.bias))
    return found[:-1]


def evidence(at: Expansion, prior: Precision, factors: Factors | None = None) -> Estimate:
    """Log evidence at the mode under a Gaussian prior, trajectories and biases integrated by
    Laplace's formula.

    `factors` are those of the prior, for who has them. A precision of 0 is a flat prior: its
    density counts as one.
    """
    factors = Factors.of(prior) if factors is None else factors
    volume = at.log_det(factors)
    own = 0.5 * float(prior.log_determinant()) + factors.value(at.point.z)
    return Estimate(at.density() + own - 0.5 * volume.value, 0.5 * volume.error)


def noise_score(at: Expansion, factors: Factors) -> tuple[Data, States]:
    """Terms of the slope of the log evidence by log noise levels, biases and trajectories
    integrated.

    Of every datum (N, C) of each block, and of every whitened noise (E, n) of each recursion.
    """
    return _noise_score(at.model, at.point, tuple(at.predicted(factors)), tuple(at.noises(factors)))


def noise_terms(at: Expansion, factors: Factors) -> list[tuple[Data, States]]:
    """`noise_score`, and the same of the information about log noise levels.

    That is a lower bound: it lacks what noises that hang together add.
    """
    given = at.model, at.point, tuple(at.predicted(factors)), tuple(at.noises(factors))
    return [_noise_score(*given), _noise_information(*given)]


def density_of(model: Model, point: Point, volume: jax.Array) -> float:
    """Log density of the data at a point whose trajectories have a posterior precision of log
    determinant `volume`."""
    spread = level_square(model, point.levels)
    return float(log_density(model, point) + mixing_gain(model) - 0.5 * (spread + np.asarray(volume)))


@jax.jit
def _noise_score(model: Model, point: Point, spread: Data, driven: States) -> tuple[Data, States]:
    parts = (model.level_score(point), model.information(point), spread, model.measured)
    rows = jax.tree.map(lambda score, weight, own, there: score + weight * own - there, *parts)
    return rows, jax.tree.map(lambda u, variance: u**2 + variance - 1.0, tuple(point.noises), driven)


@jax.jit
def _noise_information(model: Model, point: Point, spread: Data, driven: States) -> tuple[Data, States]:
    parts = (model.information(point), spread, model.measured)
    rows = jax.tree.map(lambda weight, own, there: 2.0 * there * (1.0 - weight * own) ** 2, *parts)
    return rows, jax.tree.map(lambda own: 2.0 * (1.0 - own) ** 2, driven)
