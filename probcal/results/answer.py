"""The answer of any method: one type, which `fit`, `study`, `sbc` and the tree read.

What differs between methods stands in its posterior, plain data and a function that draws: `inference.mixture` makes
that of a climb, `inference.posterior` that of a sampler.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import cached_property
from statistics import NormalDist
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol

import jax
import numpy as np

from probcal.gaussian.choose import engine_of
from probcal.gaussian.dense import DenseEngine
from probcal.gaussian.engine import Expansion, Factors, Spread, evidence
from probcal.gaussian.joint import blocks_of
from probcal.gaussian.mode import Point
from probcal.modes.explore import Mirrored
from probcal.modes.grid import track_mode
from probcal.priors import PRECISION_BOUNDS, Prior
from probcal.results.blocks import SensorBlocks
from probcal.results.schema import INTERVAL
from probcal.status import FOUND, Status, judge

if TYPE_CHECKING:
    from probcal.problem import Problem

CHAINS = 4  # of the draws of a Gaussian, so that ArviZ reads them as it reads a sampler's
NUMBERS = 400_000  # of the draws of all biases in a tree, where their covariance is not held
MOST = 250  # draws of a chain then
HALF = NormalDist().inv_cdf(0.5 + INTERVAL / 2)  # sds from the mean to an end of an interval


class Named(Protocol):
    """The description of a method in an answer."""

    name: ClassVar[str]
    chooses: ClassVar[bool]

    def note(self, prior: Prior) -> str:
        """Describes the validity of the intervals under a prior."""


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
    """The summary of each bias, in units of its scale and in the order of `problem.labels`."""

    kind: str  # "Laplace", "mixture", "exact" or "variational"
    precisions: str  # of the prior: "given", "maximised", "integrated" or "sampled"
    mean: np.ndarray  # (M,)
    covariance: SensorBlocks
    lower: np.ndarray  # (M,) of the interval
    upper: np.ndarray  # (M,)
    gamma: np.ndarray  # (M,)
    precision: np.ndarray  # (M,) of the prior
    levels: np.ndarray  # (H,) log factors of the unknown noise levels
    information: np.ndarray | None = None  # (M, M) of the data, trajectories marginalised, if held
    evidence: float | None = None  # where the method has one
    columns: Mapping[str, np.ndarray] = field(default_factory=dict)  # further ones by name, (M,)

    @classmethod
    def of(
        cls,
        kind: str,
        precisions: str,
        mean: np.ndarray,
        covariance: SensorBlocks,
        alpha: Any,
        *,
        gamma: np.ndarray | None = None,
        interval: Any = None,
        governed: np.ndarray | None = None,
        levels: Any = (),
        information: Any = None,
        **others: Any,
    ) -> Summary:
        """The summary of biases of these moments under precisions alpha (M,).

        The interval and gamma are those of a Gaussian where they are not given. The precision of a bias that a
        hierarchy governs, True in `governed` (M,), is the one that leaves its gamma.
        """
        alpha, variance = np.asarray(alpha), covariance.variance
        with np.errstate(invalid="ignore", divide="ignore"):  # a singular problem has no sd
            half = HALF * np.sqrt(variance)
            gamma = np.clip(1.0 - alpha * variance, 0.0, 1.0) if gamma is None else gamma
            own = np.clip((1 - gamma) / np.maximum(variance, 1e-300), *PRECISION_BOUNDS)
        lower, upper = (mean - half, mean + half) if interval is None else interval
        precision = alpha if governed is None else np.where(governed, own, alpha)
        information = None if information is None else np.asarray(information)
        levels = np.asarray(levels, float)
        return cls(kind, precisions, mean, covariance, lower, upper, gamma, precision, levels, information, **others)

    @property
    def sd(self) -> np.ndarray:
        """Standard deviation of each bias, (M,)."""
        return np.sqrt(self.covariance.variance)


@dataclass(frozen=True, eq=False)
class Posterior:
    """The knowledge of a method: a summary of the biases, and a function that draws everything."""

    problem: Problem
    prior: Prior
    point: Point  # the mode, or the mean with the trajectories at their mode
    summary: Summary
    draw: Callable[[Posterior, jax.Array, tuple[str, ...]], Draws]  # of itself, with a key, what is kept
    _: KW_ONLY
    # the posterior expanded at the point or near it; None: by the dense engine, when asked for
    at: Expansion | None = None
    # of the prior, where that expansion is given
    factors: Factors | None = None
    # the covariance that the declared scales leave, where that of all biases is not held
    declared: SensorBlocks | None = None
    # of the states of each recursion, where they are known
    moments: Sequence[Tracks] | None = None
    # (chain, draw, ...) hyper-parameters, and the hierarchy that they belong to
    hyper: Mapping[str, np.ndarray] = field(default_factory=dict)
    hierarchy: Any = None
    # precision of each bias by draw, where a hierarchy governs it
    precisions: Callable[[], np.ndarray | None] | None = None
    # further variables by draw: dims beyond chain and draw, values, and their coordinates
    variables: Mapping[str, Any] = field(default_factory=dict)
    # (chain, draw) of a sampler
    stats: Mapping[str, np.ndarray] = field(default_factory=dict)
    # numbers of the whole run
    attrs: Mapping[str, float] = field(default_factory=dict)
    run: Any = None  # of a sampler
    joint: Callable[[Point, Any], float] | None = None  # the log density that a sampler keeps of each draw
    chained: bool = False  # whether draws depend on each other
    held: bool = True  # whether noise levels are the same in every draw
    # the answers that a mixture is of, with the logarithms of their weights
    parts: tuple[Mirrored, ...] = ()
    # mean and sd (M,) on the heaviest side of a mirror, where draws lie on several
    side: tuple[np.ndarray, np.ndarray] | None = None
    zero: Point | None = None  # with all biases zero, where it is not the mode of the trajectories there
    term: np.ndarray | None = None  # (M,) `pull`, where the expansion does not tell it

    @property
    def states(self) -> Sequence[np.ndarray]:
        """Mean states (E, n) of each recursion."""
        if self.moments is not None:
            return [own.mean for own in self.moments]
        return [np.asarray(x) for x in self.point.states]

    def tracks(self) -> Sequence[Tracks]:
        """Mean and sd of all states."""
        if self.moments is not None:
            return self.moments
        return tracks_of(self.expansion, self.summary.covariance)

    def draws(self, key: jax.Array, keep: tuple[str, ...]) -> Draws:
        """Draws; `keep` names "states", "log_likelihood" and "replicas"."""
        return self.draw(self, key, keep)

    def log_prior(self, draws: Draws) -> np.ndarray | None:
        """Log density (chain, draw, M) of each bias given its precision; None for flat or correlated ones."""
        known = self.prior.proper and not self.prior.correlation and self.summary.covariance.whole
        alpha = self.precisions() if self.precisions is not None else self.summary.precision if known else None
        return None if alpha is None else 0.5 * (np.log(alpha / (2 * np.pi)) - alpha * draws.z**2)

    @property
    def sound(self) -> bool:
        """True if every number is finite: a flat prior on a singular problem leaves no interval."""
        parts = self.summary.covariance.covariance, self.summary.mean
        return all(bool(np.isfinite(part).all()) for part in parts)

    @property
    def here(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean and sd (M,) of the biases on this side of a mirror, where there is one."""
        return (self.summary.mean, self.summary.sd) if self.side is None else self.side

    @cached_property
    def worth(self) -> float | None:
        """The evidence, by which optima of several starts are ranked.

        That of a mixture is taken at the mean with the precisions that it ended with: declared scales would shun a
        swap.
        """
        if self.summary.kind != "mixture" or self.declared is not None:
            return self.summary.evidence
        prior = self.problem.first_precision(self.prior)
        alpha = jax.device_put(self.summary.precision)
        with jax.enable_x64(True):
            at = DenseEngine().at(self.problem.model, self.point)
            return evidence(at, prior._replace(alpha=alpha)).value

    @cached_property
    def before(self) -> Point:
        """The point with all biases zero, each trajectory at its mode."""
        return self.zero or track_mode(self.problem, uncalibrated(self.problem, self.point))

    @property
    def pull(self) -> np.ndarray:
        """Linear term (M,) of the log-likelihood of z about zero, trajectories integrated; `information` is its square.

        Its slope at the point is that of the marginal likelihood, the volume of the trajectories with it.
        """
        if self.term is not None:
            return self.term
        at, information = self.expansion, self.summary.information
        z = np.asarray(at.point.z)
        return np.asarray(at.apply(z) if information is None else information @ z) + np.asarray(at.score())

    @cached_property
    def expansion(self) -> Expansion:
        """The posterior expanded about the point."""
        model = self.problem.model
        return engine_of("dense", model).at(model, self.point) if self.at is None else self.at


def few_draws(biases: int) -> int:
    """Number of draws of a chain of which a tree holds every bias: few where these are many."""
    return int(np.clip(NUMBERS // (CHAINS * max(biases, 1)), 2, MOST))


def blocks_under(at: Expansion, factors: Factors, spread: Spread | None = None) -> SensorBlocks:
    """Covariances of the biases of each sensor under factors; estimated, their variances alone."""
    spread, M = at.spread(factors) if spread is None else spread, at.model.biases
    if spread.error.any():
        return SensorBlocks(M, np.arange(M)[:, None], spread.biases[:, None, None])
    members = blocks_of(at.model)
    return SensorBlocks(M, members, np.asarray(at.marginals(factors, members)))


def precisions_of(problem: Problem, prior: Prior) -> str:
    """The use of the precisions in a climb: "maximised", or "given" where it learns none."""
    return "maximised" if prior.learns and not problem.surveyed.all() else "given"


def tracks_of(at: Expansion, spread: SensorBlocks) -> list[Tracks]:
    """States of each recursion at a point, and their sd for a covariance of the biases."""
    return tracks_at(at.point, at.followed(spread.root()))


def tracks_at(point: Point, variances: Sequence[Any]) -> list[Tracks]:
    """States of each recursion at a point, with their variances (E, n)."""
    sds = [np.sqrt(np.maximum(np.asarray(own), 0.0)) for own in variances]
    return list(map(Tracks, map(np.asarray, point.states), sds))


@dataclass(frozen=True, eq=False)
class Answer:
    """The result of a method for a problem, with the request, what ran, and the status."""

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
    precisions: np.ndarray | None = None  # (I, M) of these biases after every outer iteration
    interrupted: bool = False
    motion: str = "used"  # or "left out", for least squares
    optima: tuple[Answer, ...] = ()  # those found from several starts
    best: int = 0  # which of them is reported, or where a sampler began
    mirrors: tuple[Mirrored, ...] = ()  # answers on the other side of a line or plane that fit about as well

    def noted(self, said: str, **changes: Any) -> Answer:
        """The answer with a further sentence in its message, and other changes."""
        return replace(self, message=f"{self.message} {said}".strip(), **changes)

    def judged(self, **facts: Any) -> Answer:
        """The answer with the status and the sentences that follow from further facts, in the names of `FOUND`."""
        status, said = judge(FOUND, facts, self.status)
        return self.noted(said, status=status)

    @property
    def objective(self) -> float:
        """Evidence where the prior is proper, else the last value of the trace; -inf where there is none."""
        value = self.posterior.worth
        value = float(self.trace[-1]) if value is None and self.trace is not None and len(self.trace) else value
        return -np.inf if value is None or not np.isfinite(value) else value


def uncalibrated(problem: Problem, point: Point) -> Point:
    """The point with all biases zero, but for the clocks by which the rows of the problem are taken."""
    return point._replace(z=jax.device_put(problem.first_z))
