"""The start of a new target: the place that explains its first rows best, of many that are tried.

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
from probcal.modes.grid import ROBUST
from probcal.stream.filters.belief import Augmented
from probcal.stream.filters.filtering import FilterGiven
from probcal.stream.filters.linearising import About, limits, residuals_widened

FIRST = 8  # epochs of a new target that are looked at
AT_ONCE = 64  # places that are tried together
REFINED = 12  # damped steps from the best of them


@partial(jax.jit, static_argnames=("r", "span", "odds"))
def place_new(
    model: Model,
    given: FilterGiven,
    belief: Augmented,
    epochs: Epoch,
    r: int,
    span: tuple[int, int],
    tried: jax.Array,
    odds: float = 0.0,
) -> tuple[jax.Array, jax.Array]:
    """State (n,) whose place explains the epochs (FIRST leading) of a target best; the first has its start.

    And which data (D,) of the first lie beyond the gate both about that place and about the one that explains the first
    best: the target moves on.
    """
    move = jax.tree.map(lambda leaf: leaf[0], epochs.move[r])
    resting, entries = move.drift, jnp.arange(*span)
    spread = jnp.sqrt(jnp.sum(move.L**2, 1))[entries]
    first = jax.tree.map(lambda leaf: leaf[:1], epochs)

    def about(place: jax.Array) -> About:
        return About(resting.at[entries].set(place), belief.mean)

    def terms(place: jax.Array, some: Epoch, slopes: bool) -> tuple[jax.Array, jax.Array]:
        def of(epoch: Epoch) -> tuple[jax.Array, jax.Array]:
            off, slope = residuals_widened(model, epoch, r, about(place), given.levels, belief.root, slopes=slopes)
            there = epoch.recursion >= 0
            return jnp.where(there, off, 0.0), jnp.where(there, slope, 0.0)

        off, slope = jax.vmap(of)(some)
        return off.ravel(), slope.reshape(off.size, -1)

    def loss(place: jax.Array, some: Epoch) -> tuple[jax.Array, jax.Array]:
        """Of all epochs and of the first alone."""
        off, _ = terms(place, some, slopes=False)
        known = 0.5 * jnp.sum(((place - resting[entries]) / spread) ** 2)
        each = 0.5 * (ROBUST + 1) * jnp.log1p(off**2 / ROBUST)
        totals = jnp.sum(each) + known, jnp.sum(each[: off.size // some.recursion.size]) + known
        whole, alone = (jnp.where(jnp.isfinite(total), total, jnp.inf) for total in totals)
        return whole, alone

    def refined(place: jax.Array, value: jax.Array, some: Epoch) -> jax.Array:
        def better(carry: tuple, _: None) -> tuple:
            place, value, damping = carry
            off, slope = terms(place, some, slopes=True)
            slope = slope[:, entries]
            weight = (ROBUST + 1) / (ROBUST + off**2)
            information = (slope.T * weight[None, :]) @ slope + jnp.diag(spread**-2)
            pull = slope.T @ (weight * off) - (place - resting[entries]) / spread**2
            damped = information + damping * jnp.diag(jnp.diagonal(information))
            after = place + linalg.solve_positive(damped, pull)
            lower = loss(after, some)[0]
            good = lower < value
            state = (
                jnp.where(good, after, place),
                jnp.where(good, lower, value),
                jnp.where(good, damping / 10, damping * 10),
            )
            return state, None

        return jax.lax.scan(better, (place, value, jnp.asarray(1e-3)), None, length=REFINED)[0][0]

    tried = jnp.concatenate([tried, resting[entries][None]])
    losses, alone = jax.lax.map(lambda place: loss(place, epochs), tried, batch_size=AT_ONCE)
    best, nearest = jnp.argmin(losses), jnp.argmin(alone)
    place = refined(tried[best], losses[best], epochs)
    if not odds:
        return about(place).x, jnp.zeros(0, bool)
    near = refined(tried[nearest], alone[nearest], first)
    low, high = limits(model, jax.tree.map(lambda leaf: leaf[0], first), r, given.levels, odds)
    far = [(off < low) | (off > high) for off, _ in (terms(at, first, slopes=False) for at in (place, near))]
    return about(place).x, far[0] & far[1]
