"""The proposals that move a particle to an epoch, and the log weight that it gains there."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from probcal import linalg
from probcal.errors import InputError
from probcal.model.epochs import Epoch, State
from probcal.model.model import Model
from probcal.particles.settings import ParticleSettings

LOST = -1e12  # log weight of a particle that cannot be: were all lost, they would count alike
STEPS = {"bootstrap": 0, "extended": 1, "laplace": 5}  # of Gauss-Newton


def log_rows(model: Model, epoch: Epoch, x: State, z: jax.Array, levels: jax.Array) -> jax.Array:
    """Log likelihood () of the rows of an epoch, finite whatever they are."""
    total = sum((jnp.sum(part) for part in model.log_likelihood_at(epoch, x, z, levels)), jnp.zeros(()))
    return jnp.where(jnp.isnan(total), LOST, jnp.clip(total, LOST, -LOST))


def steps_of(model: Model, how: ParticleSettings, conditional: bool) -> int:
    """Gauss-Newton steps of the proposal for the targets of one recursion, 0 where it is the motion itself.

    A heavy tail draws its precisions first, so that a given state has no weight: it is then proposed by the motion.
    """
    if how.proposal != "auto":
        return STEPS[how.proposal]
    linear = model.sampled[0] is None and not (conditional and model.tailed)
    return STEPS["extended"] if linear else 0


def propagated(
    model: Model, how: ParticleSettings, key: jax.Array, x: State, epoch: Epoch, z: jax.Array, levels: jax.Array,
    conditional: bool = False,
) -> tuple[State, jax.Array]:  # fmt: skip
    """A state drawn for an epoch from that before it, and the log weight gained."""
    steps = steps_of(model, how, conditional)
    if not steps:
        after = model.step(key, x, epoch, levels)
        return after, log_rows(model, epoch, after, z, levels)
    return guided(model, steps, key, x, epoch, z, levels, None)


def gained(
    model: Model, how: ParticleSettings, before: State, after: State, epoch: Epoch, z: jax.Array, levels: jax.Array
) -> jax.Array:
    """The log weight that a given state gains."""
    steps = steps_of(model, how, True)
    if not steps:
        return log_rows(model, epoch, after, z, levels)
    return guided(model, steps, jax.random.key(0), before, epoch, z, levels, after)[1]


def guided(
    model: Model, steps: int, key: jax.Array, x: State, epoch: Epoch, z: jax.Array, levels: jax.Array,
    given: State | None,
) -> tuple[State, jax.Array]:  # fmt: skip
    """A state drawn from a Gaussian around the mode of its noise given the rows, and its log weight.

    The noise u ~ N(0, I) is what is drawn, so that a motion whose noise leaves out a direction is as good as another;
    a scale mixture draws its precisions first. `given` is a state that is weighed in place of a draw.
    """
    (states,), move = x, epoch.move[0]
    keys = jax.random.split(key)
    root = move.L * jnp.concatenate([jnp.exp(levels), jnp.ones(1, levels.dtype)])[move.level][None, :]
    for k, (tail, on) in enumerate(zip(model.recursions[0].tails, move.mixed, strict=True)):
        precision = jnp.where(on, tail.family.mixing_draw(jax.random.fold_in(keys[1], k), ()), 1.0)
        root = root.at[:, slice(*tail.columns)].divide(jnp.sqrt(precision))
    mean = move.F @ states[0] + move.drift

    def at(u: jax.Array) -> State:
        return ((mean + root @ u)[None],)

    def system(u: jax.Array) -> tuple[jax.Array, jax.Array]:
        lins = model.linearise_at(epoch, at(u), z, levels, expected=True)
        J, score = jnp.eye(len(u)), -u
        for lin in lins:
            by_u = lin.state @ root
            J = J + jnp.einsum("pcu,pc,pcv->uv", by_u, lin.weight, by_u)
            score = score + jnp.einsum("pcu,pc->u", by_u, lin.score)
        sound = jnp.all(jnp.isfinite(J)) & jnp.all(jnp.isfinite(score))  # a sensor may have no value here
        return jnp.where(sound, J, jnp.eye(len(u))), jnp.where(sound, score, -u)

    mode = jnp.zeros(root.shape[1])
    for _ in range(steps):
        J, score = system(mode)
        step = linalg.solve_positive(J, score)
        mode = mode + jnp.where(jnp.isfinite(step), step, 0.0)
    lower, inverse = linalg.factor_and_inverse(J)
    if given is None:
        white = jax.random.normal(keys[0], mode.shape)
        u = mode + inverse.T @ white
    else:
        u = linalg.shortest_drive(given[0][0] - mean, root)
        white = lower.T @ (u - mode)
    after = at(u) if given is None else given
    fit = 0.5 * jnp.sum(white**2) - 0.5 * jnp.sum(u**2) - jnp.sum(jnp.log(jnp.diagonal(lower)))
    gain = jnp.clip(jnp.where(jnp.isnan(fit), LOST, fit), LOST, -LOST)
    return after, jnp.maximum(log_rows(model, epoch, after, z, levels) + gain, LOST)


def check_proposal(model: Model, how: ParticleSettings, *, conditional: bool = False) -> None:
    """Raise `InputError` where a proposal asks for what a motion does not have."""
    if how.proposal in ("auto", "bootstrap"):
        return
    try:
        model.check_linear()
    except InputError as error:
        raise InputError(f'Particles(proposal="{how.proposal}"): {error}; take proposal="bootstrap"') from None
    if conditional and model.tailed:
        raise InputError(
            f'Particles(proposal="{how.proposal}"): a process noise with heavy tails has no density by which a given'
            ' state is weighed; take proposal="bootstrap"'
        )


def lost(log_weights: Any) -> Any:
    """True if all particles of an epoch are lost, by their log weights (..., M)."""
    return jnp.max(log_weights, -1) <= 0.5 * LOST
