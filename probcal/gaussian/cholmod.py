"""Factors by CHOLMOD through sparsax, an extra for Linux and Windows."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from threading import Lock, get_ident
from typing import Any, ClassVar
from weakref import WeakSet

import jax
import numpy as np

from probcal.gaussian.factor import Entries, Factor

NO_ROOM = ("bad_alloc", "status -2", "status -3", "RESOURCE_EXHAUSTED")  # of XLA and of CHOLMOD
THREADS = "OPENBLAS_NUM_THREADS"
BESIDE = 8  # factors of each thread that are kept, where several threads have one


class _DroppedError(Exception):
    """The library has dropped a factor."""


class Cholmod(Factor):
    """CHOLMOD by sparsax, whose analysis of a pattern is kept between factors; on the CPU.

    The library keeps the factors that were made last: one, since that may be gigabytes, and some more where several
    threads have one. What it dropped is made again.
    """

    exact: ClassVar[bool] = True
    _live: ClassVar[WeakSet[Cholmod]] = WeakSet()
    _counting: ClassVar[Lock] = Lock()

    def __init__(self, places: Entries, values: np.ndarray):
        self._library, self._thread = _imported(), get_ident()
        self.places, self.values = places, values
        with _calling():
            self._entries = tuple(jax.device_put(part) for part in (places.row, places.column, values))
        with self._counting:
            self._live.add(self)
        self._make()

    def _make(self) -> None:
        with self._counting:
            threads = len({own._thread for own in self._live})
        with _calling():
            self._library.set_num_cache_size(1)
            self._library.set_token_cache_size(1 if threads == 1 else BESIDE * threads)
            self._token = jax.block_until_ready(self._library.factor(*self._entries, self.places.size))

    def _asked(self, ask: Callable[[Any], Any]) -> Any:
        """The answer of the factor to a request; factorises again if other threads evicted it."""
        while True:
            try:
                with _calling():
                    return ask(self._token)
            except _DroppedError:
                self._make()

    def _apply(self, right: np.ndarray, *modes: Any) -> np.ndarray:
        def ask(token: Any) -> np.ndarray:
            found = jax.device_put(right)
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

    @property
    def order(self) -> np.ndarray:
        """Place (n,) of each variable in the order of elimination."""
        return np.argsort(self._apply(np.arange(float(self.places.size)), self._library.MODE_P))

    def draw(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draws (count, n) around zero with this precision."""
        normal = rng.standard_normal((self.places.size, count))
        return self._apply(normal, self._library.MODE_LT, self._library.MODE_PT).T


@cache
def _imported() -> Any:
    """The library, its BLAS on one thread unless the environment says otherwise.

    The dense parts of a factor are small: of 2,500 radars two threads of OpenBLAS, which wait for
    each other, take ten times the processor's time of one.
    """
    said = os.environ.get(THREADS)
    os.environ.setdefault(THREADS, "1")  # read when the library is loaded
    try:
        import sparsax  # an extra
    finally:
        if said is None:
            os.environ.pop(THREADS, None)
    return sparsax


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
