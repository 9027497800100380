"""What all pictures share: colours, limits, plain texts, axes without pyplot."""

import io
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from probcal.files import write_whole
from probcal.plots.scene import ellipse

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8a6d00", "#5d3a9b")
BEFORE = "#a6a6a6"
GAMMA = "viridis_r"  # light: prior only, dark: data only
PALE, FAINT, SURE = "#e0e0e0", "#b5b5b5", "#c2185b"  # an object that hardly exists: on white, on any; one that does
INTERVAL = 0.89  # probability of an interval where the tree does not say
POINTS = 3_000  # of one track
ALL_POINTS = 40_000  # of all tracks together
ROWS = 120  # biases in one forest
NAMED = 60  # nodes, targets or biases above which names are left out
LINEAR = 12.0  # scales up to which the axis of the forest stays linear


def new_axes(ax: Axes | None, width: float, height: float) -> Axes:
    """The axes given, or new ones of a size in inches."""
    return Figure(figsize=(width, height), layout="compressed").subplots() if ax is None else ax


def write_figure(figure: Figure, path: str | PathLike[str], dpi: float) -> None:
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


def ellipse_patch(centre: Sequence[float], covariance: np.ndarray, probability: float, **style: Any) -> Ellipse:
    """Ellipse that holds a probability of a Gaussian in the plane, covariance (2, 2)."""
    width, height, angle = ellipse(covariance, probability)
    return Ellipse((float(centre[0]), float(centre[1])), width, height, angle=float(np.degrees(angle)), **style)
