"""The history of biases that `probcal watch` writes, with their intervals and the jumps that were found."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from probcal.errors import check_known
from probcal.files import AnyPath
from probcal.plots.base import BEFORE, SURE, colour, panels, plain_text, write_figure

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
        check_known(column, list(map(str, history)), f'plot_history: the history has no column "{column}"')
    last = history.drop_duplicates("bias", keep="last").set_index("bias")
    for label in labels or ():
        check_known(label, last.index, f'plot_history: no bias is called "{label}"')
    far = (last["mean"].abs() / last["sd"]).sort_values(ascending=False).index[:PANELS]
    chosen = list(labels) if labels else [label for label in last.index if label in set(far)]
    rows = -(-len(chosen) // COLUMNS)
    figure = Figure(figsize=(WIDTH, HEIGHT * rows), layout="constrained")
    axes = panels(figure, len(chosen), min(COLUMNS, len(chosen)), sharex=True)
    for k, (ax, label) in enumerate(zip(axes, chosen, strict=True)):
        own, unit = history[history["bias"] == label], str(last["unit"][label])
        time, mean, lower, upper = own[["time", "mean", "lower", "upper"]].to_numpy(float).T
        if unit == "rad":
            mean, lower, upper = np.rad2deg([mean, lower, upper])
        ax.axhline(0.0, color=BEFORE, linewidth=0.8)
        ax.fill_between(time, lower, upper, color=colour(k), alpha=0.25, linewidth=0)
        alone = np.ptp(time) == 0  # of one time no line is seen
        if alone:
            ax.vlines(time, lower, upper, color=colour(k), alpha=0.5, linewidth=3.0)
        ax.plot(time, mean, "o" if alone else "-", color=colour(k), linewidth=1.2)
        for _, jump in () if jumps is None else jumps[jumps["label"] == label].iterrows():
            ax.axvline(jump["since"], color=SURE, linewidth=0.8)
            ax.axvline(jump["found"], color=SURE, linewidth=0.8, linestyle=":")
        ax.set_title(plain_text(label, 34), fontsize=8)
        ax.set_ylabel({"1": "", "rad": "deg"}.get(unit, unit), fontsize=8)
        ax.tick_params(labelsize=7)
    figure.supxlabel("time, s", fontsize=9)
    return figure


def draw_history(history: pd.DataFrame, jumps: pd.DataFrame | None, path: AnyPath) -> None:
    """Write the picture of a history."""
    write_figure(plot_history(history, jumps=jumps), path, 130)
