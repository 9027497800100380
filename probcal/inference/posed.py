"""A posterior prepared for sampling: problem, frame and prior hierarchy, with the Gaussian conditionals they give.

theta holds the biases z (M,) and the log levels (H,). Given the hyper-parameters phi the frame makes theta Gaussian.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal import linalg
from probcal.gaussian.frame import Frame
from probcal.inference.draws import normals
from probcal.inference.hierarchy import Hierarchy, Phi
from probcal.model.model import Model
from probcal.priors import Precision


@dataclass(frozen=True)
class Form:
    """The static part: what kernels are compiled for."""

    biases: int  # M, the number of biases
    hierarchy: Hierarchy

    def rest(self, first: Precision) -> Precision:
        """The prior of the biases that no hierarchy governs, flat for all others."""
        governed = np.isin(np.arange(self.biases), self.hierarchy.learnt)
        return first._replace(alpha=jnp.where(governed, 0.0, first.alpha))


class Natural(NamedTuple):
    """A Gaussian likelihood of the biases alone."""

    information: jax.Array  # (M, M)
    pull: jax.Array  # (M,)
    level_spread: jax.Array  # (0,)
    first: Precision


class Posed(NamedTuple):
    """The numbers: data, frame, and the prior of the biases that no hierarchy governs."""

    model: Model
    frame: Frame
    first: Precision
    orbits: tuple[Any, ...] = ()  # `orbits.Orbit`s that chains move along
    away: Any = None  # how far this side of a mirror is from the first, a `Point`

    @property
    def information(self) -> jax.Array:
        """Precision (Q, Q) of the frame's likelihood."""
        return self.frame.information

    @property
    def pull(self) -> jax.Array:
        """Its linear term about zero, (Q,)."""
        return self.frame.pull

    @property
    def level_spread(self) -> jax.Array:
        """Prior sd (H,) of the log levels."""
        return self.model.level_spread


# a Gaussian likelihood of theta in natural form, and the prior of the biases that no hierarchy governs
Quadratic = Natural | Posed


class Conditional(NamedTuple):
    """theta given phi by the frame: Gaussian, zero where inactive."""

    mean: jax.Array  # (Q,)
    factor: jax.Array  # (Q, Q) lower Cholesky factor of the precision
    inverse: jax.Array  # (Q, Q) its inverse: covariance = inverse' inverse
    active: jax.Array  # (Q,) boolean
    alpha: jax.Array  # (Q,) prior precisions, those of the levels last

    @property
    def variance(self) -> jax.Array:
        """Variance of each entry, (Q,)."""
        return jnp.where(self.active, jnp.sum(self.inverse**2, 0), 0.0)

    def draw(self, key: jax.Array) -> jax.Array:
        """One draw (Q,)."""
        return jnp.where(self.active, self.mean + self.deviation(key), 0.0)

    def deviation(self, key: jax.Array) -> jax.Array:
        """One draw less its mean, (Q,)."""
        return jnp.where(self.active, self.inverse.T @ jax.random.normal(key, self.mean.shape), 0.0)


def prior_precision(form: Form, posed: Quadratic, phi: Phi) -> tuple[jax.Array, jax.Array]:
    """Precisions (Q,) of theta given phi, and what correlations add to them (Q, Q)."""
    H = posed.level_spread.shape[0]
    alpha = form.hierarchy.alpha(phi, posed.first.alpha)
    alpha = jnp.concatenate([alpha, 1.0 / posed.level_spread**2])
    return alpha, jnp.pad(posed.first.coupled(), (0, H))


def activity(form: Form, posed: Quadratic, phi: Phi) -> jax.Array:
    """A mask (Q,) of the entries of theta that are not exactly zero."""
    H = posed.level_spread.shape[0]
    return jnp.concatenate([form.hierarchy.active(phi, form.biases), jnp.ones(H, bool)])


def natural(form: Form, posed: Quadratic, phi: Phi) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Precision (Q, Q) and pull (Q,) of theta given phi, what is active (Q,), and prior precisions (Q,)."""
    alpha, coupling = prior_precision(form, posed, phi)
    active = activity(form, posed, phi)
    matrix = posed.information + coupling + jnp.diag(alpha)
    matrix = jnp.where(linalg.outer(active), matrix, jnp.eye(alpha.shape[0]))
    return matrix, jnp.where(active, posed.pull, 0.0), active, alpha


def conditional(form: Form, posed: Quadratic, phi: Phi) -> Conditional:
    """theta given phi, trajectories marginalised."""
    matrix, pull, active, alpha = natural(form, posed, phi)
    factor, inverse = linalg.factor_and_inverse(matrix)
    return Conditional(inverse.T @ (inverse @ pull), factor, inverse, active, alpha)


def draw_given(form: Form, posed: Quadratic, phi: Phi, key: jax.Array) -> jax.Array:
    """One draw (Q,) of theta given phi: that of `conditional`, without the inverse."""
    matrix, pull, active, _ = natural(form, posed, phi)
    return jnp.where(active, linalg.displace(matrix, pull, normals(key, pull.shape)), 0.0)


def log_prior(form: Form, posed: Quadratic, theta: jax.Array, phi: Phi) -> jax.Array:
    """Log density of theta given phi, up to a constant; only for priors without a spike."""
    alpha, coupling = prior_precision(form, posed, phi)
    proper = alpha > 0
    square = jnp.sum(alpha * theta**2) + theta @ (coupling @ theta)
    return 0.5 * jnp.sum(jnp.log(jnp.where(proper, alpha, 1.0))) - 0.5 * square


def update_inclusions(form: Form, posed: Quadratic, phi: Phi, key: jax.Array, *, backwards: bool) -> Phi:
    """One sweep over the inclusions of a spike and slab, theta integrated out, then as many exchanges of two.

    The covariance of what is in follows each flip by a rank-one update (George, McCulloch 1997, collapsed).
    """
    kind = form.hierarchy
    L = len(kind.spiked)
    learnt = jnp.asarray(kind.spiked)
    alpha, coupling = prior_precision(form, posed, phi)
    matrix, pull = posed.information + coupling + jnp.diag(alpha), posed.pull
    start = conditional(form, posed, phi)
    covariance = jnp.where(linalg.outer(start.active), start.inverse.T @ start.inverse, 0.0)
    share = kind.share(phi)
    odds = jnp.broadcast_to(jnp.log(share) - jnp.log1p(-share), (L,))

    def without(V: jax.Array, m: jax.Array) -> jax.Array:
        column = V[:, m]
        pivot = jnp.where(column[m] > 0, column[m], 1.0)
        return (V - column[:, None] * (column / pivot)[None, :]).at[m].set(0.0).at[:, m].set(0.0)

    def entering(V: jax.Array, m: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Log Bayes factor of m, not in V, and the direction and pivot by which it would enter."""
        towards = (V @ matrix[:, m]).at[m].set(-1.0)
        pivot = -matrix[m] @ towards
        slope = -pull @ towards
        return 0.5 * (jnp.log(alpha[m]) - jnp.log(pivot) + slope**2 / pivot), towards, pivot

    def entered(V: jax.Array, towards: jax.Array, pivot: jax.Array) -> jax.Array:
        return V + towards[:, None] * (towards / pivot)[None, :]

    def flip(V: jax.Array, pick: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
        k, draw = pick
        m = learnt[k]
        bare = jnp.where(V[m, m] > 0, without(V, m), V)
        gain, towards, pivot = entering(bare, m)
        takes = jnp.log(draw) - jnp.log1p(-draw) < odds[k] + gain
        return jnp.where(takes, entered(bare, towards, pivot), bare), None

    def exchange(V: jax.Array, pick: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
        pair, draw = pick
        a, b = learnt[pair[0]], learnt[pair[1]]
        leaves, comes = jnp.where(V[a, a] > 0, a, b), jnp.where(V[a, a] > 0, b, a)
        prefers = jnp.where(V[a, a] > 0, 1.0, -1.0) * (odds[pair[1]] - odds[pair[0]])
        possible = (V[a, a] > 0) != (V[b, b] > 0)
        bare = without(V, leaves)
        (old, _, _), (new, towards, pivot) = entering(bare, leaves), entering(bare, comes)
        takes = possible & (jnp.log(draw) < new - old + prefers)
        return jnp.where(takes, entered(bare, towards, pivot), V), None

    keys = jax.random.split(key, 3)
    flips = (jnp.arange(L), jax.random.uniform(keys[0], (L,)))
    exchanges = (jax.random.randint(keys[1], (L, 2), 0, L), jax.random.uniform(keys[2], (L,)))
    if backwards:
        covariance, _ = jax.lax.scan(exchange, covariance, exchanges)
        covariance, _ = jax.lax.scan(flip, covariance, flips, reverse=True)
    else:
        covariance, _ = jax.lax.scan(flip, covariance, flips)
        covariance, _ = jax.lax.scan(exchange, covariance, exchanges)
    return phi | {"included": jnp.diagonal(covariance)[learnt] > 0}


@jax.custom_vjp
def whiten(matrix: jax.Array, alpha: jax.Array, pull: jax.Array, eta: jax.Array) -> tuple[jax.Array, jax.Array]:
    """theta (Q,) of unit normals eta (Q,) for the Gaussian of precision matrix + diag(alpha), and its log volume.

    Differentiable by alpha and eta alone: matrix and pull belong to the frame. The factor's derivative is written as
    products, without triangular solves.
    """
    return _whiten(matrix, alpha, pull, eta)[0]


def _whiten(matrix: jax.Array, alpha: jax.Array, pull: jax.Array, eta: jax.Array) -> Any:
    _, inverse = linalg.factor_and_inverse(matrix + jnp.diag(alpha))
    mean = inverse.T @ (inverse @ pull)
    volume = jnp.sum(jnp.log(jnp.diagonal(inverse))) + 0.0 * eta[0]  # one each under vmap, as its derivative needs
    found = (mean + inverse.T @ eta, volume)
    return found, (inverse, mean, eta)


def _whiten_back(saved: Any, slopes: tuple[jax.Array, jax.Array]) -> tuple[Any, ...]:
    inverse, mean, eta = saved
    by_theta, by_volume = slopes
    a = inverse @ by_theta
    half = jnp.tril(eta[:, None] * a[None, :], -1) + 0.5 * jnp.diag(eta * a)
    through = jnp.sum(inverse * (half @ inverse), 0)
    by_alpha = -(inverse.T @ a) * mean - through - 0.5 * by_volume * jnp.sum(inverse**2, 0)
    return jnp.zeros_like(inverse), by_alpha, jnp.zeros_like(mean), a


whiten.defvjp(_whiten, _whiten_back)
