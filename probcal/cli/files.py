"""What the commands write: folders checked before any work, tables in one step, the report."""

import importlib.util
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from probcal.errors import InputError
from probcal.files import write_whole

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """An `InputError` where a disk is full or a folder cannot be written."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror}") from None


def write_csv(frame: "pd.DataFrame", path: Path) -> None:
    """Write a table in one step."""
    write_whole(path, frame.to_csv(index=False))


def can_plot() -> bool:
    """Whether the plot packages, an extra, are there."""
    return all(importlib.util.find_spec(name) is not None for name in ("matplotlib", "jinja2"))


def report_of(tree: "xr.DataTree", out: Path) -> Path:
    """Write the report.html of a fit."""
    from probcal.report import write_report  # the plot packages are an extra

    path = out / "report.html"
    with writing(path):
        write_report(tree, path)
    return path


def say_written(files: Sequence[Path]) -> None:
    """Print what was written."""
    print(f"written: {', '.join(str(path) for path in files)}")
