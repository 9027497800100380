"""The marginal density of the biases, every trajectory integrated by Laplace's formula: its slope.

l(z) = log p(y | u(z), z) - |u(z)|^2 / 2 - 1/2 log det W(z) + log prior(z), u(z) the mode of the whitened noises given z
and W their posterior precision by the expected information (Tierney and Kadane 1986). The joint mode of biases and
trajectory leaves the determinant out, and with as many noises as epochs prefers a scene that needs less of them.
"""

from typing import Any

import jax
import jax.numpy as jnp

from probcal.gaussian import recursion as rec
from probcal.gaussian.mode import Eliminated, Point, factors, log_likelihood
from probcal.model.model import At, Model
from probcal.model.trajectories import States

ROUNDS, EXACT = 31, 1e-14  # of an adjoint solve at most; share of its first square that ends it
SMALL = 1e-6  # share of its first square from which on an adjoint solve is good enough


@jax.jit
def volume_slope(
    model: Model, point: Point, solved: Eliminated, only: States | None = None
) -> tuple[jax.Array, jax.Array]:
    """Derivative (M,) of log det W by z at a point whose trajectories are at their mode, these following.

    `only` (E,) of each recursion marks the epochs of the targets that count; all without it.

    d log det W = sum over k of tr(P_k dJ_k), P_k the smoothed covariance of the states given z, J_k
    the information of the rows of an epoch. The way through the
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
        pairs = zip(lins, model.state_variance(lins, counted), strict=True)
        return sum((jnp.sum(lin.weight * own) for lin, own in pairs), jnp.zeros(()))

    own, by_state = jax.grad(volume, argnums=(0, 1))(point.z, point.states)
    through, sound = _adjoint(model, point, solved, spread, by_state)
    slope = own + through
    sound = sound & jnp.all(jnp.isfinite(slope))
    return jnp.where(sound, slope, 0.0), sound


def _adjoint(
    model: Model, point: Point, solved: Eliminated, spread: list[jax.Array], slope: States
) -> tuple[jax.Array, jax.Array]:
    """Slope by the biases through the trajectories, K x (M,), of a slope (E, n) by the states, H x.

    H are the second derivatives of the negative log density by the trajectories, K minus those by
    these and the biases.
    Smoothing, S, solves with the expected information in the place of the observed; `spread` are its covariances
    (E, n, n). With R what the two differ by, x = S y where (I + R S) y = slope: conjugate gradients in the inner
    product of S, one smooth each (Saad 2003, 6.7), of which K x is the sum.
    Also whether it is positive all the way: elsewhere the trajectories are at no mode.
    """

    def smooth(right: States) -> States:
        parts = model.each_layout(solved.parts, spread, right)
        return tuple(rec.respond(kept.gain, P, b[:, :, None])[:, :, 0] for _, kept, P, b in parts)

    score = jax.grad(lambda x, z: log_likelihood(model, At(x, z, point.levels)), argnums=(0, 1))

    def observed(x: States) -> tuple[States, jax.Array]:
        """The observed information less the expected, times x, and K x."""
        by_state, by_bias = jax.jvp(lambda at: score(at, point.z), (point.states,), (x,))[1]
        parts = model.each_layout(solved.parts, by_state, x)
        return tuple(-own - jnp.einsum("eij,ej->ei", kept.J, v) for _, kept, own, v in parts), by_bias

    def on(state: Any) -> jax.Array:
        *_, left, count, positive = state
        return (count < ROUNDS) & (left > EXACT * whole) & positive

    def again(state: Any) -> Any:
        through, r, p, along, left, count, _ = state
        rest, moved = observed(along)
        image = add(p, 1.0, rest)
        curved = dot(along, image)
        length = jnp.where(curved > 0, left / curved, 0.0)
        r = add(r, -length, image)
        s = smooth(r)
        after = dot(r, s)
        turn = after / left
        return through + length * moved, r, add(r, turn, p), add(s, turn, along), after, count + 1, curved > 0

    first = smooth(slope)
    whole = dot(slope, first)
    start = (jnp.zeros_like(point.z), slope, slope, first, whole, jnp.zeros((), int), jnp.ones((), bool))
    through, *_, left, _, positive = jax.lax.while_loop(on, again, start)
    return through, positive | (left <= SMALL * whole)  # at the end rounding may turn a curvature


def dot(a: States, b: States) -> jax.Array:
    """Sum of the products of all entries."""
    return sum((jnp.sum(x * y) for x, y in zip(a, b, strict=True)), jnp.zeros(()))


def add(a: States, factor: Any, b: States) -> States:
    """a + factor b."""
    return tuple(x + factor * y for x, y in zip(a, b, strict=True))
