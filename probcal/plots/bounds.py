"""Pictures of bounds: the map of the position bound, and what uncalibrated biases do to the tracks."""

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize

from probcal.errors import InputError
from probcal.plots.base import COLOURS, figure_of, finish, name_places, new_axes, plain_text

SURFACE = "viridis"
WIDE = 20.0  # ratio of largest to smallest value above which the colours are logarithmic


def plot_bound_map(found: xr.Dataset, ax: Axes | None = None) -> Axes:
    """Draw a map of `bound_map`: the bound of the position error in m, contours and the nodes; grey: not determined."""
    ax = new_axes(ax, 7.5, 6.0)
    ax.set_aspect("equal", adjustable="box")
    ax.set_facecolor("0.75")
    values = np.ma.masked_array(found["rmse"].values, ~found["determined"].values)
    if values.count():
        _surface(ax, found["x"].values, found["y"].values, values, "position bound in m", WIDE)
    nodes = found["node_position"].values[:, :2]
    ax.plot(*nodes.T, "s", color="black", markerfacecolor="white", markersize=6, zorder=4)
    name_places(ax, found["node"].values, nodes)
    for side, limit in ((found["x"].values, ax.set_xlim), (found["y"].values, ax.set_ylim)):
        half = np.ptp(side) / (2 * (len(side) - 1)) if len(side) > 1 else 0.5
        limit(side.min() - half, side.max() + half)
    height = f" at z = {float(found['z']):g} m" if "z" in found.coords else ""
    title = f"Least position error{height}, biases {plain_text(found.attrs['biases'])}"
    return finish(ax, title, grid="", key=False, xlabel="x in m", ylabel="y in m")


def plot_sensitivity(found: xr.Dataset, ax: Axes | None = None) -> Axes:
    """Draw the RMS position error of `sensitivity` over its stds: a surface over two groups, a line over one.

    The axes are in the unit of the biases. Raises `InputError` for three groups or more; select from the dataset.
    """
    dims = [str(name) for name in found["rmse"].dims]
    if len(dims) > 2:
        raise InputError(f"plot_sensitivity: there are {len(dims)} groups of biases; select one std of all but two")
    if len(dims) == 1:
        ax = new_axes(ax, 6.0, 3.8)
        ax.plot(found[dims[0]], found["rmse"], "o", color=COLOURS[0], markersize=4, label="simulated")
        ax.plot(found[dims[0]], found["predicted"], "-", color=COLOURS[1], label="to first order")
        ax.set(xlabel=f"std of {plain_text(dims[0])}", ylabel="RMS position error in m", ylim=(0.0, None))
        ax.grid(color="0.9")
        ax.legend(frameon=False)
        return ax
    ax = new_axes(ax, 6.5, 5.0)
    down, across = dims
    values = np.ma.masked_array(found["rmse"].values)
    _surface(ax, found[across].values, found[down].values, values, "RMS position error in m", np.inf)
    right, up = (f"std of {plain_text(name)}" for name in (across, down))
    return finish(ax, "Tracks that ignore the biases", grid="", key=False, xlabel=right, ylabel=up)


def _surface(ax: Axes, x: np.ndarray, y: np.ndarray, values: Any, label: str, most: float) -> None:
    """Heat map of values (y, x) with its colour bar and contours; logarithmic where they span more than a ratio."""
    low, high = float(values.min()), float(values.max())
    wide = low > 0 and high > most * low
    norm, spaced = (LogNorm(low, high), np.geomspace) if wide else (Normalize(low, high), np.linspace)
    drawn = ax.pcolormesh(x, y, values, cmap=SURFACE, norm=norm, shading="nearest", rasterized=True)
    figure_of(ax).colorbar(drawn, ax=ax, label=label, format="%g")
    if min(values.shape) > 1 and high > low:
        levels = np.unique([float(f"{level:.2g}") for level in spaced(low, high, 8)[1:-1]])
        levels = levels[(levels > low) & (levels < high)]
        if len(levels):
            lines = ax.contour(x, y, values, levels=levels, colors="white", linewidths=0.8)
            ax.clabel(lines, fmt="%g", fontsize=7)
