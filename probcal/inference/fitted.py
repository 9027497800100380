"""A fit taken up again: the problem at the point where a DataTree says that its fit ended, linearised there."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from probcal.errors import InputError
from probcal.gaussian.choose import engine_of, factoriser
from probcal.gaussian.engine import Engine, Expansion, Factors
from probcal.gaussian.information import at_levels
from probcal.gaussian.mode import Point
from probcal.gaussian.places import tilt_at
from probcal.lazy import pd, xr
from probcal.linalg import invert
from probcal.model.model import Data, Recursion
from probcal.model.motions import level_logs
from probcal.model.rows import LinearRows
from probcal.model.trajectories import States
from probcal.modes.grid import follow_states, track_mode
from probcal.priors import Precision
from probcal.problem import Epochs, Problem
from probcal.results.answer import blocks_under
from probcal.results.blocks import SensorBlocks
from probcal.results.groups import data_columns, datum_of, gather, weights_of_tails
from probcal.results.read import each_track, saved_by_epoch

COLUMNS = 16  # bias directions that are filtered together


@dataclass(frozen=True, eq=False)
class Judged:
    """A fit taken up again: the problem, the posterior expanded about the point where it ended, and what it said."""

    problem: Problem
    expansion: Expansion
    picks: list[Any]  # where each block keeps its data
    data: pd.DataFrame  # sensor, channel, target, time, row of every datum
    prior: Precision  # with the precisions that the fit ended with
    spread: SensorBlocks  # of the covariance of z
    engine: Engine
    gamma: np.ndarray | None = None  # (M,) how well the data determine each bias; None where they did not see it

    @property
    def point(self) -> Point:
        """The point where it ended."""
        return self.expansion.point

    @property
    def lins(self) -> LinearRows:
        """The rows linearised there with the expected information."""
        return self.expansion.rows

    def flat(self, parts: Any) -> np.ndarray:
        """Arrays (..., N, C) of the blocks as one (..., data)."""
        return gather([np.asarray(part) for part in parts], self.picks)

    def in_blocks(self, values: np.ndarray) -> Data:
        """Values by datum (data, K) as those of the blocks (N, C, K), zero where nothing is measured."""
        found, parts = [], np.split(values, np.cumsum([len(rows) for rows, _ in self.picks])[:-1])
        for there, pick, own in zip(self.problem.model.measured, self.picks, parts, strict=True):
            block = np.zeros((*there.shape, values.shape[1]))
            block[pick] = own
            found.append(jax.device_put(block))
        return tuple(found)

    @property
    def factors(self) -> Factors:
        """Those of the prior."""
        return Factors.of(self.prior)

    @property
    def whole(self) -> bool:
        """True if the covariance of all biases is held."""
        return self.spread.whole

    @property
    def sd(self) -> np.ndarray:
        """Standard deviation (M,) of z."""
        return np.sqrt(np.maximum(self.spread.variance, 0.0))

    def times(self, columns: np.ndarray) -> np.ndarray:
        """The covariance of z times columns (M, K)."""
        return self.spread.matrix() @ columns if self.whole else np.asarray(self.expansion.solve(self.factors, columns))

    @cached_property
    def root(self) -> Any:
        """A root (M, R) of the covariance of z, of the biases of each sensor alone where that of all is not held."""
        return self.spread.root()

    @property
    def roots(self) -> list[jax.Array]:
        """Directions (M, K) of the biases whose squares add up to their covariance; none where that is not held."""
        M = self.problem.model.biases
        if not self.whole:
            return [jnp.zeros((M, 0))]
        chunk = max(min(COLUMNS, M), 1)
        root = np.pad(self.root, ((0, 0), (0, -M % chunk)))
        return [jax.device_put(part) for part in np.split(root, max(root.shape[1] // chunk, 1), axis=1)]

    def shared(self) -> np.ndarray | None:
        """Degrees of freedom that the biases took of each datum (D,), where no roots tell them.

        The sum of gamma, shared by the variance that the biases of its sensor give each datum. Below zero where the
        data did not see the biases, which then add to what is expected.
        """
        if self.whole:
            return None
        told = np.maximum(self.flat(self.spread.predicted(self.problem.model.read, self.lins)), 0.0)
        if self.gamma is None:
            return -told
        return np.minimum(told * (self.gamma.sum() / max(told.sum(), 1e-300)), 0.9)

    def declared(self, tree: xr.DataTree) -> SensorBlocks | None:
        """Covariance of z by sensor that the declared scales leave; None where the information of all is held."""
        told = tree["calibration"].to_dataset()
        if self.whole:
            return None
        if not self.engine.exact:
            apart = 1.0 - told["contraction"].values
            return SensorBlocks(len(apart), np.arange(len(apart))[:, None], apart[:, None, None])
        return blocks_under(self.expansion, Factors.alone(np.ones(self.expansion.model.biases)))

    @property
    def readers(self) -> np.ndarray:
        """True where a sensor reads a bias, (sensors, M), sensors in the order of the network."""
        found = np.zeros((len(self.problem.network.sensors), self.problem.model.biases + 1), bool)
        for index, bias in zip(self.problem.row_index, self.problem.model.read, strict=True):
            found[self.problem.measurements.sensor[index][:, None], np.asarray(bias)] = True
        return found[:, :-1]


def take_up(problem: Problem, fit: xr.DataTree) -> Judged:
    """The fit of a problem from its tree: in memory and from a file it is judged by the same numbers.

    The trajectories are brought to their mode again from the saved ones, and the problem is linearised there. Raises
    `InputError` where the tree is no fit of this problem.
    """
    if "calibration" not in fit.children or "track" not in fit.children:
        raise InputError("assess: the tree is no fit; give the problem and the DataTree that fit() returned for it")
    group = fit["calibration"].to_dataset()
    if group["bias_label"].values.tolist() != list(problem.labels):
        raise InputError("assess: the tree was fitted with other free biases; give the problem as it was fitted")
    problem = problem if "block" in group else problem.padded()
    problem = problem.unlinked() if fit.attrs.get("motion") == "left out" else problem.untilted
    problem = problem.retimed(group["mean"].values / problem.scales)
    tracked = dict(each_track(fit))

    # the problem with the precisions of its process noise that the tracks of a tree hold
    def saved(part: Recursion, epochs: Epochs) -> States:
        names = weights_of_tails(part)
        own = [saved_by_epoch(epochs, tracked, name, "process noise") for name in names]
        return tuple(jax.device_put(np.where(epochs.target == "", 1.0, weight)) for weight in own)

    problem = problem.with_mixing(problem.model.each(saved, problem.epochs))
    datum, picks = datum_of(problem)
    if not np.array_equal(datum["y"], fit["observed_data"].to_dataset()["y"].values):
        raise InputError("assess: the tree was fitted to other data; give the problem as it was fitted")
    data = pd.DataFrame(data_columns(datum))
    spread = SensorBlocks.read(group, problem.labels, "assess", problem.scales)
    asked = "dense" if "block" not in group else "iterative" if "sd_error" in group else factoriser()
    engine, point = engine_of(asked, problem.model), point_of(problem, fit, group)
    if fit.attrs.get("places") == "integrated":
        problem = problem.with_tilt(tilt_at(problem.model, point))
    at, prior = engine.at(problem.model, point), _prior(group)
    if on_several_sides(fit):  # judged is the reported answer, not what lies between
        every = np.arange(at.model.biases)
        spread = SensorBlocks.of(np.asarray(at.marginals(Factors.of(prior), every[None]))[0])
    return Judged(problem, at, picks, data, prior, spread, engine, group["gamma"].values)


def on_several_sides(fit: xr.DataTree) -> bool:
    """True if the draws of a tree lie on several sides of a mirror."""
    stats = fit["sample_stats"].to_dataset() if "sample_stats" in fit.children else {}
    return "side" in stats and bool(np.ptp(stats["side"].values))


def point_of(problem: Problem, fit: xr.DataTree, group: xr.Dataset) -> Point:
    """Biases and levels of the tree, trajectories at their mode, searched from the saved ones."""
    tracked = dict(each_track(fit))
    places = fit["mode/track"].children.items() if on_several_sides(fit) else ()
    reported = {name: node.to_dataset().isel(mode=0) for name, node in places}
    saved = []
    for epochs in problem.epochs:
        saved.append(saved_by_epoch(epochs, tracked, "mean", "targets"))
        if reported:
            own = saved_by_epoch(epochs, reported, "position", "targets")
            saved[-1][:, slice(*epochs.position)] = own
    point = follow_states(problem, saved)
    if problem.levels:
        level = fit["level"].to_dataset()
        point = at_levels(problem.model, point, jax.device_put(level_logs(problem.levels, level["std"].values)))
    z = jax.device_put(group["point" if "point" in group else "mean"].values / problem.scales)
    return track_mode(problem, point._replace(z=z))


def _prior(group: xr.Dataset) -> Precision:
    """The prior as saved: precisions, and couplings of correlated biases."""
    found = list[tuple[np.ndarray, float]]()
    if "coupling" in group:  # of results of version 3
        added = group["coupling"].values
        for row in np.unique(added[added.any(1)] != 0, axis=0):
            members = np.flatnonzero(row)
            found.append((members, invert(np.eye(len(members)) + added[np.ix_(members, members)])[0, 1]))
    if "correlation" in group:
        value, first = group["correlation"].values, group["correlated_with"].values
        for name in np.unique(first[value != 0]):
            members = np.flatnonzero(first == name)
            found.append((members, value[members[0]]))
    return Precision.correlated(jax.device_put(group["precision"].values), found)
