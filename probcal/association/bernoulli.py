"""Tracks of an unknown number of objects from scans: a filter of Bernoulli tracks with the rest a Poisson process.

Each track has a Gaussian state and a probability of existence; what was never detected is a Poisson process spread as
the start of the motion. Which detection belongs to which track is found by belief propagation, and each track becomes
the Gaussian with the moments of its mixture (Williams 2015, track-oriented; Williams and Lau 2014).
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from probcal import linalg
from probcal.association.scan import Scan, View, Watch, detected, present
from probcal.model.model import Model

ROUNDS = 40  # of belief propagation
STEPS = 10  # of the search for the state that explains one detection
TINY = 1e-30
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
    """What a scan says: the tracks after it, those before, and how surely each slot is of each of these or new."""

    after: BernoulliTracks
    number: jax.Array  # (T,) of the tracks before
    shares: jax.Array  # (T, D)
    fresh: jax.Array  # (D,) that a slot is the first detection of an object; its track has the number of `first`
    first: jax.Array  # (D,)


class Chances(NamedTuple):
    """Of objects: undetected ones at the start, new ones and their lifetime in s."""

    undetected: jax.Array  # () mean number at the first scan
    births: jax.Array  # () mean number a second
    lifetime: jax.Array  # () mean, in s


class _Rows(NamedTuple):
    """Every slot of a scan seen from one state: log density at it, score and information by the state."""

    log_density: jax.Array  # (D,)
    score: jax.Array  # (D, n)
    information: jax.Array  # (D, n, n)


class Biases(NamedTuple):
    """Biases and noise levels at which scans are read, and how uncertain the biases are."""

    z: jax.Array  # (M,)
    covariance: jax.Array  # (M, M)
    levels: jax.Array  # (H,)


def _rows(model: Model, scan: Scan, x: jax.Array, at: Biases) -> _Rows:
    """Every slot seen from a state, with what the uncertainty of the biases adds to the noise of each channel."""
    lins = model.linearise_at(scan.epoch, (x[None],), at.z, at.levels)
    told = model.log_likelihood_at(scan.epoch, (x[None],), at.z, at.levels)
    whole = jnp.pad(at.covariance, (0, 1))
    density, score, information = [], [], []
    for lin, part, data, seen in zip(lins, told, model.rows, scan.epoch.rows, strict=True):
        own = data.bias[seen.sensor]  # (D, p)
        wide = jnp.einsum("dcp,dpq,dcq->dc", lin.bias, whole[own[:, :, None], own[:, None, :]], lin.bias)
        there = lin.weight > 0
        share = 1.0 / (1.0 + lin.weight * wide)  # of the information that is left
        off = jnp.where(there, lin.score**2 / jnp.where(there, lin.weight, 1.0), 0.0)
        density.append(jnp.sum(part + 0.5 * off * (1.0 - share) + 0.5 * jnp.log(share), 1))
        score.append(jnp.einsum("dc,dcn->dn", lin.score * share, lin.state))
        information.append(jnp.einsum("dcm,dc,dcn->dmn", lin.state, lin.weight * share, lin.state))
    return _Rows(*(jnp.concatenate(parts) for parts in (density, score, information)))


def _updated(rows: _Rows, mean: jax.Array, covariance: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Log evidence (D,) of every slot under a Gaussian state, and the state's mean (D, n) and covariance after it.

    The extended update in information form, which takes rows with missing channels and any noise family.
    """
    n = len(mean)
    root = linalg.factor(covariance)
    half = jnp.eye(n)[None] + jnp.einsum("mi,dmk,kj->dij", root, rows.information, root)
    lower = linalg.semi_cholesky(half)
    pull = jnp.einsum("mi,dm->di", root, rows.score)
    alone = linalg.forward(lower, pull[:, :, None])[:, :, 0]
    logdet = 2.0 * jnp.sum(jnp.log(jnp.diagonal(lower, axis1=1, axis2=2)), 1)
    # at the linearised optimum: density at the mean, plus half the squared pull, less the volume
    evidence = rows.log_density + 0.5 * jnp.sum(alone**2, 1) - 0.5 * logdet
    inverse = jax.vmap(lambda w: linalg.inverse_and_logdet(w)[0])(half)
    moved = mean[None] + jnp.einsum("ni,dij,dj->dn", root, inverse, pull)
    spread = jnp.einsum("ni,dij,mj->dnm", root, inverse, root)
    return evidence, moved, spread


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


def _births(
    watch: Watch, scan: Scan, views: tuple[View, ...], cloud: jax.Array, known: Biases
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Log evidence (D,), mean and covariance of an object never seen before behind each slot, and the share in view.

    The best of a cloud of states (G, n), whitened, is where a damped Gauss-Newton search begins; the start of the
    motion is its prior, and the evidence is Laplace's.
    """
    model, n = watch.model, len(watch.mean)

    def at(u: jax.Array) -> jax.Array:
        return watch.mean + watch.root @ u

    seen = jax.vmap(lambda u: detected(model, scan, views, at(u), known.z))(cloud)

    def density(u: jax.Array) -> jax.Array:
        return _rows(model, scan, at(u), known).log_density

    told = jax.vmap(density)(cloud)  # (G, D)
    best = cloud[jnp.argmax(told - 0.5 * jnp.sum(cloud**2, 1)[:, None], 0)]

    def of(slot: jax.Array, u: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        def value(u: jax.Array) -> jax.Array:
            return density(u)[slot] - 0.5 * jnp.sum(u**2)

        def slopes(u: jax.Array) -> tuple[jax.Array, jax.Array]:
            rows = _rows(model, scan, at(u), known)
            W = jnp.eye(n) + watch.root.T @ rows.information[slot] @ watch.root
            return watch.root.T @ rows.score[slot] - u, W

        def go(_: int, state: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
            u, f, damping = state
            g, W = slopes(u)
            tried = u + linalg.solve_positive(W + damping * jnp.diag(jnp.diagonal(W)), g)
            new = value(tried)
            better = new >= f
            return (
                jnp.where(better, tried, u), jnp.where(better, new, f),
                jnp.where(better, 0.1 * damping, jnp.maximum(10.0 * damping, 1e-2)),
            )  # fmt: skip

        u, f, _ = jax.lax.fori_loop(0, STEPS, go, (u, value(u), jnp.zeros(())))
        inverse, logdet = linalg.inverse_and_logdet(slopes(u)[1])
        return f - 0.5 * logdet, at(u), watch.root @ inverse @ watch.root.T

    evidence, mean, covariance = jax.vmap(of)(jnp.arange(told.shape[1]), best)
    probability = jax.vmap(lambda x: detected(model, scan, views, x, known.z))(mean)
    return evidence + jnp.log(jnp.maximum(probability, TINY)), mean, covariance, jnp.mean(seen)


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
        rows = jax.vmap(lambda x: _rows(model, scan, x, known))(mean)
        evidence, moved, spread = jax.vmap(_updated)(rows, mean, covariance)  # (T, D), ...
        born, born_mean, born_covariance, share = _births(watch, scan, views, cloud, known)
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
