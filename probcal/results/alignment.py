"""An answer laid on a truth that lives in another frame: turned, shifted and, as a similarity, made larger."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from probcal.errors import InputError
from probcal.linalg import nearest_rotation

KINDS = ("rigid", "similarity")


@dataclass(frozen=True)
class Alignment:
    """From the frame of an answer to that of a truth: scale * rotation @ place + shift.

    >>> quarter = Alignment("rigid", np.array([[0.0, -1.0], [1.0, 0.0]]), np.array([5.0, 0.0]))
    >>> quarter(np.array([1.0, 0.0])).tolist()
    [5.0, 1.0]
    """

    kind: str
    rotation: np.ndarray  # (d, d)
    shift: np.ndarray  # (d,) in m
    scale: float = 1.0

    def __call__(self, places: Any) -> np.ndarray:
        """Places (..., d) of the answer in the frame of the truth."""
        return self.scale * np.asarray(places) @ self.rotation.T + self.shift

    def back(self, places: Any) -> np.ndarray:
        """Places (..., d) of the truth in the frame of the answer."""
        return (np.asarray(places) - self.shift) @ self.rotation / self.scale


def align(places: Any, truth: Any, kind: str) -> Alignment:
    """The rotation, shift and, of a "similarity", scale that lay places (N, d) on true ones (N, d) in least squares.

    Mirror images are none of them. Raises `InputError` for another kind, and for fewer than d places that differ
    (Horn, Hilden, Negahdaripour 1988; Umeyama 1991).

    >>> found = align([[0.0, 0.0], [1.0, 0.0]], [[2.0, 2.0], [2.0, 4.0]], "similarity")
    >>> round(found.scale, 6), found([0.5, 0.0]).round(6).tolist()
    (2.0, [2.0, 3.0])
    """
    if kind not in KINDS:
        raise InputError(f'align="{kind}": give "rigid" or "similarity"')
    a, b = np.asarray(places, float), np.asarray(truth, float)
    if a.ndim != 2 or a.shape != b.shape or a.shape[1] not in (2, 3):
        raise InputError(f"align: places and truth have shape (N, 2) or (N, 3), got {a.shape} and {b.shape}")
    if len(np.unique(a, axis=0)) < a.shape[1] or not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise InputError(f"align: at least {a.shape[1]} different finite places are needed in {a.shape[1]}-D")
    from_mean, to_mean = a - a.mean(0), b - b.mean(0)
    rotation, _ = nearest_rotation(to_mean.T @ from_mean)
    scale = float(np.sum(to_mean * (from_mean @ rotation.T)) / np.sum(from_mean**2)) if kind == "similarity" else 1.0
    return Alignment(kind, rotation, b.mean(0) - scale * rotation @ a.mean(0), scale)
