"""The float64 guard of entry points, and the views that a sensor function reads."""

import functools
import linecache
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from probcal.errors import InputError, checked, nearest
from probcal.kernels import drop_if_many, keep_kernels

REMEDIES: dict[type[Exception], str] = {  # what jax raises where Python asks for the value of a traced number
    jax.errors.TracerBoolConversionError: "write jnp.where(condition, a, b) for if, and, or, min and max",
    jax.errors.NonConcreteBooleanIndexError: "write jnp.where(condition, a, b) for an index that is a condition",
    jax.errors.TracerArrayConversionError: "write jnp. for np. (import jax.numpy as jnp)",
    jax.errors.TracerIntegerConversionError: "write jnp.asarray(values)[index] for an index into a list",
    jax.errors.ConcretizationTypeError: "leave out float() and int(), and write jnp. for math.",
}
RATES = {"position": "velocity", "heading": "heading_rate", "pitch": "pitch_rate", "roll": "roll_rate"}  # of a path
LIBRARIES = ("probcal", "jax", "jaxlib", "numpy")  # packages whose lines are not the user's


def float64[**P, R](function: Callable[P, R]) -> Callable[P, R]:
    """Run a public entry point in double precision, its arguments checked, its kernels kept between
    processes."""
    run = checked(function)

    @functools.wraps(function)
    def entry(*args: P.args, **kwargs: P.kwargs) -> R:
        keep_kernels()
        try:
            with jax.enable_x64(True):
                return run(*args, **kwargs)
        except tuple(REMEDIES) as error:
            if text := untraceable(error):
                raise InputError(text) from error
            raise
        finally:
            drop_if_many()

    return entry


def untraceable(error: BaseException) -> str | None:
    """The line of a user's file that jax cannot follow, with the remedy.

    None where no such line is to blame.
    """
    remedy = next((text for kind, text in REMEDIES.items() if isinstance(error, kind)), None)
    own = [
        (frame.f_code.co_filename, line)
        for frame, line in traceback.walk_tb(error.__traceback__)
        if str(frame.f_globals.get("__name__")).partition(".")[0] not in LIBRARIES
    ]
    if remedy is None or not own:
        return None
    file, line = own[-1]
    code = linecache.getline(file, line).strip()
    return f'{Path(file).name} line {line}, "{code}", asks for a value that jax knows only when it runs; {remedy}'


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

    def __init__(self, owner: str, components: Mapping[str, Any], flow: Callable[..., Mapping[str, Any]] | None = None):
        super().__init__(owner, components)
        self._flow = flow

    def at(self, dt: Any) -> "TargetView":
        """The target `dt` seconds later, as its motion goes on without noise.

        A component that does not move by itself stays.
        """
        moved = dict(self._components)
        acceleration = moved.get("acceleration")
        if "velocity" in moved:
            moved["position"] = moved["position"] + dt * moved["velocity"]
        if acceleration is not None:
            moved["position"] = moved["position"] + 0.5 * dt**2 * acceleration
            moved["velocity"] = moved["velocity"] + dt * acceleration
        if self._flow is not None:
            moved |= self._flow(dt)
        return TargetView(self._owner, moved)


class PoseView(View):
    """One node at one instant, already corrected for its biases: position, velocity, heading and what it owns."""

    def at(self, dt: Any, **changes: Any) -> "PoseView":
        """The node `dt` seconds later along its path, with other values of some components."""
        moved = self._components | changes
        for name, rate in RATES.items():
            if rate in moved:
                moved[name] = moved[name] + dt * moved[rate]
        return PoseView(self._owner, moved)

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
