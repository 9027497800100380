"""`changes`: what moved between two recordings of one network."""

from collections.abc import Sequence
from pathlib import Path

import pandas as pd
import xarray as xr

from probcal.analysis import changes
from probcal.cli.files import can_plot, say_written, write_csv
from probcal.files import Outputs
from probcal.results.io import load, save

COLUMNS = ("unit", "scale", "first", "second", "change", "sd", "lower", "upper", "t", "verdict")


def run(first: Path, second: Path, names: Sequence[str] | None, outputs: Outputs | None) -> int:
    """What moved between two recordings: one row a bias, second less first with its interval, and findings."""
    found = changes(load(first), load(second), names=names or ("first", "second"))
    frame = frame_of(found)
    print(frame.to_string(index=False, justify="right", float_format=lambda value: f"{value:.4g}"))
    for sentence in found["finding"].to_dataset()["sentence"].values:
        print(f"- {sentence}")
    if outputs is not None:
        with outputs.writing():
            _write(found, frame, outputs.folder)
    return 0


def frame_of(found: xr.DataTree) -> pd.DataFrame:
    """One row a bias."""
    frame = found["change"].to_dataset().to_dataframe().reset_index()
    return frame.rename(columns={"bias_label": "bias"})[["bias", *COLUMNS]]


def _write(found: xr.DataTree, frame: pd.DataFrame, out: Path) -> None:
    files = [out / "changes.nc", out / "changes.csv"]
    save(found, files[0])
    write_csv(frame, files[1])
    if can_plot():
        from probcal.plots import plot_changes  # the plot packages are an extra
        from probcal.plots.base import figure_of, write_figure

        files.append(out / "changes.png")
        write_figure(figure_of(plot_changes(found)), files[-1], dpi=120)
    say_written(files)
