"""`track`: tracks of other data with a calibration applied."""

from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr

from probcal.cli.files import write_csv
from probcal.cli.kernels import keep_kernels
from probcal.cli.models import load_problem, load_truth
from probcal.diagnostics import scores
from probcal.errors import InputError
from probcal.files import Outputs
from probcal.inference import track
from probcal.results.io import load
from probcal.status import INVALID


def run(model: Path, data: Path | None, calibration: Path, outputs: Outputs) -> int:
    """Tracks of other data with a calibration applied: time, target, each state component with its sd."""
    known = load(calibration)
    if known.attrs.get("status") in INVALID:
        raise InputError(
            f"{calibration}: the fit ended {known.attrs['status']}, its estimate is invalid; fit again first"
        )
    keep_kernels()
    module, problem = load_problem(model, data)
    truth = load_truth(module, model, data, problem)
    tree = track(problem, known)
    frame = track_table(tree)
    out = outputs.folder / outputs.names[0]
    with outputs.writing():
        write_csv(frame, out)
    found = scores(tree, truth) if truth is not None else {}
    if "position_rmse_after" in found:
        print(f"position RMSE before {found['position_rmse_before']:.3f} m, after {found['position_rmse_after']:.3f} m")
    print(f"written: {out} ({len(frame)} epochs)")
    return 0


def track_table(tree: xr.DataTree) -> pd.DataFrame:
    """Tracks as a table: time, target, then each component and its sd."""
    group, parts = tree["track"].to_dataset(), []
    for name in (str(n) for n in group.data_vars if str(n).startswith("mean")):
        s = name.removeprefix("mean")
        columns: dict[str, np.ndarray] = {
            "time": group[f"epoch_time{s}"].values,
            "target": group[f"epoch_target{s}"].values,
        }
        for component in group[f"component{s}"].values:
            columns[str(component)] = group[name].sel({f"component{s}": component}).values
            columns[f"{component}_sd"] = group[f"sd{s}"].sel({f"component{s}": component}).values
        parts.append(pd.DataFrame(columns))
    return pd.concat(parts, ignore_index=True)
