"""Variational inference: a Gaussian guide fitted to the joint posterior in the coordinates of its reference.

Each chain is one optimisation from its own start; r_hat over them says whether they agree. The gradient is that of
the reparametrised bound without the score of the guide, whose variance vanishes where the guide fits (Roeder, Wu,
Duvenaud 2017, "Sticking the landing"); steps by Adam (Kingma, Ba 2015) that shrink to nothing.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from probcal.errors import InputError
from probcal.gaussian.search import chosen
from probcal.inference.chains import Sample
from probcal.inference.coordinates import Free, parts
from probcal.inference.framed import FramedSampler
from probcal.inference.guides import Guide, GuideParameters, Structured
from probcal.inference.hierarchy import Phi
from probcal.inference.posed import Form, Posed, prior_precision
from probcal.priors import Horseshoe, Prior

DECAY, SQUARE = 0.9, 0.999  # of Adam: memory of the gradients and of their squares
STEEP = 2.0  # steps are at most slope / STEEP long: a coordinate of unit spread settles instead of swinging
SMOOTH = 0.95  # of the running bound


class Optimisation(NamedTuple):
    """The state of one optimisation."""

    fitted: GuideParameters
    slope: GuideParameters  # running mean of the gradients
    square: GuideParameters  # and of their squares
    steps: jax.Array  # done, those that draw included
    bound: jax.Array  # running evidence lower bound
    trace: jax.Array  # (warmup,) the running bound of each step
    key: jax.Array


@dataclass(frozen=True)
class SVI(FramedSampler):
    """A Gaussian approximation of the joint posterior by stochastic variational inference, quicker than `NUTS`.

    The guide has full rank over biases and hyper-parameters, given which each trajectory has a block-tridiagonal
    precision: that of the linearised problem. Guides of other families are in `benchmarks/papers/guides.py`.
    Each of `chains` takes `warmup` Adam steps of length `rate` with `particles` draws each, then `draws` from its
    guide. Sample statistics: `log_weight`, log p - log q of each draw, and `elbo`, the running lower bound of the log
    evidence along the warm-up, spread over the draws. Raises `InputError` for settings outside their ranges.
    """

    chains: int = 4
    warmup: int = 800
    draws: int = 500
    rate: float = 0.05
    particles: int = 4

    name = "SVI"
    priors = (Horseshoe, Prior)
    chunk = 50
    roomy = False
    exact = False
    intervals = "quantiles of a variational approximation: too narrow where the guide does not fit, see k-hat"

    def __post_init__(self):
        super().__post_init__()
        if not (self.warmup >= 1 and self.particles >= 1 and np.isfinite(self.rate) and self.rate > 0):
            raise InputError(
                f"SVI(warmup={self.warmup}, rate={self.rate}, particles={self.particles}): at least one step of at"
                f" least one particle is needed, at a positive rate"
            )

    def first(self, form: Form, posed: Posed, theta: jax.Array, phi: Phi, key: jax.Array) -> Optimisation:
        """An optimisation that starts at phi and the posterior of the reference."""
        eps = tuple(jnp.zeros_like(x) for x in posed.frame.point.states)
        return self.begun(form, posed, Free(form.hierarchy.relax(phi), jnp.zeros_like(theta), eps), 0.0, key)

    def begun(self, form: Form, posed: Posed, mean: Free, log_scale: float, key: jax.Array) -> Optimisation:
        """An optimisation whose guide starts at a mean, with one log scale for all coordinates."""
        keys = jax.random.split(key)
        flat = ravel_pytree(mean)[0]
        rest = self.guide(form, posed).first(flat.shape[0], keys[0])
        fitted = GuideParameters(flat, jnp.full_like(flat, log_scale), rest)
        zero = jax.tree.map(jnp.zeros_like, fitted)
        return Optimisation(
            fitted, zero, zero, jnp.zeros((), int), jnp.full((), -jnp.inf), jnp.zeros(self.warmup), keys[1]
        )

    def step(self, form: Form, posed: Posed, chain: Optimisation) -> tuple[Optimisation, Sample]:
        """One step of Adam until `warmup` of them are done, and one draw of the guide."""
        keys = jax.random.split(chain.key, 3)
        moved = jax.lax.cond(
            chain.steps < self.warmup, lambda: self._improved(form, posed, chain, keys[0]), lambda: chain
        )
        guide = self.guide(form, posed)
        n = jax.random.normal(keys[1], (1, moved.fitted.mean.shape[0]))
        sample, density = self._sample(form, posed, guide.place(moved.fitted, n)[0])
        drawn = jnp.clip(moved.steps - self.warmup, 0, self.draws - 1)
        stats = {
            "log_weight": density - guide.log_density(moved.fitted, n)[0],
            "elbo": moved.trace[(drawn * self.warmup) // self.draws],
        }
        return moved._replace(steps=chain.steps + 1, key=keys[2]), sample._replace(stats=stats)

    def _improved(self, form: Form, posed: Posed, chain: Optimisation, key: jax.Array) -> Optimisation:
        """One step of Adam up the bound; a gradient that is not finite is left out."""
        guide, fitted = self.guide(form, posed), chain.fitted
        half = jax.random.normal(key, ((self.particles + 1) // 2, fitted.mean.shape[0]))
        n = jnp.concatenate([half, -half])[: self.particles]
        density = self._density(form, posed)
        still = guide.slope(fitted, n)

        def bound(fitted: GuideParameters) -> tuple[jax.Array, jax.Array]:
            x = guide.place(fitted, n)
            value = jax.vmap(density)(x)
            return jnp.mean(value - jnp.sum(still * x, 1)), jnp.mean(value - guide.log_density(fitted, n))

        gradient, value = jax.grad(bound, has_aux=True)(fitted)
        sound = jnp.isfinite(value) & jnp.all(jnp.asarray([jnp.isfinite(g).all() for g in jax.tree.leaves(gradient)]))
        t = chain.steps + 1.0
        rate = self.rate * 0.5 * (1 + jnp.cos(jnp.pi * chain.steps / self.warmup))
        slope = jax.tree.map(lambda m, g: DECAY * m + (1 - DECAY) * g, chain.slope, gradient)
        square = jax.tree.map(lambda s, g: SQUARE * s + (1 - SQUARE) * g**2, chain.square, gradient)
        fitted = jax.tree.map(
            lambda p, m, s: p + rate * (m / (1 - DECAY**t)) / (jnp.sqrt(s / (1 - SQUARE**t)) + STEEP * self.rate),
            fitted, slope, square,
        )  # fmt: skip
        mean = jnp.where(jnp.isfinite(chain.bound), SMOOTH * chain.bound + (1 - SMOOTH) * value, value)
        found = chain._replace(fitted=fitted, slope=slope, square=square, bound=mean)
        found = chosen(sound, found, chain)
        return found._replace(trace=found.trace.at[chain.steps].set(found.bound))

    def guide(self, form: Form, posed: Posed) -> Guide:
        """The family of densities."""
        free = self.template(form, posed)
        return Structured(sum(leaf.size for leaf in jax.tree.leaves(free)) - sum(e.size for e in free.eps))

    def drawn(self, form: Form, posed: Posed, free: Free) -> tuple[Sample, jax.Array]:
        """The sample that coordinates represent, and their log density up to a constant."""
        found = parts(form, posed, free)
        return Sample(found.theta, free.eps, found.phi, found.joint, {}), found.density

    def template(self, form: Form, posed: Posed) -> Free:
        """Coordinates of the right shapes."""
        kind = form.hierarchy
        phi = jax.eval_shape(lambda: kind.relax(kind.draw(jax.random.PRNGKey(0))))
        zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape), phi)
        return Free(
            zeros, jnp.zeros_like(posed.frame.theta), tuple(jnp.zeros_like(x) for x in posed.frame.point.states)
        )

    def _density(self, form: Form, posed: Posed) -> Any:
        """Log density of flat coordinates."""
        back = ravel_pytree(self.template(form, posed))[1]

        def density(x: jax.Array) -> jax.Array:
            sample, value = self.drawn(form, posed, back(x))
            return value + _constant(form, posed, sample.phi)

        return density

    def _sample(self, form: Form, posed: Posed, x: jax.Array) -> tuple[Sample, jax.Array]:
        """The sample that flat coordinates represent, and their log density."""
        sample, density = self.drawn(form, posed, ravel_pytree(self.template(form, posed))[1](x))
        return sample, density + _constant(form, posed, sample.phi)


def _constant(form: Form, posed: Posed, phi: Phi) -> jax.Array:
    """The constant that the log densities of theta and the noises omit: with it the bound is one of
    the log evidence.

    A flat prior counts as one.
    """
    alpha, _ = prior_precision(form, posed, phi)
    normal = jnp.sum(alpha > 0) + sum(x.size for x in posed.frame.point.states)
    return 0.5 * posed.first.logdet - 0.5 * np.log(2 * np.pi) * normal
