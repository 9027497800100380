"""The innovations of a stream, channel by channel: outliers, sensors that changed, noise other than declared.

Innovations of the right model are independent, of mean 0 and variance 1. So are sums of 32, 64, 128, ... of them
over the root of their number (batch means): a wrong variance, a memory and a drift show in one or another. All tests
of a stream, whatever its length, share one false-alarm rate.
"""

from __future__ import annotations

from collections.abc import Sequence, Set
from copy import deepcopy
from dataclasses import dataclass, field
from typing import NamedTuple

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
RATE = 1e-3  # probability that a sound stream of any length is called drifting, or widened
BATCH, LEVELS = 32, 20  # innovations of the smallest sum, and doublings of it (3e7 innovations)
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
    reach: np.ndarray  # std of the prediction by biases of one scale, over that of the noise
    held: np.ndarray  # held back


class Change(NamedTuple):
    """A sensor that changed."""

    sensor: str
    epoch: int  # of the window, from which on
    since: float  # s
    size: float  # scales of its biases


@dataclass
class Event:
    """What happened to a sensor: it "changed" (its biases began anew), was "lost" (its rows are left out), "drifts"."""

    kind: str
    sensor: str
    channel: str
    since: float  # s
    until: float | None  # s; None while it goes on
    size: float  # scales of a change, mean of the innovations of a drift


@dataclass
class Sums:
    """Innovations of one channel, alone (0) and in sums of 32, 64, ... of them."""

    waiting: list[list[float]] = field(default_factory=list)  # innovation and whether it was held back
    half: list[float | None] = field(default_factory=lambda: [None] * LEVELS)  # a sum that waits for another
    count: list[int] = field(default_factory=lambda: [0] * (LEVELS + 1))
    square: list[float] = field(default_factory=lambda: [0.0] * (LEVELS + 1))  # of each over the root of its number
    median: float = 0.0  # sum of the medians of the sizes of the smallest sums

    def add(self, value: float, held: bool, channels: int) -> float:
        """Take an innovation; the mean of a sum that is too far from zero, else 0."""
        self.waiting.append([value, float(held)])
        if len(self.waiting) < BATCH:
            return 0.0
        values, out = np.array(self.waiting).T
        self.waiting, admitted = [], values[out == 0]
        self.median += float(np.median(np.abs(values)))
        self.count[0] += len(admitted)
        self.square[0] += float(np.sum(admitted**2))
        return self._carried(float(admitted.sum() / np.sqrt(max(len(admitted), 1))), channels)

    def _carried(self, total: float, channels: int) -> float:
        """A sum of the smallest length added to the longer ones; the mean of one that is too far from zero."""
        shift = 0.0
        for k in range(LEVELS):
            self.count[k + 1] += 1
            self.square[k + 1] += total**2
            mean = total / np.sqrt(BATCH << k)
            limit = -special.ndtri(0.5 * _rate(channels, k, self.count[k + 1]))
            if abs(total) > limit and abs(mean) > SHIFT:
                shift = mean
            other, self.half[k] = self.half[k], None if self.half[k] is not None else total
            if other is None:
                break
            total = (total + other) / np.sqrt(2.0)
        return float(shift)

    def wide(self, channels: int) -> float:
        """Factor of the variance of the noise that the innovations call for, 1 where they are as declared."""
        found = 1.0
        for k, (count, square) in enumerate(zip(self.count, self.square, strict=True)):
            factor, likely = square / max(count, 1), _rate(channels, k, 1 + int(np.log2(max(count, 1))))
            if count >= FEWEST and factor > PRACTICAL and special.chdtrc(count, square) < likely:
                found = max(found, factor)
        if self.count[1] and (robust := (self.median / self.count[1] / MEDIAN) ** 2) > max(found, PRACTICAL**2):
            found = robust  # of innovations so large that many are held back
        return found


def _rate(channels: int, level: int, number: int) -> float:
    """The share of a test in the false-alarm rate: these of all levels and numbers add up to it."""
    return RATE / max(channels, 1) * (6.0 / np.pi**2) ** 2 / ((level + 1) ** 2 * number**2)


@dataclass
class Surveillance:
    """What the innovations of a stream have shown so far; its memory does not grow with the stream."""

    network: Network
    odds: float  # probability of a datum of the right model to be held back
    sums: list[Sums] = field(default_factory=list)
    seen: np.ndarray = field(default_factory=lambda: np.zeros(0, int))  # data of each channel
    held: np.ndarray = field(default_factory=lambda: np.zeros(0, int))  # of them held back
    recent: list[list[bool]] = field(default_factory=list)  # the last of each channel: held back
    changed: dict[str, int] = field(default_factory=dict)  # data of a sensor since it changed
    events: list[Event] = field(default_factory=list)
    cause: str = ""  # of data that the model does not explain, where it was looked for

    def __post_init__(self) -> None:
        parts = [placed.type.expand(self.network.dimension) for placed in self.network.sensors]
        names = [placed.name for placed in self.network.sensors]
        self.owners = np.repeat(np.array(names, str), [len(part) for part in parts])  # sensor of each channel
        self.names = [name for part in parts for name, _ in part]
        self.forms = [channel for part in parts for _, channel in part]
        count = len(self.names)
        if not self.sums:
            self.sums, self.recent = [Sums() for _ in range(count)], [[] for _ in range(count)]
            self.seen, self.held = np.zeros(count, int), np.zeros(count, int)

    def copy(self) -> Surveillance:
        """As it stands now."""
        return deepcopy(self)

    # sensors that change

    def change(self, data: StreamData) -> Change | None:
        """The first sensor of a window whose data are held back one after another, while those of others are not."""
        found = []
        for k in np.unique(data.channel[data.held]).tolist():
            if self.owners[k] in self.lost:
                continue
            mine = np.flatnonzero(data.channel == k)
            flags = np.array([*self.recent[k], *data.held[mine]])
            if len(flags) < RUN:
                continue
            runs = np.convolve(flags, np.ones(RUN, int), "valid")
            full = np.flatnonzero(runs >= HELD)
            if len(full):
                first = int(full[0]) + int(np.argmax(flags[full[0] :])) - len(self.recent[k])
                found.append((data.epoch[mine[max(first, 0)]], str(self.owners[k]), mine[max(first, 0) :]))
        for epoch, sensor, mine in sorted(found, key=lambda one: one[:2]):
            since = data.time[mine[0]]
            during = (data.time >= since) & np.isin(data.target, data.target[mine])
            others = during & (self.owners[data.channel] != sensor)
            if others.sum() >= HELD and data.held[others].mean() > SHARED:
                continue
            own = during & (self.owners[data.channel] == sensor) & data.held & (data.reach > 0)
            size = float(np.median(np.abs(data.residual * data.spread)[own] / data.reach[own])) if own.any() else np.inf
            return Change(sensor, int(epoch), float(since), size)
        return None

    def begin_anew(self, change: Change, jumps: bool) -> bool:
        """Note a change; whether the biases of the sensor are to begin anew, and not its rows to be left out.

        With `jumps` its rows are let in until the jump of a bias is found.
        """
        name = change.sensor
        mine = np.flatnonzero(self.owners == name)
        again = self.changed.get(name, AGAIN) < AGAIN or (jumps and name in self.changed)
        for k in mine:
            self.recent[k] = []
        if again or not change.size <= LARGEST:
            self.events.append(Event("lost", name, "", change.since, None, change.size))
            return False
        self.changed[name] = 0
        if not jumps:
            self.events.append(Event("changed", name, "", change.since, change.since, change.size))
        for k in mine:
            self.sums[k] = Sums()
        return True

    def explain(self, sensors: Set[str], since: float) -> None:
        """A jump of a bias from a time on explains what the innovations of some sensors showed since."""
        for name in sensors:
            self.changed.pop(name, None)
        for k in np.flatnonzero(np.isin(self.owners, list(sensors))):
            self.sums[k] = Sums()
        shown = [own for own in self.events if own.kind == "drifts" and own.sensor in sensors]
        explained = [own for own in shown if own.until is not None and own.until >= since]
        self.events = [own for own in self.events if own not in explained]

    # data that were filtered for good

    def add(self, data: StreamData) -> None:
        """Count data in, and look for drifts."""
        count = len(self.names)
        self.seen += np.bincount(data.channel, minlength=count)
        self.held += np.bincount(data.channel, data.held, minlength=count).astype(int)
        for k in np.unique(data.channel).tolist():
            mine, name = data.channel == k, str(self.owners[k])
            held, times = data.held[mine], data.time[mine]
            self.recent[k] = [*self.recent[k], *held.tolist()][1 - RUN :]
            e, score = normal_scores(self.forms[k].noise)
            if score[-1] > 0:
                for value, out, at in zip(np.interp(data.residual[mine], e, score), held, times, strict=True):
                    if shift := self.sums[k].add(float(value), bool(out), count):
                        self._drift(name, self.names[k], float(at), shift)
            if name in self.changed:
                self.changed[name] += int(mine.sum())
            if name in self.lost and len(self.recent[k]) == RUN - 1 and sum(self.recent[k]) <= RUN - HELD:
                self._open("lost", name).until = float(times[-1])

    def _drift(self, name: str, channel: str, at: float, shift: float) -> None:
        same = "drifts", name, channel
        old = next((own for own in self.events if (own.kind, own.sensor, own.channel) == same), None)
        if old is None:
            self.events.append(Event("drifts", name, channel, at, at, shift))
        else:
            old.until, old.size = at, shift

    @property
    def lost(self) -> list[str]:
        """Sensors whose rows are left out now."""
        return [own.sensor for own in self.events if own.kind == "lost" and own.until is None]

    def _open(self, kind: str, name: str) -> Event:
        """The event of a sensor that goes on."""
        return next(own for own in self.events if (own.kind, own.sensor, own.until) == (kind, name, None))

    # what they show

    @property
    def wide(self) -> np.ndarray:
        """Factor of the variance of each channel that the innovations call for."""
        return np.array([own.wide(len(self.names)) for own in self.sums])

    @property
    def unexplained(self) -> list[str]:
        """Channels whose data the model does not explain."""
        out = (self.seen >= 2 * RUN) & (self.held > UNEXPLAINED * self.seen)
        out |= np.isin(self.owners, list(self.lost)) & (self.held > 0)
        return [f"{self.owners[k]}.{self.names[k]}" for k in np.flatnonzero(out)]

    @property
    def surprising(self) -> int:
        """Data that were held back, where they are more than a sound stream has; else 0."""
        out, expected = int(self.held.sum()), float(self.seen.sum()) * self.odds
        return out if out and special.pdtrc(out - 1, expected) < RATE else 0

    def text(self) -> str:
        """What it found, in sentences; empty where nothing speaks against the model."""
        if names := self.unexplained:
            share = self.held.sum() / max(self.seen.sum(), 1)
            return (
                f"The model does not explain {listed(names)}: {share:.0%} of all data lie beyond its noise and were"
                f" left out. {self.cause or UNKNOWN}"
            )
        said = []
        for name, own in self._by_sensor("changed").items():
            said.append(
                f"{name} changed at {_times(own)}, by about {own[-1].size:.2g} scales of its biases: they begin anew"
                " there. Take AugmentedFilter(jumps=Jumps()), --jumps 0.1, to find the bias that jumped."
            )
        for name, own in self._by_sensor("lost").items():
            said.append(f"Nothing explains the rows of {name} from {_times(own)} on: they were left out for a time.")
        for name, own in self._by_sensor("drifts").items():
            said.append(
                f"The innovations of {name}.{own[0].channel} have mean {own[0].size:.2g} up to {own[0].until:.6g} s:"
                f" a bias of {name} drifts or has jumped; take AugmentedFilter(walk=...), --walk."
            )
        if out := self.surprising:
            said.append(
                f"{out} of {self.seen.sum()} data were left out: outliers, beyond odds of {self.odds:g}."
                " Declare Channel(..., noise=StudentT(4)) where they are to be expected."
            )
        wide = self.wide
        if wide.max(initial=1.0) > 1.0:
            k = int(np.argmax(wide))
            said.append(
                f"The innovations of {self.owners[k]}.{self.names[k]} scatter as if its"
                f" variance were {wide[k]:.2g} times as large: intervals are widened."
            )
        return " ".join(said)

    def _by_sensor(self, kind: str) -> dict[str, list[Event]]:
        """Events of a kind by their sensor."""
        return {
            own.sensor: [e for e in self.events if (e.kind, e.sensor) == (kind, own.sensor)]
            for own in self.events
            if own.kind == kind
        }


def _times(events: Sequence[Event]) -> str:
    """When events began."""
    return f"{', '.join(f'{own.since:.6g}' for own in events[:3])}{', ...' if len(events) > 3 else ''} s"


def data_in_order(parts: Sequence[StreamData]) -> StreamData:
    """Data of several recursions in the order of their epochs."""
    whole = StreamData(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    order = np.argsort(whole.epoch, kind="stable")
    return StreamData(*(column[order] for column in whole))
