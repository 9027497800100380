"""The commands, their options and the checks of these; nothing heavy is imported before they hold."""

import sys
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any

import typer

from probcal import wings
from probcal.analysis.choices import check_count, check_names, split_pair
from probcal.cli import files, options, outputs
from probcal.cli.arguments import Data, Fix, Given, Method, Model, Network, Overwrite, Prior, Scheduler, Seed
from probcal.cli.names import METHODS
from probcal.errors import FitError, InputError, check_known
from probcal.inference.progress import Terminated, check_limit

app = typer.Typer(
    help="Bayesian calibration of sensor networks from targets of opportunity.",
    no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False,
)  # fmt: skip

TERMINATED = 143  # exit code of a command that SIGTERM ended
SMOOTHERS = ("gaussian", "particles")


def main() -> None:
    """Entry point: one sentence on stderr and exit code 2 for bad input, 1 for a fit that left no
    answer.

    Ctrl-C ends a command with 130, SIGTERM with 143.
    """
    try:
        app()
    except InputError as error:
        _say(error)
        sys.exit(2)
    except FitError as error:
        _say(error)
        sys.exit(1)
    except SystemExit as ended:
        cause = ended.__context__ and ended.__context__.__cause__  # which typer makes an exit
        sys.exit(TERMINATED if isinstance(cause, Terminated) else ended.code)


def _say(text: object) -> None:
    print(f"probcal: {text}", file=sys.stderr)


def _print_version(asked: bool) -> None:
    if asked:
        print(f"probcal {metadata.version('probcal')}")
        raise typer.Exit


@app.callback()
def _options_of_all(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="print the version and end"),
    ] = False,
) -> None: ...


@app.command(name="fit")
def fit_command(
    model: Model,
    data: Annotated[
        list[Path] | None,
        typer.Argument(help="table of rows (CSV), or several recordings; the model's own data if left out"),
    ] = None,
    method: Method = "ea",
    prior: Prior = None,
    fix: Fix = None,
    given: Given = None,
    network: Network = None,
    starts: Annotated[int, options.count(1, "starts of the search; the best optimum is reported")] = 1,
    seed: Seed = 0,
    out: Annotated[Path | None, typer.Option(help="folder for fit.nc, summary.csv, network.csv, report.html")] = None,
    chains: Annotated[int | None, options.count(1, "chains of a sampler")] = None,
    draws: Annotated[int | None, options.count(1, "draws of each chain after warm-up")] = None,
    warmup: Annotated[int | None, options.count(0, "steps of each chain before its draws")] = None,
    effective: Annotated[int | None, options.count(1, "effective draws at which mcmc ends")] = None,
    resume: Annotated[
        bool,
        typer.Option(
            "--resume",
            help="go on with the stopped fit, or with the recordings, in --out",
        ),
    ] = False,
    overwrite: Overwrite = False,
    limit: Annotated[
        float | None,
        typer.Option(
            help="s after which a fit and the search for other answers end; checks follow",
            show_default=False,
        ),
    ] = None,
    scheduler: Scheduler = None,
    save: Annotated[
        str,
        typer.Option(help="draws to keep in fit.nc besides those of the biases: states,predictive"),
    ] = "",
    assessed: Annotated[
        bool,
        typer.Option("--assess/--no-assess", help="a verdict per bias, and what the residuals say"),
    ] = True,
    epoch: Annotated[float | None, options.quantity("bring rows to common epochs of so many s")] = None,
    align: Annotated[
        str | None,
        typer.Option(help="rigid | similarity: how the answer is laid on a truth in another frame"),
    ] = None,
) -> None:
    """Calibrate: one row a bias, and where the truth is known the position error before and after.

    Several recordings of one network are fitted each into a folder below --out, with one table of all, fits.csv.
    """
    wings.check_method_installed(method)
    check_known(method, METHODS, f'--method "{method}" is not known')
    options.check_priors(method, prior or ())
    numbers = {"chains": chains, "draws": draws, "warmup": warmup, "effective": effective}
    sizes = options.chain_sizes(method, numbers)
    if resume and out is None:
        raise InputError("--resume needs --out, the folder of the run to go on with")
    recordings = options.recordings(data or (), out, scheduler)
    kept = options.saved_names(save)
    arguments = options.given(given or ())
    options.check_alignment(align)
    check_limit(limit)
    chosen: dict[str, Any] = dict(
        method=method, prior=prior or (), fix=fix or (), given=arguments, starts=starts, seed=seed, sizes=sizes,
        kept=kept, assessed=assessed, epoch=epoch, align=align, limit=limit, network=network,
    )  # fmt: skip
    if recordings:
        options.check_files(model)
        with outputs.results_of_a_run(out, outputs.RECORDINGS, "runs", resume=resume, overwrite=overwrite) as table:
            from probcal.cli import recordings as several

            assert table is not None
            raise typer.Exit(
                several.run(
                    model, recordings, outputs=table, resume=resume, overwrite=overwrite, scheduler=scheduler, **chosen
                )
            )  # fmt: skip
    one = data[0] if data else None
    options.check_files(model, one)
    with outputs.results_of_a_run(out, outputs.FIT, "draws", resume=resume, overwrite=overwrite) as results:
        from probcal.cli import fit

        raise typer.Exit(fit.run(model, one, outputs=results, resume=resume, overwrite=overwrite, **chosen))


@app.command(name="simulate")
def simulate_command(
    model: Model,
    seed: Seed = 0,
    out: Annotated[Path | None, typer.Option(help="table to write (MODEL-SEED.csv if left out)")] = None,
) -> None:
    """Simulate a model's scenario: the table, and beside it its true tracks and biases."""
    options.check_files(model)
    path = Path(f"{model.stem}-{seed}.csv") if out is None else out
    names = (path.name, *(path.with_suffix(f".{what}.csv").name for what in ("tracks", "biases")))
    results = outputs.replaceable(path.parent, names)
    from probcal.cli import simulate

    raise typer.Exit(simulate.run(model, seed, results))


@app.command(name="check")
def check_command(
    model: Model,
    data: Data = None,
    fix: Fix = None,
    given: Given = None,
    network: Network = None,
    out: Annotated[Path | None, typer.Option(help="folder for check.nc, check.csv, check.png")] = None,
) -> None:
    """Check before a fit: what the data can and cannot determine, by name, what to do, and what to measure next."""
    options.check_files(model, data)
    arguments = options.given(given or ())
    results = None if out is None else outputs.replaceable(out, outputs.CHECK)
    from probcal.cli import check

    raise typer.Exit(check.run(model, data, fix or (), arguments, network, results))


@app.command(name="track")
def track_command(
    model: Model,
    data: Data = None,
    calibration: Annotated[Path | None, typer.Option(help="folder (or fit.nc) of a fit", show_default=False)] = None,
    given: Given = None,
    network: Network = None,
    smoother: Annotated[str, typer.Option(help="gaussian, or particles: for any motion, roads too")] = "gaussian",
    particles: Annotated[int, options.count(2, "particles of each target")] = 1000,
    seed: Seed = 0,
    out: Annotated[Path, typer.Option(help="table of tracks to write")] = Path("tracks.csv"),
) -> None:
    """Tracks of other data with a calibration applied: time, target, each state component with its sd."""
    if calibration is None:
        raise InputError("track needs --calibration DIR, the folder of a fit")
    check_known(smoother, SMOOTHERS, f'--smoother "{smoother}" is not known')
    options.check_fit(calibration)
    options.check_files(model, data)
    arguments = options.given(given or ())
    results = outputs.replaceable(out.parent, (out.name,))
    from probcal.cli import track

    raise typer.Exit(track.run(
        model, data, arguments, network, calibration, results, smoother=smoother, particles=particles, seed=seed
    ))  # fmt: skip


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
    for path in folders:
        options.check_fit(path)
    check_count(len(folders))
    if name:
        check_names(name, len(folders))
    pairs = [split_pair(text.split(",")) for text in pair or ()]
    results = None if out is None else outputs.replaceable(out, outputs.COMPARE)
    from probcal.cli import compare

    raise typer.Exit(compare.run(folders, name, pairs, results))


@app.command(name="changes")
def changes_command(
    first: Annotated[Path, typer.Argument(help="folder (or fit.nc) of the fit to the first recording")],
    second: Annotated[Path, typer.Argument(help="folder (or fit.nc) of the fit to the second recording")],
    name: Annotated[list[str] | None, typer.Option(help="name of each recording in turn (repeat)")] = None,
    out: Annotated[Path | None, typer.Option(help="folder for changes.nc, changes.csv, changes.png")] = None,
) -> None:
    """Changes: what moved between two recordings of one network, second less first, with intervals."""
    for path in (first, second):
        options.check_fit(path)
    results = None if out is None else outputs.replaceable(out, outputs.CHANGES)
    from probcal.cli import changes

    raise typer.Exit(changes.run(first, second, name, results))


@app.command(name="report")
def report_command(
    folder: Annotated[Path, typer.Argument(help="folder of a fit", show_default=False)],
    static: Annotated[bool, typer.Option("--static", help="without scripts: a picture in place of the map")] = False,
) -> None:
    """Write report.html of a saved fit: verdict, map, the biases that matter, and the rest folded away."""
    if not files.can_plot():
        raise InputError('the report needs plot packages: pip install "probcal[plot]"')
    options.check_fit(folder)
    results = outputs.replaceable(folder if folder.is_dir() else folder.parent, ("report.html",))
    from probcal.cli import report

    raise typer.Exit(report.run(folder, results, static=static))


def _missing(module: str, name: str) -> Callable[[typer.Context], None]:
    """The command that raises `WingMissing`, whatever its arguments."""

    def command(context: typer.Context) -> None:
        wings.loaded(module, f"probcal {name}")

    return command


for _name, _module in wings.COMMANDS.items():
    if wings.installed(_module):
        app.command(name=_name)(getattr(wings.loaded(_module, _name), f"{_name}_command"))
    else:
        any_arguments = {"allow_extra_args": True, "ignore_unknown_options": True}
        app.command(name=_name, hidden=True, context_settings=any_arguments)(_missing(_module, _name))
