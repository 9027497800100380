"""Paper B as printed: the smoothed density of each epoch alone stands for the trajectory, so that the data count twice.

    uv run python benchmarks/papers/paper_b.py

A linear network: sds of its biases by Paper B over those of `EA.as_printed()`, which has the trajectory once.
"""

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

import probcal as pc
from probcal import linalg
from probcal.gaussian import recursion as rec
from probcal.gaussian.linearised import LaplaceApproximation
from probcal.gaussian.mode import Point, compress, factors, log_likelihood, smooth_tracks
from probcal.inference.ea import learnt
from probcal.inference.method import Given, State
from probcal.inference.run import valued
from probcal.model.model import Model
from probcal.priors import Precision, Prior


def paper_b(model: Model, point: Point, prior: Precision) -> tuple[LaplaceApproximation, jax.Array]:
    """Paper B (10)-(17), (22)-(23) at smoothed trajectories: the posterior of z, and the step to its mean.

    The smoothed density of each epoch alone is taken as the prior of its state, R-bar = R + H_x P H_x'; what
    epochs share is dropped and the data count twice. By Woodbury no matrix of the size of the data is formed.
    """
    lins = model.linearise(point, expected=True)
    compressed = compress(model, lins)
    information, score = compressed.information, compressed.score
    likelihood, logdet = log_likelihood(model, point), jnp.zeros(())
    parts = zip(model.recursions, compressed.states, compressed.crosses, strict=True)
    for r, (part, (J, pull), cross) in enumerate(parts):
        L = factors(part, point.levels)
        P, _ = rec.covariances(part.F, L, rec.gains(part.F, L, J, model.entries(r)))
        values, vectors = linalg.spectrum(P)
        half = vectors * jnp.sqrt(jnp.maximum(values, 0.0))[:, None, :]
        inner = jnp.eye(P.shape[-1])[None] + half.mT @ J @ half
        inverse = jax.vmap(linalg.inverse_cholesky)(inner)
        seen, pulled = inverse @ (half.mT @ cross), (inverse @ (half.mT @ pull[:, :, None]))[:, :, 0]
        information = information - jnp.einsum("eni,enj->ij", seen, seen)
        score = score - jnp.einsum("eni,en->i", seen, pulled)
        likelihood = likelihood + 0.5 * jnp.sum(pulled**2)
        logdet = logdet - 2.0 * jnp.sum(jnp.log(jnp.diagonal(inverse, axis1=1, axis2=2)))
    information = 0.5 * (information + information.T)
    covariance, spread = linalg.inverse_and_logdet(information + prior.matrix())
    slope = score - prior.pull(point.z)
    step = covariance @ slope
    own = 0.5 * prior.log_determinant() - 0.5 * prior.square(point.z)
    evidence = likelihood + own + 0.5 * slope @ step - 0.5 * (logdet + spread)
    evidence = evidence - 0.5 * jnp.sum((point.levels / model.level_spread) ** 2)
    gamma = jnp.clip(1.0 - prior.alpha * jnp.diagonal(covariance), 0.0, 1.0)
    return LaplaceApproximation(information, covariance, gamma, evidence), step


@dataclass(frozen=True)
class PaperB(pc.EA):
    """`EA` that smooths at the current biases, then takes their posterior (16)-(17) for the precisions (25)."""

    iterations: int = 25
    trajectory: str = "joint"
    precisions: str = "maximised"

    plugged: ClassVar[str] = pc.EA.plugged + "; the data count twice (Paper B as printed)"

    def begin(self, model: Model, start: Point) -> tuple:
        """Nothing that is kept from one iteration to the next."""
        return ()

    def iterate(self, model: Model, prior: Prior, given: Given, state: State) -> State:
        """Smoothed trajectory, evidence, new precisions."""
        model, state = learnt(model, prior, given, state, self.update)
        point = smooth_tracks(model, state.point)
        found, step = paper_b(model, point, given.prior._replace(alpha=state.alpha))
        refused = state.refused & ~jnp.all(jnp.isfinite(step))
        step = jnp.where(jnp.isfinite(step), jnp.clip(step, -1.0, 1.0), 0.0)
        done = (jnp.abs(found.evidence - state.objective) < given.tolerance) & (jnp.max(jnp.abs(step)) < 1e-3)
        point = point._replace(z=point.z + step)
        state = state._replace(point=point, found=found, objective=found.evidence, refused=refused, done=done)
        return valued(prior, given, state)


@pc.sensor(x=pc.Channel("m", std=1.0), y=pc.Channel("m", std=1.0))
def fix(target, pose, *, east=pc.Bias("m", 2.0), north=pc.Bias("m", 2.0)):
    """A position, linear in all."""
    line = target.position - pose.position
    return dict(x=line[0] + east, y=line[1] + north)


def main() -> None:
    """Print sds by Paper B over those with the trajectory counted once."""
    network = pc.Network([fix.on(pc.Node(f"n{k}", place)) for k, place in enumerate([(0, 0), (5, 0), (0, 5)])])
    motion = pc.Target(pc.ConstantVelocity(0.8), {"position": ((1.0, -1.0), 6.0), "velocity": ((0.3, 0.3), 1.5)})
    table = pc.simulate(network, motion, np.arange(20.0), key=0, biases={"n1.east": 3.0, "n2.north": -4.0}).table
    problem = pc.Problem(network, motion, table)
    once, twice = (pc.fit(problem, method)["calibration"].to_dataset() for method in (pc.EA.as_printed(), PaperB()))
    kept = once["gamma"].values > 0.5
    ratio = (twice["sd"] / once["sd"]).values[kept]
    print(
        f"{kept.sum()} biases that the data show: sd by Paper B {ratio.min():.2f} to {ratio.max():.2f} of the sd once"
    )


if __name__ == "__main__":
    main()
