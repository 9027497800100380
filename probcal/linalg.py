"""The only place that factorises: small triangular factors for the recursion, dense ones for the biases."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular

UNROLL = 12  # largest matrix whose factors are written out instead of calling LAPACK
BASE = 24  # largest block that a dense factorisation hands to LAPACK
RANK = 1e-14  # share of its diagonal below which a pivot counts as zero
LOST = 1e-12  # share of its length below which a row counts as dependent on those before it
SYMMETRIC = 96  # widest symmetric product that is formed whole
NARROW = 64  # most columns for which a product is written as a sum: inside a scan a small dot costs more


def multiply(left: jax.Array, right: jax.Array) -> jax.Array:
    """Product of a small (n, k) and a (k, m) matrix, in the form that is fast inside a scan."""
    if left.shape[1] > UNROLL or right.shape[1] > NARROW:
        return left @ right
    return jnp.sum(left[:, :, None] * right[None, :, :], 1)


def multiply_rows(left: jax.Array, rows: list[jax.Array]) -> jax.Array:
    """Product of a small (n, k) matrix and k rows (m,), one after the other: for many columns inside a scan."""
    if len(rows) > 2 * UNROLL:
        return left @ jnp.stack(rows)
    return sum((left[:, j, None] * row[None, :] for j, row in enumerate(rows[1:], 1)), left[:, :1] * rows[0][None, :])


def tria(columns: jax.Array) -> jax.Array:
    """Lower-triangular (n, n) L with L L' = columns columns', for columns (n, m), m >= n, of any rank.

    Small ones by modified Gram-Schmidt, whose triangle is backward stable at any rank (Bjorck 1967).
    """
    n = columns.shape[0]
    if n > UNROLL:
        return jnp.linalg.qr(columns.T, mode="r").T
    below = jnp.arange(n)

    def project(j: jax.Array, carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        left, lower = carry
        length = jnp.sqrt(jnp.sum(left[j] ** 2))
        unit = left[j] / jnp.where(length > 0, length, 1.0)
        column = jnp.where(below >= j, jnp.sum(left * unit[None, :], 1), 0.0)
        return left - column[:, None] * unit[None, :], lower.at[:, j].set(column)

    return jax.lax.fori_loop(0, n, project, (columns, jnp.zeros((n, n), columns.dtype)))[1]


def inverse_cholesky(matrix: jax.Array) -> jax.Array:
    """Inverse C^-1 (lower) of the Cholesky factor of a small positive definite (n, n) matrix."""
    n = matrix.shape[0]
    if n > UNROLL:
        return factor_and_inverse(matrix)[1]
    below = jnp.arange(n)
    left = jnp.concatenate([matrix, jnp.eye(n, dtype=matrix.dtype)], 1)
    rows = []
    for j in range(n):  # elimination of [A, I]: the pivot rows become [C', C^-1]
        pivot = left[j] / jnp.sqrt(left[j, j])
        left = left - jnp.where(below > j, pivot[:n], 0.0)[:, None] * pivot[None, :]
        rows.append(pivot[n:])
    return jnp.stack(rows)


def observe(root: jax.Array, columns: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Root of a covariance (n, n) root root' after unit-noise data columns' x, for columns (n, u), one after another.

    Also the gains (n, u) of each by its whitened innovation, and the std (u,) of that innovation. Potter's square-root
    update (Bierman 1977, II.7): no product of the root with itself is formed.
    """

    def one(root: jax.Array, column: jax.Array) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        seen = jnp.sum(root * column[:, None], 0)
        std = jnp.sqrt(1.0 + jnp.sum(seen**2))
        gain = jnp.sum(root * (seen / std)[None, :], 1)
        return root - gain[:, None] * (seen / (1.0 + std))[None, :], (gain, std)

    root, (gains, stds) = jax.lax.scan(one, root, columns.T)
    return root, gains.T, stds


def regress_rows(rows: jax.Array, known: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The C (p, n) for which rows (p, m) less C known are orthogonal to the rows `known` (n, m), of any rank.

    Also the lower triangle T (n, n) with T T' = known known'. Modified Gram-Schmidt of both together. Of a known row
    that is lost in rounding beside the others C has zero.
    """
    n = known.shape[0]
    number = jnp.arange(n, dtype=jnp.uint32)

    def project(left: jax.Array, own: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        row, least = left[own[0]], own[1]
        length = jnp.sqrt(jnp.sum(row**2))
        there = length > least
        unit = jnp.where(there, row / jnp.where(there, length, 1.0), 0.0)
        column = jnp.sum(left * unit[None, :], 1)
        return left - column[:, None] * unit[None, :], column

    def solve(rest: jax.Array, own: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        j, row = own  # C times the triangle is what stands below it
        share = jnp.where(row[j] > 0, rest[:, j] / jnp.where(row[j] > 0, row[j], 1.0), 0.0)
        return rest - share[:, None] * row[None, :], share

    least = LOST * jnp.sqrt(jnp.sum(known**2, 1))
    whole = jax.lax.scan(project, jnp.concatenate([known, rows]), (number, least))[1].T
    found = jax.lax.scan(solve, whole[n:], (number, whole[:n]), reverse=True)[1].T
    return found, jnp.tril(whole[:n])


def semi_cholesky(matrices: jax.Array) -> jax.Array:
    """Lower roots (E, n, n) of positive semi-definite matrices of any rank; a pivot lost in rounding counts as zero."""
    n = matrices.shape[-1]
    least = RANK * jnp.diagonal(matrices, axis1=1, axis2=2)
    left, columns = matrices, []
    for j in range(n):
        there = left[:, j, j] > least[:, j]
        pivot = jnp.sqrt(jnp.where(there, left[:, j, j], 1.0))
        column = jnp.where((jnp.arange(n) >= j)[None] & there[:, None], left[:, :, j] / pivot[:, None], 0.0)
        left = left - column[:, :, None] * column[:, None, :]
        columns.append(column)
    return jnp.stack(columns, 2)


@jax.jit
def forward(root: jax.Array, right: jax.Array) -> jax.Array:
    """The y (E, n, m) with root y = right, for lower roots (E, n, n) and right-hand sides in their range.

    Where a pivot is zero the entry of y is zero.
    """
    rest, solved = right, []
    for j in range(root.shape[-1]):
        pivot = root[:, j, j, None]
        y = jnp.where(pivot > 0, rest[:, j] / jnp.where(pivot > 0, pivot, 1.0), 0.0)
        rest = rest - root[:, :, j, None] * y[:, None, :]
        solved.append(y)
    return jnp.stack(solved, 1)


def semi_solve(root: jax.Array, right: jax.Array) -> jax.Array:
    """Solutions x (E, n, m) of positive semi-definite systems of these roots (E, n, n) in their range.

    Where a pivot is lost in rounding the entry of x is zero.
    """
    y = forward(root, right)
    n = root.shape[-1]
    pivots = jnp.diagonal(root, axis1=1, axis2=2)
    there = pivots > 0
    x = jnp.zeros_like(y)
    for j in reversed(range(n)):
        left = y[:, j] - jnp.einsum("ei,eim->em", root[:, :, j], x)
        x = x.at[:, j].set(jnp.where(there[:, j, None], left / jnp.where(there, pivots, 1.0)[:, j, None], 0.0))
    return x


def gram(rows: jax.Array) -> jax.Array:
    """Symmetric product rows' rows of (k, m) rows, by halves: one triangle is formed."""
    m = rows.shape[1]
    if m <= SYMMETRIC:
        return rows.T @ rows
    h = m // 2
    below = rows[:, h:].T @ rows[:, :h]
    return jnp.block([[gram(rows[:, :h]), below.T], [below, gram(rows[:, h:])]])


def gram_less(rows: jax.Array, other: jax.Array) -> jax.Array:
    """rows' rows - other' other of (k, m) rows, symmetric: the one product (rows - other)' (rows + other)."""
    product = (rows - other).T @ (rows + other)
    return 0.5 * (product + product.T)


def factor_and_inverse(matrix: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Lower Cholesky factor L of a positive definite (n, n) matrix, and L^-1, by halves.

    Products do the work: LAPACK sees blocks of at most `BASE`, since its threaded triangular solves wait
    milliseconds for a busy core. Non-finite where the matrix is not positive definite.
    """
    n = matrix.shape[0]
    if n <= BASE:
        lower = jnp.linalg.cholesky(matrix)
        return lower, solve_triangular(lower, jnp.eye(n, dtype=matrix.dtype), lower=True)
    h = n // 2
    first, first_inverse = factor_and_inverse(matrix[:h, :h])
    below = matrix[h:, :h] @ first_inverse.T
    last, last_inverse = factor_and_inverse(matrix[h:, h:] - below @ below.T)
    lower = jnp.block([[first, jnp.zeros((h, n - h), matrix.dtype)], [below, last]])
    return lower, _inverse_of_halves(first_inverse, below, last_inverse)


def _inverse_of_halves(first: jax.Array, below: jax.Array, last: jax.Array) -> jax.Array:
    """Inverse of a lower triangular matrix by those of its diagonal blocks and what stands below them."""
    corner = jnp.zeros((len(first), len(last)), below.dtype)
    return jnp.block([[first, corner], [-(last @ below) @ first, last]])


def inverse_lower(matrix: jax.Array) -> jax.Array:
    """Inverse of a lower triangular (n, n) matrix, by halves; what stands above its diagonal is not read."""
    n = matrix.shape[0]
    if n <= BASE:
        return solve_triangular(matrix, jnp.eye(n, dtype=matrix.dtype), lower=True)
    h = n // 2
    return _inverse_of_halves(inverse_lower(matrix[:h, :h]), matrix[h:, :h], inverse_lower(matrix[h:, h:]))


def solve_positive(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """Solve a symmetric positive definite system; non-finite where the matrix is not positive definite."""
    _, inverse = factor_and_inverse(matrix)
    return inverse.T @ (inverse @ right)


def displace(matrix: jax.Array, right: jax.Array, noise: jax.Array) -> jax.Array:
    """matrix^-1 right + L^-T noise, L the Cholesky factor of `matrix`: a draw of that precision by unit noise.

    A large one by halves, as in `factor_and_inverse`: beside other work LAPACK's threads wait for each other.
    """
    if matrix.shape[0] > NARROW:
        _, inverse = factor_and_inverse(matrix)
        return inverse.T @ (inverse @ right + noise)
    lower = jnp.linalg.cholesky(matrix)
    return solve_triangular(lower, solve_triangular(lower, right, lower=True) + noise, lower=True, trans=1)


@jax.jit
def inverse_and_logdet(matrix: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Inverse and log determinant of a symmetric positive definite matrix."""
    lower, inverse = factor_and_inverse(matrix)
    return inverse.T @ inverse, 2.0 * jnp.sum(jnp.log(jnp.diagonal(lower)))


def log_normal(residual: jax.Array, root: jax.Array) -> jax.Array:
    """Log density of a residual (n,) whose covariance is root @ root.T, by its root (n, m)."""
    lower, inverse = factor_and_inverse(root @ root.T)
    white = inverse @ residual
    return -0.5 * jnp.sum(white**2) - (jnp.sum(jnp.log(jnp.diagonal(lower))) + 0.5 * len(white) * math.log(2 * math.pi))


def shortest_drive(residual: jax.Array, root: jax.Array) -> jax.Array:
    """The shortest u (m,) with root @ u the residual (n,), for a root (n, m) of full rank."""
    _, inverse = factor_and_inverse(root @ root.T)
    return root.T @ (inverse.T @ (inverse @ residual))


def solve_batched(matrices: jax.Array, right: jax.Array) -> jax.Array:
    """Solve small positive definite systems (E, n, n) for vectors (E, n)."""
    inverses = jax.vmap(inverse_cholesky)(matrices)
    return (inverses.mT @ (inverses @ right[:, :, None]))[:, :, 0]


def preceding(values: jax.Array) -> jax.Array:
    """Each entry of a sequence (E, ...) moved to the next, zero at the first."""
    return jnp.concatenate([jnp.zeros_like(values[:1]), values[:-1]])


def outer(vectors: Any) -> Any:
    """Products (..., p, p) of every two entries of vectors (..., p); of flags whether both hold."""
    return vectors[..., :, None] * vectors[..., None, :]


def library(*leaves: Any) -> Any:
    """The library that computes with these: that of jax where one is traced, else NumPy, which compiles nothing."""
    return jnp if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves) else np


def spectrum(matrices: Any) -> tuple[Any, Any]:
    """Eigenvalues (ascending) and eigenvectors (columns) of symmetric matrices (..., n, n)."""
    return library(matrices).linalg.eigh(matrices)


def singular(matrices: Any, whole: bool = False) -> tuple[Any, Any, Any]:
    """Left vectors, singular values (descending) and right vectors (rows) of matrices; all of them where `whole`."""
    return library(matrices).linalg.svd(matrices, full_matrices=whole)


def eigenvalues(matrices: Any) -> np.ndarray:
    """Eigenvalues (..., n), ascending, of symmetric matrices on the host."""
    return np.linalg.eigvalsh(matrices)


def invert(matrices: Any) -> Any:
    """Inverses of matrices (..., n, n)."""
    return library(matrices).linalg.inv(matrices)


def pseudo_inverse(matrices: Any, symmetric: bool = False) -> np.ndarray:
    """Pseudo-inverses (..., m, n) of matrices (..., n, m) on the host."""
    return np.linalg.pinv(matrices, hermitian=symmetric)


def solve_square(matrices: Any, right: Any) -> np.ndarray:
    """Solutions of square systems on the host."""
    return np.linalg.solve(matrices, right)


def log_determinant(matrices: Any) -> Any:
    """Logarithms of the determinants of matrices (..., n, n) on the host."""
    return np.linalg.slogdet(matrices)[1]


def handedness(matrices: Any) -> Any:
    """Signs of the determinants: negative where a matrix mirrors, 0 where it is singular."""
    return np.linalg.slogdet(matrices)[0]


def cholesky(matrices: Any) -> np.ndarray:
    """Lower Cholesky factors on the host; raises `numpy.linalg.LinAlgError` where one is not positive definite."""
    return np.linalg.cholesky(matrices)


def orthogonalise(columns: np.ndarray) -> np.ndarray:
    """Orthonormal columns with the span of those given."""
    return np.linalg.qr(columns)[0]


def least_squares(columns: np.ndarray, right: np.ndarray, least: float | None = None) -> np.ndarray:
    """The shortest x with columns @ x nearest to `right`; singular values below `least` of the largest count as 0."""
    return np.linalg.lstsq(columns, right, rcond=least)[0]


def marginalise(information: np.ndarray, free: Any, held: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Information (F, F) of some entries, an index of F of M, the others integrated under a prior of precision `held`.

    Also the C (M - F, F) by which the others move against them (Schur complement).
    """
    index = np.arange(len(information))
    own, rest = index[free], np.delete(index, free)
    across = information[np.ix_(rest, own)]
    gain = solve_square(information[np.ix_(rest, rest)] + held * np.eye(len(rest)), across)
    return information[np.ix_(own, own)] - across.T @ gain, gain


def nearest_rotation(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rotation nearest to a matrix (Kabsch 1976), and the singular values of the matrix."""
    left, values, right = singular(matrix)
    signs = np.ones(len(matrix))
    signs[-1] = handedness(left @ right) or 1.0
    return (left * signs) @ right, values


def root_of(covariances: Any) -> Any:
    """Roots (..., n, n) of covariances of any rank, their columns along the axes: root @ root.mT is the covariance."""
    values, vectors = spectrum(covariances)
    return vectors * library(values).sqrt(library(values).maximum(values, 0.0))[..., None, :]


def without_negative(matrices: Any, least: float = 0.0) -> Any:
    """The nearest symmetric matrices (..., n, n) whose eigenvalues are at least `least`."""
    values, vectors = spectrum(0.5 * (matrices + matrices.mT))
    return (vectors * library(values).maximum(values, least)[..., None, :]) @ vectors.mT


def symmetric_root(covariance: np.ndarray) -> np.ndarray:
    """The symmetric root (M, M) of a covariance: it does not turn with rounding, and may be singular."""
    values, vectors = spectrum(covariance)
    return (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
