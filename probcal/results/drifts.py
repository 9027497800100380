"""The drifting biases of a saved fit, piece by piece."""

from __future__ import annotations

import numpy as np
import pandas as pd

from probcal.errors import checked
from probcal.labels import step_of
from probcal.lazy import xr
from probcal.results.blocks import SensorBlocks
from probcal.results.schema import held_biases


@checked
def drift_table(tree: xr.DataTree) -> pd.DataFrame:
    """Values of the drifting biases of a fit, one row a piece: bias, unit, since (s), mean, sd, lower, upper.

    A value is the bias and its steps so far, fixed ones included; mean and sd are exact sums, the interval is of the
    draws. The first piece begins with the first datum, steps before it are in its value. Empty where nothing drifts.

    >>> len(drift_table(tree))  # nothing drifts
    0
    """
    columns = ["bias", "unit", "since", "mean", "sd", "lower", "upper"]
    if not {"calibration", "posterior"} <= set(tree.children):
        return pd.DataFrame(columns=columns)
    group, draws = tree["calibration"].to_dataset(), tree["posterior"].to_dataset()["bias"]
    free, fixed = group["unit"].to_series(), held_biases(tree)
    every = [*free.index, *fixed]
    start = float(tree["observed_data"].to_dataset()["time"].min())
    tail = (1 - tree.attrs["interval_probability"]) / 2
    steps: dict[str, list[tuple[float, str]]] = {}
    for label in every:
        if (step := step_of(label, every)) is not None:
            steps.setdefault(step[0], []).append((step[1], label))
    table = []
    for name, own in steps.items():
        units = [free[label] for label in (name, *(label for _, label in own)) if label in free]
        for since in sorted({max(time, start) for time, _ in own} | {start}) if units else ():
            so_far = [name, *(label for time, label in own if time <= since)]
            names = [label for label in so_far if label in free]
            held = sum(fixed.get(label, 0.0) for label in so_far)
            mean = held + float(group["mean"].sel(bias_label=names).sum())
            lower, upper = held + draws.sel(bias_label=names).sum("bias_label").quantile([tail, 1 - tail]).values
            sd = np.sqrt(SensorBlocks.read(group, names, "drift_table").matrix().sum())
            table.append((name, units[0], since, mean, sd, lower, upper))
    return pd.DataFrame(table, columns=columns)
