"""What a truth says of a saved fit: position and bias error, coverage."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from probcal.labels import AXES
from probcal.results.read import each_track

if TYPE_CHECKING:
    import xarray as xr

    from probcal.simulate import Truth


def position_rmse(tree: xr.DataTree, truth: Truth) -> tuple[float, float] | None:
    """Root mean square position error in m without and with calibration, over the epochs that the truth covers."""
    squares = []
    for name, track in each_track(tree):
        axes = [f"position_{axis}" for axis in AXES if f"position_{axis}" in track["component"].values]
        times = track["time"].values
        true = truth.positions(times, np.full(len(times), name), len(axes))
        both = [track[kind].sel(component=axes).values for kind in ("before", "mean")]
        known = np.isfinite(true).all(1)
        squares.append([((value - true)[known] ** 2).sum(1) for value in both])
    before, after = (np.concatenate([s[k] for s in squares]) for k in (0, 1))
    return (float(np.sqrt(before.mean())), float(np.sqrt(after.mean()))) if len(before) else None


def scores(tree: xr.DataTree, truth: Truth) -> dict[str, float]:
    """Scores by name: position RMSE before and after, normalised bias RMSE and coverage of the intervals.

    >>> bool(scores(tree, run.truth)["position_rmse_after"] < 1.0)
    True
    """
    found: dict[str, float] = {}
    positions = position_rmse(tree, truth)
    if positions is not None:
        found |= {"position_rmse_before": positions[0], "position_rmse_after": positions[1]}
    if "calibration" in tree.children and truth.biases:
        group = tree["calibration"].to_dataset()
        known = [str(label) for label in group["bias_label"].values if str(label) in truth.biases]
        if known:
            chosen = group.sel(bias_label=known)
            true = np.array([truth.biases[label] for label in known])
            error = (chosen["mean"].values - true) / chosen["scale"].values
            inside = (chosen["lower"].values <= true) & (true <= chosen["upper"].values)
            found |= {"bias_rmse": float(np.sqrt(np.mean(error**2))), "coverage": float(inside.mean())}
    return found
