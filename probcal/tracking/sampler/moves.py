"""Moves of a Markov chain over associations: each leaves the density of `sampled.fitted` as it is.

Trajectories and biases are integrated, so that the state of a chain is an association alone, and every move is one of
Metropolis and Hastings on finitely many points. A move first fits what it leaves of the association, proposes by that,
and fits what it proposes; both ways are weighed (Oh, Russell, Sastry 2009 sample associations so, with other moves).
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal import linalg
from probcal.gaussian import recursion as rec
from probcal.gaussian.mode import factors
from probcal.gaussian.search import zeros_from
from probcal.tracking.sampler.sampled import Association, Fit, Recording, chances, fitted, log_clutter
from probcal.tracking.scan import View, detected, present
from probcal.tracking.update import TINY, Biases, rows_from, updated

MOVES = ("all scans", "one scan", "swap", "track")
ALL_SCANS, ONE_SCAN, SWAP, TRACK = range(4)
LEAST = -25.0  # log of how much less likely than the best a choice may be proposed: none is out of reach
TO_THE_END = 0.5  # share of the swaps that go from a scan to the last


# the detections of one scan


def _subsets(T: int) -> tuple[np.ndarray, np.ndarray]:
    """Of every set of slots whether it holds each (T, 2^T), and the set without it."""
    sets, bits = np.arange(2**T), 1 << np.arange(T)
    holds = (sets[None, :] & bits[:, None]) > 0
    return holds, sets[None, :] & ~bits[:, None]


def _totals(ratio: jax.Array) -> jax.Array:
    """Log sums (D + 1, 2^T) over the associations of the first d detections that use a set of slots."""
    holds, without = _subsets(len(ratio))

    def add(total: jax.Array, own: jax.Array) -> tuple[jax.Array, jax.Array]:
        each = jnp.where(holds, own[:, None] + total[without], -jnp.inf)
        total = jax.nn.logsumexp(jnp.concatenate([total[None], each]), 0)
        return total, total

    none = jnp.where(jnp.arange(holds.shape[1]) == 0, 0.0, -jnp.inf)
    return jnp.concatenate([none[None], jax.lax.scan(add, none, ratio.T)[1]])


def draw_scan(ratio: jax.Array, key: jax.Array) -> jax.Array:
    """The detection (T,) of each slot in one scan, D of none, drawn exactly: no detection is of two.

    `ratio` (T, D) is the log of the likelihood of each pair over that of the slot missed and the detection false.
    """
    T, D = ratio.shape
    holds, without = _subsets(T)
    totals, keys = _totals(ratio), jax.random.split(key, D + 1)
    last = jax.random.categorical(keys[D], totals[D])

    def back(carry: tuple[jax.Array, jax.Array], d: jax.Array) -> Any:
        left, choice = carry
        each = jnp.where(jnp.asarray(holds)[:, left], ratio[:, d] + totals[d, jnp.asarray(without)[:, left]], -jnp.inf)
        slot = jax.random.categorical(keys[d], jnp.concatenate([each, totals[d, left][None]]))
        taken = slot < T
        own = jnp.minimum(slot, T - 1)
        choice = jnp.where(taken, choice.at[own].set(d), choice)
        return (jnp.where(taken, jnp.asarray(without)[own, left], left), choice), None

    return jax.lax.scan(back, (last, jnp.full(T, D)), jnp.arange(D - 1, -1, -1))[0][1]


def log_scan(ratio: jax.Array, choice: jax.Array) -> jax.Array:
    """Log probability with which `draw_scan` draws a choice (T,)."""
    T, D = ratio.shape
    own = jnp.where(choice < D, ratio[jnp.arange(T), jnp.minimum(choice, D - 1)], 0.0)
    return jnp.sum(own) - jax.nn.logsumexp(_totals(ratio)[D])


# what is proposed


class Proposal(NamedTuple):
    """An association, log density of the way back over that of the way there, and what was drawn on the way."""

    a: Association
    gain: jax.Array
    drawn: "Drawn"


class Drawn(NamedTuple):
    """Biases z (M,), and states and noises (T, E, n), drawn from the Gaussian of a fit; else zeros."""

    z: jax.Array
    states: jax.Array
    noises: jax.Array


def left_by(move: jax.Array, a: Association, D: int, key: jax.Array) -> tuple[Association, jax.Array]:
    """The part of an association that a move leaves, and the scan or slot that it will fill."""
    T, K = a.choice.shape
    slot, scan = jax.random.randint(key, (), 0, T), jax.random.randint(key, (), 0, K)
    chosen = jnp.where(move == TRACK, slot, scan)
    out = (move == TRACK) & (jnp.arange(T) == slot)
    gone = out[:, None] | ((move == ONE_SCAN) & (jnp.arange(K) == scan))[None, :]
    return Association(jnp.where(gone, D, a.choice), a.present & ~out), chosen


def _nothing(fit: Fit) -> Drawn:
    return Drawn(jnp.zeros_like(fit.z), jnp.zeros_like(fit.states), jnp.zeros_like(fit.noises))


def _all_scans(scene: Recording, views: tuple[View, ...], a: Association, fit: Fit, key: jax.Array) -> Proposal:
    """States and biases drawn from the Gaussian of an association, then every scan anew, exactly given these.

    Where that Gaussian is the posterior, a Gibbs step.
    """
    part = scene.watch.model.recursions[0]
    L = factors(part, jnp.zeros(scene.watch.model.level_spread.shape[0]))
    keys = jax.random.split(key, 4)
    dz = fit.biases.draw(keys[0], 1)[0]
    noise = jax.random.normal(keys[1], fit.noises.shape)
    seen = jax.random.normal(keys[2], (*fit.kept.gain.data.shape[:2], fit.kept.gain.data.shape[3]))

    def around(kept: Any, u: jax.Array, v: jax.Array) -> tuple[jax.Array, jax.Array]:
        """A trajectory drawn from the motion, less what smoothing makes of its data."""
        path = rec.trajectory(part.F, L, jnp.zeros((*u.shape, 1)), u[:, :, None])
        smooth = rec.smooth(part.F, kept.gain, kept.J @ path + kept.gain.data @ v[:, :, None])
        return (path - smooth.states)[:, :, 0], u - smooth.noises[:, :, 0]

    dx, du = jax.vmap(around)(fit.kept, noise, seen)
    x = fit.states + dx - fit.by_bias.states @ dz
    u = fit.noises + du - fit.by_bias.noises @ dz
    z = fit.z + dz
    ratio = _ratios(scene, a, chances(scene, views, x, z), _told(scene, x, z))
    choice = jax.vmap(draw_scan)(ratio, jax.random.split(keys[3], len(ratio))).T
    gain = jnp.sum(jax.vmap(log_scan)(ratio, a.choice.T) - jax.vmap(log_scan)(ratio, choice.T))
    return Proposal(a._replace(choice=choice), gain, Drawn(z, x, u))


def log_drawn(fit: Fit, drawn: Drawn) -> jax.Array:
    """Log density of what was drawn under the Gaussian of a fit, up to a constant."""
    dz = drawn.z - fit.z
    dx = drawn.states - fit.states + fit.by_bias.states @ dz
    du = drawn.noises - fit.noises + fit.by_bias.noises @ dz
    square = dz @ fit.biases.apply(dz) + jnp.sum(du**2) + jnp.einsum("tei,teij,tej->", dx, fit.kept.J, dx)
    return 0.5 * (fit.biases.log_determinant() + fit.volume - square)


def _told(scene: Recording, states: jax.Array, z: jax.Array) -> jax.Array:
    """Log density (K, T, D) of every slot of every scan by the states (T, E, n)."""
    model = scene.watch.model
    levels = jnp.zeros(model.level_spread.shape[0])

    def one(scan: Any, x: jax.Array) -> jax.Array:
        parts = model.log_likelihood_at(scan.epoch, (x[None],), z, levels)
        return jnp.concatenate([jnp.sum(part, 1) for part in parts])

    return jax.vmap(lambda scan, at: jax.vmap(partial(one, scan))(at))(
        scene.watch.scans, states[:, scene.epoch].swapaxes(0, 1)
    )


def _ratios(scene: Recording, a: Association, chance: jax.Array, told: jax.Array) -> jax.Array:
    """Log ratios (K, T, D) of every pair by the probability of detection (T, K) and log densities (K, T, D)."""
    odds = jnp.log(jnp.maximum(chance, TINY)) - jnp.log(jnp.maximum(1.0 - chance, TINY))
    ratio = jnp.maximum(odds.T[:, :, None] + told - log_clutter(scene.watch)[:, None], LEAST)
    there = jax.vmap(present)(scene.watch.scans)
    return jnp.where(a.present[None, :, None] & there[:, None], ratio, -jnp.inf)


def _one_scan(
    scene: Recording, views: tuple[View, ...], a: Association, rest: Association, fit: Fit, k: jax.Array, key: jax.Array
) -> Proposal:
    """One scan anew, each pair by what the others predict of it; the fit is that without the scan."""
    model = scene.watch.model
    part, levels = model.recursions[0], jnp.zeros(model.level_spread.shape[0])
    L = factors(part, levels)
    e = scene.epoch[k]
    spread = jax.vmap(lambda kept: rec.covariances(part.F, L, kept.gain)[0][e])(fit.kept)
    x, by_bias = fit.states[:, e], -fit.by_bias.states[:, e]
    scan = jax.tree.map(lambda leaf: leaf[k], scene.watch.scans)
    covariance = fit.biases.covariance()

    def one(x: jax.Array, P: jax.Array, R: jax.Array) -> jax.Array:
        lins = model.linearise_at(scan.epoch, (x[None],), fit.z, levels)
        told = model.log_likelihood_at(scan.epoch, (x[None],), fit.z, levels)
        found = []
        for _, data, _, seen, lin, own in model.each_block(scan.epoch.rows, lins, told):
            there = lin.weight > 0
            variance = jnp.where(there, 1.0 / jnp.where(there, lin.weight, 1.0), 1.0)
            bias = jnp.zeros((*lin.bias.shape[:2], len(fit.z) + 1))
            index = data.bias[seen.sensor]
            rows, columns = jnp.arange(index.shape[0])[:, None, None], jnp.arange(lin.bias.shape[1])[None, :, None]
            bias = bias.at[rows, columns, index[:, None, :]].add(lin.bias)[:, :, :-1]
            H, G = lin.state * there[:, :, None], bias * there[:, :, None]
            G = G + H @ R
            S = H @ P @ H.mT + G @ covariance @ G.mT + jnp.eye(H.shape[1])[None] * variance[:, :, None]
            white = jax.vmap(linalg.inverse_cholesky)(S)
            off = jnp.where(there, lin.score * variance, 0.0)
            square = off**2 / variance - jnp.einsum("dce,de->dc", white, off) ** 2
            volume = jnp.log(jnp.diagonal(white, axis1=1, axis2=2)) + 0.5 * jnp.log(variance)
            found.append(jnp.sum(own + 0.5 * square + volume, 1))
        return jnp.concatenate(found)

    told = jax.vmap(one)(x, spread, by_bias)
    chance = chances(scene, views, fit.states, fit.z)
    ratio = _ratios(scene, rest, chance, jnp.zeros((len(scene.epoch), *told.shape)).at[k].set(told))[k]
    choice = draw_scan(ratio, key)
    gain = log_scan(ratio, a.choice[:, k]) - log_scan(ratio, choice)
    return Proposal(rest._replace(choice=rest.choice.at[:, k].set(choice)), gain, _nothing(fit))


def _swap(a: Association, fit: Fit, key: jax.Array) -> Proposal:
    """Two tracks exchange their detections from a scan on, to the last or to another."""
    T, K = a.choice.shape
    keys = jax.random.split(key, 4)
    first = jax.random.randint(keys[0], (), 0, T)
    second = (first + jax.random.randint(keys[1], (), 1, max(T, 2))) % T
    ends = jnp.sort(jax.random.randint(keys[2], (2,), 0, K))
    end = jnp.where(jax.random.bernoulli(keys[3], TO_THE_END), K - 1, ends[1])
    inside = (jnp.arange(K) >= ends[0]) & (jnp.arange(K) <= end) & a.present[first] & a.present[second]
    one, two = a.choice[first], a.choice[second]
    choice = a.choice.at[first].set(jnp.where(inside, two, one)).at[second].set(jnp.where(inside, one, two))
    return Proposal(a._replace(choice=choice), jnp.zeros(()), _nothing(fit))


def _track(
    scene: Recording, views: tuple[View, ...], a: Association, rest: Association, fit: Fit, t: jax.Array, key: jax.Array
) -> Proposal:
    """A whole track anew: none, or one of the detections that are of no other; the fit is that without the track."""
    keys = jax.random.split(key)
    D = scene.first.mean.shape[1]
    there = jax.vmap(present)(scene.watch.scans)
    free = there & ~jnp.any(rest.choice[:, :, None] == jnp.arange(D)[None, None, :], 0)
    known = Biases(fit.z, fit.biases.covariance(), jnp.zeros(scene.watch.model.level_spread.shape[0]))
    both = jnp.stack([a.choice[t], a.choice[t]])
    walk = jax.vmap(lambda given, held: _walked(scene, views, known, free, given, held, keys[0]))
    picked, density = walk(both, jnp.array([False, True]))
    born = jax.random.bernoulli(keys[1])
    choice = rest.choice.at[t].set(jnp.where(born, picked[0], D))
    gain = jnp.where(a.present[t], density[1], 0.0) - jnp.where(born, density[0], 0.0)
    return Proposal(Association(choice, rest.present.at[t].set(born)), gain, _nothing(fit))


def _walked(
    scene: Recording,
    views: tuple[View, ...],
    known: Biases,
    free: jax.Array,
    given: jax.Array,
    held: jax.Array,
    key: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Detections (K,) of an object picked scan by scan by what those before predict, and the log probability of that.

    Where it is `held` they are those `given` (K,).
    """
    watch, first = scene.watch, scene.first
    D = first.mean.shape[1]

    def pick(carry: Any, at: Any) -> Any:
        mean, covariance, begun, total = carry
        scan, free, given, key, evidence, x, spread, share, false = at
        move = scan.epoch.move[0]
        mean = move.F @ mean + move.drift
        covariance = move.F @ covariance @ move.F.T + move.L @ move.L.T
        told, moved, after = updated(rows_from(watch.model, scan, mean, known), mean, covariance)
        chance = detected(watch.model, scan, views, mean, known.z)
        told = jnp.where(begun, jnp.log(jnp.maximum(chance, TINY)) + told, evidence) - false
        missed = jnp.log(jnp.maximum(1.0 - jnp.where(begun, chance, share), TINY))
        logits = jnp.append(jnp.where(free, told, -jnp.inf), missed)
        logits = jnp.where(jnp.isfinite(logits), jnp.maximum(logits, jnp.max(logits) + LEAST), -jnp.inf)
        chosen = jnp.where(held, given, jax.random.categorical(key, logits))
        total = total + jax.nn.log_softmax(logits)[chosen]
        own, taken = jnp.minimum(chosen, D - 1), chosen < D
        mean = jnp.where(taken, jnp.where(begun, moved[own], x[own]), mean)
        covariance = jnp.where(taken, jnp.where(begun, after[own], spread[own]), covariance)
        return (mean, covariance, begun | taken, total), chosen

    K = len(scene.epoch)
    start = (watch.mean, watch.root @ watch.root.T, jnp.zeros((), bool), jnp.zeros(()))
    at = (watch.scans, free, given, jax.random.split(key, K), *first[:4], log_clutter(watch))
    (_, _, _, total), chosen = jax.lax.scan(pick, start, at)
    return chosen, total


# the chain


class Standing(NamedTuple):
    """An association where a chain stands, and what its fit says of it."""

    a: Association
    density: jax.Array  # () log
    z: jax.Array  # (M,) mean of the biases
    root: jax.Array  # (M, M) inverse root of their precision


def move(
    scene: Recording, views: tuple[View, ...], which: jax.Array, at: Standing, key: jax.Array
) -> tuple[Standing, jax.Array]:
    """One move of Metropolis and Hastings, and whether its proposal was taken."""
    a = at.a
    keys = jax.random.split(key, 3)
    rest, chosen = left_by(which, a, scene.first.mean.shape[1], keys[0])

    def propose(fit: Fit) -> Proposal:
        return jax.lax.switch(
            which,
            [
                lambda: _all_scans(scene, views, a, fit, keys[1]),
                lambda: _one_scan(scene, views, a, rest, fit, chosen, keys[1]),
                lambda: _swap(a, fit, keys[1]),
                lambda: _track(scene, views, a, rest, fit, chosen, keys[1]),
            ],
        )

    def pass_(carry: tuple[Fit, Proposal], first: jax.Array) -> tuple[tuple[Fit, Proposal], Fit]:
        """Fits and completes what is left, then fits the proposal: one code for both."""
        _, found = carry
        fit = fitted(scene, views, found.a)
        return (fit, jax.lax.cond(first, propose, lambda _: found, fit)), fit

    none = zeros_from(fitted, scene, views, rest)
    start = (none, Proposal(rest, jnp.zeros(()), _nothing(none)))
    (there, found), both = jax.lax.scan(pass_, start, jnp.array([True, False]))
    fit = jax.tree.map(lambda leaf: leaf[0], both)
    whole = (which == ALL_SCANS) | (which == SWAP)  # what was left is the association itself; its prior may have moved
    here = jax.tree.map(partial(jnp.where, whole), _standing(a, fit), at)
    drawn = jnp.where(which == ALL_SCANS, log_drawn(there, found.drawn) - log_drawn(fit, found.drawn), 0.0)
    ratio = there.density - here.density + found.gain + drawn
    taken = jnp.log(jax.random.uniform(keys[2])) < jnp.where(jnp.isnan(ratio), -jnp.inf, ratio)
    return jax.tree.map(partial(jnp.where, taken), _standing(found.a, there), here), taken


def _standing(a: Association, fit: Fit) -> Standing:
    return Standing(a, fit.density, fit.z, fit.biases.inverse)
