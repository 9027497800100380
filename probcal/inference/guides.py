"""Gaussian guides of a variational fit: x = mean + exp(log_scale) * (B n), n unit normals (D,), and what B may be.

A `Mixing` is the static part, `mix` its numbers. Its `turned` gives B'^-1 n, which the path derivative needs: the
slope of the guide's log density at x is -exp(-log_scale) * turned (Roeder, Wu, Duvenaud 2017).
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal import linalg


class Guide(NamedTuple):
    """Parameters of a guide over D coordinates."""

    mean: jax.Array  # (D,)
    log_scale: jax.Array  # (D,)
    mix: jax.Array  # by its `Mixing`


@dataclass(frozen=True)
class Mixing(ABC):
    """How the unit normals are mixed."""

    @abstractmethod
    def first(self, size: int, key: jax.Array) -> jax.Array:
        """The numbers to start from, B near the identity."""

    @abstractmethod
    def mixed(self, mix: jax.Array, n: jax.Array) -> jax.Array:
        """B n of draws n (K, D)."""

    @abstractmethod
    def turned(self, mix: jax.Array, n: jax.Array) -> jax.Array:
        """B'^-1 n of draws n (K, D)."""

    @abstractmethod
    def volume(self, mix: jax.Array) -> jax.Array:
        """Log determinant of B."""

    def place(self, guide: Guide, n: jax.Array) -> jax.Array:
        """Coordinates (K, D) of unit normals (K, D)."""
        return guide.mean[None] + jnp.exp(guide.log_scale)[None] * self.mixed(guide.mix, n)

    def slope(self, guide: Guide, n: jax.Array) -> jax.Array:
        """Slope (K, D) of the log density by the coordinates."""
        return -jnp.exp(-guide.log_scale)[None] * self.turned(guide.mix, n)

    def log_density(self, guide: Guide, n: jax.Array) -> jax.Array:
        """Log density (K,) of the coordinates that the unit normals (K, D) give."""
        unit = -0.5 * jnp.sum(n**2, 1) - 0.5 * n.shape[1] * np.log(2 * np.pi)
        return unit - jnp.sum(guide.log_scale) - self.volume(guide.mix)


@dataclass(frozen=True)
class Diagonal(Mixing):
    """B the identity: mean-field."""

    def first(self, size, key):
        """Nothing."""
        return jnp.zeros(0)

    def mixed(self, mix, n):
        """The draws themselves."""
        return n

    def turned(self, mix, n):
        """The draws themselves."""
        return n

    def volume(self, mix):
        """Zero."""
        return jnp.zeros(())


@dataclass(frozen=True)
class Triangular(Mixing):
    """Full rank over the first `head` entries, B = I + (strictly lower) mix there; the identity for the rest."""

    head: int

    def _matrix(self, mix: jax.Array) -> jax.Array:
        return jnp.eye(self.head) + jnp.tril(mix, -1)

    def first(self, size, key):
        """Zeros (head, head)."""
        return jnp.zeros((self.head, self.head))

    def mixed(self, mix, n):
        """The head mixed, the tail as it is."""
        return jnp.concatenate([n[:, : self.head] @ self._matrix(mix).T, n[:, self.head :]], 1)

    def turned(self, mix, n):
        """The head turned, the tail as it is."""
        inverse = linalg.inverse_lower(self._matrix(mix))
        return jnp.concatenate([n[:, : self.head] @ inverse, n[:, self.head :]], 1)

    def volume(self, mix):
        """Zero: the diagonal is one."""
        return jnp.zeros(())


@dataclass(frozen=True)
class LowRank(Mixing):
    """B = I + U U', U = mix (D, rank): the covariance is a diagonal matrix and one of low rank, in scaled entries."""

    rank: int

    def _gram(self, mix: jax.Array) -> jax.Array:
        return jnp.eye(self.rank) + mix.T @ mix

    def first(self, size, key):
        """Small random directions: at zero they have no slope."""
        return 0.1 * jax.random.normal(key, (size, self.rank)) / np.sqrt(size)

    def mixed(self, mix, n):
        """What the directions see is widened."""
        return n + (n @ mix) @ mix.T

    def turned(self, mix, n):
        """By Woodbury's identity."""
        return n - linalg.solve_positive(self._gram(mix), (n @ mix).T).T @ mix.T

    def volume(self, mix):
        """Log determinant of I + U'U."""
        return linalg.inverse_and_logdet(self._gram(mix))[1]
