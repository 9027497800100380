"""The mode of the marginal density of the biases, every trajectory integrated by Laplace's formula.

l(z) = log p(y | u(z), z) - |u(z)|^2 / 2 - 1/2 log det W(z) + log prior(z), u(z) the mode of the whitened noises given z
and W their posterior precision by the expected information (Tierney and Kadane 1986). The joint mode of biases and
trajectory leaves the determinant out, and with as many noises as epochs prefers a scene that needs less of them.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal.gaussian import recursion as rec
from probcal.gaussian.linearised import compress_and_eliminate, linearise_rows
from probcal.gaussian.mode import (
    DAMPING,
    ROUNDING,
    Eliminated,
    Mode,
    Point,
    cost,
    eliminate,
    factors,
    find_tracks,
    follow,
    log_likelihood,
)
from probcal.gaussian.search import HALVINGS
from probcal.gaussian.solves import Dense
from probcal.linalg import library
from probcal.model.model import At, Model
from probcal.priors import Precision

States = tuple[jax.Array, ...]  # (E, n) of each recursion
ROUNDS, EXACT = 30, 1e-14  # of an adjoint solve at most, and the share of its first square that ends it
ENOUGH = 0.1  # share of the promised rise that a step must bring: along what motion noise alone fixes, half a step does
SMALL = 1e-6  # share of its first square from which on an adjoint solve is good enough
LEAST_CURVED = 0.05  # share of its curvature so far that a secant must show
LEAST_DAMPED = 0.25  # part of a damped step that is tried at least: more damping shortens it too
SHORT = 0.25  # part of a step above which the damping falls again
TRACK_STEPS = 30  # of Gauss-Newton after every step of the biases
SETTLED = 1e-10  # nats at which they end: log det W moves with the trajectories to first order
NOTHING = 1e-4  # nats (0.014 sd) that a slope may promise in vain: tracks that settle slowly leave it that uncertain


@jax.jit
def volume_slope(
    model: Model, point: Point, solved: Eliminated, only: tuple[jax.Array, ...] | None = None
) -> tuple[jax.Array, jax.Array]:
    """Derivative (M,) of log det W by z at a point whose trajectories are at their mode, these following.

    `only` (E,) of each recursion marks the epochs of the targets that count; all without it.

    d log det W = sum over k of tr(P_k dJ_k), P_k the smoothed covariance of the states given z. The way through the
    trajectories is one adjoint smooth with the second derivatives of the density (see `_adjoint`). Where a target
    stands on a cusp, at the place of a sensor, there is none: the derivative is zero and the second value False.
    """
    spread = [
        rec.covariances(part.F, factors(part, point.levels), kept.gain)[0]
        for part, kept in model.each_layout(solved.parts)
    ]

    if only is not None:
        counted = [jnp.where(on[:, None, None], P, 0.0) for P, on in zip(spread, only, strict=True)]
    else:
        counted = spread

    def volume(z: jax.Array, states: States) -> jax.Array:
        lins = model.linearise(At(states, z, point.levels), expected=True)
        pairs = zip(counted, model.of_states(lins), strict=True)
        return sum((jnp.sum(P * J) for P, (J, _) in pairs), jnp.zeros(()))

    own, by_state = jax.grad(volume, argnums=(0, 1))(point.z, point.states)
    moved, sound = _adjoint(model, point, solved, spread, by_state)

    def along(z: jax.Array) -> jax.Array:
        """Slope of the log-likelihood along the adjoint states."""
        return jax.jvp(lambda x: log_likelihood(model, At(x, z, point.levels)), (point.states,), (moved,))[1]

    slope = own + jax.grad(along)(point.z)
    sound = sound & jnp.all(jnp.isfinite(slope))
    return jnp.where(sound, slope, 0.0), sound


def _adjoint(
    model: Model, point: Point, solved: Eliminated, spread: list[jax.Array], slope: States
) -> tuple[States, jax.Array]:
    """Solve H x = slope (E, n), H the second derivatives of the negative log density by the trajectories.

    Smoothing, S, solves with the expected information in the place of the observed; `spread` are its covariances
    (E, n, n). With R what the two differ by, x = S y where (I + R S) y = slope: conjugate gradients in the inner
    product of S, one smooth each (Saad 2003, 6.7).
    Also whether it is positive all the way: elsewhere the trajectories are at no mode.
    """

    def smooth(right: States) -> States:
        parts = model.each_layout(solved.parts, spread, right)
        return tuple(rec.respond(kept.gain, P, b[:, :, None])[:, :, 0] for _, kept, P, b in parts)

    score = jax.grad(lambda x: log_likelihood(model, At(x, point.z, point.levels)))

    def rest(x: States) -> States:
        """What the observed information adds to the expected, times x."""
        observed = jax.jvp(score, (point.states,), (x,))[1]
        parts = model.each_layout(solved.parts, observed, x)
        return tuple(-own - jnp.einsum("eij,ej->ei", kept.J, v) for _, kept, own, v in parts)

    def on(state: Any) -> jax.Array:
        *_, left, count, positive = state
        return (count < ROUNDS) & (left > EXACT * dot(slope, first)) & positive

    def again(state: Any) -> Any:
        x, r, p, along, left, count, _ = state
        image = add(p, 1.0, rest(along))
        curved = dot(along, image)
        length = jnp.where(curved > 0, left / curved, 0.0)
        x, r = add(x, length, along), add(r, -length, image)
        s = smooth(r)
        after = dot(r, s)
        turn = after / left
        return x, r, add(r, turn, p), add(s, turn, along), after, count + 1, curved > 0

    first = smooth(slope)
    r = jax.tree.map(jnp.negative, rest(first))
    s = smooth(r)
    start = (first, r, r, s, dot(r, s), jnp.zeros((), int), jnp.ones((), bool))
    x, _, _, _, left, _, positive = jax.lax.while_loop(on, again, start)
    return x, positive | (left <= SMALL * dot(slope, first))  # at the end rounding may turn a curvature


def dot(a: States, b: States) -> jax.Array:
    """Sum of the products of all entries."""
    return sum((jnp.sum(x * y) for x, y in zip(a, b, strict=True)), jnp.zeros(()))


def add(a: States, factor: Any, b: States) -> States:
    """a + factor b."""
    return tuple(x + factor * y for x, y in zip(a, b, strict=True))


class _Search(NamedTuple):
    point: Point  # the best so far
    solved: Eliminated
    value: jax.Array  # negative log marginal density there; NaN before the first look
    begun: jax.Array  # that at the start
    score: jax.Array  # (M,) slope of the log density there
    bent: jax.Array  # (M, M) what the secants of the steps add to the information
    step: jax.Array  # (M,) the step that is being tried
    promised: jax.Array  # the rise that the whole of it promises
    share: jax.Array  # the part of it that is tried, 1, 1/2, ...
    damping: jax.Array
    moved: jax.Array  # some step raised the density
    iteration: jax.Array
    converged: jax.Array
    done: jax.Array


def _secant(matrix: jax.Array, step: jax.Array, change: jax.Array) -> jax.Array:
    """What makes a curvature (M, M) agree with the change of the slope along a step: BFGS, where it stays positive."""
    image, curved = matrix @ step, step @ change
    before = step @ image
    sound = curved > LEAST_CURVED * before
    update = jnp.outer(change, change) / jnp.where(sound, curved, 1.0) - jnp.outer(image, image) / jnp.where(
        sound, before, 1.0
    )
    return jnp.where(sound, update, 0.0)


@jax.jit
def _begun(model: Model, start: Point) -> _Search:
    """The search before the first look."""
    M, zero, no = model.biases, jnp.zeros(()), jnp.zeros((), bool)
    blank = jax.tree.map(
        lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(lambda: eliminate(model, start, expected=True))
    )
    none = jnp.zeros(M)
    return _Search(
        start, blank, zero * jnp.nan, zero, none, jnp.zeros((M, M)), none, zero, jnp.ones(()), zero, no,
        jnp.zeros((), int), no, no,
    )  # fmt: skip


@jax.jit
def _tried(model: Model, s: _Search) -> Point:
    """The point that is looked at next, its tracks not yet at their mode: the start, or a part of the step away."""
    moved = follow(model, s.point, s.solved, s.share * s.step)
    return jax.tree.map(lambda new, old: jnp.where(s.iteration == 0, old, new), moved, s.point)


@jax.jit
def _valued(
    model: Model, s: _Search, point: Point, prior: Precision, solved: Eliminated
) -> tuple[jax.Array, jax.Array]:
    """Negative log marginal density of a point, and whether it is the next of the search."""
    value = cost(model, point, prior) + 0.5 * solved.logdet
    better = (s.value - value >= ENOUGH * s.share * s.promised) & (value <= s.value)
    return value, better | (s.iteration == 0)


def _damped(matrix: jax.Array, score: jax.Array, damping: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The damped step (M,), its damping and how often that grew first: until the matrix is positive definite."""

    def solved(damping: jax.Array) -> jax.Array:
        return Dense.of(matrix + damping * jnp.eye(len(score))).solve(score)

    def more(state: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
        damping = _grown(state[1])
        return solved(damping), damping, state[2] + 1

    def on(state: tuple[jax.Array, jax.Array, jax.Array]) -> jax.Array:
        return ~jnp.all(jnp.isfinite(state[0])) & (state[1] <= DAMPING)

    return jax.lax.while_loop(on, more, (solved(damping), damping, jnp.zeros((), int)))


def _grown(damping: jax.Array) -> jax.Array:
    return jnp.maximum(damping * 10.0, 1e-3)


@jax.jit
def _turned(
    s: _Search, point: Point, solved: Eliminated, value: jax.Array, volume: jax.Array, prior: Precision, tolerance: Any
) -> _Search:
    """The search at a better point, with the next step."""
    score = solved.score - prior.pull(point.z) - 0.5 * volume
    matrix = solved.information + prior.matrix()
    bent = s.bent + _secant(matrix + s.bent, point.z - s.point.z, s.score - score)
    damping = jnp.where(s.share >= SHORT, s.damping * 0.1, _grown(s.damping))
    step, damping, grown = _damped(matrix + bent, score, jnp.where(damping < 1e-6, 0.0, damping))
    promised = 0.5 * score @ step
    found = (promised <= tolerance) & (damping <= 1.0) & jnp.isfinite(value)
    first = s.iteration == 0
    return _Search(
        point, solved, value, jnp.where(first, value, s.begun), score, bent, step, promised, jnp.ones(()), damping,
        s.moved | ~first, s.iteration + 1 + grown, found, found | ~jnp.isfinite(value + promised),
    )  # fmt: skip


@jax.jit
def _shorter(s: _Search, prior: Precision) -> _Search:
    """The search with half the step, or with more damping where that was tried often enough, soon where it is damped.

    A step that promised less than the rounding of the density, and shows nothing, is the end; one that promised
    `NOTHING` is where no part of it shows anything.
    """
    spent = s.share <= jnp.where(s.damping > 0, LEAST_DAMPED, 0.5**HALVINGS)
    found = (s.promised <= jnp.where(spent, NOTHING, ROUNDING * jnp.abs(s.value))) & (s.damping <= 1.0)
    step, damping, grown = _damped(s.solved.information + prior.matrix() + s.bent, s.score, _grown(s.damping))
    step, damping = jnp.where(spent, step, s.step), jnp.where(spent, damping, s.damping)
    return s._replace(
        step=step, promised=0.5 * s.score @ step, share=jnp.where(spent, 1.0, 0.5 * s.share), damping=damping,
        iteration=s.iteration + jnp.where(spent, 1 + grown, 0), converged=found, done=found | (damping > DAMPING),
    )  # fmt: skip


@jax.jit
def _ended(s: _Search) -> Mode:
    refused, volume = ~s.moved & ~s.converged, 0.5 * s.solved.logdet
    return Mode(s.point, s.value, s.iteration - 1, s.converged, refused, s.begun - s.value, volume)


def find_marginal_mode(
    model: Model, start: Point, prior: Precision, iterations: int, tolerance: Any
) -> tuple[Mode, Eliminated]:
    """Climb to the mode of the marginal density until a step promises less than `tolerance`; levels are held.

    Quasi-Newton steps with the whole gradient: the information of the biases, trajectories eliminated, and what the
    secants say of log det W (BFGS), which along what motion noise alone fixes doubles it. A step that does not bring
    its share of what it promises is halved, then damped. The cost of the mode is that of the marginal density; the
    system eliminated there comes with it.

    Called from Python it goes from step to step by kernels that other parts of a fit use too; inside a compiled
    function it is a loop of that.
    """

    def look(s: _Search) -> tuple[Point, Eliminated, jax.Array, jax.Array]:
        point = find_tracks(model, _tried(model, s), TRACK_STEPS, SETTLED)
        _, solved = compress_and_eliminate(model, point, linearise_rows(model, point))
        return point, solved, *_valued(model, s, point, prior, solved)

    def turned(s: _Search, point: Point, solved: Eliminated, value: jax.Array) -> _Search:
        volume, _ = volume_slope(model, point, solved)
        return _turned(s, point, solved, value, volume, prior, tolerance)

    def shorter(s: _Search, *_: Any) -> _Search:
        return _shorter(s, prior)

    s = _begun(model, start)
    if library(*jax.tree.leaves((s, model, start, prior, tolerance))) is np:
        while not s.done and s.iteration <= iterations:
            point, solved, value, better = look(s)
            s = turned(s, point, solved, value) if better else shorter(s)
        return _ended(s), s.solved

    def body(s: _Search) -> _Search:
        point, solved, value, better = look(s)
        return jax.lax.cond(better, turned, shorter, s, point, solved, value)

    last = jax.lax.while_loop(lambda s: ~s.done & (s.iteration <= iterations), body, s)
    return _ended(last), last.solved
