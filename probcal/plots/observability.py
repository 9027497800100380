"""Pictures of what data can determine: spectrum of the information, weak directions and next passes on the map."""

from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from probcal.files import AnyPath
from probcal.labels import label_parts
from probcal.plots.base import (
    BEFORE,
    GAMMA,
    NAMED,
    REACH,
    colour,
    finish,
    name_places,
    new_axes,
    plain_text,
    write_figure,
)
from probcal.plots.bounds import plot_bound_map
from probcal.results.read import each_target

SHOWN = 6  # directions on one map
LOWEST = 1e-10  # information below which the spectrum is cut


def plot_spectrum(tree: xr.DataTree, ax: Axes | None = None) -> Axes:
    """Draw the eigenvalues of the information in units of the prior scale; those below 1 are weak."""
    ax = new_axes(ax, 6.0, 3.6)
    values = tree["spectrum"].to_dataset()["information"].values
    shown = np.maximum(values, LOWEST)
    number = np.arange(1, len(values) + 1)
    weak = values < 1.0
    ax.semilogy(number[~weak], shown[~weak], "o", color=colour(0), markersize=4, label="determined by the data")
    ax.semilogy(number[weak], shown[weak], "v", color=colour(1), markersize=5, label="weak: left to prior and survey")
    ax.axhline(1.0, color="0.3", linewidth=0.8)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.legend(frameon=False, fontsize=8)
    title = f"{weak.sum()} of {len(values)} directions are weak"
    return finish(ax, title, key=False, xlabel="eigenvalue", ylabel="information in prior scales")


def plot_directions(tree: xr.DataTree, ax: Axes | None = None) -> Axes:
    """Draw each weak direction as arrows of the nodes it moves; a turning heading is a stroke across its arrow."""
    ax = new_axes(ax, 9.0, 6.0)
    ax.set_aspect("equal", adjustable="box")
    keys = _draw_scene(ax, tree)
    title = "The data determine every direction"
    if "direction" in tree.children:
        group = tree["direction"].to_dataset()
        (left, right), (low, high) = ax.get_xlim(), ax.get_ylim()
        width = max(right - left, high - low)
        ax.set(xlim=(left - REACH * width, right + REACH * width), ylim=(low - REACH * width, high + REACH * width))
        for k in range(min(SHOWN, group.sizes["direction"])):
            chosen = group.isel(direction=k)
            _draw_direction(ax, tree, chosen["vector"].to_series(), width, colour(k))
            text = f"{plain_text(chosen['direction'].item(), 60)} ({chosen['information'].item():.1g})"
            keys.append(Line2D([], [], color=colour(k), label=text))
        left = group.sizes["direction"] - SHOWN
        title = f"Directions that the data hardly determine{f', {left} more not shown' if left > 0 else ''}"
    return finish(ax, title, grid="", keys=keys)


def plot_passes(tree: xr.DataTree, passes: xr.Dataset, ax: Axes | None = None) -> Axes:
    """Draw candidate passes on the map, coloured by what each would tell (nats), the best one bold."""
    ax = new_axes(ax, 8.0, 6.0)
    ax.set_aspect("equal", adjustable="datalim")
    keys = _draw_scene(ax, tree)
    gain = passes["gain"].values
    shade = ax.scatter([], [], c=[], cmap=GAMMA, vmin=float(gain.min()), vmax=float(gain.max()))
    for k in reversed(range(len(gain))):
        path = passes["path"].values[k][:, :2]
        mark, width = "o" if len(path) == 1 else "-", 3.0 if k == 0 else 1.2
        ax.plot(*path.T, mark, color=shade.to_rgba(gain[k]), linewidth=width, zorder=3)
    ax.figure.colorbar(shade, ax=ax, label="information gain in nats", shrink=0.8)
    ax.legend(handles=keys, loc="upper left", frameon=True, fontsize=8)
    return finish(ax, "What one more pass would tell about the biases", grid="", key=False)


def draw_check(tree: xr.DataTree, passes: xr.Dataset, bound: xr.Dataset, path: AnyPath) -> None:
    """Write the pictures of a check to one file: directions, spectrum, next passes, map of the position bound."""
    figure = Figure(figsize=(15.0, 12.0), layout="constrained")
    parts: Any = figure.subfigures(2, 1, height_ratios=[1.1, 1.0])
    left, right = parts[0].subplots(1, 2, width_ratios=[1.0, 2.2])
    plot_spectrum(tree, left)
    plot_directions(tree, right)
    left, right = parts[1].subplots(1, 2)
    plot_passes(tree, passes, left)
    plot_bound_map(bound, right)
    write_figure(figure, path, 100)


def _draw_scene(ax: Axes, tree: xr.DataTree) -> list[Line2D]:
    """Draw nodes and tracks, and return their legend entries."""
    nodes = tree["constant_data"].to_dataset()
    for _, track in each_target(tree):
        places = track["mean"].sel(component=["position_x", "position_y"]).values
        ax.plot(*places.T, "." if len(places) == 1 else "-", color=BEFORE, linewidth=1.0, zorder=1)
    stated = nodes["node_position"].values[:, :2]
    style: dict[str, Any] = {"color": "black", "markerfacecolor": "none", "markersize": 6}
    ax.plot(*stated.T, "s", zorder=5, **style)
    name_places(ax, nodes["node"].values, stated)
    ax.set(xlabel="x in m", ylabel="y in m")
    return [
        Line2D([], [], marker="s", linestyle="", label="stated position", **style),
        Line2D([], [], color=BEFORE, label="target"),
    ]


def _draw_direction(ax: Axes, tree: xr.DataTree, vector: pd.Series, width: float, shade: str) -> None:
    """Draw how a direction moves the nodes (arrows) and turns them (strokes); the longest arrow has a fixed length."""
    nodes = tree["constant_data"].to_dataset()
    scale = tree["bias"].to_dataset()["scale"].to_series()
    names, stated = nodes["node"].values.astype(str), nodes["node_position"].values[:, :2]
    moved = vector * scale
    shift = np.stack([moved.reindex(names + f".position_{axis}", fill_value=0.0) for axis in "xy"], 1)
    turn = np.abs(moved.reindex(names + ".heading", fill_value=0.0).to_numpy())
    longest = np.linalg.norm(shift, axis=1).max()
    if longest > 0:
        arrows = shift / longest * REACH * width
        some = np.linalg.norm(arrows, axis=1) > 0.02 * REACH * width
        ax.quiver(
            *stated[some].T, *arrows[some].T, color=shade, angles="xy", scale_units="xy", scale=1.0, width=0.0035,
            zorder=4,
        )  # fmt: skip
    if turn.max() > 0:
        ax.scatter(
            stated[:, 0], stated[:, 1], s=60.0 * turn / turn.max(), marker="$\\circlearrowleft$", color=shade, zorder=4
        )
    large = vector.abs() > 0.3 * vector.abs().max()
    rest = [label_parts(label) for label in vector.index[large] if "position" not in label and "heading" not in label]
    for name, place in zip(names, stated, strict=True):
        own = [bias for owner, bias in rest if owner == name]
        if own and len(names) <= NAMED:
            text = ", ".join(plain_text(bias, 16) for bias in own[:2])
            ax.annotate(text, place, xytext=(6, -10), textcoords="offset points", fontsize=6, color=shade, zorder=6)
