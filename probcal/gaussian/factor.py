"""Factors of large sparse matrices, and their form: the upper triangle as entries with places.

A library that factorises is a class with the members of `Library`, its factors are `Factor`s.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np

from probcal.gaussian.selected import Fronts

FULL = 16  # places of a matrix per entry up to which solves of all columns are faster
COLUMNS = 256  # solved at once
_FRONTS: list[tuple[np.ndarray, Fronts]] = []  # of the last two patterns, by their rows


class Entries(NamedTuple):
    """Places of the entries of a positive definite matrix; those of one place are added."""

    row: np.ndarray  # (entries,), at most the column
    column: np.ndarray  # (entries,)
    size: int  # n
    diagonal: np.ndarray  # (n,) one entry on each place of the diagonal
    blocks: np.ndarray = np.zeros((0, 1), int)  # (B, p) the last variables in blocks, n of none


class Factor(ABC):
    """A factorised matrix (n, n); everything is NumPy."""

    places: Entries
    values: np.ndarray  # (entries,)

    @property
    @abstractmethod
    def order(self) -> np.ndarray:
        """Place (n,) of each variable in the order of elimination."""

    @abstractmethod
    def solve(self, right: np.ndarray) -> np.ndarray:
        """The inverse times right, (n,) or (n, K)."""

    @abstractmethod
    def log_determinant(self) -> tuple[float, float]:
        """Log determinant, and its standard error, 0 where it is exact."""

    @cached_property
    def inverse(self) -> np.ndarray:
        """The inverse at the place of each entry; raises `InputError` where it is estimated."""
        row, column, size, *_ = self.places
        if FULL * len(row) < size**2:
            return self.selected()
        starts = range(0, size, COLUMNS)
        whole = np.concatenate([self.solve(np.eye(size, COLUMNS, -start)) for start in starts], 1)
        return 0.5 * (whole[row, column] + whole[column, row])

    def selected(self) -> np.ndarray:
        """The same by Takahashi's equations, of a matrix that is not full."""
        row, column, size, *_ = self.places
        fronts = next((own for known, own in _FRONTS if known is row), None)
        if fronts is None:
            at = self.order[np.stack([row, column])]
            fronts = Fronts.of(at.max(0), at.min(0), size)
            _FRONTS[:] = [(row, fronts), *_FRONTS[:1]]
        return fronts.inverse(self.values)

    def inverse_diagonal(self) -> tuple[np.ndarray, np.ndarray]:
        """Diagonal (n,) of the inverse, and its standard error (n,), 0 where it is exact."""
        diagonal = self.inverse[self.places.diagonal]
        return diagonal, np.zeros_like(diagonal)

    @abstractmethod
    def draw(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draws (count, n) around zero with this precision."""


class Library(Protocol):
    """A way to factorise.

    Raises `numpy.linalg.LinAlgError` where a matrix is not positive definite and `MemoryError`
    where its factor does not fit.
    """

    @property
    def exact(self) -> bool:
        """True where log determinants and entries of the inverse are exact."""

    def __call__(self, places: Entries, values: np.ndarray) -> Factor:
        """Factorise the matrix of entries (entries,)."""


def mirrored(places: Entries, values: np.ndarray) -> Any:
    """The whole matrix (n, n), sparse by columns."""
    from scipy.sparse import coo_matrix

    upper = coo_matrix((values, (places.row, places.column)), (places.size, places.size)).tocsc()
    own = upper.diagonal()
    whole = upper + upper.T
    whole.setdiag(own)
    return whole


def leading(places: Entries, values: np.ndarray, stop: int, first: int = 0) -> tuple[Entries, np.ndarray]:
    """The part of a matrix with the variables from `first` to `stop`, without blocks."""
    own = (places.row >= first) & (places.column < stop)
    where = np.cumsum(own) - 1
    diagonal = where[places.diagonal[first:stop]]
    return Entries(places.row[own] - first, places.column[own] - first, stop - first, diagonal), values[own]
