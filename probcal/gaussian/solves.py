"""Solves with the precision of the biases: what an algorithm asks of it, and its dense form.

A caller says `at.given(prior)` and asks; how the precision is held and factorised is no concern of its. Another form
is another class with the members of `Solves`; those of the joint precision of states and biases are in `cholesky`.
"""

from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp

from probcal import linalg


class Solves(Protocol):
    """A positive definite precision (M, M) of the biases, prior couplings inside."""

    def solve(self, right: jax.Array) -> jax.Array:
        """Covariance times right, (M,) or (M, K)."""

    def apply(self, columns: jax.Array) -> jax.Array:
        """Precision times columns, (M,) or (M, K)."""

    def log_determinant(self) -> jax.Array:
        """Log determinant of the precision."""

    def marginals(self) -> jax.Array:
        """Variance (M,) of each bias."""

    def block(self, index: jax.Array) -> jax.Array:
        """Covariance (k, k) of some biases."""

    def draw(self, key: jax.Array, count: int) -> jax.Array:
        """Draws (D, M) around zero."""

    def smallest(self, k: int) -> tuple[jax.Array, jax.Array]:
        """The k smallest eigenvalues (k,) of the precision and their unit vectors (M, k)."""


class Dense(NamedTuple):
    """The precision as a matrix with the inverse of its lower Cholesky factor; non-finite where it is singular."""

    matrix: jax.Array  # (M, M)
    lower: jax.Array  # (M, M)
    inverse: jax.Array  # (M, M) of `lower`: covariance = inverse' inverse

    @classmethod
    def of(cls, matrix: jax.Array) -> "Dense":
        """Factorise a precision (M, M)."""
        return cls(matrix, *linalg.factor_and_inverse(matrix))

    def solve(self, right: jax.Array) -> jax.Array:
        """Covariance times right, (M,) or (M, K)."""
        return self.inverse.T @ (self.inverse @ right)

    def apply(self, columns: jax.Array) -> jax.Array:
        """Precision times columns, (M,) or (M, K)."""
        return self.matrix @ columns

    def log_determinant(self) -> jax.Array:
        """Log determinant of the precision."""
        return 2.0 * jnp.sum(jnp.log(jnp.diagonal(self.lower)))

    def covariance(self) -> jax.Array:
        """The whole covariance (M, M)."""
        return self.inverse.T @ self.inverse

    def marginals(self) -> jax.Array:
        """Variance (M,) of each bias."""
        return jnp.sum(self.inverse**2, 0)

    def block(self, index: jax.Array) -> jax.Array:
        """Covariance (k, k) of some biases."""
        columns = self.inverse[:, index]
        return columns.T @ columns

    def draw(self, key: jax.Array, count: int) -> jax.Array:
        """Draws (D, M) around zero."""
        return jax.random.normal(key, (count, self.matrix.shape[0])) @ self.inverse

    def smallest(self, k: int) -> tuple[jax.Array, jax.Array]:
        """The k smallest eigenvalues (k,) of the precision and their unit vectors (M, k)."""
        values, vectors = linalg.spectrum(self.matrix)
        return values[:k], vectors[:, :k]
