"""Roads, and particles on them."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from probcal.plots.base import colour, new_axes, plain_text

LARGEST = 60.0  # points^2 of the heaviest particle


def plot_roads(network: Any, ax: Axes | None = None, *, names: bool = False) -> Axes:
    """Draw the roads of a `RoadNetwork` in the plane, one-way ones with an arrow, and their `names` if asked for."""
    ax = new_axes(ax, 7.0, 5.0)
    ax.set_aspect("equal", adjustable="box")
    for name, line, oneway in zip(network.names, network.lines, network.oneway, strict=True):
        line = np.asarray(line)[:, :2]
        ax.plot(*line.T, color="0.8", linewidth=3.0, solid_capstyle="round", zorder=0.5)
        middle = len(line) // 2
        here, ahead = 0.5 * (line[middle - 1] + line[middle]), line[middle] - line[middle - 1]
        if oneway:
            ax.annotate("", here + 0.01 * ahead, here, arrowprops={"arrowstyle": "->", "color": "0.5"}, zorder=0.6)
        if names:
            ax.text(float(here[0]), float(here[1]), plain_text(name), fontsize=7, color="0.4", ha="center", va="center")
    ax.set(xlabel="x in m", ylabel="y in m")
    return ax


def plot_particles(
    tree: xr.DataTree, target: str = "target", times: Sequence[float] | None = None, *, kind: str = "smoothed",
    roads: Any = None, axes: Sequence[Axes] | None = None,
) -> list[Axes]:  # fmt: skip
    """Draw the particles of a target at some times side by side, larger where they weigh more, roads behind them.

    `tree` is that of `particle_filter`, `kind` "filtered" or "smoothed"; by default six epochs evenly along the track.
    """
    group = tree[f"{kind}/{target}"].to_dataset()
    known = group["time"].values
    wanted = known[np.linspace(0, len(known) - 1, min(6, len(known))).round().astype(int)] if times is None else times
    if axes is None:
        columns = min(3, len(wanted))
        rows = -(-len(wanted) // columns)
        figure = Figure(figsize=(3.3 * columns, 2.8 * rows), layout="compressed")
        axes = list(figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel())
    for ax, time in zip(axes, wanted, strict=False):
        here = group.sel(time=time, method="nearest")
        weight = here["weight"].values
        if roads is not None:
            plot_roads(roads, ax)
        places = here["state"].sel(component=["position_x", "position_y"]).values
        ax.scatter(
            places[:, 0], places[:, 1], s=LARGEST * weight / weight.max(), color=colour(0), alpha=0.4, linewidths=0
        )
        ax.set_title(f"{float(here['time']):g} s", fontsize=9)
        ax.set_aspect("equal", adjustable="box")
    return list(axes)
