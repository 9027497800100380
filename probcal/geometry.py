"""Distances and angles with finite gradients everywhere; angles are mathematical (0 east, counter-clockwise)."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def norm(vector: Any) -> jax.Array:
    """Euclidean length of a vector, in its unit; the gradient at zero is zero."""
    squared = jnp.sum(vector**2)
    positive = squared > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, squared, 1.0)), 0.0)


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
