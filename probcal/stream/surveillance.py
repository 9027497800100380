"""The innovations of a stream, channel by channel: outliers, sensors that changed, noise other than declared.

Innovations of the right model are independent, of mean 0 and variance 1. So are sums of 32, 64, 128, ... of them
over the root of their number (batch means): a wrong variance, a memory and a drift show in one or another. All tests
of a stream, whatever its length, share one false-alarm rate.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence, Set
from copy import copy
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from scipy import special

from probcal.inference.residuals import PRACTICAL
from probcal.labels import listed
from probcal.network import Network
from probcal.noise import normal_scores

RUN, HELD = 10, 8  # data of a channel in a row, and how many of them held back show that its sensor changed
SHARED = 0.75  # share of the data of other sensors, held back meanwhile, from which the target changed
LARGEST = 20.0  # scales of its biases that a sensor may change by; rows that are further off measure something else
AGAIN = 40  # data of a channel after its change within which a second change says that nothing explains them
CONSISTENT = 0.6  # sd of a jump over its size up to which the jump of one bias explains the data of a sensor
TARGETS = 64  # targets whose last data are remembered
SNAPSHOTS = 16  # moments with which biases are compared
APART = 4  # of the comparisons with them, which overlap, that count as tests of their own
KNOWN = 0.25  # variance of a bias in scales from which its moves are looked at: the start is not linear
LEARNT = 0.02  # share of the variance that must be lost between two moments
RATE = 1e-3  # probability that a sound stream of any length is called drifting, or widened
ALONE = 3.29  # sd beyond which a single test has that rate: no test of several has a smaller limit
BATCH, LEVELS = 32, 20  # innovations of the smallest sum, and doublings of it (3e7 innovations)
SHORT = (8, 16)  # innovations of the shortest sums, those that came last
SHIFT = 0.05  # mean of innovations within which a channel does not drift
FEWEST = 8  # sums of one length that show a variance
MEDIAN = 0.6745  # of the size of a standard normal
UNEXPLAINED = 0.25  # share of the data of a channel held back from which the model does not explain them
UNKNOWN = "Check units, clock, position and heading of these sensors, and the sensor that their rows name."


class StreamData(NamedTuple):
    """The data of a window in the order of time, all (D,)."""

    channel: np.ndarray  # number of sensor and channel
    epoch: np.ndarray  # of the window
    row: np.ndarray  # of the frame
    time: np.ndarray  # s
    target: np.ndarray  # names
    value: np.ndarray  # measured
    std: np.ndarray  # of the noise
    residual: np.ndarray  # over the std of noise, state and biases together
    spread: np.ndarray  # this std over that of the noise
    lead: np.ndarray  # bias on which the prediction depends most
    slope: np.ndarray  # change of the prediction, over the std of the noise, by one scale of that
    held: np.ndarray  # held back


class ChangePoint(NamedTuple):
    """A sensor that changed, or a target whose track was lost."""

    name: str
    epoch: int  # of the window, from which on
    since: float  # s
    found: float  # s, of the last datum that shows it
    target: bool = False
    bias: int = -1  # that jumped; -1 where the jump of none explains the data
    size: float = 0.0  # in scales
    sd: float = 0.0  # in scales


@dataclass(frozen=True)
class Event:
    """An event of a sensor: it "changed" (its biases began anew), is "lost" (its rows are left out), or "drifts"."""

    kind: str
    sensor: str
    channel: str  # or the label of a bias
    since: float  # s, of the first
    until: float | None  # s, of the last; None while rows are left out
    size: float  # of the last: scales of a change, mean of the innovations of a drift


class Tallies(NamedTuple):
    """Tallies of K channels; sums are of 32, 64, ... innovations over the root of their number."""

    seen: np.ndarray  # (K,) data
    held: np.ndarray  # (K,) of them held back
    recent: np.ndarray  # (K, RUN - 1) the last, newest last: 1 held back, 0 not, -1 none
    waiting: np.ndarray  # (K, BATCH) innovations of the next sum
    out: np.ndarray  # (K, BATCH) whether they were held back
    fill: np.ndarray  # (K,) how many they are
    half: np.ndarray  # (K, LEVELS) sums that wait for another of their length
    pending: np.ndarray  # (K, LEVELS) whether there is one
    number: np.ndarray  # (K, 1 + LEVELS) single innovations, and sums of each length
    square: np.ndarray  # (K, 1 + LEVELS) sums of their squares
    median: np.ndarray  # (K,) sum of the medians of the sizes of 32

    @classmethod
    def none(cls, channels: int) -> Tallies:
        """Before any data."""
        batch, lengths = (channels, BATCH), (channels, LEVELS)
        counts = np.zeros((channels, 1 + LEVELS), int)
        return cls(
            np.zeros(channels, int), np.zeros(channels, int), np.full((channels, RUN - 1), -1), np.zeros(batch),
            np.zeros(batch, bool), np.zeros(channels, int), np.zeros(lengths), np.zeros(lengths, bool), counts,
            np.zeros(counts.shape), np.zeros(channels),
        )  # fmt: skip

    def copy(self) -> Tallies:
        """As they stand now."""
        return Tallies(*(own.copy() for own in self))

    def forget(self, k: int) -> None:
        """Let the sums of a channel begin anew."""
        for own in self[3:]:
            own[k] = 0

    def add(self, k: int, values: np.ndarray, held: np.ndarray) -> tuple[int, float] | None:
        """Take innovations (n,) of a channel in order; number and mean of the last sum too far from zero."""
        shift, n = None, 0
        while n < len(values):
            fill = int(self.fill[k])
            some = slice(n, n + BATCH - fill)
            taken = len(values[some])
            self.waiting[k, fill : fill + taken], self.out[k, fill : fill + taken] = values[some], held[some]
            self.fill[k] = (fill + taken) % BATCH
            n += taken
            if fill + taken == BATCH and (mean := self._summed(k)):
                shift = n - 1, mean
        if mean := self._lately(k):
            shift = len(values) - 1, mean
        return shift

    def _lately(self, k: int) -> float:
        """Mean of the last 8, 16 or more innovations of a channel where it is too far from zero, else 0."""
        fill = int(self.fill[k])
        last = self.waiting[k, :fill][~self.out[k, :fill]]
        sums = [(m, float(last[-m:].sum())) for m in SHORT if len(last) >= m]
        number, total = len(last), float(last.sum())
        for level in np.flatnonzero(self.pending[k]).tolist():
            number, total = number + (BATCH << level), total + float(self.half[k, level]) * np.sqrt(BATCH << level)
            sums.append((number, total))
        rate = _rate(len(self.fill) * LEVELS, 0, 1 + int(self.number[k, 0] + fill) // SHORT[0])
        limit = -special.ndtri(0.5 * rate)
        far = [total / n for n, total in sums if abs(total) > limit * np.sqrt(n) and abs(total / n) > SHIFT]
        return max(far, key=abs, default=0.0)

    def _summed(self, k: int) -> float:
        """A sum of the smallest length added to the longer ones; the mean of one that is too far from zero, else 0."""
        admitted = self.waiting[k][~self.out[k]]
        self.median[k] += np.sort(np.abs(self.waiting[k]))[BATCH // 2 - 1 : BATCH // 2 + 1].mean()
        self.number[k, 0] += len(admitted)
        self.square[k, 0] += np.sum(admitted**2)
        total, shift = float(admitted.sum()) / np.sqrt(max(len(admitted), 1)), 0.0
        for level in range(LEVELS):
            self.number[k, level + 1] += 1
            self.square[k, level + 1] += total**2
            mean = total / np.sqrt(BATCH << level)
            if abs(total) > ALONE and abs(mean) > SHIFT:
                rate = _rate(len(self.fill), level, self.number[k, level + 1])
                shift = mean if abs(total) > -special.ndtri(0.5 * rate) else shift
            self.pending[k, level] = not self.pending[k, level]
            if self.pending[k, level]:
                self.half[k, level] = total
                break
            total = (total + float(self.half[k, level])) / np.sqrt(2.0)
        return shift

    @property
    def wide(self) -> np.ndarray:
        """Factor (K,) of the variance of each channel's noise that its innovations call for, 1 as declared."""
        factor = self.square / np.maximum(self.number, 1)
        octave = 1 + np.log2(np.maximum(self.number, 1)).astype(int)
        likely = special.chdtrc(np.maximum(self.number, 1), self.square)
        called = (self.number >= FEWEST) & (factor > PRACTICAL)
        called &= likely < _rate(len(self.fill), np.arange(1 + LEVELS), octave)
        found = np.where(called, factor, 1.0).max(1, initial=1.0)
        robust = (self.median / np.maximum(self.number[:, 1], 1) / MEDIAN) ** 2
        # of innovations so large that many are held back
        return np.where(robust > np.maximum(found, PRACTICAL**2), robust, found)


def _rate(channels: int, level: Any, number: Any) -> Any:
    """The share of a test in the false-alarm rate: those of all channels, levels and numbers add up to it."""
    return RATE / max(channels, 1) * (6.0 / np.pi**2) ** 2 / ((level + 1.0) ** 2 * np.square(np.asarray(number, float)))


@dataclass
class Surveillance:
    """The findings from a stream's innovations so far; memory does not grow with the stream."""

    network: Network
    odds: float  # probability of a datum of the right model to be held back
    changed: dict[str, int] = field(default_factory=dict)  # data of a sensor since it changed
    events: list[Event] = field(default_factory=list)  # one of each kind, sensor and channel
    targets: dict[str, list[bool]] = field(default_factory=dict)  # the last data of each: held back
    snapshots: list[tuple[float, np.ndarray, np.ndarray]] = field(default_factory=list)  # time, mean, variance of z
    moments: int = 0  # at which biases were looked at
    restarts: int = 0  # targets that were lost and begun anew
    cause: str = ""  # of data that the model does not explain, where it was looked for

    def __post_init__(self) -> None:
        parts = [placed.type.expand(self.network.dimension) for placed in self.network.sensors]
        names = [placed.name for placed in self.network.sensors]
        self.owners = np.repeat(np.array(names, str), [len(part) for part in parts])  # sensor of each channel
        self.names = [name for part in parts for name, _ in part]
        self.forms = [channel for part in parts for _, channel in part]
        self.tallies = Tallies.none(len(self.names))
        self.reads: dict[str, Set[int]] = dict.fromkeys(names, frozenset())  # biases that each sensor reads

    def copy(self) -> Surveillance:
        """As it stands now."""
        other = copy(self)
        other.changed, other.events, other.tallies = dict(self.changed), [*self.events], self.tallies.copy()
        other.targets, other.snapshots = dict(self.targets), [*self.snapshots]
        return other

    def _note(self, kind: str, sensor: str, channel: str, since: float, until: float | None, size: float) -> None:
        """An event, joined with those of its kind before."""
        same = [own for own in self.events if (own.kind, own.sensor, own.channel) == (kind, sensor, channel)]
        self.events = [own for own in self.events if own not in same]
        self.events.append(Event(kind, sensor, channel, min([since, *(own.since for own in same)]), until, size))

    # sensors that change

    def change(self, data: StreamData, restarts: Set[str]) -> ChangePoint | None:
        """The first sensor of a window that changed, or target that was lost; `restarts` are those that may begin anew.

        Its data are held back one after another: those of one sensor, or those of all that see a target.
        """
        targets = [self._lost_target(data, name) for name in np.unique(data.target[data.held]) if name in restarts]
        if targets := [own for own in targets if own is not None]:
            return min(targets, key=lambda own: own.epoch)
        found = []
        for k in np.unique(data.channel[data.held]).tolist():
            mine = np.flatnonzero(data.channel == k)
            before = self.tallies.recent[k][self.tallies.recent[k] >= 0]
            run = _run(before, data.held[mine])
            if run is not None and self.owners[k] not in self.lost:
                found.append((data.epoch[mine[run]], str(self.owners[k]), mine[run:]))
        for epoch, sensor, mine in sorted(found, key=lambda one: one[:2]):
            since = data.time[mine[0]]
            during = (data.time >= since) & np.isin(data.target, data.target[mine])
            others = during & (self.owners[data.channel] != sensor)
            if others.sum() < HELD or data.held[others].mean() <= SHARED:
                own = during & (self.owners[data.channel] == sensor) & data.held
                return ChangePoint(
                    sensor, int(epoch), float(since), float(data.time[own].max()), False, *_jump(data, own)
                )
        return None

    def _lost_target(self, data: StreamData, name: str) -> ChangePoint | None:
        """A target whose data are held back, whichever sensor has them; of one sensor, if it has just begun."""
        mine, before = np.flatnonzero(data.target == name), np.array(self.targets.get(name, ()), bool)
        run = _run(before[1 - RUN :], data.held[mine])
        if run is None:
            return None
        mine = mine[run : run + 3 * RUN]
        owners, held = self.owners[data.channel[mine]], data.held[mine]
        names = np.unique(owners)
        fresh = len(before) + run < RUN
        most = np.mean([held[owners == own].mean() > 0.5 for own in names]) > SHARED and held.mean() > SHARED
        if not most or (len(names) == 1 and not fresh):
            return None
        return ChangePoint(name, int(data.epoch[mine[0]]), float(data.time[mine[0]]), float(data.time[mine[-1]]), True)

    def begin_anew(self, change: ChangePoint, label: str, jumps: bool) -> bool:
        """Note the change of a sensor; whether its biases are to begin anew, and not its rows to be left out.

        `label` is that of the bias that jumped. With `jumps` such a jump is part of the model.
        """
        name, mine = change.name, np.flatnonzero(self.owners == change.name)
        self.tallies.recent[mine] = -1
        if self.changed.get(name, AGAIN) < AGAIN or (change.bias < 0 and not change.size <= LARGEST):
            self._note("lost", name, "", change.since, None, change.size)
            return False
        self.changed[name] = 0
        if not (jumps and label):
            self._note("changed", name, label, change.since, change.since, change.size)
        self.explain({name}, change.since)
        return True

    def explain(self, sensors: Set[str], since: float) -> None:
        """A jump of a bias from a time on explains what the innovations of some sensors showed since."""
        self.snapshots = []
        for k in np.flatnonzero(np.isin(self.owners, list(sensors))).tolist():
            self.tallies.forget(k)
        shown = [own for own in self.events if own.kind == "drifts" and own.sensor in sensors]
        explained = [own for own in shown if own.until is not None and own.until >= since]
        self.events = [own for own in self.events if own not in explained]

    # data that were filtered for good

    def add(self, data: StreamData) -> None:
        """Count data in, and look for drifts."""
        count, kept = len(self.names), self.tallies
        kept.seen[:] += np.bincount(data.channel, minlength=count)
        kept.held[:] += np.bincount(data.channel, data.held, minlength=count).astype(int)
        for k in np.unique(data.channel).tolist():
            mine, name = data.channel == k, str(self.owners[k])
            held, times = data.held[mine], data.time[mine]
            kept.recent[k] = np.concatenate([kept.recent[k], held])[1 - RUN :]
            e, score = normal_scores(self.forms[k].noise)
            if score[-1] > 0 and (drift := kept.add(k, np.interp(data.residual[mine], e, score), held)):
                self._note("drifts", name, self.names[k], *(float(times[drift[0]]),) * 2, drift[1])
            if name in self.changed:
                self.changed[name] += int(mine.sum())
                if self.changed[name] >= AGAIN:
                    del self.changed[name]
            if name in self.lost and kept.recent[k].min() >= 0 and kept.recent[k].sum() <= RUN - HELD:
                self._note("lost", name, "", np.inf, float(times[-1]), 0.0)

        for name in np.unique(data.target).tolist():
            own = data.held[data.target == name].tolist()
            self.targets[name] = [*self.targets.pop(name, ()), *own][-RUN:]
        for name in list(self.targets)[:-TARGETS]:
            del self.targets[name]

    def follow(
        self, labels: Sequence[str], steps: Iterable[tuple[float, np.ndarray, np.ndarray]], still: np.ndarray
    ) -> None:
        """Look for biases, in scales, that moved by more than what was learnt of them since explains.

        Between two moments the mean of a constant bias changes by a normal step whose variance is that lost meanwhile.
        `steps` are moments with means and variances (M,); `still` marks biases that are constant and estimated.
        """
        inflation = self.wide.max(initial=1.0)
        for time, mean, variance in steps:
            if self.snapshots and self.snapshots[-1][0] == time:
                continue
            self.moments += 1
            limit = -special.ndtri(0.5 * _rate(max(len(labels), 1) * APART, 0, self.moments))
            if not self.snapshots:
                self.snapshots = [(time, mean, variance)]
                continue
            times, first, before = (np.array(column) for column in zip(*self.snapshots, strict=True))
            learnt = np.maximum(before - variance, 0.0) * inflation
            told = still & (before < KNOWN) & (learnt > LEARNT * variance)
            step = np.where(told, (mean - first) / np.sqrt(np.where(told, learnt, 1.0)), 0.0)
            for then, m in np.argwhere(np.abs(step) > limit).tolist():
                readers = [own for own, read in self.reads.items() if m in read]
                since, size = float(times[then]), float(step[then, m])
                self._note("drifts", readers[0] if readers else "", labels[m], since, time, size)
            self.snapshots.append((time, mean, variance))
            if len(self.snapshots) > SNAPSHOTS:
                del self.snapshots[1 : SNAPSHOTS // 2 : 2]

    @property
    def lost(self) -> list[str]:
        """Sensors whose rows are left out now."""
        return [own.sensor for own in self.events if own.kind == "lost" and own.until is None]

    # what they show

    @property
    def wide(self) -> np.ndarray:
        """Factor of the variance of each channel that the innovations call for."""
        return self.tallies.wide

    @property
    def unexplained(self) -> list[str]:
        """Channels whose data the model does not explain."""
        seen, held = self.tallies.seen, self.tallies.held
        out = (seen >= 2 * RUN) & (held > UNEXPLAINED * seen)
        out |= np.isin(self.owners, list(self.lost)) & (held > 0)
        return [f"{self.owners[k]}.{self.names[k]}" for k in np.flatnonzero(out)]

    @property
    def outliers(self) -> int:
        """Data that were left out."""
        return int(self.tallies.held.sum())

    @property
    def seen(self) -> int:
        """Data that came."""
        return int(self.tallies.seen.sum())

    def text(self) -> str:
        """The findings, in sentences; empty if nothing contradicts the model."""
        if names := self.unexplained:
            return (
                f"The model does not explain {listed(names)}: {self.outliers / max(self.seen, 1):.0%} of all data lie"
                f" beyond its noise and were left out. {self.cause or UNKNOWN}"
            )
        said = [self._said(own) for own in self.events]
        if self.outliers and special.pdtrc(self.outliers - 1, self.seen * self.odds) < RATE:
            said.append(
                f"{self.outliers} of {self.seen} data were left out: outliers, beyond odds of {self.odds:g}."
                " Declare Channel(..., noise=StudentT(4)) where they are to be expected."
            )
        if self.restarts:
            said.append(f"{self.restarts} target{'s' * (self.restarts > 1)} were lost and begun anew.")
        wide = self.wide
        if wide.max(initial=1.0) > 1.0:
            k = int(np.argmax(wide))
            said.append(
                f"The innovations of {self.owners[k]}.{self.names[k]} scatter as if its variance were {wide[k]:.2g}"
                " times as large: intervals are widened."
            )
        return " ".join(said)

    @staticmethod
    def _said(event: Event) -> str:
        """The sentence of an event."""
        name, since, until = event.sensor, event.since, event.until
        when = f"{since:.6g} s" if until in (None, since) else f"{since:.6g} to {until:.6g} s"
        if event.kind == "changed":
            what = f"{event.channel} jumped" if event.channel else f"{name} changed"
            return (
                f"{what} at {when}, by {event.size:.2g} scales, and begins anew there. Take"
                " AugmentedFilter(jumps=Jumps()), --jumps 0.1, where jumps are to be expected."
            )
        if event.kind == "lost":
            return f"Nothing explains the rows of {name} from {when}: they were left out."
        if "." in event.channel:  # a bias
            what = f"{event.channel} moved by {abs(event.size):.2g} sd of what was learnt of it from {when}: it"
        else:
            what = f"The innovations of {name}.{event.channel} have mean {event.size:.2g} at {when}: a bias of {name}"
        return f"{what} drifts or has jumped; take AugmentedFilter(walk=...), --walk."


def _run(before: np.ndarray, held: np.ndarray) -> int | None:
    """The first of data (n,) that are held back one after another, with those before them; None where none are."""
    flags = np.concatenate([before, held]).astype(bool)
    if len(flags) < RUN:
        return None
    full = np.flatnonzero(np.convolve(flags, np.ones(RUN, int), "valid") >= HELD)
    if not len(full):
        return None
    run = flags[full[0] : full[0] + RUN].astype(int)
    wrong = np.cumsum(run) - run + np.cumsum((1 - run)[::-1])[::-1]  # held before each datum, not held from it on
    return max(int(full[0]) + int(np.argmin(wrong)) - len(before), 0)


def _jump(data: StreamData, own: np.ndarray) -> tuple[int, float, float]:
    """The bias whose jump explains data, its size and sd in scales; else -1 and the scales that they call for."""
    off = (data.residual * data.spread)[own]
    lead, slope = data.lead[own], data.slope[own]
    there = slope != 0
    if not there.any():
        return -1, np.inf, np.inf
    bias = int(np.bincount(lead[there]).argmax())
    mine = there & (lead == bias)
    sizes = off[mine] / slope[mine]
    size = float(np.median(sizes))
    # wide, so that the data which show the jump count once
    sd = 3.0 * max(float(np.median(np.abs(sizes - size))) / MEDIAN, float(np.median(1.0 / np.abs(slope[mine]))))
    if mine.mean() > 0.5 and sd < CONSISTENT * abs(size):
        return bias, size, sd
    size = float(np.median(np.abs(off[there] / slope[there])))
    return -1, size, size


def data_in_order(parts: Sequence[StreamData]) -> StreamData:
    """Data of several recursions in the order of their epochs."""
    whole = StreamData(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    order = np.argsort(whole.epoch, kind="stable")
    return StreamData(*(column[order] for column in whole))
