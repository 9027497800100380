"""The belief about biases and targets at one time: a separated augmented Gaussian, by square roots.

Given the biases z the targets are independent, so that the joint Gaussian of z and all states is that of z,
N(mean, root root'), and of each target a line in z with a covariance of its own: x | z ~ N(m + B z, R R') (Friedland
1969). It is the augmented-state filter (thesis 4.3) exactly, but an epoch touches one target and z alone: its cost does
not grow with the number of targets. Where the biases move, targets get correlations beyond those through z, which are
dropped; with one target there are none.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from probcal import linalg
from probcal.model.epochs import Move


class Slots(NamedTuple):
    """The targets of one recursion: x | z ~ N(m + B z, R R')."""

    m: jax.Array  # (T, n)
    B: jax.Array  # (T, n, M)
    R: jax.Array  # (T, n, n)
    shift: jax.Array  # (T, n, C) of x | z by each candidate jump of unit size


class JumpCandidates(NamedTuple):
    """Jumps that may have begun some time ago: what data since say of each (Willsky, Jones 1976)."""

    bias: jax.Array  # (C,) which bias jumps
    response: jax.Array  # (M, C) of the mean of z to a jump of unit size
    information: jax.Array  # (C,)
    score: jax.Array  # (C,)


class Augmented(NamedTuple):
    """Biases and targets at a moment."""

    mean: jax.Array  # (M,) of z
    root: jax.Array  # (M, M) of its covariance, root root'
    slots: tuple[Slots, ...]  # of each recursion
    candidates: JumpCandidates


class WhiteRow(NamedTuple):
    """One datum as a filter takes it: value = x'hx + z'hz + e, e ~ N(0, 1).

    Its residual over the std of its noise is `shift` plus the innovation of that over `ratio`; a
    datum whose residual lies beyond `low` or `high` is held back.
    """

    value: jax.Array  # ()
    hx: jax.Array  # (n,) of its target
    hz: jax.Array  # (M,)
    shift: jax.Array  # ()
    ratio: jax.Array  # ()
    low: jax.Array  # ()
    high: jax.Array  # ()
    verdict: jax.Array  # () DECIDE, ADMIT or HOLD

    def leading(self) -> tuple[jax.Array, jax.Array]:
        """Of several data (D,): the bias on which each depends most, and the change of its prediction by one scale."""
        if not self.hz.size:
            return jnp.zeros(self.value.shape, int), jnp.zeros(self.value.shape)
        lead = jnp.argmax(jnp.abs(self.hz), 1)
        return lead, jnp.take_along_axis(self.hz, lead[:, None], 1)[:, 0] / self.ratio


DECIDE, ADMIT, HOLD = 0, 1, 2  # whether a datum is held back: by its residual, never, always


class KeptDatum(NamedTuple):
    """The terms that the smoother needs per datum: c = g'z + e given the states before."""

    hx: jax.Array  # (n,) over the std of the datum given z
    gain: jax.Array  # (n,) of x by c
    c: jax.Array  # ()
    g: jax.Array  # (M,)
    innovation: jax.Array  # () standardised, with x and z uncertain
    variance: jax.Array  # () of the innovation over that of the noise
    moved: jax.Array  # (M,) by how much the mean of z moved
    residual: jax.Array  # () over the std of noise, state and biases together
    spread: jax.Array  # () this std over that of the noise; 0 where there is no datum
    held: jax.Array  # () whether it was held back: it changed nothing then
    lead: jax.Array | None = None  # () bias on which it depends most
    slope: jax.Array | None = None  # () change of its prediction, over the std of the noise, by one scale of that


@partial(jax.jit, static_argnames="sizes")
def empty(z: jax.Array, root: jax.Array, sizes: tuple[tuple[int, int], ...], bias: jax.Array) -> Augmented:
    """Biases N(z, root root') before any target, `sizes` (T, n) of each recursion, candidates (C,) by their bias."""
    M, C = z.shape[0], bias.shape[0]
    slots = tuple(
        Slots(jnp.zeros((T, n)), jnp.zeros((T, n, M)), jnp.zeros((T, n, n)), jnp.zeros((T, n, C))) for T, n in sizes
    )
    return Augmented(z, root, slots, JumpCandidates(bias, jnp.zeros((M, C)), jnp.zeros(C), jnp.zeros(C)))


def one(slots: Slots, target: jax.Array) -> Slots:
    """One target of a recursion, without the leading dimension."""
    return Slots(*(leaf[target] for leaf in slots))


def put(slots: Slots, target: jax.Array, new: Slots) -> Slots:
    """A recursion with one target replaced."""
    return Slots(*(leaf.at[target].set(own) for leaf, own in zip(slots, new, strict=True)))


def moved_on(own: Slots, move: Move) -> Slots:
    """A target carried to its next epoch; at its first F is zero and nothing of the target before it is left."""
    F = move.F
    root = linalg.tria(jnp.concatenate([linalg.multiply(F, own.R), move.L], 1))
    B, shift = linalg.multiply(F, own.B), linalg.multiply(F, own.shift)
    return Slots(F @ own.m + move.drift, B, root, shift)


def seen(belief: Augmented, own: Slots, row: WhiteRow) -> tuple[Augmented, Slots, KeptDatum]:
    """Belief and target after a datum of it: both updates by Potter's square root (Bierman 1977, II.7).

    A datum that is held back changes nothing.
    """
    v = row.hx @ own.R
    std = jnp.sqrt(1.0 + jnp.sum(v**2))
    c = (row.value - row.hx @ own.m) / std
    g = (row.hz + row.hx @ own.B) / std
    u = g @ belief.root
    variance = 1.0 + jnp.sum(u**2)
    innovation = c - g @ belief.mean
    spread = jnp.sqrt(1.0 + (variance * std**2 - 1.0) / row.ratio**2)
    residual = (row.shift + innovation * std / row.ratio) / spread
    held = (row.verdict == HOLD) | ((row.verdict == DECIDE) & ((residual < row.low) | (residual > row.high)))
    free = jnp.where(held, 0.0, 1.0)
    c, innovation = jnp.where(held, 0.0, c), jnp.where(held, 0.0, innovation)
    gain = free * (own.R @ v) / std
    pull = free * (belief.root @ u) / variance  # gain of z
    root = belief.root - pull[:, None] * (u / (1.0 + 1.0 / jnp.sqrt(variance)))[None, :]
    told = belief.candidates
    shift = (row.hz[told.bias] + row.hx @ own.shift) / std
    change = free * (shift - g @ told.response)  # of the innovation by a jump of unit size
    candidates = told._replace(
        response=told.response + pull[:, None] * change[None, :],
        information=told.information + change**2 / variance,
        score=told.score + change * innovation / variance,
    )
    after = Slots(
        own.m + gain * c,
        own.B - gain[:, None] * g[None, :],
        own.R - gain[:, None] * (v / (1.0 + std))[None, :],
        own.shift - gain[:, None] * shift[None, :],
    )
    datum = KeptDatum(
        free * row.hx / std, gain, c, free * g, innovation / jnp.sqrt(variance), free * variance * std**2,
        pull * innovation, residual, spread, held,
    )  # fmt: skip
    return Augmented(belief.mean + pull * innovation, root, belief.slots, candidates), after, datum


def not_estimated(belief: Augmented, kept: KeptDatum, considered: jax.Array) -> Augmented:
    """The belief after a datum by which the biases in `considered` (M,) were not to be estimated.

    They get back mean and covariance; their correlation with all else is that of the datum (Schmidt 1966).
    """
    moved = jnp.where(considered, kept.moved, 0.0)
    spread = moved / jnp.where(kept.innovation != 0, kept.innovation, 1.0)
    after, slots = dispersed(belief, belief.slots, spread[:, None], moved)
    return after._replace(slots=slots)


@jax.jit
def dispersed(
    belief: Augmented, slots: tuple[Slots, ...], columns: jax.Array, back: jax.Array | None = None
) -> tuple[Augmented, tuple[Slots, ...]]:
    """Biases that moved by a step of covariance columns columns' (M, q), the targets being where they are.

    `back` (M,) is taken from the mean of z alone.
    """
    root = linalg.tria(jnp.concatenate([belief.root, columns], 1))
    inverse = linalg.inverse_lower(root)
    weighed = inverse @ columns  # (M, q)
    share = linalg.semi_cholesky((jnp.eye(columns.shape[1]) - weighed.T @ weighed)[None])[0]
    solved = inverse.T @ weighed  # covariance^-1 columns
    mean = belief.mean if back is None else belief.mean - back

    def of(m: jax.Array, B: jax.Array, R: jax.Array, shift: jax.Array) -> Slots:
        reached = B @ columns  # (n, q)
        after = B - reached @ solved.T
        spread = linalg.tria(jnp.concatenate([R, reached @ share], 1))
        response = shift + (B - after) @ belief.candidates.response
        return Slots(m + B @ belief.mean - after @ mean, after, spread, response)

    found = tuple(jax.vmap(of)(*own) for own in slots)
    return belief._replace(mean=mean, root=root), found


def walked(belief: Augmented, std: jax.Array) -> Augmented:
    """Biases that each moved by a step of a standard deviation (M,), 0 where one stays."""
    after, slots = dispersed(belief, belief.slots, jnp.diag(std))
    return after._replace(slots=slots)


@jax.jit
def jumped(belief: Augmented, which: jax.Array, size: jax.Array, variance: jax.Array) -> Augmented:
    """The belief where candidate `which` did jump, by a size of mean and variance given by its data.

    All candidates begin anew.
    """
    told = belief.candidates
    M = belief.mean.shape[0]
    unit = jnp.zeros(M).at[told.bias[which]].set(1.0)
    away = unit - told.response[:, which]  # of the present biases by a jump of unit size
    sd = jnp.sqrt(variance)
    mean = belief.mean + away * size
    root = linalg.tria(jnp.concatenate([belief.root, (away * sd)[:, None]], 1))
    inverse = linalg.inverse_lower(root)
    weighed = inverse @ (away * sd)
    solved = inverse.T @ weighed
    left = sd * jnp.sqrt(jnp.maximum(1.0 - jnp.sum(weighed**2), 0.0))
    slots = []
    for own in belief.slots:
        turn = own.shift[:, :, which] - own.B @ unit  # (T, n) of x given the present z by a jump of unit size
        B = own.B + turn[:, :, None] * (sd * solved)[None, None, :]
        m = own.m + turn * (size - sd * (solved @ mean))
        R = jax.vmap(linalg.tria)(jnp.concatenate([own.R, turn[:, :, None] * left], 2))
        slots.append(Slots(m, B, R, jnp.zeros_like(own.shift)))
    fresh = told._replace(
        response=jnp.zeros_like(told.response),
        information=jnp.zeros_like(told.information),
        score=jnp.zeros_like(told.score),
    )
    return Augmented(mean, root, tuple(slots), fresh)


@jax.jit
def renewed(belief: Augmented, columns: jax.Array) -> Augmented:
    """Candidates of some columns (C,) begin at this moment."""
    told = belief.candidates
    kept = ~columns
    slots = tuple(own._replace(shift=own.shift * kept[None, None, :]) for own in belief.slots)
    fresh = told._replace(
        response=told.response * kept[None, :], information=told.information * kept, score=told.score * kept
    )
    return belief._replace(slots=slots, candidates=fresh)
