"""Tables of studies and comparisons."""

from __future__ import annotations

import numpy as np
import pandas as pd
import xarray as xr

from probcal.status import Status


def grid_of(study: xr.Dataset) -> list[str]:
    """Names of the settings of a study."""
    return [str(name) for name in study["bias_rmse"].dims if name not in ("estimator", "run")]


def study_table(study: xr.Dataset) -> pd.DataFrame:
    """One row a setting and method: mean, sd, median and worst bias error, position error, coverage, statuses.

    Fits that are not finished do not count.
    """
    frame = study[[name for name in study.data_vars if "bias_label" not in study[name].dims]].to_dataframe()
    frame = frame[frame["status"] != ""]
    groups = frame.reset_index().groupby([*grid_of(study), "estimator"], sort=False)
    table = groups["bias_rmse"].agg(mean="mean", sd="std", median="median", worst="max")
    if "position_rmse" in frame:
        table["position"] = groups["position_rmse"].mean()
    table["coverage"] = groups["coverage"].mean()
    there = (study["true"] != 0) & study["true"].notnull()
    inside = ((study["lower"] <= 0) & (study["upper"] >= 0)).where(there)
    if bool(there.any()) and not bool((there | study["true"].isnull()).all()):
        table["of non-zero"] = inside.mean(["run", "bias_label"]).to_series().reindex(table.index)
    table["runs"] = groups.size()
    ended = groups["status"].value_counts().unstack(fill_value=0)
    table = table.join(ended.reindex(columns=[str(status) for status in Status], fill_value=0))
    return table.reset_index().rename(columns={"estimator": "method"}).dropna(axis=1, how="all")  # no sd of one run


def comparison_rows(comparison: xr.DataTree) -> pd.DataFrame:
    """A comparison as a long table: method, other, bias, quantity, value; other and bias may be empty."""
    estimate = comparison["estimate"].to_dataset()
    columns = ["method", "other", "bias", "quantity", "value"]
    parts = [estimate.drop_vars(["status", "unit", "scale"]).rename(estimator="method")]
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
