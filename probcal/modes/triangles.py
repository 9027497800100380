"""Similar triangles: the same path seen from two places, each up to scale, gives the one from the other."""

from typing import NamedTuple

import numpy as np

from probcal.errors import InputError
from probcal.linalg import nearest_rotation

FLAT = 1e-3  # spread across a path, over that along it, below which a path in space turns about itself unseen


class Similarity(NamedTuple):
    """fixed = position + scale * rotation @ moved, with the covariance (d, d) of the position.

    `determined` is False where the path is straight in space: then the turn about it is open.
    """

    position: np.ndarray
    rotation: np.ndarray
    scale: float
    spread: np.ndarray
    determined: bool


def turn_of(pairs: list[tuple[np.ndarray, np.ndarray, np.ndarray]], level: bool = False) -> tuple[np.ndarray, bool]:
    """Rotation (d, d) that turns moved paths (T, d) onto fixed ones, whatever their scales and shifts (Umeyama 1991).

    Each pair holds moved, fixed, weights (T,). `level` turns about the vertical only. Also whether it is determined: in
    space one straight path, or several parallel ones, leave the turn about themselves open.
    """
    d = pairs[0][0].shape[1]
    total = np.zeros((d, d))
    for moved, fixed, weight in pairs:
        w = weight / weight.sum()
        a, b = fixed - w @ fixed, moved - w @ moved
        size = np.sqrt((w @ (a**2).sum(1)) * (w @ (b**2).sum(1)))
        if size > 0:
            total += (a * w[:, None]).T @ b / size
    if level and d == 3:
        flat, sure = _turn(total[:2, :2])
        rotation = np.eye(3)
        rotation[:2, :2] = flat
        return rotation, sure
    return _turn(total)


def _turn(total: np.ndarray) -> tuple[np.ndarray, bool]:
    """Nearest rotation of a correlation matrix, and whether it is determined."""
    rotation, values = nearest_rotation(total)
    needed = values[len(total) - 2] if len(total) == 3 else values[0]
    return rotation, bool(needed > FLAT * max(values[0], 1e-300))


def similarity(
    moved: np.ndarray,
    fixed: np.ndarray,
    moved_spread: np.ndarray | None = None,
    fixed_spread: np.ndarray | None = None,
    *,
    level: bool = False,
    rotation: np.ndarray | None = None,
) -> Similarity:
    """Position, turn and scale that carry a path (T, d) onto another, weighted by the covariances (T, d, d) of both.

    In the plane this is fixed = s + g moved in complex numbers, g = sum w conj(dB) dA / sum w |dB|^2 (DOA paper,
    section 3: similar triangles); in space Umeyama's. A given `rotation` is kept. Weights are taken twice, the scale in
    them from the first time. Raises `InputError` where the shapes differ or there are fewer than two points.
    """
    moved, fixed = np.asarray(moved, float), np.asarray(fixed, float)
    if moved.shape != fixed.shape or moved.ndim != 2 or len(moved) < 2 or moved.shape[1] not in (2, 3):
        raise InputError(f"similarity: give two paths of one shape (T, 2 or 3), got {moved.shape} and {fixed.shape}")
    T, d = moved.shape
    C = [np.broadcast_to(np.zeros((d, d)) if s is None else s, (T, d, d)) for s in (moved_spread, fixed_spread)]
    weight, scale = np.ones(T), 1.0
    position, turn, spread, sure = np.zeros(d), np.eye(d), np.eye(d), True
    for again in range(2):
        if again:
            each = np.trace(C[1] + scale**2 * C[0], axis1=1, axis2=2)
            weight = 1.0 / np.maximum(each, 1e-9 * max(each.max(), 1e-300)) if each.max() > 0 else weight
        turn, sure = turn_of([(moved, fixed, weight)], level) if rotation is None else (rotation, True)
        w = weight / weight.sum()
        turned = moved @ turn.T
        a, b = fixed - w @ fixed, turned - w @ turned
        about = max(float(w @ (b**2).sum(1)), 1e-300)
        scale = float(w @ (a * b).sum(1)) / about
        position = w @ fixed - scale * (w @ turned)
        both = C[1] + scale**2 * turn @ C[0] @ turn.T
        lever = 1.0 - (b @ (w @ turned)) / about  # how an error at each point moves the position
        spread = np.einsum("t,tij->ij", (w * lever) ** 2, both)
    return Similarity(position, turn, scale, spread, sure)
