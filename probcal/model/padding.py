"""Room for a few more rows and epochs: kernels compiled for one recording serve others of about its length."""

from dataclasses import replace
from typing import Any

import jax
import numpy as np

from probcal.model.model import Model, Recursion
from probcal.model.rows import BY_ROW, Rows
from probcal.model.trajectories import Trajectories

PARTS = 8  # sizes are multiples of this, and of the largest power of two that is one part in so many at most


def roomy(count: int) -> int:
    """The size to which so many entries are padded.

    >>> [roomy(count) for count in (1, 20, 100, 1_000, 1_816)]
    [8, 24, 104, 1024, 1920]
    """
    step = max(PARTS, (1 << count.bit_length()) // (2 * PARTS))
    return -(-count // step) * step


def padded_index(count: int) -> np.ndarray:
    """Numbers of so many entries, the last one over again up to the size to which they are padded."""
    return np.minimum(np.arange(roomy(count)), count - 1)


def padded_model(model: Model) -> Model:
    """The model with masked rows, and behind the last epoch of a recursion some at which its target stays as it is.

    Its arrays are of NumPy. What is computed from it of the rest stays as it was.
    """

    def longer(part: Recursion) -> Recursion:
        E, n = part.drift.shape
        found = jax.tree.map(lambda leaf: np.asarray(leaf)[padded_index(E)], part)
        still = {"F": np.eye(n), "L": 0.0, "level": len(model.level_spread), "drift": 0.0, "dt": 0.0, "first": False}
        for name, value in still.items():
            getattr(found, name)[E:] = value
        for tail in found.tails:
            tail.on[E:], tail.weight[E:] = False, 1.0
        return found

    def masked(data: Rows) -> Rows:
        N = len(data.y)
        found = data._replace(**{name: np.asarray(getattr(data, name))[padded_index(N)] for name in BY_ROW})
        found.mask[N:] = 0.0
        return found

    return replace(model, recursions=tuple(map(longer, model.recursions)), rows=tuple(map(masked, model.rows)))


def longer(path: Trajectories) -> Trajectories:
    """Trajectories at the epochs of a padded model."""

    def more(states: Any, noises: Any) -> tuple[np.ndarray, np.ndarray]:
        E = len(noises)
        found = np.asarray(noises)[padded_index(E)]
        found[E:] = 0.0
        return np.asarray(states)[padded_index(E)], found

    return path.map(more)
