"""Factors by SuperLU of SciPy, which is always installed; exact, and slower than CHOLMOD."""

from __future__ import annotations

from functools import cached_property
from typing import ClassVar

import numpy as np

from probcal.gaussian.factor import Entries, Factor, mirrored


class SuperLU(Factor):
    """SuperLU without pivoting: L D L' of the matrix with its variables in another order."""

    exact: ClassVar[bool] = True

    def __init__(self, places: Entries, values: np.ndarray):
        from scipy.sparse.linalg import splu

        options = {"SymmetricMode": True, "Equil": False}
        whole = mirrored(places, values)
        try:
            self._lu = splu(whole, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
        except RuntimeError as error:  # exactly singular
            raise np.linalg.LinAlgError(f"not positive definite: {error}") from None
        if not (self._pivots > 0).all() or not np.array_equal(self._lu.perm_r, self._lu.perm_c):
            raise np.linalg.LinAlgError("not positive definite")
        self.places, self.values = places, values

    @cached_property
    def _pivots(self) -> np.ndarray:
        return np.asarray(self._lu.U.diagonal())

    def solve(self, right: np.ndarray) -> np.ndarray:
        """The inverse times right, (n,) or (n, K)."""
        return np.asarray(self._lu.solve(np.asarray(right)))

    def log_determinant(self) -> tuple[float, float]:
        """Log determinant, and no error."""
        return float(np.sum(np.log(self._pivots))), 0.0

    @property
    def order(self) -> np.ndarray:
        """Place (n,) of each variable in the order of elimination."""
        return np.asarray(self._lu.perm_c)

    def draw(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draws (count, n) around zero with this precision."""
        from scipy.sparse.linalg import spsolve_triangular

        normal = rng.standard_normal((self.places.size, count)) / np.sqrt(self._pivots)[:, None]
        moved = spsolve_triangular(self._lu.L.T.tocsr(), normal, lower=False, unit_diagonal=True)
        return np.asarray(moved)[self._lu.perm_c].T
