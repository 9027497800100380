"""The fits of a study: arrays by setting, method and run, in memory, and beside them in one zarr store.

The store is laid out as the Dataset that `study` returns. A chunk holds all methods and BATCH runs of one point of the
grid; it is written whole, with a checksum, its statuses last, so that what a kill leaves is "not done". Statuses are
integer codes, their words in the attributes `flag_values` and `flag_meanings` (CF conventions). One process writes, any
may read meanwhile.
"""

from __future__ import annotations

import itertools
import json
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from probcal.errors import InputError
from probcal.files import AnyPath, cannot_write
from probcal.inference.manifest import MARK, OVERWRITE, STORE, clear_store, store_mark
from probcal.inference.storage import Storage
from probcal.lazy import Later, xr
from probcal.results.schema import INTERVAL
from probcal.status import Status

if TYPE_CHECKING:
    import zarr
    from zarr import codecs
else:
    xr, zarr, codecs = Later("xarray"), Later("zarr"), Later("zarr.codecs")

BATCH = 10  # runs of one chunk
SCALARS = ("bias_rmse", "coverage", "position_rmse")  # one number a fit
VECTORS = ("error", "lower", "upper", "true", "sd", "gamma")  # by bias, over its scale; the interval less the truth
CODED = ("ran", "status")  # words that are stored as codes; the status comes last of all
LAYOUT = "layout"  # attribute of the store: settings, methods, runs and biases, as JSON
ORDER = ("problem", *SCALARS, "iterations", *VECTORS, *CODED)  # in which a chunk is written
UNDONE = -1  # code of a fit that is not done
Record = Mapping[str, Any]


class _Layout(NamedTuple):
    """The dims of the arrays."""

    axes: dict[str, list[Any]]
    methods: list[str]
    runs: list[int]
    labels: list[str]

    def dims(self, name: str) -> tuple[str, ...]:
        """Dims of an array."""
        if name == "problem":
            return (*self.axes, "run")
        return (*self.axes, "estimator", "run", *(["bias_label"] if name in VECTORS else []))

    def sizes(self, runs: int | None = None) -> dict[str, int]:
        """Sizes of all dims, or of a chunk of so many runs."""
        own = {"estimator": len(self.methods), "bias_label": len(self.labels)}
        if runs is None:
            return own | {name: len(values) for name, values in self.axes.items()} | {"run": len(self.runs)}
        return own | dict.fromkeys(self.axes, 1) | {"run": runs}

    def shape(self, name: str, runs: int | None = None) -> tuple[int, ...]:
        """Shape of an array, or of its chunks."""
        sizes = self.sizes(runs)
        return tuple(sizes[dim] for dim in self.dims(name))

    def chunks(self) -> Iterator[tuple[tuple[int, ...], int]]:
        """The grid point and the block of runs of every chunk."""
        counts = (*map(len, self.axes.values()), -(-len(self.runs) // BATCH))
        yield from ((where[:-1], where[-1]) for where in itertools.product(*map(range, counts)))

    def coordinates(self) -> dict[str, list[Any]]:
        """Values along each dim."""
        return {**self.axes, "estimator": self.methods, "run": self.runs, "bias_label": self.labels}


def _empty(name: str, shape: tuple[int, ...]) -> np.ndarray:
    """An array of fits that are not done."""
    if name in CODED:
        return np.full(shape, UNDONE, np.int8)
    return np.zeros(shape, np.int64) if name in ("iterations", "problem") else np.full(shape, np.nan)


class Fits:
    """The fits of a study, beside them a store where `path` is given."""

    def __init__(
        self, layout: _Layout, words: Mapping[str, list[str]], arrays: dict[str, np.ndarray], path: Path | None = None,
        digest: str = "",
    ):  # fmt: skip
        self._layout, self._words, self._arrays, self._path, self._digest = layout, words, arrays, path, digest
        self._group: Any = None  # the store, once it is written to

    def missing(self, point: Mapping[str, Any]) -> list[list[int]]:
        """Runs of a grid point that are not done by every method, those of a chunk together."""
        runs, done = self._layout.runs, np.zeros(len(self._layout.runs), bool)
        if self._arrays:
            done = (self._arrays["status"][self._at(point)] != UNDONE).all(0)
        blocks = [[run for k, run in block if not done[k]] for block in itertools.batched(enumerate(runs), BATCH)]
        return [block for block in blocks if block]

    def count(self, axes: Mapping[str, list[Any]], runs: Sequence[int]) -> int:
        """Fits that are done, of some settings and runs."""
        return int((self._chosen("status", axes, runs) != UNDONE).sum()) if self._arrays else 0

    def problems(self) -> list[tuple[dict[str, Any], int, int]]:
        """Grid point, run and number of the problems that are known."""
        if not self._arrays:
            return []
        found, axes = self._arrays["problem"], self._layout.axes
        return [
            (
                {name: values[i] for (name, values), i in zip(axes.items(), where, strict=False)},
                self._layout.runs[where[-1]], int(found[tuple(where)]),
            )
            for where in np.argwhere(found).tolist()
        ]  # fmt: skip

    def add(self, point: Mapping[str, Any], records: Sequence[Record]) -> None:
        """Keep the records of some runs of one grid point, runs of one chunk.

        Raises `InputError` where they name other biases, and where the store cannot be written.
        """
        labels = list(records[0]["labels"])
        if not self._arrays:
            self._layout = self._layout._replace(labels=labels)
            self._arrays = {name: _empty(name, self._layout.shape(name)) for name in ORDER}
        if any(list(record["labels"]) != self._layout.labels for record in records):
            raise InputError("study: the settings have different biases; make one study for each network")
        at, runs, known = self._at(point), [], sum(map(len, self._words.values()))
        for record in records:
            run = self._layout.runs.index(record["run"])
            where = (*at, self._layout.methods.index(record["method"]), run)
            for name in (*SCALARS, "iterations", *VECTORS):
                self._arrays[name][where] = record[name]
            for name in CODED:
                self._arrays[name][where] = self._code(name, record[name])
            if "problem" in record:
                self._arrays["problem"][*at, run] = record["problem"]
            runs.append(run)
        if self._path is not None:
            self._write(self._path / STORE, at, runs[0] // BATCH, sum(map(len, self._words.values())) > known)

    def _at(self, point: Mapping[str, Any]) -> tuple[int, ...]:
        return tuple(values.index(point[name]) for name, values in self._layout.axes.items())

    def _code(self, name: str, word: str) -> int:
        words = self._words[name]
        if word not in words:
            words.append(word)
        return words.index(word)

    def _write(self, store: Path, at: tuple[int, ...], block: int, new_words: bool) -> None:
        """Write a chunk of every array, statuses last."""
        try:
            if self._group is None:
                self._group = _prepared(store, self._digest, self._layout, self._words)
            elif new_words:
                _describe(self._group, self._words)
            for name in ORDER:
                where = _region(name, at, block)
                self._group[name][where] = self._arrays[name][where]
        except OSError as error:
            raise cannot_write(store, error) from None

    def _chosen(self, name: str, axes: Mapping[str, list[Any]], runs: Sequence[int]) -> np.ndarray:
        """An array of some settings, in the order of the store, and runs."""
        layout = self._layout
        rows = [[values.index(value) for value in axes[key]] for key, values in layout.axes.items()]
        columns = [layout.runs.index(run) for run in runs]
        others = [range(size) for size in self._arrays[name].shape[len(rows) :]]
        others[0 if name == "problem" else 1] = columns  # type: ignore[call-overload]
        return self._arrays[name][np.ix_(*rows, *others)]

    def dataset(self, axes: Mapping[str, list[Any]] | None = None, runs: Sequence[int] | None = None) -> xr.Dataset:
        """The fits of some settings and runs, of all if left out, as `study` returns them."""
        layout = self._layout
        axes, runs = layout.axes if axes is None else axes, layout.runs if runs is None else runs
        names = (*SCALARS, *reversed(CODED), "iterations", *VECTORS)
        arrays = {name: self._chosen(name, axes, runs) for name in names}
        for name in CODED:
            arrays[name] = np.array([*self._words[name], ""])[arrays[name]]  # UNDONE is the last
        if np.isnan(arrays["position_rmse"]).all():
            del arrays["position_rmse"]
        found = xr.Dataset(
            {name: (layout.dims(name), array) for name, array in arrays.items()},
            coords={**{name: axes[name] for name in layout.axes}, "estimator": layout.methods, "run": list(runs),
                    "bias_label": layout.labels},
            attrs={"interval_probability": INTERVAL},
        )  # fmt: skip
        return found.transpose(*axes, "estimator", "run", "bias_label")


def open_fits(storage: Storage, axes: Mapping[str, list[Any]], methods: Sequence[str], runs: Sequence[int]) -> Fits:
    """The fits that a storage holds, with room for those of some settings and runs.

    Raises `InputError` where a file of the store is damaged, and where it is of other settings.
    """
    layout = _Layout({name: list(values) for name, values in axes.items()}, list(methods), list(runs), [])
    path = storage.path
    if path is None or not store_mark(path):
        words = {"status": [str(status) for status in Status], "ran": []}
        return Fits(layout, words, {}, path, storage.digest)
    clear_store(path, drafts=True)
    stored = _Stored(path)
    if stored.digest != storage.digest:
        raise InputError(f"{stored.path} does not belong to the run of its folder; give another, or {OVERWRITE}")
    if set(stored.layout.axes) != set(axes):
        raise InputError(
            f"{stored.path} is a study over {', '.join(stored.layout.axes) or 'runs alone'}; vary the same, give"
            f" another folder, or {OVERWRITE}"
        )
    layout, arrays = _united(stored.layout, layout), stored.read()
    for name, array in arrays.items():
        room = [(0, wanted - there) for wanted, there in zip(layout.shape(name), array.shape, strict=True)]
        arrays[name] = np.pad(array, room, constant_values=_empty(name, ()).item())
    return Fits(layout, stored.words, arrays, path, storage.digest)


def load_study(path: AnyPath) -> xr.Dataset:
    """Read the finished fits of a study from its `store`, or from the --out of `probcal study`, while it runs too.

    The Dataset is that of `study`; fits that are not finished are NaN, with an empty `status`. Raises `InputError`
    where there is no study, or none of its fits is finished, and where a file is damaged.
    """
    folder = Path(path)
    folder = next((found for found in (folder, folder / "runs") if store_mark(found)), folder)
    if not store_mark(folder):
        raise InputError(f"{path} holds no finished fits of a study; give its store, or the --out of probcal study")
    stored = _Stored(folder)
    fits = Fits(stored.layout, stored.words, stored.read())
    return fits.dataset().assign_attrs(identity=stored.digest)


class _Stored:
    """A store that is there."""

    def __init__(self, folder: Path):
        self.path = folder / STORE
        try:
            group = zarr.open_group(self.path, mode="r", use_consolidated=False)
            self.digest = str(group.attrs[MARK])
            self.layout = _Layout(**json.loads(str(group.attrs[LAYOUT])))
            self._found: dict[str, Any] = {name: group[name] for name in ORDER}
            self.words = {name: [str(word) for word in self._found[name].attrs["words"]] for name in CODED}
        except Exception as error:  # whatever zarr says of foreign bytes
            raise self._useless(error) from None

    def _useless(self, error: Exception) -> InputError:
        return InputError(
            f"{self.path} cannot be read ({type(error).__name__}: {error}); give another folder, or {OVERWRITE}"
        )

    def read(self) -> dict[str, np.ndarray]:
        """All arrays by name; what lacks a file of its chunk is not done."""
        arrays = {name: self._array(name) for name in reversed(ORDER)}  # statuses first: another may be writing
        for where, block in self.layout.chunks():
            done = (arrays["status"][_region("status", where, block)] != UNDONE).any()
            if done and not all(self._file(name, where, block).is_file() for name in ORDER):
                for name in ORDER:
                    arrays[name][_region(name, where, block)] = _empty(name, ())
        return arrays

    def _array(self, name: str) -> np.ndarray:
        """One array, without what a kill left beyond its sizes."""
        try:
            return np.array(self._found[name][tuple(map(slice, self.layout.shape(name)))])
        except Exception as error:  # a checksum, or whatever codecs say of foreign bytes
            raise self._damage(name, error) from None

    def _damage(self, name: str, error: Exception) -> InputError:
        """The sentence about the file of an array that cannot be read."""
        for where, block in self.layout.chunks():
            try:
                self._found[name][_region(name, where, block)]
            except Exception as found:
                return InputError(
                    f"{self._file(name, where, block)} is damaged ({type(found).__name__}): delete it and --resume"
                    f" (resume=True) makes it anew, or {OVERWRITE}"
                )
        return self._useless(error)

    def _file(self, name: str, where: tuple[int, ...], block: int) -> Path:
        """The file of a chunk."""
        parts = (*where, block) if name == "problem" else (*where, 0, block, *([0] if name in VECTORS else []))
        return self.path / name / "c" / "/".join(map(str, parts))


def _region(name: str, where: tuple[int, ...], block: int) -> tuple[Any, ...]:
    """The part of an array that one chunk holds."""
    runs = slice(block * BATCH, (block + 1) * BATCH)
    return (*where, runs) if name == "problem" else (*where, slice(None), runs)


def _united(there: _Layout, wanted: _Layout) -> _Layout:
    """A layout with more settings and runs behind those that are there."""

    def more(old: list[Any], new: list[Any]) -> list[Any]:
        return [*old, *(value for value in new if value not in old)]

    axes = {name: more(values, wanted.axes[name]) for name, values in there.axes.items()}
    return there._replace(axes=axes, runs=more(there.runs, wanted.runs))


def _prepared(store: Path, digest: str, layout: _Layout, words: Mapping[str, list[str]]) -> Any:
    """The zarr group of a store, made or made larger; what says that it is complete comes last."""
    if store_mark(store.parent):
        group: Any = zarr.open_group(store, mode="r+", use_consolidated=False)
        for name in ORDER:
            group[name].resize(layout.shape(name))  # files of chunks stay what they are
    else:
        clear_store(store.parent)
        group = zarr.create_group(store, zarr_format=3)
        for name in ORDER:
            empty = _empty(name, ())
            group.create_array(
                name, shape=layout.shape(name), chunks=layout.shape(name, BATCH), dtype=empty.dtype,
                fill_value=empty.item(), dimension_names=layout.dims(name), config={"write_empty_chunks": True},
                compressors=[codecs.ZstdCodec(), codecs.Crc32cCodec()],
            )  # fmt: skip
    for name, values in layout.coordinates().items():
        array = np.asarray(values)
        made = group.create_array(
            name, shape=array.shape, chunks=array.shape, dtype=str if array.dtype.kind == "U" else array.dtype,
            dimension_names=(name,), overwrite=True,
        )  # fmt: skip
        made[:] = array
    attributes = {MARK: digest, LAYOUT: json.dumps(layout._asdict()), "interval_probability": INTERVAL}
    _describe(group, words, attributes)
    return group


def _describe(group: Any, words: Mapping[str, list[str]], attributes: Mapping[str, Any] | None = None) -> None:
    """Write the words of the codes, and attributes of the whole, where readers look first."""
    for name in CODED:
        flags = {"flag_values": list(range(len(words[name]))), "flag_meanings": " ".join(
            word.replace(" ", "_") for word in words[name])}  # fmt: skip
        group[name].update_attributes({"words": words[name], **flags})
    if attributes is not None:
        group.update_attributes(dict(attributes))
    with warnings.catch_warnings():  # no part of the zarr specification yet; xarray reads it
        warnings.simplefilter("ignore")
        zarr.consolidate_metadata(group.store)
