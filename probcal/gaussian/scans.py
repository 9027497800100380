"""Recurrences over epochs, one after the other or in parallel: the depth of a scan is then the logarithm of its length.

In parallel (Blelloch 1990) a scan does a few times the work, which pays where many processors wait for one: on an
accelerator. Covariances of the filter are scanned as square roots (Yaghoobi, Corenflos, Hassan, Sarkka 2022).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from probcal.linalg import forward, multiply, observe, preceding, regress_rows, tria

PARALLEL: bool | None = None  # None: wherever the backend is no CPU; read where a kernel is traced


def in_parallel() -> bool:
    """True if epochs are scanned in parallel."""
    return jax.default_backend() != "cpu" if PARALLEL is None else PARALLEL


def recur(T: jax.Array, s: jax.Array, *, reverse: bool = False) -> jax.Array:
    """All x_k = T_k x_k-1 + s_k (E, n, m) from zero, for T (E, n, n); from the last to the first if `reverse`."""
    if in_parallel():

        def join(first: tuple[jax.Array, jax.Array], then: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            return then[0] @ first[0], then[0] @ first[1] + then[1]

        return jax.lax.associative_scan(join, (T, s), reverse=reverse)[1]

    def step(x: jax.Array, epoch: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        x = multiply(epoch[0], x) + epoch[1]
        return x, x

    return jax.lax.scan(step, jnp.zeros_like(s[0]), (T, s), reverse=reverse)[1]


def recur_squared(T: jax.Array, own: jax.Array, *, reverse: bool = False) -> jax.Array:
    """All C_k = T_k C_k-1 T_k' + own_k (E, n, n) from zero; from the last to the first if `reverse`."""
    if in_parallel():

        def join(first: tuple[jax.Array, jax.Array], then: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            return then[0] @ first[0], then[0] @ first[1] @ then[0].mT + then[1]

        return jax.lax.associative_scan(join, (T, own), reverse=reverse)[1]

    def step(C: jax.Array, epoch: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        C = multiply(epoch[0], multiply(C, epoch[0].T)) + epoch[1]
        return C, C

    return jax.lax.scan(step, jnp.zeros_like(own[0]), (T, own), reverse=reverse)[1]


class FilterPass(NamedTuple):
    """The covariance pass of a filter, epoch by epoch."""

    predicted: jax.Array  # (E, n, n) root of the predicted covariance
    updated: jax.Array  # (E, n, n) root of the filtered covariance
    gain: jax.Array  # (E, n, u) gain of each datum by its whitened innovation, one after another
    std: jax.Array  # (E, u) std of that innovation
    shares: jax.Array  # (E, 2n, n) regression of the state before an epoch, and of its noise, on its predicted state


def filter_roots(F: jax.Array, L: jax.Array, data: jax.Array) -> FilterPass:
    """The covariance pass for transitions F and noise factors L (E, n, n), and unit-noise data `data`' x (E, n, u)."""
    n = F.shape[1]

    def step(root: jax.Array, epoch: tuple[jax.Array, ...]) -> tuple[jax.Array, FilterPass]:
        F_k, L_k, G_k = epoch
        causes = jnp.concatenate([jnp.pad(root, ((0, 0), (0, n))), jnp.eye(n, 2 * n, n, F.dtype)])
        shares, predicted = regress_rows(causes, jnp.concatenate([multiply(F_k, root), L_k], 1))
        updated, gain, std = observe(predicted, G_k)
        return updated, FilterPass(predicted, updated, gain, std, shares)

    if in_parallel():
        before = _updated(F, L, data)
        return jax.vmap(step)(preceding(before), (F, L, data))[1]
    return jax.lax.scan(step, jnp.zeros((n, n), F.dtype), (F, L, data))[1]


def inverse_root(data: jax.Array, gain: jax.Array, std: jax.Array) -> jax.Array:
    """Inverse root (E, u, u) of the covariance of the innovations, I + G'PG, from what `observe` leaves."""
    eye = jnp.eye(std.shape[1], dtype=std.dtype)
    everywhere = jnp.broadcast_to(eye, (std.shape[0], *eye.shape))
    return forward(jnp.tril(data.mT @ gain, -1) + std[:, :, None] * eye[None], everywhere)


class _Segment(NamedTuple):
    """The transition of a segment, A x of root U, and its information Z Z' on the state before
    it."""

    A: jax.Array  # (E, n, n)
    U: jax.Array  # (E, n, n)
    Z: jax.Array  # (E, n, n)


def _updated(F: jax.Array, L: jax.Array, data: jax.Array) -> jax.Array:
    """Roots (E, n, n) of the filtered covariances."""
    n, u = data.shape[1:]
    root, gain, std = jax.vmap(observe)(L, data)
    whiten = inverse_root(data, gain, std)
    keep = jnp.eye(n, dtype=F.dtype)[None] - (gain @ whiten) @ data.mT
    told = F.mT @ data @ whiten.mT
    segments = _Segment(keep @ F, jax.vmap(tria)(root), jnp.pad(told, ((0, 0), (0, 0), (0, n - u))))
    return jax.lax.associative_scan(_joined, segments)[1]


def _joined(first: _Segment, then: _Segment) -> _Segment:
    """Two stretches, one after the other."""
    n = first.A.shape[1]
    eye = jnp.broadcast_to(jnp.eye(n, dtype=first.A.dtype), first.A.shape)
    above = jnp.concatenate([first.U.mT @ then.Z, eye], 2)
    both = jax.vmap(tria)(jnp.concatenate([above, jnp.concatenate([then.Z, jnp.zeros_like(eye)], 2)], 1))
    corner, below, rest = both[:, :n, :n], both[:, n:, :n], both[:, n:, n:]
    moved = then.A @ forward(corner, first.U.mT).mT
    return _Segment(
        then.A @ first.A - moved @ (below.mT @ first.A),
        jax.vmap(tria)(jnp.concatenate([moved, then.U], 2)),
        jax.vmap(tria)(jnp.concatenate([first.A.mT @ rest, first.Z], 2)),
    )
