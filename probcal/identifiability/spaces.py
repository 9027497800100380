"""Subspaces of the biases: orthonormal bases, what lies inside one sensor, vectors that a reader takes in."""

from collections.abc import Iterator

import numpy as np

from probcal.linalg import marginalise, singular, solve_square

RIDGE = 1e-2  # keeps the completion of a pattern from running along other weak directions


def orthonormal(space: np.ndarray, least: float) -> np.ndarray:
    """Orthonormal basis of the columns (F, k), without directions of singular value at most `least`."""
    if not space.shape[1]:
        return space
    left, sizes, _ = singular(space)
    return left[:, sizes > least]


def inside(space: np.ndarray, own: np.ndarray, most: float) -> np.ndarray:
    """The directions of an orthonormal space (F, k) of which at most `most` lies outside the entries `own` (F,)."""
    _, sizes, rows = singular(space[~own], whole=True)
    sizes = np.concatenate([sizes, np.zeros(len(rows) - len(sizes))])
    return space @ rows[sizes < most].T


def readable(space: np.ndarray) -> Iterator[np.ndarray]:
    """Unit vectors that span a space (F, k), each with a bias of its own that the others leave alone."""
    if not space.shape[1]:
        return
    from scipy import linalg as dense  # here, that a fit without weak directions does not load it

    pivots = dense.qr(space.T, mode="r", pivoting=True)[1][: space.shape[1]]
    for vector in solve_square(space[pivots].T, space.T):
        yield vector / np.linalg.norm(vector)


def complete(information: np.ndarray, pattern: np.ndarray) -> np.ndarray:
    """Unit vector that holds a pattern and lets the other biases move so as to hide it from the data."""
    own = pattern != 0
    unit = pattern / np.linalg.norm(pattern)
    unit[~own] = -marginalise(information, own, RIDGE)[1] @ unit[own]
    return unit / np.linalg.norm(unit)
