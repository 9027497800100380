"""Collapsed sampling: trajectories marginalised by the frame, Gibbs on what is left, every draw made exact.

One draw: leaps of hyper-parameters and biases together by Gibbs sweeps on the frame's Gaussian likelihood; the
hyper-parameters drawn anew; then a Hamiltonian swing of biases and all trajectories.
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal.errors import InputError
from probcal.gaussian.frame import log_weight
from probcal.gaussian.search import chosen
from probcal.inference.chains import Sample
from probcal.inference.draws import accepted
from probcal.inference.framed import FramedSampler
from probcal.inference.gibbs import draw_hyper
from probcal.inference.hierarchy import Phi
from probcal.inference.leaps import Place, leap
from probcal.inference.orbits import roam
from probcal.inference.posed import Conditional, Form, Posed, conditional, prior_precision
from probcal.inference.sampler import Sampler
from probcal.model.trajectories import States
from probcal.priors import Horseshoe, Prior

LEAPS = 4  # tries before a swing, which costs more than all of them
STEP = 1.3  # of a swing, over the fourth root of the dimension (Beskos and others 2013)


class CollapsedState(NamedTuple):
    """The state of a chain."""

    theta: jax.Array
    eps: States
    phi: Phi
    weight: jax.Array  # log weight of theta and eps
    key: jax.Array


def hmc_step(
    posed: Posed, chain: CollapsedState, given: Conditional, key: jax.Array
) -> tuple[jax.Array, States, jax.Array, jax.Array]:
    """Hamiltonian step of theta and eps given phi, a quarter turn in the frame's coordinates.

    Returns theta, eps, log weight and whether the step was taken. Its steps are short enough for many epochs that
    together leave the frame.
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
    taken = accepted(keys[2], gain)
    return *chosen(taken, (place(last), last[1], weight), (chain.theta, chain.eps, chain.weight)), taken


@dataclass(frozen=True)
class Collapsed(FramedSampler):
    """Exact posterior of biases, hyper-parameters and trajectories, sampled with the trajectories marginalised.

    Conjugate Gibbs for scale mixtures and for the Bernoulli-Gaussian, `sweeps` of it (None: as pays for the prior)
    a leap of each of `chains`, four leaps a draw. Biases and trajectories also move together, by a Hamiltonian swing.
    Where the frame fits badly it is moved; where that fails the joint sampler `NUTS` takes over if it has the prior.
    Where draws have not mixed every second one is kept of twice as many steps, up to one of
    `patience`. Raises `InputError` for less than one sweep or step.
    """

    chains: int = 4
    warmup: int = 100
    draws: int = 500
    sweeps: int | None = None
    patience: int = 16
    effective: int = 0

    name = "Collapsed"
    priors = (Horseshoe, Prior)
    atoms = True
    crosses = True
    roams = True
    chunk = 50

    def __post_init__(self):
        super().__post_init__()
        for name, value in (("sweeps", self.sweeps), ("patience", self.patience)):
            if value is not None and value < 1:
                raise InputError(f"Collapsed({name}={value}): it must be at least 1")

    def kernel(self) -> "Collapsed":
        """The method whatever the number of its chains and draws."""
        return replace(self, chains=1, warmup=0, draws=1, patience=1, effective=0)

    def instead(self, prior: Prior, fallback: Any) -> Sampler | None:
        """The fallback where it has the prior."""
        own = dict[str, int]()
        if self.effective:  # as of `MCMC`
            own = {"warmup": 2 * self.warmup, "patience": self.patience, "effective": self.effective}
        return replace(fallback, chains=self.chains, draws=self.draws, **own) if fallback.takes(prior) else None

    def first(self, form: Form, posed: Posed, theta: jax.Array, phi: Phi, key: jax.Array) -> CollapsedState:
        """A chain at a draw of the frame's posterior."""
        keys = jax.random.split(key, len(posed.frame.loops) + 1)
        eps = posed.frame.normals(keys)
        weight = log_weight(posed.model, posed.frame, theta, eps)
        return CollapsedState(theta, eps, phi, weight, keys[-1])

    def step(self, form: Form, posed: Posed, chain: CollapsedState) -> tuple[CollapsedState, Sample]:
        """One draw."""
        key, *keys = jax.random.split(chain.key, 5)
        at, rate = leap(
            form, posed, self.place(form, posed, chain), keys[0], LEAPS, self.sweeps or form.hierarchy.sweeps
        )
        phi = draw_hyper(form, at.phi, at.theta, keys[1])
        given = conditional(form, posed, phi)
        theta, eps, weight, swung = hmc_step(posed, chain._replace(**at._asdict()), given, keys[2])
        at, roamed = roam(form, posed, Place(theta, eps, phi, weight), keys[3])
        joint = at.weight + posed.frame.log_likelihood(at.theta) - 0.5 * sum(jnp.sum(e**2) for e in at.eps)
        stats = {"acceptance_rate": rate, "swung": swung, "log_weight": at.weight}
        stats |= {"roamed": roamed} if posed.orbits else {}
        return CollapsedState(*at, key), Sample(at.theta, at.eps, at.phi, joint, stats)

    def place(self, form: Form, posed: Posed, chain: CollapsedState) -> Place:
        """The position of a chain."""
        return Place(chain.theta, chain.eps, chain.phi, chain.weight)

    def put(self, form: Form, posed: Posed, chain: CollapsedState, at: Place) -> CollapsedState:
        """The chain at another place."""
        return CollapsedState(*at, chain.key)

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
