"""Motion of a target: records of named state components that compose with `+`.

A component knows its names, its transition over a time step and its noise factor; a motion stacks them.
To add one, write a frozen dataclass with the members of `Component` and compose it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np

from probcal.errors import InputError, nearest
from probcal.geometry import slopes
from probcal.labels import AXES
from probcal.lazy import Later
from probcal.noise import Level, check_level
from probcal.types import TargetView

if TYPE_CHECKING:
    import pandas as pd
else:
    pd = Later("pandas")


class Component(Protocol):
    """Part of a target's state that evolves on its own; `dt` has shape (E,), s is its size in `dimension` axes.

    `memoryless` components are drawn anew at every epoch around `means`; the others start from `start()`. `driven`
    names the state component that the noise drives.
    """

    @property
    def memoryless(self) -> bool: ...
    @property
    def std(self) -> Level: ...
    @property
    def driven(self) -> str: ...
    def names(self) -> tuple[tuple[str, bool], ...]: ...
    def transition(self, dt: np.ndarray, dimension: int) -> np.ndarray: ...
    def noise_factor(self, dt: np.ndarray, dimension: int) -> np.ndarray: ...
    def means(self, time: np.ndarray, dimension: int) -> np.ndarray: ...
    def start(self) -> dict[str, tuple[Any, float]]: ...


class _Composable:
    """`a + b` stacks two components (or motions) into one `Motion`."""

    memoryless: ClassVar[bool] = False

    @property
    def driven(self: Component) -> str:
        """State component that the noise drives: the last one."""
        return self.names()[-1][0]

    def means(self: Component, time: np.ndarray, dimension: int) -> np.ndarray:
        """Zero: what has a memory is known by its start alone, shape (E, s)."""
        return np.zeros((len(time), sum(dimension if per_axis else 1 for _, per_axis in self.names())))

    def __add__(self, other: Any) -> Motion:
        return Motion((*_components(self), *_components(other)))


def _blocks(rows: list[list[Any]], dimension: int, dt: np.ndarray) -> np.ndarray:
    """Stack (E,) entries into (E, r * d, c * d) matrices, one identity block of size d an entry."""
    small = np.stack([np.stack([np.broadcast_to(np.asarray(v, float), dt.shape) for v in row], -1) for row in rows], -2)
    return np.einsum("erc,ij->ericj", small, np.eye(dimension)).reshape(
        len(dt), len(rows) * dimension, len(rows[0]) * dimension
    )


@dataclass(frozen=True)
class ConstantVelocity(_Composable):
    """Constant velocity in 2-D or 3-D (Paper C 45-46).

    Full rank: `std` in m s^-3/2 with covariance std^2 [[T^3/3, T^2/2], [T^2/2, T]] an axis.
    `singular=True`: `std` in m s^-2, G = [T^2/2, T], the rank-deficient form of the papers.
    """

    std: Level
    singular: bool = False

    def __post_init__(self):
        check_level(self.std, "ConstantVelocity: std", zero=True)

    def names(self) -> tuple[tuple[str, bool], ...]:
        """State components and whether each has one value an axis."""
        return (("position", True), ("velocity", True))

    def transition(self, dt: np.ndarray, dimension: int) -> np.ndarray:
        """Transition matrices, shape (E, 2d, 2d)."""
        return _blocks([[1.0, dt], [0.0, 1.0]], dimension, dt)

    def noise_factor(self, dt: np.ndarray, dimension: int) -> np.ndarray:
        """Noise factors for unit std, shape (E, 2d, d) or (E, 2d, 2d)."""
        if self.singular:
            return _blocks([[dt**2 / 2], [dt]], dimension, dt)
        root = np.sqrt(dt)
        return _blocks([[dt * root / np.sqrt(3), 0.0], [root * np.sqrt(3) / 2, root / 2]], dimension, dt)

    def start(self) -> dict[str, tuple[Any, float]]:
        """No default: position and velocity start wide, from the extent of network and recording."""
        return {}


@dataclass(frozen=True)
class ConstantAcceleration(_Composable):
    """Constant acceleration in 2-D or 3-D (Bar-Shalom, Li, Kirubarajan 2001, 6.2.3 and 6.3.3).

    Full rank: white jerk, `std` in m s^-5/2 with covariance std^2 times
    [[T^5/20, T^4/8, T^3/6], [T^4/8, T^3/3, T^2/2], [T^3/6, T^2/2, T]] an axis. `singular=True`: `std` in m s^-2 is
    the change of acceleration from epoch to epoch, G = [T^2/2, T, 1].
    """

    std: Level
    singular: bool = False

    def __post_init__(self):
        check_level(self.std, "ConstantAcceleration: std", zero=True)

    def names(self) -> tuple[tuple[str, bool], ...]:
        """State components and whether each has one value an axis."""
        return (("position", True), ("velocity", True), ("acceleration", True))

    def transition(self, dt: np.ndarray, dimension: int) -> np.ndarray:
        """Transition matrices, shape (E, 3d, 3d)."""
        return _blocks([[1.0, dt, dt**2 / 2], [0.0, 1.0, dt], [0.0, 0.0, 1.0]], dimension, dt)

    def noise_factor(self, dt: np.ndarray, dimension: int) -> np.ndarray:
        """Noise factors for unit std, shape (E, 3d, d) or (E, 3d, 3d): the Cholesky factor written out."""
        if self.singular:
            return _blocks([[dt**2 / 2], [dt], [1.0]], dimension, dt)
        root = np.sqrt(dt)
        jerk = [
            [dt**2 / np.sqrt(20), 0.0, 0.0],
            [dt * np.sqrt(5) / 4, dt / np.sqrt(48), 0.0],
            [np.sqrt(5) / 3, 1 / np.sqrt(3), 1 / 3],
        ]
        return _blocks([[root * entry for entry in row] for row in jerk], dimension, dt)

    def start(self) -> dict[str, tuple[Any, float]]:
        """No default: all start wide, from the extent of network and recording."""
        return {}


@dataclass(frozen=True)
class CoordinatedTurn(_Composable):
    """Turn of known `rate` in rad/s (left positive) in the x-y plane (Bar-Shalom, Li, Kirubarajan 2001, 11.7.1).

    `std` in m s^-3/2: white acceleration as in `ConstantVelocity`, here carried along the turn; a rate of 0, and
    the z axis, are constant velocity.
    """

    std: Level
    rate: float

    def __post_init__(self):
        check_level(self.std, "CoordinatedTurn: std", zero=True)
        if not np.isfinite(self.rate):
            raise InputError(f"CoordinatedTurn: rate is {self.rate!r}: give a finite number in rad/s")

    def names(self) -> tuple[tuple[str, bool], ...]:
        """State components and whether each has one value an axis."""
        return (("position", True), ("velocity", True))

    def transition(self, dt: np.ndarray, dimension: int) -> np.ndarray:
        """Transition matrices, shape (E, 2d, 2d); x + iy has velocity exp(i rate T)."""
        angle = self.rate * dt
        moved = dt * np.exp(0.5j * angle) * np.sinc(angle / (2 * np.pi))
        return self._turned([[1.0, moved], [0.0, np.exp(1j * angle)]], [[1.0, dt], [0.0, 1.0]], dimension, dt)

    def noise_factor(self, dt: np.ndarray, dimension: int) -> np.ndarray:
        """Noise factors for unit std, shape (E, 2d, 2d).

        Of x + iy: position variance T^3 g, covariance with the conjugate velocity T^2 c, velocity variance T, with
        g = 2 (a - sin a) / a^3 and c = (1 - cos a) / a^2 - i a g / 2 at the angle a = rate T.
        """
        angle, root = self.rate * dt, np.sqrt(dt)
        g = _turn_variance(angle)
        c = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 - 0.5j * angle * g
        along = c.conj() / np.sqrt(g)
        rest = np.sqrt(np.maximum(1.0 - np.abs(along) ** 2, 0.0))
        straight = ConstantVelocity(1.0).noise_factor(dt, 1)
        rows = [[straight[:, r, k] for k in range(2)] for r in range(2)]
        turned = [[dt * root * np.sqrt(g), 0.0], [root * along, root * rest]]
        return self._turned(turned, rows, dimension, dt)

    def start(self) -> dict[str, tuple[Any, float]]:
        """No default: position and velocity start wide, from the extent of network and recording."""
        return {}

    @staticmethod
    def _turned(plane: list[list[Any]], up: list[list[Any]], dimension: int, dt: np.ndarray) -> np.ndarray:
        """Stack complex entries that act on x + iy, and real ones that act on z, into (E, 2d, 2d) matrices."""
        full = _blocks(up, dimension, dt)
        for r, row in enumerate(plane):
            for k, entry in enumerate(row):
                x, y, u, v = r * dimension, r * dimension + 1, k * dimension, k * dimension + 1
                full[:, x, u] = full[:, y, v] = np.real(entry)
                full[:, y, u], full[:, x, v] = np.imag(entry), -np.imag(entry)
        return full


def _turn_variance(angle: np.ndarray) -> np.ndarray:
    """2 (a - sin a) / a^3, by its series where the difference would cancel."""
    small = np.abs(angle) < 0.5
    series = sum(2 * (-1) ** k * angle ** (2 * k) / math.factorial(2 * k + 3) for k in range(6))
    a = np.where(small, 1.0, angle)
    return np.where(small, series, 2 * (a - np.sin(a)) / a**3)


@dataclass(frozen=True)
class Static(_Composable):
    """A target that does not move: all its rows form one epoch."""

    std: Level = 0.0

    def names(self) -> tuple[tuple[str, bool], ...]:
        """State components and whether each has one value an axis."""
        return (("position", True),)

    def transition(self, dt: np.ndarray, dimension: int) -> np.ndarray:
        """Identity, shape (E, d, d)."""
        return _blocks([[1.0]], dimension, dt)

    def noise_factor(self, dt: np.ndarray, dimension: int) -> np.ndarray:
        """No noise, shape (E, d, 0)."""
        return np.zeros((len(dt), dimension, 0))

    def start(self) -> dict[str, tuple[Any, float]]:
        """No default: the position starts wide."""
        return {}


@dataclass(frozen=True)
class RandomWalk(_Composable):
    """A scalar (or, `per_axis`, a vector) component that drifts: `std` in unit s^-1/2, `initial` = (mean, std)."""

    name: str
    unit: str
    std: Level
    initial: tuple[float, float]
    per_axis: bool = False

    def __post_init__(self):
        check_level(self.std, f'RandomWalk("{self.name}"): std', zero=True)
        _check_pair(self.initial, f'RandomWalk("{self.name}"): initial')

    def names(self) -> tuple[tuple[str, bool], ...]:
        """State component and whether it has one value an axis."""
        return ((self.name, self.per_axis),)

    def transition(self, dt: np.ndarray, dimension: int) -> np.ndarray:
        """Identity, shape (E, s, s)."""
        return _blocks([[1.0]], dimension if self.per_axis else 1, dt)

    def noise_factor(self, dt: np.ndarray, dimension: int) -> np.ndarray:
        """Noise factors for unit std, shape (E, s, s)."""
        return _blocks([[np.sqrt(dt)]], dimension if self.per_axis else 1, dt)

    def start(self) -> dict[str, tuple[Any, float]]:
        """Mean and standard deviation at the first epoch."""
        return {self.name: self.initial}


@dataclass(frozen=True)
class White(_Composable):
    """A component drawn anew at every epoch (an unknown emission range, say): `mean` (one or one an axis), `std`."""

    memoryless: ClassVar[bool] = True

    name: str
    unit: str
    std: Level
    mean: Any = 0.0
    per_axis: bool = False

    def __post_init__(self):
        check_level(self.std, f'White("{self.name}"): std')

    def names(self) -> tuple[tuple[str, bool], ...]:
        """State component and whether it has one value an axis."""
        return ((self.name, self.per_axis),)

    def transition(self, dt: np.ndarray, dimension: int) -> np.ndarray:
        """Zero, shape (E, s, s): nothing is kept."""
        return _blocks([[0.0]], dimension if self.per_axis else 1, dt)

    def noise_factor(self, dt: np.ndarray, dimension: int) -> np.ndarray:
        """Identity, shape (E, s, s)."""
        return _blocks([[1.0]], dimension if self.per_axis else 1, dt)

    def means(self, time: np.ndarray, dimension: int) -> np.ndarray:
        """The one mean at every epoch, shape (E, s)."""
        return np.broadcast_to(self.mean, (len(time), dimension if self.per_axis else 1))

    def start(self) -> dict[str, tuple[Any, float]]:
        """None: the first epoch is like every other."""
        return {}


@dataclass(frozen=True, eq=False)
class Known(_Composable):
    """A target whose path is known or reported (a surveyed walk, ADS-B, AIS): interpolated, not searched for.

    `track` is a DataFrame with the columns time, position_x, position_y[, position_z] and, where known, velocity_x,
    ... (or a pair of arrays, times (T,) in s and positions (T, d) in m); without velocities they are its differences.
    `std` is that of the reported position on each axis in m, drawn anew at every epoch; 0 takes it as exact.
    """

    memoryless: ClassVar[bool] = True
    driven: ClassVar[str] = "position"

    track: Any
    std: Level = 0.0
    time: np.ndarray = field(init=False, repr=False)  # (T,)
    state: np.ndarray = field(init=False, repr=False)  # (T, 2d) positions, velocities

    def __post_init__(self):
        check_level(self.std, "Known: std", zero=True)
        time, position, velocity = _track(self.track)
        if time.ndim != 1 or position.ndim != 2 or len(position) != len(time) or position.shape[1] not in (2, 3):
            raise InputError(
                f"Known: time has shape {time.shape} and position {position.shape}; give (T,) and (T, 2 or 3)"
            )
        if not len(time) or not (np.diff(time) > 0).all():
            raise InputError("Known: time must increase; give one track a target, sorted by time")
        if velocity is None:
            velocity = slopes(time, position)
        state = np.concatenate([position, velocity], 1)
        if not (np.isfinite(time).all() and np.isfinite(state).all()):
            raise InputError("Known: time, position and velocity must be finite; drop the gaps")
        object.__setattr__(self, "time", time)
        object.__setattr__(self, "state", state)

    def names(self) -> tuple[tuple[str, bool], ...]:
        """State components and whether each has one value an axis."""
        return (("position", True), ("velocity", True))

    def transition(self, dt: np.ndarray, dimension: int) -> np.ndarray:
        """Zero, shape (E, 2d, 2d): every epoch is known by itself."""
        return np.zeros((len(dt), 2 * dimension, 2 * dimension))

    def noise_factor(self, dt: np.ndarray, dimension: int) -> np.ndarray:
        """Identity for the position, nothing for the velocity, shape (E, 2d, d); no column where std is 0."""
        factor = _blocks([[1.0], [0.0]], dimension, dt)
        return factor[:, :, :0] if self.std == 0 else factor

    def means(self, time: np.ndarray, dimension: int) -> np.ndarray:
        """The track at each time, shape (E, 2d); raises `InputError` outside it."""
        if self.state.shape[1] != 2 * dimension:
            raise InputError(f"the known track is {self.state.shape[1] // 2}-D, the network {dimension}-D")
        outside = (time < self.time[0] - 1e-9) | (time > self.time[-1] + 1e-9)
        if outside.any():
            raise InputError(
                f"time {time[outside][0]:g} is outside its known track, which runs from {self.time[0]:g}"
                f" to {self.time[-1]:g}; drop the rows or extend the track"
            )
        return np.stack([np.interp(time, self.time, column) for column in self.state.T], 1)

    def start(self) -> dict[str, tuple[Any, float]]:
        """None: the first epoch is like every other."""
        return {}


def _track(given: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Times (T,), positions (T, d) and velocities (T, d), where given, of a frame or a pair of arrays."""
    if not isinstance(given, pd.DataFrame):
        try:
            time, position = (np.asarray(part, float) for part in given)
        except (TypeError, ValueError):
            raise InputError(
                "Known: give a DataFrame with the columns time, position_x, position_y, or a pair (time, position)"
            ) from None
        return time, position, None
    axes = AXES if "position_z" in given else AXES[:2]
    wanted = ["time", *(f"position_{axis}" for axis in axes)]
    if any(column.startswith("velocity_") for column in map(str, given.columns)):
        wanted += [f"velocity_{axis}" for axis in axes]
    for column in wanted:
        if column not in given:
            raise InputError(f'Known: the track has no column "{column}"{nearest(column, given.columns)}')
    try:
        values = given[wanted].to_numpy(float)
    except (TypeError, ValueError):
        raise InputError(f"Known: the columns {', '.join(wanted)} of the track must hold numbers") from None
    d = len(axes)
    return values[:, 0], values[:, 1 : 1 + d], values[:, 1 + d :] if len(wanted) > 1 + d else None


def _check_pair(pair: Any, what: str) -> None:
    try:
        mean, std = pair
        fine = bool(np.all(np.isfinite(mean)) and np.isfinite(std) and std > 0)
    except (TypeError, ValueError):
        fine = False
    if not fine:
        raise InputError(f"{what} is {pair!r}: give (mean, std) with finite values and a positive std")


@dataclass(frozen=True)
class Motion:
    """Components stacked into one state vector, in order."""

    components: tuple[Any, ...]

    def __post_init__(self):
        names = [name for component in self.components for name, _ in component.names()]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise InputError(f'motion: component "{twice[0]}" is declared twice')

    def __add__(self, other: Any) -> Motion:
        return Motion((*self.components, *_components(other)))

    @property
    def static(self) -> bool:
        """Whether nothing ever moves, so that all rows of a target form one epoch."""
        return all(isinstance(component, Static) for component in self.components)

    def layout(self, dimension: int) -> tuple[tuple[str, int, int, bool], ...]:
        """State components as (name, start, stop, per axis)."""
        spans, offset = [], 0
        for component in self.components:
            for name, per_axis in component.names():
                width = dimension if per_axis else 1
                spans.append((name, offset, offset + width, per_axis))
                offset += width
        return tuple(spans)

    def size(self, dimension: int) -> int:
        """Length of the state vector."""
        return self.layout(dimension)[-1][2]

    def labels(self, dimension: int) -> tuple[str, ...]:
        """State components by scalar name (`position_x`, `velocity_y`, `power`)."""
        return tuple(
            f"{name}_{axis}" if per_axis else name
            for name, _, _, per_axis in self.layout(dimension)
            for axis in (AXES[:dimension] if per_axis else ("",))
        )


def view(layout: tuple[tuple[str, int, int, bool], ...], state: Any) -> TargetView:
    """Read a state vector (n,) by component name; scalar components are scalars."""
    return TargetView(
        "the target", {name: state[start:stop] if per_axis else state[start] for name, start, stop, per_axis in layout}
    )


def as_motion(value: Any) -> Motion:
    """Accept a bare component where a motion is meant."""
    return value if isinstance(value, Motion) else Motion(_components(value))


def _components(value: Any) -> tuple[Any, ...]:
    """Components of a motion or of a bare component."""
    if isinstance(value, Motion):
        return value.components
    for member in ("names", "transition", "noise_factor", "start"):
        if not hasattr(value, member):
            raise InputError(f"{value!r} is not a motion; give ConstantVelocity(std), Static(), or a sum of components")
    return (value,)


@dataclass(frozen=True)
class Target:
    """A target with a motion of its own and, where known, its start: component -> (mean, std)."""

    motion: Any
    start: Mapping[str, tuple[Any, float]] = field(default_factory=dict)

    def __post_init__(self):
        components = as_motion(self.motion).components
        known = [name for component in components for name, _ in component.names()]
        anew = {name for component in components if component.memoryless for name, _ in component.names()}
        for name, pair in self.start.items():
            if name not in known:
                raise InputError(f'Target start: the motion has no component "{name}"{nearest(name, known)}')
            if name in anew:
                raise InputError(f'Target start: "{name}" is drawn anew at every epoch; state it in the motion')
            _check_pair(pair, f'Target start "{name}"')
