"""`sbc`: a method checked on a model by simulation."""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from probcal import plots
from probcal.cli.files import write_result
from probcal.cli.models import load_problem, on_network, prior_named
from probcal.cli.progress import shown
from probcal.files import Outputs
from probcal.inference import METHODS
from probcal.priors import PRIORS
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
        write_result(outputs, tree, table, lambda path: plots.draw_sbc(tree, path), tree.attrs["identity"])
    return 0 if tree.attrs["status"] == "uniform" else 1
