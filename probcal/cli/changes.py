"""`changes`: what moved between two recordings of one network."""

from collections.abc import Sequence
from pathlib import Path

import pandas as pd
import xarray as xr

from probcal import plots
from probcal.analysis import changes
from probcal.cli.files import say_findings, write_result
from probcal.files import Outputs
from probcal.results.io import load
from probcal.results.read import frame_of

COLUMNS = ("unit", "scale", "first", "second", "change", "sd", "lower", "upper", "t", "verdict")


def run(first: Path, second: Path, names: Sequence[str] | None, outputs: Outputs | None) -> int:
    """Reports the changes between two recordings: a row per bias, second less first, and
    findings."""
    found = changes(load(first), load(second), names=names or ("first", "second"))
    frame = rows_of(found)
    print(frame.to_string(index=False, justify="right", float_format=lambda value: f"{value:.4g}"))
    say_findings(found)
    if outputs is not None:
        write_result(outputs, found, frame, lambda path: plots.draw_changes(found, path))
    return 0


def rows_of(found: xr.DataTree) -> pd.DataFrame:
    """One row a bias."""
    return frame_of(found, "change", *COLUMNS).rename_axis("bias").reset_index()
