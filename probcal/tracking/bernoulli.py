"""Tracks of an unknown number of objects from scans: a filter of Bernoulli tracks with the rest a Poisson process.

Each track has a Gaussian state and a probability of existence; what was never detected is a Poisson process spread as
the start of the motion. Which detection belongs to which track is found by belief propagation, and each track becomes
the Gaussian with the moments of its mixture (Williams 2015, track-oriented; Williams and Lau 2014).
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from probcal.tracking.scan import Scan, View, Watch, detected, present
from probcal.tracking.update import TINY, Biases, Chances, births, rows_from, updated

ROUNDS = 40  # of belief propagation
GONE = 1e-9  # existence below which a track takes no detection
HIGHEST = 60.0  # log of the most that a pair may be likelier than the track missed and the slot new


class BernoulliTracks(NamedTuple):
    """T tracks: existence (T,), means (T, n), covariances (T, n, n) and numbers (T,), -1 of none."""

    existence: jax.Array
    mean: jax.Array
    covariance: jax.Array
    number: jax.Array


Carry = tuple[BernoulliTracks, jax.Array]  # and the mean number of objects never detected


class Step(NamedTuple):
    """The result of a scan: the tracks after and before it, and the probability that each slot is
    of each of these or new.
    """

    after: BernoulliTracks
    number: jax.Array  # (T,) of the tracks before
    shares: jax.Array  # (T, D)
    fresh: jax.Array  # (D,) that a slot is the first detection of an object; its track has the number of `first`
    first: jax.Array  # (D,)


def associate(ratio: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Marginal association of tracks and slots by belief propagation (Williams, Lau 2014).

    `ratio` (T, D) is the likelihood of each pair over that of the track missed and the slot new or false. Returns the
    probability of each pair (T, D) and of a slot to be of no track (D,).
    """

    def to_slots(nu: jax.Array) -> jax.Array:
        return ratio / (1.0 + _others(ratio * nu, 1))

    def again(_: int, nu: jax.Array) -> jax.Array:
        return 1.0 / (1.0 + _others(to_slots(nu), 0))

    nu = jax.lax.fori_loop(0, ROUNDS, again, jnp.ones_like(ratio))
    own = ratio * nu
    pairs = own / (1.0 + jnp.sum(own, 1, keepdims=True))
    return pairs, 1.0 / (1.0 + jnp.sum(to_slots(nu), 0))


def _others(values: jax.Array, axis: int) -> jax.Array:
    """For each entry the sum of the others along an axis; no difference of large numbers."""
    before = jnp.roll(jnp.cumsum(values, axis), 1, axis)
    after = jnp.roll(jnp.flip(jnp.cumsum(jnp.flip(values, axis), axis), axis), -1, axis)
    place = jnp.arange(values.shape[axis]).reshape((-1, 1) if axis == 0 else (1, -1))
    return jnp.where(place > 0, before, 0.0) + jnp.where(place < values.shape[axis] - 1, after, 0.0)


@partial(jax.jit, static_argnames=("views", "most"))
def filter_tracks(
    watch: Watch,
    views: tuple[View, ...],
    known: Biases,
    chances: Chances,
    cloud: jax.Array,
    most: int,
) -> Step:
    """All scans one after the other with `most` tracks kept, biases and levels held; K leading.

    What is not known of the biases counts as noise of each detection alone.
    """
    model, n = watch.model, len(watch.mean)

    def step(carry: Carry, at: tuple[jax.Array, Scan]) -> tuple[Carry, Step]:
        (tracks, hidden), (k, scan) = carry, at
        move = scan.epoch.move[0]
        scale = jnp.concatenate([jnp.exp(known.levels), jnp.ones(1)])[move.level]
        L = move.L * scale[None, :]
        stays = jnp.exp(-scan.elapsed / chances.lifetime)
        mean = tracks.mean @ move.F.T + move.drift[None]
        covariance = jnp.einsum("ij,tjk,lk->til", move.F, tracks.covariance, move.F) + (L @ L.T)[None]
        r = tracks.existence * stays
        hidden = hidden * stays + chances.births * scan.elapsed

        there = present(scan)
        chance = jax.vmap(lambda x: detected(model, scan, views, x, known.z))(mean)
        rows = jax.vmap(lambda x: rows_from(model, scan, x, known))(mean)
        evidence, moved, spread = jax.vmap(updated)(rows, mean, covariance)  # (T, D), ...
        born, born_mean, born_covariance, share = births(watch, scan, views, cloud, known)
        false = jnp.log(jnp.maximum(scan.clutter * scan.density, TINY))
        new = jnp.log(jnp.maximum(hidden, TINY)) + born
        none = jnp.logaddexp(false, new)  # of a slot that is of no track
        missed = 1.0 - r * chance
        weight = jnp.log(jnp.maximum(r * chance, TINY))[:, None] + evidence - none[None]
        ratio = jnp.exp(jnp.minimum(weight, HIGHEST)) / jnp.maximum(missed, TINY)[:, None]
        pairs, unused = associate(jnp.where(there[None] & (r * chance > GONE)[:, None], ratio, 0.0))

        alone = 1.0 - jnp.sum(pairs, 1)
        left = alone * r * (1.0 - chance) / jnp.maximum(missed, TINY)  # exists, and was missed
        existence = jnp.sum(pairs, 1) + left
        share_of = jnp.concatenate([left[:, None], pairs], 1) / jnp.maximum(existence, TINY)[:, None]
        share_of = jnp.where((existence > TINY)[:, None], share_of, jnp.eye(1, share_of.shape[1]))
        means = jnp.concatenate([mean[:, None], moved], 1)
        spreads = jnp.concatenate([covariance[:, None], spread], 1)
        middle = jnp.einsum("th,thn->tn", share_of, means)
        off = means - middle[:, None]
        wide = jnp.einsum("th,thij->tij", share_of, spreads) + jnp.einsum("th,thi,thj->tij", share_of, off, off)
        fresh = jnp.where(there, unused * jnp.exp(new - none), 0.0)
        first = k * len(there) + jnp.arange(len(there))

        whole = BernoulliTracks(
            jnp.concatenate([existence, fresh]),
            jnp.concatenate([middle, born_mean]),
            jnp.concatenate([wide, born_covariance]),
            jnp.concatenate([tracks.number, first]),
        )
        kept = jax.lax.top_k(whole.existence, most)[1]
        after = jax.tree.map(lambda leaf: leaf[kept], whole)
        hidden = hidden * (1.0 - share)
        return (after, hidden), Step(after, tracks.number, pairs, fresh, first)

    start = BernoulliTracks(
        jnp.zeros(most), jnp.tile(watch.mean, (most, 1)), jnp.tile(jnp.eye(n), (most, 1, 1)), -jnp.ones(most, int)
    )
    K = len(watch.scans.elapsed)
    return jax.lax.scan(step, (start, jnp.asarray(chances.undetected, float)), (jnp.arange(K), watch.scans))[1]
