"""Collapsed sampling: trajectories marginalised by the frame, Gibbs on what is left, every draw made exact.

One draw: a few Gibbs sweeps on the frame's Gaussian likelihood propose hyper-parameters and biases together
(surrogate transition, Liu 2001; delayed acceptance, Christen, Fox 2005), taken or refused by the weight of the joint
posterior; the hyper-parameters are drawn anew; biases and trajectories then move along an ellipse (Murray, Adams,
MacKay 2010).
"""

from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal.errors import InputError
from probcal.inference.gibbs import reversible_sweeps
from probcal.inference.hierarchy import Phi
from probcal.inference.orbits import Place, roam
from probcal.inference.posed import Conditional, Form, Posed, conditional, prior_precision
from probcal.inference.sampler import Sample, Sampler
from probcal.priors import Horseshoe, Prior
from probcal.smoothing.frame import log_weight

SHRINKINGS = 40  # most times that an ellipse is cut
STEP = 1.3  # of a swing, over the fourth root of the dimension (Beskos and others 2013)


class CollapsedState(NamedTuple):
    """Where a chain stands."""

    theta: jax.Array
    eps: tuple[jax.Array, ...]
    phi: Phi
    weight: jax.Array  # log weight of theta and eps
    key: jax.Array


def elliptical_slice_step(
    form: Form, posed: Posed, chain: CollapsedState, given: Conditional, key: jax.Array
) -> tuple[jax.Array, tuple[jax.Array, ...], jax.Array, jax.Array]:
    """Elliptical slice sampling of theta and eps given phi: new theta, eps, log weight and the tries it took."""
    keys = jax.random.split(key, 4)
    turn = given.deviation(keys[0])
    seeds = jax.random.split(keys[1], len(chain.eps))
    other = tuple(jax.random.normal(k, e.shape) for k, e in zip(seeds, chain.eps, strict=True))
    level = chain.weight - jax.random.exponential(keys[2])
    mean = jnp.where(given.active, given.mean, 0.0)

    def at(angle: jax.Array) -> tuple[jax.Array, tuple[jax.Array, ...]]:
        c, s = jnp.cos(angle), jnp.sin(angle)
        theta = mean + c * (chain.theta - mean) + s * turn
        return theta, tuple(c * e + s * o for e, o in zip(chain.eps, other, strict=True))

    def attempt(state: Any) -> Any:
        low, high, key, tries, _, _ = state
        key, draw = jax.random.split(key)
        angle = low + (high - low) * jax.random.uniform(draw)
        weight = log_weight(posed.model, posed.frame, *at(angle))
        return jnp.where(angle < 0, angle, low), jnp.where(angle < 0, high, angle), key, tries + 1, angle, weight

    start = 2 * jnp.pi * jax.random.uniform(keys[3])
    first = (start - 2 * jnp.pi, start, key, jnp.zeros((), int), jnp.zeros(()), jnp.full((), -jnp.inf, float))
    last = jax.lax.while_loop(lambda s: ~(s[5] >= level) & (s[3] < SHRINKINGS), attempt, first)
    found = last[5] >= level
    theta, eps = at(jnp.where(found, last[4], 0.0))
    return theta, eps, jnp.where(found, last[5], chain.weight), last[3]


def hmc_step(
    form: Form, posed: Posed, chain: CollapsedState, given: Conditional, key: jax.Array
) -> tuple[jax.Array, tuple[jax.Array, ...], jax.Array, jax.Array]:
    """Hamiltonian step of theta and eps given phi, a quarter turn in the frame's coordinates; as `ellipse` returns.

    Its short steps hold where many epochs together leave the frame, and an ellipse could only creep.
    """
    keys = jax.random.split(key, 3)
    free = (given.factor.T @ (chain.theta - given.mean), chain.eps)

    def place(free: Any) -> jax.Array:
        return jnp.where(given.active, given.mean + given.inverse.T @ free[0], 0.0)

    def energy(free: Any) -> tuple[jax.Array, jax.Array]:
        weight = log_weight(posed.model, posed.frame, place(free), free[1])
        return 0.5 * sum(jnp.sum(leaf**2) for leaf in jax.tree.leaves(free)) - weight, weight

    slope = jax.value_and_grad(energy, has_aux=True)
    leaves, shape = jax.tree.flatten(free)
    seeds = jax.random.split(keys[0], len(leaves))
    momentum = jax.tree.unflatten(
        shape, [jax.random.normal(k, leaf.shape) for k, leaf in zip(seeds, leaves, strict=True)]
    )
    momentum = (momentum[0] * given.active, momentum[1])  # what is out stays at 0
    longest = STEP * sum(leaf.size for leaf in leaves) ** -0.25
    count = max(1, round(0.5 * float(np.pi) / longest))
    size = longest * (1.0 - 0.3 * jax.random.uniform(keys[1]))

    def add(a: Any, b: Any, t: Any) -> Any:
        return jax.tree.map(lambda x, y: x + t * y, a, b)

    (before, _), pull = slope(free)

    def leap(state: Any, _: None) -> tuple[Any, None]:
        at, momentum, pull, _ = state
        momentum = add(momentum, pull, -0.5 * size)
        at = add(at, momentum, size)
        value, pull = slope(at)
        return (at, add(momentum, pull, -0.5 * size), pull, value), None

    def kinetic(momentum: Any) -> jax.Array:
        return 0.5 * sum((jnp.sum(leaf**2) for leaf in jax.tree.leaves(momentum)), jnp.zeros(()))

    first = (free, momentum, pull, (before, chain.weight))
    (last, after, _, (value, weight)), _ = jax.lax.scan(leap, first, None, length=count)
    gain = before + kinetic(momentum) - value - kinetic(after)
    taken = jnp.log(jax.random.uniform(keys[2])) < jnp.where(jnp.isfinite(gain), gain, -jnp.inf)
    found = (place(last), last[1], weight), (chain.theta, chain.eps, chain.weight)
    return *jax.tree.map(lambda new, old: jnp.where(taken, new, old), *found), jnp.asarray(count)


MOVES = {"ellipse": elliptical_slice_step, "swing": hmc_step}


@dataclass(frozen=True)
class Collapsed(Sampler):
    """Exact posterior of biases, hyper-parameters and trajectories, sampled with the trajectories marginalised.

    Conjugate Gibbs for scale mixtures and for the Bernoulli-Gaussian, `sweeps` of it (None: as pays for the prior)
    between two draws of each of `chains`. Biases and trajectories also move together, along an "ellipse" or by a
    Hamiltonian "swing". Where the frame fits badly it is moved; where that fails the joint sampler `NUTS` takes over,
    or, for a spike, the swing.
    Raises `InputError` for another move or less than one sweep.
    """

    chains: int = 4
    warmup: int = 100
    draws: int = 500
    sweeps: int | None = None
    move: str = "ellipse"

    name: ClassVar[str] = "Collapsed"
    priors: ClassVar[tuple[type, ...]] = (Horseshoe, Prior)
    atoms: ClassVar[bool] = True
    crosses: ClassVar[bool] = True
    roams: ClassVar[bool] = True
    chunk: ClassVar[int] = 50

    def __post_init__(self):
        super().__post_init__()
        if self.move not in MOVES or (self.sweeps is not None and self.sweeps < 1):
            raise InputError(f'Collapsed(sweeps={self.sweeps}, move="{self.move}"): move is one of {", ".join(MOVES)}')

    def kernel(self) -> "Collapsed":
        """The method whatever the number of its chains and draws."""
        return replace(self, chains=1, warmup=0, draws=1)

    def instead(self, prior: Prior, fallback: Any) -> tuple[Sampler, str]:
        """The fallback where it has the prior, else the swing, which needs no frame that fits."""
        if fallback.takes(prior):
            return replace(fallback, chains=self.chains, draws=self.draws), fallback.name
        return replace(self, move="swing"), "the swing"

    def first(self, form: Form, posed: Posed, theta: jax.Array, phi: Phi, key: jax.Array) -> CollapsedState:
        """A chain at a draw of the frame's posterior."""
        keys = jax.random.split(key, len(posed.frame.loops) + 1)
        pairs = zip(keys, posed.frame.point.states, strict=False)
        eps = tuple(jax.random.normal(k, x.shape) for k, x in pairs)
        weight = log_weight(posed.model, posed.frame, theta, eps)
        return CollapsedState(theta, eps, phi, weight, keys[-1])

    def step(self, form: Form, posed: Posed, chain: CollapsedState) -> tuple[CollapsedState, Sample]:
        """One draw."""
        key, *keys = jax.random.split(chain.key, 6)
        theta, phi = reversible_sweeps(
            form, posed, chain.theta, chain.phi, keys[0], self.sweeps or form.hierarchy.sweeps
        )
        weight = log_weight(posed.model, posed.frame, theta, chain.eps)
        rate = jnp.exp(jnp.minimum(weight - chain.weight, 0.0))
        taken = jax.random.uniform(keys[1]) < rate
        proposed = chain._replace(theta=theta, phi=phi, weight=weight)
        chain = jax.tree.map(lambda new, old: jnp.where(taken, new, old), proposed, chain._replace(key=chain.key))
        phi, learnt = chain.phi, jnp.asarray(form.hierarchy.learnt, int)
        for k, update in enumerate(form.hierarchy.updates()):
            phi = update(phi, chain.theta[learnt], jax.random.fold_in(keys[2], k))
        given = conditional(form, posed, phi)
        theta, eps, weight, tries = MOVES[self.move](form, posed, chain, given, keys[3])
        moved, roamed = roam(form, posed, Place(theta, eps, phi, weight), jax.random.fold_in(keys[4], 0))
        theta, eps, phi, weight = moved
        chain = CollapsedState(theta, eps, phi, weight, key)
        joint = weight + posed.frame.log_likelihood(theta) - 0.5 * sum(jnp.sum(e**2) for e in eps)
        stats = {"acceptance_rate": rate, "tries": tries, "log_weight": weight}
        stats |= {"roamed": roamed} if posed.orbits else {}
        return chain, Sample(theta, eps, phi, joint, stats)

    def across(self, form: Form, here: Posed, there: Posed, chain: CollapsedState) -> tuple[CollapsedState, jax.Array]:
        """theta by the same unit normals on the other side, hyper-parameters and those of the trajectories kept."""
        own, other = conditional(form, here, chain.phi), conditional(form, there, chain.phi)
        eta = own.factor.T @ (chain.theta - own.mean)
        theta = jnp.where(other.active, other.mean + other.inverse.T @ eta, 0.0)
        weight = log_weight(there.model, there.frame, theta, chain.eps)
        alpha, coupling = prior_precision(form, here, chain.phi)

        def value(posed: Posed, given: Conditional, theta: jax.Array, weight: jax.Array) -> jax.Array:
            square = jnp.sum(jnp.where(given.active, alpha, 0.0) * theta**2) + theta @ (coupling @ theta)
            volume = jnp.sum(jnp.log(jnp.diagonal(given.inverse)))
            return weight + posed.frame.log_likelihood(theta) - 0.5 * square + volume

        gain = value(there, other, theta, weight) - value(here, own, chain.theta, chain.weight)
        return chain._replace(theta=theta, weight=weight), gain
