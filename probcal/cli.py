"""The command line: simulate, check, fit, track, study, compare, report.

Bad input ends with exit code 2, a fit that is no answer, or a problem that can have none, with 1.
"""

import importlib.util
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any

import jax
import numpy as np
import pandas as pd
import platformdirs
import typer
import xarray as xr
from rich.console import Console
from rich.progress import Progress as RichProgress

from probcal.analysis import assess, bound_map, compare, next_anchors, next_passes, next_sensors, observability
from probcal.analysis.compare import chosen_pair, named
from probcal.diagnostics import comparison_rows, grid_of, scores, study_table
from probcal.inference import METHODS, ORACLE, fit, study, track
from probcal.inference.coverage import coverage_table
from probcal.inference.run import Method, Progress
from probcal.inference.sampler import Sampler
from probcal.inference.sbc import sbc, short
from probcal.inference.study import choose_methods
from probcal.priors import PRIORS
from probcal.problem import Problem
from probcal.simulate import Simulation, Truth, truth_beside
from probcal.smoothing.start import automatic_start
from probcal.tree import add_scores, load, outliers, save, summary
from probcal.types import FitError, InputError, nearest

MAP_CELLS = 60  # of a bound map an axis

app = typer.Typer(
    help="Bayesian calibration of sensor networks from targets of opportunity.",
    no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False,
)  # fmt: skip

STATUS = {
    "determined": "status: determined",
    "weak": "status: weak: some directions are left to prior and survey by half or more",
    "open": "status: open: the data say next to nothing of some direction; a fit may be no answer (exit code 1)",
}
FINDINGS = 8  # sentences of an assessment that are printed

Model = Annotated[Path, typer.Argument(help="model file that defines problem(data=None)", show_default=False)]
Data = Annotated[Path | None, typer.Argument(help="table of rows (CSV); the model's own data if left out")]
Seed = Annotated[int, typer.Option(min=0, help="seed of everything random")]


def main() -> None:
    """Entry point: one sentence on stderr and exit code 2 for bad input, 1 for a fit that left no answer."""
    _keep_kernels()
    try:
        app()
    except InputError as error:
        _say(error)
        sys.exit(2)
    except FitError as error:
        _say(error)
        sys.exit(1)


def _keep_kernels() -> None:
    """Compiled kernels stay in the user's cache folder, the latest 1 GB; JAX_COMPILATION_CACHE_DIR names another."""
    if jax.config.jax_compilation_cache_dir:
        return
    folder = platformdirs.user_cache_path("probcal") / "kernels"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:  # a home that cannot be written: compile anew
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_compilation_cache_max_size", 10**9)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)


def _say(text: object) -> None:
    print(f"probcal: {text}", file=sys.stderr)


def load_model(path: Path) -> ModuleType:
    """Import a model file; raises `InputError` if it is missing or fails."""
    if not _exists(path) or not path.is_file():
        raise InputError(f"{path}: no such model file")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if path.suffix != ".py" or spec is None or spec.loader is None:
        raise InputError(f"{path} is not a Python file; a model file defines problem(data=None)")
    module = importlib.util.module_from_spec(spec)
    folder = str(path.parent.resolve())
    sys.path.insert(0, folder)
    try:
        with _told(f"{path.name} cannot be loaded:", f"{path.name}: "):
            spec.loader.exec_module(module)
    finally:
        if folder in sys.path:
            sys.path.remove(folder)
    return module


@contextmanager
def _told(what: str, prefix: str = "") -> Iterator[None]:
    """Whatever a user's file raises, `sys.exit()` included, becomes one sentence; Ctrl-C stays what it is."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{prefix}{error}") from None
    except (FitError, KeyboardInterrupt):
        raise
    except BaseException as error:
        try:
            reason = str(error)
        except Exception:  # an exception of the user's own that cannot be printed
            reason = "no text"
        raise InputError(f"{what} {type(error).__name__}: {reason}") from None


def _exists(path: Path) -> bool:
    """Whether a file or folder is there; a name that no file can have is not."""
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


def _call(module: ModuleType, path: Path, name: str, /, *arguments: Any, **options: Any) -> Any:
    """Call a function of a model file; its own failures become one sentence."""
    function = getattr(module, name, None)
    if not callable(function):
        raise InputError(
            f"{path.name} defines no {name}(); a model file defines problem(data=None) and, to simulate, scenario(key)"
        )
    with _told(f"{path.name}: {name}() failed with"):
        return function(*arguments, **options)


def _problem(model: Path, data: Path | None, fix: Sequence[str] | None = ()) -> tuple[ModuleType, Problem]:
    module = load_model(model)
    if data is not None and not _exists(data):
        raise InputError(f"{data}: no such file")
    problem = _call(module, model, "problem", data)
    if not isinstance(problem, Problem):
        raise InputError(
            f"{model.name}: problem() returned {type(problem).__name__}; return a probcal.Problem with a network"
        )
    if fix:
        problem = problem.rebuild(fix=problem.fixed | dict.fromkeys(fix, 0.0))
    return module, problem


def _truth(module: ModuleType, model: Path, data: Path | None, problem: Problem) -> Truth | None:
    """The truth beside the data, else the model's own; checked before a fit rather than at its scores."""
    truth = truth_beside(data) if data is not None else None
    if truth is None and hasattr(module, "truth"):
        truth = _call(module, model, "truth", data)
        if not isinstance(truth, Truth | None):
            raise InputError(f"{model.name}: truth() returned {type(truth).__name__}; return a probcal.Truth or None")
    if truth is not None:
        truth.positions(np.zeros(0), np.zeros(0, str), problem.network.dimension)
    return truth


@contextmanager
def _progress() -> Iterator[Progress | None]:
    """A line on a terminal that follows the iterations; nothing where stderr is a file."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield None
        return
    with console.status("starting: compiling, finding the tracks") as status:
        yield lambda method, count, value: status.update(f"{method}: iteration {count}, objective {value:.3f}")


def _folder(path: Path) -> Path:
    """Make a folder and check that it can be written, before any work is done."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror}") from None
    return path


def _write_csv(frame: pd.DataFrame, path: Path) -> None:
    """Write a table in one step."""
    draft = path.with_name(f".{path.name}.part")
    try:
        frame.to_csv(draft, index=False)
        os.replace(draft, path)
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror}") from None
    finally:
        draft.unlink(missing_ok=True)


def table_text(tree: xr.DataTree) -> str:
    """The table of biases as printed: label, unit, scale, mean, sd, interval, gamma, status, verdict."""
    frame = summary(tree)
    numbers = ["scale", "mean", "sd", "lower", "upper"]
    for name in numbers:
        frame[name] = [f"{value:.4g}" for value in frame[name]]
    frame["gamma"] = [f"{value:.3f}" for value in frame["gamma"]]
    mixed = [name for name in ("inclusion", "r_hat", "ess") if name in frame]
    for name in mixed:
        frame[name] = [f"{value:.0f}" if name == "ess" else f"{value:.3f}" for value in frame[name]]
    shown = frame[["bias", "unit", *numbers, "gamma", *mixed, "status", *(["verdict"] if "verdict" in frame else [])]]
    return shown.to_string(index=False, justify="right")


@app.command(name="fit")
def fit_command(
    model: Model,
    data: Data = None,
    method: Annotated[str, typer.Option(help=" | ".join(METHODS))] = "ea",
    prior: Annotated[
        str | None, typer.Option(help=" | ".join(PRIORS) + "; the model's or the method's own if left out")
    ] = None,
    fix: Annotated[list[str] | None, typer.Option(help="hold biases at 0, by label or pattern (repeat)")] = None,
    starts: Annotated[int, typer.Option(min=1, help="starts of the search; the best optimum is reported")] = 1,
    seed: Seed = 0,
    out: Annotated[Path | None, typer.Option(help="folder for fit.nc, summary.csv, report.html")] = None,
    chains: Annotated[int | None, typer.Option(min=1, help="chains of a sampler")] = None,
    draws: Annotated[int | None, typer.Option(min=1, help="draws of each chain after warm-up")] = None,
    warmup: Annotated[int | None, typer.Option(min=0, help="steps of each chain before its draws")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="go on with the stopped run of a sampler in --out")] = False,
    assessed: Annotated[
        bool, typer.Option("--assess/--no-assess", help="a verdict per bias, and what the residuals say")
    ] = True,
) -> None:
    """Calibrate: one row a bias, and where the truth is known the position error before and after."""
    if method not in METHODS:
        raise InputError(f'--method "{method}" is not known{nearest(method, METHODS)}')
    if prior is not None and prior not in PRIORS:
        raise InputError(f'--prior "{prior}" is not known{nearest(prior, PRIORS)}')
    value, implied = METHODS[method]
    value = _sized(value, method, {"chains": chains, "draws": draws, "warmup": warmup})
    if resume and out is None:
        raise InputError("--resume needs --out, the folder of the run to go on with")
    chosen: Any = PRIORS[prior] if prior is not None else implied
    if out is not None:
        _folder(out)
    began = time.perf_counter()
    module, problem = _problem(model, data, fix)
    own = getattr(module, "PRIOR", None)
    if chosen is None and own is not None and value.takes(own):
        chosen = own
    truth = _truth(module, model, data, problem)
    with _progress() as progress:
        tree = fit(
            problem, value, prior=chosen, key=seed, starts=starts, progress=progress,
            store=out / "draws" if out is not None else None, resume=resume,
        )  # fmt: skip
        if out is not None:
            save(tree, out / "fit.nc")  # what is found is safe whatever comes
            if "Interrupted" not in tree.attrs["message"]:
                shutil.rmtree(out / "draws", ignore_errors=True)  # they are in fit.nc now
        if assessed:
            tree = assess(problem, tree, truth=truth, key=seed)
    tree.attrs["model"] = model.stem
    if truth is not None:
        add_scores(tree, scores(tree, truth), truth.biases)
    print(table_text(tree))
    _print_verdict(tree, time.perf_counter() - began)
    if out is not None:
        _write(tree, out)
    raise typer.Exit(0 if tree.attrs["status"] == "converged" else 1)


def _sized(method: Method, name: str, sizes: dict[str, int | None]) -> Method:
    """The method with the numbers of chains and draws that the command line gives."""
    given = {option: number for option, number in sizes.items() if number is not None}
    if given and not isinstance(method, Sampler):
        raise InputError(f'--{next(iter(given))}: "{name}" draws no chains; take collapsed, nuts or svi')
    changed: Any = method
    return replace(changed, **given) if given else method


def _print_verdict(tree: xr.DataTree, seconds: float) -> None:
    attrs = tree.attrs
    work = f"{tree['optimisation'].sizes['iteration']} iterations" if "optimisation" in tree.children else (
        f"{tree['posterior'].sizes['chain']} x {tree['posterior'].sizes['draw']} draws"
    )  # fmt: skip
    print(f"{attrs['method']} ({attrs['prior']}): {attrs['status']} after {work}, {seconds:.1f} s")
    print(f"intervals are {attrs['interval_probability']:.0%}; {attrs['intervals']}")
    if "level" in tree.children:
        for label, std in tree["level"].to_dataset()["std"].to_series().items():
            print(f"estimated {label} = {std:.4g}")
    listed = outliers(tree)
    if len(listed):
        total = tree["residual"].sizes["datum"]
        first = listed.iloc[0]
        print(f"{len(listed)} of {total} data count less than half; the least: row {first['row']}, {first['sensor']}")
    if "optimum" in tree.children:
        optima = tree["optimum"].to_dataset()
        score = optima["log_evidence" if "log_evidence" in optima else "objective"]
        pairs = zip(optima["start"].values, optima["status"].values, score.values, strict=True)
        print(f"{score.name} by start: " + ", ".join(f"{k}: {value:.2f} ({status})" for k, status, value in pairs))
    if "position_rmse_after" in attrs:
        print(f"position RMSE before {attrs['position_rmse_before']:.3f} m, after {attrs['position_rmse_after']:.3f} m")
    _print_findings(tree)
    if attrs["message"]:
        print(attrs["message"], file=sys.stdout if attrs["status"] == "converged" else sys.stderr)


def _print_findings(tree: xr.DataTree) -> None:
    """The first sentences that an assessment has to say."""
    if "finding" not in tree.children:
        return
    sentences = tree["finding"].to_dataset()["sentence"].values.tolist()
    for sentence in sentences[:FINDINGS]:
        print(f"- {sentence}")
    if len(sentences) > FINDINGS:
        print(f"- and {len(sentences) - FINDINGS} more (group finding of fit.nc, report.html)")


def _write(tree: xr.DataTree, out: Path) -> None:
    try:
        save(tree, out / "fit.nc")
    except OSError as error:
        raise InputError(f"{out} cannot be written: {error.strerror}") from None
    files = [out / "fit.nc", out / "summary.csv"]
    _write_csv(summary(tree), files[1])
    if (tree["residual"]["weight"] < 1).any():  # some noise has heavy tails
        files.append(out / "outliers.csv")
        _write_csv(outliers(tree), files[2])
    else:
        (out / "outliers.csv").unlink(missing_ok=True)  # of an earlier fit
    if _can_plot():
        files.append(_report(tree, out))
    print(f"written: {', '.join(str(path) for path in files)}")
    if not _can_plot():
        print('report.html is left out: pip install "probcal[plot]"')


def _can_plot() -> bool:
    return all(importlib.util.find_spec(name) is not None for name in ("matplotlib", "jinja2"))


def _report(tree: xr.DataTree, out: Path) -> Path:
    from probcal.report import write_report  # the plot packages are an extra

    path = out / "report.html"
    try:
        write_report(tree, path)
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror}") from None
    return path


@app.command(name="simulate")
def simulate_command(
    model: Model,
    seed: Seed = 0,
    out: Annotated[Path | None, typer.Option(help="table to write (MODEL-SEED.csv if left out)")] = None,
) -> None:
    """Simulate a model's scenario: the table, and beside it its true tracks and biases."""
    module = load_model(model)
    simulation = _call(module, model, "scenario", seed)
    if not isinstance(simulation, Simulation):
        raise InputError(f"{model.name}: scenario() returned {type(simulation).__name__}; return probcal.simulate(...)")
    path = Path(f"{model.stem}-{seed}.csv") if out is None else out
    _folder(path.parent)
    try:
        written = simulation.write(path)
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror}") from None
    print(f"written: {', '.join(str(p) for p in written)} ({len(simulation.table)} rows)")


@app.command(name="check")
def check_command(
    model: Model,
    data: Data = None,
    fix: Annotated[list[str] | None, typer.Option(help="hold biases at 0, by label or pattern (repeat)")] = None,
    out: Annotated[Path | None, typer.Option(help="folder for check.nc, check.csv, check.png")] = None,
) -> None:
    """Check before a fit: what the data can and cannot determine, by name, what to do, and what to measure next."""
    if out is not None:
        _folder(out)
    _, problem = _problem(model, data, fix)
    with _progress() as progress:
        if progress is not None:
            progress("check", 0, 0.0)
        start = automatic_start(problem)
        tree = observability(problem, point=start)
        passes = next_passes(problem, point=start)
        plans = (passes, next_anchors(problem, point=start), next_sensors(problem, point=start))
    tree.attrs["model"] = model.stem
    _print_check(problem, tree, plans)
    if out is not None:
        _write_check(problem, tree, passes, out)
    raise typer.Exit(1 if tree.attrs["status"] == "open" else 0)


def _print_check(problem: Problem, tree: xr.DataTree, plans: tuple[xr.Dataset, xr.Dataset, xr.Dataset]) -> None:
    data = problem.measurements
    print(
        f"{data.table.source}: {len(data.time)} rows of {len(set(data.sensor))} sensors, {len(data.target_names)} "
        f"target(s), {sum(len(e.time) for e in problem.epochs)} epochs over {np.ptp(data.time):g} s"
    )
    for name in problem.silent:
        print(f'sensor "{name}" has no row: a fit refuses it; add rows or take it out of the network')
    print(check_table(tree).to_string(index=False, justify="right"))
    print("share: how much of the answer the data give under a prior of one scale; sd: the bound that goes with it")
    sensors = tree["sensor"].to_dataset().to_dataframe().sort_values("leverage")
    print("biases that the rows of each sensor determine: " + _listed(sensors["leverage"]))
    targets = tree["target"].to_dataset()["leverage"].to_series().sort_values()
    print(f"of each target: {_listed(targets)}; of the motion: {tree['target'].attrs['motion']:.2f}")
    print(_directions_text(tree))
    passes, anchors, sensors_ = plans
    print(f"weak directions now: {passes.attrs['weak_before']}. What would tell most (nats; weak directions left):")
    path = passes["path"].values[0]
    ends = " to ".join("(" + ", ".join(f"{v:.4g}" for v in place) + ")" for place in path[[0, -1]][: len(path)])
    what = "another pass" if len(path) > 1 else "another target"
    print(f"  {what}, {ends} m: {passes['gain'].values[0]:.2f} ({passes['weak'].values[0]})")
    label, unit, std = (anchors[name].values[0] for name in ("anchor", "unit", "std"))
    survey = f"a survey of {label} to {std:.2g} {unit.strip('1')}".rstrip()
    print(f"  {survey}: {anchors['gain'].values[0]:.2f} of the other biases ({anchors['weak'].values[0]})")
    place = ", ".join(f"{v:.4g}" for v in sensors_["place"].values[0])
    print(f"  one more {sensors_['type'].values[0]} at ({place}) m: {sensors_['gain'].values[0]:.2f}")
    print(STATUS[tree.attrs["status"]])


def _directions_text(tree: xr.DataTree) -> str:
    """The directions that the data leave open, in words, each with its remedy."""
    if "direction" not in tree.children:
        surveyed = "survey" in tree["bias"].to_dataset()["kind"].values.tolist()
        return f"the data determine every direction of the biases{' without a survey' if surveyed else ''}"
    group = tree["direction"].to_dataset()
    count = group.sizes["direction"]
    lines = [f"{count} direction{'s' * (count > 1)} of the biases that the data hardly determine; remedies add up:"]
    for k in range(group.sizes["direction"]):
        kind, share, words = (group[name].values[k] for name in ("kind", "share", "words"))
        lines.append(f"  {k + 1}. {group['direction'].values[k]} ({kind}, the data give {share:.2g} of the answer)")
        lines += [f"     {words}", f"     {group['remedy'].values[k]}"]
    return "\n".join([*lines, tree.attrs["rule"]])


def _listed(values: pd.Series, most: int = 8) -> str:
    """Names and numbers of a series in one line, the first and the last where there are many."""
    pairs = [f"{name} {value:.2f}" for name, value in values.items()]
    return ", ".join(pairs if len(pairs) <= most else [*pairs[: most // 2], "...", *pairs[-most // 2 :]])


def check_table(tree: xr.DataTree) -> pd.DataFrame:
    """The biases of a check: bias, unit, scale (or survey), kind, sd (bound), share, verdict."""
    columns = ["unit", "scale", "kind", "sd", "share", "verdict"]
    frame = tree["bias"].to_dataset()[columns].to_dataframe().reset_index()
    frame = frame[["bias_label", *columns]].rename(columns={"bias_label": "bias"})
    shown = {"scale": "{:.4g}", "sd": "{:.4g}", "share": "{:.3f}"}
    return frame.assign(**{name: [form.format(v) for v in frame[name]] for name, form in shown.items()})


def _write_check(problem: Problem, tree: xr.DataTree, passes: xr.Dataset, out: Path) -> None:
    files = [out / "check.nc", out / "check.csv"]
    try:
        save(tree, files[0])
        columns = ["unit", "scale", "kind", "sd", "share", "verdict"]
        frame = tree["bias"].to_dataset()[columns].to_dataframe().reset_index().rename(columns={"bias_label": "bias"})
        _write_csv(frame[["bias", *columns]], files[1])
        if _can_plot():
            from probcal.plots import draw_check  # the plot packages are an extra

            files.append(out / "check.png")
            low, high = passes["path"].values.min((0, 1)), passes["path"].values.max((0, 1))
            height = float((low + high)[2] / 2) if len(low) == 3 else None
            sides = [(a, b) for a, b in zip(low[:2], high[:2], strict=True)]
            bound = bound_map(problem, sides, MAP_CELLS, biases="unknown", z=height)
            draw_check(tree, passes, bound, files[-1])
    except OSError as error:
        raise InputError(f"{out} cannot be written: {error.strerror}") from None
    print(f"written: {', '.join(str(path) for path in files)}")


@app.command(name="track")
def track_command(
    model: Model,
    data: Data = None,
    calibration: Annotated[Path | None, typer.Option(help="folder (or fit.nc) of a fit", show_default=False)] = None,
    out: Annotated[Path, typer.Option(help="table of tracks to write")] = Path("tracks.csv"),
) -> None:
    """Tracks of other data with a calibration applied: time, target, each state component with its sd."""
    if calibration is None:
        raise InputError("track needs --calibration DIR, the folder of a fit")
    known = load(calibration)
    if known.attrs.get("status") in ("at bound", "diverged"):
        raise InputError(
            f"{calibration}: the fit ended {known.attrs['status']}, its estimate is invalid; fit again first"
        )
    _folder(out.parent)
    module, problem = _problem(model, data)
    truth = _truth(module, model, data, problem)
    tree = track(problem, known)
    frame = track_table(tree)
    _write_csv(frame, out)
    found = scores(tree, truth) if truth is not None else {}
    if "position_rmse_after" in found:
        print(f"position RMSE before {found['position_rmse_before']:.3f} m, after {found['position_rmse_after']:.3f} m")
    print(f"written: {out} ({len(frame)} epochs)")


def track_table(tree: xr.DataTree) -> pd.DataFrame:
    """Tracks as a table: time, target, then each component and its sd."""
    group, parts = tree["track"].to_dataset(), []
    for name in (str(n) for n in group.data_vars if str(n).startswith("mean")):
        s = name.removeprefix("mean")
        columns: dict[str, np.ndarray] = {
            "time": group[f"epoch_time{s}"].values,
            "target": group[f"epoch_target{s}"].values,
        }
        for component in group[f"component{s}"].values:
            columns[str(component)] = group[name].sel({f"component{s}": component}).values
            columns[f"{component}_sd"] = group[f"sd{s}"].sel({f"component{s}": component}).values
        parts.append(pd.DataFrame(columns))
    return pd.concat(parts, ignore_index=True)


def parse_values(text: str) -> tuple[str, list[Any]]:
    """`name=a,b,c` or `name=first:last:step` as a name and its values; numbers where they are numbers."""
    name, equals, values = text.partition("=")
    parts = [part.strip() for part in values.split(",")]
    if not equals or not name.strip() or not all(parts):
        raise InputError(f'--set "{text}": write name=value,value,... or name=first:last:step')
    found: list[Any] = []
    for part in parts:
        numbers = [_number(piece) for piece in part.split(":")]
        if len(numbers) == 3 and all(isinstance(number, (int, float)) for number in numbers):
            first, last, step = numbers
            if not all(np.isfinite(numbers)) or not step or (last - first) / step < 0:
                raise InputError(f'--set "{text}": the step does not lead from {first} to {last}')
            count = int(np.floor((last - first) / step + 1e-9)) + 1
            found += [round(first + k * step, 12) for k in range(count)]
        else:
            found.append(_number(part))
    return name.strip(), found


def _number(text: str) -> Any:
    """An integer or a float where the text is one, else the text."""
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


@app.command(name="study")
def study_command(
    model: Model,
    setting: Annotated[
        list[str] | None,
        typer.Option("--set", help="values of an argument of setting(): share=0:1:0.1, scenario=C1,C2"),
    ] = None,
    methods: Annotated[str, typer.Option(help=", ".join([*METHODS, ORACLE]))] = f"ml,em-ea,ea,{ORACLE}",
    runs: Annotated[int, typer.Option(min=1, help="simulated runs of every setting")] = 20,
    seed: Annotated[int, typer.Option(min=0, help="number of the first run")] = 0,
    out: Annotated[Path | None, typer.Option(help="folder for study.nc, study.csv, study.png")] = None,
) -> None:
    """Study: fit many simulated runs of a model's setting(run, ...) by several methods, and plot their errors."""
    chosen = choose_methods([name.strip() for name in methods.split(",")])
    grid: dict[str, list[Any]] = {}
    for name, values in map(parse_values, setting or ()):
        grid[name] = grid.get(name, []) + values
    if out is not None:
        _folder(out)
    module = load_model(model)
    began = time.perf_counter()
    with _bar() as advance:
        found = study(
            lambda run, **point: _call(module, model, "setting", run, **point),
            grid, chosen, range(seed, seed + runs), progress=advance,
        )  # fmt: skip
    table = study_table(found)
    print(table.to_string(index=False, float_format=lambda value: f"{value:.4g}"))
    print(f"{found['status'].size} fits in {time.perf_counter() - began:.1f} s")
    if out is not None:
        _write_csv(table, out / "study.csv")
        try:
            save(xr.DataTree(found), out / "study.nc")
            print(f"written: {', '.join(str(path) for path in _study_files(found, out))}")
        except OSError as error:
            raise InputError(f"{out} cannot be written: {error.strerror}") from None


def _study_files(found: xr.Dataset, out: Path) -> list[Path]:
    files = [out / "study.nc", out / "study.csv"]
    if _can_plot() and any(np.issubdtype(found[name].dtype, np.number) for name in grid_of(found)):
        from probcal.plots import draw_study  # the plot packages are an extra

        draw_study(found, out / "study.png")
        files.append(out / "study.png")
    return files


@contextmanager
def _bar() -> Iterator[Callable[[int, int], None]]:
    """A progress bar on a terminal; nothing where stderr is a file."""
    console = Console(stderr=True)
    with RichProgress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("fits", total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


@app.command(name="compare")
def compare_command(
    folders: Annotated[list[Path], typer.Argument(help="folders (or fit.nc) of fits to the same data")],
    name: Annotated[
        list[str] | None, typer.Option(help="name of each fit in turn (repeat); method and prior if left out")
    ] = None,
    pair: Annotated[
        list[str] | None, typer.Option(help="two biases to draw against each other, LABEL,LABEL (repeat)")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="folder for compare.nc, compare.csv, compare.png")] = None,
) -> None:
    """Put fits of the same data side by side: estimates, distances, gamma, coverage, prediction, evidence, cost."""
    fits = named([load(folder) for folder in folders], name)
    pairs = [chosen_pair(fits, text.split(",")) for text in pair or ()]
    if out is not None:
        _folder(out)
    comparison = compare(fits)
    print(estimates_text(comparison))
    print(methods_text(comparison))
    for sentence in comparison["finding"].to_dataset()["sentence"].values:
        print(f"- {sentence}")
    if out is not None:
        _write_comparison(comparison, fits, pairs, out)
    lost = [name for name in fits if fits[name].attrs["status"] in ("at bound", "diverged")]
    raise typer.Exit(1 if lost else 0)


def estimates_text(comparison: xr.DataTree) -> str:
    """One row a bias: unit, true value, then of each method mean and sd, gamma, and the distance to the first."""
    estimate, pair = comparison["estimate"].to_dataset(), comparison["pair"].to_dataset()
    labels, (first, *_) = estimate["bias_label"].values.tolist(), estimate["estimator"].values.tolist()
    columns: list[tuple[str, list[str]]] = [("bias", labels), ("unit", estimate["unit"].values.tolist())]
    if "truth" in comparison.children:
        true = comparison["truth"].to_dataset()["bias"].to_series().to_dict()
        columns.append(("true", [f"{true[label] + 0.0:.4g}" if label in true else "" for label in labels]))
    for name in estimate["estimator"].values.tolist():
        mine = estimate.sel(estimator=name)
        moments = zip(mine["mean"].values, mine["sd"].values, strict=True)
        columns.append((name, [f"{mean:.3g} \N{PLUS-MINUS SIGN} {sd:.2g}" for mean, sd in moments]))
        columns.append(("gamma", [f"{value:.3f}" for value in mine["gamma"].values]))
        beside = (pair["first"] == first) & (pair["second"] == name)
        for distance in pair["wasserstein"].values[beside.values]:
            columns.append(("distance", [f"{value:.3f}" for value in distance]))
    frame = pd.DataFrame(np.array([values for _, values in columns], dtype=object).T, columns=[n for n, _ in columns])
    note = f"distance: Wasserstein distance to {first}, in scales"
    return f"{frame.to_string(index=False, justify='right')}\n{note}"


def methods_text(comparison: xr.DataTree) -> str:
    """One row a method: status, scores, prediction, evidence and cost, a cell empty where it does not apply."""

    def number(value: str, form: str, error: str = "") -> Callable[[dict[str, Any]], str]:
        def shown(at: dict[str, Any]) -> str:
            tail = f" \N{PLUS-MINUS SIGN} {at[error]:{form}}" if error in at else ""
            return f"{at[value]:{form}}{tail}" if value in at else ""

        return shown

    def covered(suffix: str) -> Callable[[dict[str, Any]], str]:
        return lambda at: f"{at[f'covered{suffix}']}/{at[f'known{suffix}']}" if f"known{suffix}" in at else ""

    columns: dict[str, Callable[[dict[str, Any]], str]] = {
        "status": lambda at: at["status"], "bias_rmse": number("bias_rmse", ".3f"), "coverage": covered(""),
        "non-zero": covered("_nonzero"), "elpd": number("elpd", ".1f", "elpd_se"),
        "difference": number("elpd_difference", ".2f", "elpd_difference_se"), "bad k": number("bad_k", ".1%"),
        "log evidence": number("log_evidence", ".1f", "log_evidence_se"), "r_hat": number("largest_r_hat", ".3f"),
        "ess": number("smallest_ess", ".0f"), "ess/s": number("ess_per_second", ".3g"),
        "seconds": number("seconds", ".3g"),
    }  # fmt: skip
    names = comparison["estimate"].to_dataset()["estimator"].values.tolist()
    attrs = [{str(k): value for k, value in comparison[f"method/{name}"].attrs.items()} for name in names]
    frame = pd.DataFrame({"method": names} | {title: [cell(at) for at in attrs] for title, cell in columns.items()})
    frame = frame.loc[:, (frame != "").any()]
    return frame.to_string(index=False, justify="right")


def _write_comparison(
    comparison: xr.DataTree, fits: dict[str, xr.DataTree], pairs: list[tuple[str, str]], out: Path
) -> None:
    files = [out / "compare.nc", out / "compare.csv"]
    try:
        save(comparison, files[0])
        _write_csv(comparison_rows(comparison), files[1])
        if _can_plot():
            from probcal.plots import draw_compare  # the plot packages are an extra

            files.append(out / "compare.png")
            draw_compare(comparison, fits, files[-1], pairs)
    except OSError as error:
        raise InputError(f"{out} cannot be written: {error.strerror}") from None
    print(f"written: {', '.join(str(path) for path in files)}")


@app.command(name="report")
def report_command(
    folder: Annotated[Path, typer.Argument(help="folder of a fit", show_default=False)],
) -> None:
    """Write report.html of a saved fit: map, forest of biases, residuals, trace."""
    if not _can_plot():
        raise InputError('the report needs plot packages: pip install "probcal[plot]"')
    tree = load(folder)
    target = folder if folder.is_dir() else folder.parent
    print(f"written: {_report(tree, _folder(target))}")


@app.command(name="sbc")
def sbc_command(
    model: Model,
    data: Data = None,
    method: Annotated[str, typer.Option(help=" | ".join(METHODS))] = "ea",
    prior: Annotated[str | None, typer.Option(help=" | ".join(PRIORS) + "; the method's own if left out")] = None,
    truths: Annotated[
        str | None, typer.Option("--from", help="prior that the truths are drawn from; that of the fit if left out")
    ] = None,
    fix: Annotated[list[str] | None, typer.Option(help="hold biases at 0, by label or pattern (repeat)")] = None,
    runs: Annotated[int, typer.Option(min=2, help="simulations")] = 200,
    seed: Seed = 0,
    posterior: Annotated[
        bool, typer.Option("--posterior", help="draw the truths from the posterior of the data instead of the prior")
    ] = False,
    full: Annotated[
        bool, typer.Option("--full", help="run samplers as long as a fit would, not just long enough for ranks")
    ] = False,
    out: Annotated[Path | None, typer.Option(help="folder for sbc.nc, sbc.csv, sbc.png, and finished runs")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="go on with the finished runs in --out")] = False,
) -> None:
    """Check a method on a model by simulation: do its intervals hold the truth as often as they say?"""
    if method not in METHODS:
        raise InputError(f'sbc: no method is called "{method}"{nearest(method, METHODS)}')
    for name in (prior, truths):
        if name is not None and name not in PRIORS:
            raise InputError(f'sbc: no prior is called "{name}"{nearest(name, PRIORS)}')
    if resume and out is None:
        raise InputError("sbc: --resume needs --out DIR, the folder of the runs to go on with")
    value, implied = METHODS[method]
    value = value if full else short(value)
    if out is not None:
        _folder(out)
    module, problem = _problem(model, data, fix)
    chosen: Any = PRIORS[prior] if prior is not None else implied
    own = getattr(module, "PRIOR", None)
    if chosen is None and own is not None and value.takes(own):
        chosen = own
    began = time.perf_counter()
    with _bar() as advance:
        tree = sbc(
            problem, value, chosen, runs, simulate_from=PRIORS[truths] if truths is not None else None,
            around="data" if posterior else None, key=seed, progress=advance, resume=resume,
            store=None if out is None else out / "runs",
        )  # fmt: skip
    tree.attrs["model"] = model.stem
    table = coverage_table(tree)
    print(table.to_string(index=False, float_format=lambda number: f"{number:.3f}"))
    counted = f"{tree.attrs['runs']} runs, truths from {tree.attrs['source']}"
    print(f"{tree.attrs['method']} ({tree.attrs['prior']}): {counted}, {time.perf_counter() - began:.1f} s")
    print(tree.attrs["verdict"])
    if tree.attrs["message"]:
        print(tree.attrs["message"])
    if out is not None:
        _write_sbc(tree, table, out)
    raise typer.Exit(0 if tree.attrs["status"] == "uniform" else 1)


def _write_sbc(tree: xr.DataTree, table: pd.DataFrame, out: Path) -> None:
    files = [out / "sbc.nc", out / "sbc.csv"]
    try:
        save(tree, files[0])
        _write_csv(table, files[1])
        if _can_plot():
            from probcal.plots.sbc import draw_sbc  # the plot packages are an extra

            files.append(out / "sbc.png")
            draw_sbc(tree, files[-1])
    except OSError as error:
        raise InputError(f"{out} cannot be written: {error.strerror}") from None
    print(f"written: {', '.join(str(path) for path in files)}")


if __name__ == "__main__":
    main()
