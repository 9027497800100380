"""What the commands write: tables in one step, the report."""

import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from probcal.files import write_whole

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


def write_csv(frame: "pd.DataFrame", path: Path) -> None:
    """Write a table in one step."""
    from probcal.table import csv_text  # it loads jax, and the options are checked before

    write_whole(path, csv_text(frame))


def can_plot() -> bool:
    """Whether the plot packages, an extra, are there."""
    return all(importlib.util.find_spec(name) is not None for name in ("bokeh", "jinja2", "matplotlib"))


def report_of(tree: "xr.DataTree", out: Path, *, static: bool = False) -> Path:
    """Write the report.html of a fit."""
    from probcal.report import write_report  # the plot packages are an extra

    return write_report(tree, out / "report.html", static=static)


def say_written(files: Sequence[Path]) -> None:
    """Print what was written."""
    print(f"written: {', '.join(str(path) for path in files)}")
