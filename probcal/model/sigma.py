"""Statistical linearisation by sigma points, as the unscented and the cubature E-step need it.

Each row is regressed on the state over the smoothed density of its epoch (posterior linearisation,
Garcia-Fernandez et al. 2015; the unscented transform of Julier and Uhlmann, the cubature rule of
Arasaratnam and Haykin 2009). Where a sensor is linear the result is that of the extended smoother.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal import linalg
from probcal.model import rows
from probcal.model.model import Data, Model, Where
from probcal.model.rows import Block, Linearised, Rows

FLOOR = 1e-10  # least variance along an axis of the sigma points
Rule = Callable[[int], float]  # weight kappa of the centre, by the number of state entries


def unscented(entries: int) -> float:
    """Weight of the centre by the unscented transform."""
    return max(3.0 - entries, 1.0)


def cubature(entries: int) -> float:
    """None: the cubature rule has no point there."""
    return 0.0


class PointSet(NamedTuple):
    """Sigma points about means, by the symmetric root, which does not turn with rounding."""

    shift: jax.Array  # (S, ..., u)
    unit: jax.Array  # (S, u) the same points for unit covariance
    weight: jax.Array  # (S,)
    whiten: jax.Array  # (..., u, u) from entries to unit covariance


def sigma_points(covariance: jax.Array, rule: Rule) -> PointSet:
    """The points of a rule for covariances (..., u, u)."""
    u = covariance.shape[-1]
    kappa = rule(u)
    axes = np.concatenate([np.eye(u), -np.eye(u)]) * np.sqrt(u + kappa)
    unit = np.concatenate([np.zeros((1, u)), axes]) if kappa else axes
    centre = [kappa / (u + kappa)] if kappa else []
    weight = np.concatenate([centre, np.full(2 * u, 0.5 / (u + kappa))])
    values, vectors = linalg.spectrum(covariance)
    scale = jnp.sqrt(jnp.maximum(values, FLOOR))[..., None, :]
    root = (vectors * scale) @ vectors.mT
    shift, whiten = jnp.einsum("...uv,sv->s...u", root, unit), vectors / scale @ vectors.mT
    return PointSet(shift, jnp.asarray(unit), jnp.asarray(weight), whiten)


def regress(
    block: Block, points: PointSet, values: jax.Array, centre: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Mean (N, C) of values (S, N, C) less the centre, their slope (N, C, u), what is left over."""
    moved = rows.difference(block, values, centre[None])
    mean = jnp.einsum("s,snc->nc", points.weight, moved)
    slope = jnp.einsum("s,snc,su->ncu", points.weight, moved - mean[None], points.unit)
    square = jnp.einsum("s,snc->nc", points.weight, (moved - mean[None]) ** 2)
    return mean, slope, jnp.maximum(square - jnp.sum(slope**2, -1), 0.0)


def _points(block: Block, states: jax.Array, covariance: jax.Array, rule: Rule) -> tuple[jax.Array, PointSet]:
    """States (S, E, n) with the entries moved that the block reads, and the points of these."""
    used = np.asarray(block.used, int)
    points = sigma_points(covariance[:, used[:, None], used[None, :]], rule)
    all_of = jnp.broadcast_to(states, (len(points.weight), *states.shape))
    return all_of.at[:, :, used].add(points.shift), points


def _block(block: Block, data: Rows, point: Where, states: jax.Array, covariance: jax.Array, rule: Rule) -> Linearised:
    if not block.used:
        return rows.linearise(block, data, states, point.z, point.levels, expected=False)
    moved, points = _points(block, states, covariance, rule)
    centre = rows.predict(block, data, states, point.z)
    values = jax.lax.map(lambda x: rows.predict(block, data, x, point.z), moved)
    mean, slope, extra = regress(block, points, values, centre)
    score, weight = rows.weigh(block, data, centre + mean, point.levels, expected=False, extra=extra)
    by_bias = jax.lax.map(lambda x: rows.linearise(block, data, x, point.z, point.levels, expected=False).bias, moved)
    by_state = jnp.einsum("ncu,nuv->ncv", slope, points.whiten[data.epoch])
    return Linearised(score, weight, by_state, jnp.einsum("s,sncp->ncp", points.weight, by_bias))


def regress_blocks(model: Model, point: Where, covariances: Sequence[jax.Array], rule: Rule) -> list[Linearised]:
    """Blocks regressed on the states over their smoothed densities; what is left over widens noise."""
    each = model.each_block()
    return [_block(own, data, point, point.states[r], covariances[r], rule) for own, data, r in each]


def expect_biases(model: Model, point: Where, covariances: Sequence[jax.Array], rule: Rule) -> tuple[Data, jax.Array]:
    """Information (S, p, p) by sensor and score (M,), over the smoothed states (Paper A 15-21)."""
    information, score = list[jax.Array](), jnp.zeros(model.biases)
    for block, data, r in model.each_block():
        alone = replace(model, blocks=(block,), recursion=(r,), rows=(data,))

        def at(x: jax.Array, block: Block = block, data: Rows = data, alone: Model = alone) -> tuple:
            lin = rows.linearise(block, data, x, point.z, point.levels, expected=False)
            (own,), pull = alone.of_sensors([lin])
            return own, pull

        if not block.used:
            G, g = at(point.states[r])
        else:
            states, points = _points(block, point.states[r], covariances[r], rule)
            each = jax.lax.map(at, states)
            G, g = (jnp.einsum("s,s...->...", points.weight, part) for part in each)
        information.append(G)
        score = score + g
    return tuple(information), score
