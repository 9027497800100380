"""`fit`: calibrate, print one row per bias and the verdict, write fit.nc, its tables, network.csv and report.html."""

import importlib
import signal
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import xarray as xr

from probcal.cli.files import can_plot, formatted, printed_rows, report_of, say_findings, say_written, write_csv
from probcal.cli.models import load_problem, load_truth, note_network, on_network, prior_named
from probcal.cli.progress import shown
from probcal.errors import InputError
from probcal.files import Outputs
from probcal.inference import METHODS, calibrate
from probcal.inference.finish import judged_problem
from probcal.inference.manifest import remove_run
from probcal.inference.progress import Monitor
from probcal.inference.widen import judge_fit
from probcal.network import Network
from probcal.nodes import write_network
from probcal.results.alignment import KINDS
from probcal.results.io import save
from probcal.results.modes import started
from probcal.results.read import outliers, summary, with_calibration
from probcal.status import INVALID, Status

FINDINGS = 8  # sentences of an assessment that are printed
FORMS = {  # of the columns of numbers in the table of biases
    **dict.fromkeys(("scale", "mean", "sd", "lower", "upper"), "{:.4g}"),
    **dict.fromkeys(("gamma", "inclusion", "r_hat"), "{:.3f}"),
    "ess": "{:.0f}",
}
ENDING = (signal.SIGINT, signal.SIGTERM)  # signals that end a fit with the best answer so far
LONG = 60.0  # s of a fit that is written before it is assessed


def run(
    model: Path, data: Path | None, *, outputs: Outputs | None, resume: bool, overwrite: bool, limit: float | None,
    **options: Any,
) -> int:  # fmt: skip
    """Calibrate: one row a bias, and where the truth is known the position error before and after."""
    drawn = ["probcal.report.page", "probcal.report.chart"] if outputs is not None and can_plot() else []

    # import modules that are needed later while kernels compile; what fails to load fails where
    # it is needed
    def load() -> None:
        for name in drawn:
            with suppress(ImportError):
                importlib.import_module(name)

    threading.Thread(target=load, daemon=True).start()
    began = time.perf_counter()
    with shown() as progress:
        monitor = Monitor(progress, limit, signals=ENDING)
        tree, network = calibrated(
            model, data, outputs=outputs, resume=resume, overwrite=overwrite, monitor=monitor, **options
        )  # fmt: skip
    # the table of biases as printed: label, unit, scale, mean, sd, interval, gamma, status, verdict
    frame = summary(tree)
    whole = len(frame)
    frame = printed_rows(frame, -(frame["mean"] / frame["sd"]).abs()).sort_index()
    columns = [name for name in ("bias", "unit", *FORMS, "status", "verdict") if name in frame]
    listed = formatted(frame[columns], FORMS).to_string(index=False, justify="right")
    left_out = f"\n{len(frame)} of {whole} biases, those that are surest not to be zero"
    print(listed + left_out * (len(frame) < whole))
    _print_verdict(tree, time.perf_counter() - began)
    if outputs is not None:
        say_written(written(tree, network, outputs))
        if not can_plot():
            print('report.html is left out: pip install "probcal[plot]"')
    if monitor.signal:
        return 128 + monitor.signal
    return 0 if Status(tree.attrs["status"]).settled else 1


def calibrated(
    model: Path, data: Path | None, *, method: str, prior: Sequence[str], fix: Sequence[str], given: Mapping[str, Any],
    starts: int, seed: int, outputs: Outputs | None, sizes: Mapping[str, int], resume: bool, overwrite: bool,
    kept: Sequence[str], assessed: bool, epoch: float | None = None, align: str | None = None,
    monitor: Monitor | None = None, limit: float | None = None, module: ModuleType | None = None,
    network: Path | None = None,
) -> tuple[xr.DataTree, Network]:  # fmt: skip
    """The tree of a fit, assessed and scored, and its network; `module` is the model file where it is loaded already.

    `network` is the file of a calibrated network that replaces the one of the model.
    """
    known, implied = METHODS[method]
    value: Any = known
    for option in sizes:
        if option not in value.__dataclass_fields__:
            raise InputError(f'--{option} is not for the method "{method}"; leave it out, or take mcmc')
    value = replace(value, **sizes) if sizes else value
    began, monitor = time.perf_counter(), Monitor(limit=limit, signals=()) if monitor is None else monitor
    monitor.enter("start", value.name)
    module, declared = load_problem(model, data, fix, given, epoch, module)
    problem = on_network(declared, network)
    chosen = prior_named(module, value, implied, prior)
    truth = load_truth(module, model, data, problem, given, declared.network)
    if align is not None and truth is None:
        raise InputError(f"--align {align}: there is no truth to lay the answer on; put one beside the data")
    store = None if outputs is None else outputs.folder / "draws"
    if outputs is not None and overwrite:
        outputs.begin()
    tree, answer = calibrate(
        problem, value, prior=chosen, key=seed, starts=starts, monitor=monitor, save=kept, store=store,
        resume=resume, overwrite=overwrite,
    )  # fmt: skip
    judged = judged_problem(problem, answer)
    if assessed and judged is not None and not monitor.signal:
        from probcal.analysis import assess

        monitor.enter("checks")
        with _safe(tree, outputs, time.perf_counter() - began > LONG), monitor.leaving():
            near = truth if align is None else None  # of a truth in another frame no NEES
            tree = assess(judged, tree, truth=near, key=seed)
    elif judged is not None and not monitor.signal:
        tree = judge_fit(judged, tree)
    if monitor.signal:
        tree.attrs["interrupted"] = 1
        if assessed:
            unchecked = "The checks are missing, since the fit was interrupted."
            tree.attrs["message"] = f"{tree.attrs['message']} {unchecked}".strip()
    tree.attrs["model"] = model.stem
    if given:
        tree.attrs["set"] = ", ".join(f"{name}={value}" for name, value in given.items())
    if truth is not None:
        from probcal.results.scores import add_scores

        with _safe(tree, outputs, False):
            add_scores(tree, truth, align=align)
    return note_network(tree, network), problem.network


def written(tree: xr.DataTree, network: Network, outputs: Outputs) -> list[Path]:
    """Write the files of a fit; the draws that it streamed are in them now and go."""
    with outputs.writing(tree.attrs["identity"]):
        files = _write(tree, network, outputs)
    if not tree.attrs.get("interrupted", 0):
        remove_run(outputs.folder / "draws", tree.attrs["identity"])
    return files


@contextmanager
def _safe(tree: xr.DataTree, outputs: Outputs | None, long: bool) -> Iterator[None]:
    """Keeps a fit safe: writes it first where it took long, else if its assessment fails."""
    written = False

    def write() -> None:
        if outputs is not None and not written:
            outputs.begin()
            save(tree, outputs.folder / "fit.nc")

    if long:
        write()
        written = True
    try:
        yield
    except BaseException:
        write()
        raise


def _print_verdict(tree: xr.DataTree, seconds: float) -> None:
    attrs = tree.attrs
    work = f"{tree['optimisation'].sizes['iteration']} iterations" if "optimisation" in tree.children else (
        f"{tree['posterior'].sizes['chain']} x {tree['posterior'].sizes['draw']} draws"
    )  # fmt: skip
    print(f"{attrs['method']} ({attrs['prior']}): {attrs['status']} after {work}, {seconds:.1f} s")
    print(f"intervals are {attrs['interval_probability']:.0%}; {attrs['intervals']}")
    if "epoch" in attrs:
        print(f"rows at epochs of {attrs['epoch']:g} s, shifted by {attrs['epoch_shift']:.3g} s at most")
    if "level" in tree.children:
        for label, std in tree["level"].to_dataset()["std"].to_series().items():
            print(f"estimated {label} = {std:.4g}")
    listed = outliers(tree)
    if len(listed):
        total = tree["residual"].sizes["datum"]
        first = listed.iloc[0]
        print(f"{len(listed)} of {total} data count less than half; the least: row {first['row']}, {first['sensor']}")
    if (optima := started(tree)) is not None:
        pairs = zip(*(optima[name].values for name in ("start", "status", "objective")), strict=True)
        listed_ = ", ".join(f"{k}: {value:.2f} ({status})" for k, status, value in pairs)
        print(f"{optima.attrs['objective']} by start: {listed_}")
    for suffix, how in (("", ""), *((f"_{kind}", f", {kind} alignment") for kind in KINDS)):
        if f"position_rmse_after{suffix}" in attrs:
            before, after = (attrs[f"position_rmse_{when}{suffix}"] for when in ("before", "after"))
            print(f"position RMSE before {before:.3f} m, after {after:.3f} m{how}")
    say_findings(tree, FINDINGS, "(group finding of fit.nc, report.html)")
    if attrs["message"]:
        print(attrs["message"], file=sys.stdout if Status(attrs["status"]).settled else sys.stderr)


def _write(tree: xr.DataTree, network: Network, outputs: Outputs) -> list[Path]:
    out = outputs.folder
    save(tree, out / "fit.nc")
    files = [out / "fit.nc", out / "summary.csv"]
    write_csv(summary(tree), files[1])
    if (tree["residual"]["weight"] < 1).any():  # some noise has heavy tails
        files.append(out / "outliers.csv")
        write_csv(outliers(tree), files[2])
    else:
        outputs.remove("outliers.csv")  # of an earlier fit
    if tree.attrs["status"] in INVALID:
        outputs.remove("network.csv")
    else:
        files.append(write_network(out / "network.csv", with_calibration(network, tree)))
    if can_plot():
        files.append(report_of(tree, out))
    return files
