"""Guides of a variational fit: densities of x (D,) that unit normals n (D,) are turned into, reparametrised.

All are x = mean + exp(log_scale) * f(n) and differ in f. `slope` is what the path derivative needs: that of the log
density by x, at fixed parameters (Roeder, Wu, Duvenaud 2017).
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal import linalg


class GuideParameters(NamedTuple):
    """Parameters of a guide over D coordinates."""

    mean: jax.Array  # (D,)
    log_scale: jax.Array  # (D,)
    rest: tuple[jax.Array, ...]  # of f


@dataclass(frozen=True)
class Guide(ABC):
    """The static part of a guide: how f works. Draws are rows of (K, D)."""

    @abstractmethod
    def first(self, size: int, key: jax.Array) -> tuple[jax.Array, ...]:
        """Parameters of f at the start, f near the identity."""

    @abstractmethod
    def turned(self, rest: tuple[jax.Array, ...], n: jax.Array) -> jax.Array:
        """f(n), (K, D)."""

    @abstractmethod
    def pulled(self, rest: tuple[jax.Array, ...], n: jax.Array) -> jax.Array:
        """Slope (K, D) of the log density of t = f(n) by t."""

    @abstractmethod
    def volume(self, rest: tuple[jax.Array, ...], n: jax.Array) -> jax.Array:
        """Log determinant (K,) of the derivative of f."""

    def place(self, fitted: GuideParameters, n: jax.Array) -> jax.Array:
        """Coordinates (K, D) of unit normals."""
        return fitted.mean[None] + jnp.exp(fitted.log_scale)[None] * self.turned(fitted.rest, n)

    def slope(self, fitted: GuideParameters, n: jax.Array) -> jax.Array:
        """Slope (K, D) of the log density by the coordinates."""
        return jnp.exp(-fitted.log_scale)[None] * self.pulled(fitted.rest, n)

    def log_density(self, fitted: GuideParameters, n: jax.Array) -> jax.Array:
        """Log density (K,) of the coordinates of unit normals."""
        unit = -0.5 * jnp.sum(n**2, 1) - 0.5 * n.shape[1] * np.log(2 * np.pi)
        return unit - jnp.sum(fitted.log_scale) - self.volume(fitted.rest, n)


@dataclass(frozen=True)
class Structured(Guide):
    """Full rank over the first `head` entries, each with a skewness and tails of its own; normals for the rest.

    There t = sinh(tail asinh(Ln) + skew) entry by entry (Jones, Pewsey 2009), L unit lower triangular: scales of a
    hierarchy are skewed on the log scale, with the tails of their half-Cauchy (tail 2 is that of an exponential).
    Tail lies between 1/2 and 2, skew between -1 and 1.
    """

    head: int

    def first(self, size, key):
        """Zeros, so that t = n: L below its diagonal (times the root of its size); skew, tail before their bounds."""
        return jnp.zeros((self.head, self.head)), jnp.zeros(self.head), jnp.zeros(self.head)

    def _correlated(self, rest: tuple[jax.Array, ...], n: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Ln (K, head), and L."""
        L = jnp.eye(self.head) + jnp.tril(rest[0], -1) / np.sqrt(self.head)
        return n[:, : self.head] @ L.T, L

    def _shape(self, rest: tuple[jax.Array, ...], c: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """t of c = Ln, the log of its derivative, and the slope of that log."""
        tail, skew = 2.0 ** jnp.tanh(rest[2])[None], jnp.tanh(rest[1])[None]
        root = jnp.sqrt(1 + c**2)
        angle = tail * jnp.arcsinh(c) + skew
        volume = jnp.log(tail) + jnp.log(jnp.cosh(angle)) - jnp.log(root)
        return jnp.sinh(angle), volume, tail * jnp.tanh(angle) / root - c / root**2

    def turned(self, rest, n):
        """The head correlated and bent, the tail as it is."""
        t, _, _ = self._shape(rest, self._correlated(rest, n)[0])
        return jnp.concatenate([t, n[:, self.head :]], 1)

    def pulled(self, rest, n):
        """By the chain rule."""
        c, L = self._correlated(rest, n)
        _, volume, bend = self._shape(rest, c)
        own = -(n[:, : self.head] @ linalg.inverse_lower(L)) - bend
        return jnp.concatenate([own * jnp.exp(-volume), -n[:, self.head :]], 1)

    def volume(self, rest, n):
        """That of the bending: the diagonal of L is one."""
        return jnp.sum(self._shape(rest, self._correlated(rest, n)[0])[1], 1)
