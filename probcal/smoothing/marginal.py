"""The mode of the marginal density of the biases, every trajectory integrated by Laplace's formula.

l(z) = log p(y | u(z), z) - |u(z)|^2 / 2 - 1/2 log det W(z) + log prior(z), u(z) the mode of the whitened noises given z
and W their posterior precision by the expected information (Tierney and Kadane 1986). The joint mode of biases and
trajectory leaves the determinant out, and with as many noises as epochs prefers a scene that needs less of them.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from probcal.model.model import At, Model
from probcal.priors import Precision
from probcal.smoothing import recursion as rec
from probcal.smoothing.mode import (
    DAMPING,
    HALVINGS,
    ROUNDING,
    Eliminated,
    Mode,
    Point,
    cost,
    eliminate,
    factors,
    find_mode,
    follow,
    log_likelihood,
)
from probcal.smoothing.solves import Dense

States = tuple[jax.Array, ...]  # (E, n) of each recursion
ROUNDS, EXACT = 30, 1e-18  # of an adjoint solve at most, and the square of a change that ends it
ENOUGH = 0.1  # share of the promised rise that a step must bring: along what motion noise alone fixes, half a step does
TRACK_STEPS = 1  # of Gauss-Newton after every step of the biases; the trajectories reach their mode along with these


def volume_slope(model: Model, point: Point, solved: Eliminated) -> jax.Array:
    """Derivative (M,) of log det W by z at a point whose trajectories are at their mode, these following.

    d log det W = sum over k of tr(P_k dJ_k), P_k the smoothed covariance of the states given z. The way through the
    trajectories is one adjoint smooth with the second derivatives of the density (see `_adjoint`).
    """
    spread = [
        rec.covariances(part.F, factors(part, point.levels), kept.J, kept.gain)[0]
        for part, kept in zip(model.recursions, solved.parts, strict=True)
    ]

    def volume(z: jax.Array, states: States) -> jax.Array:
        lins = model.linearise(At(states, z, point.levels), expected=True)
        pairs = zip(spread, model.of_states(lins), strict=True)
        return sum((jnp.sum(P * J) for P, (J, _) in pairs), jnp.zeros(()))

    own, by_state = jax.grad(volume, argnums=(0, 1))(point.z, point.states)
    moved = _adjoint(model, point, solved, by_state)

    def along(z: jax.Array) -> jax.Array:
        """Slope of the log-likelihood along the adjoint states."""
        return jax.jvp(lambda x: log_likelihood(model, At(x, z, point.levels)), (point.states,), (moved,))[1]

    return own + jax.grad(along)(point.z)


def _adjoint(model: Model, point: Point, solved: Eliminated, slope: States) -> States:
    """Solve H x = slope (E, n), H the second derivatives of the negative log density by the trajectories.

    Smoothing solves with the expected information in the place of the observed; what these differ by is moved to the
    right-hand side until nothing changes. Where that does not settle the first solution stands.
    """

    def smooth(right: States) -> States:
        parts = zip(model.recursions, solved.parts, right, strict=True)
        return tuple(
            rec.smooth(part.F, factors(part, point.levels), kept.J, kept.gain, b[:, :, None]).states[:, :, 0]
            for part, kept, b in parts
        )

    score = jax.grad(lambda x: log_likelihood(model, At(x, point.z, point.levels)))

    def rest(x: States) -> States:
        """What the observed information adds to the expected, times x."""
        observed = jax.jvp(score, (point.states,), (x,))[1]
        parts = zip(solved.parts, observed, x, strict=True)
        return tuple(-own - jnp.einsum("eij,ej->ei", kept.J, v) for kept, own, v in parts)

    def size(x: States) -> jax.Array:
        return sum((jnp.sum(v**2) for v in x), jnp.zeros(()))

    def on(state: tuple[States, jax.Array, jax.Array, jax.Array]) -> jax.Array:
        _, change, before, count = state
        return (count < ROUNDS) & (change > EXACT * size(first)) & (change < before)

    def again(state: tuple[States, jax.Array, jax.Array, jax.Array]) -> Any:
        x, change, _, count = state
        new = smooth(jax.tree.map(jnp.subtract, slope, rest(x)))
        return new, size(jax.tree.map(jnp.subtract, new, x)), change, count + 1

    first = smooth(slope)
    start = (first, jnp.full((), jnp.finfo(float).max), jnp.full((), jnp.inf), jnp.zeros((), int))
    last, change, before, _ = jax.lax.while_loop(on, again, start)
    return jax.tree.map(lambda new, old: jnp.where(change < before, new, old), last, first)


class _Search(NamedTuple):
    point: Point
    solved: Eliminated
    value: jax.Array  # negative log marginal density
    damping: jax.Array
    moved: jax.Array  # some step raised the density
    iteration: jax.Array
    converged: jax.Array
    done: jax.Array


def _valued(model: Model, point: Point, prior: Precision) -> tuple[Eliminated, jax.Array]:
    solved = eliminate(model, point, expected=True)
    return solved, cost(model, point, prior) + 0.5 * solved.logdet


@jax.jit
def find_marginal_mode(model: Model, start: Point, prior: Precision, iterations: int, tolerance: float) -> Mode:
    """Climb to the mode of the marginal density until a step promises less than `tolerance`; levels are held.

    Gauss-Newton with the information of the biases, trajectories eliminated, and the whole gradient; a step that does
    not bring its share of what it promises is halved, then damped. The cost of the mode is that of the marginal
    density.
    """
    flat = Precision.single(jnp.zeros_like(start.z))

    def settled(point: Point) -> Point:
        return find_mode(model, point, flat, TRACK_STEPS, 1e-2 * tolerance, joint=False).point

    def body(s: _Search) -> _Search:
        point, solved = s.point, s.solved
        score = solved.score - prior.pull(point.z) - 0.5 * volume_slope(model, point, solved)
        matrix = solved.information + prior.matrix() + s.damping * jnp.eye(model.biases)
        dz = Dense.of(matrix).solve(score)
        promised = 0.5 * score @ dz

        def shorter(state):
            t, tries, *_ = state
            t = jnp.where(tries == 0, 1.0, 0.5 * t)
            moved = settled(follow(model, point, solved, t * dz))
            return t, tries + 1, moved, *_valued(model, moved, prior)

        def worse(state):
            t, tries, _, _, value = state
            enough = s.value - value >= ENOUGH * t * promised
            return (tries == 0) | (~enough & (tries < HALVINGS))

        t, tries, moved, after, value = jax.lax.while_loop(
            worse, shorter, (jnp.ones(()), jnp.zeros((), int), point, solved, s.value)
        )
        better = s.value - value >= ENOUGH * t * promised
        small = promised <= jnp.maximum(tolerance, ROUNDING * jnp.abs(s.value))
        take = better & (value <= s.value)
        point, solved = jax.tree.map(lambda new, old: jnp.where(take, new, old), (moved, after), (point, solved))
        damping = jnp.where(take & (tries <= 3), s.damping * 0.1, jnp.maximum(s.damping * 10.0, 1e-3))
        damping = jnp.where(damping < 1e-6, 0.0, damping)
        converged = small & (s.damping <= 1.0) & jnp.isfinite(s.value)
        return _Search(
            point, solved, jnp.where(take, value, s.value), damping, s.moved | take, s.iteration + 1, converged,
            converged | (damping > DAMPING),
        )  # fmt: skip

    begin = settled(start)
    first = _Search(
        begin, *_valued(model, begin, prior), jnp.zeros(()), jnp.zeros((), bool), jnp.zeros((), int),
        jnp.zeros((), bool), jnp.zeros((), bool),
    )  # fmt: skip
    last = jax.lax.while_loop(lambda s: ~s.done & (s.iteration < iterations), body, first)
    gained, volume = first.value - last.value, 0.5 * last.solved.logdet
    refused = ~last.moved & ~last.converged
    return Mode(last.point, last.value, last.iteration, last.converged, refused, gained, volume)
