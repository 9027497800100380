"""`study`: fit many simulated runs of a model's setting(run, ...) by several methods, and plot their errors."""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from probcal.cli.files import can_plot, say_written, write_csv
from probcal.cli.kernels import keep_kernels
from probcal.cli.models import call, load_model
from probcal.cli.progress import bar
from probcal.diagnostics import grid_of, study_table
from probcal.files import Outputs
from probcal.inference import study
from probcal.inference.study import choose_methods
from probcal.results.io import save


def run(
    model: Path, grid: Mapping[str, list[Any]], methods: Sequence[str], *, runs: int, seed: int,
    outputs: Outputs | None, resume: bool, overwrite: bool,
) -> int:  # fmt: skip
    """Study: fit many simulated runs of a model's setting(run, ...) by several methods, and plot their errors."""
    keep_kernels()
    chosen = choose_methods(methods)
    module = load_model(model)
    began = time.perf_counter()
    if outputs is not None and overwrite:
        outputs.begin()
    with bar() as advance:
        found = study(
            lambda run, **point: call(module, model, "setting", run, **point),
            grid, chosen, runs=range(seed, seed + runs), progress=advance, resume=resume, overwrite=overwrite,
            store=None if outputs is None else outputs.folder / "runs",
        )  # fmt: skip
    table = study_table(found)
    print(table.to_string(index=False, float_format=lambda value: f"{value:.4g}"))
    print(f"{found['status'].size} fits in {time.perf_counter() - began:.1f} s")
    if outputs is not None:
        with outputs.writing(found.attrs["identity"]):
            write_csv(table, outputs.folder / "study.csv")
            save(xr.DataTree(found), outputs.folder / "study.nc")
            say_written(_files(found, outputs.folder))
    return 0


def _files(found: xr.Dataset, out: Path) -> list[Path]:
    """The files of a study, its picture drawn."""
    files = [out / "study.nc", out / "study.csv"]
    if can_plot() and any(np.issubdtype(found[name].dtype, np.number) for name in grid_of(found)):
        from probcal.plots import draw_study  # the plot packages are an extra

        draw_study(found, out / "study.png")
        files.append(out / "study.png")
    return files
