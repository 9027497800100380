"""Motion of a target: records of named state components that compose with `+`.

A component knows its names, its transition over a time step and its noise factor; a motion stacks them.
To add one, write a frozen dataclass with the members of `Component` and compose it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol

import numpy as np

from probcal.noise import Level, check_level
from probcal.types import AXES, InputError, TargetView, nearest


class Component(Protocol):
    """Part of a target's state that evolves on its own; `dt` has shape (E,), s is its size in `dimension` axes.

    `memoryless` components are drawn anew at every epoch around `mean`; the others start from `start()`.
    """

    @property
    def memoryless(self) -> bool: ...
    @property
    def mean(self) -> float: ...
    @property
    def std(self) -> Level: ...
    def names(self) -> tuple[tuple[str, bool], ...]: ...
    def transition(self, dt: np.ndarray, dimension: int) -> np.ndarray: ...
    def noise_factor(self, dt: np.ndarray, dimension: int) -> np.ndarray: ...
    def start(self) -> dict[str, tuple[Any, float]]: ...


class _Composable:
    """`a + b` stacks two components (or motions) into one `Motion`."""

    memoryless: ClassVar[bool] = False
    mean: float = 0.0

    def __add__(self, other: Any) -> "Motion":
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
    """A component drawn anew at every epoch (an unknown emission range, say): mean `mean`, `std` in its unit."""

    memoryless: ClassVar[bool] = True

    name: str
    unit: str
    std: Level
    mean: float = 0.0
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

    def start(self) -> dict[str, tuple[Any, float]]:
        """None: the first epoch is like every other."""
        return {}


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

    def __add__(self, other: Any) -> "Motion":
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
        known = [name for component in as_motion(self.motion).components for name, _ in component.names()]
        for name, pair in self.start.items():
            if name not in known:
                raise InputError(f'Target start: the motion has no component "{name}"{nearest(name, known)}')
            _check_pair(pair, f'Target start "{name}"')
