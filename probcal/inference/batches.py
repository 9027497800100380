"""Results of many runs on their way to disk: a folder with one file a batch, whole or absent, safe against a kill."""

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from probcal.errors import InputError

NAME = "runs.json"
Record = Mapping[str, Any]  # arrays of one run by name


class Batches:
    """Records of runs by number; in memory, or in a folder where `path` is given. Threads may add at once."""

    def __init__(self, path: Path | None, name: Mapping[str, str], *, resume: bool):
        self.path = path
        self.records: dict[int, dict[str, np.ndarray]] = {}
        if path is None:
            return
        path.mkdir(parents=True, exist_ok=True)
        if resume and (path / NAME).exists():
            other = json.loads((path / NAME).read_text())
            for key, value in name.items():
                if other.get(key) != value:
                    raise InputError(
                        f"resume: the runs in {path} have another {key}; go on as they began, or give another folder"
                    )
            for file in sorted(path.glob("batch-*.npz")):
                self._read(file)
            return
        for file in (*path.glob("batch-*.npz"), *path.glob(".batch-*.part.npz")):
            file.unlink(missing_ok=True)
        draft = path / f".{NAME}.{os.getpid()}.part"
        draft.write_text(json.dumps(dict(name), indent=1))
        os.replace(draft, path / NAME)

    def _read(self, file: Path) -> None:
        with np.load(file) as saved:
            for name in saved.files:
                run, _, field = name.partition(" ")
                self.records.setdefault(int(run), {})[field] = saved[name]

    def add(self, runs: Sequence[int], records: Sequence[Record]) -> None:
        """Keep the records of some runs, in one file."""
        if self.path is not None:
            named: dict[str, Any] = {
                f"{run} {field}": np.asarray(value)
                for run, record in zip(runs, records, strict=True)
                for field, value in record.items()
            }
            draft = self.path / f".batch-{runs[0]:06d}.{os.getpid()}.part.npz"
            np.savez(draft, **named)
            os.replace(draft, self.path / f"batch-{runs[0]:06d}.npz")
        for run, record in zip(runs, records, strict=True):
            self.records[run] = {field: np.asarray(value) for field, value in record.items()}
