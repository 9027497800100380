"""`fit` of several recordings of one network: each as `fit` fits it, into a folder of its own, and one table of all."""

import json
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pandas as pd

from probcal.cli import fit
from probcal.cli.files import say_written, write_csv
from probcal.cli.models import ModelFile, check_here
from probcal.cli.outputs import FIT, results_of_a_run
from probcal.cli.progress import shown
from probcal.errors import FitError, InputError
from probcal.files import Outputs, digest_of_file, write_whole
from probcal.inference.manifest import check_same, stored_run
from probcal.inference.progress import Monitor
from probcal.inference.spread import check_scheduler, spread
from probcal.results.read import summary
from probcal.status import Status

NOTE = ".probcal-fit.json"  # in the folder of a recording: what its fit is, and once it is finished what it found
PARTLY = 30.0  # s after which the table is made anew while fits go on
WAIT = 3600.0  # s for a worker that another client left busy with the same recording
REFUSED = "refused"  # status of a recording that cannot be fitted


@dataclass(frozen=True)
class Recordings:
    """The common settings of all fits; a call with one recording fits it and returns its rows."""

    model: ModelFile
    out: Path
    options: Mapping[str, Any]
    resume: bool
    overwrite: bool

    def identity(self, digest: str) -> dict[str, str]:
        """The identity of the fit of a table, by the names that error messages use."""
        options = {name: repr(value) for name, value in sorted(self.options.items()) if name != "network"}
        if (network := self.options["network"]) is not None:
            options["network"] = digest_of_file(network)
        return {"version of probcal": version("probcal"), "model": self.model.digest, "data": digest} | options

    def kept(self, data: Path, digest: str) -> list[dict[str, Any]] | None:
        """The rows of a recording that is finished, None where it is not; `InputError` where its fit is another's."""
        try:
            note = json.loads((self.out / data.stem / NOTE).read_text())
            there, rows = dict(note["fit"]), note["rows"]
        except (OSError, ValueError, KeyError, TypeError):
            return None
        if self.resume:
            check_same(self.out / data.stem, self.identity(digest), there)
        return rows if self.resume and (self.out / data.stem / "fit.nc").exists() else None

    def __call__(self, recording: tuple[Path, str]) -> list[dict[str, Any]]:
        """Fit a recording, its path and digest."""
        data, digest = recording
        check_here(data, digest)
        folder, store = self.out / data.stem, self.out / data.stem / "draws"
        mine = (folder / NOTE).exists() and self.resume  # of `kept`: the same fit, not finished
        going = mine and stored_run(store) != ""
        new = self.overwrite or (mine and not going)
        with results_of_a_run(folder, FIT, "draws", resume=going, overwrite=new, wait=WAIT) as outputs:
            assert outputs is not None
            rows = self.kept(data, digest)  # another may have finished it meanwhile
            return self._fit(data, digest, outputs, going, new) if rows is None else rows

    def _fit(self, data: Path, digest: str, outputs: Outputs, going: bool, new: bool) -> list[dict[str, Any]]:
        note = outputs.folder / NOTE
        write_whole(note, json.dumps({"fit": self.identity(digest), "rows": None}))
        try:
            tree, network = fit.calibrated(
                self.model.path, data, module=self.model.module(), outputs=outputs, resume=going, overwrite=new,
                **self.options,
            )  # fmt: skip
        except (InputError, FitError) as error:
            return [{"recording": data.stem, "status": REFUSED, "message": str(error)}]
        fit.written(tree, network, outputs)
        found = summary(tree)[["bias", "mean", "sd"]].to_dict("records")
        rows = [{"recording": data.stem, "status": tree.attrs["status"], **row} for row in found]
        write_whole(note, json.dumps({"fit": self.identity(digest), "rows": rows}))
        return rows


def run(
    model: Path, recordings: Sequence[Path], *, outputs: Outputs, resume: bool, overwrite: bool,
    scheduler: str | None, **options: Any,
) -> int:  # fmt: skip
    """Fit several recordings, one after the other or spread over a cluster, and write one table of all."""
    check_scheduler(scheduler)
    began = time.perf_counter()
    work = Recordings(ModelFile.of(model), outputs.folder.resolve(), options, resume, overwrite)
    files = [(path.resolve(), digest_of_file(path)) for path in recordings]
    found = {path: rows for path, digest in files if (rows := work.kept(path, digest)) is not None}
    missing = [(path, digest) for path, digest in files if path not in found]
    outputs.begin()
    with (
        shown() as progress, _kept(found, files, outputs),
        closing(spread(work, missing, scheduler=scheduler, threads=1)) as finished,
    ):  # fmt: skip
        last, monitor = time.monotonic(), Monitor(progress)
        monitor.tell("recordings", len(found), len(files))
        for k, rows in finished:
            found[missing[k][0]] = rows
            _check_seen(work.out, missing[k][0])
            monitor.tell("recordings", len(found), len(files))
            if time.monotonic() - last > PARTLY:
                _write(found, files, outputs)
                last = time.monotonic()
    table = _write(found, files, outputs)
    print(table.to_string(index=False, float_format=lambda value: f"{value:.4g}"))
    fitted = sum(found[path][0]["status"] != REFUSED for path, _ in missing)
    print(f"{len(files)} recordings, {fitted} of them fitted now, {time.perf_counter() - began:.1f} s")
    say_written([outputs.folder / "fits.csv"])
    ended = pd.DataFrame([rows[0] for rows in found.values()])
    refused = ended[ended["status"] == REFUSED]
    for message, own in refused.groupby("message", sort=False) if len(refused) else ():
        print(f"{', '.join(own['recording'])}: {message}", file=sys.stderr)
    return 0 if all(state != REFUSED and Status(state).settled for state in ended["status"]) else 1


@contextmanager
def _kept(
    found: Mapping[Path, list[dict[str, Any]]], files: Sequence[tuple[Path, str]], outputs: Outputs
) -> Iterator[None]:
    """Interrupted, the table of what is finished is written."""
    try:
        yield
    except KeyboardInterrupt:
        _write(found, files, outputs)
        done = f"interrupted; {len(found)} of {len(files)} recordings are finished, --resume goes on"
        print(f"probcal: {done}", file=sys.stderr)
        raise


def _check_seen(out: Path, data: Path) -> None:
    """Raise `InputError` where what workers write is not seen by this process."""
    if not (out / data.stem / NOTE).exists():
        raise InputError(
            f"{out / data.stem} is written where this process does not see it; give an --out that all workers share"
        )


def _write(
    found: Mapping[Path, list[dict[str, Any]]], files: Sequence[tuple[Path, str]], outputs: Outputs
) -> pd.DataFrame:
    """Write the table of what is finished, in the order of the recordings."""
    rows = [row for path, _ in files if path in found for row in found[path]]
    table = pd.DataFrame(rows, columns=["recording", "status", "bias", "mean", "sd"])
    with outputs.writing():
        write_csv(table, outputs.folder / "fits.csv")
    return table
