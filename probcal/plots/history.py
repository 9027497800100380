"""The history of biases that `probcal watch` writes, with their intervals and the jumps that were found."""

from collections.abc import Sequence
from os import PathLike

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from probcal.errors import InputError, nearest
from probcal.plots.base import BEFORE, SURE, colour, plain_text, write_figure

COLUMNS, PANELS = 4, 24  # panels of a row, and at most
WIDTH, HEIGHT = 13.0, 2.2  # of the picture and of a row of panels, inches


def plot_history(
    history: pd.DataFrame, labels: Sequence[str] | None = None, jumps: pd.DataFrame | None = None
) -> Figure:
    """Draw each bias over the time of a stream, mean and 89 % interval, and where it jumped.

    `history` is the table biases.csv of `probcal watch` (time, bias, unit, mean, lower, upper), `jumps` its jumps.csv.
    At most 24 biases are drawn, those that end farthest from zero in their sds. Raises `InputError` for a column that
    is missing or a bias that is not there.

    >>> import pandas as pd
    >>> row = {"bias": "a.heading", "unit": "rad", "mean": 0.1, "sd": 0.1, "lower": 0.0, "upper": 0.2}
    >>> len(plot_history(pd.DataFrame([row | {"time": t} for t in (0.0, 1.0)])).axes)
    1
    """
    for column in ("time", "bias", "unit", "mean", "sd", "lower", "upper"):
        if column not in history:
            raise InputError(
                f'plot_history: the history has no column "{column}"{nearest(column, [str(name) for name in history])}'
            )
    last = history.drop_duplicates("bias", keep="last").set_index("bias")
    for label in labels or ():
        if label not in last.index:
            raise InputError(
                f'plot_history: no bias is called "{label}"{nearest(label, [str(name) for name in last.index])}'
            )
    far = (last["mean"].abs() / last["sd"]).sort_values(ascending=False).index[:PANELS]
    chosen = list(labels) if labels else [label for label in last.index if label in set(far)]
    rows = -(-len(chosen) // COLUMNS)
    figure = Figure(figsize=(WIDTH, HEIGHT * rows), layout="constrained")
    axes = list(figure.subplots(rows, min(COLUMNS, len(chosen)), squeeze=False, sharex=True).ravel())
    for spare in axes[len(chosen) :]:
        spare.remove()
    for k, (ax, label) in enumerate(zip(axes[: len(chosen)], chosen, strict=True)):
        own = history[history["bias"] == label]
        time = own["time"].to_numpy()
        size, unit = (np.rad2deg(1.0), "deg") if own["unit"].iloc[0] == "rad" else (1.0, str(own["unit"].iloc[0]))
        ax.axhline(0.0, color=BEFORE, linewidth=0.8)
        ax.fill_between(time, own["lower"] * size, own["upper"] * size, color=colour(k), alpha=0.25, linewidth=0)
        alone = np.ptp(time) == 0  # of one time no line is seen
        if alone:
            ax.vlines(time, own["lower"] * size, own["upper"] * size, color=colour(k), alpha=0.5, linewidth=3.0)
        ax.plot(time, own["mean"] * size, "o" if alone else "-", color=colour(k), linewidth=1.2)
        for _, jump in () if jumps is None else jumps[jumps["label"] == label].iterrows():
            ax.axvline(jump["since"], color=SURE, linewidth=0.8)
            ax.axvline(jump["found"], color=SURE, linewidth=0.8, linestyle=":")
        ax.set_title(plain_text(label, 34), fontsize=8)
        ax.set_ylabel("" if unit == "1" else unit, fontsize=8)
        ax.tick_params(labelsize=7)
    figure.supxlabel("time, s", fontsize=9)
    return figure


def draw_history(history: pd.DataFrame, jumps: pd.DataFrame | None, path: str | PathLike[str]) -> None:
    """Write the picture of a history."""
    write_figure(plot_history(history, jumps=jumps), path, 130)
