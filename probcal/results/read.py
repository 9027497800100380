"""The readers of a tree: one row per bias, outliers, and a calibration for other data."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np

from probcal.errors import InputError, checked
from probcal.files import AnyPath
from probcal.labels import NOBODY
from probcal.lazy import pd, xr
from probcal.results.blocks import SensorBlocks
from probcal.results.schema import MORE, SUMMARY, held_biases
from probcal.status import INVALID

if TYPE_CHECKING:
    from probcal.network import Network
    from probcal.problem import Epochs, Problem


@checked
def summary(tree: xr.DataTree) -> Any:
    """One row a bias as a DataFrame: bias, unit, scale, mean, sd, lower, upper, gamma, precision, status.

    After `assess` also verdict and reason.

    >>> summary(tree).set_index("bias").loc["sonar_1.range_offset", "unit"]
    'm'
    """
    group = tree["calibration"].to_dataset()
    columns = [*SUMMARY, "precision", "status", *(name for name in MORE if name in tree["calibration"])]
    if "verdict" in tree.children:
        judged = tree["verdict"].to_dataset()[["verdict", "reason"]]
        group, columns = group.assign(judged.data_vars), [*columns, *judged.data_vars]
    frame = group[columns[1:]].to_dataframe().reset_index()
    return frame.rename(columns={"bias_label": "bias"})[columns]


def frame_of(tree: xr.DataTree, group: str, *columns: str) -> Any:
    """The variables and coordinates of a group as a DataFrame, or some of them in this order."""
    data, chosen = tree[group].to_dataset(), list(columns)
    return data[chosen].to_dataframe()[chosen] if chosen else data.to_dataframe()


def listed_in(tree: xr.DataTree, group: str, name: str) -> list[Any]:
    """The values of a variable of a group; none where the tree has no such group."""
    return tree[group].to_dataset()[name].values.tolist() if group in tree.children else []


def known_truth(tree: xr.DataTree) -> pd.Series:
    """The true biases that a scored tree knows, by label; empty where it was not scored."""
    known = tree["truth"].to_dataset()["bias"].to_series() if "truth" in tree.children else pd.Series(dtype=float)
    return known.rename(index=str)


def summed_log_likelihood(tree: xr.DataTree) -> xr.DataArray | None:
    """Log-likelihood of all data at every draw (chain, draw) that has one; None where the tree holds none.

    Of many data a tree holds the sum alone.
    """
    if "log_likelihood" in tree.children:
        return tree["log_likelihood"].to_dataset()["y"].sum("datum")
    return tree["log_likelihood_sum"].to_dataset()["y"] if "log_likelihood_sum" in tree.children else None


def each_track(tree: xr.DataTree, group: str = "track") -> Iterator[tuple[str, xr.Dataset]]:
    """Name and dataset of every target of a tree, in the order of the problem; none where it has no such group."""
    if group in tree.children:
        for node in tree[group].children.values():
            yield str(node.attrs["target"]), node.to_dataset(inherit=False)


def each_target(tree: xr.DataTree) -> Iterator[tuple[str, xr.Dataset]]:
    """Name and track of every target of a tree that exists: the rows without a target have a known state only."""
    return (pair for pair in each_track(tree) if pair[0] != NOBODY)


def each_object(tree: xr.DataTree, axes: Sequence[str]) -> Iterator[tuple[str, np.ndarray, np.ndarray, np.ndarray]]:
    """Name, times (L,), positions (L, d) and existence (L,) of every object that nobody named; none without a group.

    Where several sensors looked at one time, what the last of them left is taken.
    """
    if "object" in tree.children:
        frame = tree["object"].to_dataset().to_dataframe().drop_duplicates(["track", "time"], keep="last")
        columns = [f"position_{axis}" for axis in axes]
        if set(columns) <= set(frame):
            for name, own in frame.groupby("track", sort=False):
                yield str(name), own["time"].to_numpy(), own[columns].to_numpy(float), own["existence"].to_numpy()


@checked
def tracks(tree: xr.DataTree) -> pd.DataFrame:
    """Tracks as a table, one row an epoch of a target: time (s), target, each state component and its sd.

    A component that a target lacks is empty there.

    >>> tracks(tree).columns[:3].tolist()
    ['time', 'target', 'position_x']
    """
    parts = []
    for target, group in each_target(tree):
        columns = {"time": group["time"].values, "target": np.full(group.sizes["time"], target)}
        for component in group["component"].values:
            columns[str(component)] = group["mean"].sel(component=component).values
            columns[f"{component}_sd"] = group["sd"].sel(component=component).values
        parts.append(pd.DataFrame(columns))
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=["time", "target"])


def saved_states(problem: Problem, tracked: Mapping[str, xr.Dataset]) -> list[np.ndarray]:
    """Draws of the states (chain, draw, E, n) of each recursion that the tracks of a tree hold."""
    return [epochs.joined([tracked[name]["state"].values for name in epochs.members], 2) for epochs in problem.epochs]


@checked
def outliers(tree: xr.DataTree, *, below: float = 0.5) -> pd.DataFrame:
    """Data that count less than `below` (heavy-tailed noise), the least first: row, time, sensor, residual, weight.

    The weight is that of a Student-t over its largest, or the probability that a datum is no echo of a mixture.

    >>> len(outliers(tree))  # its noise is Gaussian
    0
    """
    frame = tree["residual"].to_dataset().to_dataframe().reset_index(drop=True)
    frame["residual/std"] = frame["after"] / frame["std"]
    columns = ["row", "time", "sensor", "target", "channel", "after", "residual/std", "weight"]
    return frame[frame["weight"] < below].sort_values("weight", kind="stable")[columns].reset_index(drop=True)


@dataclass(frozen=True)
class Calibrated:
    """A calibration in the numbers of a problem: the problem with the same biases held, z, its covariance, levels."""

    problem: Problem
    z: np.ndarray  # (M,)
    levels: np.ndarray  # (H,) log factors
    spread: SensorBlocks  # of its covariance

    @property
    def covariance(self) -> np.ndarray:
        """Covariance (M, M) of z."""
        return self.spread.matrix()


def bias_values(tree: xr.DataTree) -> dict[str, float]:
    """Value of every bias by label: the mean of a fit, or what it was held at."""
    means = tree["calibration"].to_dataset()["mean"].to_series().items()
    return {str(label): float(value) for label, value in means} | held_biases(tree)


def stated_values(tree: xr.DataTree) -> dict[str, float]:
    """Stated value of each component and coordinate of each node, by label."""
    group = tree["constant_data"].to_dataset()
    names = zip(group["stated_node"].values, group["stated_component"].values, strict=True)
    places: Any = group["node_position"].to_series().items()
    stated = {f"{node}.{name}": float(value) for (node, name), value in zip(names, group["stated"].values, strict=True)}
    return stated | {f"{node}.position_{axis}": value for (node, axis), value in places}


def held_by(calibration: xr.DataTree, labels: Sequence[str]) -> dict[str, float]:
    """The biases among some labels that a fit held fixed, and their values."""
    return {label: value for label, value in held_biases(calibration).items() if label in labels}


@checked
def with_calibration(network: Network, source: xr.DataTree | AnyPath) -> Network:
    """The network with the values and sds that a fit found, in the place of those that it states.

    Parameters
    ----------
    network
        The sensors as they were declared for the fit; further ones stay as they are declared.
    source
        The result of `fit` or `load`, or a file of `write_network`.

    Returns
    -------
    A network that states the calibrated places, components and sensor biases. The sd of each is a survey, whatever
    the prior of the fit was; correlations are left out. A drifting bias has its value at the end of the data. A bias
    that the fit held stays as declared: hold it again with `fix=`. Noise levels are not part of a network.

    Raises
    ------
    InputError
        Where the fit ended without an answer, or is of another network.

    >>> sharper = with_calibration(network, tree)
    >>> sharper.labels == network.labels, {bias.kind for bias in sharper.biases}
    (True, {'survey'})
    """
    if isinstance(source, (str, PathLike)):
        from probcal.nodes import read_network  # it loads jax, which a report does without

        return network.surveyed(read_network(source, network))
    check_valid(source, "with_calibration")
    from probcal.results.drifts import drift_table  # it loads pandas

    frame = summary(source).set_index("bias")
    pieces = drift_table(source).drop_duplicates("bias", keep="last").set_index("bias")
    frame.loc[pieces.index, ["mean", "sd"]] = pieces[["mean", "sd"]]
    stated = stated_values(source)
    biases = [bias for bias in network.biases if bias.since is None and bias.label in frame.index]
    if not biases or any(bias.unit != frame.loc[bias.label, "unit"] for bias in biases):
        raise InputError(
            "with_calibration: the fit and the network have no bias in common, or in other units; declare the same"
        )
    values = {}
    for bias in biases:
        mean, sd = (float(frame.loc[bias.label, name]) for name in ("mean", "sd"))
        if sd > 0:
            values[bias.label] = (mean + (bias.nominal if bias.sensor_type else stated[bias.label]), sd)
    return network.surveyed(values)


def check_valid(calibration: xr.DataTree, name: str) -> None:
    """Raise `InputError` where a calibration ended without an answer."""
    if (status := str(calibration.attrs.get("status"))) in INVALID:
        raise InputError(f"{name}: the fit ended {status}, its estimate is invalid; fit again first")


def _began(problem: Problem, calibration: xr.DataTree, group: xr.Dataset) -> float:
    """Time in s of a problem from which the clocks of a calibration count: that of its own first row."""
    running = [b.label for b in problem.biases if b.component == "time_rate"]
    if not running or "since" not in group.coords:
        return problem.begin
    from probcal.table import first_date

    began = float(group["since"].sel(bias_label=running[0]))
    dates = str(calibration.attrs.get("time_origin", "")), first_date(problem.measurements.table)
    if all(dates):
        then, now = map(datetime.fromisoformat, dates)
        began += (then - now).total_seconds()
    return began


def apply(problem: Problem, calibration: xr.DataTree) -> Calibrated:
    """Applies a fit to another problem of its network; biases and levels are matched by label.

    Biases that the fit held are held; a level that it did not estimate stays at its guess. Raises `InputError` if the
    calibration lacks a bias, or ended without an answer.
    """
    check_valid(calibration, "calibration")
    held = held_by(calibration, problem.labels)
    problem = problem.rebuild(fix=problem.fixed | held) if held else problem
    group, labels = calibration["calibration"].to_dataset(), list(problem.labels)
    known = [str(label) for label in group["bias_label"].values]
    for label in labels:
        if label not in known:
            raise InputError(f'the calibration has no bias "{label}"; fit the same network, or fix that bias')
    mean = group["mean"].sel(bias_label=labels).values
    problem = problem.counted_from(_began(problem, calibration, group)).retimed(mean / problem.scales)
    levels = np.zeros(len(problem.levels))
    if problem.levels and "level" in calibration.children:
        found = calibration["level"].to_dataset()["std"].to_series()
        levels = np.array([level.log(found.get(level.label, level.guess)) for level in problem.levels])
    spread = SensorBlocks.read(group, labels, "a calibration", problem.scales)
    return Calibrated(problem, mean / problem.scales, levels, spread)


def saved_by_epoch(epochs: Epochs, tracked: dict[str, xr.Dataset], name: str, what: str) -> np.ndarray:
    """A variable of the tracks of a tree at the epochs of a recursion, (E, ...)."""
    parts = []
    for target, mine in epochs.members.items():
        own = tracked.get(target)
        if own is None or name not in own or own.sizes["time"] != mine.sum():
            raise InputError(f"assess: the tree was fitted with other {what}; give the problem as it was fitted")
        parts.append(own[name].values)
    return epochs.joined(parts)
