"""Factors of large sparse matrices: by CHOLMOD through sparsax where it is installed, else by SciPy's SuperLU.

Both take the upper triangle of a symmetric positive definite matrix as entries with places, those of one place added.
Another library is another class with the members of `Factor`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property
from importlib.util import find_spec
from threading import Lock, get_ident
from typing import Any, ClassVar, NamedTuple, Protocol
from weakref import WeakSet

import jax
import jax.numpy as jnp
import numpy as np

FULL, COLUMNS = 16, 256  # an entry of so many places of the matrix makes it full; columns solved at once
NO_ROOM = ("bad_alloc", "status -2", "status -3", "RESOURCE_EXHAUSTED")  # of XLA and of CHOLMOD
BESIDE = 8  # factors of each thread that are kept, where several threads have one
PROBES, BLOCK = 512, 64  # draws of a diagonal that is estimated, and of them at once


class Entries(NamedTuple):
    """Where the entries of a matrix stand."""

    row: np.ndarray  # (entries,), at most the column
    column: np.ndarray  # (entries,)
    size: int  # n
    diagonal: np.ndarray  # (n,) one entry on each place of the diagonal


class Factor(Protocol):
    """A factorised matrix (n, n); everything is NumPy."""

    def solve(self, right: np.ndarray) -> np.ndarray:
        """The inverse times right, (n,) or (n, K)."""

    def log_determinant(self) -> tuple[float, float]:
        """Log determinant, and its standard error, 0 where it is exact."""

    def inverse_diagonal(self) -> tuple[np.ndarray, np.ndarray]:
        """Diagonal (n,) of the inverse, and the standard error (n,) of each entry, 0 where it is exact."""

    def inverse_entries(self) -> np.ndarray:
        """The inverse at the place of each entry; raises `RuntimeError` where the library has no selected inverse."""

    def draw(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draws (count, n) around zero with this precision."""


def factorise(places: Entries, values: np.ndarray) -> Factor:
    """Factorise a matrix.

    Raises `numpy.linalg.LinAlgError` where it is not positive definite and `MemoryError` where there is no room.
    """
    return Cholmod(places, values) if exact() else SuperLU(places, values)


def exact() -> bool:
    """Whether entries of the inverse are exact: with sparsax, an extra for Linux and Windows."""
    return find_spec("sparsax") is not None


class _DroppedError(Exception):
    """The library has dropped a factor."""


class Cholmod:
    """CHOLMOD by sparsax, whose analysis of a pattern is kept between factors; on the CPU.

    The library keeps the factors that were made last: one, since that may be gigabytes, and some more where several
    threads have one. What it dropped is made again.
    """

    _live: ClassVar[WeakSet[Cholmod]] = WeakSet()
    _counting: ClassVar[Lock] = Lock()

    def __init__(self, places: Entries, values: np.ndarray):
        import sparsax  # an extra

        self._library, self._places, self._thread = sparsax, places, get_ident()
        with _calling():
            self._entries = tuple(jnp.asarray(part) for part in (places.row, places.column, values))
        with self._counting:
            self._live.add(self)
        self._make()

    def _make(self) -> None:
        with self._counting:
            threads = len({own._thread for own in self._live})
        with _calling():
            self._library.set_num_cache_size(1)
            self._library.set_token_cache_size(1 if threads == 1 else BESIDE * threads)
            self._token = jax.block_until_ready(self._library.factor(*self._entries, self._places.size))

    def _asked(self, ask: Callable[[Any], Any]) -> Any:
        """What the factor says; it is made again where other threads made it go."""
        while True:
            try:
                with _calling():
                    return ask(self._token)
            except _DroppedError:
                self._make()

    def _apply(self, right: np.ndarray, *modes: Any) -> np.ndarray:
        def ask(token: Any) -> np.ndarray:
            found = jnp.asarray(right)
            for mode in modes:
                found = self._library.solve_factor(token, found, mode)
            return np.asarray(found)

        return np.asarray(self._asked(ask))

    def solve(self, right: np.ndarray) -> np.ndarray:
        """The inverse times right, (n,) or (n, K)."""
        return self._apply(right, self._library.MODE_A)

    def log_determinant(self) -> tuple[float, float]:
        """Log determinant, and no error."""
        return float(self._asked(lambda token: float(self._library.logdet_factor(token)))), 0.0

    def inverse_entries(self) -> np.ndarray:
        """The inverse at the place of each entry, exact: Takahashi's selected inverse, or all columns of a full one."""
        row, column, size, _ = self._places
        if FULL * len(row) >= size**2:  # the factor is full, and solves of many columns are faster
            found, order = np.empty(len(row)), np.argsort(column, kind="stable")
            for start in range(0, size, COLUMNS):
                stop = min(start + COLUMNS, size)
                mine = order[slice(*np.searchsorted(column, (start, stop), sorter=order))]
                eye = np.zeros((size, COLUMNS))
                eye[np.arange(start, stop), np.arange(stop - start)] = 1.0
                found[mine] = self.solve(eye)[row[mine], column[mine] - start]
            return found
        with _calling():
            return np.asarray(self._library.selinv(*self._entries, self._places.size))

    def inverse_diagonal(self) -> tuple[np.ndarray, np.ndarray]:
        """Diagonal (n,) of the inverse, and no error."""
        diagonal = self.inverse_entries()[self._places.diagonal]
        return diagonal, np.zeros_like(diagonal)

    def draw(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draws (count, n) around zero with this precision."""
        normal = rng.standard_normal((self._places.size, count))
        return self._apply(normal, self._library.MODE_LT, self._library.MODE_PT).T


class SuperLU:
    """SuperLU of SciPy without pivoting; the diagonal of the inverse is estimated by draws."""

    def __init__(self, places: Entries, values: np.ndarray):
        from scipy.sparse.linalg import splu

        whole = mirrored(places, values)
        options = {"SymmetricMode": True, "Equil": False}
        try:
            self._lu = splu(whole, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
        except RuntimeError as error:  # exactly singular
            raise np.linalg.LinAlgError(f"not positive definite: {error}") from None
        if not (self._pivots > 0).all() or not np.array_equal(self._lu.perm_r, self._lu.perm_c):
            raise np.linalg.LinAlgError("not positive definite")
        self._size, self._whole = places.size, whole

    @cached_property
    def _pivots(self) -> np.ndarray:
        return np.asarray(self._lu.U.diagonal())

    def solve(self, right: np.ndarray) -> np.ndarray:
        """The inverse times right, (n,) or (n, K)."""
        return np.asarray(self._lu.solve(np.asarray(right)))

    def log_determinant(self) -> tuple[float, float]:
        """Log determinant, and no error."""
        return float(np.sum(np.log(self._pivots))), 0.0

    def inverse_diagonal(self) -> tuple[np.ndarray, np.ndarray]:
        """Diagonal (n,) of the inverse from draws, and its standard error."""
        return drawn_diagonal(self.draw, self._whole, PROBES)

    def inverse_entries(self) -> np.ndarray:
        """There is none."""
        raise RuntimeError("SuperLU has no selected inverse")

    def draw(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draws (count, n) around zero with this precision."""
        from scipy.sparse.linalg import spsolve_triangular

        normal = rng.standard_normal((self._size, count)) / np.sqrt(self._pivots)[:, None]
        moved = spsolve_triangular(self._lu.L.T.tocsr(), normal, lower=False, unit_diagonal=True)
        return np.asarray(moved)[self._lu.perm_c].T


def mirrored(places: Entries, values: np.ndarray) -> Any:
    """The whole matrix (n, n), sparse by columns."""
    from scipy.sparse import coo_matrix

    upper = coo_matrix((values, (places.row, places.column)), (places.size, places.size)).tocsc()
    own = upper.diagonal()
    whole = upper + upper.T
    whole.setdiag(own)
    return whole


def drawn_diagonal(
    draw: Callable[[np.random.Generator, int], np.ndarray], whole: Any, probes: int
) -> tuple[np.ndarray, np.ndarray]:
    """Diagonal (n,) of the inverse of a sparse matrix from draws, the rest of each given (Siden and others 2018).

    Also the standard error of each entry.
    """
    rng, own = np.random.default_rng(0), whole.diagonal()
    total, fourth = np.zeros(len(own)), np.zeros(len(own))
    for _ in range(probes // BLOCK):
        drawn = draw(rng, BLOCK).T
        middle = drawn - (whole @ drawn) / own[:, None]  # the mean of each given all others
        total += np.sum(middle**2, 1)
        fourth += np.sum(middle**4, 1)
    mean = total / probes
    return 1.0 / own + mean, np.sqrt(np.maximum(fourth / probes - mean**2, 0.0) / probes)


@contextmanager
def _calling() -> Iterator[None]:
    """In double precision on the CPU; what the library raised within is told apart."""
    try:
        with jax.enable_x64(True), jax.default_device(jax.devices("cpu")[0]):
            yield
    except (RuntimeError, ValueError) as error:  # what XLA makes of what the library raised
        if any(word in str(error) for word in NO_ROOM):
            raise MemoryError(f"no room for a sparse factor: {error}") from None
        if "stale factor" in str(error):
            raise _DroppedError from None
        if "positive definite" in str(error):
            raise np.linalg.LinAlgError(f"not positive definite: {error}") from None
        raise
