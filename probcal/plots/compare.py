"""Pictures of fits side by side: forest of methods, gamma against gamma, posterior of a pair of biases."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from probcal.analysis.compare import Fits, chosen_pair, fits_by_name, interchangeable, plugged_in
from probcal.files import AnyPath
from probcal.plots.base import (
    ROWS,
    colour,
    ellipse_patch,
    finish,
    most_first,
    name_rows,
    new_axes,
    plain_text,
    probability,
    scale_axis,
    write_figure,
)
from probcal.results.blocks import SensorBlocks
from probcal.results.read import known_truth, listed_in
from probcal.status import INVALID

SCATTER = 2_000  # draws of one fit in the picture of a pair
PAIRS = 2  # of interchangeable biases that are drawn where none is asked for


def plot_methods(comparison: xr.DataTree, ax: Axes | None = None) -> Axes:
    """Draw mean and interval of every bias by every method in units of its scale, with the true value."""
    estimate = comparison["estimate"].to_dataset()
    total, names = estimate.sizes["bias_label"], estimate["estimator"].values.tolist()
    apart = comparison["pair"].to_dataset()["wasserstein"].max("pair").values
    estimate = estimate.isel(bias_label=most_first(apart))
    labels, scale = estimate["bias_label"].values, estimate["scale"].values
    rows, count = np.arange(len(labels)), len(names)
    ax = new_axes(ax, 9.0, _height(count, len(rows)))
    for row in rows[::2]:
        ax.axhspan(row - 0.5, row + 0.5, color="0.96", zorder=0)
    ax.axvline(0.0, color="0.3", linewidth=0.8, zorder=1)
    seen = []
    for k, name in enumerate(names):
        mine = estimate.sel(estimator=name)
        mean, lower, upper = (mine[column].values / scale for column in ("mean", "lower", "upper"))
        place = rows + (k - (count - 1) / 2) * 0.8 / count
        ax.hlines(place, lower, upper, color=colour(k), linewidth=1.6, zorder=2)
        status = comparison[f"method/{name}"].attrs["status"]
        valid = status not in INVALID
        label = plain_text(name) + ("" if valid else f", {status}")
        ax.plot(mean, place, "o", color=colour(k), markersize=3.5, label=label, zorder=3)
        seen += [lower, upper] if valid else []  # what diverged is cut
    true = known_truth(comparison).reindex(labels).to_numpy() / scale
    if np.isfinite(true).any():
        ax.plot(true, rows, "|", color="#d00000", markersize=11, markeredgewidth=1.4, zorder=4, label="true")
    scale_axis(ax, *seen, true)
    name_rows(ax, labels)
    some = f"{len(rows)} of {total} biases, those that differ most" if len(rows) < total else f"{total} biases"
    text = f"bias in units of its scale, {probability(comparison):.0%} interval"
    return finish(ax, f"{some}, {count} methods", grid="x", xlabel=text)


def _height(methods: int, biases: int) -> float:
    """Height in inches of a forest."""
    return min(1.8 + (0.16 + 0.09 * methods) * biases, 30.0)


def plot_gammas(comparison: xr.DataTree, ax: Axes | None = None) -> Axes:
    """Draw gamma of every bias by the first method against that of the others, with its interval where it was drawn."""
    ax = new_axes(ax, 6.5, 4.8)
    gamma = comparison["estimate"].to_dataset()["gamma"]
    first, *others = gamma["estimator"].values.tolist()
    across = gamma.sel(estimator=first).values
    ax.plot([0, 1], [0, 1], color="0.3", linewidth=0.8, zorder=1)
    for k, name in enumerate(others):
        method, tint = comparison[f"method/{name}"].to_dataset(), colour(k + 1)
        if "gamma_upper" in method:
            ends = method["gamma_lower"], method["gamma_upper"]
            ax.vlines(across, *ends, color=tint, linewidth=0.9, alpha=0.5, zorder=2)
        ax.plot(across, gamma.sel(estimator=name), "o", color=tint, markersize=4, label=plain_text(name), zorder=3)
    title = "How well the data determine each bias (0 prior only)"
    span = (-0.04, 1.04)
    return finish(ax, title, xlim=span, ylim=span, xlabel=f"gamma by {plain_text(first)}", ylabel="gamma by the others")


def plot_pair(fits: Fits, labels: Sequence[str], names: Sequence[str] | None = None, ax: Axes | None = None) -> Axes:
    """Draw the posterior draws of two biases, and on them the ellipse of the first fit whose posterior is Gaussian.

    `labels` are two labels that all fits have, for instance of `interchangeable`; raises `InputError` for others.
    """
    known = fits_by_name(fits, names)
    first, second = chosen_pair(known, labels)
    ax = new_axes(ax, 6.5, 4.8)
    plugged = next((name for name, tree in known.items() if plugged_in(tree)), None)
    keys = list[Any]()
    for k, (name, tree) in enumerate(known.items()):
        group = tree["calibration"].to_dataset().sel(bias_label=[first, second])
        if name == plugged:
            covariance = SensorBlocks.read(group, [first, second], "plot_pair").matrix()
            mean = group["mean"].values
            style = {"facecolor": "none", "edgecolor": colour(k), "linewidth": 1.8, "zorder": 4}
            ax.add_patch(ellipse_patch(mean, covariance, probability(tree), **style))
            ax.plot(*mean, "+", color=colour(k), markersize=9, markeredgewidth=1.8, zorder=4)
            keys.append(Line2D([], [], color=colour(k), label=f"{plain_text(name)}, {probability(tree):.0%} ellipse"))
            continue
        draws = tree["posterior"].to_dataset()["bias"].sel(bias_label=[first, second])
        z = draws.transpose("bias_label", "chain", "draw").values.reshape(2, -1)
        z = z[:, np.linspace(0, z.shape[1] - 1, min(SCATTER, z.shape[1])).astype(int)]
        ax.plot(*z, ".", color=colour(k), markersize=2.5, alpha=0.4, zorder=2, rasterized=True)
        keys.append(Line2D([], [], marker=".", linestyle="", color=colour(k), label=f"{plain_text(name)}, draws"))
    true = pd.concat([known_truth(tree) for tree in known.values()])
    if first in true and second in true:
        place = [true[[label]].iloc[-1] for label in (first, second)]
        ax.plot(*place, "x", color="#d00000", markersize=8, markeredgewidth=1.8, zorder=5)
        keys.append(Line2D([], [], marker="x", linestyle="", color="#d00000", label="true"))
    unit = next(iter(known.values()))["calibration"].to_dataset()["unit"].to_series()
    across, up = (f"{plain_text(label)} [{unit[label]}]" for label in (first, second))
    return finish(ax, "Posterior of a pair of biases", keys=keys, xlabel=across, ylabel=up)


def draw_compare(comparison: xr.DataTree, fits: Fits, path: AnyPath, pairs: Sequence[Sequence[str]] = ()) -> None:
    """Write the pictures of a comparison to one file: forest, gammas, and pairs of biases.

    `fits` are those compared; where no pair is given the most interchangeable ones of the reference are drawn.
    """
    names = listed_in(comparison, "estimate", "estimator")
    known = fits_by_name(list(fits.values()) if isinstance(fits, Mapping) else fits, names)
    labels = listed_in(comparison, "estimate", "bias_label")
    if not pairs:
        found = interchangeable(known[str(comparison.attrs["reference"])], count=PAIRS, among=labels)
        pairs = [(first, second) for first, second, _ in found]
    height = _height(len(known), min(len(labels), ROWS))
    figure = Figure(figsize=(17.0, max(height, 4.2 * (1 + len(pairs)))), layout="constrained")
    halves: Any = figure.subfigures(1, 2, width_ratios=[1.15, 1.0])
    left, right = halves
    plot_methods(comparison, left.subplots())
    axes = np.atleast_1d(right.subplots(1 + len(pairs), 1))
    plot_gammas(comparison, axes[0])
    for ax, pair in zip(axes[1:], pairs, strict=True):
        plot_pair(known, pair, ax=ax)
    write_figure(figure, path, 110)
