"""The folder of a command's results: checked and locked before any work, so that nothing of another run is replaced."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from probcal.errors import InputError
from probcal.files import Lock, Outputs, make_folder
from probcal.inference.manifest import REMEDY, check_choice, stored_digest, stored_run

FIT = ("fit.nc", "summary.csv", "outliers.csv", "network.csv", "report.html")
SBC = ("sbc.nc", "sbc.csv", "sbc.png")
STUDY = ("study.nc", "study.csv", "study.png")
CHECK = ("check.nc", "check.csv", "check.png")
RECORDINGS = ("fits.csv",)
COMPARE = ("compare.nc", "compare.csv", "compare.png")
WATCH = ("watch.npz", "biases.csv", "jumps.csv", "tracks.csv", "refused.csv", "rows.csv", "biases.png", "fit.nc")
CHANGES = ("changes.nc", "changes.csv", "changes.png")


@contextmanager
def results_of_a_run(
    out: Path | None, names: tuple[str, ...], parts: str, *, resume: bool, overwrite: bool, wait: float = 0.0
) -> Iterator[Outputs | None]:
    """The results of a run in a folder, and its parts in a folder below, for this process alone.

    Raises `InputError` where they are of another run and neither `resume` nor `overwrite` lets it go on.
    """
    if out is None:
        if overwrite:
            raise InputError("--overwrite needs --out, the folder whose run it replaces")
        yield None
        return
    check_choice(resume, overwrite)
    outputs, store = replaceable(out, names), out / parts
    lock = Lock(out, wait)
    try:
        if not resume and not overwrite:
            if outputs.there:
                raise InputError(f"{out / outputs.there[0]} is the result of another run; {REMEDY}")
            if run := stored_run(store):
                raise InputError(f"{store} holds {run} already; {REMEDY}")
        elif resume and outputs.runs() - {stored_digest(store)}:
            raise InputError(
                f"{out / outputs.there[0]} is the result of a run that is finished, or of another than the one to go on"
                " with; give --overwrite instead of --resume, or another --out"
            )
        yield outputs
    except KeyboardInterrupt:
        if run := stored_run(store):
            print(
                f"probcal: interrupted; {store} keeps {run}, --resume goes on with it",
                file=sys.stderr,
            )
        raise
    finally:
        lock.release()


def replaceable(out: Path, names: tuple[str, ...]) -> Outputs:
    """Files in a folder that can be written; raises `InputError` for one that this package did not write."""
    outputs = Outputs(make_folder(out), names)
    outputs.check()
    return outputs
