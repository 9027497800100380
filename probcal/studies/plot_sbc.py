"""Pictures of a simulation-based calibration: ranks against their simultaneous band, coverage of the intervals."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from arviz_plots import PlotCollection, plot_ecdf_pit
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase

from probcal.errors import InputError, nearest
from probcal.files import AnyPath
from probcal.plots.base import BEFORE, colour, new_axes, plain_text, write_figure
from probcal.studies.uniformity import band

COLUMNS = 5
WIDTH, HEIGHT = 13.0, 2.3  # of the picture and of a row of panels, inches
PANELS = 40  # at most so many quantities, those that fit worst
ALARM = 0.05  # probability that a right method leaves the band of one panel
WORST = "#d55e00"


def plot_ranks(
    tree: xr.DataTree, quantities: Sequence[str] | None = None, figure: FigureBase | None = None
) -> FigureBase:
    """Draw how the ranks of each quantity depart from uniform (ArviZ), with the band that 95 % of right methods keep.

    Above the line all along: the truth lies low among the draws; above it left and below it right: the posterior is too
    narrow. At most 40 quantities are drawn, those that fit worst; those that fail the test of all together are red.
    Raises `InputError` for a quantity that was not ranked.
    """
    group, tests = tree["sbc"].to_dataset(), tree["uniformity"].to_dataset()
    p_value = tests["p_value"].to_series().to_dict()
    names = [str(name) for name in group["quantity"].values]
    for name in quantities or ():
        if name not in names:
            raise InputError(f'plot_ranks: no quantity is called "{name}"{nearest(name, names)}')
    worst = sorted(names, key=lambda name: p_value[name])[:PANELS]
    chosen = list(quantities) if quantities else [name for name in names if name in worst]
    data = group[["place"]].sel(quantity=chosen).drop_vars("kind")
    rows = -(-len(chosen) // COLUMNS)
    if figure is None:
        figure = Figure(figsize=(WIDTH, HEIGHT * rows), layout="constrained")
    axes = list(figure.subplots(rows, COLUMNS, squeeze=False, sharex=True, sharey=True).ravel())
    for spare in axes[len(chosen) :]:
        spare.remove()
    axes = axes[: len(chosen)]
    _draw_by_arviz(figure, axes, data)
    x, low, high = band(data.sizes["run"], ALARM)
    limit = tree.attrs["false_alarm_rate"] / len(p_value)
    for name, ax in zip(chosen, axes, strict=True):
        ax.fill_between(x, low - x, high - x, color=BEFORE, alpha=0.3, linewidth=0)
        found = p_value[name]
        ax.set_title(f"{plain_text(name, 30)}\np {found:.2g}", fontsize=8, color=WORST if found < limit else "black")
        ax.set(xlabel="", ylabel="")
        ax.tick_params(labelsize=7)
    figure.supxlabel("place of the truth among the draws", fontsize=9)
    figure.supylabel("share below, less expected", fontsize=9)
    return figure


def _draw_by_arviz(figure: FigureBase, axes: Sequence[Axes], data: xr.Dataset) -> None:
    """Let ArviZ draw the difference of distribution functions of `place` into given axes, without pyplot."""
    objects: Any = np.empty(len(axes), dtype=object)
    objects[:] = axes
    coords = {"quantity": data["quantity"].values}
    places = {
        "plot": objects,
        "row_index": np.arange(len(axes)) // COLUMNS,
        "col_index": np.arange(len(axes)) % COLUMNS,
    }
    parts = {name: xr.Dataset({"place": ("quantity", value)}, coords=coords) for name, value in places.items()}
    whole = xr.Dataset({"figure": ((), np.array(figure, dtype=object))})
    canvas = PlotCollection(data, xr.DataTree.from_dict({"/": whole} | parts), backend="matplotlib")
    hidden: Any = dict.fromkeys(("title", "p_value_text", "suspicious_points", "xlabel", "ylabel"), False)
    plot_ecdf_pit(
        xr.DataTree.from_dict({"prior_sbc": data}), sample_dims=["run"], plot_collection=canvas, backend="matplotlib",
        visuals=hidden,
    )  # fmt: skip


def plot_coverage(tree: xr.DataTree, ax: Axes | None = None) -> Axes:
    """Draw observed against nominal coverage of the intervals, with two Monte Carlo standard errors."""
    ax = new_axes(ax, 4.6, 4.2)
    table = tree["coverage"].to_dataset()
    nominal = table["nominal"].values
    ax.plot([0, 1], [0, 1], color="0.6", linewidth=1)
    words = {"all": "all biases", "nonzero": "biases that are not zero", "plain": "all biases, ends included"}
    shown = {name: text for name, text in words.items() if name in table}
    for k, (name, text) in enumerate(shown.items()):
        place, error = nominal + 0.006 * (k - 1), 2 * table[f"{name}_se"].values
        ax.errorbar(place, table[name].values, error, fmt="os^"[k], color=colour(k), markersize=4, label=text)
    low = min(float(table[name].min()) for name in shown)
    ax.set(xlabel="nominal probability of the interval", ylabel="share of runs that it holds the truth")
    ax.set(xlim=(0.45, 1.0), ylim=(min(0.45, low - 0.05), 1.02))
    ax.grid(color="0.9")
    ax.legend(frameon=False, fontsize=8, loc="lower right")
    return ax


def draw_sbc(tree: xr.DataTree, path: AnyPath) -> None:
    """Write ranks and coverage of a calibration as one picture."""
    rows = -(-min(tree["sbc"].sizes["quantity"], PANELS) // COLUMNS)
    figure = Figure(figsize=(WIDTH, HEIGHT * (rows + 2)), layout="constrained")
    parts: Any = figure.subfigures(2, 1, height_ratios=[rows, 2])
    upper, lower = parts
    plot_ranks(tree, figure=upper)
    plot_coverage(tree, lower.subplots(1, 3)[1])
    for ax in lower.axes[::2]:
        ax.remove()
    figure.suptitle(plain_text(f"{tree.attrs['method']}, {tree.attrs['prior']}: {tree.attrs['status']}", 80))
    write_figure(figure, path, 120)
