"""Distances and angles with finite gradients everywhere; angles are mathematical (0 east, counter-clockwise)."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from probcal.errors import InputError
from probcal.linalg import handedness

TURNED = 1e-3  # by how much a rotation matrix may miss being one, of numbers that were rounded


def lattice(axes: Sequence[Any]) -> np.ndarray:
    """The points (P, d) of a grid with these coordinates along each axis, the last running fastest."""
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, len(axes))


def norm(vector: Any) -> jax.Array:
    """Euclidean length of a vector (d,), in its unit; the gradient at zero is zero."""
    squared = sum(vector[i] ** 2 for i in range(len(vector)))  # XLA weaves it into what is around, a reduction not
    nothing = squared == 0
    return jnp.where(nothing, 0.0, jnp.sqrt(jnp.where(nothing, 1.0, squared)))


def bearing(line: Any) -> jax.Array:
    """Angle of a line in the x-y plane from east, counter-clockwise, in radians (thesis 2.11 by atan2)."""
    x, y = line[0], line[1]
    away = (x != 0) | (y != 0)
    return jnp.where(away, jnp.arctan2(jnp.where(away, y, 0.0), jnp.where(away, x, 1.0)), 0.0)


def elevation(line: Any) -> jax.Array:
    """Angle of a 3-D line above the x-y plane, in radians."""
    return bearing(jnp.stack([norm(line[:2]), line[2]]))


def slopes(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Derivative (T, d) of values (T, d) at times (T,) by differences; zero for a single time."""
    return np.gradient(values, time, axis=0) if len(time) > 1 else np.zeros_like(values)


def wrap(angle: Any, period: float = 2 * np.pi) -> jax.Array:
    """The angle shifted by whole periods into [-period/2, period/2]."""
    return angle - period * jnp.round(angle / period)


def attitude(rotation: Any, *, scalar_first: bool = False) -> dict[str, Any]:
    """Heading, pitch and roll in rad of rotations, by name, as `Node` and `Path` take them.

    `rotation` holds matrices (..., 3, 3), (..., 2, 2) in the plane, whose columns are the node's axes (ahead, left, up)
    in the common frame, quaternions (..., 4) in the order x, y, z, w (`scalar_first`: w, x, y, z), or a SciPy
    `Rotation`. Looking straight up or down the roll is 0. Raises `InputError` naming the first that is no rotation.

    >>> found = attitude([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # turned left by a quarter
    >>> [round(float(found[name]), 4) for name in ("heading", "pitch", "roll")]
    [1.5708, 0.0, 0.0]
    """
    given = np.asarray(rotation.as_matrix() if hasattr(rotation, "as_matrix") else rotation, float)
    if given.shape[-2:] not in ((3, 3), (2, 2)) and given.shape[-1:] == (4,):
        given = _of_quaternions(given, scalar_first)
    if given.shape[-2:] not in ((3, 3), (2, 2)):
        raise InputError(
            f"attitude: give matrices (..., 3, 3) or (..., 2, 2), or quaternions (..., 4); got {given.shape}"
        )
    flat = given.reshape(-1, *given.shape[-2:])
    whole = np.isfinite(flat).all((1, 2))
    safe = np.where(whole[:, None, None], flat, 0.0)
    square, size = safe @ safe.mT - np.eye(flat.shape[-1]), handedness(safe)
    bad = ~whole | (np.abs(square).max((1, 2), initial=0.0) > TURNED) | (size < 0)
    if bad.any():
        k = int(np.flatnonzero(bad)[0])
        raise InputError(
            f"attitude: rotation {k} is none: its columns must be unit vectors at right angles (ahead, left, up),"
            f" right-handed; its determinant is {size[k] if whole[k] else np.nan:.3g}"
        )
    heading = np.arctan2(given[..., 1, 0], given[..., 0, 0])
    if given.shape[-1] == 2:
        return {"heading": heading[()]}
    pitch = np.arcsin(np.clip(given[..., 2, 0], -1.0, 1.0))
    roll = np.arctan2(given[..., 2, 1], given[..., 2, 2])
    upright = np.hypot(given[..., 0, 0], given[..., 1, 0]) < TURNED  # there only heading and roll together are told
    heading = np.where(upright, np.arctan2(-given[..., 0, 1], given[..., 1, 1]), heading)
    return {"heading": heading[()], "pitch": pitch[()], "roll": np.where(upright, 0.0, roll)[()]}


def _of_quaternions(given: np.ndarray, scalar_first: bool) -> np.ndarray:
    """Matrices (..., 3, 3) of quaternions (..., 4) of any length but 0."""
    length = np.linalg.norm(given, axis=-1, keepdims=True)
    if not (np.isfinite(length) & (length > 0)).all():
        raise InputError("attitude: a quaternion must be finite and not 0")
    unit = np.roll(given, -1, axis=-1) if scalar_first else given
    v, w = unit[..., :3] / length, (unit[..., 3:] / length)[..., None]
    skew = np.cross(v[..., None, :], -np.eye(3))  # its columns are the products of v with the axes
    return (w**2 - np.sum(v**2, -1)[..., None, None]) * np.eye(3) + 2 * v[..., :, None] * v[..., None, :] + 2 * w * skew
