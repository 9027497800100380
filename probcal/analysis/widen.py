"""Intervals widened where the innovations say that the noise is larger, or longer remembered, than the model has it."""

from __future__ import annotations

import numpy as np
import xarray as xr

from probcal.analysis import residuals
from probcal.analysis.findings import LAGGED, NOTABLE, PRACTICAL, Finding
from probcal.results.blocks import SensorBlocks
from probcal.status import Status

TOLD = 1.05  # times as wide, from which sds are widened
REJECTED = 1e-3  # probability of the NIS of all data, or of the whiteness of any channel, of a model that is wrong


def rejection(found: residuals.Innovations, channels: xr.Dataset) -> str:
    """Which test of the innovations rejects the model, in words; empty where none does."""
    total = residuals.squares(found, np.zeros(len(found.value), int), 1, 2 * REJECTED)
    if total.nis[0] > max(total.upper[0], PRACTICAL):
        return f"their mean square is {total.nis[0]:.2g} (limit {total.upper[0]:.2g})"
    lagged, notable = channels["autocorrelation"].values, np.maximum(NOTABLE, LAGGED / np.sqrt(channels["data"].values))
    red = (channels["white"].values < REJECTED / len(lagged)) & (lagged > notable)
    if red.any():
        worst = int(np.argmax(np.where(red, channels["autocorrelation"].values, -1.0)))
        name = ".".join(str(channels[part].values[worst]) for part in ("sensor", "channel"))
        return f"those of {name} follow each other ({channels['autocorrelation'].values[worst]:.2f})"
    return ""


def widened(tree: xr.DataTree, inflation: np.ndarray, reason: str) -> tuple[xr.DataTree, list[Finding]]:
    """A copy of a fit whose biases have the variance that the innovations call for, and the finding that says so.

    `inflation` (M,) is of the variance that comes from the data: a bias takes the share gamma of it. Mean and draws
    keep their place; sd, interval, covariance and the spread of the draws grow together, where some sd grows by the
    factor `TOLD`. A fit that is no answer, or was widened before, stays as it is.
    """
    result = tree.copy()
    if not reason or "widened" in tree.attrs or not Status(tree.attrs["status"]).valid:
        return result, []
    group = tree["calibration"].to_dataset()
    wide = np.sqrt(1.0 + group["gamma"].values * (inflation - 1.0))
    if wide.max() < TOLD:
        text = f"the innovations reject the model: {reason}"
        result.attrs |= {"message": f"{tree.attrs['message']} {text[0].upper()}{text[1:]}.".strip(), "widened": 1.0}
        return result, [Finding("widened", "fit", text)]
    mean = group["mean"].values
    ends = {name: mean + wide * (group[name].values - mean) for name in ("lower", "upper")}
    columns = {"sd": group["sd"].values * wide, **ends, "widened": wide}
    if "block" in group:
        scales = np.ones(len(wide))
        spread = SensorBlocks.read(group, group["bias_label"].values.tolist(), scales).widened(wide).columns(scales)
    else:
        spread = {"covariance": (group["covariance"].dims, group["covariance"].values * np.outer(wide, wide))}
    group = group.assign({name: ("bias_label", values) for name, values in columns.items()})
    result["calibration"] = xr.DataTree(group.assign(spread))
    draws = tree["posterior"].to_dataset()
    drawn = (draws["bias"] - draws["bias"].mean(("chain", "draw"))) * xr.DataArray(wide - 1.0, dims="bias_label")
    result["posterior"] = xr.DataTree(draws.assign(bias=draws["bias"] + drawn))
    text = (
        f"the innovations reject the model: {reason}; the sd of the biases are widened by up to {wide.max():.2g}"
        f" ({group['bias_label'].values[int(wide.argmax())]})"
    )
    result.attrs["widened"] = float(wide.max())
    result.attrs["message"] = f"{tree.attrs['message']} {text[0].upper()}{text[1:]}.".strip()
    return result, [Finding("widened", "fit", text)]
