"""A fit taken up again: the problem at the point where a DataTree says that its fit ended, linearised there."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from probcal import linalg
from probcal.errors import InputError
from probcal.gaussian.dense import DenseEngine, DenseExpansion
from probcal.gaussian.draws import draw
from probcal.gaussian.engine import Engine, Expansion, Factors
from probcal.gaussian.information import at_levels
from probcal.gaussian.linearised import Linearisation, held_noises, linearise, roots_of
from probcal.gaussian.mode import Eliminated, Point
from probcal.gaussian.places import tilt_at
from probcal.gaussian.sparse import SparseEngine
from probcal.inference.blockwise import BlockPosterior, declared_blocks, engine_of
from probcal.lazy import Later
from probcal.model.model import Recursion
from probcal.model.motions import level_logs
from probcal.model.rows import Linearised
from probcal.modes.grid import follow_states, track_mode
from probcal.priors import Precision
from probcal.problem import Epochs, Problem
from probcal.results.answer import Answer
from probcal.results.blocks import SensorBlocks
from probcal.results.groups import datum_of, gather, weights_of_tails
from probcal.results.read import each_track, saved_by_epoch
from probcal.results.schema import matrix_of

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
else:
    pd, xr = Later("pandas"), Later("xarray")


COLUMNS = 16  # bias directions that are filtered together


@dataclass(frozen=True, eq=False)
class Judged(ABC):
    """The problem of a fit, the point where it ended, and its rows linearised there, for every
    check."""

    problem: Problem
    point: Point
    lins: Sequence[Linearised]  # with the expected information
    solved: Eliminated
    picks: list[Any]  # where each block keeps its data
    data: pd.DataFrame  # sensor, channel, target, time, row of every datum
    prior: Precision  # with the precisions that the fit ended with

    whole: ClassVar[bool]  # whether the covariance of all biases is held

    def flat(self, parts: Any) -> np.ndarray:
        """Arrays (..., N, C) of the blocks as one (..., data)."""
        return gather([np.asarray(part) for part in parts], self.picks)

    @property
    @abstractmethod
    def engine(self) -> Engine:
        """By which it was solved."""

    @property
    @abstractmethod
    def expansion(self) -> Expansion:
        """The posterior at the point."""

    @property
    def factors(self) -> Factors:
        """Those of the prior."""
        return Factors.of(self.prior)

    @property
    @abstractmethod
    def sd(self) -> np.ndarray:
        """Standard deviation (M,) of z."""

    @abstractmethod
    def times(self, columns: np.ndarray) -> np.ndarray:
        """The covariance of z times columns (M, K)."""

    @property
    @abstractmethod
    def root(self) -> Any:
        """A root (M, R) of the covariance of z.

        Of the biases of each sensor alone where that of all is not held.
        """

    @property
    @abstractmethod
    def roots(self) -> list[jax.Array]:
        """Directions (M, K) of the biases whose squares add up to their covariance.

        None where that is not held.
        """

    def shared(self) -> np.ndarray | None:
        """Degrees of freedom that the biases took of each datum (D,), where no roots tell them."""
        return None

    def declared(self, tree: xr.DataTree) -> SensorBlocks | None:
        """Covariance of z by sensor that the declared scales leave, where that of all is not held."""
        return None

    @abstractmethod
    def drawn(self, z: jax.Array, levels: jax.Array, key: jax.Array) -> tuple[jax.Array, Sequence[jax.Array]]:
        """Draws of biases (D, M), those of the fit where its whole covariance is held, with trajectories (D, E, n)."""

    @cached_property
    def noise_roots(self) -> list[tuple[jax.Array, jax.Array]]:
        """Roots (E, n, n) of the process noise and of the information of the rows."""
        return roots_of(self.problem.model, self.point.levels, self.solved)

    @cached_property
    def held_noises(self) -> Sequence[jax.Array]:
        """Variance (E, n) of every whitened noise of each recursion, the biases known."""
        return held_noises(self.problem.model, self.point.levels, self.solved)

    @property
    def readers(self) -> np.ndarray:
        """True where a sensor reads a bias, (sensors, M), sensors in the order of the network."""
        found = np.zeros((len(self.problem.network.sensors), self.problem.model.biases + 1), bool)
        for index, bias in zip(self.problem.row_index, self.problem.model.read, strict=True):
            found[self.problem.measurements.sensor[index][:, None], np.asarray(bias)] = True
        return found[:, :-1]


@dataclass(frozen=True, eq=False)
class Fitted(Judged):
    """A fit whose covariance is held."""

    at: Linearisation
    covariance: np.ndarray  # (M, M) of z

    whole: ClassVar[bool] = True

    @property
    def engine(self) -> Engine:
        """The dense one."""
        return DenseEngine()

    @property
    def expansion(self) -> Expansion:
        """The posterior at the point."""
        return DenseExpansion.of(self.at)

    @property
    def sd(self) -> np.ndarray:
        """Standard deviation (M,) of z."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    def times(self, columns: np.ndarray) -> np.ndarray:
        """The covariance of z times columns (M, K)."""
        return self.covariance @ columns

    @property
    def root(self) -> np.ndarray:
        """The symmetric root (M, M) of the covariance."""
        return linalg.symmetric_root(self.covariance)

    @property
    def roots(self) -> list[jax.Array]:
        """Columns of the symmetric root of the covariance."""
        M = self.problem.model.biases
        chunk = max(min(COLUMNS, M), 1)
        root = np.pad(self.root, ((0, 0), (0, -M % chunk)))
        return [jnp.asarray(part) for part in np.split(root, max(root.shape[1] // chunk, 1), axis=1)]

    def drawn(self, z: jax.Array, levels: jax.Array, key: jax.Array) -> tuple[jax.Array, Sequence[jax.Array]]:
        """The biases, and a trajectory for each draw of these."""
        return z, draw(self.at, z, levels, key).states

    @cached_property
    def noise_roots(self) -> list[tuple[jax.Array, jax.Array]]:
        """Roots (E, n, n) of the process noise and of the information of the rows."""
        return [(own.L, own.half) for own in self.at.trajectories]

    @cached_property
    def held_noises(self) -> Sequence[jax.Array]:
        """Variance (E, n) of every whitened noise of each recursion, the biases known."""
        return [own.spread for own in self.at.trajectories]


@dataclass(frozen=True, eq=False)
class JudgedLarge(Judged):
    """A fit in sparse form taken up again."""

    at: Expansion
    blocks: SensorBlocks  # of the covariance of z
    gamma: np.ndarray | None  # (M,) how well the data determine each bias; None where they did not see the biases
    scaled: SensorBlocks | None = None  # of that covariance under a prior of the declared scales, where it is known
    solver: Engine = field(default_factory=SparseEngine)

    whole: ClassVar[bool] = False

    @property
    def engine(self) -> Engine:
        """That of the fit, the sparse one where it came from a file."""
        return self.solver

    @property
    def expansion(self) -> Expansion:
        """The posterior at the point."""
        return self.at

    @property
    def sd(self) -> np.ndarray:
        """Standard deviation (M,) of z."""
        return np.sqrt(self.blocks.variance)

    def shared(self) -> np.ndarray:
        """The sum of gamma, shared by the variance that the biases of its sensor give each datum.

        Below zero where the data did not see the biases, which then add to what is expected.
        """
        told = np.maximum(self.flat(self.blocks.predicted(self.problem.model.read, self.lins)), 0.0)
        if self.gamma is None:
            return -told
        return np.minimum(told * (self.gamma.sum() / max(told.sum(), 1e-300)), 0.9)

    def declared(self, tree: xr.DataTree) -> SensorBlocks:
        """Covariance of z by sensor that a prior of the declared scales leaves."""
        told = tree["calibration"].to_dataset()
        if self.scaled is not None:
            return self.scaled
        if "sd_error" in told:  # no factor was made, or none that has exact variances
            apart = 1.0 - told["contraction"].values
            return SensorBlocks(len(apart), np.arange(len(apart))[:, None], apart[:, None, None])
        return declared_blocks(self.at)

    def times(self, columns: np.ndarray) -> np.ndarray:
        """The covariance of z times columns (M, K)."""
        return np.asarray(self.at.solve(self.factors, columns))

    @property
    def root(self) -> Any:
        """A sparse root (M, R)."""
        return self.blocks.root()

    @property
    def roots(self) -> list[jax.Array]:
        """None: the covariance of all is not held."""
        return [jnp.zeros((self.problem.model.biases, 0))]

    def drawn(self, z: jax.Array, levels: jax.Array, key: jax.Array) -> tuple[jax.Array, Sequence[jax.Array]]:
        """Biases and trajectories drawn together around the mean."""
        found = self.at.sample(self.factors, key, len(levels))
        return jnp.asarray(found.z), [jnp.asarray(own) for own in found.states]


def take_up(problem: Problem, fit: xr.DataTree, answer: Answer | None = None) -> Judged:
    """The fit of a problem from its tree, and from the answer behind it where that is at hand.

    Biases, precisions and levels are those of the tree; without an answer the trajectories are brought to their mode
    again and the problem is linearised anew. Raises `InputError` where the tree is no fit of this problem.
    """
    problem, datum, picks = identified(problem, fit, answer)
    group = fit["calibration"].to_dataset()
    if fit.attrs.get("sparse", 0):
        return _taken_large(problem, fit, answer, datum, picks)
    covariance = matrix_of(group, "covariance", "assess").values / np.outer(problem.scales, problem.scales)
    if answer is None:
        point = point_of(problem, fit)
        if fit.attrs.get("places") == "integrated":
            problem = problem.with_tilt(tilt_at(problem.model, point))
        at = linearise(problem.model, point)
    else:
        at = answer.posterior.linearised
    return Fitted(problem, at.point, at.rows, at.solved, picks, datum, _prior(group), at, covariance)


def _taken_large(
    problem: Problem, tree: xr.DataTree, answer: Answer | None, data: pd.DataFrame, picks: list[Any]
) -> JudgedLarge:
    posterior, group = None if answer is None else answer.posterior, tree["calibration"].to_dataset()
    scaled, solver = None, engine_of(getattr(answer.method, "engine", "") if answer is not None else "")
    if isinstance(posterior, BlockPosterior):
        at, scaled = posterior.at, posterior.declared
    else:
        point = point_of(problem, tree) if posterior is None else posterior.point
        at = SparseEngine().settled(problem.model, point)
    blocks = SensorBlocks.read(group, problem.labels, problem.scales)
    prior = Precision.single(jnp.asarray(group["precision"].values))
    own = (problem, at.point, at.rows, at.eliminated, picks, data, prior)
    return JudgedLarge(*own, at, blocks, group["gamma"].values, scaled, solver)


def identified(problem: Problem, fit: xr.DataTree, answer: Answer | None) -> tuple[Problem, pd.DataFrame, list[Any]]:
    """The problem as it was fitted, and its data; raises `InputError` where the tree is no fit of this problem."""
    if "calibration" not in fit.children or "track" not in fit.children:
        raise InputError("assess: the tree is no fit; give the problem and the DataTree that fit() returned for it")
    group = fit["calibration"].to_dataset()
    if group["bias_label"].values.tolist() != list(problem.labels):
        raise InputError("assess: the tree was fitted with other free biases; give the problem as it was fitted")
    if answer is not None:
        problem = answer.problem
    else:
        problem = problem.unlinked() if fit.attrs.get("motion") == "left out" else problem
        problem = problem.retimed(group["mean"].values / problem.scales)
        problem = _weighted(problem, dict(each_track(fit)))
    datum, picks = datum_of(problem)
    if not np.array_equal(datum["y"], fit["observed_data"].to_dataset()["y"].values):
        raise InputError("assess: the tree was fitted to other data; give the problem as it was fitted")
    return problem, pd.DataFrame({name: values for name, (_, values) in datum["coords"].items()}), picks


def _weighted(problem: Problem, tracked: dict[str, xr.Dataset]) -> Problem:
    """The problem with the precisions of its process noise that the tracks of a tree hold."""

    def saved(part: Recursion, epochs: Epochs) -> tuple[jax.Array, ...]:
        names = weights_of_tails(part)
        return tuple(jnp.asarray(saved_by_epoch(epochs, tracked, name, "process noise")) for name in names)

    return problem.with_mixing(problem.model.each(saved, problem.epochs))


def point_of(problem: Problem, fit: xr.DataTree) -> Point:
    """Biases and levels of the tree, trajectories at their mode, searched from the saved ones."""
    tracked = dict(each_track(fit))
    saved = [saved_by_epoch(epochs, tracked, "mean", "targets") for epochs in problem.epochs]
    point = follow_states(problem, saved)
    if problem.levels:
        level = fit["level"].to_dataset()
        point = at_levels(problem.model, point, jnp.asarray(level_logs(problem.levels, level["std"].values)))
    z = jnp.asarray(fit["calibration"].to_dataset()["mean"].values / problem.scales)
    return track_mode(problem, point._replace(z=z))


def _prior(group: xr.Dataset) -> Precision:
    """The prior as saved: precisions, and couplings of correlated biases."""
    alpha = group["precision"].values
    if "coupling" not in group:
        return Precision.single(jnp.asarray(alpha))
    coupling, own = group["coupling"].values, np.where(alpha > 0, alpha, 1.0)
    _, whole = linalg.inverse_and_logdet(jnp.asarray(np.diag(own) + coupling))
    return Precision(jnp.asarray(alpha), jnp.asarray(coupling), whole - jnp.sum(jnp.log(own)))
