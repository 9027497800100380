"""The normaliser of the quad term (Separable likelihoods 6), for tracks of two sensors.

The term is the geometric mean of two densities of the detections of both sensors at one time: one by what the first
knew before, one by what the second knew. For an object that both track these are Gaussian, and what the mean lacks to
a density is their Bhattacharyya coefficient, which depends on the poses.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal import linalg
from probcal.model.model import Model
from probcal.problem import Problem
from probcal.tracking.bernoulli import associate
from probcal.tracking.phd import Intensity
from probcal.tracking.poses.local import Alone
from probcal.tracking.poses.separable import Crossed, carry, first_slot, go_along, matched_scans
from probcal.tracking.scan import Scan

AGREE = 0.1  # coefficient from which two tracks are more likely than not one object


class Paired(NamedTuple):
    """The predictions of two sensors at the scans of the first that have a partner (K leading)."""

    model: Model
    scans: Scan
    mine: Intensity
    other: Model
    stand: Scan
    theirs: Intensity
    used: jax.Array  # (K,)
    levels: jax.Array


def paired(
    problem: Problem, one: Alone, other: Alone, mine: Intensity, theirs: Intensity, window: float, lifetime: float
) -> Paired:
    """Both sensors' tracks (K, J) after their own scans, predicted to the scans of the first."""
    pair = matched_scans(one, other, window, before=False)
    own = np.arange(len(one.time)) - 1
    back = np.where(pair >= 0, pair - 1, -1)  # its scan before, so that neither knows of the two
    used = (pair >= 0) & (own >= 0) & (back >= 0) & one.there
    stand = jax.tree.map(lambda leaf: leaf[np.maximum(pair, 0)], other.watch.scans)
    here = carry(problem, mine, np.maximum(own, 0), one.time - one.time[np.maximum(own, 0)], lifetime)
    there = carry(problem, theirs, np.maximum(back, 0), one.time - other.time[np.maximum(back, 0)], lifetime)
    levels = np.zeros(len(problem.levels))
    sides: Any = one.watch.model, one.watch.scans, here, other.watch.model, stand, there, used, levels
    return jax.device_put(Paired(*sides))


def normaliser(each: Paired, z: jax.Array, theta: jax.Array, at: jax.Array) -> Crossed:
    """Minus the log of the normaliser of all scans, its slope and information by theta = z[at]."""

    def of(scan: Scan, stand: Scan, mine: Intensity, theirs: Intensity, used: jax.Array) -> Crossed:
        sides = ((each.model, first_slot(scan)), (each.other, first_slot(stand)))

        def seen(x: jax.Array, theta: jax.Array, owner: int) -> tuple[jax.Array, ...]:
            """The values that both would measure for a state that one of them tracks."""
            whole = z.at[at].set(theta)
            where = go_along(*sides[owner], x, whole)
            return tuple(model.predict_at(s.epoch, (where[None],), whole)[0][0] for model, s in sides)

        def by(x: jax.Array, P: jax.Array, owner: int) -> tuple[jax.Array, ...]:
            """Mean (C,), covariance (C, C) and Jacobian by theta (C, p) of the channels of both."""
            value = seen(x, theta, owner)
            parts = jax.jacrev(lambda x, t: jnp.concatenate(seen(x, t, owner)), argnums=(0, 1))(x, theta)
            noise = [
                1.0 / model.innovations_at(s.epoch, (h[None],), each.levels)[0][1][0]
                for (model, s), h in zip(sides, value, strict=True)
            ]
            return jnp.concatenate(value), parts[0] @ P @ parts[0].T + jnp.diag(jnp.concatenate(noise)), parts[1]

        def off(a: jax.Array, b: jax.Array) -> jax.Array:
            """Difference (C,) of the channels of both, wrapped."""
            found, start = [], 0
            for model, s in sides:
                C = s.epoch.rows[0].y.shape[1]
                value = s.epoch._replace(rows=(s.epoch.rows[0]._replace(y=a[None, start : start + C]),))
                found.append(model.innovations_at(value, (b[None, start : start + C],), each.levels)[0][0][0])
                start += C
            return jnp.concatenate(found)

        first = jax.vmap(lambda x, P: by(x, P, 0))(mine.mean, mine.covariance)
        second = jax.vmap(lambda x, P: by(x, P, 1))(theirs.mean, theirs.covariance)

        def two(a: tuple[jax.Array, ...], b: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
            delta, by_theta = off(a[0], b[0]), a[2] - b[2]
            inverse = linalg.inverse_cholesky(0.5 * (a[1] + b[1]))
            white, J = inverse @ delta, inverse @ by_theta
            logs = [jnp.sum(jnp.log(jnp.diagonal(linalg.inverse_cholesky(S)))) for S in (a[1], b[1])]
            volume = jnp.sum(jnp.log(jnp.diagonal(inverse))) - 0.5 * (logs[0] + logs[1])
            return volume - 0.125 * jnp.sum(white**2), -0.25 * J.T @ white, 0.25 * J.T @ J

        value, slope, information = jax.vmap(lambda a: jax.vmap(lambda b: two(a, b))(second))(first)
        ratio = mine.weight[:, None] * theirs.weight[None] * jnp.exp(value) / AGREE
        share, _ = associate(ratio)
        slope, information = jnp.einsum("ab,abp->p", share, slope), jnp.einsum("ab,abpq->pq", share, information)
        found = Crossed(-jnp.sum(share * value), -slope, -information)
        return jax.tree.map(lambda leaf: jnp.where(used, leaf, 0.0), found)

    parts = jax.vmap(of)(each.scans, each.stand, each.mine, each.theirs, each.used)
    return jax.tree.map(lambda leaf: jnp.sum(leaf, 0), parts)
