"""The linear-Gaussian recursion over epochs, shared by all columns, in square-root covariance form.

Model of one recursion: x_k = F_k x_{k-1} + c_k + L_k u_k, u_k ~ N(0, I), with F_k = 0 at the first epoch of a
target, so that targets are concatenated. Data enter compressed: information J_k = G G' (n, n) and columns b_k (n, m),
read as unit-noise data y of G'x where G y = b. Neither L_k nor J_k needs to have full rank. No root is multiplied by
itself before the end: of a start of 1e7 m and data of 1 cm seven digits are left, of their squares none would be.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from probcal.gaussian.scans import filter_roots, in_parallel, inverse_root, recur, recur_squared
from probcal.linalg import forward, multiply_rows, preceding, semi_cholesky


class Gains(NamedTuple):
    """The results of the covariance pass for any columns, u entries of the state being read by
    rows."""

    data: jax.Array  # (E, n, u) root G of the information
    solve: jax.Array  # (E, u, n) y = solve b solves G y = b
    predicted: jax.Array  # (E, n, n) root of the predicted covariance
    updated: jax.Array  # (E, n, n) root of the filtered covariance
    whiten: jax.Array  # (E, u, u) inverse root of the covariance of the innovations, I + G'PG
    gain: jax.Array  # (E, n, u) Kalman gain
    keep: jax.Array  # (E, n, n) I - gain G', the part of a prediction that an update keeps
    back: jax.Array  # (E, n, n) regression of the state before an epoch on its predicted state
    drive: jax.Array  # (E, n, n) that of its whitened noise
    logdet: jax.Array  # log det of the posterior precision of all u


class Smoothed(NamedTuple):
    """Posterior means of states and whitened noises, one column each."""

    states: jax.Array  # (E, n, m)
    noises: jax.Array  # (E, n, m)


@partial(jax.jit, static_argnames="used")
def gains(F: jax.Array, L: jax.Array, J: jax.Array, used: tuple[int, ...]) -> Gains:
    """Covariance pass: transitions F, noise factors L and information J of the `used` state entries, all (E, n, n)."""
    E, n, _ = F.shape
    entries = jnp.asarray(used or (0,), int)
    root = semi_cholesky(J[:, entries[:, None], entries[None, :]])
    eye = jnp.eye(len(entries), dtype=F.dtype)
    everywhere = jnp.broadcast_to(eye, root.shape)
    data = jnp.zeros((E, n, len(entries)), F.dtype).at[:, entries].set(root)
    solve = jnp.zeros((E, len(entries), n), F.dtype).at[:, :, entries].set(forward(root, everywhere))
    predicted, updated, gain, std, shares = filter_roots(F, L, data)
    whiten = inverse_root(data, gain, std)
    gain = gain @ whiten
    keep = jnp.eye(n, dtype=F.dtype)[None] - gain @ data.mT
    logdet = 2.0 * jnp.sum(jnp.log(std))
    return Gains(data, solve, predicted, updated, whiten, gain, keep, shares[:, :n], shares[:, n:], logdet)


class Predicted(NamedTuple):
    """The prediction of each epoch before its data, and the change that the data make."""

    states: jax.Array  # (E, n, m)
    alone: jax.Array  # (E, u, m) the data y of b
    innovation: jax.Array  # (E, u, m) y - G' states
    moved: jax.Array  # (E, n, m) filtered less predicted states


@partial(jax.jit, static_argnames="free")
def predict(F: jax.Array, gain: Gains, b: jax.Array, c: jax.Array | None = None, *, free: bool = False) -> Predicted:
    """Filter columns b (E, n, m) with drifts c (E, n, q) of the first q (zero if None), predicting from what is before.

    Where b is `free` it need not be made of data, G y: what lies beside them is a force on the states.
    """
    alone = gain.solve @ b
    force = gain.updated @ (gain.updated.mT @ (b - gain.data @ alone)) if free else jnp.zeros_like(b)
    source = gain.gain @ alone + force
    if c is not None:
        source = source.at[:, :, : c.shape[2]].add(gain.keep @ c)
    filtered = recur(gain.keep @ F, source)
    states = F @ preceding(filtered)
    if c is not None:
        states = states.at[:, :, : c.shape[2]].add(c)
    innovation = alone - gain.data.mT @ states
    return Predicted(states, alone, innovation, gain.gain @ innovation + force)


@partial(jax.jit, static_argnames="free")
def smooth(F: jax.Array, gain: Gains, b: jax.Array, c: jax.Array | None = None, *, free: bool = False) -> Smoothed:
    """Smooth columns b (E, n, m) with drifts c (E, n, m) (see `predict`), forward and backward.

    The backward pass is that of Rauch, Tung and Striebel for d_k, by how much all data move a state from its
    prediction: d_k = filtered - predicted + back_k+1 d_k+1, u_k = drive_k d_k.
    """
    found = predict(F, gain, b, c, free=free)
    moved = recur(_next(gain.back), found.moved, reverse=True)
    return Smoothed(found.states + moved, gain.drive @ moved)


def _next(parts: jax.Array) -> jax.Array:
    """Of each epoch what belongs to the one after it (E, ...), zero at the last."""
    return jnp.concatenate([parts[1:], jnp.zeros_like(parts[:1])])


def innovate(F: jax.Array, gain: Gains, b: jax.Array, c: jax.Array | None = None) -> tuple[jax.Array, jax.Array]:
    """Columns b (E, n, m), q of them with drifts c (E, n, q), as unit-noise data: alone, and as innovations (E, u, m).

    `alone` solves G alone = b, and the innovation alone - G' x against the predicted x is whitened by its covariance
    I + G'PG. The sum of squares of the innovations, less that of `alone`, is -b'W^-1 b, W the precision of the whole
    trajectory: a forward pass is enough to eliminate it, and an error of x enters squared, so that a target grazing a
    sensor does no harm.
    """
    if c is None and not in_parallel():
        # `innovate` without drifts, epoch by epoch: no state of a column is ever written
        alone, n = gain.solve @ b, F.shape[1]
        onward = jnp.concatenate([gain.keep @ F, gain.gain], 2)
        seen = jnp.concatenate([-(gain.whiten @ (gain.data.mT @ F)), gain.whiten], 2)

        def step(x: jax.Array, epoch: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array]:
            onward_k, seen_k, y = epoch
            return multiply_rows(onward_k, [*x, *y]), multiply_rows(seen_k, [*x, *y])

        return alone, jax.lax.scan(step, jnp.zeros((n, b.shape[2]), b.dtype), (onward, seen, alone))[1]
    found = predict(F, gain, b, c)
    return found.alone, gain.whiten @ found.innovation


@jax.jit
def covariances(F: jax.Array, L: jax.Array, gain: Gains) -> tuple[jax.Array, jax.Array]:
    """Posterior covariances of every state and of every whitened noise, both (E, n, n), as sums of squares."""
    eye = jnp.eye(F.shape[-1], dtype=F.dtype)[None]

    def square(*roots):
        columns = jnp.concatenate(roots, 2)
        return columns @ columns.mT

    back = _next(gain.back)
    own = square((eye - back @ _next(F)) @ gain.updated, back @ _next(L))
    states = recur_squared(back, own, reverse=True)
    noises = square(gain.drive @ (F @ preceding(gain.updated)), eye - gain.drive @ L)
    return states, noises + gain.drive @ states @ gain.drive.mT


def respond(gain: Gains, states: jax.Array, b: jax.Array) -> jax.Array:
    """Joint posterior covariance of all states times columns b (E, n, m), by the covariances of each (E, n, n).

    The covariance of two epochs is that of the later one, regressed back. What `smooth` gives for a `free` b, but for
    what a difference of large numbers loses there.
    """
    own, back = states @ b, _next(gain.back)
    earlier = recur(gain.back.mT, b)
    return states @ earlier + back @ _next(recur(back, own, reverse=True))


@partial(jax.jit, inline=True)
def trajectory(F: jax.Array, L: jax.Array, c: jax.Array, noises: jax.Array) -> jax.Array:
    """States (E, n, m) of whitened noises (E, n, m) and drifts (E, n, m) (or (E, n, 1))."""
    return recur(F, L @ noises + c)
