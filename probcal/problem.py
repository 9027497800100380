"""Problem = network + motion + table (+ fixed biases): labels above, arrays below."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from numbers import Real
from typing import Any, NamedTuple

import jax
import numpy as np

from probcal.clocks import CLOCK
from probcal.errors import InputError, check_known, nearest
from probcal.files import AnyPath
from probcal.labels import NOBODY
from probcal.lazy import pd
from probcal.linalg import handedness
from probcal.model.epochs import Epoch, merged
from probcal.model.model import TILTED, Mixing, Model, Recursion, Spot, Tail, Tilt, at_rest
from probcal.model.motions import (
    CLEAR,
    DIFFUSE,
    FAR,
    Area,
    LevelRecord,
    Levels,
    by_component,
    chain,
    channel_levels,
    form_of,
    linear_of,
    parameters,
    start_of,
    tails_of,
)
from probcal.model.padding import padded_index, padded_model, roomy
from probcal.model.rows import Block, Rows, addresses, late_by, make_block, pose_entries, pose_vector
from probcal.model.sampled import SampledMotion
from probcal.model.variants import aligned, at_measured
from probcal.motion import Known, Layout, LinearMotion, Static, Target, White, as_motion, flow_of, labels_of
from probcal.motion.components import Remembered
from probcal.network import BiasRecord, Network, Node
from probcal.noise import Bernoulli, guess_of
from probcal.plausible import check_plausible, check_scales
from probcal.priors import Precision, Prior
from probcal.scans import Scans, assigned_rows, scans_of
from probcal.sensor import Sensor
from probcal.table import (
    LARGEST,
    OBJECT,
    Measurements,
    Table,
    header,
    measure,
    read_table,
    unit_factor,
)
from probcal.types import float64


@dataclass(frozen=True, eq=False)
class Epochs:
    """Labels of one recursion: time (E,) and target name (E,) of each epoch, and its state components."""

    time: np.ndarray
    target: np.ndarray
    layout: Layout
    components: tuple[str, ...]
    order: np.ndarray  # (E,) number of each epoch where all rows are taken at their stated times
    flow: tuple[Any, ...] = ()  # parts of the motion that `motion.flow_of` names

    @property
    def padded(self) -> Epochs:
        """The labels of the epochs and of those behind them that belong to no target."""
        index, more = padded_index(len(self.time)), np.arange(len(self.time), roomy(len(self.time)))
        target = np.append(self.target, np.full(len(more), "", self.target.dtype))
        return replace(self, time=self.time[index], target=target, order=np.append(self.order, more))

    @property
    def position(self) -> tuple[int, int]:
        """First and last (excluded) state entry of the position."""
        return next((start, stop) for name, start, stop, _ in self.layout if name == "position")

    @property
    def members(self) -> dict[str, np.ndarray]:
        """Mask (E,) of the epochs of each target."""
        return {str(name): self.target == name for name in dict.fromkeys(self.target) if name}

    def joined(self, parts: Sequence[np.ndarray], axis: int = 0) -> np.ndarray:
        """Values of each target at its epochs, along an axis, as one array; epochs of no target repeat the last."""
        found = np.concatenate(parts, axis)
        return np.take(found, np.minimum(np.arange(len(self.time)), found.shape[axis] - 1), axis)


class _Chained(NamedTuple):
    """The targets of one recursion, one after the other."""

    recursion: Recursion
    epochs: Epochs
    epoch_of: np.ndarray  # (rows,) of the table, -1 of other targets


class _Gathered(NamedTuple):
    """The rows of one sensor type that one recursion explains."""

    block: Block
    rows: Rows
    recursion: int
    mine: np.ndarray  # rows of the table
    columns: tuple[str, ...]  # channels


class Arrived(NamedTuple):
    """Rows that came later, in the form of a problem before them."""

    model: Model
    rows: list[np.ndarray]  # (N,) which rows of their table each block has
    target: list[np.ndarray]  # (E,) target of each epoch of each recursion


class Problem:
    """A network, the motion of its targets and a table of rows, compiled to arrays.

    `motion` is one motion for all targets, or a mapping from target name to motion or `Target`. `data` is a
    path or a DataFrame. `fix` holds biases at a value: labels or patterns (`"beacon_0.*"`) at 0, or a mapping
    to values. `epoch` brings rows to common epochs: each time is rounded to a whole multiple of so many seconds
    (where a target moves at v it is off by up to v epoch / 2). `silent` names the sensors without rows: `fit`
    refuses them, `track` does not. Raises `InputError` naming what is wrong.

    A row whose sensor reads no target, such as a distance between two nodes, need not name one: its
    cell is blank, or the column is left out. Where no row has a target the motion is None or left
    out, `Problem(network, data=table)`. Inside, such rows share a target that is known for ever at
    the centre of the nodes; no track is reported of it.

    >>> free = Problem(network, motion, run.table, fix="sonar_0.*")
    >>> free.model.biases, problem.model.biases
    (8, 12)
    """

    @float64
    def __init__(
        self,
        network: Network,
        motion: Any = None,
        data: AnyPath | pd.DataFrame | Table | None = None,
        *,
        fix: Mapping[str, float] | Iterable[str] = (),
        epoch: float | None = None,
    ):
        if data is None:
            raise InputError(
                "Problem: the table of rows is missing; give Problem(network, motion, table), or"
                " Problem(network, data=table) where no row has a target"
            )
        whole = measure(read_table(data), network)
        network = network.with_floors(whole.floors)
        self.network = network
        self.motion = {str(name): value for name, value in motion.items()} if isinstance(motion, Mapping) else motion
        self.fixed = fixed_biases(network, fix)
        self.biases: tuple[BiasRecord, ...] = tuple(b for b in network.biases if b.label not in self.fixed)
        self.labels = tuple(bias.label for bias in self.biases)  # in the order of every bias array
        self.scales = np.array([bias.scale for bias in self.biases])
        self.surveyed = np.array([bias.kind != "scale" for bias in self.biases], bool)
        self.epoch = _positive(epoch)
        if not whole.table.admitted:
            check_plausible(whole, network)
        check_scales(self.biases, network)
        self.measurements = self._at_epochs(whole)
        self.epoch_shift = float(np.abs(self.measurements.time - whole.time).max())  # s, of the rows to their epochs
        self.silent = _check_rows(self.measurements, network)
        self.levels: tuple[LevelRecord, ...]
        self.epochs: list[Epochs]  # of each recursion
        self.row_index: list[np.ndarray]  # rows of the table behind each block
        self.model: Model
        self.roomy = False  # whether there are masked rows, and epochs of no target
        self.begin = float(self.measurements.time.min())  # s, from which clocks that run count
        self.moved = np.zeros(len(self.measurements.time))  # s, of each row from its stated time
        self.timed: dict[str, float] = {}  # values of the biases of clocks that moved the rows, by label
        self._compile()

    def _at_epochs(self, data: Measurements) -> Measurements:
        """Rows at common epochs, where these are asked for."""
        return data if self.epoch is None else replace(data, time=np.round(data.time / self.epoch) * self.epoch)

    @property
    def targets(self) -> tuple[str, ...]:
        """Names of the targets; none where no row has one."""
        return tuple(name for name in self.measurements.target_names if name != NOBODY)

    @property
    def members(self) -> list[dict[str, str]]:
        """The owner, node(s), sensor type(s), component and vector of axes of each free bias."""
        found = []
        readers: dict[str, list[Sensor]] = {}
        for s in self.network.sensors:
            for owner in dict.fromkeys((s.name, s.type.name, *(n.name for n in s.nodes))):
                readers.setdefault(owner, []).append(s)
        for bias in self.biases:
            users = readers.get(bias.owner, [])
            nodes = {n.name for s in users for n in s.nodes}
            node = bias.owner if bias.owner in nodes else "-".join(sorted(nodes))
            types = "-".join(sorted({s.type.name for s in users}))
            vector = f"{bias.owner}.{bias.component}" + ("" if bias.since is None else f"@{bias.since!r}")
            found.append(
                {"owner": bias.owner, "node": node, "type": types, "component": bias.component, "vector": vector}
            )
        return found

    def first_precision(self, prior: Prior) -> Precision:
        """Precisions of the biases before any is learnt, and the couplings of correlated ones."""
        return prior.precision(self.labels, self.surveyed)

    def unlinked(self) -> Problem:
        """The same problem without motion: the state of every epoch is free, but for known and static targets."""
        check_linear(self)
        if self.clocks.any():
            raise InputError(
                'without a motion nothing tells the time of a row: hold the clocks, fix=("*.time_*",), or take a method'
                " that uses the motion"
            )
        names = self.measurements.target_names
        motion = {name: self._unlinked(name, self.target(name)) for name in names}
        return self.rebuild(motion=motion)

    def _unlinked(self, name: str, target: Target) -> Target:
        """Each component that links epochs replaced by one drawn anew, as wide as an undeclared start."""
        time = self._counting(name)
        free: list[Any] = []
        for component in linear_of(as_motion(target.motion)):
            if component.memoryless or isinstance(component, Static | Remembered):
                free.append(component)
                continue
            mean, std = start_of(name, component, Target(target.motion), time, self.area)
            row = 0
            for part, per_axis in component.names():
                width = self.network.dimension if per_axis else 1
                wide = max(std[row], guess_of(component.std) * np.sqrt(np.ptp(time)))
                wide = wide if per_axis else DIFFUSE * wide
                free.append(White(part, "", wide, mean[row : row + width] if per_axis else mean[row], per_axis))
                row += width
        kept = {part for c in free if isinstance(c, Static) for part, _ in c.names()}
        return Target(LinearMotion(tuple(free)), {part: pair for part, pair in target.start.items() if part in kept})

    def _counting(self, name: str) -> np.ndarray:
        """Times of the rows of a target whose weight is not 0, of all its rows where none counts."""
        data = self.measurements
        mine = data.target == data.target_names.index(name)
        counts = mine & (data.weight > 0)
        return data.time[counts if counts.any() else mine]

    @property
    def area(self) -> Area:
        """The area in which a target without a stated start begins, wider than the nodes are known.

        A narrower start would hold the network in the place of a survey.
        """
        ranged = any(
            channel.unit == "m"
            for s in self.network.sensors
            if len(s.nodes) == 1
            for channel in s.type.channels.values()
        )
        wide = DIFFUSE * (1.0 if ranged else FAR)
        loose = max((bias.scale for bias in self.biases if bias.component == "position"), default=0.0)
        extent = max(self.extent, CLEAR * loose / wide)
        return Area(self.network.dimension, self.node_positions.mean(0), extent, wide)

    @property
    def extent(self) -> float:
        """Diagonal of the network in metres, or the largest measured length that counts if that is larger."""
        lengths = [1.0, float(np.linalg.norm(np.ptp(self.node_positions, axis=0)))]
        counts = self.measurements.weight > 0
        for j, name in enumerate(self.measurements.channels):
            declared = (c for t in self.network.types for c in t.expand(self.network.dimension))
            units = {channel.unit for own, channel in declared if own == name}
            there = self.measurements.value[self.measurements.measured[:, j] & counts, j]
            if units == {"m"} and len(there):
                lengths.append(float(np.quantile(np.abs(there), 0.99)))
        return max(lengths)

    @property
    def node_positions(self) -> np.ndarray:
        """Stated positions of all nodes (a path's points for a moving one), shape (points, d)."""
        return positions_of(self.network)

    def _with(self, **parts: Any) -> Problem:
        """A copy with other parts."""
        other = copy(self)
        vars(other).update(parts)
        return other

    def rebuild(self, data: Any = None, **changes: Any) -> Problem:
        """The same problem with other data, another network or other fixed biases."""
        settings: dict[str, Any] = {
            "network": self.network, "motion": self.motion, "fix": self.fixed, "epoch": self.epoch,
        }  # fmt: skip
        settings |= changes
        found = Problem(data=self.measurements.table if data is None else data, **settings)
        if data is not None:
            return found
        found.begin = self.begin
        found = found.at_times(self.moved, self.timed)
        return found.padded() if self.roomy else found

    @float64
    def padded(self) -> Problem:
        """The same problem with masked rows and with epochs of no target, so that kernels serve others of its length.

        The last row of a block is repeated, with nothing measured; behind the last epoch of a recursion its target
        stays where it is.
        """
        return self if self.roomy else self._with(roomy=True)._longer()

    def _longer(self) -> Problem:
        self.model = jax.device_put(padded_model(jax.device_get(self.model)), may_alias=False)
        self.epochs = [own.padded for own in self.epochs]
        self.row_index = [index[padded_index(len(index))] for index in self.row_index]
        return self

    @property
    def clocks(self) -> np.ndarray:
        """Number of the clock that gives the rows of each sensor their times, 0 where the table does, (S,)."""
        own = [b for b in self.network.biases if b.component.removesuffix("_step") in CLOCK]
        off = {b.owner for b in own if self.fixed.get(b.label, 1.0)}  # free, or held at another time
        off |= {node.name for node in self.network.nodes if any(node.components[name] for name in CLOCK)}
        number = {node.name: k + 1 for k, node in enumerate(self.network.nodes) if node.name in off}
        return np.array([number.get(s.nodes[0].name, 0) if s.type.clocked else 0 for s in self.network.sensors])

    def positions(self, states: Iterable[Any]) -> tuple[np.ndarray, ...]:
        """Positions (E, d) in states (E, n) of each state layout."""
        return self.model.each(lambda _, own, x: np.asarray(x)[:, slice(*own.position)], self.epochs, states)

    def tracks(self, *of_each: Iterable[Any]) -> Iterator[tuple[Any, ...]]:
        """Name and times (K,) of each target, and its part of each sequence in `of_each`.

        A sequence has one array (E, ...) per state layout, or one pytree of them.
        """
        for _, epochs, *own in self.model.each_layout(self.epochs, *of_each):
            for name, mine in epochs.members.items():
                yield name, epochs.time[mine], *jax.tree.map(lambda leaf, mine=mine: np.asarray(leaf)[mine], own)

    @property
    def by_clock(self) -> list[np.ndarray]:
        """Mask (E,) of the epochs of each recursion whose rows have a free clock."""
        found = [np.zeros(len(epochs.time), bool) for epochs in self.epochs]
        for _, data, r, index in self.model.each_block(self.row_index):
            found[r][np.asarray(data.epoch)[self.clocks[self.measurements.sensor[index]] > 0]] = True
        return found

    @property
    def first_z(self) -> np.ndarray:
        """Biases z (M,) at which a search begins: zero but for those of the clocks by which the rows are taken."""
        return np.array([self.timed.get(b.label, 0.0) / b.scale for b in self.biases])

    @float64
    def counted_from(self, begin: float) -> Problem:
        """The same problem, whose clocks that run count from a time in s on, by default that of the first row."""
        if begin == self.begin or not self.clocks.any():
            return self
        return self._with(begin=begin)._compile()

    @float64
    def at_times(self, moved: np.ndarray, timed: dict[str, float]) -> Problem:
        """The same problem with its rows taken so many seconds (N,) after their stated times; shapes stay.

        `timed` are the values of the biases by which they are.
        """
        if np.array_equal(moved, self.moved):
            return self
        return self._with(moved=moved, timed=timed)._compile()

    def lateness(self, z: Any) -> np.ndarray:
        """Seconds (N,) from where each row is taken to where its clock puts it at biases z (M,)."""
        late = np.zeros(len(self.moved))
        for block, data, _, index in self.model.each_block(self.row_index):
            if block.type.clocked:
                late[index] = late_by(block, data, z)
        return late

    def retimed(self, z: Any) -> Problem:
        """The same problem with the rows of free clocks taken where biases z (M,) put them."""
        if not self.clocks.any():
            return self
        values = zip(self.biases, np.asarray(z) * self.scales, strict=True)
        timed = {b.label: float(value) for b, value in values if b.component.removesuffix("_step") in CLOCK}
        return self.at_times(self.moved + self.lateness(z), timed)

    def reordered(self, other: Problem, states: Sequence[Any]) -> list[np.ndarray]:
        """States (E, n) of the epochs of this problem in the order that they have at the times of another."""
        layouts = self.model.each_layout(self.epochs, other.epochs, states)
        return [np.asarray(x)[np.argsort(own.order)][new.order] for _, own, new, x in layouts]

    @property
    def scans(self) -> Scans | None:
        """The scans of the detections that name no target; None where every row names its own."""
        return scans_of(self.measurements) if self.measurements.detection.any() else None

    def assigned(self, tracks: Any) -> Problem:
        """The labelled problem: detections that belong to tracks, each with its weight, and the rows with targets.

        `tracks` is a table with the columns row (of this table, from 0), track and, where not certain, weight, as
        `track_objects` gives it. Each track has the motion that all objects share. Raises `InputError`.
        """
        if self.scans is None:
            raise InputError("assigned: every row names its target already")
        table = assigned_rows(self.measurements, tracks)
        motion = self.motion
        if isinstance(motion, Mapping):
            shared = self.target(OBJECT)
            names = dict.fromkeys(str(name) for name in table.frame["target"])
            motion = {name: motion.get(name, shared) for name in names}
        return Problem(self.network, motion, table, fix=self.fixed, epoch=self.epoch)

    def select(self, rows: np.ndarray) -> Problem:
        """The same problem with some rows of its table only: a mask or numbers (N,)."""
        table = self.measurements.table
        frame = table.frame.iloc[rows].reset_index(drop=True)
        return self.rebuild(replace(table, frame=frame, lines=table.lines[rows])).at_times(self.moved[rows], self.timed)

    def redrawn(self, y: Sequence[Any]) -> Problem:
        """The same rows with other measured values: y (N, C) of each block, read where a value is measured.

        Shapes and static form stay, so that kernels compiled for this problem serve the other.
        """
        data, frame = self.measurements, self.measurements.table.frame.copy()
        value = data.value.copy()
        for _, rows, _, channels, index, new in self.model.each_block(self.columns, self.row_index, y):
            there = np.asarray(rows.mask) > 0
            for c, name in enumerate(channels):
                value[index[there[:, c]], data.channels.index(name)] = np.asarray(new)[there[:, c], c]
        names, units = header(data.table)
        for j, name in enumerate(data.channels):
            if name in names:
                column = np.full(len(frame), np.nan)
                for k in np.unique(data.sensor[data.measured[:, j]]):
                    channel = dict(self.network.sensors[k].type.expand(self.network.dimension))[name]
                    mine = (data.sensor == k) & data.measured[:, j]
                    own = channel.turned(value[mine, j])
                    column[mine] = own / unit_factor(data.table, name, units[name], channel.unit)
                frame[frame.columns[names.index(name)]] = column
        measured = replace(data, value=value, table=replace(data.table, frame=frame))
        return self._with(measurements=measured, model=self.model.with_values(y))

    def target(self, name: str) -> Target:
        """Motion and start of a target by name."""
        return declared_target(self.motion, name, self.network)

    def noise_columns(self, name: str) -> list[tuple[Any, slice]]:
        """Each component of a target's linear motion, and the columns of the noise factor that drive it."""
        components = linear_of(as_motion(self.target(name).motion))
        return [(component, own) for component, _, own in by_component(components, self.network.dimension)]

    def with_tilt(self, tilt: Tilt) -> Problem:
        """The same problem with a term of the log-likelihood of its biases beside that of the rows."""
        return self._with(model=self.model.with_tilt(tilt))

    @property
    def tilted(self) -> bool:
        """True if there is such a term."""
        return self.model.tilt is not None and any(np.any(leaf) for leaf in self.model.tilt)

    @property
    def untilted(self) -> Problem:
        """The same problem with no such term, which holds near one point only."""
        return self if self.model.tilt is None else self.with_tilt(Tilt.none(self.model.biases))

    def at_measured(self) -> Problem:
        """The same problem with growing stds at the measured values, for starts; itself where none grows."""
        return self if (model := at_measured(self.model)) is self.model else self._with(model=model)

    def with_start(self, where: Spot, value: float, sd: float) -> tuple[Problem, float]:
        """The same problem with a measurement of a first state, and the log density of that."""
        model, density = self.model.with_start(where, value, sd)
        return self._with(model=model), density

    def with_mixing(self, weights: Mixing) -> Problem:
        """The same problem with other precisions (E,) of the process noises that are not Gaussian."""
        return self._with(model=self.model.with_mixing(weights)) if self.model.tailed else self

    def loosened(self) -> Problem | None:
        """The same problem with motions of a linear form that hold its own loosely; None where one has none."""
        motions = {}
        for name in self.measurements.target_names:
            target = self.target(name)
            found = as_motion(target.motion).within(self.longest).loose() if as_motion(target.motion).split[1] else ()
            if found is None:
                return None
            motions[name] = Target(found[0], {**found[1], **target.start}) if found else target
        return self.rebuild(motion=motions)

    def seen(self) -> Problem:
        """The same problem where states are what rows see of them, (E, n) whatever the motion."""
        return self._with(model=self.model.seen())

    @float64
    def later(self, data: Any, sizes: tuple[int, ...] | None = None) -> Epoch:
        """The epochs of rows that came after those of this problem, stacked in time order (K leading).

        Each target goes on from its last epoch here, so that a kernel compiled for `model.epochs()` takes these too.
        `sizes` are the most rows of each block at an epoch, by default those of this problem. Raises `InputError` for
        a row that is not later, for a new target, and where an epoch has more rows than its size.
        """
        measured = self._at_epochs(measure(read_table(data), self.network))
        silent = _check_rows(measured, self.network)
        last = {name: float(time[-1]) for name, time in self.tracks()}
        for name in measured.target_names:
            if name not in last:
                raise InputError(
                    f'later: target "{name}" is new{nearest(name, last)}; build a new Problem from all rows'
                )
        before = np.array([last[name] for name in measured.target_names])[measured.target]
        early = np.flatnonzero(measured.time <= before)
        if len(early):
            n = early[0]
            raise InputError(
                f"{measured.table.where(n)}: time {measured.time[n]:g} is not after the last epoch of its target, at"
                f" {before[n]:g}"
            )
        other = self._with(measurements=measured, moved=np.zeros(len(measured.time)), silent=silent)
        other._compile(last)
        slots = {n: k for e in self.epochs for k, n in enumerate(e.members)}
        sizes = self.model.sizes if sizes is None else sizes
        return jax.device_put(merged(self._aligned(other, slots)[0], self.model.rows, sizes))

    def arrived(self, data: Measurements, begun: Mapping[str, float], slots: Mapping[str, int]) -> Arrived:
        """Measured rows compiled as this problem would, in its form, for filters that go on.

        Targets in `begun` go on from an epoch at that time, which they may still see; the others begin, from the start
        that is declared. `slots` says which target of its recursion each is. Every sensor type and every form of a
        motion that the rows have must be in this problem. Raises `InputError` as `Problem`.
        """
        other = self._with(measurements=self._at_epochs(data), moved=np.zeros(len(data.time)), silent=())
        other._compile(begun)
        model, pairs = self._aligned(other, slots)
        found = {(block, r): rows for block, _, r, rows in other.model.each_block(other.row_index)}
        none = np.zeros(0, int)
        rows = [found.get((block, pairs[r]), none) for block, _, r in model.each_block()]
        names = [np.zeros(0, str) if r is None else other.epochs[r].target for r in pairs]
        return Arrived(model, rows, names)

    def _aligned(self, other: Problem, slots: Mapping[str, int]) -> tuple[Model, list[int | None]]:
        """The model of rows that came later in the form of this one, and which recursion of it each here is."""
        forms, others = (
            p.model.each(lambda _, own, sampled: (own.layout, own.flow, sampled), p.epochs, p.model.sampled)
            for p in (self, other)
        )
        own = {form: r for r, form in enumerate(others)}
        pairs = [own.get(form) for form in forms]
        targets = [[] if r is None else [slots[n] for n in other.epochs[r].members] for r in pairs]
        return aligned(self.model, other.model, pairs, targets), pairs

    def _compile(self, after: Mapping[str, float] | None = None) -> Problem:
        """The problem with arrays of its rows; of later ones targets go on from epochs at times."""
        begun, further = after or {}, after is not None
        levels = Levels(self.levels if further else ())
        self.longest = self._longest(begun, further)
        forms = self._forms(levels)
        chained = [self._chained(layout, flow, names, levels, begun) for (layout, flow, _), names in forms.items()]
        self.epochs = [own.epochs for own in chained]
        gathered = self._gathered(levels, chained)
        self.row_index = [own.mine for own in gathered]
        self.columns = [own.columns for own in gathered]  # their channels
        self.levels = tuple(levels.records)
        free = len(self.levels)
        recursions = tuple(_numbered(own.recursion, free) for own in chained)
        rows = tuple(_numbered(own.rows, free) for own in gathered)
        sampled_of_each = tuple(sampled for *_, sampled in forms)
        driven = any((own.recursion.level >= 0).any() for own in chained) or any(
            number >= 0 for sampled in sampled_of_each if sampled is not None for *_, number in sampled.levels
        )
        spread: Any = np.array([np.log(level.factor) for level in self.levels])
        counts = tuple(len(epochs.members) for epochs in self.epochs)
        rest = any(at_rest(part, T).any() for part, T in zip(recursions, counts, strict=True))
        model = Model(
            tuple(own.block for own in gathered),
            tuple(own.recursion for own in gathered),
            len(self.biases),
            driven,
            counts,
            # rows of clocks may fall on one time, here or where they are taken next
            not self.clocks.any() and all(bool(handedness(part.L).all()) for part in recursions),
            sampled_of_each,
            recursions,
            rows,
            spread,
            Tilt.none(len(self.biases)) if rest and len(self.biases) <= TILTED else None,
        )
        # put, not `asarray`: that compiles a copy for every new shape; later rows are put when they are epochs
        self.model = model if further else jax.device_put(model, may_alias=False)
        return self._longer() if self.roomy and not further else self

    def _longest(self, begun: Mapping[str, float], further: bool) -> float:
        """The longest time in s between two epochs of a target; of rows that come later, what it was before them."""
        data, longest = self.measurements, 0.0
        for n, name in enumerate(data.target_names):
            times = np.unique((data.time + self.moved)[data.target == n])
            longest = max(longest, float(np.diff(times, prepend=begun.get(name, times[0])).max()))
        if not further:
            return longest or 1.0
        beyond = any(as_motion(self.target(name).motion).split[1] for name in data.target_names)
        if beyond and longest > self.longest * (1 + 1e-9):
            raise InputError(
                f"later: {longest:g} s pass between two epochs, more than the {self.longest:g} s for which the motion"
                " was made ready; build a new Problem from all rows"
            )
        return self.longest

    def _forms(self, levels: Levels) -> dict[tuple[Layout, tuple[Any, ...], SampledMotion | None], list[str]]:
        """The targets whose states are alike, by layout, flow and motion without linear form: one recursion each."""
        forms: dict[tuple[Layout, tuple[Any, ...], SampledMotion | None], list[str]] = {}
        goes_on = any("at" in kind.target_components for kind in self.network.types)
        for name in self.measurements.target_names:
            motion = as_motion(self.target(name).motion).within(self.longest)
            layout, sampled = form_of(name, motion, levels, self.network.dimension)
            if "position" not in {component for component, *_ in layout}:
                raise InputError(f'target "{name}": the motion has no position; add ConstantVelocity(std) or Static()')
            flow = flow_of(linear_of(motion), self.network.dimension) if goes_on else ()
            forms.setdefault((layout, flow, sampled), []).append(name)
        return forms

    def _chained(
        self, layout: Layout, flow: tuple[Any, ...], names: list[str], levels: Levels, begun: Mapping[str, float]
    ) -> _Chained:
        """The epochs of some targets, one target after the other, and the epoch of each of their rows."""
        data, area, dimension = self.measurements, self.area, self.network.dimension
        epoch_of = np.full(len(data.time), -1)
        parts, drives, times = list[Any](), list[tuple[Any, int]](), list[np.ndarray]()
        orders, clocks, offset = list[np.ndarray](), self.clocks[data.sensor], 0
        for name in names:
            target = self.target(name)
            rows = data.target == data.target_names.index(name)
            self._check_memory(name, np.unique(data.sensor[rows]))
            still = getattr(as_motion(target.motion), "static", False) and name not in begun
            time, order, own = _epochs(data.time[rows], self.moved[rows], clocks[rows], once=still)
            epoch_of[rows] = offset + own
            orders.append(offset + order)
            arrays = chain(name, target, time, levels, begun.get(name), area, self._counting(name))
            first = np.arange(len(time)) == (0 if name not in begun else -1)
            dt = np.diff(time, prepend=begun.get(name, time[0]))
            drives += [(tail, offset) for tail in tails_of(target, len(time), name not in begun, dimension)]
            parts.append((*arrays, time, dt, first, np.full(len(time), len(times))))
            times.append(time)
            offset += len(time)
        columns: list[Any] = [np.concatenate(column) for column in zip(*parts, strict=True)]
        # the noises of a recursion that are not Gaussian, targets of one family joined; each with its first epoch
        joined: dict[Any, np.ndarray] = {}
        for (*key, on), begin in drives:
            whole = joined.setdefault(tuple(key), np.zeros(offset, bool))
            whole[begin : begin + len(on)] = on
        found = [(*key, on, np.ones(offset)) for key, on in joined.items()]
        recursion = Recursion(*columns)._replace(tails=tuple(Tail(*own) for own in found))
        owners = np.repeat(names, [len(time) for time in times])
        order = np.concatenate(orders)
        epochs = Epochs(np.concatenate(times), owners, layout, labels_of(layout, dimension), order, flow)
        return _Chained(recursion, epochs, epoch_of)

    def _check_memory(self, name: str, sensors: np.ndarray) -> None:
        """Raise `InputError` for a sensor with a clock that reads what a target has at one epoch only."""
        anew = {
            part
            for c in linear_of(as_motion(self.target(name).motion))
            if c.memoryless and not c.timed
            for part, _ in c.names()
        }
        for k in sensors[self.clocks[sensors] > 0]:
            placed = self.network.sensors[k]
            if both := sorted(anew & placed.type.target_components):
                raise InputError(
                    f'sensor "{placed.name}" reads target.{both[0]}, of which every epoch has its own, so that its'
                    f' rows cannot have times of their own; leave time_offset of node "{placed.nodes[0].name}" out'
                    " and free the clock bias of the sensor instead"
                )

    def _gathered(self, levels: Levels, chained: list[_Chained]) -> list[_Gathered]:
        """Rows by sensor type and recursion."""
        found = []
        for kind in self.network.types:
            ours = [k for k, placed in enumerate(self.network.sensors) if placed.type == kind]
            sensors = [self.network.sensors[k].name for k in ours]
            level_of = channel_levels(kind, self.network.dimension, levels, sensors)
            columns = tuple(name for name, _ in kind.expand(self.network.dimension))
            for r, own in enumerate(chained):
                chosen = np.flatnonzero((own.epoch_of >= 0) & np.isin(self.measurements.sensor, ours))
                if len(chosen):
                    block = make_block(self.network, kind, own.epochs.layout, own.epochs.flow)
                    epoch = own.epoch_of[chosen]
                    numbers, pieces = self._rows(block, ours, chosen, epoch, level_of)
                    unknown = parameters(kind, self.network.dimension, levels, sensors, pieces)
                    memory = tuple((c, tuple(np.repeat(own, pieces).tolist())) for c, own in block.memory)
                    block = replace(block, unknown=unknown, memory=memory) if unknown or memory else block
                    found.append(_Gathered(block, Rows(**numbers), r, chosen, columns))
        return found

    def _rows(
        self, block: Block, ours: list[int], chosen: np.ndarray, epoch: np.ndarray, level_of: np.ndarray
    ) -> tuple[dict[str, Any], list[int]]:
        """Numbers of a block of rows, by the names of `Rows`, and the number of pieces of each sensor."""
        data, network = self.measurements, self.network
        sensor = np.searchsorted(ours, data.sensor[chosen])
        level = level_of[sensor]
        nodes = [network.sensors[k].nodes for k in ours]
        entries = pose_entries(block.type, network.dimension)
        pose = np.zeros((len(chosen), block.type.arity, len(entries)))
        local, starts = self._local(block, ours)
        ends = np.cumsum(np.bincount(sensor, minlength=len(ours)))
        pieces = np.split(np.argsort(sensor, kind="stable"), ends[:-1])  # the rows of each sensor
        for pair, own in zip(nodes, pieces, strict=True):
            for a, node in enumerate(pair):
                self._check_path(node, chosen[own])
                moved = self.moved[chosen[own]]
                pose[own, a] = pose_vector(node, block.extras, data.time[chosen[own]] + moved, moved, self.begin)
        first = np.cumsum([0, *map(len, starts)])
        for s, own in enumerate(pieces):
            sensor[own] = first[s] + np.searchsorted(starts[s], data.time[chosen[own]], side="right") - 1
        names = [name for name, _ in block.type.expand(network.dimension)]
        columns = [data.channels.index(name) for name in names]
        pick = np.ix_(chosen, columns)
        declared = np.array([1.0 if isinstance(c.noise, Bernoulli) else guess_of(c.std) for c in block.channels])
        own = data.has_std[pick]
        std = np.where(own, data.std[pick], declared)
        coarse = np.argwhere(data.measured[pick] & (np.spacing(np.abs(data.value[pick])) > std))
        if len(coarse):
            n, c = coarse[0]
            where, value = data.table.where(chosen[n]), data.value[pick][n, c]
            raise InputError(
                f'{where} column "{names[c]}": {value:g} is too coarse a number for noise of {std[n, c]:g}; leave the'
                f" cell blank, or check its unit and the std"
            )
        return dict(
            epoch=epoch, sensor=sensor, pose=pose, **local,
            y=np.where(data.measured[pick], data.value[pick], 0.0),
            mask=data.measured[pick] * data.weight[chosen, None],
            std=std,
            level=np.where(own, -1, level),
        ), [len(start) for start in starts]  # fmt: skip

    def _check_path(self, node: Node, rows: np.ndarray) -> None:
        """Raise `InputError` for a row at a time outside the path of a moving node."""
        if node.path is None:
            return
        time = self.measurements.time[rows]
        outside = np.flatnonzero((time < node.path.time[0] - 1e-9) | (time > node.path.time[-1] + 1e-9))
        if len(outside):
            where = self.measurements.table.where(rows[outside[0]])
            raise InputError(f'{where}: time {time[outside[0]]:g} is outside the path of node "{node.name}"')

    def _local(self, block: Block, ours: list[int]) -> tuple[dict[str, np.ndarray], list[np.ndarray]]:
        """The biases that the sensors of a block read: arrays (S, p) by the names of `Rows`, a
        sensor once per piece.

        And the start of each sensor's pieces: between two of them its drifting biases are constant.
        """
        constant = {(b.owner, b.component, b.axis): b for b in self.network.biases if b.since is None}
        number = {label: m for m, label in enumerate(self.labels)}
        entries = pose_entries(block.type, self.network.dimension)
        records: list[list[BiasRecord | None]] = []
        starts = []
        for k in ours:
            keys = addresses(block.type, self.network.sensors[k], block.free, entries)
            steps = [iter(self.network.steps(*key)) for key in keys]
            found = [constant.get(key) for key in keys] + [next(steps[column], None) for column in block.steps]
            starts.append(np.array([-np.inf, *sorted({b.since for b in found if b and b.since is not None})]))
            records += [[b if b and (b.since is None or b.since <= t) else None for b in found] for t in starts[-1]]
        shape = (len(records), len(block.free) + len(block.type.biases) + len(block.steps))
        bias, scale, base = np.full(shape, len(number)), np.zeros(shape), np.zeros(shape)
        for s, found in enumerate(records):
            for j, b in enumerate(found):
                if b is not None:
                    base[s, j] = b.nominal + self.fixed.get(b.label, 0.0)
                    if b.label in number:
                        bias[s, j], scale[s, j] = number[b.label], b.scale
        return {"bias": bias, "scale": scale, "base": base}, starts


def _numbered[P: (Recursion, Rows)](part: P, free: int) -> P:
    """Arrays whose known levels have the number after those of the `free` ones."""
    level: Any = np.where(part.level < 0, free, part.level)
    return part._replace(level=level)


def _epochs(
    time: np.ndarray, moved: np.ndarray, clock: np.ndarray, *, once: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times (E,) of the epochs of one target, their order at stated times (E,), and the epoch of each row (N,).

    Rows of one stated time share an epoch, but for those of a free clock, which have theirs. With `once` there is one.
    """
    if once:
        return time.min()[None], np.zeros(1, int), np.zeros(len(time), int)
    if not clock.any():
        found, own = np.unique(time, return_inverse=True)
        return found, np.arange(len(found)), own
    _, first, own = np.unique(np.stack([time, clock]), axis=1, return_index=True, return_inverse=True)
    found = (time + moved)[first]
    order = np.argsort(found, kind="stable")
    return found[order], order, np.argsort(order)[own.ravel()]


def positions_of(network: Network) -> np.ndarray:
    """Stated positions of all nodes (the points of its path for a moving one), shape (points, d)."""
    return np.concatenate([n.position[None] if n.path is None else n.path.position for n in network.nodes])


def declared_target(motion: Any, name: str, network: Network) -> Target:
    """Motion and start of a target with the remembered noise of all sensors; raises `InputError`."""
    target = _stated_target(motion, name, network)
    known = {part for component in linear_of(as_motion(target.motion)) for part, _ in component.names()}
    found = [own for own in remembered(network, name != NOBODY) if own.name not in known]
    return replace(target, motion=sum(found, as_motion(target.motion))) if found else target


def remembered(network: Network, reads_target: bool) -> list[Remembered]:
    """The remembered noise of each channel of each sensor, of those that read a target or of the others."""
    return [
        Remembered(
            f"{placed.name}.{name}_memory", channel.memory.std, channel.memory.time,
            f"{placed.name if getattr(channel.memory.std, 'by', None) else placed.type.name}.{name}_memory_std",
        )
        for placed in network.sensors
        for name, channel in placed.type.expand(network.dimension)
        if channel.memory is not None and placed.type.reads_target == reads_target
    ]  # fmt: skip


def _stated_target(motion: Any, name: str, network: Network) -> Target:
    """Motion and start of a target, of one motion for all or of a mapping by name; raises `InputError`."""
    if name == NOBODY:
        centre = positions_of(network).mean(0)
        return Target(Known(([-LARGEST, LARGEST], [centre, centre])))
    if motion is None:
        raise InputError(
            f'target "{name}" has no motion; give one, such as ConstantVelocity(std) or Static(). Rows of sensors that'
            ' read no target need none: leave their column "target" blank'
        )
    if isinstance(motion, Mapping):
        check_known(name, motion, f'target "{name}" has no motion')
        motion = motion[name]
    return motion if isinstance(motion, Target) else Target(motion)


def check_linear(problem: Problem) -> None:
    """Raise `InputError` naming target and motion where one has no linear form, which Gaussian methods need."""
    for _, epochs, sampled in problem.model.each_layout(problem.epochs, problem.model.sampled):
        if sampled is not None:
            raise InputError(
                f'target "{epochs.target[0]}" moves by {type(sampled.others[0]).__name__}, which has no linear form, as'
                " Gaussian methods need it; take motions such as ConstantVelocity(std), or particles:"
                " EM(Particles(200)), ParticleGibbs(), track(..., smoother=Particles(1000)), of a stream"
                " ParticleFilter(1000) (--particles 1000)"
            )


def fixed_biases(network: Network, fix: Mapping[str, float] | Iterable[str]) -> dict[str, float]:
    """Labels and values of the fixed biases, patterns expanded."""
    given = dict(fix) if isinstance(fix, Mapping) else dict.fromkeys([fix] if isinstance(fix, str) else fix, 0.0)
    fixed: dict[str, float] = {}
    for pattern, value in given.items():
        exact = [pattern] if pattern in network.labels else []
        found = exact or [label for label in network.labels if fnmatchcase(label, pattern)]
        if not found:
            raise InputError(f'fix: no bias is called "{pattern}"{nearest(pattern, network.labels)}')
        if not np.isfinite(value):
            raise InputError(f'fix "{pattern}": the value must be finite, got {value}')
        fixed |= dict.fromkeys(found, float(value))
    return fixed


def _positive(epoch: float | None) -> float | None:
    """The length of an epoch; raises `InputError` where it is none."""
    if epoch is not None and not (isinstance(epoch, Real) and np.isfinite(epoch) and epoch > 0):
        raise InputError(f"Problem(epoch={epoch!r}): give seconds, a positive number, or leave it out")
    return None if epoch is None else float(epoch)


def _check_rows(data: Measurements, network: Network) -> tuple[str, ...]:
    """Raise `InputError` where nothing was measured; returns the names of the sensors without rows."""
    measured = data.measured.any(1)
    if not measured.any():
        raise InputError(f"{data.table.source} has no measured value; fill the channel columns")
    seen = set(data.sensor[measured])
    return tuple(placed.name for k, placed in enumerate(network.sensors) if k not in seen)
