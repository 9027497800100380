"""The rows of one epoch linearised about a belief: by derivatives, or by sigma points of state and biases together."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal.model import rows as waist
from probcal.model.epochs import Epoch
from probcal.model.model import Model
from probcal.model.rows import Block, Linearised, Rows
from probcal.model.sigma import Rule, regress, sigma_points
from probcal.noise import gate_limits
from probcal.stream.filters.belief import Augmented, Slots, WhiteRow


class About(NamedTuple):
    """The point at which rows are linearised: a state and the biases."""

    x: jax.Array  # (n,)
    z: jax.Array  # (M,)


def centre(belief: Augmented, own: Slots) -> About:
    """The means of a belief."""
    return About(own.m + own.B @ belief.mean, belief.mean)


def here(model: Model, epoch: Epoch, r: int) -> list[tuple[int, Block, Rows]]:
    """Blocks that see recursion r, with their rows at an epoch."""
    blocks = enumerate(model.each_block(epoch.rows))
    return [(b, block, seen.rows_of(data)) for b, (block, data, own, seen) in blocks if own == r]


def linearised(model: Model, epoch: Epoch, r: int, at: About, levels: jax.Array, odds: float = 0.0) -> list[WhiteRow]:
    """The data of an epoch of recursion r about a point, (P C,) of each block: by derivatives.

    A datum has the expected information, or the step weight of its noise family where that is less: one that lies far
    off says little, and does not make the filter sure of where it is.
    """
    found = []
    for _, block, data in here(model, epoch, r):
        lin = waist.linearise(block, data, at.x[None], at.z, levels, expected=True)
        predicted = waist.predict(block, data, at.x[None], at.z)
        _, step = waist.weigh(block, data, predicted, levels, expected=False)
        lin = lin._replace(weight=jnp.minimum(lin.weight, step))
        found.append(_rows(block, data, lin, at, predicted, waist.noise_std(data, levels), odds))
    return found


def regressed(
    model: Model, epoch: Epoch, r: int, belief: Augmented, own: Slots, levels: jax.Array, rule: Rule, odds: float = 0.0
) -> list[WhiteRow]:
    """The data of an epoch of recursion r regressed on state and biases over a belief, (P C,) of each block.

    Statistical linearisation (Arasaratnam, Haykin 2009; Julier, Uhlmann 2004) by points that move what each row
    reads alone, so that their number does not grow with the network.
    """
    at = centre(belief, own)
    reach = own.B @ belief.root
    state = own.R @ own.R.T + reach @ reach.T
    cross = reach @ belief.root.T
    biases = belief.root @ belief.root.T
    found = []
    for _, block, data in here(model, epoch, r):
        used = np.asarray(block.used, int)
        read = data.bias[data.sensor]  # (P, p), M where fixed
        free = read < at.z.shape[0]
        which = jnp.minimum(read, at.z.shape[0] - 1)
        P, u = read.shape[0], len(used)
        own_x = jnp.broadcast_to(state[used[:, None], used[None, :]], (P, u, u))
        own_xz = jnp.where(free[:, None, :], cross[used][:, which].transpose(1, 0, 2), 0.0)
        own_z = jnp.where(free[:, :, None] & free[:, None, :], biases[which[:, :, None], which[:, None, :]], 0.0)
        whole = jnp.concatenate([jnp.concatenate([own_x, own_xz], 2), jnp.concatenate([own_xz.mT, own_z], 2)], 1)
        found.append(_rows(block, data, *_regress(block, data, at, whole, rule, levels), odds))
    return found


def _regress(
    block: Block, data: Rows, at: About, covariance: jax.Array, rule: Rule, levels: jax.Array
) -> tuple[Linearised, About, jax.Array, jax.Array]:
    """Rows regressed over what they read, covariance (P, u + p, u + p); where, their predicted values and stds."""
    used = np.asarray(block.used, int)
    points = sigma_points(covariance, rule)
    base = waist.read_biases(block, data, at.z)  # (P, p) in their units
    scale = data.scale[data.sensor]

    def value(move: jax.Array) -> jax.Array:
        x = jnp.broadcast_to(at.x, (base.shape[0], at.x.shape[0]))
        x = x.at[:, used].add(move[:, : len(used)]) if len(used) else x
        return waist.predict_local(block, data, x, base + scale * move[:, len(used) :])

    reference = value(jnp.zeros_like(points.shift[0]))
    mean, slope, extra = regress(block, points, jax.lax.map(value, points.shift), reference)
    std = jnp.sqrt(waist.noise_std(data, levels) ** 2 + extra)
    score, information = waist.weigh(block, data, reference + mean, levels, expected=True, extra=extra)
    step = waist.weigh(block, data, reference + mean, levels, expected=False, extra=extra)[1]
    information = jnp.minimum(information, step)
    by = jnp.einsum("pcu,puv->pcv", slope, points.whiten)
    lin = Linearised(score, information, by[:, :, : len(used)], by[:, :, len(used) :])
    return lin, at, reference + mean, std


def _rows(
    block: Block, data: Rows, lin: Linearised, at: About, predicted: jax.Array, std: jax.Array, odds: float
) -> WhiteRow:
    """Whitened data (P C,) of a block linearised about a point; zero where nothing was measured."""
    there = (data.mask > 0) & (lin.weight > 0)
    weight = jnp.where(there, lin.weight, 1.0)
    root = jnp.where(there, jnp.sqrt(weight), 0.0)
    state = jnp.where(there[:, :, None], lin.state, 0.0)
    bias = jnp.where(there[:, :, None], lin.bias, 0.0)
    P, C, M = *there.shape, at.z.shape[0]
    hx = jnp.zeros((P, C, at.x.shape[0])).at[:, :, np.asarray(block.used, int)].set(state)
    read = data.bias[data.sensor]
    place = jnp.arange(P)[:, None, None], jnp.arange(C)[None, :, None], read[:, None, :]
    hz = jnp.zeros((P, C, M + 1)).at[place].add(bias)[:, :, :M]
    value = jnp.where(there, lin.score / weight, 0.0) + hx @ at.x + hz @ at.z
    residual = jnp.where(there, waist.innovation(block, data, predicted) / std, 0.0)
    ratio = jnp.where(there, root * std, 1.0)
    low, high = _limits(block, data, std, odds)
    shift = residual - jnp.where(there, lin.score / jnp.sqrt(weight), 0.0) / ratio
    scaled = WhiteRow(
        root * value, root[:, :, None] * hx, root[:, :, None] * hz, shift, ratio, low, high, jnp.zeros((P, C), jnp.int8)
    )
    return jax.tree.map(lambda leaf: leaf.reshape(P * C, *leaf.shape[2:]), scaled)


def _limits(block: Block, data: Rows, std: jax.Array, odds: float) -> tuple[jax.Array, jax.Array]:
    """Residuals (P, C) over the std beyond which data of a block are held back."""
    found = np.array([gate_limits(channel.noise, odds) for channel in block.channels]).T
    low, high = (jnp.broadcast_to(jnp.asarray(limit), std.shape) for limit in found)
    floors = np.array([getattr(channel.noise, "floor", None) is not None for channel in block.channels])
    if floors.any():  # a value at the floor says nothing of how far below it the prediction may lie
        floor = np.array([[getattr(channel.noise, "floor", None) or 0.0 for channel in block.channels]])
        high = jnp.where(floors[None] & ((data.y - floor) / std <= high), jnp.inf, high)
    return low, high


def limits(model: Model, epoch: Epoch, r: int, levels: jax.Array, odds: float) -> tuple[jax.Array, jax.Array]:
    """Residuals (D,) over the std beyond which the data of an epoch are held back."""
    parts = [_limits(block, data, waist.noise_std(data, levels), odds) for _, block, data in here(model, epoch, r)]
    low, high = (jnp.concatenate([own.ravel() for own in column]) for column in zip(*parts, strict=True))
    return low, high


def residuals_widened(
    model: Model, epoch: Epoch, r: int, at: About, levels: jax.Array, root: jax.Array, *, slopes: bool
) -> tuple[jax.Array, jax.Array]:
    """Residuals (D,) over the std of noise and biases of covariance root root', and their slopes (D, n) by the state.

    Without `slopes`, no columns.
    """
    covariance = jnp.pad(root @ root.T, (0, 1))  # of a bias that is fixed 0
    offs, by_state = [], []
    for _, block, data in here(model, epoch, r):
        derive = waist.linearise if slopes else waist.linearise_biases
        lin = derive(block, data, at.x[None], at.z, levels, expected=True)
        predicted, std = waist.predict(block, data, at.x[None], at.z), waist.noise_std(data, levels)
        _, step = waist.weigh(block, data, predicted, levels, expected=False)
        there = (data.mask > 0) & (lin.weight > 0) & (step > 0)
        read = data.bias[data.sensor]
        spread = covariance[read[:, :, None], read[:, None, :]]
        wide = jnp.sqrt(std**2 + jnp.einsum("pcu,puv,pcv->pc", lin.bias, spread, lin.bias))
        offs.append(jnp.where(there, waist.innovation(block, data, predicted) / wide, 0.0).ravel())
        slope = jnp.where(there[:, :, None], lin.state / wide[:, :, None], 0.0).reshape(there.size, -1)
        if slopes:
            slope = jnp.zeros((there.size, at.x.shape[0])).at[:, np.asarray(block.used, int)].set(slope)
        by_state.append(slope)
    return jnp.concatenate(offs), jnp.concatenate(by_state)
