"""The answer of any method: one type, which `fit`, `study`, `sbc` and the tree read.

What differs between methods stands in its posterior: a Gaussian (`Normal`), or the draws of a sampler.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from statistics import NormalDist
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from probcal.errors import InputError
from probcal.gaussian.choose import engine_of
from probcal.gaussian.draws import draw, draw_biases, draws_a_chain
from probcal.gaussian.engine import Expansion
from probcal.gaussian.linearised import LaplaceApproximation
from probcal.gaussian.mode import Point
from probcal.modes.grid import track_mode
from probcal.modes.mirrors import Mirrored
from probcal.priors import Prior
from probcal.results.blocks import SensorBlocks
from probcal.results.schema import INTERVAL
from probcal.status import Status

if TYPE_CHECKING:
    from probcal.problem import Problem

CHAINS = 4  # of the draws of a Gaussian, so that ArviZ reads them as it reads a sampler's
HALF = NormalDist().inv_cdf(0.5 + INTERVAL / 2)  # sds from the mean to an end of an interval


class Named(Protocol):
    """What an answer says of a method."""

    name: ClassVar[str]

    def note(self, prior: Prior) -> str:
        """What the intervals are worth under a prior."""


class Draws(NamedTuple):
    """Draws chain by chain, and what hangs on them; empty where it was not asked for."""

    z: np.ndarray  # (chain, draw, M)
    levels: np.ndarray  # (chain, draw, H)
    states: Sequence[np.ndarray]  # (chain, draw, E, n) of each recursion
    kept: np.ndarray  # (kept,) which draws of each chain have values by datum
    log_likelihood: Sequence[np.ndarray]  # (chain, kept, N, C) of each block, (chain, kept, 1, 1) of many data
    replicas: Sequence[np.ndarray]  # (chain, kept, N, C) of each block


class Tracks(NamedTuple):
    """Posterior moments of the states of one recursion."""

    mean: np.ndarray  # (E, n)
    sd: np.ndarray  # (E, n)


@dataclass(frozen=True, eq=False)
class Summary:
    """What an answer says of each bias, z over its scale, in the order of `problem.labels`."""

    kind: str  # "Laplace", "mixture", "exact" or "variational"
    precisions: str  # of the prior: "given", "maximised", "integrated" or "sampled"
    mean: np.ndarray  # (M,)
    covariance: np.ndarray | None  # (M, M); None where the biases are too many for it
    lower: np.ndarray  # (M,) of the interval
    upper: np.ndarray  # (M,)
    gamma: np.ndarray  # (M,)
    precision: np.ndarray  # (M,) of the prior
    information: np.ndarray | None  # (M, M) of the data, trajectories marginalised; None as well
    levels: np.ndarray  # (H,) log factors of the unknown noise levels
    evidence: float | None = None  # where the method has one
    columns: Mapping[str, np.ndarray] = field(default_factory=dict)  # further ones by name, (M,)
    blocks: SensorBlocks | None = None  # of the covariance, where there is none of all

    @property
    def whole(self) -> np.ndarray:
        """The covariance (M, M); raises `InputError` where the biases are too many for it."""
        if self.covariance is None:
            raise InputError(f"a fit of {len(self.mean)} biases in sparse form holds no covariance of all of them")
        return self.covariance

    @property
    def sd(self) -> np.ndarray:
        """Standard deviation of each bias, (M,)."""
        if self.covariance is not None:
            return np.sqrt(np.diag(self.covariance))
        assert self.blocks is not None
        return np.sqrt(self.blocks.variance)


@dataclass(frozen=True, eq=False)
class Posterior(ABC):
    """What a method knows: a summary of the biases, and draws of everything."""

    problem: Problem
    prior: Prior
    point: Point  # the mode, or the mean with the trajectories at their mode
    summary: Summary

    chained: ClassVar[bool]  # whether draws depend on each other
    held: ClassVar[bool]  # whether noise levels are the same in every draw

    @property
    @abstractmethod
    def states(self) -> Sequence[np.ndarray]:
        """Mean states (E, n) of each recursion."""

    @abstractmethod
    def tracks(self) -> Sequence[Tracks]:
        """Mean and sd of all states."""

    @abstractmethod
    def draws(self, key: jax.Array, keep: tuple[str, ...]) -> Draws:
        """Draws; `keep` names "states", "log_likelihood" and "replicas"."""

    @abstractmethod
    def log_prior(self, draws: Draws) -> np.ndarray | None:
        """Log density (chain, draw, M) of each bias given its precision, where each has one of its own."""

    @property
    def sound(self) -> bool:
        """Whether every number is finite: a flat prior on a singular problem leaves no interval."""
        return bool(np.isfinite(self.summary.whole).all() and np.isfinite(self.summary.mean).all())

    @property
    def here(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean and sd (M,) of the biases on this side of a mirror, where there is one."""
        return self.summary.mean, self.summary.sd

    @property
    def worth(self) -> float | None:
        """What optima of several starts are ranked by: the evidence."""
        return self.summary.evidence

    @cached_property
    def before(self) -> Point:
        """The point with all biases zero, each trajectory at its mode."""
        return track_mode(self.problem, uncalibrated(self.problem, self.point))

    @property
    def pull(self) -> np.ndarray:
        """Linear term (M,) of the log-likelihood of z about zero, trajectories integrated; `information` is its square.

        Its slope at the point is that of the marginal likelihood, the volume of the trajectories with it.
        """
        at, information = self.expansion, self.summary.information
        z = np.asarray(at.point.z)
        return np.asarray(at.apply(z) if information is None else information @ z) + np.asarray(at.score())

    @property
    def variables(self) -> Mapping[str, Any]:
        """Further variables by draw: dims beyond chain and draw, values, and their coordinates."""
        return {}

    @property
    def hyper(self) -> Mapping[str, np.ndarray]:
        """Draws of the hyper-parameters, (chain, draw, ...)."""
        return {}

    @property
    def stats(self) -> Mapping[str, np.ndarray]:
        """What the sampler says of each draw, (chain, draw)."""
        return {}

    @property
    def attrs(self) -> Mapping[str, float]:
        """Numbers of the whole run."""
        return {}

    @property
    def expansion(self) -> Expansion:
        """The posterior expanded about the point."""
        return self._expanded

    @cached_property
    def _expanded(self) -> Expansion:
        return engine_of("dense", self.problem.model).at(self.problem.model, self.point)


@dataclass(frozen=True, eq=False)
class NormalPosterior(Posterior):
    """A Gaussian of the biases around a point, noise levels held."""

    found: LaplaceApproximation

    chained: ClassVar[bool] = False
    held: ClassVar[bool] = True

    @classmethod
    def of(
        cls, problem: Problem, prior: Prior, point: Point, found: LaplaceApproximation, alpha: np.ndarray
    ) -> NormalPosterior:
        """The Gaussian at a point, with the precisions alpha (M,) that a method ended with."""
        mean, covariance = np.asarray(point.z), np.asarray(found.covariance)
        with np.errstate(invalid="ignore"):  # a singular problem has no sd
            half = HALF * np.sqrt(np.diag(covariance))
        summary = Summary(
            "Laplace", precisions_of(problem, prior), mean, covariance, mean - half, mean + half,
            np.asarray(found.gamma), alpha, np.asarray(found.information), np.asarray(point.levels),
            float(found.evidence) if prior.proper else None,
        )  # fmt: skip
        return cls(problem, prior, point, summary, found)

    @property
    def states(self) -> Sequence[np.ndarray]:
        """States (E, n) of each recursion at the point."""
        return [np.asarray(x) for x in self.point.states]

    def tracks(self) -> Sequence[Tracks]:
        """States at the point, and their sd with the biases uncertain."""
        return tracks_of(self.expansion, SensorBlocks.of(np.asarray(self.found.covariance)))

    def draws(self, key: jax.Array, keep: tuple[str, ...]) -> Draws:
        """Independent draws, as many as the size of the data lets be kept."""
        shape = (CHAINS, draws_a_chain(self.problem.model.size, CHAINS))
        keys = jax.random.split(key)
        z = draw_biases(self.point, self.found.covariance, keys[0], shape[0] * shape[1])
        drawn = draw(self.expansion, z, self.point.levels, keys[1], keep)

        def split(a: Any) -> np.ndarray:
            return np.asarray(a).reshape(*shape, *a.shape[1:])

        levels = np.broadcast_to(self.summary.levels, (*shape, len(self.summary.levels)))
        states, likelihood, replicas = ([split(a) for a in part] for part in drawn)
        return Draws(split(z), levels, states, np.arange(shape[1]), likelihood, replicas)

    def log_prior(self, draws: Draws) -> np.ndarray | None:
        """Log density (chain, draw, M) of each bias given its precision; None for flat or correlated ones."""
        independent = self.prior.proper and not self.prior.correlation
        return log_prior_normal(draws.z, self.summary.precision) if independent else None


def precisions_of(problem: Problem, prior: Prior) -> str:
    """The use of the precisions in a climb: "maximised", or "given" where it learns none."""
    return "maximised" if prior.learns and not problem.surveyed.all() else "given"


def tracks_of(at: Expansion, spread: SensorBlocks) -> list[Tracks]:
    """States of each recursion at a point, and their sd for a covariance of the biases."""
    pairs = at.model.each_layout(at.point.states, at.followed(spread.root()))
    return [Tracks(np.asarray(x), np.sqrt(np.maximum(np.asarray(variance), 0.0))) for _, x, variance in pairs]


def log_prior_normal(z: np.ndarray, precision: np.ndarray) -> np.ndarray:
    """Log density of each entry of z, Gaussian around zero with its precision."""
    return 0.5 * (np.log(precision / (2 * np.pi)) - precision * z**2)


@dataclass(frozen=True, eq=False)
class Answer:
    """What a method found for a problem, what was asked for and what ran, and how it ended."""

    problem: Problem  # that was solved; without motion for weighted least squares
    method: Named  # that ran
    requested: Named  # that was asked for
    prior: Prior
    posterior: Posterior
    status: Status
    message: str  # on the status and what to do; empty where nothing is to be said
    bias_status: tuple[str, ...]
    iterations: int  # of the outer loop, or draws a chain
    trace: np.ndarray | None = None  # objective of every outer iteration
    steps: np.ndarray | None = None  # (I, M) biases after every outer iteration, where they are kept
    interrupted: bool = False
    motion: str = "used"  # or "left out", for least squares
    optima: tuple[Answer, ...] = ()  # those found from several starts
    best: int = 0  # which of them is reported, or where a sampler began
    mirrors: tuple[Mirrored, ...] = ()  # answers on the other side of a line or plane that fit about as well

    @property
    def objective(self) -> float:
        """Evidence where the prior is proper, else the last value of the trace; -inf where there is none."""
        value = self.posterior.worth
        value = float(self.trace[-1]) if value is None and self.trace is not None and len(self.trace) else value
        return -np.inf if value is None or not np.isfinite(value) else value


def uncalibrated(problem: Problem, point: Point) -> Point:
    """The point with all biases zero, but for the clocks by which the rows of the problem are taken."""
    return point._replace(z=jnp.asarray(problem.first_z))
