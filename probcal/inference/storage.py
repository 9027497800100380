"""Work on its way to disk: a folder with the numbered parts of one run, each whole or absent, safe against a kill.

A folder holds the manifest of a run (what it is, see `identity`) and a file for every part: a chunk of a sampler's
draws with the state after it, the state and course of a loop of a climb, or the records of some runs of `sbc`. Every
part carries its number, the digest of its run and a checksum, and is written in one step. The fits of a study are one
zarr store instead (`fits.py`). One process at a time works in a folder. Nothing is removed but files that carry the
names made here, in a folder with a manifest.
"""

from __future__ import annotations

import hashlib
import io
import os
import time
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from probcal.errors import InputError
from probcal.files import AnyPath, Lock, clear_drafts, make_folder, write_whole
from probcal.inference.manifest import (
    KINDS,
    MANIFEST,
    OLD_FITS,
    OLDER,
    OVERWRITE,
    REMEDY,
    check_choice,
    check_same,
    clear_parts,
    described,
    digest_of,
    holds_parts,
    parts_of,
    read_manifest,
    remove_parts,
    write_manifest,
)

Arrays = Mapping[str, Any]
EVERY = 2.0  # s from one state of a climb that is written to the next
DRAWS = "draws_"  # begins the names of arrays of draws in a part
SELDOM = 20.0  # times what a write took, until the next one at least


class Storage:
    """Parts of one run by number, in the folder `path`; none are kept where there is no path. Threads may add at once.

    `resume` takes up what the folder holds, `overwrite` replaces it. Raises `InputError` where the folder holds a run
    and neither is given, where its run is another, where a part is damaged, and where another process works there.
    """

    def __init__(
        self, path: AnyPath | None, kind: str, identity: Mapping[str, str], *, resume: bool = False,
        overwrite: bool = False,
    ):  # fmt: skip
        check_choice(resume, overwrite)
        self.path = None if path is None else Path(path)
        self.kind, self.identity = kind, dict(identity)
        self.digest = digest_of(kind, identity)
        self._numbers: set[int] = set()
        self._lock: Lock | None = None
        self._loops = 0  # begun so far, of a fit whose loops are kept
        if self.path is None:
            return
        self._made = not self.path.exists()
        make_folder(self.path)
        self._lock = Lock(self.path)
        try:
            self._open(self.path, resume, overwrite)
        except BaseException:
            self._lock.release()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def _open(self, path: Path, resume: bool, overwrite: bool) -> None:
        clear_drafts(path)
        there = (path / MANIFEST).exists()
        files, names = holds_parts(path), os.listdir(path)
        if not there and (files or any(OLDER.fullmatch(name) for name in names)):
            raise InputError(
                f"{path} holds parts of a run without its manifest {MANIFEST} (it was lost, or written by an older"
                " probcal): move them away, or give another folder"
            )
        if any(OLD_FITS.fullmatch(name) for name in names):
            raise InputError(f"{path} holds fits-*.npz of an older probcal: move them away, or give another folder")
        if there and files and not overwrite:
            if not resume:
                raise InputError(f"{path} holds {described(path)} already; {REMEDY}")
            kind, other = read_manifest(path)
            if kind != self.kind:
                raise InputError(f"{path} holds a run of another kind ({kind}); give another folder, or {OVERWRITE}")
            check_same(path, self.identity, other)
            self._numbers = set(parts_of(path))
            return
        clear_parts(path)
        write_manifest(path, self.kind, self.identity)

    @property
    def numbers(self) -> list[int]:
        """Numbers of the parts that are there."""
        return sorted(self._numbers)

    def read(self, number: int) -> dict[str, np.ndarray]:
        """Arrays of one part by name; raises `InputError` where its file is missing, damaged or another's."""
        file = self._file(number)
        remedy = f"delete it{self._later} and --resume (resume=True) makes it anew, or {OVERWRITE}"
        if not file.is_file():
            raise InputError(f"{file} is missing: {remedy}")
        try:
            with zipfile.ZipFile(file) as whole:
                broken = whole.testzip()
            with np.load(file, allow_pickle=False) as saved:
                found = {name: saved[name] for name in saved.files}
        except Exception as error:  # whatever zip, zlib and NumPy say of foreign bytes
            raise InputError(f"{file} is damaged ({type(error).__name__}): {remedy}") from None
        mark = found.pop("probcal", np.array(""))
        if broken is not None or str(mark) != self._mark(number):
            raise InputError(f"{file} is damaged or does not belong to the run of its folder: {remedy}")
        return found

    @property
    def _later(self) -> str:
        return " and every later chunk" if self.kind == "draws" else ""

    def _mark(self, number: int) -> str:
        """The mark in the file of a part, which identifies it."""
        return f"{KINDS[self.kind]} {number} of {self.digest}"

    def _file(self, number: int) -> Path:
        assert self.path is not None
        return self.path / f"{KINDS[self.kind]}-{number:06d}.npz"

    def add(self, number: int, arrays: Arrays) -> None:
        """Keep a part: its arrays by name."""
        if self.path is not None:
            content = io.BytesIO()
            marked = {**arrays, "probcal": np.array(self._mark(number))}
            np.savez(content, **marked)
            write_whole(self._file(number), content.getbuffer())
        self._numbers.add(number)

    def checkpoint(self, kind: str, first: Sequence[Any]) -> Checkpoint | Chunks | None:
        """The keeper of the next loop of a kind, whose first state has these leaves; None where it is not kept."""
        if self.path is None or self.kind != kind:
            return None
        if kind == "draws":
            return Chunks(self)
        self._loops += 1
        return Checkpoint(self, self._loops - 1, first)

    def close(self) -> None:
        """Let another process work in the folder; one without any part is left as it was found."""
        if self.path is None or self._lock is None:
            return
        if not holds_parts(self.path):
            remove_parts(self.path, self._lock, folder=self._made)
        else:
            self._lock.release()
        self._lock = None


def numbered(part: Arrays, name: str) -> list[Any]:
    """Arrays of a part that share a name, in order."""
    return [part[f"{name}_{k}"] for k in range(sum(own.startswith(f"{name}_") for own in part))]


class Chunks:
    """Draws of a sampler, a part for each chunk: its arrays by name, and the state after it."""

    due = True

    def __init__(self, storage: Storage):
        self.storage = storage
        self.found: tuple[list[np.ndarray], list[Arrays]] | None = None  # leaves of the state; the chunks
        chunks = list[Arrays]()
        for number in range(len(storage.numbers)):
            part = storage.read(number)
            chunks.append({name.removeprefix(DRAWS): own for name, own in part.items() if name.startswith(DRAWS)})
            self.found = numbered(part, "state"), chunks

    def write(self, state: Sequence[Any], course: Sequence[Arrays]) -> None:
        """Append the chunks that are not there yet, with the leaves of the state after them."""
        leaves = {f"state_{k}": np.asarray(leaf) for k, leaf in enumerate(state)}
        for number in range(len(self.storage.numbers), len(course)):
            self.storage.add(number, {DRAWS + name: array for name, array in course[number].items()} | leaves)


class Checkpoint:
    """State and course of one loop of a fit, in one part that is written anew while the loop runs.

    The part of a loop that began otherwise is left out.
    """

    def __init__(self, storage: Storage, number: int, first: Sequence[Any]):
        self.storage, self.number, self.later = storage, number, time.monotonic() + EVERY
        self.begun = np.array(hashlib.sha256(b"".join(np.asarray(leaf).tobytes() for leaf in first)).hexdigest())
        self.found: tuple[list[np.ndarray], list[np.ndarray]] | None = None  # leaves of the state; the course
        if number in storage.numbers and (part := storage.read(number))["begun"] == self.begun:
            self.found = numbered(part, "state"), numbered(part, "course")

    @property
    def due(self) -> bool:
        """True where the state has not been written for some time."""
        return time.monotonic() >= self.later

    def write(self, state: Sequence[Any], course: Sequence[Any]) -> None:
        """Replace the part."""
        before = time.monotonic()
        named = {
            f"{kind}_{k}": leaf for kind, own in (("state", state), ("course", course)) for k, leaf in enumerate(own)
        }
        self.storage.add(self.number, named | {"begun": self.begun})
        now = time.monotonic()
        self.later = now + max(EVERY, SELDOM * (now - before))


class Records:
    """Records of numbered runs, arrays by field; several runs share a part."""

    def __init__(self, storage: Storage):
        self.storage = storage
        self.records: dict[int, dict[str, np.ndarray]] = {}
        for number in storage.numbers:
            for name, array in storage.read(number).items():
                run, _, field = name.partition(" ")
                self.records.setdefault(int(run), {})[field] = array

    def add(self, runs: Sequence[int], records: Sequence[Arrays]) -> None:
        """Keep the records of some runs, in one part."""
        named = {
            f"{run} {field}": np.asarray(value)
            for run, record in zip(runs, records, strict=True)
            for field, value in record.items()
        }
        self.storage.add(runs[0], named)
        for run, record in zip(runs, records, strict=True):
            self.records[run] = {field: np.asarray(value) for field, value in record.items()}
