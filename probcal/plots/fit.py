"""Pictures of a saved fit: biases, residuals, objective, drift, gamma; matplotlib figures without pyplot."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.axes import Axes
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
    colour,
    finish,
    most_first,
    name_rows,
    new_axes,
    panels,
    plain_text,
    probability,
    scale_axis,
)
from probcal.results.drifts import drift_table
from probcal.results.read import frame_of, known_truth, summary
from probcal.results.schema import EVIDENCES, evidence_in
from probcal.status import INVALID


def plot_biases(tree: xr.DataTree, ax: Axes | None = None) -> Axes:
    """Draw mean and interval of every bias in units of its scale, coloured by gamma, with the true value."""
    frame = summary(tree).set_index("bias")
    total, invalid = len(frame), frame["status"].isin(INVALID)
    known = frame[["mean", "lower", "upper"]].assign(true=known_truth(tree)).div(frame["scale"], axis=0)
    size = known["mean"].abs().fillna(np.inf).mask(invalid, np.inf)
    chosen = most_first(size.to_numpy())
    frame, known = frame.iloc[chosen], known.iloc[chosen]
    rows = range(len(frame))
    ax = new_axes(ax, 9.0, min(2.0 + 0.24 * len(rows), 24.0))
    ax.axvline(0.0, color="0.3", linewidth=0.8, zorder=1.8)
    ax.hlines(rows, known["lower"], known["upper"], color="0.55", linewidth=2.0, zorder=2)
    dots = ax.scatter(
        known["mean"], rows, c=frame["gamma"].fillna(0.0), cmap=GAMMA, vmin=0.0, vmax=1.0,
        s=30, edgecolor="0.2", linewidth=0.6, zorder=3,
    )  # fmt: skip
    scored = bool(known["true"].notna().any())
    if scored:
        ax.plot(known["true"], rows, "x", color="#d00000", markersize=6, markeredgewidth=1.6, zorder=4)
    for row, status in enumerate(frame["status"]):
        if status in (*INVALID, "pruned"):
            tint = "0.4" if status == "pruned" else "#b00000"
            ax.text(1.01, row, status, transform=ax.get_yaxis_transform(), va="center", fontsize=8, color=tint)
    name_rows(ax, frame.index)
    scale_axis(ax, *known[["lower", "upper", "true"]].to_numpy().T)
    # add the colour bar of gamma below the axes, at a distance that does not grow with the rows
    height = max(ax.figure.bbox.height / ax.figure.dpi - 1.5, 1.0)
    bar = ax.inset_axes((0.25, -0.75 / height, 0.5, 0.12 / height))
    ax.figure.colorbar(dots, cax=bar, orientation="horizontal", label="gamma (0 prior only, 1 data only)")
    shown = f"{len(rows)} of {total} biases: the largest |mean| / scale, and any invalid"
    title = (shown if len(rows) < total else f"{total} biases") + (" (cross: true value)" if scored else "")
    text = f"bias in units of its scale, {probability(tree):.0%} interval"
    return finish(ax, title, grid="x", key=False, xlabel=text)


def plot_residuals(tree: xr.DataTree, axes: Sequence[Axes] | None = None) -> list[Axes]:
    """Draw residual/std of every channel before and after calibration, one axes a channel."""
    channels = list(frame_of(tree, "residual").groupby("channel", sort=False))
    if axes is None:
        columns = 2 if len(channels) == 4 else min(len(channels), 3)
        height = 0.3 + 3.1 * -(-len(channels) // columns)
        figure = Figure(figsize=(9.0 if columns > 1 else 6.0, height), layout="constrained")
        axes = panels(figure, len(channels), columns)
    for ax, (channel, frame) in zip(axes, channels, strict=True):
        # draw both histograms of one channel over the standard normal density
        usable = frame[["before", "after"]].div(frame["std"].where(frame["std"] > 0), axis=0)
        ratios = {kind: usable[kind].dropna() for kind in usable}
        sizes = [ratio.abs().quantile(0.98) for ratio in ratios.values() if len(ratio)]
        limit = float(np.clip(max(sizes, default=4.0), 4.0, 12.0))  # holds 98 % of the data, within 4 to 12 std
        edges = np.linspace(-limit, limit, 61)
        forms: Any = ("stepfilled", "step")
        for (kind, ratio), form, tint in zip(ratios.items(), forms, ("0.78", COLOURS[0]), strict=True):
            outside = int((ratio.abs() > limit).sum())
            label = kind + (f" ({outside} outside)" if outside else "")
            weights = np.full(len(ratio), 1 / (max(len(ratio), 1) * (edges[1] - edges[0])))
            if len(ratio):
                ax.hist(ratio, edges.tolist(), weights=weights, label=label, histtype=form, color=tint, linewidth=1.5)
        x = np.linspace(-limit, limit, 241)
        ax.plot(x, np.exp(-0.5 * x**2) / np.sqrt(2 * np.pi), "--", color="0.15", linewidth=1.0, label="standard normal")
        ax.set(xlim=(-limit, limit), ylim=(0.0, 1.45 * ax.get_ylim()[1]), xlabel="residual / std", ylabel="density")
        ax.set_title(f"{plain_text(str(channel))} ({len(frame)} data)", loc="left", fontsize=10)
        ax.legend(fontsize=7, frameon=False, loc="upper right")
    return list(axes)


def plot_outliers(tree: xr.DataTree, ax: Axes | None = None) -> Axes:
    """Draw residual/std of every datum over time; crosses in the sensor's colour count less than half."""
    frame = frame_of(tree, "residual")
    frame["ratio"] = frame["after"] / frame["std"]
    ax = new_axes(ax, 9.0, 3.4)
    out = frame["weight"] < 0.5
    inlying = frame[~out][:: 1 + (~out).sum() // ALL_POINTS]
    ax.plot("time", "ratio", ".", data=inlying, color=BEFORE, markersize=2, rasterized=True, label="inlying")
    for k, (name, own) in enumerate(frame[out].groupby("sensor", sort=False)):
        label = plain_text(name) if k < 10 else None
        ax.plot("time", "ratio", "x", data=own, color=colour(k), markersize=4, label=label)
    sizes = frame["ratio"].abs()
    linear = max(LINEAR, float(sizes.quantile(0.9)))
    if sizes.max() > 2 * linear:
        ax.set_yscale("symlog", linthresh=linear)
    title = f"Residuals over time: {out.sum()} of {len(out)} count less than half"
    return finish(ax, title, xlabel="time in s", ylabel="residual/std")


def plot_objective(tree: xr.DataTree, ax: Axes | None = None) -> Axes:
    """Draw the objective over the iterations."""
    ax = new_axes(ax, 6.0, 3.4)
    trace = tree["optimisation"].to_dataset()["objective"].to_series().reset_index(drop=True)
    known = trace.dropna()
    ax.plot(known.index + 1, known, "o-", color=COLOURS[0], markersize=3.5 if len(trace) < 60 else 0)
    name = evidence_in(tree.attrs)
    is_evidence = name and len(known) and np.isclose(known.iloc[-1], tree.attrs[name], rtol=1e-6)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.ticklabel_format(axis="y", useOffset=False, style="plain")
    text = EVIDENCES[name] if is_evidence else "objective"
    return finish(ax, f"Objective over {len(trace)} iterations", key=False, xlabel="iteration", ylabel=text)


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
    title = f"Drift of {table['bias'].nunique()} biases, with {probability(tree):.0%} intervals"
    return finish(ax, title, xlabel="time in s", ylabel="bias / scale")


def plot_gamma(tree: xr.DataTree, ax: Axes | None = None) -> Axes:
    """Draw gamma of all biases in ascending order, coloured by the kind of bias."""
    gamma = tree["calibration"].to_dataset()["gamma"].to_series().fillna(0.0)
    order = gamma.sort_values(kind="stable").index
    kinds = order.map(_kind)
    few = len(order) <= NAMED
    ax = new_axes(ax, 9.0, 4.6)
    for k, kind in enumerate(dict.fromkeys(kinds)):
        (place,) = np.nonzero(kinds == kind)
        marker = "os^Dv"[(k // len(COLOURS)) % 5]
        values = gamma[order[place]]
        ax.plot(place, values, marker, color=colour(k), markersize=5.0 if few else 3.0, label=plain_text(kind))
    if few:
        ax.set_xticks(range(len(order)), [plain_text(label) for label in order], rotation=90, fontsize=7)
    title = f"How well the data determine {len(order)} biases (0 prior only, 1 data only)"
    ax.set_xlabel("" if few else "bias, sorted by gamma")
    return finish(ax, title, grid="y", ylabel="gamma", ylim=(-0.04, 1.04))


def _kind(label: str) -> str:
    """Name of a bias without its owner: `heading` of `radar_2.heading`, `heading_step` of `radar_2.heading@0.5`."""
    name, _, time = label_parts(label)[1].partition("@")
    return f"{name}_step" if time else name
