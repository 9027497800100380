"""Draws of a chain, and the kernels that run many steps of it between two checkpoints."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from probcal.devices import over_devices
from probcal.gaussian.frame import place
from probcal.gaussian.search import chosen, zeros_from
from probcal.inference.draws import accepted
from probcal.inference.hierarchy import Phi
from probcal.inference.posed import Form, Posed, conditional, log_prior
from probcal.inference.sides import Sided, shifted, side_of
from probcal.model.trajectories import States


class Sample(NamedTuple):
    """One draw as a sampler sees it, and what it says about itself."""

    theta: jax.Array  # (Q,)
    eps: States
    phi: Phi
    joint: jax.Array  # () log density of data and eps given theta
    stats: dict[str, jax.Array]


class Draw(NamedTuple):
    """One draw as it is kept; a pytree of arrays, with leading dims (draws,) in a chunk."""

    theta: jax.Array  # (Q,) biases, log levels
    phi: Phi
    gamma: jax.Array  # (M,) 1 - alpha Sigma given phi
    variance: jax.Array  # (M,) of each z given phi
    states: States  # (E, n) of each recursion
    density: jax.Array  # () log density of data, eps and theta given phi
    stats: dict[str, jax.Array]


def keep(form: Form, posed: Posed, sample: Sample) -> Draw:
    """The stored values of a draw: gamma and variance given its hyper-parameters, trajectories."""
    M = form.biases
    given = conditional(form, posed, sample.phi)
    variance = given.variance[:M]
    gamma = jnp.where(given.active[:M], jnp.clip(1.0 - given.alpha[:M] * variance, 0.0, 1.0), 0.0)
    point = place(posed.model, posed.frame, sample.theta, sample.eps)
    density = sample.joint + log_prior(form, posed, sample.theta, sample.phi)
    return Draw(sample.theta, sample.phi, gamma, variance, point.states, density, sample.stats)


def repeated(step: Callable[[Any], tuple[Any, Sample]], state: Any, thin: jax.Array) -> tuple[Any, Sample]:
    """The state after `thin` steps, and the last draw."""
    return jax.lax.fori_loop(0, thin, lambda _, at: step(at[0]), (state, zeros_from(step, state)[1]))


@partial(jax.jit, static_argnames=("method", "form"))
def run_chunk(method: Any, form: Form, posed: Posed, chain: Any, thin: jax.Array) -> tuple[Any, Draw]:
    """`method.chunk` draws of one chain, `thin` steps apart; leading dims of the draws are (chunk,)."""

    def one(chain: Any, _: None) -> tuple[Any, Draw]:
        chain, sample = repeated(partial(method.step, form, posed), chain, thin)
        return chain, keep(form, posed, sample)

    return jax.lax.scan(one, chain, None, length=method.chunk)


@partial(jax.jit, static_argnames=("method", "form"))
def run_sided(method: Any, form: Form, sides: Posed, state: Sided, thin: jax.Array) -> tuple[Sided, Draw]:
    """Draws of one chain as in `run_chunk`, each step followed by attempts to cross to another side.

    The first keeps hyper-parameters and the coordinates that the frame of a side whitens, an involution between any two
    sides, and is accepted by the joint density there (`method.across`); the second is a shift (`shifted`).
    """
    count = jax.tree.leaves(sides.frame)[0].shape[0]

    def by_coordinates(here: Posed, there: Posed, chain: Any) -> tuple[Any, jax.Array]:
        return method.across(form, here, there, chain)

    def by_shift(here: Posed, there: Posed, chain: Any) -> tuple[Any, jax.Array]:
        at, gain = shifted(form, here, there, method.place(form, here, chain))
        return method.put(form, there, chain, at), gain

    def step(state: Sided) -> tuple[Sided, Sample]:
        here = side_of(sides, state.side)
        chain, sample = method.step(form, here, state.chain)
        side, (key, *keys), crossed = state.side, jax.random.split(state.key, 3), jnp.zeros((), bool)
        for way, own in zip((by_coordinates, by_shift), keys, strict=True):
            pick, lot = jax.random.split(own)
            other = (side + 1 + jax.random.randint(pick, (), 0, count - 1)) % count
            moved, gain = way(side_of(sides, side), side_of(sides, other), chain)
            taken = accepted(lot, gain)
            chain, side = chosen(taken, (moved, other), (chain, side))
            crossed = crossed | taken
        stats = sample.stats | {"side": state.side, "crossed": crossed}
        return Sided(chain, side, key), sample._replace(stats=stats)

    def one(state: Sided, _: None) -> tuple[Sided, Draw]:
        state, sample = repeated(step, state, thin)
        return state, keep(form, side_of(sides, sample.stats["side"]), sample)

    return jax.lax.scan(one, state, None, length=method.chunk)


@partial(jax.jit, static_argnames=("run", "method", "form"))
def run_together(
    run: Callable[..., tuple[Any, Draw]], method: Any, form: Form, posed: Posed, states: Any, thin: jax.Array
) -> tuple[Any, Draw]:
    """All chains, leading dim (chains,), by `run_chunk` or `run_sided`, on all devices."""
    return over_devices(jax.vmap(lambda state: run(method, form, posed, state, thin)), states)
