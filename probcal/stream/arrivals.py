"""Rows of a stream on their way to a filter: order, late and repeated ones, targets that come and go, arrays."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from probcal.errors import InputError
from probcal.labels import AXES, NOBODY
from probcal.lazy import pd
from probcal.model.epochs import Epoch, merged, slots
from probcal.model.motions import Area, linear_of, start_of
from probcal.modes.grid import candidates
from probcal.motion import Target, as_motion
from probcal.network import Network
from probcal.noise import Heard, Normal
from probcal.plausible import implausible
from probcal.problem import Problem, check_linear, declared_target
from probcal.stream.counted import COUNTED, STREAMS, Counted, Stream, first_key
from probcal.table import Table, header, measure, name_as_text, names_as_text

ONLY = "target"  # the target of a table that names none


class Batch(NamedTuple):
    """Epochs in time order (K leading, as NumPy), and what they are of."""

    epochs: Epoch
    time: np.ndarray  # (K,)
    target: np.ndarray  # (K,) names
    row: np.ndarray  # (rows,) of the frame: the epoch of each
    owners: tuple[np.ndarray, ...]  # (K, D, 2) of each recursion: number of the channel, -1 for none, row of the frame
    numbers: tuple[np.ndarray, ...]  # (K, D, 2) likewise: measured value, std of its noise


@dataclass
class CarriedTarget:
    """A target that the filter carries: its slot, the time up to which it was filtered, and what was seen then."""

    recursion: int
    slot: int
    time: float
    keys: tuple[tuple[str, int, float], ...] = ()  # sensor, cells and own time of the rows at that time


@dataclass
class Arrivals:
    """Converts rows into epochs.

    A row that cannot be meant (`probcal.plausible`, beside the last values of each column) or that the calibration
    has counted is refused. A row that is earlier than the time up to which its target was filtered is late (where
    biases move, than that of any target), one that repeats time, sensor, target and channels of another is a
    duplicate; both are left out and counted. With an `epoch` (s) rows count as of the nearest multiple of it. Rows of
    one call, and those that are still in the window, are brought into order. A new target takes a free slot, or that of
    the target that has been silent for longest.
    """

    network: Network
    motion: Any
    fixed: Mapping[str, float]
    most: int  # targets that are carried at once
    linear: bool = True  # whether every motion must have a linear form
    epoch: float | None = None  # s, length of common epochs; without it rows keep their times
    counted: Counted | None = None  # rows that the calibration has counted
    counts: Counter[str] = field(default_factory=Counter)
    targets: dict[str, CarriedTarget] = field(default_factory=dict)
    origin: str = ""  # the date of time 0, where times are dates
    samples: pd.DataFrame | None = None  # a row of each form: what the template is made of
    starts: dict[str, dict[str, tuple[Any, float]]] = field(default_factory=dict)
    area: Area | None = None  # where a target starts of which nothing is stated, as the first rows have it
    duration: float = 1.0  # s, of the first rows
    tried: np.ndarray | None = None  # (places, d) that are tried for a new target
    template: Problem | None = None
    sizes: tuple[int, ...] = ()  # rows of an epoch of each block, padded
    earlier: Mapping[str, np.ndarray] = field(default_factory=dict)  # last values of each column, and last times
    first: int | None = None  # key of the first row that was taken
    latest: float = -np.inf  # s, of the rows that were taken
    until: float = -np.inf  # s, up to which the calibration has counted this recording

    def copy(self) -> Arrivals:
        """As it stands now: what rows change is copied."""
        targets = {name: replace(own) for name, own in self.targets.items()}
        return replace(self, counts=self.counts.copy(), targets=targets, starts=dict(self.starts))

    def admit(self, table: Table, pending: pd.DataFrame | None, since: float) -> tuple[pd.DataFrame, pd.DataFrame]:
        """Rows of a table behind those pending, in order, without repeated ones and those before a time; those refused.

        Raises `InputError` for a column that is missing or not understood.
        """
        names, units = header(table)
        for column in ("time", "sensor"):
            if column not in names:
                raise InputError(f'{table.source} has no column "{column}"; a stream needs time and sensor')
        frame = self._in_seconds(table, names, units)
        frame["sensor"] = names_as_text(frame["sensor"])
        blind = frame["sensor"].isin([name_as_text(s.name) for s in self.network.sensors if not s.type.reads_target])
        if "target" in frame:
            frame["target"] = frame["target"].astype(object).mask(frame["target"].isna() & blind, NOBODY)
            blank = frame["target"].isna()
            if blank.any():
                raise InputError(
                    f'{table.where(int(np.flatnonzero(blank)[0]))} column "target" is blank; an online filter takes'
                    " rows that name their target: track_objects(...) finds those of detections"
                )
            frame["target"] = names_as_text(frame["target"])
        elif any(placed.detection is not None for placed in self.network.sensors):
            raise InputError(f"{table.source}: an online filter takes rows that name their target, no detections")
        else:
            frame["target"] = np.where(blind, NOBODY, ONLY)
        reasons = self._reasons(replace(table, frame=frame), units["time"])
        taken = ~np.isin(np.arange(len(frame)), list(reasons))
        data = [c for c in frame.columns if c not in ("time", "sensor", "target")]
        filled = frame[data].notna().to_numpy()
        power = np.int64(1) << (np.arange(len(data), dtype=np.int64) % 63)
        frame["cells"] = filled @ power  # which are filled, as a number
        frame["line"] = table.lines
        frame = frame[taken].reset_index(drop=True)
        codes, kinds = pd.factorize(frame["target"])
        known = [self.targets[name].time if name in self.targets else -np.inf for name in kinds]
        last = np.array(known, float)[codes]
        own = frame["time"].to_numpy(float)
        time = own if self.epoch is None else np.round(own / self.epoch) * self.epoch
        late = time < np.maximum(last, since)
        again = np.zeros(len(frame), bool)
        for n in np.flatnonzero(time == last):
            row = frame.iloc[n]
            again[n] = (row["sensor"], int(row["cells"]), float(row["time"])) in self.targets[row["target"]].keys
        frame = frame[~late & ~again]
        whole = frame if pending is None or pending.empty else pd.concat([pending, frame], ignore_index=True)
        key = whole[["time", "cells"]].assign(**{name: pd.factorize(whole[name])[0] for name in ("sensor", "target")})
        twice = key.duplicated().to_numpy()
        self.counts["rows"] += len(table.frame)
        self.counts["late"] += int(late.sum())
        self.counts["duplicates"] += int(again.sum() + twice.sum())
        self.counts["refused"] += len(reasons)
        refused = refused_rows(table.lines[~taken], [reasons[row] for row in sorted(reasons)])
        return whole[~twice].sort_values("time", kind="stable", ignore_index=True), refused

    def _reasons(self, table: Table, unit: str | None) -> dict[int, str]:
        """Rows that cannot be meant or are counted already, each with its reason; `unit` is that of their times."""
        if table.frame.empty:
            return {}
        network = self._placed
        data = measure(table, network, repeated=True)
        reasons, self.earlier = implausible(data, network, self.earlier, unit)
        taken = data.measured.any(1) & ~np.isin(np.arange(len(data.time)), list(reasons))
        if self.counted is not None:
            known = self.counted.rows(data, network, self.origin) | (data.time <= self.until)
            while self.first is None and (taken & ~known).any():
                row = int((taken & ~known).argmax())
                until = self.counted.until(data, network, row, self.origin)
                if until <= self.until:
                    break
                self.until, known = until, known | (data.time <= until)
            reasons |= {row: f"{table.where(row)}: {COUNTED}" for row in np.flatnonzero(taken & known).tolist()}
            taken &= ~known
        if taken.any() and self.first is None:
            self.first = first_key(data, network, int(taken.argmax()))
        self.latest = max(self.latest, data.time[taken].max(initial=-np.inf))
        return reasons

    def noted(self) -> dict[str, str]:
        """Attributes of a tree that name the rows that it has counted."""
        streams = [] if self.counted is None else [*self.counted.streams]
        if self.first is not None:
            streams.append(Stream(self.first, self.latest, self.origin, 0.0))
        return {STREAMS: json.dumps(streams)} | ({"time_origin": self.origin} if self.origin else {})

    @property
    def _placed(self) -> Network:
        """The network, with the floors of its channels as the first rows have them."""
        return self.network if self.template is None else self.template.network

    def _in_seconds(self, table: Table, names: list[str], units: Mapping[str, str | None]) -> pd.DataFrame:
        """The frame with time in seconds: as they are, or since the first date of the stream."""
        frame = table.frame.copy()
        k = names.index("time")
        column = frame.iloc[:, k]
        found = pd.to_numeric(column, errors="coerce") if column.dtype.kind not in "mM" else None
        if found is not None and not found.isna().any():
            unit = units["time"] or "s"
            factor = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}.get(unit)
            if factor is None:
                raise InputError(
                    f'{table.source} column "time": unit "{unit}" is not a time; use s, ms, us, ns, min or h'
                )
            seconds: np.ndarray = found.to_numpy(float) * factor
        else:
            stamps = pd.to_datetime(column, errors="coerce", utc=True, format=None if found is None else "ISO8601")
            if stamps.isna().any():
                row = int(np.flatnonzero(stamps.isna())[0])
                raise InputError(
                    f'{table.where(row)} column "time": {column.iloc[row]} is not a finite time;'
                    " give seconds or ISO dates"
                )
            self.origin = self.origin or stamps.min().isoformat()
            seconds = (stamps - pd.Timestamp(self.origin)).dt.total_seconds().to_numpy(float)
        if not np.isfinite(seconds).all():
            row = int(np.flatnonzero(~np.isfinite(seconds))[0])
            raise InputError(f'{table.where(row)} column "time": the time is infinite; give seconds or ISO dates')
        frame.isetitem(k, seconds)
        return frame.rename(columns={frame.columns[k]: "time", **{
            frame.columns[names.index(own)]: own for own in ("sensor", "target") if own in names
        }})  # fmt: skip

    def compiled(self, frame: pd.DataFrame, source: str) -> Batch | None:
        """Rows in order as epochs, None where all are blank; raises `InputError` naming a row that cannot be taken."""
        own = frame.drop(columns=["cells", "line"])
        table = Table(own, source, frame["line"].to_numpy())
        network = self._placed
        data = measure(table, network)
        if not data.measured.any():
            if self.template is None:
                raise InputError(f"{len(frame)} rows have no measured value; fill the channel columns")
            return None
        seen = np.isin(data.target, data.target[data.measured.any(1)])
        if not seen.all():  # a target of which nothing was measured has no state
            own = own[seen].reset_index(drop=True)
            table = Table(own, source, table.lines[seen])
            data = measure(table, network)
        self._provide(own, data, source)
        template = self.template
        assert template is not None
        self._seat(template, data.target_names)
        begun = {name: known.time for name, known in self.targets.items() if np.isfinite(known.time)}
        found = template.arrived(data, begun, {name: self.targets[name].slot for name in data.target_names})
        model = found.model
        counts = [np.bincount(np.asarray(d.epoch)).max(initial=0) for d in model.rows]
        old = self.sizes if len(self.sizes) == len(counts) else (1,) * len(counts)
        self.sizes = tuple(max(a, 1 << max(int(b) - 1, 0).bit_length()) for a, b in zip(old, counts, strict=True))
        time = np.concatenate([np.asarray(part.time) for part in model.recursions])
        order = np.argsort(time, kind="stable")
        place = np.empty(len(time), int)
        place[order] = np.arange(len(time))
        starts = np.cumsum([0, *(len(part.time) for part in model.recursions)])
        row = np.full(len(frame), -1)
        owners: list[list[np.ndarray]] = [[np.zeros((len(time), 0, 2), int)] for _ in model.recursions]
        numbers: list[list[np.ndarray]] = [[np.zeros((len(time), 0, 2))] for _ in model.recursions]
        first = np.cumsum([0, *(len(s.type.expand(network.dimension)) for s in network.sensors)])
        for _, block, r, block_rows, size in model.each_block(found.rows, self.sizes):
            mine, epoch = np.flatnonzero(seen)[block_rows], place[starts[r] + np.asarray(block.epoch)]
            row[mine] = epoch
            there, C = np.asarray(block.mask) > 0, block.mask.shape[1]
            at = epoch, slots(epoch, len(time))
            pair = first[data.sensor[block_rows]][:, None] + np.arange(C), np.broadcast_to(mine[:, None], there.shape)
            measured = np.asarray(block.y), np.asarray(block.std)
            for whole, none, columns in ((owners, -1, pair), (numbers, 0.0, measured)):
                cells = np.full((len(time), size, C, 2), none)
                cells[at] = np.where(there[:, :, None], np.stack(columns, 2), none)
                whole[r].append(cells.reshape(len(time), size * C, 2))
        epochs = _held(merged(model, template.model.rows, self.sizes))
        cells_of = [tuple(np.concatenate(parts, 1) for parts in whole) for whole in (owners, numbers)]
        return Batch(epochs, time[order], np.concatenate(found.target)[order], row, *cells_of)

    def _provide(self, frame: pd.DataFrame, data: Any, source: str) -> None:
        """A template with every sensor type and every form of a motion that the rows have."""
        kinds = np.array([s.type.name for s in self.network.sensors])
        groups = [self._group(name) for name in data.target_names]
        measured = np.flatnonzero(data.measured.any(1))
        _, places = np.unique(data.sensor[measured] * len(groups) + data.target[measured], return_index=True)
        some = measured[places]  # a row of each sensor with each target
        pairs = pd.DataFrame({"kind": kinds[data.sensor[some]], "group": [groups[k] for k in data.target[some]]}, some)
        known = set() if self.samples is None else set(zip(self.samples["_kind"], self.samples["_group"], strict=True))
        fresh = pairs[[p not in known for p in zip(pairs["kind"], pairs["group"], strict=True)]].drop_duplicates()
        if fresh.empty:
            return
        if self.template is None:
            self._freeze(
                Problem(
                    self.network, self.motion, Table(frame, source, np.arange(len(frame)), admitted=True),
                    fix=self.fixed, epoch=self.epoch,
                )
            )  # fmt: skip
        for name in data.target_names:
            self._start(name)
        rows = frame.loc[fresh.index].assign(_kind=fresh["kind"], _group=fresh["group"])
        self.samples = rows if self.samples is None else pd.concat([self.samples, rows], ignore_index=True)
        self.rebuild()

    def rebuild(self) -> None:
        """The template from its samples: one row of each sensor type that sees each form of a motion."""
        assert self.samples is not None
        kept = self.samples.drop(columns=["_kind", "_group"]).reset_index(drop=True)
        table = Table(kept, "data", np.arange(len(kept)), admitted=True)
        template = Problem(self.network, self.motions(kept["target"]), table, fix=self.fixed, epoch=self.epoch)
        if self.linear:
            check_linear(template)
            self._check_gaussian(template)
        self.template, self.sizes = template, ()

    def _check_gaussian(self, template: Problem) -> None:
        """Raise `InputError` naming target, motion and noise where what drives a target is not Gaussian."""
        for name in template.measurements.target_names:
            for component in linear_of(as_motion(template.target(name).motion)):
                noise = getattr(component, "noise", None)
                if not isinstance(noise, Normal | None):
                    raise InputError(
                        f'target "{name}" moves by {type(component).__name__} with noise={noise!r}, which'
                        " AugmentedFilter() would take for Gaussian; take ParticleFilter(1000) (--particles 1000),"
                        " leave noise= out, or fit the rows as a batch"
                    )

    def target(self, name: str) -> Target:
        """Motion and start of a target as they are declared; raises `InputError` where it has none."""
        return declared_target(self.motion, name, self.network)

    def _group(self, name: str) -> str:
        """The group of a target: targets whose motion is declared once share it."""
        return str(name) if isinstance(self.motion, Mapping) or name == NOBODY else ""

    def _freeze(self, problem: Problem) -> None:
        """Keep where targets start of which nothing is stated, as the first rows have it."""
        self.network = problem.network
        self.area, self.tried = problem.area, candidates(problem)
        self.duration = float(np.ptp(problem.measurements.time)) or 1.0

    @property
    def floors(self) -> list[tuple[int, str, float]]:
        """Number of the sensor type, channel and floor of what is heard, as the first rows have it."""
        return [
            (k, f"{name}_{AXES[0]}" if channel.per_axis else name, channel.noise.floor)
            for k, kind in enumerate(self.network.types)
            for name, channel in kind.channels.items()
            if isinstance(channel.noise, Heard) and channel.noise.floor is not None
        ]

    @floors.setter
    def floors(self, floors: Iterable[tuple[int, str, float]]) -> None:
        self.network = self.network.with_floors({(k, name): floor for k, name, floor in floors})

    def _start(self, name: str) -> None:
        group = self._group(name)
        if group in self.starts:
            return
        target = self.target(name)
        assert self.area is not None
        found: dict[str, tuple[Any, float]] = {}
        for component in linear_of(as_motion(target.motion)):
            if component.memoryless:
                continue
            mean, std = start_of(name, component, target, np.array([0.0, self.duration]), self.area)
            row = 0
            for part, per_axis in component.names():
                width = self.network.dimension if per_axis else 1
                found[part] = (tuple(mean[row : row + width].tolist()), float(std[row]))
                row += width
        self.starts[group] = {k: (m if len(m) > 1 else m[0], s) for k, (m, s) in found.items()}

    def motions(self, names: Iterable[Any]) -> dict[str, Target]:
        """The motion of each target, with its start."""
        names = list(names)
        for name in names:
            self._start(str(name))
        return {str(n): Target(self.target(str(n)).motion, self.starts[self._group(str(n))]) for n in names}

    def _seat(self, template: Problem, names: Iterable[str]) -> None:
        """A slot for each new target, free or of the one that has been silent for longest; sets their motions."""
        names = [str(name) for name in names]
        template.motion = self.motions([*names, *template.measurements.target_names])
        for name in names:
            if name in self.targets:
                continue
            r = self._recursion(template, name)
            taken = {own.slot: other for other, own in self.targets.items() if own.recursion == r}
            free = next((k for k in range(self.most) if k not in taken), None)
            if free is None:
                silent = [(self.targets[other].time, k) for k, other in taken.items() if other not in names]
                if not silent:
                    raise InputError(
                        f"more than {self.most} targets are seen at once; give more slots, Online(..., targets=...)"
                    )
                free = min(silent)[1]
                self.counts["retired"] += 1
                del self.targets[taken[free]]
            self.targets[name] = CarriedTarget(r, free, -np.inf)

    def _recursion(self, template: Problem, name: str) -> int:
        """The index of a target's recursion: that of a sample with the same motion."""
        mine = self._group(name)
        assert self.samples is not None
        like = str(self.samples.loc[self.samples["_group"] == mine, "target"].iloc[0])
        return next(r for r, epochs in enumerate(template.epochs) if like in epochs.target)

    def settled(self, batch: Batch, frame: pd.DataFrame, count: int) -> None:
        """The first `count` epochs of a batch were filtered and will not be looked at again."""
        last = {str(name): k for k, name in enumerate(batch.target[:count].tolist())}
        for name, k in last.items():
            rows = frame[batch.row == k]
            own = self.targets[name]
            keys = zip(rows["sensor"], rows["cells"].tolist(), rows["time"].tolist(), strict=True)
            same = own.keys if own.time == batch.time[k] else ()
            own.time, own.keys = float(batch.time[k]), (*same, *keys)

    def components(self, r: int) -> list[str]:
        """Names of the state components of a recursion."""
        assert self.template is not None
        return list(self.template.epochs[r].components)

    def axes(self) -> list[str]:
        """Names of the axes."""
        return list(AXES[: self.network.dimension])


def refused_rows(lines: Sequence[Any] | np.ndarray = (), reasons: Sequence[str] = ()) -> pd.DataFrame:
    """The table of rows that a stream leaves out: line of each and the reason."""
    return pd.DataFrame({"line": np.asarray(lines, None if len(lines) else int), "reason": np.asarray(reasons, object)})


def _held(epochs: Any) -> Epoch:
    """Epochs of which those that go on at the same time leave the state as it is."""
    again = (epochs.dt == 0) & ~epochs.first
    if not again.any():
        return epochs
    moves: list[Any] = []
    for r, move in enumerate(epochs.move):
        mine = again & (epochs.recursion == r)
        n = move.F.shape[1]
        moves.append(
            move._replace(
                F=np.where(mine[:, None, None], np.eye(n)[None], move.F),
                L=np.where(mine[:, None, None], 0.0, move.L),
                drift=np.where(mine[:, None], 0.0, move.drift),
            )
        )
    return epochs._replace(move=tuple(moves))


def padded(epochs: Any, count: int) -> Epoch:
    """Epochs with some behind them that change nothing, up to a count."""
    import jax

    K = len(epochs.time)
    if count == K:
        return epochs
    index = np.minimum(np.arange(count), max(K - 1, 0))
    more: Any = jax.tree.map(lambda leaf: leaf[index], epochs)
    recursion = np.where(np.arange(count) < K, more.recursion, -1)
    return more._replace(recursion=recursion)
