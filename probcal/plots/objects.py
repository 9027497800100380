"""Pictures of objects that nobody named: how surely each exists over time, and how many there are."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from probcal.errors import InputError
from probcal.plots.base import ALL_POINTS, LISTED, SURE, colour, finish, plain_text
from probcal.plots.scene import THERE


def plot_objects(tree: xr.DataTree, axes: Sequence[Axes] | None = None) -> list[Axes]:
    """Draw the existence of every object over time, one line each, and below it how many there are: two axes.

    The mean number is the sum of all existences at a time, beside it the number of those above one half. Raises
    `InputError` for a tree whose data named their targets.
    """
    if "object" not in tree.children:
        raise InputError("plot_objects: the tree has no group object; give a result of detections that name no target")
    frame = tree["object"].to_dataset().to_dataframe()[["time", "track", "existence"]]
    frame = frame.drop_duplicates(["track", "time"], keep="last")  # of sensors that look at one time, after the last
    if axes is None:
        figure = Figure(figsize=(9.0, 4.8), layout="constrained")
        axes = list(figure.subplots(2, 1, sharex=True, height_ratios=(3, 2)))
    above, below = axes
    names = frame["track"].unique()
    step = max(1, len(frame) // ALL_POINTS + 1)
    for k, (name, own) in enumerate(frame.groupby("track", sort=False)):
        label = plain_text(name) if len(names) <= LISTED else None
        above.plot(own["time"][::step], own["existence"][::step], color=colour(k), linewidth=1.1, label=label)
    title = f"Existence of {len(names)} object{'' if len(names) == 1 else 's'} over time"
    finish(above, title, key=0 < len(names) <= LISTED, ylim=(-0.03, 1.03), ylabel="existence")
    time, mean, count = counted(frame)
    below.plot(time, mean, color="0.55", linewidth=1.0, drawstyle="steps-post", label="mean number")
    below.plot(time, count, color=SURE, linewidth=1.3, drawstyle="steps-post", label=f"existence above {THERE}")
    below.yaxis.set_major_locator(MaxNLocator(integer=True))
    highest = max([1.0, *mean, *count]) + 0.5
    return [above, finish(below, "", xlabel="time in s", ylabel="objects", ylim=(0.0, highest))]


def counted(frame: pd.DataFrame) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times (K,) at which some object was looked for, the sum of the existences there, and how many lie above half."""
    there = frame.assign(there=frame["existence"] > THERE).groupby("time")[["existence", "there"]].sum()
    return there.index.to_numpy(float), there["existence"].to_numpy(float), there["there"].to_numpy(int)
