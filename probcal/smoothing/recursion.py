"""The linear-Gaussian recursion over epochs, shared by all columns, in square-root covariance form.

Model of one recursion: x_k = F_k x_{k-1} + c_k + L_k u_k, u_k ~ N(0, I), with F_k = 0 at the first epoch of a
target, so that targets are concatenated. Data enter compressed: information J_k (n, n) and columns b_k (n, m).
Neither L_k nor J_k needs to have full rank: no covariance is ever inverted, only I + L' J L.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from probcal.linalg import inverse_cholesky, multiply, semi_cholesky, tria


class Gains(NamedTuple):
    """What the covariance pass leaves for any number of columns."""

    predicted: jax.Array  # (E, n, n) root of the predicted covariance
    updated: jax.Array  # (E, n, n) root of the filtered covariance
    keep: jax.Array  # (E, n, n) I - P+ J, the part of a prediction that an update keeps
    logdet: jax.Array  # log det of the posterior precision of all u


class Smoothed(NamedTuple):
    """Posterior means of states and whitened noises, one column each."""

    states: jax.Array  # (E, n, m)
    noises: jax.Array  # (E, n, m)


def gains(F: jax.Array, L: jax.Array, J: jax.Array) -> Gains:
    """Covariance pass: transitions F, noise factors L and data information J, all (E, n, n)."""
    n = F.shape[-1]
    eye = jnp.eye(n, dtype=F.dtype)

    def step(root, epoch):
        F_k, L_k, J_k = epoch
        predicted = tria(jnp.concatenate([multiply(F_k, root), L_k], 1))
        inverse = inverse_cholesky(eye + multiply(predicted.T, multiply(J_k, predicted)))
        updated = multiply(predicted, inverse.T)
        return updated, (predicted, updated, jnp.diagonal(inverse))

    _, (predicted, updated, diagonals) = jax.lax.scan(step, jnp.zeros_like(eye), (F, L, J))
    keep = eye[None] - updated @ (updated.mT @ J)
    return Gains(predicted, updated, keep, -2.0 * jnp.sum(jnp.log(diagonals)))


def smooth(F: jax.Array, L: jax.Array, J: jax.Array, gain: Gains, b: jax.Array, c: jax.Array | None = None) -> Smoothed:
    """Smooth columns b (E, n, m) with drifts c (E, n, m) (zero if None), forward and backward.

    The backward pass is the adjoint form of Bryson and Frazier: lambda_k = (I + J P)^-1 (g_k + F' lambda_k+1),
    x_k = x_k|k + P+ F' lambda_k+1, u_k = L' lambda_k.
    """
    carry = jnp.zeros_like(b[0])
    covariance = gain.updated @ gain.updated.mT
    source = covariance @ b
    if c is not None:
        source = source + gain.keep @ c

    def forward(x, epoch):
        T_k, s_k = epoch
        x = multiply(T_k, x) + s_k
        return x, x

    _, filtered = jax.lax.scan(forward, carry, (gain.keep @ F, source))
    before = jnp.concatenate([carry[None], filtered[:-1]])
    loss = gain.keep.mT @ J
    pulls = gain.keep.mT @ b - (loss @ F) @ before  # keep' (b - J predicted)
    if c is not None:
        pulls = pulls - loss @ c
    F_next = jnp.concatenate([F[1:], jnp.zeros_like(F[:1])])

    def backward(adjoint, epoch):
        T_k, g_k = epoch
        following = adjoint
        adjoint = multiply(T_k, adjoint) + g_k
        return adjoint, (adjoint, following)

    _, (adjoint, following) = jax.lax.scan(backward, carry, (gain.keep.mT @ F_next.mT, pulls), reverse=True)
    states = filtered + (covariance @ F_next.mT) @ following
    return Smoothed(states, L.mT @ adjoint)


def innovate(
    F: jax.Array, J: jax.Array, gain: Gains, b: jax.Array, c: jax.Array, used: tuple[int, ...]
) -> tuple[jax.Array, jax.Array]:
    """Columns b (E, n, m) with drifts c (E, n, m) as unit-noise data: alone, and as innovations, both (E, u, m).

    With J_k = G G' on the `used` state entries, `alone` solves G alone = b, and the innovation alone - G' x
    against the predicted x is whitened by its covariance I + G'PG. The sum of squares of the innovations, less that
    of `alone`, is -b'W^-1 b, W the precision of the whole trajectory: a forward pass is enough to eliminate it,
    and an error of x enters squared, so that a target grazing a sensor does no harm.
    """
    entries = jnp.asarray(used, int)
    root, alone = semi_cholesky(J[:, entries[:, None], entries[None, :]], b[:, entries])
    covariance = gain.updated @ gain.updated.mT
    source = covariance[:, :, entries] @ b[:, entries] + gain.keep @ c

    def forward(x, epoch):
        T_k, s_k = epoch
        x = multiply(T_k, x) + s_k
        return x, x

    carry = jnp.zeros_like(b[0])
    _, filtered = jax.lax.scan(forward, carry, (gain.keep @ F, source))
    before = jnp.concatenate([carry[None], filtered[:-1]])
    predicted = F[:, entries] @ before + c[:, entries]
    spread = gain.predicted[:, entries]
    S = jnp.eye(len(used), dtype=J.dtype)[None] + root.mT @ (spread @ spread.mT) @ root
    return alone, jax.vmap(inverse_cholesky)(S) @ (alone - root.mT @ predicted)


def covariances(F: jax.Array, L: jax.Array, J: jax.Array, gain: Gains) -> tuple[jax.Array, jax.Array]:
    """Posterior covariances of every state and of every whitened noise, both (E, n, n)."""
    F_next = jnp.concatenate([F[1:], jnp.zeros_like(F[:1])])

    def backward(information, epoch):
        F_k, keep, J_k, updated = epoch
        ahead = multiply(F_k.T, multiply(information, F_k))
        here = multiply(keep.T, J_k + multiply(ahead, keep))
        state = multiply(updated, updated.T)
        return here, (here, state - multiply(state, multiply(ahead, state)))

    start = jnp.zeros_like(F[0])
    _, (adjoint, states) = jax.lax.scan(backward, start, (F_next, gain.keep, J, gain.updated), reverse=True)
    eye = jnp.eye(F.shape[-1], dtype=F.dtype)
    return states, eye[None] - L.mT @ adjoint @ L


def trajectory(F: jax.Array, L: jax.Array, c: jax.Array, noises: jax.Array) -> jax.Array:
    """States (E, n, m) of whitened noises (E, n, m) and drifts (E, n, m) (or (E, n, 1))."""

    def step(x, epoch):
        F_k, s_k = epoch
        x = multiply(F_k, x) + s_k
        return x, x

    source = L @ noises + c
    return jax.lax.scan(step, jnp.zeros_like(source[0]), (F, source))[1]
