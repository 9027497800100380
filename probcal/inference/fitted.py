"""A fit taken up again: the problem at the point where a DataTree says that its fit ended, linearised there."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from probcal import linalg
from probcal.errors import InputError
from probcal.gaussian.dense import DenseEngine, DenseExpansion
from probcal.gaussian.engine import Engine, Expansion, Factors
from probcal.gaussian.information import at_levels
from probcal.gaussian.linearised import Linearisation, linearise
from probcal.gaussian.mode import Eliminated, Point
from probcal.gaussian.places import tilt_at
from probcal.gaussian.sparse import SparseEngine, SparseExpansion
from probcal.inference.blockwise import BlockPosterior
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
from probcal.results.read import each_track
from probcal.results.schema import matrix_of

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
else:
    pd, xr = Later("pandas"), Later("xarray")


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
    @abstractmethod
    def factors(self) -> Factors:
        """Those of the prior, with the precisions that the fit ended with."""

    @property
    @abstractmethod
    def sd(self) -> np.ndarray:
        """Standard deviation (M,) of z."""

    @abstractmethod
    def times(self, columns: np.ndarray) -> np.ndarray:
        """The covariance of z times columns (M, K)."""

    @property
    def readers(self) -> np.ndarray:
        """True where a sensor reads a bias, (sensors, M), sensors in the order of the network."""
        found = np.zeros((len(self.problem.network.sensors), self.problem.model.biases + 1), bool)
        for index, bias in zip(self.problem.row_index, self.problem.model.read, strict=True):
            found[self.problem.measurements.sensor[index][:, None], np.asarray(bias)] = True
        return found[:, :-1]


@dataclass(frozen=True, eq=False)
class Fitted(Judged):
    """A problem linearised where its fit ended, and the prior with the precisions that the fit ended with."""

    at: Linearisation
    prior: Precision
    covariance: np.ndarray  # (M, M) of z

    @property
    def engine(self) -> Engine:
        """The dense one."""
        return DenseEngine()

    @property
    def expansion(self) -> Expansion:
        """The posterior at the point."""
        return DenseExpansion(self.at)

    @property
    def factors(self) -> Factors:
        """Those of the prior."""
        return Factors.of(self.prior)

    @property
    def sd(self) -> np.ndarray:
        """Standard deviation (M,) of z."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    def times(self, columns: np.ndarray) -> np.ndarray:
        """The covariance of z times columns (M, K)."""
        return self.covariance @ columns


@dataclass(frozen=True, eq=False)
class JudgedLarge(Judged):
    """A fit in sparse form taken up again."""

    at: SparseExpansion
    blocks: SensorBlocks  # of the covariance of z
    alpha: np.ndarray  # (M,) precisions of the prior

    @property
    def engine(self) -> Engine:
        """The sparse one."""
        return SparseEngine()

    @property
    def expansion(self) -> Expansion:
        """The posterior at the point."""
        return self.at

    @property
    def factors(self) -> Factors:
        """Those of the prior."""
        return Factors.alone(self.alpha)

    @property
    def sd(self) -> np.ndarray:
        """Standard deviation (M,) of z."""
        return np.sqrt(self.blocks.variance)

    def times(self, columns: np.ndarray) -> np.ndarray:
        """The covariance of z times columns (M, K)."""
        return np.asarray(self.at.solve(self.factors, columns))


def take_up_large(problem: Problem, tree: xr.DataTree, answer: Answer | None) -> JudgedLarge:
    """The fit of a problem in sparse form, as `take_up`."""
    problem, data, picks = identified(problem, tree, answer)
    posterior = None if answer is None else answer.posterior
    if isinstance(posterior, BlockPosterior):
        at = posterior.at
    else:
        point = point_of(problem, tree) if posterior is None else posterior.point
        at = SparseEngine().settled(problem.model, point)
    assert isinstance(at, SparseExpansion)
    blocks = SensorBlocks.read(tree["calibration"].to_dataset(), problem.labels, problem.scales)
    alpha = tree["calibration"].to_dataset()["precision"].values
    return JudgedLarge(problem, at.point, at.rows, at.eliminated, picks, data, at, blocks, alpha)


def take_up(problem: Problem, fit: xr.DataTree, answer: Answer | None = None) -> Fitted:
    """The fit of a problem from its tree, and from the answer behind it where that is at hand.

    Biases, precisions and levels are those of the tree; without an answer the trajectories are brought to their mode
    again and the problem is linearised anew. Raises `InputError` where the tree is no fit of this problem.
    """
    problem, datum, picks = identified(problem, fit, answer)
    group = fit["calibration"].to_dataset()
    covariance = matrix_of(group, "covariance", "assess").values / np.outer(problem.scales, problem.scales)
    if answer is None:
        point = point_of(problem, fit)
        if fit.attrs.get("places") == "integrated":
            problem = problem.with_tilt(tilt_at(problem.model, point))
        at = linearise(problem.model, point)
    else:
        at = answer.posterior.linearised
    return Fitted(problem, at.point, at.rows, at.solved, picks, datum, at, _prior(group), covariance)


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


def saved_by_epoch(epochs: Epochs, tracked: dict[str, xr.Dataset], name: str, what: str) -> np.ndarray:
    """A variable of the tracks of a tree at the epochs of a recursion, (E, ...)."""
    parts = []
    for target, mine in epochs.members.items():
        own = tracked.get(target)
        if own is None or name not in own or own.sizes["time"] != mine.sum():
            raise InputError(f"assess: the tree was fitted with other {what}; give the problem as it was fitted")
        parts.append(own[name].values)
    return np.concatenate(parts)


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
