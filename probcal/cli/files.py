"""The output files of the commands: tables in one step, the report."""

import importlib.util
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from probcal.files import Outputs, write_whole
from probcal.lazy import pd, xr

MANY = 400  # biases up to which all are printed
SHOWN = 40  # biases that are printed of more


def write_csv(frame: "pd.DataFrame", path: Path) -> None:
    """Write a table in one step."""
    from probcal.table import csv_text  # it loads jax, and the options are checked before

    write_whole(path, csv_text(frame))


def can_plot() -> bool:
    """True if the plot packages, an extra, are there."""
    return all(importlib.util.find_spec(name) is not None for name in ("bokeh", "jinja2", "matplotlib"))


def report_of(tree: "xr.DataTree", out: Path, *, static: bool = False) -> Path:
    """Write the report.html of a fit."""
    from probcal.report import write_report  # the plot packages are an extra

    return write_report(tree, out / "report.html", static=static)


def formatted(frame: "pd.DataFrame", forms: Mapping[str, str]) -> "pd.DataFrame":
    """A table with the numbers of some columns as texts, those that it has."""
    texts = {name: frame[name].map(form.format) for name, form in forms.items() if name in frame}
    return frame.assign(**texts)


def printed_rows(frame: "pd.DataFrame", order: "pd.Series") -> "pd.DataFrame":
    """A table as it is; of more than `MANY` rows those that come first in an order, one number per row."""
    return frame if len(frame) <= MANY else frame.loc[order.sort_values(kind="stable").index[:SHOWN]]


def write_result(
    outputs: Outputs, tree: "xr.DataTree", frame: "pd.DataFrame", draw: Callable[[Path], None] | None, run: str = ""
) -> None:
    """Write the NAME.nc, NAME.csv and, where it can be drawn, NAME.png of a result, and print what was written."""
    from probcal.results.io import save  # it loads xarray

    result, table, picture = (outputs.folder / name for name in outputs.names)
    files = [result, table]
    with outputs.writing(run):
        save(tree, result)
        write_csv(frame, table)
        if draw is not None and can_plot():
            draw(picture)
            files.append(picture)
        say_written(files)


def say_findings(tree: "xr.DataTree", most: int | None = None, where: str = "") -> None:
    """Print the sentences of a result, all or the first, and where the others are; nothing where it has none."""
    from probcal.results.read import listed_in  # it loads xarray

    sentences = listed_in(tree, "finding", "sentence")
    shown = sentences[:most]
    left = len(sentences) - len(shown)
    for sentence in [*shown, *([f"and {left} more {where}"] if left else [])]:
        print(f"- {sentence}")


def say_written(files: Sequence[Path]) -> None:
    """Print what was written."""
    print(f"written: {', '.join(str(path) for path in files)}")
