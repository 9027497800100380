"""The protocol `Motion` of all motions, and the `Component` that linear ones compose with `+`.

To add a linear motion, write a frozen dataclass that inherits `Component`. To add another, whose state may be any
pytree (a road: edge, arc length, speed), write one that inherits `Motion`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

from probcal import linalg
from probcal.errors import InputError
from probcal.motion.layout import Layout, Start, check_once, labels_of, layout_of, pieces, stacked
from probcal.noise import Level, Normal, guess_of

NO_START: Start = MappingProxyType({})
GAUSSIAN = Normal()


class Linear(NamedTuple):
    """The linear form of a motion over E time steps: x' = F x + L (levels * u), u ~ N(0, I)."""

    F: jax.Array  # (E, n, n)
    L: jax.Array  # (E, n, m) for unit levels; m < n where the noise does not reach every direction
    levels: tuple[str, ...]  # (m,) which level multiplies a column of L


class Motion(ABC):
    """The motion of one target: the functions that filters call. `a + b` puts two side by side.

    The state is a pytree of arrays with the same shapes at all times. `dt` is () in s, and `levels` maps each name in
    `self.levels` to its value. `linear`, `log_density` and `log_initial` are capabilities: Gaussian methods ask for
    the first, smoothing by particles for the others; a motion without one raises `InputError`.
    """

    @property
    def levels(self) -> Mapping[str, Level]:
        """Noise levels by name, numbers or `Unknown`; none unless a motion declares them."""
        return {}

    @property
    def split(self) -> tuple[LinearMotion | None, tuple[Motion, ...]]:
        """The part with a linear form, where there is one, and the motions without."""
        return None, (self,)

    @abstractmethod
    def view(self, state: Any) -> Mapping[str, Any]:
        """The components that sensors may read: vectors (d,), `position` among them, and numbers ()."""

    @abstractmethod
    def initial(self, key: jax.Array) -> Any:
        """State drawn at the first epoch of a target."""

    @abstractmethod
    def sample(self, key: jax.Array, state: Any, dt: Any, levels: Mapping[str, Any]) -> Any:
        """State drawn `dt` seconds after a state."""

    def log_density(self, before: Any, state: Any, dt: Any, levels: Mapping[str, Any]) -> jax.Array:
        """Log density () of a state `dt` seconds after another."""
        raise InputError(f"{_name(self)} does not say its density; write its log_density(before, state, dt, levels)")

    def log_initial(self, state: Any) -> jax.Array:
        """Log density () of a state at the first epoch of a target."""
        raise InputError(f"{_name(self)} does not say the density of its start; write its log_initial(state)")

    def linear(self, dt: Any, dimension: int) -> Linear:
        """Transition and noise factor over each of dt (E,) seconds."""
        raise InputError(f"{_name(self)} has no linear form; one that has is composed of motion.Component")

    def within(self, longest: float) -> Motion:
        """The motion with what it precomputes for steps of up to `longest` s; a problem asks once."""
        return self

    def loose(self) -> tuple[Any, Start] | None:
        """A motion with a linear form that holds this one loosely, and its start: from it a search begins.

        None where none is known.
        """
        return None

    def __add__(self, other: Any) -> Motion:
        return _joined(self, as_motion(other))

    def __radd__(self, other: Any) -> Motion:
        return _joined(as_motion(other), self)


class Component(ABC):
    """Part of a target's state that evolves linearly on its own; `a + b` stacks two into one `LinearMotion`.

    `dt` has shape (E,) and is a NumPy or a jax array: `dt.__array_namespace__()` are the functions for it. s is the
    size of the part in `dimension` axes. `std`, the level of its noise, multiplies the noise factor. `noise` is the
    family of the noise of each epoch: Gaussian, or a scale mixture such as `StudentT(4)` for what goes straight most of
    the time and turns now and then; the axes share its precision, so that it turns with the world.
    """

    std: Level
    noise: Any = GAUSSIAN
    memoryless: ClassVar[bool] = False  # drawn anew at every epoch around `means`; the others start from `start()`
    timed: ClassVar[bool] = False  # whether the means are those of a time, known at the rows of a table only
    stationary: ClassVar[bool] = False  # the start is as wide as every other epoch, whatever the level
    static: ClassVar[bool] = False  # whether it never moves, so that all rows of a target form one epoch
    # declared where its noise has a memory
    next_order: ClassVar[str] = "a component of your own with one state more"

    @abstractmethod
    def names(self) -> tuple[tuple[str, bool], ...]:
        """State components and whether each has one value an axis."""

    @abstractmethod
    def transition(self, dt: Any, dimension: int) -> Any:
        """Transition matrices, shape (E, s, s)."""

    @abstractmethod
    def noise_factor(self, dt: Any, dimension: int) -> Any:
        """Noise factors for unit std, shape (E, s, m) with m <= s."""

    @property
    def driven(self) -> str:
        """State component that the noise drives: the last one."""
        return self.names()[-1][0]

    def means(self, time: np.ndarray, dimension: int) -> np.ndarray:
        """Known part of the state at times (T,), shape (T, s): zero for what has a memory."""
        return np.zeros((len(time), layout_of([self], dimension)[-1][2]))

    def start(self) -> dict[str, tuple[Any, float]]:
        """Mean and standard deviation at the first epoch by name; what is left out a `Target` states.

        Position, velocity and acceleration start wide where nobody states them.
        """
        return {}

    def __add__(self, other: Any) -> Motion:
        return as_motion(self) + other

    def __radd__(self, other: Any) -> Motion:
        return as_motion(other) + self


@dataclass(frozen=True)
class LinearMotion(Motion):
    """Components stacked into one state vector (n,), in order."""

    components: tuple[Any, ...]

    def __post_init__(self):
        check_once(name for component in self.components for name, _ in component.names())

    @property
    def split(self) -> tuple[LinearMotion | None, tuple[Motion, ...]]:
        """Itself, and nothing else."""
        return self, ()

    @property
    def levels(self) -> dict[str, Level]:
        """Noise level of each component, by what its noise drives (`velocity_std`)."""
        return {level_name(component): component.std for component in self.components}

    def layout(self, dimension: int) -> Layout:
        """State components as (name, start, stop, per axis)."""
        return layout_of(self.components, dimension)

    def size(self, dimension: int) -> int:
        """Length of the state vector."""
        return sum(stop - start for _, start, stop, _ in self.layout(dimension))

    def labels(self, dimension: int) -> tuple[str, ...]:
        """Entries of the state by scalar name (`position_x`, `velocity_y`, `power`)."""
        return labels_of(self.layout(dimension), dimension)

    def view(self, state: Any) -> dict[str, Any]:
        """Components of a state (n,) by name."""
        return pieces(self.layout(self._dimension(state)), state)

    def initial(self, key: jax.Array, dimension: int = 2, start: Start = NO_START) -> jax.Array:
        """State (n,) drawn from the start that the components or `start` state; a problem has wide defaults.

        Raises `InputError` for a component without start, and where the motion is known at some times only.
        """
        mean, root = self._start(dimension, start)
        return mean + root @ jax.random.normal(key, root.shape[1:])

    def sample(self, key: jax.Array, state: Any, dt: Any, levels: Mapping[str, Any]) -> jax.Array:
        """State (n,) drawn after `dt` seconds; a level that is not given has its declared value."""
        mean, root = self._step(state, dt, levels)
        own, drawn = jax.random.split(key)
        noise = jax.random.normal(own, root.shape[1:])
        for k, (family, start, stop) in enumerate(self.mixed(self._dimension(state))):
            precision = family.mixing_draw(jax.random.fold_in(drawn, k), ())
            noise = noise.at[start:stop].divide(jnp.sqrt(precision))
        return mean + root @ noise

    def log_density(self, before: Any, state: Any, dt: Any, levels: Mapping[str, Any]) -> jax.Array:
        """Log density () of a state (n,); raises `InputError` where the noise leaves out a direction."""
        step = self.linear(np.ones(1), self._dimension(state)).L[0]
        _check_density(step, any(guess_of(component.std) == 0 for component in self.components))
        mean, root = self._step(before, dt, levels)
        density = linalg.log_normal(state - mean, root)
        mixed = self.mixed(self._dimension(state))
        noise = linalg.shortest_drive(state - mean, root) if mixed else state
        for family, start, stop in mixed:
            density = density + family.mixing_density(jnp.sum(noise[start:stop] ** 2), stop - start)
        return density

    def log_initial(self, state: Any, start: Start = NO_START) -> jax.Array:
        """Log density () of a state (n,) at the start."""
        mean, root = self._start(self._dimension(state), start)
        _check_density(root, False)
        return linalg.log_normal(state - mean, root)

    def linear(self, dt: Any, dimension: int) -> Linear:
        """Transition and noise factor of the stacked state, shapes (E, n, n) and (E, n, m)."""
        F = [component.transition(dt, dimension) for component in self.components]
        L = [component.noise_factor(dt, dimension) for component in self.components]
        names = [level_name(c) for c, own in zip(self.components, L, strict=True) for _ in range(own.shape[2])]
        return Linear(_diagonal(F), _diagonal(L), tuple(names))

    def mixed(self, dimension: int) -> list[tuple[Any, int, int]]:
        """Families that are not Gaussian, and the first and last (excluded) column of the noise factor they drive."""
        found, column = [], 0
        for component in self.components:
            width = component.noise_factor(np.ones(1), dimension).shape[2]
            if not isinstance(getattr(component, "noise", GAUSSIAN), Normal):
                found.append((component.noise, column, column + width))
            column += width
        return found

    @property
    def static(self) -> bool:
        """True if nothing ever moves, so that all rows of a target form one epoch."""
        return all(getattr(component, "static", False) for component in self.components)

    def _dimension(self, state: Any) -> int:
        """Number of axes of a state vector (n,)."""
        own = [per_axis for component in self.components for _, per_axis in component.names()]
        return (len(state) - own.count(False)) // max(own.count(True), 1)

    def _step(self, state: Any, dt: Any, levels: Mapping[str, Any]) -> tuple[jax.Array, jax.Array]:
        """Mean (n,) and root of the covariance (n, m) after `dt` seconds."""
        dimension = self._dimension(state)
        form = self.linear(jnp.atleast_1d(jnp.asarray(dt, float)), dimension)
        stated = {name: guess_of(level) for name, level in self.levels.items()} | dict(levels)
        std = jnp.stack([jnp.asarray(stated[name], float) for name in form.levels] or [jnp.zeros(())])
        root = form.L[0] * std[None, : len(form.levels)]
        return form.F[0] @ state + self._means(dimension), root

    def _means(self, dimension: int) -> jax.Array:
        """Known part of the state (n,)."""
        for component in self.components:
            if getattr(component, "timed", False):
                raise InputError(
                    f"{_name(component)} is known at the times of a table only; draw from problem.model instead"
                )
        return jnp.concatenate([jnp.asarray(c.means(np.zeros(1), dimension)[0]) for c in self.components])

    def _start(self, dimension: int, start: Start) -> tuple[jax.Array, jax.Array]:
        """Mean (n,) at the start and the root of its covariance (n, m)."""
        means, roots = self._means(dimension), []
        ends = np.cumsum([layout_of([c], dimension)[-1][2] for c in self.components]).tolist()
        for component, stop in zip(self.components, ends, strict=True):
            if component.memoryless:
                roots.append(guess_of(component.std) * component.noise_factor(np.ones(1), dimension))
                continue
            given = {**component.start(), **start}
            for name, _ in component.names():
                if name not in given:
                    raise InputError(
                        f'the motion states no start of "{name}"; give it, as in start={{"{name}": (mean, std)}}'
                    )
            mean, std = stacked(component, given, dimension)
            means = means.at[stop - len(mean) : stop].set(mean)
            roots.append(np.diag(std)[None])
        return means, _diagonal(roots)[0]


@dataclass(frozen=True)
class Joint(Motion):
    """Motions side by side, at least one of them without linear form; the state is a tuple, one of each.

    What is linear is one vector (n,) in front, where there is any.
    """

    vector: LinearMotion | None
    others: tuple[Motion, ...]

    def __post_init__(self):
        check_once((name for part in self.motions for name in part.levels), "level")

    @property
    def motions(self) -> tuple[Motion, ...]:
        """The motions in the order of the state."""
        return self.others if self.vector is None else (self.vector, *self.others)

    @property
    def split(self) -> tuple[LinearMotion | None, tuple[Motion, ...]]:
        """The part with a linear form, where there is one, and the motions without."""
        return self.vector, self.others

    @property
    def levels(self) -> dict[str, Level]:
        """Noise levels of all parts."""
        return {name: level for part in self.motions for name, level in part.levels.items()}

    def loose(self) -> tuple[Any, Start] | None:
        """The loose motions of all parts, side by side."""
        found = [part.loose() for part in self.others]
        known = [pair for pair in found if pair is not None]
        if len(known) < len(found):
            return None
        motions = [as_motion(motion) for motion, _ in known]
        start = {name: pair for _, own in known for name, pair in own.items()}
        return _joined(*([] if self.vector is None else [self.vector]), *motions), start

    def within(self, longest: float) -> Motion:
        """The motion with what its parts precompute for steps of up to `longest` s."""
        return replace(self, others=tuple(part.within(longest) for part in self.others))

    def view(self, state: Any) -> dict[str, Any]:
        """Components of all parts by name."""
        found = [part.view(own) for part, own in zip(self.motions, state, strict=True)]
        check_once(name for own in found for name in own)
        return {name: value for own in found for name, value in own.items()}

    def initial(self, key: jax.Array, dimension: int = 2, start: Start = NO_START) -> tuple[Any, ...]:
        """State of each part; `dimension` and `start` are those of the linear one."""
        first, *keys = jax.random.split(key, 1 + len(self.others))
        drawn = tuple(part.initial(own) for part, own in zip(self.others, keys, strict=True))
        return drawn if self.vector is None else (self.vector.initial(first, dimension, start), *drawn)

    def sample(self, key: jax.Array, state: Any, dt: Any, levels: Mapping[str, Any]) -> tuple[Any, ...]:
        """State of each part after `dt` seconds."""
        keys = jax.random.split(key, len(self.motions))
        return tuple(part.sample(k, own, dt, levels) for part, k, own in zip(self.motions, keys, state, strict=True))

    def log_density(self, before: Any, state: Any, dt: Any, levels: Mapping[str, Any]) -> jax.Array:
        """Sum of the log densities of the parts."""
        triples = zip(self.motions, before, state, strict=True)
        return sum((part.log_density(old, new, dt, levels) for part, old, new in triples), jnp.zeros(()))

    def log_initial(self, state: Any, start: Start = NO_START) -> jax.Array:
        """Sum of the log densities of the parts at their start."""
        total, rest = jnp.zeros(()), state
        if self.vector is not None:
            total, rest = self.vector.log_initial(state[0], start), state[1:]
        return sum((part.log_initial(own) for part, own in zip(self.others, rest, strict=True)), total)


def as_motion(value: Any) -> Motion:
    """Accept a bare component where a motion is meant."""
    if isinstance(value, Motion):
        return value
    for member in ("names", "transition", "noise_factor", "start"):
        if not hasattr(value, member) or isinstance(value, type):
            raise InputError(f"{value!r} is not a motion; give ConstantVelocity(std), Static(), or a sum of components")
    return LinearMotion((value,))


def _joined(*motions: Motion) -> Motion:
    """Motions side by side: all that is linear in one vector, the others as they are."""
    linear = [part for part, _ in (motion.split for motion in motions) if part is not None]
    others = tuple(other for motion in motions for other in motion.split[1])
    vector = LinearMotion(tuple(c for part in linear for c in part.components)) if linear else None
    if not others:
        return cast(LinearMotion, vector)
    return Joint(vector, others) if vector is not None or len(others) > 1 else others[0]


def level_name(component: Any) -> str:
    """The name of the noise level of a component."""
    return component.level if getattr(component, "stationary", False) else f"{component.driven}_std"


def level_label(component: Any) -> str:
    """Label of the noise level of a component in a problem."""
    own = level_name(component)
    return own if getattr(component, "stationary", False) else f"motion.{own}"


def _check_density(root: Any, still: bool) -> None:
    """Raise `InputError` where noise of a root (n, m) leaves out a direction, or a level is zero."""
    if still or root.shape[1] < root.shape[0]:
        raise InputError(
            "a density needs noise in every component of the state; take a motion of full rank, as"
            " ConstantVelocity(std) without singular=True"
        )


def _diagonal(blocks: list[Any]) -> Any:
    """Matrices (E, r, c) along the diagonal of one."""
    wide, before, found = sum(b.shape[2] for b in blocks), 0, []
    for block in blocks:
        xp = block.__array_namespace__()
        found.append(xp.pad(block, ((0, 0), (0, 0), (before, wide - before - block.shape[2]))))
        before += block.shape[2]
    return jnp.concatenate(found, 1) if any(isinstance(b, jax.Array) for b in found) else np.concatenate(found, 1)


def _name(value: Any) -> str:
    return type(value).__name__
