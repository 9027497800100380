"""Where a target that has just come can be: the place that explains its first rows best, of many that are tried.

Everything else of its state is at the start that is declared, and the noise is widened by what is not known of the
biases, with the robust loss of the batch start. Residuals count by the std of their noise, whatever its family: the
weights of heavy tails are the same at all places that are far off.
"""

from functools import partial

import jax
import jax.numpy as jnp

from probcal import linalg
from probcal.model.epochs import Epoch
from probcal.model.model import Model
from probcal.online.belief import Augmented
from probcal.online.filtering import FilterGiven
from probcal.online.linearising import About, linearised
from probcal.smoothing.grid import ROBUST

FIRST = 8  # epochs of a new target that are looked at
AT_ONCE = 64  # places that are tried together
REFINED = 12  # damped steps from the best of them


@partial(jax.jit, static_argnames=("r", "span"))
def place_new(
    model: Model, given: FilterGiven, belief: Augmented, epochs: Epoch, r: int, span: tuple[int, int], tried: jax.Array
) -> jax.Array:
    """State (n,) whose place explains the epochs (FIRST leading) of a target best; the first has its start."""
    move = jax.tree.map(lambda leaf: leaf[0], epochs.move[r])
    resting, entries = move.drift, jnp.arange(*span)
    spread = jnp.sqrt(jnp.sum(move.L**2, 1))[entries]

    def terms(place: jax.Array) -> tuple[jax.Array, jax.Array]:
        x = resting.at[entries].set(place)

        def of(epoch: Epoch) -> tuple[jax.Array, jax.Array]:
            rows = linearised(model, epoch, r, About(x, belief.mean), given.levels)
            parts = []
            for row in rows:
                wide = row.ratio * jnp.sqrt(1.0 + jnp.sum((row.hz @ belief.root) ** 2, 1) / row.ratio**2)
                off = (row.ratio * row.shift + row.value - row.hx @ x - row.hz @ belief.mean) / wide
                parts.append((off, row.hx[:, entries] / wide[:, None]))
            off, slope = zip(*parts, strict=True)
            there = epoch.recursion >= 0
            return jnp.where(there, jnp.concatenate(off), 0.0), jnp.where(there, jnp.concatenate(slope), 0.0)

        off, slope = jax.vmap(of)(epochs)
        return off.ravel(), slope.reshape(-1, len(entries))

    def loss(place: jax.Array) -> jax.Array:
        off, _ = terms(place)
        known = 0.5 * jnp.sum(((place - resting[entries]) / spread) ** 2)
        total = jnp.sum(0.5 * (ROBUST + 1) * jnp.log1p(off**2 / ROBUST)) + known
        return jnp.where(jnp.isfinite(total), total, jnp.inf)

    def better(carry: tuple, _: None) -> tuple:
        place, value, damping = carry
        off, slope = terms(place)
        weight = (ROBUST + 1) / (ROBUST + off**2)
        information = (slope.T * weight[None, :]) @ slope + jnp.diag(spread**-2)
        pull = slope.T @ (weight * off) - (place - resting[entries]) / spread**2
        damped = information + damping * jnp.diag(jnp.diagonal(information))
        after = place + linalg.solve_positive(damped, pull)
        lower = loss(after)
        good = lower < value
        state = (
            jnp.where(good, after, place),
            jnp.where(good, lower, value),
            jnp.where(good, damping / 10, damping * 10),
        )
        return state, None

    tried = jnp.concatenate([tried, resting[entries][None]])
    losses = jax.lax.map(loss, tried, batch_size=AT_ONCE)
    best = jnp.argmin(losses)
    (place, _, _), _ = jax.lax.scan(better, (tried[best], losses[best], jnp.asarray(1e-3)), None, length=REFINED)
    return resting.at[entries].set(place)


@partial(jax.jit, static_argnames=("r", "odds"))
def outside_gate(
    model: Model, given: FilterGiven, belief: Augmented, epoch: Epoch, x: jax.Array, r: int, odds: float
) -> jax.Array:
    """Whether data (D,) of one epoch lie beyond the gate about a state, as the biases are known."""
    rows = linearised(model, epoch, r, About(x, belief.mean), given.levels, odds)
    row = jax.tree.map(lambda *parts: jnp.concatenate(parts), *rows)
    off = row.shift + (row.value - row.hx @ x - row.hz @ belief.mean) / row.ratio
    residual = off / jnp.sqrt(1.0 + jnp.sum((row.hz @ belief.root) ** 2, 1) / row.ratio**2)
    return (residual < row.low) | (residual > row.high)
