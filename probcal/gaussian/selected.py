"""The inverse of a large sparse matrix at the places of its entries.

A multifrontal elimination and Takahashi's equations (Erisman, Tinney 1975), columns with the same
rows below at once.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from ctypes import CDLL
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

LOOSE = 0.2  # share of zeros up to which groups join: 2,500 radars take as long from 0.1 to 0.35


class _Group(NamedTuple):
    """Columns that are eliminated at once."""

    width: int  # number of the columns
    size: int  # of the columns and the rows below them
    parent: int  # group of the first row below, -1 where there is none
    at: np.ndarray  # of each row below: its place among the variables of the parent
    entries: slice  # of the matrix, in the order of `Fronts.order`


@dataclass(frozen=True)
class Fronts:
    """The groups of columns of a pattern under an order of elimination."""

    groups: list[_Group]
    order: np.ndarray  # (entries,) by group
    local: np.ndarray  # (entries,) place in the matrix of their group, in this order

    @classmethod
    def of(cls, row: np.ndarray, column: np.ndarray, size: int) -> Fronts:
        """The groups of entries (entries,) of a lower triangle, row at least column."""
        below, spans = _joined(_below(row, column, size))
        starts = np.array([first for first, _ in spans])
        order = np.argsort(column, kind="stable")
        ends = np.searchsorted(column, [*starts, size], sorter=order)
        found, local = list[_Group](), np.empty(len(row), int)
        for k, (first, stop) in enumerate(spans):
            mine, index = order[ends[k] : ends[k + 1]], np.append(np.arange(first, stop), below[k])
            local[ends[k] : ends[k + 1]] = np.searchsorted(index, row[mine]) * len(index) + column[mine] - first
            parent, at = -1, below[k]
            if len(at):
                parent = int(np.searchsorted(starts, at[0], "right")) - 1
                first_above, stop_above = spans[parent]
                own = at - first_above
                far = at >= stop_above
                own[far] = np.searchsorted(below[parent], at[far]) + stop_above - first_above
                at = own
            found.append(_Group(stop - first, len(index), parent, at, slice(ends[k], ends[k + 1])))
        return cls(found, order, local)

    def inverse(self, values: np.ndarray) -> np.ndarray:
        """The inverse at the places of the entries of values (entries,).

        With F of a front, J its columns, S the rows below and D = F_SJ F_JJ^-1: Z_SJ = -Z_SS D,
        Z_JJ = F_JJ^-1 - D' Z_SJ; what J leaves to its parent is F_SS - D F_SJ'. Raises
        `numpy.linalg.LinAlgError` where the matrix is not positive definite.
        """
        with _one_thread():
            return self._inverse(values)

    def _inverse(self, values: np.ndarray) -> np.ndarray:
        values, waiting = values[self.order], dict[int, np.ndarray]()
        kept = list[tuple[np.ndarray, np.ndarray]]()
        for k, (width, size, parent, at, entries) in enumerate(self.groups):
            front = waiting.pop(k, None)
            front = np.zeros((size, size)) if front is None else front
            np.add.at(front.reshape(-1), self.local[entries], values[entries])
            root = np.linalg.inv(np.linalg.cholesky(front[:width, :width]))
            inner, across = root.T @ root, front[width:, :width]
            down = across @ inner
            kept.append((inner, down))
            if parent >= 0:
                if parent not in waiting:
                    waiting[parent] = np.zeros((self.groups[parent].size,) * 2)
                waiting[parent][at[:, None], at] += front[width:, width:] - down @ across.T
        found = np.empty(len(values))
        children = np.bincount([own.parent + 1 for own in self.groups])
        for k in range(len(self.groups) - 1, -1, -1):
            width, size, parent, at, entries = self.groups[k]
            (inner, down), whole = kept.pop(), np.empty((size, size))
            if parent >= 0:
                whole[width:, width:] = waiting[parent][at[:, None], at]
                children[parent + 1] -= 1
                if not children[parent + 1]:
                    del waiting[parent]
            across = whole[width:, :width] = -whole[width:, width:] @ down
            whole[:width, width:], whole[:width, :width] = across.T, inner - down.T @ across
            found[self.order[entries]] = whole.reshape(-1)[self.local[entries]]
            if k + 1 < len(children) and children[k + 1]:
                waiting[k] = whole
        return found


def _below(row: np.ndarray, column: np.ndarray, size: int) -> list[np.ndarray]:
    """Rows below the diagonal that each column of the factor has, ascending."""
    order = np.lexsort((row, column))
    row, column = row[order], column[order]
    new = np.append(True, (np.diff(column) != 0) | (np.diff(row) != 0)) & (row > column)
    own = np.split(row[new], np.searchsorted(column[new], np.arange(1, size)))
    brought = defaultdict[int, list[np.ndarray]](list)
    for j in range(size):
        if rows := brought.pop(j, []):
            own[j] = np.unique(np.concatenate([own[j], *(other[1:] for other in rows)]))
        if len(own[j]):
            brought[int(own[j][0])].append(own[j])
    return own


def _joined(below: list[np.ndarray]) -> tuple[list[np.ndarray], list[tuple[int, int]]]:
    """Rows below each group of columns, and its first column and the one after its last.

    Neighbours join where the one follows from the other, or where few zeros are worked on for it.
    """
    rows, spans, zeros = list[np.ndarray](), list[tuple[int, int]](), list[float]()
    for j, own in enumerate(below):
        first, lost = j, 0.0
        while spans and len(rows[-1]) and rows[-1][0] < j + 1:
            before, width = spans[-1][0], j + 1 - spans[-1][0]
            stop = spans[-1][1]
            more = zeros[-1] + lost + (stop - before) * (len(own) + j + 1 - stop - len(rows[-1]))
            if more > LOOSE * width * (0.5 * width + len(own)):
                break
            first, lost = before, more
            for parts in (rows, spans, zeros):
                parts.pop()
        rows.append(own)
        spans.append((first, j + 1))
        zeros.append(lost)
    return rows, spans


@contextmanager
def _one_thread() -> Iterator[None]:
    """NumPy's OpenBLAS on one thread: most fronts are so small that several wait for each other."""
    library = CDLL(np.linalg._umath_linalg.__file__)
    known = hasattr(library, "scipy_openblas_set_num_threads64_")  # of NumPy's own wheels
    before = library.scipy_openblas_get_num_threads64_() if known else 1
    if before > 1:
        library.scipy_openblas_set_num_threads64_(1)
    try:
        yield
    finally:
        if before > 1:
            library.scipy_openblas_set_num_threads64_(before)
