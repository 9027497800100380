"""Draws on their way to disk: a folder of whole chunks and the state to go on from, safe against a kill."""

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from probcal.errors import InputError

STATE = "state.npz"


class Store:
    """Chunks of draws and the state after the last; in memory, or in a folder where `path` is given.

    Every file is written aside and renamed: it is whole or absent. A chunk counts once the state after it is there, so
    that a killed run loses one chunk at most.
    """

    def __init__(self, path: Path | None, name: Mapping[str, str], *, resume: bool):
        self.path, self.name = path, json.dumps(dict(name), sort_keys=True)
        self.count = 0
        self._state: list[np.ndarray] | None = None
        self._chunks: list[dict[str, np.ndarray]] = []
        if path is None:
            return
        path.mkdir(parents=True, exist_ok=True)
        if resume and (path / STATE).exists():
            self._take_up(path)
        else:
            self.clear()

    def _take_up(self, path: Path) -> None:
        with np.load(path / STATE) as saved:
            other = json.loads(str(saved["name"]))
            mine = json.loads(self.name)
            for key in mine:
                if mine[key] != other.get(key):
                    raise InputError(
                        f"--resume: the run in {path} has another {key}; resume it as it began, or give another --out"
                    )
            self.count = int(saved["count"])
            self._state = [saved[f"leaf_{k}"] for k in range(int(saved["leaves"]))]

    @property
    def state(self) -> list[np.ndarray] | None:
        """Leaves of the state after the last whole chunk, None before any."""
        return self._state

    def add(self, chunk: Mapping[str, np.ndarray], state: Sequence[Any]) -> None:
        """Append a chunk of draws, (chains, draws, ...) by name, and the leaves of the state after it."""
        leaves = [np.asarray(leaf) for leaf in state]
        if self.path is None:
            self._chunks.append(dict(chunk))
        else:
            _write_chunk(self.path / f"chunk-{self.count:06d}.nc", chunk)
        self.count += 1
        self.keep(leaves)

    def keep(self, leaves: Sequence[np.ndarray]) -> None:
        """Write the state alone."""
        self._state = list(leaves)
        if self.path is None:
            return
        draft = self.path / f".{STATE}.{os.getpid()}.part.npz"
        named: dict[str, Any] = {f"leaf_{k}": leaf for k, leaf in enumerate(leaves)}
        np.savez(draft, name=np.array(self.name), count=self.count, leaves=len(leaves), **named)
        os.replace(draft, self.path / STATE)

    def chunks(self) -> list[dict[str, np.ndarray]]:
        """All whole chunks."""
        return self._chunks if self.path is None else [_read_chunk(p) for p in self._files()[: self.count]]

    def _files(self) -> list[Path]:
        return sorted(self.path.glob("chunk-*.nc")) if self.path is not None else []

    def clear(self) -> None:
        """Forget everything, on disk too."""
        self.count, self._state, self._chunks = 0, None, []
        if self.path is not None:
            for file in [self.path / STATE, *self._files(), *self.path.glob(".*.part*")]:
                file.unlink(missing_ok=True)


def _write_chunk(path: Path, chunk: Mapping[str, np.ndarray]) -> None:
    draft = path.with_name(f".{path.name}.{os.getpid()}.part")
    values = {
        name: (("chain", "draw", *(f"{name}_{k}" for k in range(array.ndim - 2))), np.asarray(array))
        for name, array in chunk.items()
    }
    xr.Dataset(values).to_netcdf(draft, engine="h5netcdf")
    os.replace(draft, path)


def _read_chunk(path: Path) -> dict[str, np.ndarray]:
    with xr.open_dataset(path, engine="h5netcdf") as chunk:
        return {str(name): chunk[name].values for name in chunk.data_vars}
