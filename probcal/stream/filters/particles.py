"""Rao-Blackwellised particles of a stream: paths of all targets are drawn, the biases given each are Gaussian.

Each particle carries the states of all targets and a Gaussian of the biases by a square root, which its rows update
(Schoen, Gustafsson, Nordlund 2005, with biases for the linear part; thesis 4.24-4.27 is that update). Where biases
enter linearly and noise is Gaussian the weights are exact, else those of Laplace's method at the updated biases. Any
motion that can be drawn from will do, roads too.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal import linalg
from probcal.model import rows as waist
from probcal.model.epochs import Epoch, State
from probcal.model.model import Model
from probcal.resampling import chosen_at
from probcal.stream.filters.belief import WhiteRow
from probcal.stream.filters.filtering import FilterGiven
from probcal.stream.filters.linearising import About, here, linearised


class Cloud(NamedTuple):
    """Weighted particles (N leading)."""

    states: State
    mean: jax.Array  # (N, M) of the biases given the path
    root: jax.Array  # (N, M, M)
    log_weight: jax.Array  # (N,) normalised
    origin: jax.Array  # (N,) which particle of the start each descends from


class CloudPass(NamedTuple):
    """The results of each epoch (K leading)."""

    x: tuple[jax.Array, ...]  # (n,) mean of what rows see of its target, of each recursion
    sd: tuple[jax.Array, ...]  # (n,)
    log_evidence: jax.Array  # () up to nothing: log density of the rows given those before
    ess: jax.Array  # () effective number of particles before they are resampled
    kept: tuple["Foreseen", ...]  # (D,) of each recursion


def first_cloud(states: State, z: jax.Array, root: jax.Array, count: int) -> Cloud:
    """Particles before any row: biases N(z, root root') in each."""

    def many(leaf: jax.Array) -> jax.Array:
        return jnp.broadcast_to(leaf, (count, *leaf.shape))

    return Cloud(
        jax.tree.map(many, states), many(z), many(root), jnp.full(count, -jnp.log(float(count))), jnp.arange(count)
    )


def ancestors(cloud: Cloud) -> int:
    """The number of particles of the start that have descendants."""
    return len(np.unique(np.asarray(cloud.origin)))


@jax.jit
def bias_moments(cloud: Cloud) -> tuple[jax.Array, jax.Array]:
    """Mean (M,) and covariance (M, M) of the biases over all particles."""
    weight = jnp.exp(cloud.log_weight)
    mean = weight @ cloud.mean
    away = cloud.mean - mean[None]
    within = jnp.einsum("p,pij,pkj->ik", weight, cloud.root, cloud.root)
    return mean, within + (away.T * weight[None, :]) @ away


class Foreseen(NamedTuple):
    """Data (D,) as all particles together predict them."""

    residual: jax.Array  # over the std of noise, state and biases together
    spread: jax.Array  # this std over that of the noise; 0 where there is no datum
    lead: jax.Array  # bias on which it depends most
    slope: jax.Array  # change of its prediction, over the std of the noise, by one scale of that
    held: jax.Array  # whether it is held back


def foreseen(
    model: Model, given: FilterGiven, cloud: Cloud, root: jax.Array, epoch: Epoch, r: int, keys: jax.Array, odds: float
) -> tuple[Foreseen, Epoch]:
    """Data of an epoch of recursion r before they are used, and the epoch without those that are held back."""

    def particle(key: jax.Array, x: State, z: jax.Array, own: jax.Array) -> tuple[jax.Array, jax.Array, WhiteRow]:
        if model.sampled[r] is not None or model.recursions[r].tails:
            after = model.step(key, x, epoch, given.levels)[r]
            mean = model.vectors(r, jax.tree.map(lambda leaf: leaf[epoch.target[r]][None], after))[0]
            L = jnp.zeros((mean.shape[0], 1))
        else:
            mean, L = _moved(given, epoch, r, x)
        parts = linearised(model, epoch, r, About(mean, z), given.levels, odds)
        row = jax.tree.map(lambda *parts: jnp.concatenate(parts), *parts)
        off = row.shift + (row.value - row.hx @ mean - row.hz @ z) / row.ratio
        wide = jnp.sum((row.hx @ L) ** 2, 1) + jnp.sum((row.hz @ own) ** 2, 1)
        return off, 1.0 + wide / row.ratio**2, row

    off, wide, row = jax.vmap(particle)(keys, cloud.states, cloud.mean, root)
    weight = jnp.exp(cloud.log_weight)
    middle = weight @ off
    spread = jnp.sqrt(weight @ (wide + (off - middle[None]) ** 2))
    first = jax.tree.map(lambda leaf: leaf[0], row)
    there = jnp.any(first.hx != 0, 1) | jnp.any(first.hz != 0, 1)
    residual = middle / spread
    held = there & ((residual < first.low) | (residual > first.high))
    lead, slope = first.leading()
    rows, begun = list(epoch.rows), 0
    for b, _, data in here(model, epoch, r):
        size = data.mask.size
        out = held[begun : begun + size].reshape(data.mask.shape)
        rows[b] = rows[b]._replace(mask=jnp.where(out, 0.0, rows[b].mask))
        begun += size
    return Foreseen(residual, jnp.where(there, spread, 0.0), lead, slope, held), epoch._replace(rows=tuple(rows))


def _moved(given: FilterGiven, epoch: Epoch, r: int, x: State) -> tuple[jax.Array, jax.Array]:
    """Mean (n,) and root of the covariance (n, n) of the state of one particle at an epoch of a linear motion."""
    move = epoch.move[r]
    level = jnp.concatenate([jnp.exp(given.levels), jnp.ones(1)])[move.level]
    return move.F @ x[r][epoch.target[r]] + move.drift, move.L * level[None, :]


def _drawn(
    model: Model, given: FilterGiven, epoch: Epoch, r: int, key: jax.Array, x: State, z: jax.Array, root: jax.Array
) -> tuple[State, jax.Array]:
    """States of one particle at an epoch of recursion r, and the log weight by which they were not drawn as they move.

    Where the motion is linear they are drawn near what the rows say, the biases being uncertain: one Gauss-Newton step.
    """
    if model.sampled[r] is not None or model.recursions[r].tails:
        return model.step(key, x, epoch, given.levels), jnp.zeros(())
    target, (mean, L) = epoch.target[r], _moved(given, epoch, r, x)
    J, pull = jnp.eye(L.shape[1]), jnp.zeros(L.shape[1])
    for row in linearised(model, epoch, r, About(mean, z), given.levels):
        by = row.hx @ L
        wide = 1.0 + jnp.sum((row.hz @ root) ** 2, 1)
        J = J + (by.T / wide[None, :]) @ by
        pull = pull + by.T @ ((row.value - row.hx @ mean - row.hz @ z) / wide)
    lower, inverse = linalg.factor_and_inverse(J)
    white = jax.random.normal(key, pull.shape)
    u = inverse.T @ (inverse @ pull + white)
    gain = 0.5 * jnp.sum(white**2) - 0.5 * jnp.sum(u**2) - jnp.sum(jnp.log(jnp.diagonal(lower)))
    states = tuple(own.at[target].set(mean + L @ u) if k == r else own for k, own in enumerate(x))
    return states, gain


def _weighed(
    model: Model, given: FilterGiven, epoch: Epoch, r: int, x: State, z: jax.Array, root: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Biases of one particle after the rows of an epoch of recursion r, and the log density of these."""
    M = z.shape[0]
    mine = jax.tree.map(lambda leaf: leaf[epoch.target[r]][None], x[r])
    seen = model.vectors(r, mine)
    values, slopes = [], []
    for _, block, data in here(model, epoch, r):
        lin = waist.linearise_biases(block, data, seen, z, given.levels, expected=True)
        there = (data.mask > 0) & (lin.weight > 0)
        weight = jnp.where(there, lin.weight, 1.0)
        scale = jnp.where(there, jnp.sqrt(weight), 0.0)
        P, C = there.shape
        hz = jnp.zeros((P, C, M + 1)).at[
            jnp.arange(P)[:, None, None], jnp.arange(C)[None, :, None], data.bias[data.sensor][:, None, :]
        ].add(jnp.where(there[:, :, None], lin.bias, 0.0))[:, :, :M]  # fmt: skip
        value = jnp.where(there, lin.score / weight, 0.0) + hz @ z
        values.append((scale * value).ravel())
        slopes.append((scale[:, :, None] * hz).reshape(P * C, M))
    value, slope = jnp.concatenate(values), jnp.concatenate(slopes)

    def use(carry: tuple, row: tuple) -> tuple:
        mean, root, total = carry
        y, h = row
        u = h @ root
        variance = 1.0 + jnp.sum(u**2)
        off = y - h @ mean
        gain = root @ u / variance
        root = root - gain[:, None] * (u / (1.0 + 1.0 / jnp.sqrt(variance)))[None, :]
        return (mean + gain * off, root, total - 0.5 * (off**2 / variance + jnp.log(variance))), None

    (mean, after, total), _ = jax.lax.scan(use, (z, root, jnp.zeros(())), (value, slope))
    total = total + 0.5 * jnp.sum((value - slope @ mean) ** 2)  # what the density below has in its place
    for _, block, data in here(model, epoch, r):
        density = waist.log_likelihood(block, data, waist.predict(block, data, seen, mean), given.levels)
        total = total + jnp.sum(jnp.where(data.mask > 0, density, 0.0))
    return mean, after, total


@partial(jax.jit, static_argnames=("walks", "threshold", "odds"))
def run_particles(
    model: Model, given: FilterGiven, cloud: Cloud, epochs: Epoch, elapsed: jax.Array, key: jax.Array, *,
    walks: bool, threshold: float, odds: float,
) -> tuple[Cloud, CloudPass]:  # fmt: skip
    """The cloud after a stack of epochs; those that pad it (recursion -1) change nothing."""
    N, R = cloud.log_weight.shape[0], len(model.recursions)

    def one(carry: tuple[Cloud, jax.Array], inputs: tuple) -> tuple:
        epoch, dt = inputs

        def go(cloud: Cloud, key: jax.Array) -> tuple[Cloud, Any]:
            keys = jax.random.split(key, N + 1)
            root = cloud.root
            if walks:
                std = jnp.diag(given.walk * jnp.sqrt(jnp.maximum(dt, 0.0)))
                root = jax.vmap(lambda own: linalg.tria(jnp.concatenate([own, std], 1)))(root)

            def of(r: int) -> Any:
                own_data, used = foreseen(model, given, cloud, root, epoch, r, keys[:N], odds)

                def particle(key: jax.Array, x: State, z: jax.Array, own: jax.Array) -> Any:
                    after, drawn = _drawn(model, given, used, r, key, x, z, own)
                    mean, root, told = _weighed(model, given, used, r, after, z, own)
                    return after, mean, root, drawn + told

                kept = tuple(own_data if k == r else no_data[k] for k in range(R))
                return *jax.vmap(particle)(keys[:N], cloud.states, cloud.mean, root), kept

            sizes = [sum(data.mask.size for _, _, data in here(model, epoch, r)) for r in range(R)]
            no_data = [
                Foreseen(jnp.zeros(n), jnp.zeros(n), jnp.zeros(n, int), jnp.zeros(n), jnp.zeros(n, bool)) for n in sizes
            ]
            states, mean, root, gain, kept = jax.lax.switch(epoch.recursion, [partial(of, r) for r in range(R)])
            log_weight = cloud.log_weight + jnp.where(jnp.isfinite(gain), gain, -jnp.inf)
            total = jax.scipy.special.logsumexp(log_weight)
            log_weight = log_weight - total
            weight = jnp.exp(log_weight)
            ess = 1.0 / jnp.sum(weight**2)
            xs, sds = [], []
            for r in range(R):
                mine = jax.tree.map(lambda leaf, r=r: leaf[:, epoch.target[r]], states[r])
                seen = model.vectors(r, mine)
                middle = weight @ seen
                xs.append(middle)
                sds.append(jnp.sqrt(weight @ (seen - middle[None]) ** 2))
            index, flat = jnp.arange(N), log_weight
            drawn = chosen_at(log_weight, (jax.random.uniform(keys[N]) + jnp.arange(N)) / N)  # systematic
            few = ess < threshold * N
            index = jnp.where(few, drawn, index)
            flat = jnp.where(few, -jnp.log(float(N)), flat)
            states = jax.tree.map(lambda leaf: leaf[index], states)
            return Cloud(states, mean[index], root[index], flat, cloud.origin[index]), (
                tuple(xs),
                tuple(sds),
                total,
                ess,
                kept,
            )

        cloud, key = carry
        key, own = jax.random.split(key)
        nothing = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), jax.eval_shape(lambda: go(cloud, own)[1]))
        after, left = jax.lax.cond(epoch.recursion >= 0, lambda: go(cloud, own), lambda: (cloud, nothing))
        return (after, key), left

    left: Any
    (cloud, _), left = jax.lax.scan(one, (cloud, key), (epochs, elapsed))
    return cloud, CloudPass(*left)
