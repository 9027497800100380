"""Motions without a linear form in a model: static, equal by what they compute, with states that are pytrees.

A recursion holds the arrays of what is linear in its motion, if anything, and one `Sampled` for the rest. Rows read
`vector(x)`, what the motion shows of a state, laid out as the state of a linear motion is.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp

from probcal.errors import InputError
from probcal.fingerprint import computes
from probcal.motion import Joint, Layout, Motion
from probcal.motion.layout import check_once, layout_of
from probcal.types import untraceable


@dataclass(frozen=True, eq=False)
class SampledMotion:
    """The nonlinear motion of one recursion's targets; x is a state of the declared `motion`."""

    motion: Motion
    layout: Layout  # of `vector(x)`: what is linear, then what the others show
    levels: tuple[tuple[str, float, int], ...]  # name, value or guess, number among the unknown levels, -1 where known

    @property
    def others(self) -> tuple[Motion, ...]:
        """The motions without linear form."""
        return self.motion.split[1]

    @cached_property
    def empty(self) -> tuple[Any, ...]:
        """Shapes and types of their states."""
        return tuple(_begin(other) for other in self.others)

    @cached_property
    def fingerprint(self) -> str:
        """Digest of all that the motions compute."""
        key, dt = jax.eval_shape(lambda: jax.random.key(0)), jax.ShapeDtypeStruct((), float)
        levels = {name: dt for name, *_ in self.levels}
        parts = [repr((self.layout, self.levels, type(self.motion) is Joint, self.motion.split[0] is None))]
        for other, state in zip(self.others, self.empty, strict=True):
            parts += [computes(other.view, state), computes(other.initial, key)]
            parts.append(computes(other.sample, key, state, dt, levels))
            if has_density(other):
                parts += [computes(other.log_density, state, state, dt, levels), computes(other.log_initial, state)]
        return hashlib.sha256("".join(parts).encode()).hexdigest()

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, SampledMotion) and self.fingerprint == other.fingerprint)

    def __hash__(self) -> int:
        return hash(self.fingerprint)

    def part(self, x: Any) -> tuple[jax.Array | None, tuple[Any, ...]]:
        """The linear part of a state, or of many, and the states of the others."""
        if not isinstance(self.motion, Joint):
            return None, (x,)
        return (None, tuple(x)) if self.motion.vector is None else (x[0], tuple(x[1:]))

    def whole(self, vector: jax.Array | None, others: tuple[Any, ...]) -> Any:
        """A state of its linear part and those of the others."""
        if not isinstance(self.motion, Joint):
            return others[0]
        return others if self.motion.vector is None else (vector, *others)

    def vector(self, x: Any) -> jax.Array:
        """The vector (n,) that rows read from a state, in the order of the layout."""
        linear, others = self.part(x)
        shown = [other.view(own) for other, own in zip(self.others, others, strict=True)]
        parts = [jnp.atleast_1d(jnp.asarray(own[name], float)) for own in shown for name in sorted(own)]
        return jnp.concatenate(parts if linear is None else [linear, *parts])

    def resting(self, count: int) -> tuple[Any, ...]:
        """States of the others before any epoch, all 0, with `count` leading."""
        return jax.tree.map(lambda leaf: jnp.zeros((count, *leaf.shape), leaf.dtype), self.empty)

    def begin(self, key: jax.Array) -> tuple[Any, ...]:
        """States of the others at the first epoch of a target."""
        return self._cast([m.initial(jax.random.fold_in(key, j)) for j, m in enumerate(self.others)])

    def go(self, key: jax.Array, others: tuple[Any, ...], dt: jax.Array, levels: jax.Array) -> tuple[Any, ...]:
        """States of the others drawn `dt` seconds later, at log levels (H,)."""
        values, pairs = self._values(levels), enumerate(zip(self.others, others, strict=True))
        return self._cast([m.sample(jax.random.fold_in(key, j), own, dt, values) for j, (m, own) in pairs])

    def log_begin(self, others: tuple[Any, ...]) -> jax.Array:
        """Log density of the states of the others at the first epoch of a target."""
        return sum((m.log_initial(own) for m, own in zip(self.others, others, strict=True)), jnp.zeros(()))

    def log_go(self, before: tuple[Any, ...], after: tuple[Any, ...], dt: jax.Array, levels: jax.Array) -> jax.Array:
        """Log density of the states of the others `dt` seconds after those before."""
        values, triples = self._values(levels), zip(self.others, before, after, strict=True)
        return sum((m.log_density(old, new, dt, values) for m, old, new in triples), jnp.zeros(()))

    def _values(self, levels: jax.Array) -> dict[str, Any]:
        """Noise levels by name at log levels (H,)."""
        return {name: value if h < 0 else value * jnp.exp(levels[h]) for name, value, h in self.levels}

    def _cast(self, states: list[Any]) -> tuple[Any, ...]:
        return jax.tree.map(lambda form, leaf: jnp.asarray(leaf, form.dtype), self.empty, tuple(states))


@partial(jax.jit, static_argnums=0)
def path(sampled: SampledMotion, first: jax.Array, dt: jax.Array, key: jax.Array, levels: jax.Array) -> tuple[Any, ...]:
    """States of the others along all epochs of a recursion (E leading), drawn from the motion."""

    def one(others: tuple[Any, ...], epoch: tuple[jax.Array, ...]) -> tuple[Any, Any]:
        begins, step, seed = epoch
        drawn = jax.lax.cond(begins, lambda: sampled.begin(seed), lambda: sampled.go(seed, others, step, levels))
        return drawn, drawn

    start = jax.tree.map(lambda leaf: leaf[0], sampled.resting(1))
    return jax.lax.scan(one, start, (first, dt, jax.random.split(key, len(first))))[1]


def sampled_of(motion: Motion, dimension: int, levels: Mapping[str, int], values: Mapping[str, float]) -> SampledMotion:
    """The static form of a motion; `levels` numbers its unknown ones. Raises `InputError` where it cannot work."""
    linear, others = motion.split
    layout = list(layout_of(() if linear is None else linear.components, dimension))
    offset = layout[-1][2] if layout else 0
    stated = {name: jax.ShapeDtypeStruct((), float) for name in values}
    for other in others:
        name = type(other).__name__
        state = _begin(other)
        try:
            after = jax.eval_shape(
                lambda x, s, other=other: other.sample(jax.random.key(0), x, jnp.ones(()), s), state, stated
            )
            shown = jax.eval_shape(other.view, state)
        except Exception as error:  # whatever a user's motion raises is reported with its name
            reason = untraceable(error) or f"the motion failed on a trial call: {error}"
            raise InputError(f"motion {name}: {reason}") from error
        forms = [jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype.kind), found) for found in (state, after)]
        if forms[0] != forms[1]:
            raise InputError(
                f"motion {name}: sample returns a state of another form than initial, {forms[1]} and {forms[0]};"
                " return the same shapes and types"
            )
        for component, value in sorted(shown.items()):
            if value.shape not in ((), (dimension,)):
                raise InputError(
                    f'motion {name}: its view shows "{component}" of shape {value.shape}, the network is {dimension}-D;'
                    f" show a number or shape ({dimension},)"
                )
            width = value.shape[0] if value.shape else 1
            layout.append((component, offset, offset + width, bool(value.shape)))
            offset += width
    check_once(name for name, *_ in layout)
    return SampledMotion(motion, tuple(layout), tuple((name, values[name], levels[name]) for name in values))


def has_density(motion: Motion) -> bool:
    """True if a motion without linear form says the density of its steps and of its start."""
    return all(getattr(type(motion), name) is not getattr(Motion, name) for name in ("log_density", "log_initial"))


def check_densities(sampled: tuple[SampledMotion | None, ...]) -> None:
    """Raise `InputError` for a motion without density."""
    for form in sampled:
        for motion in () if form is None else form.others:
            if not has_density(motion):
                raise InputError(
                    f"motion {type(motion).__name__} states no density of its steps; give it both"
                    " log_density(before, state, dt, levels) and log_initial(state)"
                )


def _begin(motion: Motion) -> Any:
    """Shapes and types of a state."""
    try:
        return jax.eval_shape(lambda: motion.initial(jax.random.key(0)))
    except Exception as error:  # as above
        reason = untraceable(error) or f"initial failed on a trial call: {error}"
        raise InputError(f"motion {type(motion).__name__}: {reason}") from error
