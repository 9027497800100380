"""Errors, the float64 entry-point guard, and the views that a sensor function reads."""

import functools
from collections.abc import Callable, Iterable, Mapping
from difflib import get_close_matches
from typing import Any

import jax
import jax.numpy as jnp

AXES = ("x", "y", "z")


class InputError(ValueError):
    """A declaration, table or argument that cannot be used; the text, one line, says what to do about it."""

    def __init__(self, text: object):
        super().__init__(one_line(text))


class FitError(RuntimeError):
    """A fit that left nothing to report: the text says why and what to do."""


def float64[**P, R](function: Callable[P, R]) -> Callable[P, R]:
    """Run a public entry point in double precision without touching the global configuration of jax."""

    @functools.wraps(function)
    def entry(*args: P.args, **kwargs: P.kwargs) -> R:
        with jax.enable_x64(True):
            return function(*args, **kwargs)

    return entry


def nearest(name: str, known: Iterable[str]) -> str:
    """Return `; did you mean "..."?` for the nearest known name, or the list of what is known."""
    names = [str(item) for item in known]
    close = get_close_matches(str(name), names, n=1)
    if close:
        return f'; did you mean "{close[0]}"?'
    shown = ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")
    return f"; known: {shown}" if names else ""


def one_line(text: object, width: int = 800) -> str:
    """Text on one line that can be printed, its middle cut out where it is longer than `width`."""
    line = " ".join(str(text).split())
    if len(line) > width:
        line = f"{line[: width // 2]} ... {line[-width // 2 :]}"
    return "".join(character if character.isprintable() else "\N{REPLACEMENT CHARACTER}" for character in line)


class View:
    """Named components, read as attributes by a sensor function (`target.position`, `pose.heading`)."""

    def __init__(self, owner: str, components: Mapping[str, Any]):
        self._owner = owner
        self._components = dict(components)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        try:
            return self._components[name]
        except KeyError:
            raise InputError(f'{self._owner} has no component "{name}"{nearest(name, self._components)}') from None


class TargetView(View):
    """One target at one instant: its state components by name, in metres, seconds and radians."""

    def at(self, dt: Any) -> "TargetView":
        """Extrapolate by `dt` seconds along velocity and acceleration; other components stay."""
        moved = dict(self._components)
        acceleration = moved.get("acceleration")
        if "velocity" in moved:
            moved["position"] = moved["position"] + dt * moved["velocity"]
        if acceleration is not None:
            moved["position"] = moved["position"] + 0.5 * dt**2 * acceleration
            moved["velocity"] = moved["velocity"] + dt * acceleration
        return TargetView(self._owner, moved)


class PoseView(View):
    """One node at one instant, already corrected for its biases: position, velocity, heading and what it owns."""

    def local(self, point: Any) -> jax.Array:
        """A point of the common frame in the node's own axes (x ahead, y left, z up), from the node."""
        return self.turn(point - self.position)

    def turn(self, vector: Any) -> jax.Array:
        """Turn a vector from the common frame into the node's own axes.

        Rotation is heading about z, then pitch (nose up), then roll (left side up), all in radians; in 2-D heading
        alone.
        """
        c, s = jnp.cos(self.heading), jnp.sin(self.heading)
        ahead = c * vector[0] + s * vector[1]
        left = -s * vector[0] + c * vector[1]
        if vector.shape[0] == 2:
            return jnp.stack([ahead, left])
        cp, sp = jnp.cos(self.pitch), jnp.sin(self.pitch)
        cr, sr = jnp.cos(self.roll), jnp.sin(self.roll)
        forward = cp * ahead + sp * vector[2]
        above = -sp * ahead + cp * vector[2]
        return jnp.stack([forward, cr * left + sr * above, -sr * left + cr * above])
