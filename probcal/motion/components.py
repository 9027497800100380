"""The linear motions of the package, and the scalar parts that compose with them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from probcal.errors import InputError
from probcal.motion.base import GAUSSIAN, Component
from probcal.motion.target import check_pair
from probcal.noise import Level, check_driven, guess_of

PLANE, QUARTER, UP = np.diag([1.0, 1.0, 0.0]), np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 0]]), np.diag([0.0, 0, 1])


def blocks(rows: list[list[Any]], dimension: int, dt: Any, axes: np.ndarray | None = None) -> Any:
    """Stack (E,) entries into (E, r * d, c * d) matrices, each times `axes` (d, d), by default the identity."""
    xp = dt.__array_namespace__()
    small = xp.stack(
        [xp.stack([xp.broadcast_to(xp.asarray(v, dtype=float), dt.shape) for v in row], -1) for row in rows], -2
    )
    return xp.einsum("erc,ij->ericj", small, np.eye(dimension) if axes is None else axes).reshape(
        len(dt), len(rows) * dimension, len(rows[0]) * dimension
    )


@dataclass(frozen=True)
class ConstantVelocity(Component):
    """Constant velocity in 2-D or 3-D (Paper C 45-46).

    Full rank: `std` in m s^-3/2 with covariance std^2 [[T^3/3, T^2/2], [T^2/2, T]] an axis.
    `singular=True`: `std` in m s^-2, G = [T^2/2, T], the rank-deficient form of the papers.
    """

    next_order = "ConstantAcceleration(std)"

    std: Level
    singular: bool = False
    noise: Any = GAUSSIAN

    def __post_init__(self):
        check_driven(self, "ConstantVelocity:")

    def names(self) -> tuple[tuple[str, bool], ...]:
        """State components and whether each has one value an axis."""
        return (("position", True), ("velocity", True))

    def transition(self, dt: Any, dimension: int) -> Any:
        """Transition matrices, shape (E, 2d, 2d)."""
        return blocks([[1.0, dt], [0.0, 1.0]], dimension, dt)

    def noise_factor(self, dt: Any, dimension: int) -> Any:
        """Noise factors for unit std, shape (E, 2d, d) or (E, 2d, 2d)."""
        if self.singular:
            return blocks([[dt**2 / 2], [dt]], dimension, dt)
        root = dt.__array_namespace__().sqrt(dt)
        return blocks([[dt * root / np.sqrt(3), 0.0], [root * np.sqrt(3) / 2, root / 2]], dimension, dt)


@dataclass(frozen=True)
class ConstantAcceleration(Component):
    """Constant acceleration in 2-D or 3-D (Bar-Shalom, Li, Kirubarajan 2001, 6.2.3 and 6.3.3).

    Full rank: white jerk, `std` in m s^-5/2 with covariance std^2 times
    [[T^5/20, T^4/8, T^3/6], [T^4/8, T^3/3, T^2/2], [T^3/6, T^2/2, T]] an axis. `singular=True`: `std` in m s^-2 is
    the change of acceleration from epoch to epoch, G = [T^2/2, T, 1].
    """

    std: Level
    singular: bool = False
    noise: Any = GAUSSIAN

    def __post_init__(self):
        check_driven(self, "ConstantAcceleration:")

    def names(self) -> tuple[tuple[str, bool], ...]:
        """State components and whether each has one value an axis."""
        return (("position", True), ("velocity", True), ("acceleration", True))

    def transition(self, dt: Any, dimension: int) -> Any:
        """Transition matrices, shape (E, 3d, 3d)."""
        return blocks([[1.0, dt, dt**2 / 2], [0.0, 1.0, dt], [0.0, 0.0, 1.0]], dimension, dt)

    def noise_factor(self, dt: Any, dimension: int) -> Any:
        """Noise factors for unit std, shape (E, 3d, d) or (E, 3d, 3d): the Cholesky factor written out."""
        if self.singular:
            return blocks([[dt**2 / 2], [dt], [1.0]], dimension, dt)
        root = dt.__array_namespace__().sqrt(dt)
        jerk = [
            [dt**2 / np.sqrt(20), 0.0, 0.0],
            [dt * np.sqrt(5) / 4, dt / np.sqrt(48), 0.0],
            [np.sqrt(5) / 3, 1 / np.sqrt(3), 1 / 3],
        ]
        return blocks([[root * entry for entry in row] for row in jerk], dimension, dt)


@dataclass(frozen=True)
class CoordinatedTurn(Component):
    """Turn of known `rate` in rad/s (left positive) in the x-y plane (Bar-Shalom, Li, Kirubarajan 2001, 11.7.1).

    `std` in m s^-3/2: white acceleration as in `ConstantVelocity`, here carried along the turn; a rate of 0, and
    the z axis, are constant velocity.
    """

    next_order = "another rate, or ConstantAcceleration(std)"

    std: Level
    rate: float
    noise: Any = GAUSSIAN

    def __post_init__(self):
        check_driven(self, "CoordinatedTurn:")
        if not np.isfinite(self.rate):
            raise InputError(f"CoordinatedTurn: rate is {self.rate!r}: give a finite number in rad/s")

    names = ConstantVelocity.names

    def transition(self, dt: Any, dimension: int) -> Any:
        """Transition matrices, shape (E, 2d, 2d); x + iy has velocity exp(i rate T)."""
        xp, angle = dt.__array_namespace__(), self.rate * dt
        moved = dt * xp.exp(0.5j * angle) * xp.sinc(angle / (2 * np.pi))
        return self._turned([[1.0, moved], [0.0, xp.exp(1j * angle)]], [[1.0, dt], [0.0, 1.0]], dimension, dt)

    def noise_factor(self, dt: Any, dimension: int) -> Any:
        """Noise factors for unit std, shape (E, 2d, 2d).

        Of x + iy: position variance T^3 g, covariance with the conjugate velocity T^2 c, velocity variance T, with
        g = 2 (a - sin a) / a^3 and c = (1 - cos a) / a^2 - i a g / 2 at the angle a = rate T.
        """
        xp = dt.__array_namespace__()
        angle, root = self.rate * dt, xp.sqrt(dt)
        g = _turn_variance(angle)
        c = 0.5 * xp.sinc(angle / (2 * np.pi)) ** 2 - 0.5j * angle * g
        along = c.conj() / xp.sqrt(g)
        rest = xp.sqrt(xp.maximum(1.0 - xp.abs(along) ** 2, 0.0))
        straight = ConstantVelocity(1.0).noise_factor(dt, 1)
        rows = [[straight[:, r, k] for k in range(2)] for r in range(2)]
        turned = [[dt * root * xp.sqrt(g), 0.0], [root * along, root * rest]]
        return self._turned(turned, rows, dimension, dt)

    @staticmethod
    def _turned(plane: list[list[Any]], up: list[list[Any]], dimension: int, dt: Any) -> Any:
        """Stack complex entries that act on x + iy, and real ones that act on z, into (E, 2d, 2d) matrices."""
        d = dimension
        real, turned = ([[getattr(v, part) for v in row] for row in plane] for part in ("real", "imag"))
        parts = (real, PLANE), (turned, QUARTER), (up, UP)
        return sum(blocks(rows, d, dt, axes[:d, :d]) for rows, axes in parts)


def _turn_variance(angle: Any) -> Any:
    """2 (a - sin a) / a^3, by its series where the difference would cancel."""
    xp = angle.__array_namespace__()
    small = xp.abs(angle) < 0.5
    series = sum(2 * (-1) ** k * angle ** (2 * k) / math.factorial(2 * k + 3) for k in range(6))
    a = xp.where(small, 1.0, angle)
    return xp.where(small, series, 2 * (a - xp.sin(a)) / a**3)


@dataclass(frozen=True)
class Static(Component):
    """A target that does not move: all its rows form one epoch."""

    static = True

    std: Level = 0.0

    def names(self) -> tuple[tuple[str, bool], ...]:
        """State components and whether each has one value an axis."""
        return (("position", True),)

    def transition(self, dt: Any, dimension: int) -> Any:
        """Identity, shape (E, d, d)."""
        return blocks([[1.0]], dimension, dt)

    def noise_factor(self, dt: Any, dimension: int) -> Any:
        """No noise, shape (E, d, 0)."""
        return np.zeros((len(dt), dimension, 0))


class OneComponent(Component):
    """One state component, a number unless it is `per_axis`."""

    name: str
    per_axis: bool = False

    def names(self) -> tuple[tuple[str, bool], ...]:
        """State component and whether it has one value an axis."""
        return ((self.name, self.per_axis),)

    def _each(self, entry: Any, dimension: int, dt: Any) -> Any:
        """Matrices (E, s, s) of one entry."""
        return blocks([[entry]], dimension if self.per_axis else 1, dt)


@dataclass(frozen=True)
class RandomWalk(OneComponent):
    """A scalar (or, `per_axis`, a vector) component that drifts: `std` in unit s^-1/2, `initial` = (mean, std)."""

    name: str
    unit: str
    std: Level
    initial: tuple[float, float]
    per_axis: bool = False
    noise: Any = GAUSSIAN

    def __post_init__(self):
        check_driven(self, f'RandomWalk("{self.name}"):')
        check_pair(self.initial, f'RandomWalk("{self.name}"): initial')

    def transition(self, dt: Any, dimension: int) -> Any:
        """Identity, shape (E, s, s)."""
        return self._each(1.0, dimension, dt)

    def noise_factor(self, dt: Any, dimension: int) -> Any:
        """Noise factors for unit std, shape (E, s, s)."""
        return self._each(dt.__array_namespace__().sqrt(dt), dimension, dt)

    def start(self) -> dict[str, tuple[Any, float]]:
        """Mean and standard deviation at the first epoch."""
        return {self.name: self.initial}


@dataclass(frozen=True)
class Remembered(OneComponent):
    """The remembered noise of one channel of one sensor (`noise.Memory`), a state that the rows of this sensor read.

    `level` is the label of its std.
    """

    stationary = True
    next_order = "another time of its Memory(std, time)"

    name: str
    std: Level
    time: float
    level: str

    def transition(self, dt: Any, dimension: int) -> Any:
        """The fraction that is remembered, shape (E, 1, 1)."""
        return self._each(dt.__array_namespace__().exp(-dt / self.time), dimension, dt)

    def noise_factor(self, dt: Any, dimension: int) -> Any:
        """Noise factors for unit std, shape (E, 1, 1)."""
        xp = dt.__array_namespace__()
        return self._each(xp.sqrt(-xp.expm1(-2.0 * dt / self.time)), dimension, dt)

    def start(self) -> dict[str, tuple[Any, float]]:
        """Mean and standard deviation at the first epoch, which are those of every epoch."""
        return {self.name: (0.0, guess_of(self.std))}


@dataclass(frozen=True)
class White(OneComponent):
    """A component drawn anew at every epoch (an unknown emission range, say): `mean` (one or one an axis), `std`."""

    memoryless = True
    next_order = "RandomWalk(name, unit, std, initial)"

    name: str
    unit: str
    std: Level
    mean: Any = 0.0
    per_axis: bool = False
    noise: Any = GAUSSIAN

    def __post_init__(self):
        check_driven(self, f'White("{self.name}"):', zero=False)

    def transition(self, dt: Any, dimension: int) -> Any:
        """Zero, shape (E, s, s): nothing is kept."""
        return self._each(0.0, dimension, dt)

    def noise_factor(self, dt: Any, dimension: int) -> Any:
        """Identity, shape (E, s, s)."""
        return self._each(1.0, dimension, dt)

    def means(self, time: np.ndarray, dimension: int) -> np.ndarray:
        """The one mean at every epoch, shape (E, s)."""
        return np.broadcast_to(self.mean, (len(time), dimension if self.per_axis else 1))
