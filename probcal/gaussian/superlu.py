"""Factors by SuperLU of SciPy, which is always installed; exact, and slower than CHOLMOD."""

from __future__ import annotations

from collections import defaultdict
from functools import cached_property
from itertools import pairwise
from typing import Any, ClassVar

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
        self.places = places

    @cached_property
    def _pivots(self) -> np.ndarray:
        return np.asarray(self._lu.U.diagonal())

    def solve(self, right: np.ndarray) -> np.ndarray:
        """The inverse times right, (n,) or (n, K)."""
        return np.asarray(self._lu.solve(np.asarray(right)))

    def log_determinant(self) -> tuple[float, float]:
        """Log determinant, and no error."""
        return float(np.sum(np.log(self._pivots))), 0.0

    def selected(self) -> np.ndarray:
        """The inverse at the place of each entry."""
        at = self._lu.perm_c[np.stack([self.places.row, self.places.column])]
        return selected_inverse(self._lu.L.tocsc(), self._pivots, at.max(0), at.min(0))

    def draw(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draws (count, n) around zero with this precision."""
        from scipy.sparse.linalg import spsolve_triangular

        normal = rng.standard_normal((self.places.size, count)) / np.sqrt(self._pivots)[:, None]
        moved = spsolve_triangular(self._lu.L.T.tocsr(), normal, lower=False, unit_diagonal=True)
        return np.asarray(moved)[self._lu.perm_c].T


def selected_inverse(lower: Any, pivots: np.ndarray, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """The inverse of L D L' at places (row, column), L sparse by columns with a unit diagonal.

    Takahashi's equations (Erisman, Tinney 1975), from the last column on, columns with the same rows
    below at once: Z_SJ = -Z_SS L_SJ L_JJ^-1, Z_JJ = (L_JJ D L_JJ')^-1 - (L_SJ L_JJ^-1)' Z_SJ.
    """
    from scipy.linalg import solve_triangular

    groups = _groups(lower, row, column)
    ending = {parent: k for k, (*_, parent) in reversed(list(enumerate(groups)))}  # its last child
    order, found = np.argsort(column, kind="stable"), np.empty(len(row))
    ends = np.searchsorted(column, [*(own[0] for own in groups), len(pivots)], sorter=order)
    known = {-1: (np.zeros(0, int), np.zeros((0, 0)))}  # variables and inverse of groups that others need
    for k in range(len(groups) - 1, -1, -1):
        first, stop, under, parent = groups[k]
        variables, inverse = known.pop(parent) if ending[parent] == k else known[parent]
        at, width = np.searchsorted(variables, under), stop - first
        outer, index = inverse[np.ix_(at, at)], np.append(np.arange(first, stop), under)
        own, span = np.zeros((len(index), width)), slice(lower.indptr[first], lower.indptr[stop])
        columns = np.repeat(np.arange(width), np.diff(lower.indptr[first : stop + 1]))
        own[np.searchsorted(index, lower.indices[span]), columns] = lower.data[span]
        inner = solve_triangular(own[:width], np.eye(width), lower=True, unit_diagonal=True)
        down = own[width:] @ inner
        across = -outer @ down
        left = np.concatenate([(inner.T / pivots[first:stop]) @ inner - down.T @ across, across])
        mine = order[ends[k] : ends[k + 1]]
        found[mine] = left[np.searchsorted(index, row[mine]), column[mine] - first]
        if k in ending:
            known[k] = index, np.hstack([left, np.concatenate([across.T, outer])])
    return found


def _groups(lower: Any, row: np.ndarray, column: np.ndarray) -> list[tuple[int, int, np.ndarray, int]]:
    """First and last column of those with the same rows below, these rows, and the group of the first row.

    That group is -1 where there are no rows. They are those of L, of the places, which may hold a
    zero that L leaves out, and of earlier columns.
    """
    from scipy.sparse import csc_matrix

    pattern = abs(lower) + csc_matrix((np.ones(len(row)), (row, column)), lower.shape)
    below, brought = list[np.ndarray](), defaultdict[int, list[np.ndarray]](list)
    for j, own in enumerate(np.split(pattern.indices, pattern.indptr[1:-1])):
        rows = np.unique(np.concatenate([own, *brought.pop(j, [])]))
        below.append(rows[rows > j])
        for parent in below[j][:1].tolist():
            brought[parent].append(below[j])
    alike = [own[:1].tolist() == [j + 1] and len(own) == len(below[j + 1]) + 1 for j, own in enumerate(below)]
    starts = np.flatnonzero([True, *np.logical_not(alike[:-1])])
    found = [(j, k, below[k - 1]) for j, k in pairwise([*starts.tolist(), len(below)])]
    return [(*own, int(np.searchsorted(starts, own[2][:1], "right").sum()) - 1) for own in found]
