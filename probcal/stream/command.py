"""The command `watch` and its options; nothing heavy is imported before these hold."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from probcal.cli import options, outputs
from probcal.cli.arguments import Fix, Given, Model, Network
from probcal.errors import InputError
from probcal.files import Lock

KEPT = ("tracks", "rows")  # tables of a watch besides its history


def watch_command(
    model: Model,
    data: Annotated[
        Path | None,
        typer.Argument(help="table of rows (CSV) that may grow; standard input if left out"),
    ] = None,
    follow: Annotated[bool, typer.Option("--follow", help="wait for more rows at the end of the file")] = False,
    calibration: Annotated[Path | None, typer.Option(help="folder (or fit.nc) of a fit to start from")] = None,
    out: Annotated[Path | None, typer.Option(help="folder for the state, the history of biases and fit.nc")] = None,
    by: Annotated[str | None, typer.Option(help="extended (if left out) | unscented | cubature")] = None,
    lag: Annotated[
        int | None,
        options.count(0, "epochs that are linearised again, 32 if left out; 0 is the plain filter"),
    ] = None,
    particles: Annotated[
        int | None,
        options.count(2, "filter by so many particles: for roads and other motions of no linear form"),
    ] = None,
    walk: Annotated[
        list[str] | None,
        typer.Option(help="biases that walk: PATTERN=STD over one second (repeat)"),
    ] = None,
    consider: Annotated[
        list[str] | None, typer.Option(help="biases that are not estimated, by pattern (repeat)")
    ] = None,
    jumps: Annotated[float | None, options.quantity("find biases that jump, with so many false alarms an hour")] = None,
    within: Annotated[float, options.quantity("s within which a jump must be found")] = 60.0,
    gate: Annotated[
        float, options.quantity("probability of a datum of the right model to be left out; 0 takes all", zero=True)
    ] = 1e-6,
    targets: Annotated[int, options.count(1, "targets that are carried at once")] = 16,
    every: Annotated[float, options.quantity("s between two states that are stored", zero=True)] = 1.0,
    keep: Annotated[str, typer.Option(help="tables to write besides: tracks,rows")] = "",
    fix: Fix = None,
    given: Given = None,
    network: Network = None,
) -> None:
    """Calibrate a stream as it comes: a live table of biases, their history, and a state that survives a kill.

    With --out a run that was stopped or killed goes on where it was: every row of a file counts once. A row that comes
    later than what was filtered of its target is left out and counted, as are duplicates.
    """
    options.check_files(model, data)
    if calibration is not None:
        options.check_fit(calibration)
    kept = [name.strip() for name in keep.split(",") if name.strip()]
    for name in kept:
        if name not in KEPT:
            raise InputError(f'--keep "{name}" is not known; give tracks, rows or both, separated by a comma')
    if kept and out is None:
        raise InputError("--keep needs --out, the folder of the tables")
    arguments, walks = options.given(given or ()), walks_of(walk or ())
    results = None if out is None else outputs.replaceable(out, outputs.WATCH)
    lock = None if out is None else Lock(out, 0.0)
    try:
        from probcal.stream import watch
        from probcal.stream.online import AugmentedFilter, Jumps, ParticleFilter

        found = None if jumps is None else Jumps(false_alarms=jumps, within=within)
        method: AugmentedFilter | ParticleFilter
        if particles is None:
            method = AugmentedFilter(
                by or "extended", 32 if lag is None else lag, walks, tuple(consider or ()), found, gate=gate
            )
        else:
            others = {"--by": by, "--lag": lag, "--consider": consider, "--jumps": jumps}
            if other := next((name for name, value in others.items() if value is not None), None):
                raise InputError(f"--particles filters without {other}; give one of the two")
            method = ParticleFilter(particles, walks, gate=gate)
        raise typer.Exit(watch.run(
            model, data, fix or (), arguments, network, method, calibration=calibration, targets=targets, follow=follow,
            outputs=results, every=every, kept=kept,
        ))  # fmt: skip
    finally:
        if lock is not None:
            lock.release()


def walks_of(texts: Sequence[str]) -> dict[str, float]:
    """`PATTERN=STD` of biases that walk; raises `InputError` for what is no such pair."""
    found = {}
    for text in texts:
        pattern, equals, value = text.rpartition("=")
        number = options.as_number(value) if equals and pattern else None
        if not isinstance(number, (int, float)) or not options.LEAST_SIZE <= number <= options.MOST_SIZE:
            raise InputError(f'--walk "{text}": write PATTERN=STD, the positive standard deviation over one second')
        found[pattern] = float(number)
    return found
