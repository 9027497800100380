"""What a truth says of a saved fit or study: position and bias error, coverage; tables of studies, comparisons."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
import xarray as xr

from probcal.labels import AXES, step_of
from probcal.status import Status

if TYPE_CHECKING:
    from probcal.simulate import Truth


def position_rmse(tree: xr.DataTree, truth: Truth) -> tuple[float, float] | None:
    """Root mean square position error in m without and with calibration, over the epochs that the truth covers."""
    track = tree["track"].to_dataset()
    squares = []
    for name in (n for n in track.data_vars if str(n).startswith("mean")):
        s = str(name).removeprefix("mean")
        axes = [f"position_{axis}" for axis in AXES if f"position_{axis}" in track[f"component{s}"].values]
        true = truth.positions(track[f"epoch_time{s}"].values, track[f"epoch_target{s}"].values, len(axes))
        both = [track[f"{kind}{s}"].sel({f"component{s}": axes}).values for kind in ("before", "mean")]
        known = np.isfinite(true).all(1)
        squares.append([((value - true)[known] ** 2).sum(1) for value in both])
    before, after = (np.concatenate([s[k] for s in squares]) for k in (0, 1))
    return (float(np.sqrt(before.mean())), float(np.sqrt(after.mean()))) if len(before) else None


def scores(tree: xr.DataTree, truth: Truth) -> dict[str, float]:
    """Scores by name: position RMSE before and after, normalised bias RMSE and coverage of the intervals."""
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


def grid_of(study: xr.Dataset) -> list[str]:
    """Names of the settings of a study."""
    return [str(name) for name in study["bias_rmse"].dims if name not in ("estimator", "run")]


def study_table(study: xr.Dataset) -> pd.DataFrame:
    """One row a setting and method: mean, sd, median and worst bias error, position error, coverage, statuses."""
    frame = study[[name for name in study.data_vars if "bias_label" not in study[name].dims]].to_dataframe()
    groups = frame.reset_index().groupby([*grid_of(study), "estimator"], sort=False)
    table = groups["bias_rmse"].agg(mean="mean", sd="std", median="median", worst="max")
    if "position_rmse" in frame:
        table["position"] = groups["position_rmse"].mean()
    table["coverage"] = groups["coverage"].mean()
    there = study["true"] != 0
    inside = ((study["lower"] <= 0) & (study["upper"] >= 0)).where(there)
    if bool(there.any()) and not bool(there.all()):
        table["of non-zero"] = inside.mean(["run", "bias_label"]).to_series().reindex(table.index)
    table["runs"] = groups.size()
    for status in map(str, Status):
        frame[status] = frame["status"] == status
        table[status] = frame.reset_index().groupby([*grid_of(study), "estimator"], sort=False)[status].sum()
    return table.reset_index().rename(columns={"estimator": "method"}).dropna(axis=1, how="all")  # no sd of one run


def drift_table(tree: xr.DataTree) -> pd.DataFrame:
    """Values of the drifting biases of a fit, one row a piece: bias, unit, since (s), mean, sd, lower, upper.

    A value is the bias and its steps so far, fixed ones included; mean and sd are exact sums, the interval is of the
    draws. The first piece begins with the first datum, steps before it are in its value. Empty where nothing drifts.
    """
    columns = ["bias", "unit", "since", "mean", "sd", "lower", "upper"]
    if not {"calibration", "posterior"} <= set(tree.children):
        return pd.DataFrame(columns=columns)
    group, draws = tree["calibration"].to_dataset(), tree["posterior"].to_dataset()["bias"].values
    labels = group["bias_label"].values.astype(str).tolist()
    constant = tree["constant_data"].to_dataset()
    fixed = {str(k): float(v) for k, v in constant["fixed"].to_series().items()} if "fixed" in constant else {}
    every = [*labels, *fixed]
    units = dict(zip(labels, group["unit"].values, strict=True))
    mean, covariance = group["mean"].values, group["covariance"].values
    start = float(tree["observed_data"].to_dataset()["time"].min())
    tail = (1 - tree.attrs["interval_probability"]) / 2
    steps: dict[str, list[tuple[float, str]]] = {}
    for label in every:
        step = step_of(label, every)
        if step is not None:
            steps.setdefault(step[0], []).append((step[1], label))
    table = []
    for name, own in steps.items():
        known = [label for label in (name, *(label for _, label in own)) if label in units]
        if not known:
            continue
        for since in sorted({max(time, start) for time, _ in own} | {start}):
            so_far = [name, *(label for time, label in own if time <= since)]
            members = [labels.index(label) for label in so_far if label in units]
            held = sum(fixed.get(label, 0.0) for label in so_far)
            lower, upper = held + np.quantile(draws[..., members].sum(-1), [tail, 1 - tail])
            sd = np.sqrt(covariance[np.ix_(members, members)].sum())
            table.append((name, units[known[0]], since, held + mean[members].sum(), sd, lower, upper))
    return pd.DataFrame(table, columns=columns)


def comparison_rows(comparison: xr.DataTree) -> pd.DataFrame:
    """A comparison as a long table: method, other, bias, quantity, value; other and bias may be empty."""
    estimate = comparison["estimate"].to_dataset()
    columns = ["method", "other", "bias", "quantity", "value"]
    parts = [estimate[[n for n in estimate.data_vars if n != "status"]].drop_vars(["unit", "scale"])]
    parts[0] = parts[0].rename(estimator="method")
    parts.append(comparison["pair"].to_dataset().rename(first="method", second="other"))
    for name in estimate["estimator"].values:
        parts.append(comparison[f"method/{name}"].to_dataset().assign_coords(method=str(name)))
    frames = []
    for part in parts:
        frame = part.to_dataframe().reset_index().rename(columns={"bias_label": "bias"})
        frame = frame.assign(**{key: "" for key in ("other",) if key not in frame})
        frames.append(frame.melt(columns[:3], [str(n) for n in part.data_vars], "quantity"))
        totals = [(key, value) for key, value in part.attrs.items() if isinstance(value, (int, float, np.number))]
        if totals:
            rows = [[str(part["method"].item()), "", "", key, float(value)] for key, value in totals]
            frames.append(pd.DataFrame(rows, columns=columns))
    return pd.concat(frames, ignore_index=True)[columns]
