"""What a truth says of a saved fit: position and bias error, coverage."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from probcal.labels import AXES
from probcal.results.alignment import align as laid_on
from probcal.results.read import each_track

if TYPE_CHECKING:
    import xarray as xr

    from probcal.simulate import Truth


def position_rmse(tree: xr.DataTree, truth: Truth, *, align: str | None = None) -> tuple[float, float] | None:
    """Root mean square position error in m without and with calibration, over the epochs that the truth covers.

    With `align` ("rigid", "similarity") each is first laid on the truth, which may live in another frame then.
    """
    pairs = []
    for name, track in each_track(tree):
        axes = [f"position_{axis}" for axis in AXES if f"position_{axis}" in track["component"].values]
        times = track["time"].values
        true = truth.positions(times, np.full(len(times), name), len(axes))
        known = np.isfinite(true).all(1)
        pairs.append([track[kind].sel(component=axes).values[known] for kind in ("before", "mean")] + [true[known]])
    before, after, true = (np.concatenate([part[k] for part in pairs]) for k in range(3))
    if not len(true):
        return None
    if align is not None:
        before, after = (laid_on(places, true, align)(places) for places in (before, after))
    first, second = (float(np.sqrt(((places - true) ** 2).sum(1).mean())) for places in (before, after))
    return first, second


def scores(tree: xr.DataTree, truth: Truth, *, align: str | None = None) -> dict[str, float]:
    """Scores by name: position RMSE before and after, normalised bias RMSE and coverage of the intervals.

    A truth whose tracks live in another frame is met by `align`, "rigid" or "similarity": the tracks are laid on it
    first, and the scores say so (`position_rmse_after_rigid`). Raises `InputError` for another kind.

    >>> bool(scores(tree, run.truth)["position_rmse_after"] < 1.0)
    True
    """
    found: dict[str, float] = {}
    positions, suffix = position_rmse(tree, truth, align=align), "" if align is None else f"_{align}"
    if positions is not None:
        found |= {f"position_rmse_before{suffix}": positions[0], f"position_rmse_after{suffix}": positions[1]}
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
