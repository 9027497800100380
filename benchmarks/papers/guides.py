"""SVI with the usual guides, mean field and low rank, in coordinates that know nothing of the posterior.

    uv run python benchmarks/papers/guides.py

A linear network with an exact posterior: the independent normals of a mean field have the conditional variances
(Bishop 2006, 10.2), too narrow where biases are correlated; a covariance of low rank holds most of them. Printed are
sds over the exact ones and the bounds of the log evidence, of both and of `SVI()`.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import probcal as pc
from probcal import linalg
from probcal.gaussian.frame import log_joint, place, unit_normals
from probcal.gaussian.mode import Point, factors, mixed_density
from probcal.gaussian.recursion import trajectory
from probcal.inference.chains import Sample
from probcal.inference.coordinates import Free
from probcal.inference.guides import Guide
from probcal.inference.hierarchy import Phi
from probcal.inference.posed import Form, Posed, log_prior, prior_precision, whiten
from probcal.inference.svi import Optimisation

NARROW = 0.1  # scale of the coordinates to start from


class Plain(NamedTuple):
    """What plain coordinates stand for."""

    theta: jax.Array
    phi: Phi
    point: Point
    density: jax.Array  # of the coordinates


def noncentred(form: Form, posed: Posed, free: Free) -> Plain:
    """Biases, hyper-parameters and trajectories of non-centred coordinates that know nothing of the frame.

    eta is theta over its prior sd (a declared scale where the prior is flat), eps the whitened noises of the problem.
    """
    model = posed.model
    phi, hyper = form.hierarchy.constrain(free.phi)
    matrix, alpha = _prior_matrix(form, posed, phi)
    theta, volume = whiten(matrix, alpha, jnp.zeros_like(alpha), free.eta)
    levels = theta[form.biases :]
    tracks = zip(model.recursions, free.eps, strict=True)
    states = tuple(trajectory(p.F, factors(p, levels), p.drift[:, :, None], u[:, :, None])[:, :, 0] for p, u in tracks)
    point = Point(states, free.eps, theta[: form.biases], levels)
    density = hyper + volume + log_prior(form, posed, theta, phi) + mixed_density(model, point)
    return Plain(theta, phi, point, jnp.where(jnp.isfinite(density), density, -jnp.inf))


def _prior_matrix(form: Form, posed: Posed, phi: Phi) -> tuple[jax.Array, jax.Array]:
    """Coupling (Q, Q) and precisions (Q,) of theta, one where flat."""
    alpha, coupling = prior_precision(form, posed, phi)
    return coupling, jnp.where(alpha > 0, alpha, 1.0)


@dataclass(frozen=True)
class MeanField(Guide):
    """Independent normals."""

    def first(self, size, key):
        """Nothing."""
        return ()

    def turned(self, rest, n):
        """The draws themselves."""
        return n

    def pulled(self, rest, n):
        """That of unit normals."""
        return -n

    def volume(self, rest, n):
        """Zero."""
        return jnp.zeros(n.shape[0])


@dataclass(frozen=True)
class LowRank(Guide):
    """A normal with f = I + U U', U (D, rank): a diagonal covariance and one of low rank, in scaled entries."""

    rank: int

    def first(self, size, key):
        """Small random directions: at zero they have no slope. U is kept times the root of D."""
        return (0.1 * jax.random.normal(key, (size, self.rank)),)

    def _directions(self, rest: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array]:
        U = rest[0] / np.sqrt(rest[0].shape[0])
        return U, jnp.eye(self.rank) + U.T @ U

    def turned(self, rest, n):
        """The draws, widened along the directions."""
        U, _ = self._directions(rest)
        return n + (n @ U) @ U.T

    def pulled(self, rest, n):
        """By the identity of Woodbury."""
        U, gram = self._directions(rest)
        return linalg.solve_positive(gram, (n @ U).T).T @ U.T - n

    def volume(self, rest, n):
        """Log determinant of I + U'U."""
        return jnp.broadcast_to(linalg.inverse_and_logdet(self._directions(rest)[1])[1], n.shape[:1])


@dataclass(frozen=True)
class PlainSVI(pc.SVI):
    """`SVI` in plain coordinates: mean field, or with `low_rank` a covariance of the root of their number."""

    low_rank: bool = False

    def first(self, form, posed, theta, phi, key) -> Optimisation:
        """Narrowly around theta and phi."""
        resting = tuple(jnp.zeros_like(x) for x in posed.frame.point.states)
        coupling, alpha = _prior_matrix(form, posed, phi)
        eta = linalg.factor(coupling + jnp.diag(alpha)).T @ theta
        noises = place(posed.model, posed.frame, theta, resting).noises
        mean = Free(form.hierarchy.relax(phi), eta, noises)
        return self.begun(form, posed, mean, float(np.log(NARROW)), key)

    def guide(self, form, posed) -> Guide:
        """A mean field or one of low rank."""
        size = sum(leaf.size for leaf in jax.tree.leaves(self.template(form, posed)))
        return LowRank(round(float(np.sqrt(size)))) if self.low_rank else MeanField()

    def drawn(self, form, posed, free) -> tuple[Sample, jax.Array]:
        """What plain coordinates stand for."""
        at = noncentred(form, posed, free)
        eps = unit_normals(posed.model, posed.frame, at.point)
        return Sample(at.theta, eps, at.phi, log_joint(posed.model, posed.frame, at.theta, eps), {}), at.density


@pc.sensor(x=pc.Channel("m", std=1.0), y=pc.Channel("m", std=1.0))
def fix(target, pose, *, east=pc.Bias("m", 2.0), north=pc.Bias("m", 2.0)):
    """A position, linear in all."""
    line = target.position - pose.position
    return dict(x=line[0] + east, y=line[1] + north)


def main() -> None:
    """Print both guides beside `SVI()` and the exact posterior."""
    network = pc.Network([fix.on(pc.Node(f"n{k}", place)) for k, place in enumerate([(0, 0), (5, 0), (0, 5)])])
    motion = pc.Target(pc.ConstantVelocity(0.8), {"position": ((1.0, -1.0), 6.0), "velocity": ((0.3, 0.3), 1.5)})
    problem = pc.Problem(network, motion, pc.simulate(network, motion, np.arange(6.0), key=0).table)
    exact = pc.summary(pc.fit(problem, pc.MAP()))["sd"]
    for name, method in {
        "structured": pc.SVI(chains=2, warmup=50, draws=500),
        "low rank": PlainSVI(chains=2, warmup=1500, draws=500, low_rank=True),
        "mean field": PlainSVI(chains=2, warmup=1500, draws=500),
    }.items():
        tree = pc.fit(problem, method, prior=pc.Gaussian())
        ratio = pc.summary(tree)["sd"] / exact
        bound = float(tree["sample_stats"]["elbo"].isel(draw=-1).mean())
        print(f"{name:10s} sd over exact {ratio.min():.2f} to {ratio.max():.2f}; log evidence at least {bound:.2f}")


if __name__ == "__main__":
    main()
