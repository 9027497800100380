"""The motion of each target as arrays: transitions and noise factors of its epochs, and the levels that are unknown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from probcal.errors import InputError
from probcal.model.rows import Parameter
from probcal.model.sampled import SampledMotion, sampled_of
from probcal.motion import Layout, Motion, Target, as_motion
from probcal.motion.base import GAUSSIAN, level_label
from probcal.motion.layout import layout_of, stacked
from probcal.noise import Bernoulli, Growing, Level, Normal, Unknown, guess_of, is_odds, level_at, log_level, unknowns

DIFFUSE = 10.0  # start spread of an undeclared position, in extents of network and measured ranges
FAR = 10.0  # times as wide where no sensor measures a range: bearings of a small array reach far beyond it
# sds of the least known node in an undeclared start: three nodes' common shift is then 0.7 % too
# sure
CLEAR = 5.0


class Area(NamedTuple):
    """The area in which a target starts if nothing is stated about it."""

    dimension: int
    centre: np.ndarray  # (d,)
    extent: float  # in m
    wide: float  # spread of a start, in extents


@dataclass(frozen=True)
class LevelRecord:
    """One unknown noise level: label, unit, guess and the factor within which it is known.

    Of a share between 0 and 1 the factor is that of the odds (`odds`).
    """

    label: str
    unit: str
    guess: float
    factor: float
    odds: bool = field(default=False, repr=False)

    def at(self, log: Any) -> Any:
        """Value at a log level."""
        return level_at(self.guess, self.odds, np.asarray(log, float))

    def log(self, value: Any) -> Any:
        """Log level of a value."""
        return log_level(self.guess, self.odds, value)


def level_values(records: Sequence[LevelRecord], logs: Any) -> np.ndarray:
    """Values (..., H) of levels at log levels (..., H)."""
    logs = np.asarray(logs, float)
    return np.stack([level.at(logs[..., h]) for h, level in enumerate(records)], -1) if records else logs


def level_logs(records: Sequence[LevelRecord], values: Any) -> np.ndarray:
    """Log levels (..., H) of values (..., H)."""
    values = np.asarray(values, float)
    return np.stack([level.log(values[..., h]) for h, level in enumerate(records)], -1) if records else values


class Levels:
    """Collects unknown noise levels; equal declarations under one label are one level."""

    def __init__(self, records: Iterable[LevelRecord] = ()) -> None:
        self.records: list[LevelRecord] = list(records)

    def of(self, level: Level, label: str, unit: str, odds: bool = False) -> int:
        """Number of the level, -1 where it is known."""
        if not isinstance(level, Unknown):
            return -1
        twins = [other for other in self.records if other.label.split("#")[0] == label]
        for k, other in enumerate(twins):
            if (other.guess, other.factor) == (level.guess, level.factor):
                return self.records.index(twins[k])
        name = f"{label}#{len(twins) + 1}" if twins else label
        self.records.append(LevelRecord(name, unit, level.guess, level.factor, odds))
        return len(self.records) - 1


def channel_levels(kind: Any, dimension: int, levels: Levels, sensors: Sequence[str]) -> np.ndarray:
    """Level number (S, C) of each scalar channel of the sensors of a type; a channel per axis has one level."""
    numbers: list[np.ndarray] = []
    for name, channel in kind.channels.items():
        level = np.full(len(sensors), -1)
        if not isinstance(channel.noise, Bernoulli):
            level[:] = _numbers(channel.std, kind, f"{name}_std", channel.unit, levels, sensors)
        numbers += [level] * (dimension if channel.per_axis else 1)
    return np.stack(numbers, 1)


def parameters(
    kind: Any, dimension: int, levels: Levels, sensors: Sequence[str], pieces: Sequence[int]
) -> tuple[Parameter, ...]:
    """Unknown parameters of the noise of each scalar channel of a type, whose sensors count once for each piece."""
    found, column = list[Parameter](), 0
    for channel_name, channel in kind.channels.items():
        width = dimension if channel.per_axis else 1
        for name, level in unknowns(channel.noise).items():
            odds, label = is_odds(channel.noise, name), f"{channel_name}_{name.split('.')[-1]}"
            own = _numbers(level, kind, label, "", levels, sensors, odds)
            number = tuple(np.repeat(own, pieces).tolist()) if level.by else (own[0],)
            found += [Parameter(column + c, name, level.guess, odds, number) for c in range(width)]
        if isinstance(channel.noise, Growing) and isinstance(channel.std, Unknown):
            own = _numbers(channel.std, kind, f"{channel_name}_std", channel.unit, levels, sensors)
            found += [Parameter(column + c, "", channel.std.guess, False, tuple(own)) for c in range(width)]
        column += width
    return tuple(found)


def _numbers(
    level: Level, kind: Any, label: str, unit: str, levels: Levels, sensors: Sequence[str], odds: bool = False
) -> list[int]:
    """Number (S,) of the level that each sensor of a type has: one for all, or each its own."""
    own = isinstance(level, Unknown) and level.by
    return [levels.of(level, f"{name if own else kind.name}.{label}", unit, odds) for name in sensors]


def linear_of(motion: Motion) -> tuple[Any, ...]:
    """Components of what is linear in a motion."""
    vector = motion.split[0]
    return () if vector is None else vector.components


def by_component(components: tuple[Any, ...], d: int) -> list[tuple[Any, slice, slice]]:
    """Each component, its entries of the state in d axes, and the columns of the noise factor that drive it.

    A component has as many columns as entries, for its start; of these its noise needs the first ones, or all.
    """
    found, row = [], 0
    for component in components:
        size, width = component.noise_factor(np.ones(1), d).shape[1:]
        found.append((component, slice(row, row + size), slice(row, row + width)))
        row += size
    return found


def form_of(name: str, motion: Motion, levels: Levels, d: int) -> tuple[Layout, SampledMotion | None]:
    """The layout of a target's state in d axes, and the static form of a nonlinear motion."""
    others = motion.split[1]
    if not others:
        return layout_of(linear_of(motion), d), None
    own = {level: value for other in others for level, value in other.levels.items()}
    numbers = {level: levels.of(value, f"motion.{level}", "") for level, value in own.items()}
    try:
        found = sampled_of(motion, d, numbers, {level: guess_of(value) for level, value in own.items()})
    except InputError as error:
        raise InputError(f'target "{name}": {error}') from None
    return found.layout, found


def chain(
    name: str,
    target: Target,
    time: np.ndarray,
    levels: Levels,
    before: float | None,
    area: Area,
    seen: np.ndarray | None = None,
) -> tuple[np.ndarray, ...]:
    """Arrays of one target's epochs: F, L, level, drift; it begins at the first, or goes on from a time before.

    An undeclared start is as wide as the times `seen` ask for, by default those of the epochs.
    """
    d, components = area.dimension, linear_of(as_motion(target.motion))
    n, epochs = sum(stop - start for _, start, stop, _ in layout_of(components, d)), len(time)
    F, L = np.zeros((epochs, n, n)), np.zeros((epochs, n, n))
    level, drift = np.full((epochs, n), -1), np.zeros((epochs, n))
    dt = np.diff(time, prepend=time[0] if before is None else before)
    for component, here, noise in by_component(components, d):
        F[:, here, here] = component.transition(dt, d)
        L[:, here, noise] = component.noise_factor(dt, d) * guess_of(component.std)
        level[:, noise] = levels.of(component.std, level_label(component), "")
        try:
            drift[:, here] = component.means(time, d)
        except InputError as error:
            raise InputError(f'target "{name}": {error}') from None
        if not component.memoryless and before is None:
            F[0, here, here], drift[0, here] = 0.0, 0.0
            mean, std = start_of(name, component, target, time if seen is None else seen, area)
            L[0, here, :], drift[0, here] = 0.0, mean
            L[0, here, here] = np.diag(std)
            if not getattr(component, "stationary", False):
                level[0, noise] = -1
    if before is None:
        F[0] = 0.0
    return F, L, level, drift


def tails_of(
    target: Target, epochs: int, begins: bool, dimension: int
) -> list[tuple[Any, str, tuple[int, int], np.ndarray]]:
    """Families of the noise of one target that are not Gaussian: what they drive, columns, and epochs (E,)."""
    found = []
    for component, _, noise in by_component(linear_of(as_motion(target.motion)), dimension):
        family, on = getattr(component, "noise", GAUSSIAN), np.ones(epochs, bool)
        on[0] = component.memoryless or not begins
        if noise.stop > noise.start and not isinstance(family, Normal):
            found.append((family, component.driven, (noise.start, noise.stop), on))
    return found


def start_of(name: str, component: Any, target: Target, time: np.ndarray, area: Area) -> tuple[np.ndarray, np.ndarray]:
    """Start mean and standard deviation of a component: declared, its own, or wide."""
    extent, duration = area.extent, float(np.ptp(time)) or 1.0
    pace, wander = area.wide * extent / duration, guess_of(component.std) * np.sqrt(duration)
    bent = component.driven == "acceleration"
    wide = {
        "position": (area.centre, area.wide * extent),
        "velocity": (0.0, pace + wander * (duration if bent else 1.0)),
        "acceleration": (0.0, pace / duration + wander),
    }
    given = wide | component.start() | dict(target.start)
    for part, _ in component.names():
        if part not in given:
            raise InputError(
                f'target "{name}": state the start of "{part}", Target(motion, start={{"{part}": (mean, std)}})'
            )
    try:
        return stacked(component, given, area.dimension)
    except ValueError as error:
        raise InputError(f'target "{name}": {error}') from None
