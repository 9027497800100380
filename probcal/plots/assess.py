"""Pictures of an assessment: shrinkage with verdicts, NIS by epoch, sensors left out, change between halves."""

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from probcal.files import AnyPath
from probcal.plots.base import (
    COLOURS,
    FAINT,
    NAMED,
    POINTS,
    ROWS,
    SURE,
    colour,
    figure_of,
    finish,
    most_first,
    name_rows,
    new_axes,
    plain_text,
    scale_axis,
    write_figure,
)
from probcal.results.read import each_track

# the words of a verdict, each with its colour and mark
VERDICTS = {
    "determined": ("#009e73", "o"), "relative": (SURE, "D"), "by the prior": (FAINT, "p"),
    "weak": ("#e69f00", "s"), "prior only": ("#8c8c8c", "v"),
    "drifting": ("#d55e00", "^"), "conflicting": ("#cc79a7", "X"),
}  # fmt: skip


def plot_shrinkage(tree: xr.DataTree, ax: Axes | None = None) -> Axes:
    """Draw gamma against posterior contraction 1 - sd^2 / scale^2 of every bias, coloured by verdict."""
    ax = new_axes(ax, 6.5, 4.5)
    columns = tree["calibration"].to_dataset()[["sd", "scale", "gamma"]].assign(tree["verdict"].to_dataset())
    frame: Any = columns.to_dataframe()
    frame["contraction"] = 1.0 - (frame["sd"] / frame["scale"]) ** 2
    others = dict.fromkeys(sorted(set(frame["verdict"]) - set(VERDICTS)), ("black", "P"))
    for word, (tint, mark) in (VERDICTS | others).items():
        own = frame[frame["verdict"] == word]
        if len(own):
            ax.plot("contraction", "gamma", mark, data=own, color=tint, markersize=6, label=f"{word} ({len(own)})")
    alarmed = frame[frame["verdict"].isin(["drifting", "conflicting"])]
    for label, place in alarmed[["contraction", "gamma"]].iterrows() if len(alarmed) <= NAMED // 4 else ():
        ax.annotate(plain_text(label), tuple(place), xytext=(5, 4), textcoords="offset points", fontsize=7)
    contraction = "posterior contraction 1 - sd\N{SUPERSCRIPT TWO} / scale\N{SUPERSCRIPT TWO}"
    return finish(ax, "Shrinkage of every bias", grid="", xlabel=contraction, ylabel="gamma", ylim=(-0.05, 1.05))


def plot_nis(tree: xr.DataTree, ax: Axes | None = None) -> Axes:
    """Draw the NIS a datum of every epoch with its limits, and how many lie outside."""
    ax = new_axes(ax, 9.0, 3.4)
    outside = total = 0
    for k, (_, check) in enumerate(each_track(tree, "epoch_check")):
        time, nis, lower, upper = (check[part].values for part in ("time", "nis", "lower", "upper"))
        out = (nis < lower) | (nis > upper)
        outside, total = outside + int(out.sum()), total + len(out)
        shown = np.union1d(np.arange(0, len(time), len(time) // POINTS + 1), np.flatnonzero(out))
        first = k == 0
        ax.plot(time[shown], nis[shown], ".", color=colour(k), markersize=3, label="epoch" if first else None)
        limits = np.stack([lower, upper], 1)[shown]
        label = ("_lower", "99 % limits") if first else None
        ax.plot(time[shown], limits, "-", color="0.4", linewidth=0.7, label=label)
    ax.axhline(1.0, color="0.7", linewidth=0.8, zorder=0)
    top = ax.get_ylim()[1]
    ax.set_yscale("asinh", linear_width=5.0)
    ticks = np.array([0, 1, 2, 5, *(m * 10.0**e for e in range(1, 9) for m in (1, 2, 5))])
    ax.set_yticks(ticks[ticks <= top], [f"{tick:g}" for tick in ticks[ticks <= top]])
    ax.minorticks_off()
    title = f"Innovations: {outside} of {total} epochs outside (1 % expected)"
    return finish(ax, title, grid="", xlabel="time in s", ylabel="NIS a datum", ylim=(0.0, top))


def plot_left_out(tree: xr.DataTree, ax: Axes | None = None) -> Axes:
    """Draw, for each sensor, how many nats better the rest predicts its data calibrated than as stated."""
    check = tree["sensor_left" if "sensor_left" in tree.children else "sensor_check"].to_dataset()
    gain = check["difference"] if "difference" in check else xr.zeros_like(check["nis"])
    gains = gain.to_series().sort_values(ascending=False, kind="stable")[:ROWS]
    ax = new_axes(ax, 9.0, min(1.2 + 0.24 * len(gains), 24.0))
    ax.barh(range(len(gains)), gains, color=[COLOURS[1], *[COLOURS[0]] * (len(gains) - 1)], height=0.7)
    ax.axvline(0.0, color="0.3", linewidth=0.8)
    name_rows(ax, gains.index)
    all_of = check.attrs.get("of", gain.size)
    part = f": {len(gains)} of {all_of} sensors" if len(gains) < all_of else ""
    title = f"Each sensor predicted by the rest{part}"
    return finish(ax, title, grid="x", key=False, xlabel="elpd calibrated less elpd as stated, nats")


def plot_halves(tree: xr.DataTree, ax: Axes | None = None) -> Axes:
    """Draw the change of each bias from the first half to the second in units of its scale, with its limits."""
    group = tree["halves"].to_dataset()
    group = group.assign(scale=tree["calibration"]["scale"].sel(bias_label=group["bias_label"]))
    title = f"Change between halves (at {group.attrs['time']:.4g} s)"
    moved = abs(group["t"]) > group.attrs["limit"]
    return _draw_changes(group, moved, "second half less first", title, ax)


def plot_changes(tree: xr.DataTree, ax: Axes | None = None) -> Axes:
    """Draw what `changes` found between two recordings, in units of the scales, those that moved in colour."""
    group = tree["change"].to_dataset()
    moved = group["verdict"] == "moved"
    title = f"{int(moved.sum())} of {group.sizes['bias_label']} biases moved"
    difference = f"{plain_text(tree.attrs['second'])} less {plain_text(tree.attrs['first'])}"
    return _draw_changes(group, moved, difference, title, ax)


def draw_changes(tree: xr.DataTree, path: AnyPath) -> None:
    """Write the picture of what moved between two recordings."""
    write_figure(figure_of(plot_changes(tree)), path, 120)


def _draw_changes(group: xr.Dataset, marked: xr.DataArray, difference: str, title: str, ax: Axes | None) -> Axes:
    """Changes with intervals of the limit, those of largest |t| where there are many, `marked` ones in colour."""
    limit = float(group.attrs["limit"])
    frame: Any = group[["change", "sd", "scale", "t"]].assign(marked=marked).to_dataframe()
    frame = frame[np.isfinite(frame["sd"])]
    frame = frame.iloc[most_first(frame["t"].abs().to_numpy())]
    change, half = frame["change"] / frame["scale"], limit * frame["sd"] / frame["scale"]
    ax = new_axes(ax, 9.0, min(1.5 + 0.24 * len(frame), 24.0))
    tint = np.where(frame["marked"], COLOURS[1], "0.45")
    ax.axvline(0.0, color="0.3", linewidth=0.8)
    ax.hlines(range(len(frame)), change - half, change + half, color=tint, linewidth=2.0)
    ax.scatter(change, range(len(frame)), color=tint, s=22, zorder=3)
    name_rows(ax, frame.index)
    scale_axis(ax, change - half, change + half)
    return finish(ax, title, grid="x", key=False, xlabel=f"{difference}, in scales; intervals of {limit:.1f} sd")
