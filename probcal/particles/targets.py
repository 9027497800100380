"""The epochs of each target by itself: given the biases no target knows of another, so that each is filtered alone."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal.linalg import handedness
from probcal.model.epochs import Epoch
from probcal.model.model import Model
from probcal.model.rows import BY_ROW


class Targets(NamedTuple):
    """The T targets of one recursion, K epochs of each, those behind its last one empty.

    `model` has one target: a state has 1 leading, and nothing in it depends on the number of rows.
    """

    model: Model
    epochs: Epoch  # (T, K) leading
    there: jax.Array  # (T, K) whether a target has so many epochs
    place: jax.Array  # (T, K) which epoch of the recursion it is; the number of them where there is none


def targets_of(model: Model) -> tuple[Targets, ...]:
    """The targets of each recursion of a model."""
    epochs = jax.tree.map(np.asarray, model.epochs())
    return tuple(_of(model, epochs, r) for r in range(len(model.recursions)))


def _of(model: Model, epochs: Epoch, r: int) -> Targets:
    """The targets of one recursion; `epochs` are those of all, in time order."""
    owner, mine = np.asarray(model.recursions[r].target), np.flatnonzero(epochs.recursion == r)
    order = [np.flatnonzero(owner == t) for t in range(model.targets[r])]
    of = [mine[epochs.target[r][mine] == t] for t in range(model.targets[r])]
    K = max(len(one) for one in of)
    there = np.arange(K) < np.array([len(one) for one in of])[:, None]
    pick = np.stack([np.concatenate([one, np.full(K - len(one), one[-1])]) for one in of])
    index = np.stack([np.concatenate([one, np.full(K - len(one), len(owner))]) for one in order])
    blocks = [b for b, own in enumerate(model.recursion) if own == r]

    def taken(leaf: Any) -> Any:
        return leaf[pick]

    rows = tuple(jax.tree.map(taken, epochs.rows[b]) for b in blocks)
    rows = tuple(seen._replace(mask=seen.mask * there[:, :, None, None]) for seen in rows)
    picked: Any = dict(
        time=taken(epochs.time), dt=np.where(there, taken(epochs.dt), 1.0), first=taken(epochs.first) & there,
        recursion=np.zeros_like(index), target=(np.zeros_like(index),),
        move=(jax.tree.map(taken, epochs.move[r]),), rows=rows,
    )  # fmt: skip
    found: Any = (_alone(model, r, blocks), epochs._replace(**picked), there, index)
    return jax.device_put(Targets(*found))


def _alone(model: Model, r: int, blocks: list[int]) -> Model:
    """A model of one target of a recursion, of a single row a block: the numbers of an epoch come with the epoch."""
    part: Any = jax.tree.map(lambda leaf: np.asarray(leaf)[:1], model.recursions[r])
    every: Any = [model.rows[b] for b in blocks]
    rows = [data._replace(**{name: np.asarray(getattr(data, name))[:1] for name in BY_ROW}) for data in every]
    moving = np.asarray(model.recursions[r].L)[~np.asarray(model.recursions[r].first)]  # a start needs no density
    rank = bool(handedness(moving).all())
    return replace(
        model, blocks=tuple(model.blocks[b] for b in blocks), recursion=(0,) * len(blocks), targets=(1,),
        full_rank=rank, sampled=(model.sampled[r],), recursions=(part,), rows=tuple(rows),
    )  # fmt: skip


def weigh_rows(targets: Targets, weight: jax.Array) -> Targets:
    """The targets with every datum counted by a weight ()."""
    rows = tuple(seen._replace(mask=seen.mask * weight) for seen in targets.epochs.rows)
    return targets._replace(epochs=targets.epochs._replace(rows=rows))


def place_by_epoch(index: jax.Array, leaf: jax.Array, E: int) -> jax.Array:
    """(T, K, ...) put at the epochs (T, K) of E, those that are none left out."""
    flat = leaf.reshape(-1, *leaf.shape[2:])
    return jnp.zeros((E, *flat.shape[1:]), leaf.dtype).at[index.reshape(-1)].set(flat, mode="drop")


def along_targets(index: jax.Array, leaf: jax.Array) -> jax.Array:
    """(E, ...) of a recursion as (T, K, ...), what is behind a target's last epoch that epoch's again."""
    last = jnp.max(jnp.where(index < leaf.shape[0], index, -1), 1, keepdims=True)
    return leaf[jnp.where(index < leaf.shape[0], index, last)]
