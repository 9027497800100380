"""The shared parts of pictures: colours, limits, texts, axes without pyplot, labels, legends."""

import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from probcal.files import AnyPath, write_whole
from probcal.plots.scene import ellipse
from probcal.results.schema import INTERVAL

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8a6d00", "#5d3a9b")
BEFORE = "#a6a6a6"
REACH = 0.12  # longest arrow on a map, in its widths
GAMMA = "viridis_r"  # light: prior only, dark: data only
PALE, FAINT, SURE = "#e0e0e0", "#b5b5b5", "#c2185b"  # an object that hardly exists: on white, on any; one that does
POINTS = 3_000  # of one track
ALL_POINTS = 40_000  # of all tracks together
ROWS = 120  # biases in one forest
FEW = 25  # nodes above which their names and marks are small
LISTED = 12  # targets or objects in a legend, and biases in the words of a node
NAMED = 60  # nodes, targets or biases above which names are left out
LINEAR = 12.0  # scales up to which the axis of a forest stays linear
BESIDE: Any = {"loc": "upper left", "bbox_to_anchor": (1.01, 1.0), "frameon": False, "fontsize": 8}  # of a legend


def new_axes(ax: Axes | None, width: float, height: float) -> Axes:
    """The axes given, or new ones of a size in inches."""
    return Figure(figsize=(width, height), layout="compressed").subplots() if ax is None else ax


def panels(figure: Any, count: int, columns: int, **options: Any) -> list[Axes]:
    """New axes of a figure in rows of so many columns."""
    grid = figure.subplots(-(-count // columns), columns, squeeze=False, **options).ravel()
    for spare in grid[count:]:
        spare.remove()
    return list(grid[:count])


def finish(
    ax: Axes, title: str, *, grid: Any = "both", key: bool = True, keys: Sequence[Any] | None = None, **settings: Any
) -> Axes:
    """The axes with labels and limits, a grid in some directions, a title at the left and a legend at the right."""
    ax.set(**settings)
    ax.set_title(title, loc="left")
    if grid:
        ax.grid(axis=grid, color="0.9")
        ax.set_axisbelow(True)
    if key:
        ax.legend(handles=keys, **BESIDE)
    return ax


def name_rows(ax: Axes, names: Iterable[object]) -> None:
    """Write names down the left side, the first on top."""
    texts = [plain_text(name) for name in names]
    ax.set_yticks(range(len(texts)), texts, fontsize=8 if len(texts) <= NAMED else 7)
    ax.set_ylim(len(texts) - 0.4, -0.6)


def name_places(ax: Axes, names: Sequence[object] | np.ndarray, places: np.ndarray) -> None:
    """Write the names of nodes at their places (N, 2) in the plane; none where there are too many."""
    if len(names) <= NAMED:
        for name, place in zip(names, places, strict=True):
            ax.annotate(
                plain_text(name), place, xytext=(6, 6), textcoords="offset points", annotation_clip=True, zorder=7,
                fontsize=8 if len(names) <= FEW else 6,
                bbox={"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "pad": 0.8},
            )  # fmt: skip


def scale_axis(ax: Axes, *values: np.ndarray) -> None:
    """Set the limits of a forest about values in scales; far ones make the axis logarithmic beyond a few scales."""
    known = np.concatenate([[-1.0, 1.0], *values])
    low, high = np.nanmin(known), np.nanmax(known)
    if max(-low, high) > LINEAR:
        ax.set_xscale("symlog", linthresh=3.0)
        ax.xaxis.set_major_formatter("{x:g}")
        ax.set_xlim(1.5 * low, 1.5 * high)
    else:
        margin = 0.04 * (high - low)
        ax.set_xlim(low - margin, high + margin)


def most_first(size: np.ndarray) -> np.ndarray:
    """Rows of a forest in their order: all, or those of largest size where there are too many."""
    return np.sort(np.argsort(-size, kind="stable")[:ROWS])


def write_figure(figure: Figure, path: AnyPath, dpi: float) -> None:
    """Write a figure in one step, in the format that the name ends with."""
    sheet = io.BytesIO()
    figure.savefig(sheet, format=Path(path).suffix.removeprefix(".") or "png", dpi=dpi)
    write_whole(path, sheet.getvalue())


def figure_of(ax: Axes) -> Figure:
    """The whole figure that some axes belong to."""
    figure = ax.get_figure(root=True)
    assert figure is not None
    return figure


def colour(k: int) -> str:
    """Colour number k, in turn."""
    return COLOURS[k % len(COLOURS)]


def plain_text(text: object, longest: int = 40) -> str:
    """Text that matplotlib shows as it stands: no formula, no hidden legend entry, not too long."""
    text = str(text).replace("\n", " ")
    text = text if len(text) <= longest else text[: longest // 2] + "..." + text[-longest // 2 + 3 :]
    return (" " if text.startswith("_") else "") + text.replace("$", r"\$")


def probability(tree: xr.DataTree) -> float:
    """Probability of the intervals of a fit."""
    return float(tree.attrs.get("interval_probability", INTERVAL))


def ellipse_patch(centre: np.ndarray, covariance: np.ndarray, probability: float, **style: Any) -> Ellipse:
    """Ellipse that holds a probability of a Gaussian in the plane, covariance (2, 2)."""
    width, height, angle = ellipse(covariance, probability)
    return Ellipse(tuple(centre), width, height, angle=float(np.degrees(angle)), **style)
