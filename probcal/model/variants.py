"""Other models made from one: a part of it, some of its rows, rows counted twice, biases split or held."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from probcal.model.model import Model
from probcal.model.rows import BY_ROW, Block, Rows


def part(model: Model, r: int) -> Model:
    """The model of recursion r and its rows alone."""
    pairs = [(block, data) for block, data, own in model.each_block() if own == r]
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


def biases_alone(model: Model) -> Model:
    """The model of the biases, without rows and trajectories."""
    parts = ("blocks", "recursion", "recursions", "targets", "sampled", "rows")
    nothing: dict[str, Any] = dict.fromkeys(parts, ())
    return replace(model, **nothing, tilt=None)


def at_measured(model: Model) -> Model:
    """The model whose growing stds are those at the measured values, for starts; itself where none grows."""
    if not any(block.growing for block in model.blocks):
        return model
    return replace(model, blocks=tuple(replace(own, at_measured=bool(own.growing)) for own in model.blocks))


def counts(model: Model, of: Callable[[np.ndarray], np.ndarray]) -> list[np.ndarray]:
    """Counts (E,) at each epoch of each recursion: sums of what `of` makes of the mask (N, C), a number (N,) a row."""
    found = [np.zeros(recursion.drift.shape[0]) for recursion in model.recursions]
    for _, data, r in model.each_block():
        np.add.at(found[r], np.asarray(data.epoch), of(np.asarray(data.mask)))
    return found


def aligned(like: Model, later: Model, recursions: Sequence[int | None], targets: Sequence[Sequence[int]]) -> Model:
    """The rows and epochs of a later model in the form of an earlier one, whose blocks and targets it may lack.

    `recursions` names the later recursion behind each earlier one, `targets` which earlier target each later one is.
    """
    found, rows = [], []
    for part, r, names in like.each_layout(recursions, targets):
        if r is None:
            found.append(jax.tree.map(lambda leaf: np.asarray(leaf)[:0], part))
        else:
            mine = later.recursions[r]
            found.append(mine._replace(target=np.asarray(names, int)[np.asarray(mine.target)]))
    own = {(block, r): data for block, data, r in later.each_block()}
    for block, data, r in like.each_block():
        nothing = {name: np.asarray(getattr(data, name))[:0] for name in BY_ROW}
        rows.append(own.get((block, recursions[r]), data._replace(**nothing)))
    return replace(like, recursions=tuple(found), rows=tuple(rows))


def of_epochs(model: Model, r: int, kept: np.ndarray) -> Model:
    """The model with the rows of recursion r at the epochs that are kept (E,) only; its epochs stay."""

    def some(data: Rows) -> Rows:
        mine = np.flatnonzero(kept[np.asarray(data.epoch)])
        chosen: dict[str, Any] = {name: np.asarray(getattr(data, name))[mine] for name in BY_ROW}
        return data._replace(**chosen)

    return replace(model, rows=tuple(some(data) if own == r else data for _, data, own in model.each_block()))


def measured_twice(model: Model, y: Sequence[Any]) -> Model:
    """Every row twice, the second time with measured values y (N, C)."""

    def both(old: Rows, new: Rows) -> dict[str, Any]:
        return {name: jnp.concatenate([getattr(old, name), getattr(new, name)]) for name in BY_ROW}

    return model.with_rows(both, model.with_values(y).rows)


def split(model: Model, piece: Sequence[np.ndarray], count: int) -> Model:
    """Biases of its own for each of `count` pieces; `piece` (N,) is that of every row."""
    M = model.biases

    def copied(data: Rows, own: np.ndarray) -> dict[str, Any]:
        S, bias = data.bias.shape[0], np.asarray(data.bias)
        return {
            "sensor": np.asarray(data.sensor) + S * own,
            "bias": np.concatenate([np.where(bias < M, bias + p * M, count * M) for p in range(count)]),
            "scale": np.tile(data.scale, (count, 1)),
            "base": np.tile(data.base, (count, 1)),
        }

    return replace(model.with_rows(copied, piece), biases=count * M, tilt=None)


def of_read(model: Model) -> tuple[Model, np.ndarray]:
    """The model of the biases that its rows read alone, and which (K,) of the M they are."""
    M = model.biases
    read = np.unique(np.concatenate([np.zeros(0, int), *(own.ravel() for own in model.read)]))
    read = read[read < M]
    number = np.full(M + 1, len(read))
    number[read] = np.arange(len(read))
    chosen = model.with_rows(lambda data: {"bias": number[np.asarray(data.bias)]})
    return replace(chosen, biases=len(read), tilt=None), read


def differing(model: Model, along: Sequence[np.ndarray]) -> Model:
    """Further biases by which the M may differ from row to row: q of each, times `along` (N, q) of every row.

    After the M come those of the first column, then of the next.
    """
    M, q = model.biases, along[0].shape[1]

    def stepped(data: Rows, own: np.ndarray) -> dict[str, Any]:
        pattern, which = np.unique(own, axis=0, return_inverse=True)
        S, bias, scale, base = (data.bias.shape[0], *(np.asarray(a) for a in (data.bias, data.scale, data.base)))
        last = (1 + q) * M  # that of none
        first = np.where(bias < M, bias, last)
        biases, scales = [], []
        for row in pattern:
            more = [np.where((bias < M) & (row[j] != 0), bias + (1 + j) * M, last) for j in range(q)]
            biases.append(np.concatenate([first, *more], 1))
            scales.append(np.concatenate([scale, *(row[j] * scale for j in range(q))], 1))
        wide = np.concatenate([base, np.zeros((S, q * base.shape[1]))], 1)
        return {
            "sensor": np.asarray(data.sensor) + S * which.ravel(),
            "bias": np.concatenate(biases),
            "scale": np.concatenate(scales),
            "base": np.tile(wide, (len(pattern), 1)),
        }

    def read(block: Block, data: Rows) -> Block:
        own = (*range(data.bias.shape[1] - len(block.steps)), *block.steps)
        return replace(block, steps=(*block.steps, *q * own))

    blocks = tuple(read(block, data) for block, data, _ in model.each_block())
    return replace(model.with_rows(stepped, along), blocks=blocks, biases=(1 + q) * M, tilt=None)


def reading(model: Model, tables: Sequence[np.ndarray]) -> Model:
    """A model of `differing` whose sensors read further parameters by tables (S, k), which move no prediction.

    They take the places of the differences, so that kernels made for these serve.
    """

    def own(data: Rows, table: np.ndarray) -> dict[str, Any]:
        p, again = data.bias.shape[1] - table.shape[1], len(data.bias) // max(len(table), 1)
        bias = np.concatenate([np.asarray(data.bias)[:, :p], np.tile(table, (again, 1))], 1)
        return {"bias": bias, "scale": np.where(np.arange(bias.shape[1]) < p, data.scale, 0.0)}

    return model.with_rows(own, tables)


@partial(jax.jit, inline=True)
def placed(model: Model, mine: Sequence[jax.Array], place: jax.Array) -> Model:
    """The first node of the rows `mine` (N,) of each block moved to a place (d,)."""

    def moved(data: Rows, own: jax.Array) -> dict[str, Any]:
        first = jnp.where(own[:, None], place[None], data.pose[:, 0, : len(place)])
        return {"pose": data.pose.at[:, 0, : len(place)].set(first)}

    return model.with_rows(moved, mine)
