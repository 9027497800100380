"""The commands `study` and `sbc` and their options; nothing heavy is imported before these hold."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from probcal.cli import options, outputs
from probcal.cli.arguments import (
    LARGEST_SEED,
    Data,
    Fix,
    Given,
    Method,
    Model,
    Network,
    Overwrite,
    Prior,
    Scheduler,
    Seed,
)
from probcal.cli.names import METHODS, ORACLE, PRIORS
from probcal.errors import InputError, nearest
from probcal.studies.settings import check_setting
from probcal.wings import check_method_installed


def study_command(
    model: Model,
    setting: Annotated[
        list[str] | None,
        typer.Option("--set", help="values of an argument of setting(): share=0:1:0.1, scenario=C1,C2"),
    ] = None,
    methods: Annotated[str, typer.Option(help=", ".join([*METHODS, ORACLE]))] = f"ml,em-ea,ea,{ORACLE}",
    runs: Annotated[int, options.count(1, "simulated runs of every setting")] = 20,
    seed: Annotated[int, typer.Option(min=0, max=LARGEST_SEED, help="number of the first run")] = 0,
    out: Annotated[
        Path | None, typer.Option(help="folder for study.nc, study.csv, study.png, and finished fits")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="go on with the finished fits in --out")] = False,
    overwrite: Overwrite = False,
    scheduler: Scheduler = None,
) -> None:
    """Study: fit many simulated runs of a model's setting(run, ...) by several methods, and plot their errors."""
    chosen = method_names(methods)
    grid = values_of(setting or ())
    options.check_files(model)
    if resume and out is None:
        raise InputError("study: --resume needs --out DIR, the folder of the fits to go on with")
    with outputs.results_of_a_run(out, outputs.STUDY, "runs", resume=resume, overwrite=overwrite) as results:
        from probcal.studies import run_study

        raise typer.Exit(
            run_study.run(
                model, grid, chosen, runs=runs, seed=seed, outputs=results, resume=resume, overwrite=overwrite,
                scheduler=scheduler,
            )
        )  # fmt: skip


def sbc_command(
    model: Model,
    data: Data = None,
    method: Method = "ea",
    prior: Prior = None,
    truths: Annotated[
        str | None, typer.Option("--from", help="prior that the truths are drawn from; that of the fit if left out")
    ] = None,
    fix: Fix = None,
    given: Given = None,
    network: Network = None,
    runs: Annotated[int, options.count(2, "simulations")] = 200,
    seed: Seed = 0,
    posterior: Annotated[
        bool, typer.Option("--posterior", help="draw the truths from the posterior of the data instead of the prior")
    ] = False,
    full: Annotated[
        bool, typer.Option("--full", help="run samplers as long as a fit would, not just long enough for ranks")
    ] = False,
    out: Annotated[Path | None, typer.Option(help="folder for sbc.nc, sbc.csv, sbc.png, and finished runs")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="go on with the finished runs in --out")] = False,
    overwrite: Overwrite = False,
    scheduler: Scheduler = None,
) -> None:
    """Check a method on a model by simulation: do its intervals hold the truth as often as they say?"""
    check_method_installed(method)
    if method not in METHODS:
        raise InputError(f'sbc: no method is called "{method}"{nearest(method, METHODS)}')
    if truths is not None and truths not in PRIORS:
        raise InputError(f'sbc: no prior is called "{truths}"{nearest(truths, PRIORS)}')
    options.check_priors(method, prior or ())
    if resume and out is None:
        raise InputError("sbc: --resume needs --out DIR, the folder of the runs to go on with")
    options.check_files(model, data)
    arguments = options.given(given or ())
    with outputs.results_of_a_run(out, outputs.SBC, "runs", resume=resume, overwrite=overwrite) as results:
        from probcal.studies import run_sbc

        raise typer.Exit(
            run_sbc.run(
                model, data, method=method, prior=prior or (), truths=truths, fix=fix or (), given=arguments,
                network=network, runs=runs, seed=seed, posterior=posterior, full=full, outputs=results, resume=resume,
                overwrite=overwrite, scheduler=scheduler,
            )
        )  # fmt: skip


def method_names(text: str) -> list[str]:
    """Names of the methods of a study, separated by commas."""
    names = [name.strip() for name in text.split(",")]
    for name in names:
        check_method_installed(name)
        if name not in METHODS and name != ORACLE:
            raise InputError(f'method "{name}" is not known{nearest(name, [*METHODS, ORACLE])}')
    return names


def values_of(settings: Sequence[str]) -> dict[str, list[Any]]:
    """The values of each setting of a study, those given in several options one after the other."""
    found: dict[str, list[Any]] = {}
    for name, values in map(options.parse_values, settings):
        found[name] = found.get(name, []) + values
    for name, values in found.items():
        check_setting(name, values)
    return found
