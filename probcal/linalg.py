"""The only place that factorises: small triangular factors for the recursion, dense ones for the biases."""

import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_factor, cho_solve

UNROLL = 12  # largest matrix whose Cholesky factor is written out instead of calling LAPACK


def tria(columns: jax.Array) -> jax.Array:
    """Lower-triangular (n, n) L with L L' = columns columns', for columns (n, m), m >= n, of any rank."""
    return jnp.linalg.qr(columns.T, mode="r").T


def _unrolled_cholesky(matrix: jax.Array) -> list[list[jax.Array]]:
    n = matrix.shape[0]
    lower: list[list[jax.Array]] = [[matrix[i, j] for j in range(n)] for i in range(n)]
    for j in range(n):
        for k in range(j):
            lower[j][j] = lower[j][j] - lower[j][k] ** 2
        lower[j][j] = jnp.sqrt(lower[j][j])
        for i in range(j + 1, n):
            for k in range(j):
                lower[i][j] = lower[i][j] - lower[i][k] * lower[j][k]
            lower[i][j] = lower[i][j] / lower[j][j]
    return lower


def inverse_cholesky(matrix: jax.Array) -> jax.Array:
    """Inverse C^-1 (lower) of the Cholesky factor of a small positive definite (n, n) matrix."""
    n = matrix.shape[0]
    if n > UNROLL:
        factor = jnp.linalg.cholesky(matrix)
        return jax.scipy.linalg.solve_triangular(factor, jnp.eye(n, dtype=matrix.dtype), lower=True)
    lower = _unrolled_cholesky(matrix)
    zero = jnp.zeros((), matrix.dtype)
    inverse = [[zero] * n for _ in range(n)]
    for j in range(n):
        inverse[j][j] = 1.0 / lower[j][j]
        for i in range(j + 1, n):
            total = lower[i][j] * inverse[j][j]
            for k in range(j + 1, i):
                total = total + lower[i][k] * inverse[k][j]
            inverse[i][j] = -total / lower[i][i]
    return jnp.stack([jnp.stack(row) for row in inverse])


def solve_positive(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """Solve a symmetric positive definite system; non-finite where the matrix is not positive definite."""
    return cho_solve(cho_factor(matrix, lower=True), right)


def inverse_and_logdet(matrix: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Inverse and log determinant of a symmetric positive definite matrix, by one Cholesky factor."""
    factor = jnp.linalg.cholesky(matrix)
    inverse = cho_solve((factor, True), jnp.eye(matrix.shape[0], dtype=matrix.dtype))
    return inverse, 2.0 * jnp.sum(jnp.log(jnp.diagonal(factor)))


def inverse_diagonal(matrix: jax.Array) -> jax.Array:
    """Diagonal of the inverse of a symmetric positive definite matrix."""
    root = jnp.linalg.cholesky(matrix)
    inverse = jax.scipy.linalg.solve_triangular(root, jnp.eye(matrix.shape[0], dtype=matrix.dtype), lower=True)
    return jnp.sum(inverse**2, 0)


def factor(matrix: jax.Array) -> jax.Array:
    """Lower Cholesky factor of a symmetric positive definite matrix."""
    return jnp.linalg.cholesky(matrix)


def spectrum(matrix: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Eigenvalues (ascending) and eigenvectors (columns) of a symmetric matrix."""
    return jnp.linalg.eigh(matrix)
