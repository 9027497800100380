"""Pictures of an assessment: shrinkage with verdicts, NIS by epoch, sensors left out, change between halves."""

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from probcal.plots.base import COLOURS, NAMED, POINTS, ROWS, colour, new_axes, plain_text
from probcal.results.read import each_track

# the words of a verdict, each with its colour and mark
VERDICTS = {
    "determined": (COLOURS[2], "o"), "weak": (COLOURS[4], "s"), "prior only": ("#8c8c8c", "v"),
    "drifting": (COLOURS[1], "^"), "conflicting": (COLOURS[3], "X"),
}  # fmt: skip


def plot_shrinkage(tree: xr.DataTree, ax: Axes | None = None) -> Axes:
    """Draw gamma against posterior contraction 1 - sd^2 / scale^2 of every bias, coloured by verdict."""
    ax = new_axes(ax, 6.5, 4.5)
    group = tree["calibration"].to_dataset()
    words, labels = tree["verdict"].to_dataset()["verdict"].values, group["bias_label"].values
    shrunk = 1.0 - (group["sd"].values / group["scale"].values) ** 2
    for word, (tint, mark) in VERDICTS.items():
        mine = words == word
        if mine.any():
            ax.plot(
                shrunk[mine],
                group["gamma"].values[mine],
                mark,
                color=tint,
                markersize=6,
                label=f"{word} ({mine.sum()})",
            )
    alarmed = np.isin(words, ["drifting", "conflicting"])
    if alarmed.sum() <= NAMED // 4:
        for k in np.flatnonzero(alarmed):
            ax.annotate(plain_text(labels[k]), (shrunk[k], group["gamma"].values[k]), xytext=(5, 4),
                        textcoords="offset points", fontsize=7)  # fmt: skip
    ax.set(xlabel="posterior contraction 1 - sd\N{SUPERSCRIPT TWO} / scale\N{SUPERSCRIPT TWO}", ylabel="gamma",
           ylim=(-0.05, 1.05))  # fmt: skip
    ax.set_title("Shrinkage of every bias", loc="left")
    ax.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False, fontsize=8)
    return ax


def plot_nis(tree: xr.DataTree, ax: Axes | None = None) -> Axes:
    """Draw the NIS a datum of every epoch with its limits, and how many lie outside."""
    ax = new_axes(ax, 9.0, 3.4)
    outside = total = 0
    for k, (_, check) in enumerate(each_track(tree, "epoch_check")):
        time, nis, lower, upper = (check[part].values for part in ("time", "nis", "lower", "upper"))
        out = (nis < lower) | (nis > upper)
        outside, total = outside + int(out.sum()), total + len(out)
        shown = np.union1d(np.arange(0, len(time), len(time) // POINTS + 1), np.flatnonzero(out))
        ax.plot(time[shown], nis[shown], ".", color=colour(k), markersize=3, label="epoch" if k == 0 else None)
        ax.plot(time[shown], lower[shown], "-", color="0.4", linewidth=0.7)
        ax.plot(time[shown], upper[shown], "-", color="0.4", linewidth=0.7, label="99 % limits" if k == 0 else None)
    ax.axhline(1.0, color="0.7", linewidth=0.8, zorder=0)
    top = ax.get_ylim()[1]
    ax.set_yscale("asinh", linear_width=5.0)
    ticks = np.array([0, 1, 2, 5, *(m * 10.0**e for e in range(1, 9) for m in (1, 2, 5))])
    ax.set_yticks(ticks[ticks <= top], [f"{tick:g}" for tick in ticks[ticks <= top]])
    ax.minorticks_off()
    ax.set_ylim(0.0, top)
    ax.set(xlabel="time in s", ylabel="NIS a datum")
    ax.set_title(f"Innovations: {outside} of {total} epochs outside (1 % expected)", loc="left")
    ax.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False, fontsize=8)
    return ax


def plot_left_out(tree: xr.DataTree, ax: Axes | None = None) -> Axes:
    """Draw, for each sensor, how many nats better the rest predicts its data calibrated than as stated."""
    check = tree["sensor_left" if "sensor_left" in tree.children else "sensor_check"].to_dataset()
    if "difference" not in check:
        check = check.assign(difference=xr.zeros_like(check["nis"]))
    gain = check["difference"].values
    order = np.argsort(-gain, kind="stable")[:ROWS]
    ax = new_axes(ax, 9.0, min(1.2 + 0.24 * len(order), 24.0))
    rows = np.arange(len(order))
    ax.barh(rows, gain[order], color=[COLOURS[1] if k == order[0] else COLOURS[0] for k in order], height=0.7)
    ax.axvline(0.0, color="0.3", linewidth=0.8)
    _named(ax, rows, check["sensor"].values[order])
    ax.set_xlabel("elpd calibrated less elpd as stated, nats")
    more = f", the largest {len(order)} of {len(gain)}" if len(order) < len(gain) else ""
    ax.set_title(f"Each sensor predicted by the rest{more}", loc="left")
    return ax


def plot_halves(tree: xr.DataTree, ax: Axes | None = None) -> Axes:
    """Draw the change of each bias from the first half to the second in units of its scale, with its limits."""
    group = tree["halves"].to_dataset()
    scale = tree["calibration"].to_dataset()["scale"].sel(bias_label=group["bias_label"]).values
    limit = float(group.attrs["limit"])
    ax = _draw_changes(group, scale, np.abs(group["t"].values) > limit, ax)
    ax.set_xlabel(f"second half less first, in scales; intervals of {limit:.1f} sd")
    ax.set_title(f"Change between halves (at {group.attrs['time']:.4g} s)", loc="left")
    return ax


def plot_changes(tree: xr.DataTree, ax: Axes | None = None) -> Axes:
    """Draw what `changes` found between two recordings, in units of the scales, those that moved in colour."""
    group = tree["change"].to_dataset()
    group = group.isel(bias_label=np.isfinite(group["sd"].values))
    ax = _draw_changes(group, group["scale"].values, group["verdict"].values == "moved", ax)
    limit = tree["change"].attrs["limit"]
    ax.set_xlabel(f"{plain_text(tree.attrs['second'])} less {plain_text(tree.attrs['first'])}, in scales;"
                  f" intervals of {limit:.1f} sd")  # fmt: skip
    moved = int((group["verdict"].values == "moved").sum())
    ax.set_title(f"{moved} of {tree['change'].sizes['bias_label']} biases moved", loc="left")
    return ax


def _draw_changes(group: xr.Dataset, scale: np.ndarray, marked: np.ndarray, ax: Axes | None) -> Axes:
    """Changes with intervals of the limit, those of largest |t| where there are many, `marked` ones in colour."""
    order = np.sort(np.argsort(-np.abs(group["t"].values), kind="stable")[:ROWS])
    limit = float(group.attrs["limit"])
    change, sd = group["change"].values / scale, group["sd"].values / scale
    ax = new_axes(ax, 9.0, min(1.5 + 0.24 * len(order), 24.0))
    rows = np.arange(len(order))
    tint = [COLOURS[1] if marked[k] else "0.45" for k in order]
    ax.axvline(0.0, color="0.3", linewidth=0.8)
    ax.hlines(rows, (change - limit * sd)[order], (change + limit * sd)[order], color=tint, linewidth=2.0)
    ax.scatter(change[order], rows, color=tint, s=22, zorder=3)
    _named(ax, rows, group["bias_label"].values[order])
    if len(order) and np.abs(change[order]).max() + limit * sd[order].max() > 5.0:
        ax.set_xscale("asinh", linear_width=1.0)
        ticks = [sign * 10.0**e for sign in (-1, 1) for e in range(9)]
        ticks = [0.0, *(tick for tick in ticks if ax.get_xlim()[0] < tick < ax.get_xlim()[1])]
        ax.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        ax.minorticks_off()
    return ax


def _named(ax: Axes, rows: Any, names: Any) -> None:
    """Names down the left side, the first on top."""
    ax.set_yticks(rows, [plain_text(name) for name in names], fontsize=8 if len(rows) <= NAMED else 6)
    ax.set_ylim(len(rows) - 0.4, -0.6)
    ax.grid(axis="x", color="0.9", zorder=0)
    ax.set_axisbelow(True)
