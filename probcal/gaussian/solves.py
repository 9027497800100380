"""A positive definite matrix of all biases, factorised."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from probcal import linalg


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

    def log_determinant(self) -> jax.Array:
        """Log determinant of the precision."""
        return 2.0 * jnp.sum(jnp.log(jnp.diagonal(self.lower)))

    def covariance(self) -> jax.Array:
        """The whole covariance (M, M)."""
        return self.inverse.T @ self.inverse

    def apply(self, columns: jax.Array) -> jax.Array:
        """Precision times columns, (M,) or (M, K)."""
        return self.matrix @ columns

    def marginals(self) -> jax.Array:
        """Variance (M,) of each bias."""
        return jnp.sum(self.inverse**2, 0)

    def draw(self, key: jax.Array, count: int) -> jax.Array:
        """Draws (D, M) around zero."""
        return jax.random.normal(key, (count, self.matrix.shape[0])) @ self.inverse
