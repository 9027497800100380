"""Pictures of a saved fit: biases, residuals, objective, drift, gamma; matplotlib figures without pyplot."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from probcal.labels import label_parts
from probcal.plots.base import (
    ALL_POINTS,
    BEFORE,
    COLOURS,
    GAMMA,
    LINEAR,
    NAMED,
    ROWS,
    colour,
    new_axes,
    plain_text,
    probability,
)
from probcal.results.drifts import drift_table
from probcal.results.schema import EVIDENCES, evidence_in
from probcal.status import INVALID


def plot_biases(tree: xr.DataTree, ax: Axes | None = None) -> Axes:
    """Draw mean and interval of every bias in units of its scale, coloured by gamma, with the true value."""
    group = tree["calibration"].to_dataset()
    total = group.sizes["bias_label"]
    group = group.isel(bias_label=_largest(group))
    labels, scale, gamma = group["bias_label"].values, group["scale"].values, group["gamma"].values
    mean, lower, upper = (group[name].values / scale for name in ("mean", "lower", "upper"))
    rows = np.arange(len(labels))
    ax = new_axes(ax, 9.0, min(2.0 + 0.24 * len(rows), 24.0))
    ax.axvline(0.0, color="0.3", linewidth=0.8, zorder=1.8)
    ax.hlines(rows, lower, upper, color="0.55", linewidth=2.0, zorder=2)
    dots = ax.scatter(
        mean, rows, c=np.nan_to_num(gamma), cmap=GAMMA, norm=Normalize(0.0, 1.0),
        s=30, edgecolor="0.2", linewidth=0.6, zorder=3,
    )  # fmt: skip
    true = _true(tree, labels) / scale
    if np.isfinite(true).any():
        ax.plot(true, rows, "x", color="#d00000", markersize=6, markeredgewidth=1.6, zorder=4)
    _mark_status(ax, group["status"].values, _text_size(len(rows)))
    ax.set_yticks(rows, [plain_text(label) for label in labels], fontsize=_text_size(len(rows)))
    ax.set_ylim(len(rows) - 0.3, -0.7)
    ax.grid(axis="x", color="0.9", zorder=0)
    _scale_axis(ax, np.concatenate([lower, upper, true, [-1.0, 1.0]]))
    ax.set_xlabel(f"bias in units of its scale, {probability(tree):.0%} interval")
    _title_biases(ax, len(rows), total, bool(np.isfinite(true).any()))
    _gamma_bar(ax, dots)
    return ax


def plot_residuals(tree: xr.DataTree, axes: Sequence[Axes] | None = None) -> list[Axes]:
    """Draw residual/std of every channel before and after calibration, one axes a channel."""
    group = tree["residual"].to_dataset()
    channels = list(dict.fromkeys(group["channel"].values.tolist()))
    if axes is None:
        columns = 2 if len(channels) == 4 else min(len(channels), 3)
        lines = -(-len(channels) // columns)
        figure = Figure(figsize=(9.0 if columns > 1 else 6.0, 0.3 + 3.1 * lines), layout="constrained")
        grid = figure.subplots(lines, columns, squeeze=False).ravel()
        for ax in grid[len(channels) :]:
            ax.remove()
        axes = list(grid[: len(channels)])
    for ax, channel in zip(axes, channels, strict=True):
        chosen = group.isel(datum=group["channel"].values == channel)
        _draw_residuals(ax, str(channel), chosen)
    return list(axes)


def plot_outliers(tree: xr.DataTree, ax: Axes | None = None) -> Axes:
    """Draw residual/std of every datum over time; crosses in the sensor's colour count less than half."""
    group = tree["residual"].to_dataset()
    ax = new_axes(ax, 9.0, 3.4)
    time, ratio = group["time"].values, group["after"].values / group["std"].values
    weight = group["weight"].values if "weight" in group else np.ones(len(time))
    out, sensors = weight < 0.5, group["sensor"].values
    shown = np.flatnonzero(~out)[:: max(1, int((~out).sum()) // ALL_POINTS + 1)]
    ax.plot(time[shown], ratio[shown], ".", color=BEFORE, markersize=2, rasterized=True, label="inlying")
    for k, name in enumerate(dict.fromkeys(sensors[out].tolist())):
        mine = out & (sensors == name)
        label = plain_text(name) if k < 10 else None
        ax.plot(time[mine], ratio[mine], "x", color=colour(k), markersize=4, label=label)
    linear = max(LINEAR, float(np.quantile(np.abs(ratio), 0.9)))
    if np.abs(ratio).max() > 2 * linear:
        ax.set_yscale("symlog", linthresh=linear)
    ax.set(xlabel="time in s", ylabel="residual/std")
    ax.grid(color="0.9")
    ax.set_title(f"Residuals over time: {int(out.sum())} of {len(out)} count less than half", loc="left")
    ax.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False, fontsize=8)
    return ax


def plot_objective(tree: xr.DataTree, ax: Axes | None = None) -> Axes:
    """Draw the objective over the iterations."""
    ax = new_axes(ax, 6.0, 3.4)
    trace = tree["optimisation"].to_dataset()["objective"].values
    steps = np.arange(1, len(trace) + 1)
    known = np.isfinite(trace)
    ax.plot(steps[known], trace[known], "o-", color=COLOURS[0], markersize=3.5 if len(trace) < 60 else 0)
    name = evidence_in(tree.attrs)
    evidence = tree.attrs.get(name)
    is_evidence = evidence is not None and known.any() and np.isclose(trace[known][-1], evidence, rtol=1e-6)
    ax.set(xlabel="iteration", ylabel=EVIDENCES[name] if is_evidence else "objective")
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.ticklabel_format(axis="y", useOffset=False, style="plain")
    ax.grid(color="0.9")
    ax.set_title(f"Objective over {len(trace)} iterations", loc="left")
    return ax


def plot_drift(tree: xr.DataTree, ax: Axes | None = None) -> Axes:
    """Draw the drifting biases over time with their intervals, in units of their scales."""
    table = drift_table(tree)
    ax = new_axes(ax, 9.0, 4.2)
    scales = tree["calibration"].to_dataset()["scale"].to_series()
    end = float(tree["observed_data"].to_dataset()["time"].max())
    for k, (name, pieces) in enumerate(table.groupby("bias", sort=False)):
        time = np.append(pieces["since"], max(end, pieces["since"].max()))
        held = pd.concat([pieces, pieces.tail(1)])[["mean", "lower", "upper"]] / scales[name]
        mean, lower, upper = held.to_numpy().T
        ax.plot(time, mean, drawstyle="steps-post", color=colour(k), label=plain_text(name))
        ax.fill_between(time, lower, upper, step="post", color=colour(k), alpha=0.2, linewidth=0)
    ax.axhline(0.0, color="0.7", linewidth=0.8, zorder=0)
    ax.set(xlabel="time in s", ylabel="bias / scale")
    ax.grid(color="0.9")
    ax.set_title(f"Drift of {table['bias'].nunique()} biases, with {probability(tree):.0%} intervals", loc="left")
    ax.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False, fontsize=8)
    return ax


def plot_gamma(tree: xr.DataTree, ax: Axes | None = None) -> Axes:
    """Draw gamma of all biases in ascending order, coloured by the kind of bias."""
    group = tree["calibration"].to_dataset()
    labels, gamma = group["bias_label"].values.astype(str), np.nan_to_num(group["gamma"].values)
    order = np.argsort(gamma, kind="stable")
    names = np.array([_bias(label) for label in labels[order]])
    ax = new_axes(ax, 9.0, 4.6)
    size = 5.0 if len(labels) <= NAMED else 3.0
    for k, name in enumerate(dict.fromkeys(names.tolist())):
        mine = names == name
        marker = "os^Dv"[(k // len(COLOURS)) % 5]
        ax.plot(
            np.nonzero(mine)[0],
            gamma[order][mine],
            marker,
            color=colour(k),
            markersize=size,
            label=plain_text(name),
        )
    if len(labels) <= NAMED:
        ax.set_xticks(np.arange(len(labels)), [plain_text(label) for label in labels[order]], rotation=90, fontsize=7)
    else:
        ax.set_xlabel("bias, sorted by gamma")
    ax.set(ylim=(-0.04, 1.04), ylabel="gamma")
    ax.grid(axis="y", color="0.9")
    ax.set_title(f"How well the data determine {len(labels)} biases (0 prior only, 1 data only)", loc="left")
    ax.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False, fontsize=8)
    return ax


def _bias(label: str) -> str:
    """Name of a bias without its owner: `heading` of `radar_2.heading`, `heading_step` of `radar_2.heading@0.5`."""
    name, _, time = label_parts(label)[1].partition("@")
    return f"{name}_step" if time else name


# Forest


def _largest(group: xr.Dataset) -> np.ndarray:
    """Rows of the forest in the order of the tree: all, or invalid ones and those of largest |mean|/scale."""
    size = np.abs(np.nan_to_num(group["mean"].values / group["scale"].values, nan=np.inf))
    size[np.isin(group["status"].values, INVALID)] = np.inf
    return np.sort(np.argsort(-size, kind="stable")[:ROWS])


def _title_biases(ax: Axes, shown: int, total: int, true: bool) -> None:
    some = (
        f"{shown} of {total} biases: the largest |mean| / scale, and any invalid"
        if shown < total
        else f"{total} biases"
    )
    ax.set_title(some + (" (cross: true value)" if true else ""), loc="left")


def _true(tree: xr.DataTree, labels: np.ndarray) -> np.ndarray:
    """True value of every label, NaN where none is known."""
    if "truth" not in tree.children:
        return np.full(len(labels), np.nan)
    known = tree["truth"].to_dataset()["bias"]
    values = dict(zip(known["bias_label"].values.tolist(), known.values.tolist(), strict=True))
    return np.array([values.get(label, np.nan) for label in labels.tolist()])


def _gamma_bar(ax: Axes, dots: PathCollection) -> None:
    """Add the colour bar of gamma below the axes, at a distance that does not grow with the rows."""
    height = max(ax.figure.bbox.height / ax.figure.dpi - 1.5, 1.0)
    bar = ax.inset_axes((0.25, -0.75 / height, 0.5, 0.12 / height))
    ax.figure.colorbar(dots, cax=bar, orientation="horizontal", label="gamma (0 prior only, 1 data only)")


def _text_size(rows: int) -> float:
    return 8.0 if rows <= 80 else 7.0


def _mark_status(ax: Axes, status: np.ndarray, size: float) -> None:
    """Write what happened to a bias at the right of its row."""
    for row, text in enumerate(status.tolist()):
        if text in (*INVALID, "pruned"):
            colour = "0.4" if text == "pruned" else "#b00000"
            ax.text(1.01, row, text, transform=ax.get_yaxis_transform(), va="center", fontsize=size, color=colour)


def _scale_axis(ax: Axes, values: np.ndarray) -> None:
    """Set the limits of the forest; far values get an axis that is logarithmic beyond a few scales."""
    values = values[np.isfinite(values)]
    low, high = values.min(), values.max()
    if max(-low, high) > LINEAR:
        ax.set_xscale("symlog", linthresh=3.0)
        ax.set_xlim(1.5 * low, 1.5 * high)
    else:
        margin = 0.04 * (high - low)
        ax.set_xlim(low - margin, high + margin)


# Residuals


def _draw_residuals(ax: Axes, channel: str, group: xr.Dataset) -> None:
    """Draw both histograms of one channel over the standard normal density."""
    ratios = {kind: _ratio(group, kind) for kind in ("before", "after")}
    limit = _robust_limit(ratios)
    edges = np.linspace(-limit, limit, 61)
    styles: dict[str, dict[str, Any]] = {
        "before": {"histtype": "stepfilled", "color": "0.78"},
        "after": {"histtype": "step", "color": COLOURS[0], "linewidth": 1.5},
    }
    width = edges[1] - edges[0]
    for kind, ratio in ratios.items():
        if len(ratio):
            outside = int((np.abs(ratio) > limit).sum())
            label = kind + (f" ({outside} outside)" if outside else "")
            ax.hist(
                ratio,
                edges.tolist(),
                weights=np.full(len(ratio), 1 / (len(ratio) * width)),
                label=label,
                **styles[kind],
            )
    x = np.linspace(-limit, limit, 241)
    ax.plot(
        x,
        np.exp(-0.5 * x**2) / np.sqrt(2 * np.pi),
        "--",
        color="0.15",
        linewidth=1.0,
        label="standard normal",
    )
    ax.set(xlim=(-limit, limit), xlabel="residual / std", ylabel="density")
    ax.set_title(f"{plain_text(channel)} ({group.sizes['datum']} data)", loc="left", fontsize=10)
    ax.set_ylim(0.0, 1.45 * ax.get_ylim()[1])
    ax.legend(fontsize=7, frameon=False, loc="upper right")


def _ratio(group: xr.Dataset, kind: str) -> np.ndarray:
    """Finite residuals in units of std."""
    std = group["std"].values
    usable = np.isfinite(group[kind].values) & (std > 0)
    return group[kind].values[usable] / std[usable]


def _robust_limit(ratios: dict[str, np.ndarray]) -> float:
    """Half width of the picture: what holds 98 % of the data, within 4 to 12 std."""
    sizes = [np.quantile(np.abs(ratio), 0.98) for ratio in ratios.values() if len(ratio)]
    return float(np.clip(max(sizes, default=4.0), 4.0, 12.0))
