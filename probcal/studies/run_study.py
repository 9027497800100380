"""`study`: fit many simulated runs of a model's setting(run, ...) by several methods, and plot their errors."""

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from probcal.cli.files import can_plot, say_written, write_csv
from probcal.cli.models import ModelFile
from probcal.cli.progress import shown
from probcal.diagnostics import grid_of, study_table
from probcal.errors import InputError
from probcal.files import Outputs
from probcal.inference.progress import OnProgress, Progress
from probcal.results.io import save
from probcal.studies.fits import load_study
from probcal.studies.study import choose_methods, study

PARTLY = 30.0  # s after which table and picture are made anew while fits go on
SHARE = 20.0  # times as long as they took, where that is longer


def run(
    model: Path, grid: Mapping[str, list[Any]], methods: Sequence[str], *, runs: int, seed: int,
    outputs: Outputs | None, resume: bool, overwrite: bool, scheduler: str | None = None,
) -> int:  # fmt: skip
    """Study: fit many simulated runs of a model's setting(run, ...) by several methods, and plot their errors."""
    chosen = choose_methods(methods)
    setting = ModelFile.of(model).setting
    began = time.perf_counter()
    if outputs is not None and overwrite:
        outputs.begin()
    with shown() as progress:
        found = study(
            setting, grid, chosen, runs=range(seed, seed + runs), resume=resume, overwrite=overwrite,
            store=None if outputs is None else outputs.folder / "runs", scheduler=scheduler,
            progress=progress if outputs is None else partly(outputs, progress),
        )  # fmt: skip
    table = study_table(found)
    print(table.to_string(index=False, float_format=lambda value: f"{value:.4g}"))
    print(f"{found['status'].size} fits in {time.perf_counter() - began:.1f} s")
    if outputs is not None:
        with outputs.writing(found.attrs["identity"]):
            save(xr.DataTree(found), outputs.folder / "study.nc")
            say_written([outputs.folder / "study.nc", *_drawn(found, outputs.folder)])
    return 0


def partly(outputs: Outputs, advance: OnProgress, clock: Callable[[], float] = time.monotonic) -> OnProgress:
    """Progress that now and then writes table and picture of the fits that are finished."""
    due = clock() + PARTLY

    def told(at: Progress) -> None:
        nonlocal due
        advance(at)
        began = clock()
        if at.done < at.total and began >= due:
            found = load_study(outputs.folder)
            try:
                with outputs.writing(found.attrs["identity"]):
                    _drawn(found, outputs.folder)
            except InputError:  # another has changed them meanwhile: the end of the study says so
                pass
            due = clock() + max(PARTLY, SHARE * (clock() - began))

    return told


def _drawn(found: xr.Dataset, out: Path) -> list[Path]:
    """Write table and picture of a study: the files."""
    files = [out / "study.csv"]
    write_csv(study_table(found), files[0])
    if can_plot() and any(np.issubdtype(found[name].dtype, np.number) for name in grid_of(found)):
        from probcal.plots import draw_study  # the plot packages are an extra

        draw_study(found, out / "study.png")
        files.append(out / "study.png")
    return files
