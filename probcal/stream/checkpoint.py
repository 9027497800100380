"""The state of an online filter as bytes, so that a killed one goes on where it was; sealed and checked where read."""

from __future__ import annotations

import hashlib
import io
import json
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from functools import reduce
from typing import Any

import jax
import numpy as np

from probcal.errors import InputError
from probcal.inference.manifest import check_same
from probcal.lazy import pd
from probcal.model.motions import Area
from probcal.results.io import SEAL
from probcal.stream.arrivals import CarriedTarget
from probcal.stream.online import Jump, Online, ParticleFilter
from probcal.stream.surveillance import BATCH, Event
from probcal.table import Table, measure
from probcal.types import float64

VERSION = 4
LARGEST = 2**63  # above every count, and every integer that an array holds
REMEDY = "move it away to begin anew, or give another --out"

Kind = Callable[[Any], Any]  # the value of a JSON member as the filter holds it; raises `ValueError` for another kind


def real(value: Any) -> float:
    """A finite number."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not np.isfinite(float(value)):
        raise ValueError("a finite number")
    return float(value)


def positive_real(value: Any) -> float:
    """A positive number."""
    if not real(value) > 0:
        raise ValueError("a positive number")
    return float(value)


def moment(value: Any) -> float:
    """A time in s, -inf before the first row."""
    return -np.inf if value == -np.inf else real(value)


def whole(value: Any) -> int:
    """A count, an index or bits."""
    if type(value) is not int or not 0 <= value < LARGEST:
        raise ValueError("an integer from 0")
    return value


def flag(value: Any) -> bool:
    """True or false."""
    if not isinstance(value, bool):
        raise ValueError("true or false")
    return value


def text(value: Any) -> str:
    """A text."""
    if not isinstance(value, str):
        raise ValueError("a text")
    return value


def cell(value: Any) -> Any:
    """A cell of a table: a number, a flag, a text such as `<-95`, or blank."""
    if not isinstance(value, (str, float, bool, int, type(None))) or (type(value) is int and abs(value) >= LARGEST):
        raise ValueError("a cell of a table")
    return value


def level(value: Any) -> float:
    """A number, NaN where a target has none."""
    if not isinstance(value, float) or np.isinf(value):
        raise ValueError("a number")
    return value


def optional(kind: Kind) -> Kind:
    """A value that may be absent."""
    return lambda value: None if value is None else kind(value)


def many(kind: Kind, make: Callable[[Any], Any] = list) -> Kind:
    """A list, from which something is made."""

    def listed(value: Any) -> Any:
        if not isinstance(value, list):
            raise ValueError("a list")
        return make([kind(part) for part in value])

    return listed


def named(kind: Kind, make: Callable[[Any], Any] = dict) -> Kind:
    """Values by name."""

    def by_name(value: Any) -> Any:
        if not isinstance(value, dict):
            raise ValueError("values by name")
        return make({name: kind(part) for name, part in value.items()})

    return by_name


def record(make: Callable[..., Any], *kinds: Kind) -> Kind:
    """A list of values of stated kinds, from which something is made."""

    def made(value: Any) -> Any:
        if not isinstance(value, list) or len(value) != len(kinds):
            raise ValueError(f"a list of {len(kinds)}")
        return make(*(kind(part) for kind, part in zip(kinds, value, strict=True)))

    return made


def frame(further: Kind, **kinds: Kind) -> Kind:
    """A table with some columns and the kinds of their cells, and the kind of those of further columns."""

    def table(value: Any) -> pd.DataFrame:
        columns = named(many(lambda part: part))(value)
        if missing := [name for name in kinds if name not in columns]:
            raise ValueError(f"a table with the column {missing[0]}")
        if len({len(column) for column in columns.values()}) > 1:
            raise ValueError("a table with columns of one length")
        return pd.DataFrame({name: many(kinds.get(name, further))(column) for name, column in columns.items()})

    return table


def pair(*parts: Any) -> tuple[Any, ...]:
    """Values as a tuple."""
    return parts


VECTOR = many(real, np.array)
COUNTS = named(whole, Counter)
ROW: dict[str, Kind] = {"time": real, "sensor": text, "target": text}
ROWS = frame(cell, **ROW, cells=whole, line=whole)
TRACKS = frame(level, time=real, target=text)
SEEN = record(pair, text, whole, real)  # sensor, cells and own time of a row
MEMBERS: dict[str, Kind] = {  # of an `Online`, by path: those of its arrivals come first and make its problem
    "arrivals.counts": COUNTS,
    "arrivals.targets": named(record(CarriedTarget, whole, whole, moment, many(SEEN, tuple))),
    "arrivals.origin": text,
    "arrivals.area": optional(record(Area, whole, VECTOR, positive_real, positive_real)),
    "arrivals.duration": positive_real,
    "arrivals.floors": many(record(pair, whole, text, real)),
    "arrivals.earlier": named(VECTOR),
    "arrivals.first": optional(whole),
    "arrivals.latest": moment,
    "arrivals.until": moment,
    "arrivals.samples": optional(frame(cell, **ROW, _kind=text, _group=text)),
    "doubts": COUNTS,
    "points": many(record(pair, record(pair, real, text), record(pair, VECTOR, VECTOR)), dict),
    "pending": optional(ROWS),
    "recent": optional(ROWS),
    "lately": optional(TRACKS),
    "log_evidence": real,
    "epochs": whole,
    "time": moment,
    "walked": moment,
    "since": many(moment),
    "jumps": many(record(Jump, text, *[real] * 6)),
    "last": optional(ROWS),
    "check.changed": named(whole),
    "check.events": many(record(Event, text, text, text, real, optional(real), real)),
    "check.targets": named(many(flag)),
    "check.snapshots": many(record(pair, real, VECTOR, VECTOR)),
    "check.moments": whole,
    "check.restarts": whole,
    "check.cause": text,
}
RANGES: dict[str, Callable[[np.ndarray, np.ndarray], Any]] = {  # by leaf: whether it, and that before rows, are sound
    "root": lambda leaf, _: np.isfinite(np.square(leaf)) & (np.square(leaf).sum(-1, keepdims=True) > 0),
    "information": lambda leaf, _: leaf >= 0,
    "bias": lambda leaf, before: leaf == before,
    "origin": lambda leaf, _: (leaf >= 0) & (leaf < len(leaf)),
    "log_weight": lambda leaf, _: (leaf < 1e-6) & np.isfinite(leaf.max()),
    **dict.fromkeys(("seen", "held", "number", "square", "median"), lambda leaf, _: leaf >= 0),
    "fill": lambda leaf, _: (leaf >= 0) & (leaf < BATCH),
    "recent": lambda leaf, _: np.abs(leaf) <= 1,
}


def pack_state(online: Online, beside: dict[str, Any]) -> bytes:
    """Everything that a filter knows, and what the caller keeps beside it (JSON), sealed by a digest."""
    found: dict[str, Any] = {path: reduce(getattr, path.split("."), online) for path in MEMBERS}
    found["points"] = list(found["points"].items())
    head = {"version": VERSION, "method": repr(online.method), "identity": online.identity}
    trees = {name: getattr(online, name) for name in ("belief", "end", "cloud")} | {"tallies": online.check.tallies}
    arrays: dict[str, Any] = {name: np.asarray(leaf) for name, leaf in _leaves(trees)}
    if online.arrivals.tried is not None:
        arrays["tried"] = online.arrivals.tried
    said = json.dumps(head | {"members": found, "beside": beside}, default=_plain)
    packed = io.BytesIO()
    np.savez(packed, said=np.frombuffer(said.encode(), np.uint8), **arrays)
    return sealed(packed.getvalue())


def sealed(content: bytes) -> bytes:
    """A content with its digest behind it."""
    return b"".join([content, SEAL, hashlib.sha256(content).digest()])


@float64
def unpack_state(online: Online, content: bytes, source: str) -> Any:
    """Bring a fresh filter of the same declarations and settings to a snapshot; what was kept beside it.

    Raises `InputError` where the snapshot is damaged, or of another network, motion or settings.
    """
    said, arrays = _opened(content, source)
    head = read_members(said, {"method": text, "identity": named(text)}, source)
    if head["method"] != repr(online.method):
        raise InputError(
            f"{source} is the checkpoint of other settings, {head['method']}; give those, or another --out"
        )
    check_same(source, online.identity, head["identity"], "give another --out, or move it away")
    members = read_members(said.get("members"), MEMBERS, source)
    arrivals = online.arrivals
    for path, value in members.items():
        if path.startswith("arrivals."):
            setattr(arrivals, path.partition(".")[2], value)
    if arrivals.samples is not None:
        arrivals.tried = arrays.pop("tried", None)
        area, tried, d = arrivals.area, arrivals.tried, online.network.dimension
        if area is None or (area.dimension, area.centre.shape) != (d, (d,)):
            raise _changed(source, "arrivals.area", "is not that of the network")
        if tried is None or tried.shape[1:] != (d,) or tried.dtype != float or not np.isfinite(tried).all():
            raise _changed(source, "tried", "holds no places")
        with _naming(source, "arrivals.samples"):
            arrivals.rebuild()
        online.prepare()
    for path, value in members.items():
        if not path.startswith("arrivals."):
            *owner, name = path.split(".")
            setattr(reduce(getattr, owner, online), name, value)
    _restore(online, arrays, source)
    _check(online, source)
    return said.get("beside")


def read_members(said: Any, kinds: Mapping[str, Kind], source: str) -> dict[str, Any]:
    """Values of JSON members by name; raises `InputError` naming one that is missing or of another kind."""
    found = {}
    for name, kind in kinds.items():
        if not isinstance(said, dict) or name not in said:
            raise _changed(source, name, "is missing")
        try:
            found[name] = kind(said[name])
        except (ValueError, OverflowError) as error:
            raise _changed(source, name, f"does not hold {error}") from None
    return found


def _opened(content: bytes, source: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """JSON and arrays of a state."""
    left = len(content) - len(sealed(b""))
    try:
        if left < 0 or sealed(content[:left]) != content:
            raise ValueError("wrong digest")
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            arrays = dict(file.items())
        said = json.loads(arrays.pop("said").tobytes())
        if said["version"] != VERSION:
            raise ValueError("other version")
    except Exception:  # whatever NumPy and zipfile say of foreign bytes
        raise InputError(f"{source} is damaged, or no state of this version of probcal watch; {REMEDY}") from None
    return said, arrays


def _restore(online: Online, arrays: Mapping[str, np.ndarray], source: str) -> None:
    """Put the stored arrays in the place of those of a filter that has just begun, whose form they must have."""
    if online.belief is None:
        return
    trees = {"belief": online.belief, "end": online.belief, "cloud": online.cloud, "tallies": online.check.tallies}
    before = {name: np.asarray(leaf) for name, leaf in _leaves(trees)}
    if other := sorted(before.keys() ^ arrays.keys()):
        raise _changed(source, other[0], "is missing" if other[0] in before else "is not known")
    for name, first in before.items():
        leaf, last = arrays[name], "" if ".states." in name else name.rpartition(".")[2]
        if (leaf.shape, leaf.dtype) != (first.shape, first.dtype):
            raise _changed(source, name, f"has the form {leaf.dtype}{leaf.shape}, not {first.dtype}{first.shape}")
        if not (np.isfinite(leaf).all() or last == "log_weight") or not np.all(RANGES.get(last, _any)(leaf, first)):
            raise _changed(source, name, "holds numbers that no filter has")
    found = jax.tree.unflatten(jax.tree.structure(trees), [arrays[name] for name in before])
    online.check.tallies = found.pop("tallies")
    for name, tree in found.items():
        setattr(online, name, tree)


def _check(online: Online, source: str) -> None:
    """Raise `InputError` naming a member that does not fit the problem of a filter."""
    arrivals, template = online.arrivals, online.arrivals.template
    for name in ("pending", "recent"):
        if (getattr(online, name) is None) != (template is None):
            raise _changed(source, name, "is absent, or should be")
    check = online.check
    if not {*check.changed, *(own.sensor for own in check.events)} <= {*check.owners, ""}:
        raise _changed(source, "check.events", "names a sensor that the network does not have")
    if template is None:
        return
    seats = [(own.recursion, own.slot) for own in arrivals.targets.values()]
    if any({len(mean), len(variance)} != {template.model.biases} for _, mean, variance in check.snapshots):
        raise _changed(source, "check.snapshots", "holds snapshots of other biases")
    R, sizes = len(template.epochs), [part.drift.shape[1] for part in template.model.recursions]
    if len(set(seats)) < len(seats) or any(r >= R or slot >= arrivals.most for r, slot in seats):
        raise _changed(source, "arrivals.targets", "holds targets that have no place in the filter")
    widths = {name: (sizes[own.recursion], template.model.biases) for name, own in arrivals.targets.items()}
    if any((len(x), len(z)) != widths.get(name) for (_, name), (x, z) in online.points.items()):
        raise _changed(source, "points", "holds points that no target has")
    if len(online.since) != online._starts:
        raise _changed(source, "since", f"does not hold {online._starts} times")
    if not np.isfinite(online.time):
        raise _changed(source, "time", "is not the time of a row")
    if not {jump.label for jump in online.jumps} <= set(template.labels):
        raise _changed(source, "jumps", "names a bias that the network does not have")
    if (online.lately is None) == isinstance(online.method, ParticleFilter):
        raise _changed(source, "lately", "is absent, or should be")
    for name in ("pending", "recent"):
        table: Any = getattr(online, name)
        with _naming(source, name):
            if len(table):
                measure(Table(table.drop(columns=["cells", "line"]), name, table["line"].to_numpy()), template.network)
            for target in table["target"].unique():
                arrivals.target(target)


def _changed(source: str, name: str, fault: str) -> InputError:
    """The sentence of a member that no filter has written."""
    return InputError(f"{source}: its member {name} {fault}; it was changed, {REMEDY}")


@contextmanager
def _naming(source: str, name: str) -> Iterator[None]:
    """Whatever is raised inside is the fault of a member."""
    try:
        yield
    except Exception as error:  # what a changed table makes of a problem is not foreseen
        raise _changed(source, name, f"does not make a problem ({error})") from None


def _leaves(trees: dict[str, Any]) -> list[tuple[str, Any]]:
    """Name and array of each leaf of pytrees."""
    paths, _ = jax.tree_util.tree_flatten_with_path(trees)
    return [(jax.tree_util.keystr(path, simple=True, separator="."), leaf) for path, leaf in paths]


def _any(*_: Any) -> bool:
    return True


def _plain(value: Any) -> Any:
    """A value that JSON does not know as lists, numbers and texts."""
    if is_dataclass(value):
        return [getattr(value, one.name) for one in fields(value)]
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return value.tolist()
    return {str(name): value[name].tolist() for name in value}  # a table
