"""Other models made from one: a part of it, some of its rows, rows counted twice, biases split or held."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from probcal.model.model import Model
from probcal.model.rows import BY_ROW, Rows


def part(model: Model, r: int) -> Model:
    """The model of recursion r and its rows alone."""
    triples = zip(model.blocks, model.rows, model.recursion, strict=True)
    pairs = [(block, data) for block, data, own in triples if own == r]
    return replace(
        model,
        blocks=tuple(block for block, _ in pairs),
        recursion=(0,) * len(pairs),
        recursions=(model.recursions[r],),
        targets=(model.targets[r],),
        sampled=(model.sampled[r],),
        rows=tuple(data for _, data in pairs),
        tilt=None,
    )


def counts(model: Model, of: Callable[[np.ndarray], np.ndarray]) -> list[np.ndarray]:
    """Counts (E,) at each epoch of each recursion: sums of what `of` makes of the mask (N, C), a number (N,) a row."""
    found = [np.zeros(recursion.drift.shape[0]) for recursion in model.recursions]
    for data, r in zip(model.rows, model.recursion, strict=True):
        np.add.at(found[r], np.asarray(data.epoch), of(np.asarray(data.mask)))
    return found


def aligned(like: Model, later: Model, recursions: Sequence[int | None], targets: Sequence[Sequence[int]]) -> Model:
    """The rows and epochs of a later model in the form of an earlier one, whose blocks and targets it may lack.

    `recursions` names the later recursion behind each earlier one, `targets` which earlier target each later one is.
    """
    found, rows = [], []
    for part, r, names in zip(like.recursions, recursions, targets, strict=True):
        if r is None:
            found.append(jax.tree.map(lambda leaf: leaf[:0], part))
        else:
            mine = later.recursions[r]
            found.append(mine._replace(target=np.asarray(names, int)[np.asarray(mine.target)]))
    own: dict[Any, Rows] = {(b, r): data for b, data, r in zip(later.blocks, later.rows, later.recursion, strict=True)}
    for block, data, r in zip(like.blocks, like.rows, like.recursion, strict=True):
        nothing = {name: getattr(data, name)[:0] for name in BY_ROW}
        rows.append(own.get((block, recursions[r]), data._replace(**nothing)))
    return replace(like, recursions=tuple(found), rows=tuple(rows))


def of_epochs(model: Model, r: int, kept: np.ndarray) -> Model:
    """The model with the rows of recursion r at the epochs that are kept (E,) only; its epochs stay."""

    def some(data: Rows) -> Rows:
        mine = np.flatnonzero(kept[np.asarray(data.epoch)])
        chosen: dict[str, Any] = {name: np.asarray(getattr(data, name))[mine] for name in BY_ROW}
        return data._replace(**chosen)

    pairs = zip(model.rows, model.recursion, strict=True)
    return replace(model, rows=tuple(some(data) if own == r else data for data, own in pairs))


def measured_twice(model: Model, y: Sequence[Any]) -> Model:
    """Every row twice, the second time with measured values y (N, C)."""
    again = model.with_values(y)
    pairs = zip(model.rows, again.rows, strict=True)
    both = [
        old._replace(**{name: jnp.concatenate([getattr(old, name), getattr(new, name)]) for name in BY_ROW})
        for old, new in pairs
    ]
    return replace(model, rows=tuple(both))


def split(model: Model, piece: Sequence[np.ndarray], count: int) -> Model:
    """Biases of its own for each of `count` pieces; `piece` (N,) is that of every row."""
    M, rows = model.biases, []
    for data, own in zip(model.rows, piece, strict=True):
        S, bias = data.bias.shape[0], np.asarray(data.bias)
        copied: dict[str, Any] = {
            "sensor": np.asarray(data.sensor) + S * own,
            "bias": np.concatenate([np.where(bias < M, bias + p * M, count * M) for p in range(count)]),
            "scale": np.tile(data.scale, (count, 1)),
            "base": np.tile(data.base, (count, 1)),
        }
        rows.append(data._replace(**copied))
    return replace(model, biases=count * M, rows=tuple(rows), tilt=None)


def placed(model: Model, mine: Sequence[jax.Array], place: jax.Array) -> Model:
    """The first node of the rows `mine` (N,) of each block moved to a place (d,)."""
    rows = []
    for data, own in zip(model.rows, mine, strict=True):
        first = jnp.where(own[:, None], place[None], data.pose[:, 0, : len(place)])
        rows.append(data._replace(pose=data.pose.at[:, 0, : len(place)].set(first)))
    return replace(model, rows=tuple(rows))


def without(model: Model, held: np.ndarray) -> Model:
    """The model that does not feel the biases in `held` (M,), which stay columns."""
    felt = np.append(~held, True)
    rows = (data._replace(scale=np.asarray(data.scale) * felt[np.asarray(data.bias)]) for data in model.rows)
    return replace(model, rows=tuple(rows))
