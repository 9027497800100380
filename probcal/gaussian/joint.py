"""The joint precision of all states and biases as a sparse matrix, for networks whose dense form
does not fit.

A row couples the state of its epoch with the biases of its sensor, and motion one epoch with the
next: of the n^2 entries few are not zero. One Cholesky factor solves what `eliminate` and a Schur
complement do where it is dense.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from probcal.gaussian.engine import Factors
from probcal.gaussian.factor import Entries, leading, mirrored
from probcal.gaussian.mode import factors, inverse_factors
from probcal.linalg import outer
from probcal.model.model import Model
from probcal.model.rows import LinearRows


def missing(model: Model) -> str:
    """A feature of a model that the sparse form does not take, in words; empty if it takes all."""
    if any(form is not None for form in model.sampled):
        return "a motion without a linear form"
    if any(not np.all(_drives(part) | _carries(part) | _fixes(part)) for part in model.recursions):
        return "a motion whose noise reaches only a part of the state"
    return ""


def _drives(part: Any) -> np.ndarray:
    """Epochs (E,) whose noise reaches every direction of the state."""
    values = np.linalg.svd(np.asarray(part.L), compute_uv=False)
    return values[:, -1] > 1e-12 * values[:, 0]


def _carries(part: Any) -> np.ndarray:
    """Epochs (E,) at which a state stays exactly what it was."""
    still = np.all(np.asarray(part.F) == np.eye(part.F.shape[1]), (1, 2))
    return still & np.all(np.asarray(part.L) == 0, (1, 2)) & np.all(np.asarray(part.drift) == 0, 1)


def _fixes(part: Any) -> np.ndarray:
    """Epochs (E,) whose state is known."""
    return np.all(np.asarray(part.F) == 0, (1, 2)) & np.all(np.asarray(part.L) == 0, (1, 2))


@dataclass(frozen=True, eq=False)
class JointPrecision:
    """The sources of the entries of a model's joint precision: states first, then the M biases.

    `kept` (entries,) are their places among all values of `_values`, `times` (entries,) what each
    counts. A state that stays what it was has the variables of the epoch before; one that is known
    has none, -1 in `slots`.
    """

    places: Entries
    kept: np.ndarray
    times: np.ndarray
    slots: tuple[np.ndarray, ...]  # (E, n) variable of each entry of the states of each recursion
    driven: tuple[np.ndarray, ...]  # (E,) whether an epoch has variables of its own
    states: int  # number of variables that are states
    count: int  # of all values of `_values`
    extra: np.ndarray  # (X, 2) further pairs of biases that have a place, before all others
    _wider: list[JointPrecision] = field(default_factory=list)  # that was asked for last

    @classmethod
    def of(cls, model: Model, pairs: Sequence[np.ndarray] = ()) -> JointPrecision:
        """The pattern of a model, its biases in blocks of one sensor.

        Biases in one row of `pairs` (B, p), M of none, have an entry with each other, as those have
        that integrated places couple.
        """
        slots, driven, start = [], [], 0
        for part in model.recursions:
            E, n = part.drift.shape
            own = _drives(part) if E else np.zeros(0, bool)
            at = start + n * (np.cumsum(own) - 1)
            base = np.where(own, at, -1)
            for k in np.flatnonzero(_carries(part) & ~own) if E else ():
                base[k] = base[k - 1]
            slots.append(np.where(base[:, None] >= 0, base[:, None] + np.arange(n), -1))
            driven.append(own)
            start += n * int(own.sum())
        extra = _pairs_of(model, pairs)
        rows, columns, times = _entries(model, slots, driven, start)
        rows, columns = (
            np.concatenate([start + own, rest]) for own, rest in zip(extra.T, (rows, columns), strict=True)
        )
        times = np.concatenate([np.ones(len(extra)), times])
        kept = np.flatnonzero((rows >= 0) & (columns >= 0))
        low, high = np.minimum(rows, columns)[kept], np.maximum(rows, columns)[kept]
        size = start + model.biases
        diagonal = np.zeros(size, int)
        on = np.flatnonzero(low == high)
        diagonal[low[on]] = on
        blocks = start + blocks_of(model)
        places = Entries(low.astype(np.int32), high.astype(np.int32), size, diagonal, blocks)
        return cls(places, kept, times[kept], tuple(slots), tuple(driven), start, len(rows), extra)

    def values(self, model: Model, lins: LinearRows, levels: jax.Array) -> np.ndarray:
        """Entries (entries,) of the precision of data and motion, the biases without prior."""
        found = np.asarray(_values(model, lins, levels))
        more = np.zeros(len(self.extra))
        if model.tilt is not None:
            more = np.asarray(model.tilt.between(*self.extra.T))
        return np.concatenate([more, found])[self.kept] * self.times

    def under(self, values: np.ndarray, factors: Factors) -> np.ndarray:
        """Entries (entries,) with Gaussian factors, each pair of whose biases has a place."""
        whole = values.copy()
        for group in factors.groups:
            pairs, precision = self.pairs(np.asarray(group.members)), np.asarray(group.precision)
            upper = np.triu(np.ones(pairs.shape[1:], bool))[None] & (pairs >= 0)
            np.add.at(whole, pairs[upper], precision[upper])
        return whole

    def with_pairs(self, model: Model, pairs: Sequence[np.ndarray]) -> JointPrecision:
        """A pattern with entries for the biases in one row of `pairs` (B, p); this one where it has
        them."""
        if all(self.holds(own) for own in pairs):
            return self
        if not (self._wider and all(self._wider[0].holds(own) for own in pairs)):
            self._wider[:] = [JointPrecision.of(model, pairs)]
        return self._wider[0]

    def holds(self, members: np.ndarray) -> bool:
        """True if all pairs of biases (B, p) of a row have a place."""
        there = members < self.places.size - self.states
        return bool((self.pairs(members) >= 0)[outer(there)].all())

    def block_values(self, members: np.ndarray, pairs: np.ndarray, inverse: np.ndarray) -> np.ndarray:
        """Covariances (B, p, p) of biases (B, p), of their `pairs` in the inverse at the places of
        the entries."""
        none = members == self.places.size - self.states
        return np.where(pairs >= 0, inverse[pairs], np.eye(members.shape[1])[None] * none[:, None])

    def pairs(self, members: np.ndarray) -> np.ndarray:
        """The indices of the entries (B, p, p) of pairs of biases (B, p), else -1; M is no bias."""
        order, keys = self._order
        low = np.minimum(members[:, :, None], members[:, None, :]) + self.states
        high = np.maximum(members[:, :, None], members[:, None, :]) + self.states
        wanted = low.astype(np.int64) * self.places.size + high
        at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        there = (high < self.places.size) & (keys[at] == wanted)
        return np.where(there, order[at], -1)

    @cached_property
    def _order(self) -> tuple[np.ndarray, np.ndarray]:
        """The entries sorted by their places, and a number of each place, ascending."""
        keys = self.places.row.astype(np.int64) * self.places.size + self.places.column
        order = np.argsort(keys, kind="stable")
        return order, keys[order]

    def steps(self, model: Model, inverse: np.ndarray) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Covariances (E, n, n) of each state of each recursion, of the one before, and between
        that and it.

        From the inverse at the places of the entries; 0 where states are known, or come from none.
        """
        whole, at = np.zeros(self.count), len(self.extra)
        whole[self.kept] = inverse
        found = []
        for part in model.recursions:
            E, n = part.drift.shape
            half = n * (n + 1) // 2
            own, before = (whole[at + k * E * half : at + (k + 1) * E * half].reshape(E, half) for k in (0, 1))
            across = whole[at + 2 * E * half : at + E * (2 * half + n * n)].reshape(E, n, n)
            found.append((_symmetric(own, n), _symmetric(before, n), across))
            at += E * (2 * half + n * n)
        return found

    def predicted_variances(self, model: Model, lins: LinearRows, inverse: np.ndarray) -> list[np.ndarray]:
        """Variance (N, C) of each predicted value of each block, from the inverse at the places of
        the entries."""
        whole, states = np.zeros(self.count), [own for own, _, _ in self.steps(model, inverse)]
        whole[self.kept] = inverse
        at = len(self.extra) + sum(len(x) * x.shape[1] * (2 * x.shape[1] + 1) for x in states)
        found = []
        for block, data, r, lin in model.each_block(lins):
            (N, p), u, S = (len(data.epoch), data.bias.shape[1]), len(block.used), len(data.bias)
            both = whole[at : at + N * p * u].reshape(N, p, u)
            at += N * p * u
            half = p * (p + 1) // 2
            biases = _symmetric(whole[at : at + S * half].reshape(S, half), p)[np.asarray(data.sensor)]
            at += S * half
            used = list(block.used)
            own = states[r][np.asarray(data.epoch)][:, used][:, :, used]
            H, B = np.asarray(lin.state), np.asarray(lin.bias)
            total = np.sum((H @ own) * H, 2) + np.sum((B @ biases) * B, 2)
            found.append(total + 2.0 * np.sum((B @ both) * H, 2))
        return found

    def of_states(self, values: np.ndarray) -> tuple[Entries, np.ndarray]:
        """The precision of the states at held biases."""
        return leading(self.places, values, self.states)

    def across(self, values: np.ndarray) -> Any:
        """The part (states, M) of the precision between states and biases, sparse."""
        return mirrored(self.places, values).tocsr()[: self.states, self.states :]

    def of_biases(self, pull: np.ndarray) -> np.ndarray:
        """A right-hand side (n,) with entries (M,) or (M, K) for the biases alone."""
        return np.concatenate([np.zeros((self.states, *pull.shape[1:])), pull])

    def state_values(self, values: np.ndarray) -> list[np.ndarray]:
        """Of values (n,) of all variables those of the states (E, n) of each recursion, 0 where
        they are known."""
        padded = np.append(values, 0.0)
        return [padded[own] for own in self.slots]

    def correction(self, model: Model, levels: jax.Array) -> float:
        """Twice the sum of log |L|, by which log det W of whitened noises is above that of the
        states."""
        total = 0.0
        for part, own in model.each_layout(self.driven):
            if own.any():
                total += 2.0 * float(np.sum(np.linalg.slogdet(np.asarray(factors(part, levels))[own])[1]))
        return total


def _pairs_of(model: Model, pairs: Sequence[np.ndarray]) -> np.ndarray:
    """Further pairs (X, 2) of biases, low first, each once; those of a tilt too."""
    M = model.biases
    found = [np.zeros((0, 2), int)]
    if model.tilt is not None and np.any(np.asarray(model.tilt.curvature)):
        pairs = [*pairs, np.arange(M).reshape((1, M) if model.tilt.curvature.ndim == 2 else (M, 1))]
    for own in pairs:
        i, j = np.triu_indices(own.shape[1])
        found.append(np.sort(np.stack([own[:, i].ravel(), own[:, j].ravel()], 1), 1))
    every = np.unique(np.concatenate(found), axis=0)
    return every[every[:, 1] < M]


def _symmetric(upper: np.ndarray, n: int) -> np.ndarray:
    """Symmetric matrices (K, n, n) of their upper triangles (K, n (n + 1) / 2)."""
    found = np.zeros((len(upper), n, n))
    i, j = np.triu_indices(n)
    found[:, i, j] = found[:, j, i] = upper
    return found


def blocks_of(model: Model) -> np.ndarray:
    """Biases (B, p) of each sensor that no sensor before has, M of none; those of no sensor by
    themselves."""
    M = model.biases
    taken, members = np.zeros(M + 1, bool), list[np.ndarray]()
    taken[M] = True
    wide = max((data.bias.shape[1] for data in model.rows), default=1)
    for data in model.rows:
        own = np.sort(np.asarray(data.bias), 1)
        own = np.where(np.concatenate([np.zeros((len(own), 1), bool), own[:, 1:] == own[:, :-1]], 1), M, own)
        values, first = np.unique(own, return_index=True)
        mine = np.full(own.size, M)
        mine[first] = np.where(taken[values], M, values)
        taken[values] = True
        room = wide - own.shape[1]
        members.append(np.pad(mine.reshape(own.shape), ((0, 0), (0, room)), constant_values=M))
    alone = np.flatnonzero(~taken)[:, None]
    members.append(np.pad(alone, ((0, 0), (0, wide - 1)), constant_values=M))
    found = np.concatenate(members)
    return found[(found < M).any(1)]


def _entries(
    model: Model, slots: list[np.ndarray], driven: list[np.ndarray], states: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Row, column and count of every value of `_values`, -1 where it has no place."""
    M, rows, columns, times = model.biases, list[np.ndarray](), list[np.ndarray](), list[np.ndarray]()

    def add(row: np.ndarray, column: np.ndarray, count: Any = 1.0) -> None:
        row, column = np.broadcast_arrays(row, column)
        rows.append(row.ravel())
        columns.append(column.ravel())
        times.append(np.broadcast_to(count, row.shape).ravel())

    for part, own, drives in model.each_layout(slots, driven):
        i, j = np.triu_indices(own.shape[1])
        add(own[:, i], own[:, j])
        follows = drives & np.any(np.asarray(part.F) != 0, (1, 2))
        before = np.where(follows[:, None], np.concatenate([np.full_like(own[:1], -1), own[:-1]]), -1)
        add(before[:, i], before[:, j])  # of the motion to the next epoch
        add(before[:, :, None], own[:, None, :])
    for block, data, r in model.each_block():
        reached = slots[r][np.asarray(data.epoch)][:, list(block.used)]  # (N, u)
        bias = np.asarray(data.bias)
        free = np.where(bias < M, states + bias, -1)
        add(reached[:, None, :], free[np.asarray(data.sensor)][:, :, None])
        i, j = np.triu_indices(bias.shape[1])
        add(free[:, i], free[:, j], np.where((bias[:, i] == bias[:, j]) & (i != j), 2.0, 1.0))
    add(states + np.arange(M), states + np.arange(M))
    return np.concatenate(rows), np.concatenate(columns), np.concatenate(times)


@jax.jit
def _values(model: Model, lins: LinearRows, levels: jax.Array) -> jax.Array:
    """Values of the blocks of the joint precision in the order of `_entries`, the diagonal of the
    biases zero."""
    found = []
    for part, (J, _) in model.each_layout(model.of_states(lins)):
        n = J.shape[1]
        i, j = np.triu_indices(n)
        inverse = inverse_factors(part, levels)
        back = inverse @ part.F
        found += [(J + inverse.mT @ inverse)[:, i, j], (back.mT @ back)[:, i, j], -(back.mT @ inverse)]
    for _, data, _, lin in model.each_block(lins):
        found.append(jnp.einsum("ncp,nc,ncu->npu", lin.bias, lin.weight, lin.state))
        own = jnp.einsum("ncp,nc,ncq->npq", lin.bias, lin.weight, lin.bias)
        i, j = np.triu_indices(own.shape[1])
        found.append(jax.ops.segment_sum(own, data.sensor, data.bias.shape[0])[:, i, j])
    return jnp.concatenate([*(part.ravel() for part in found), jnp.zeros(model.biases)])
