"""The joint precision by its products alone, where no factor of the biases fits: conjugate gradients and Lanczos.

Trajectories are banded and keep a factor of their own. Of what they leave to the M biases, S = C - B'W^-1 B, only
products are formed; the blocks of the sensors in C precondition it. Solves are exact to a tolerance; the variances of
biases and states, and the log determinant, are estimated and come with their standard errors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from probcal.errors import FitError, InputError
from probcal.gaussian.factor import Entries, Factor, Library, leading, mirrored

TOLERANCE = 1e-9  # share of the first residual that ends a solve
DRAWN = 1e-2  # share of a draw that its error may have: a bound, which errors stay far below
STEPS = 2000  # of one solve
FEW, MANY, PROBED = 128, 512, 500_000  # probes of an estimate: as many as make so many numbers, within bounds
NUMBERS = 40_000_000  # of the bases that are held at once
LOOK = 8  # steps between two looks at whether draws are done
BLOCK = 64  # draws at once
LACKS = (
    "without a factor of the biases variances of the biases and of each state are estimated, and there are none of"
    ' states together, of predictions or of noises: take engine="cholmod" or "superlu"'
)


@dataclass(frozen=True)
class Iterative:
    """Conjugate gradients for the biases; another library factorises the states before them."""

    library: Library

    exact: ClassVar[bool] = False

    def __call__(self, places: Entries, values: np.ndarray) -> Factor:
        """Factorise the states; of a matrix without biases, or without states, this is all."""
        both = places.blocks.min(initial=places.size) % places.size
        return Products(self.library, places, values) if both else self.library(places, values)


class Products(Factor):
    """A precision (n, n), states before biases."""

    def __init__(self, library: Library, places: Entries, values: np.ndarray):
        """Each bias stands in one of the blocks.

        Raises `numpy.linalg.LinAlgError` where a bias has neither data nor prior.
        """
        self.places, self._whole = places, mirrored(places, values)
        self._states = states = int(places.blocks.min())
        self._held = library(*leading(places, values, states))
        self._across, self._within = self._whole[:states, states:].tocsr(), self._whole[states:, states:].tocsr()
        self._back, self._members, self._size = self._across.T.tocsr(), places.blocks - states, places.size - states
        self._probes = BLOCK * (int(np.clip(PROBED // self._size, FEW, MANY)) // BLOCK)
        # what the matrix has between the biases of each sensor (B, p, p), the tracks known
        M, members = self._size, self._members
        low, high = np.broadcast_arrays(members[:, :, None], members[:, None, :])
        there = (low < M) & (high < M)
        found = np.where(there, 0.0, np.eye(members.shape[1])[None])
        found[there] = np.asarray(self._within[low[there], high[there]]).ravel()
        self._lower = np.linalg.cholesky(found)
        self._inverse = np.linalg.inv(self._lower)

    def _left(self, z: np.ndarray) -> np.ndarray:
        """S times columns z (M, K)."""
        return np.asarray(self._within @ z - self._back @ self._held.solve(self._across @ z))

    def _blockwise(self, matrices: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Matrices (B, p, p) of the blocks times columns z (M, K)."""
        padded = np.concatenate([z, np.zeros((1, z.shape[1]))])
        found = np.empty_like(padded)
        found[self._members] = matrices @ padded[self._members]
        return found[:-1]

    def _white(self, z: np.ndarray) -> np.ndarray:
        """L^-1 S L^-T times columns z (M, K), L the Cholesky factor of the blocks."""
        return self._blockwise(self._inverse, self._left(self._blockwise(self._inverse.mT, z)))

    def solve(self, right: np.ndarray) -> np.ndarray:
        """The inverse times right, (n,) or (n, K); raises `FitError` where conjugate gradients do not end."""
        columns = right.reshape(len(right), -1)
        first = self._held.solve(columns[: self._states])
        z = self._gradients(columns[self._states :] - self._back @ first)
        states = first - self._held.solve(self._across @ z)
        return np.concatenate([states, z]).reshape(right.shape)

    def _gradients(self, right: np.ndarray) -> np.ndarray:
        """S^-1 right (M, K) by preconditioned conjugate gradients, all columns at once."""
        precondition = self._inverse.mT @ self._inverse
        x, r = np.zeros_like(right), right
        p = y = self._blockwise(precondition, r)
        left = np.sum(r * y, 0)
        aim = TOLERANCE**2 * left
        for _ in range(STEPS):
            going = left > aim
            if not going.any():
                return x
            image = self._left(p)
            curved = np.sum(p * image, 0)
            if not (curved[going] > 0).all():
                raise np.linalg.LinAlgError("not positive definite")
            length = np.where(going, left, 0.0) / np.where(going, curved, 1.0)
            x, r = x + length * p, r - length * image
            y = self._blockwise(precondition, r)
            after = np.sum(r * y, 0)
            p = np.where(going, y + after / np.where(going, left, 1.0) * p, 0.0)
            left = np.where(going, after, 0.0)
        raise FitError(
            f"conjugate gradients did not end within {STEPS} steps: the data leave some directions of the biases to a"
            " prior that is much wider; hold them by surveys"
        )

    def log_determinant(self) -> tuple[float, float]:
        """Log determinant by Lanczos quadrature (Ubaru, Chen, Saad 2017), and its standard error."""
        rng = np.random.default_rng(1)
        whole, _ = self._held.log_determinant()
        whole += 2.0 * float(np.sum(np.log(np.diagonal(self._lower, axis1=1, axis2=2))))
        found = np.zeros(0)
        while len(found) < self._probes:
            signs = rng.choice([-1.0, 1.0], (self._size, min(BLOCK, self._probes - len(found))))
            found = np.append(found, self._lanczos(signs, np.log)[1])
        return whole + float(found.mean()), float(found.std(ddof=1) / np.sqrt(len(found)))

    def inverse_diagonal(self) -> tuple[np.ndarray, np.ndarray]:
        """Diagonal (n,) of the inverse from draws, and its standard error (Siden and others 2018)."""
        rng, own = np.random.default_rng(0), self._whole.diagonal()
        total, fourth = np.zeros(len(own)), np.zeros(len(own))
        for _ in range(self._probes // BLOCK):
            drawn = self.draw(rng, BLOCK).T
            middle = drawn - (self._whole @ drawn) / own[:, None]  # the mean of each given all others
            total += np.sum(middle**2, 1)
            fourth += np.sum(middle**4, 1)
        mean = total / self._probes
        return 1.0 / own + mean, np.sqrt(np.maximum(fourth / self._probes - mean**2, 0.0) / self._probes)

    @cached_property
    def inverse(self) -> np.ndarray:
        """There is none: raises `InputError`."""
        raise InputError(LACKS)

    @property
    def order(self) -> np.ndarray:
        """There is none either."""
        raise InputError(LACKS)

    def draw(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draws (count, n) around zero with this precision (Chow, Saad 2014)."""
        found = np.zeros((0, self._whole.shape[0]))
        while len(found) < count:
            normal = rng.standard_normal((self._size, min(BLOCK, count - len(found))))
            white, _ = self._lanczos(normal, lambda values: values**-0.5)
            z = self._blockwise(self._inverse.mT, white)
            states = self._held.draw(rng, z.shape[1]).T - self._held.solve(self._across @ z)
            found = np.concatenate([found, np.concatenate([states, z]).T])
        return found

    def _lanczos(
        self, start: np.ndarray, function: Callable[[np.ndarray], np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray]:
        """A function of the whitened S times the first of some vectors (M, K), and the quadratic forms of these (K,).

        As many of them as there is room for: where their bases outgrow it the last half is dropped. A basis is made
        orthogonal anew at every step. It ends by the residual of the linear system, which bounds the error of a root
        and of a logarithm, integrals over shifted systems; the last entry alone ends it long before small eigenvalues
        are resolved.
        """
        M, K = start.shape
        norm = np.sqrt(np.sum(start**2, 0))
        basis, middle, beside = [start / norm], list[np.ndarray](), list[np.ndarray]()
        while True:
            w = self._white(basis[-1])
            middle.append(np.sum(basis[-1] * w, 0))
            w = w - middle[-1] * basis[-1] - (beside[-1] * basis[-2] if beside else 0.0)
            for own in basis:
                w -= own * np.einsum("mk,mk->k", own, w)
            length = np.sqrt(np.sum(w**2, 0))
            going = length > 1e-12 * np.abs(middle[0])
            beside.append(np.where(going, length, 0.0))
            if len(middle) % LOOK == 0 or not going.any() or len(middle) == M:
                share, rest = _functions(np.array(middle).T, np.array(beside).T, function)
                if (rest <= DRAWN).all() or len(middle) == M:
                    drawn = sum(own * c for own, c in zip(basis, (norm[:, None] * share).T, strict=True))
                    return drawn, norm**2 * share[:, 0]
            if len(middle) == STEPS:
                raise FitError(f"draws of the biases did not end within {STEPS} steps: hold what the data leave open")
            basis.append(np.where(going, w / np.where(going, length, 1.0), 0.0))
            if len(basis) * M * K > NUMBERS and K > 1:
                K //= 2
                norm = norm[:K]
                basis = [own[:, :K].copy() for own in basis]
                middle, beside = [own[:K] for own in middle], [own[:K] for own in beside]


def _functions(
    middle: np.ndarray, beside: np.ndarray, function: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """First columns (K, k) of a function of tridiagonal matrices, and a bound (K,) of the error of a root, a share.

    `beside` (K, k) has with its last column what couples the next vector. A basis that was complete goes on with
    zeros, which the first column does not reach.
    """
    K, k = middle.shape
    matrices, at = np.zeros((K, k, k)), np.arange(k)
    matrices[:, at, at] = np.where(middle == 0, middle[:, :1], middle)
    matrices[:, at[1:], at[:-1]] = matrices[:, at[:-1], at[1:]] = beside[:, :-1]
    values, vectors = np.linalg.eigh(matrices)
    if not (values[:, 0] > 1e-14 * values[:, -1]).all():
        raise np.linalg.LinAlgError("not positive definite")
    first = vectors[:, 0, :]
    share = np.einsum("kij,kj->ki", vectors, function(values) * first)
    residual = beside[:, -1] * np.abs(np.sum(vectors[:, -1, :] * first / values, 1))
    root = np.sqrt(np.sum(first**2 / values, 1))  # the length of the root times the first vector
    return share, residual / (np.sqrt(values[:, 0]) * root)
