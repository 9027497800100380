"""`sbc`: a method checked on a model by simulation."""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import xarray as xr

from probcal.cli.files import can_plot, say_written, write_csv
from probcal.cli.models import load_problem, on_network, prior_named
from probcal.cli.progress import shown
from probcal.files import Outputs
from probcal.inference import METHODS
from probcal.priors import PRIORS
from probcal.results.io import save
from probcal.studies.coverage import coverage_table
from probcal.studies.sbc import sbc, short


def run(
    model: Path, data: Path | None, *, method: str, prior: Sequence[str], truths: str | None, fix: Sequence[str],
    given: Mapping[str, Any], network: Path | None,
    runs: int, seed: int, posterior: bool, full: bool, outputs: Outputs | None,
    resume: bool, overwrite: bool, scheduler: str | None = None,
) -> int:  # fmt: skip
    """Check a method on a model by simulation: do its intervals hold the truth as often as they say?"""
    value, implied = METHODS[method]
    value = value if full else short(value)
    module, problem = load_problem(model, data, fix, given)
    problem = on_network(problem, network)
    chosen = prior_named(module, value, implied, prior)
    began = time.perf_counter()
    if outputs is not None and overwrite:
        outputs.begin()
    with shown() as progress:
        tree = sbc(
            problem, value, prior=chosen, runs=runs, simulate_from=PRIORS[truths] if truths is not None else None,
            around="data" if posterior else None, key=seed, progress=progress, resume=resume,
            overwrite=overwrite, scheduler=scheduler, store=None if outputs is None else outputs.folder / "runs",
        )  # fmt: skip
    tree.attrs["model"] = model.stem
    table = coverage_table(tree)
    print(table.to_string(index=False, float_format=lambda number: f"{number:.3f}"))
    counted = f"{tree.attrs['runs']} runs, truths from {tree.attrs['source']}"
    print(f"{tree.attrs['method']} ({tree.attrs['prior']}): {counted}, {time.perf_counter() - began:.1f} s")
    print(tree.attrs["verdict"])
    if tree.attrs["message"]:
        print(tree.attrs["message"])
    if outputs is not None:
        with outputs.writing(tree.attrs["identity"]):
            _write(tree, table, outputs.folder)
    return 0 if tree.attrs["status"] == "uniform" else 1


def _write(tree: xr.DataTree, table: pd.DataFrame, out: Path) -> None:
    files = [out / "sbc.nc", out / "sbc.csv"]
    save(tree, files[0])
    write_csv(table, files[1])
    if can_plot():
        from probcal.studies.plot_sbc import draw_sbc  # the plot packages are an extra

        files.append(out / "sbc.png")
        draw_sbc(tree, files[-1])
    say_written(files)
