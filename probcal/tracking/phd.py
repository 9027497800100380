"""Intensity of an unknown number of objects from scans: Gaussian-mixture PHD and cardinalised PHD filters.

The intensity is a Gaussian mixture whose weights add up to the mean number of objects that were detected at least once
(Vo, Ma 2006); those never detected are a Poisson process spread as the start of the motion, whose share in a detection
begins a component. The cardinalised filter (Vo, Vo, Cantoni 2007) carries the distribution of the number of all of
them beside it.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaln, logsumexp, xlogy

from probcal import linalg
from probcal.errors import InputError
from probcal.lazy import pd
from probcal.problem import Problem
from probcal.tracking.entry import asked
from probcal.tracking.scan import Scan, View, Watch, detected, present
from probcal.tracking.update import TINY, Biases, Chances, births, rows_from, updated, updated_by_points
from probcal.types import float64

Kind = Literal["phd", "cphd"]
Update = Literal["extended", "cubature"]
PRUNE = 1e-5  # weight up to which a component is dropped
MERGE = 4.0  # squared Mahalanobis distance up to which two become one
CONSIDERED = 4  # times as many components as are kept may be merged, the heaviest
LEAST = 0.05  # weight of a component that may be taken for an object
HIGHEST = 60  # most objects whose number has a probability


class Intensity(NamedTuple):
    """A Gaussian mixture of J components whose weights add up to a mean number of objects; weight 0 is none."""

    weight: jax.Array  # (J,)
    mean: jax.Array  # (J, n)
    covariance: jax.Array  # (J, n, n)


class Passed(NamedTuple):
    """The belief at each of K scans (leading): objects detected at least once, and their number."""

    before: Intensity  # predicted to the scan
    after: Intensity
    count: jax.Array  # type: ignore[assignment]  # () mean number of all objects after it
    undetected: jax.Array  # () of it, mean number never detected
    spread: jax.Array  # () variance of the number of all
    log_likelihood: jax.Array  # () of the scan given those before


class _Detections(NamedTuple):
    """The likelihood terms of a scan's slots, for predicted components and undetected objects."""

    there: jax.Array  # (D,)
    chance: jax.Array  # (J,) of detection
    pair: jax.Array  # (D, J) log of weight, chance and density of a slot
    fresh: jax.Array  # (D,) the same of objects never detected
    false: jax.Array  # (D,) log density of false detections
    share: jax.Array  # () chance of detection of an object never detected


class _Shares(NamedTuple):
    """The factors for missed objects and for each slot's pairs, and the scan's log-likelihood."""

    missed: jax.Array  # () factor, besides the chance of being missed
    slot: jax.Array  # (D,) log factor of the pairs of each slot
    log_likelihood: jax.Array  # ()
    number: jax.Array  # (N,) log probability of each number of objects


def _moved(watch: Watch, scan: Scan, held: Intensity, stays: jax.Array, known: Biases) -> Intensity:
    """The components that survive, at the time of a scan."""
    move = scan.epoch.move[0]
    L = move.L * jnp.concatenate([jnp.exp(known.levels), jnp.ones(1)])[move.level][None, :]
    mean = held.mean @ move.F.T + move.drift[None]
    covariance = jnp.einsum("ij,tjk,lk->til", move.F, held.covariance, move.F) + (L @ L.T)[None]
    return Intensity(held.weight * stays, mean, covariance)


def _log(value: jax.Array) -> jax.Array:
    return jnp.where(value > 0, jnp.log(jnp.where(value > 0, value, 1.0)), -jnp.inf)


# the number of objects


def _log_binomial(n: jax.Array, k: jax.Array) -> jax.Array:
    return gammaln(n + 1.0) - gammaln(k + 1.0) - gammaln(n - k + 1.0)


def _poisson(mean: jax.Array, highest: int) -> jax.Array:
    """Log probabilities (N,) of the numbers up to the highest."""
    n = jnp.arange(highest + 1.0)
    found = xlogy(n, mean) - mean - gammaln(n + 1.0)
    return found - logsumexp(found)


def _outlived(number: jax.Array, stays: jax.Array, born: jax.Array) -> jax.Array:
    """Log probabilities (N,) of the numbers after some went, each staying with a probability, and others came."""
    n = jnp.arange(float(len(number)))
    k = n[:, None]
    alive = k <= n[None]
    gone = jnp.where(alive, n[None] - k, 0.0)
    thinned = _log_binomial(k + gone, k) + xlogy(k, stays) + xlogy(gone, -jnp.expm1(_log(stays)))
    left = logsumexp(jnp.where(alive, thinned + number[None], -jnp.inf), 1)
    more = jnp.where(alive, 0.0, k - n[None])  # of k those that came, where n were left
    came = xlogy(more, born) - born - gammaln(more + 1.0)
    found = logsumexp(jnp.where(k >= n[None], came + left[None], -jnp.inf), 1)
    return found - logsumexp(found)


def _moments(number: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Mean and variance of a number with log probabilities (N,)."""
    n = jnp.arange(float(len(number)))
    mean = jnp.sum(n * jnp.exp(number))
    return mean, jnp.sum((n - mean) ** 2 * jnp.exp(number))


def symmetric(false: jax.Array, found: jax.Array, used: jax.Array, degree: int) -> jax.Array:
    """Log coefficients (degree + 1,) of the product over slots (D,) of exp(false) + exp(found) t, those used.

    They are the elementary symmetric functions of the ratios times the densities of false detections: sums of
    positive terms alone, so that nothing cancels.
    """

    def grow(c: jax.Array, slot: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, None]:
        f, a, on = slot
        higher = jnp.concatenate([jnp.full(1, -jnp.inf), c[:-1]])
        return jnp.where(on, jnp.logaddexp(c + f, higher + a), c), None

    first = jnp.full(degree + 1, -jnp.inf).at[0].set(0.0)
    return jax.lax.scan(grow, first, (false, found, used))[0]


def _as_poisson(seen: _Detections, before: Intensity, hidden: jax.Array, clutter: jax.Array) -> _Shares:
    """The update of a Poisson process (Vo, Ma 2006)."""
    total = jnp.logaddexp(logsumexp(seen.pair, 1), jnp.logaddexp(seen.fresh, seen.false))
    expected = clutter + jnp.sum(before.weight * seen.chance) + hidden * seen.share
    value = jnp.sum(jnp.where(seen.there, total, 0.0)) - expected
    return _Shares(jnp.ones(()), -total, value, jnp.zeros(0))


def _as_cluster(
    seen: _Detections, before: Intensity, hidden: jax.Array, clutter: jax.Array, number: jax.Array
) -> _Shares:
    """The update of a process of independent objects of any number (Vo, Vo, Cantoni 2007, 13 to 17)."""
    N, D = len(number), len(seen.there)
    degree = min(D, N - 1)
    whole = jnp.sum(before.weight) + hidden
    missed = jnp.sum(before.weight * (1.0 - seen.chance)) + hidden * (1.0 - seen.share)
    a = jnp.logaddexp(logsumexp(seen.pair, 1), seen.fresh) - jnp.log(whole)  # of a slot, by one object
    n, j = jnp.arange(float(N))[:, None], jnp.arange(degree + 1.0)[None]

    def ways(u: int) -> jax.Array:
        """Log of the ways in which j + u of n objects are picked in order, the others missed."""
        there = n >= j + u
        rest = jnp.where(there, n - j - u, 0.0)
        picked = gammaln(n + 1.0) - gammaln(rest + 1.0) + xlogy(rest, jnp.minimum(missed / whole, 1.0))
        return jnp.where(there, picked, -jnp.inf)

    none, one = ways(0), ways(1)
    beside = logsumexp(number[:, None] + one, 0)  # (J,) where one object more is picked
    all_of = symmetric(seen.false, a, seen.there, degree)
    others = jax.vmap(lambda left: symmetric(seen.false, a, seen.there & ~left, degree))(jnp.eye(D, dtype=bool))
    found = number + logsumexp(none + all_of[None], 1)
    total = logsumexp(found)
    return _Shares(
        jnp.exp(logsumexp(all_of + beside) - total) / whole,
        logsumexp(others + beside[None], 1) - total - jnp.log(whole),
        total - clutter,
        found - total,
    )


# few components


def reduced(mixture: Intensity, most: int, prune: jax.Array | float, merge: jax.Array | float) -> Intensity:
    """At most `most` components: light ones dropped, near ones merged, the sum of the weights kept.

    From the heaviest on, each takes those within a squared Mahalanobis distance `merge` by the covariances of both (one
    that is wide widens no narrow one beside it); a group becomes the Gaussian with its moments. What was dropped is
    made up by the weights of the others.
    """
    weight, which = jax.lax.top_k(mixture.weight, min(CONSIDERED * most, len(mixture.weight)))
    mean, covariance = mixture.mean[which], mixture.covariance[which]
    white = jax.vmap(linalg.inverse_cholesky)(covariance)
    rank = jnp.arange(len(weight))

    def group(left: jax.Array, _: None) -> tuple[jax.Array, Intensity]:
        top = jnp.argmax(left)
        off = mean - mean[top][None]
        theirs = jnp.sum(jnp.einsum("tij,tj->ti", white, off) ** 2, 1)
        mine = jnp.sum((off @ white[top].T) ** 2, 1)
        near = (left > 0) & ((jnp.maximum(theirs, mine) <= merge) | (rank == top))
        taken = jnp.where(near, left, 0.0)
        total = jnp.sum(taken)
        share = jnp.where(total > 0, taken / jnp.where(total > 0, total, 1.0), (rank == top).astype(float))
        shift = share @ off
        wide = off - shift[None]
        spread = jnp.einsum("t,tij->ij", share, covariance) + (wide * share[:, None]).T @ wide
        return jnp.where(near, 0.0, left), Intensity(total, mean[top] + shift, spread)

    _, found = jax.lax.scan(group, jnp.where(weight > prune, weight, 0.0), length=most)
    kept = jnp.sum(found.weight)
    whole = jnp.sum(mixture.weight)
    return found._replace(weight=found.weight * jnp.where(kept > 0, whole / jnp.where(kept > 0, kept, 1.0), 0.0))


Carry = tuple[Intensity, jax.Array, jax.Array]  # and the mean number never detected, log probabilities of the number


@partial(jax.jit, static_argnames=("views", "most", "kind", "update", "highest"))
def filter_intensity(
    watch: Watch,
    views: tuple[View, ...],
    known: Biases,
    chances: Chances,
    cloud: jax.Array,
    most: int,
    *,
    kind: Kind = "phd",
    update: Update = "extended",
    prune: jax.Array | float = PRUNE,
    merge: jax.Array | float = MERGE,
    highest: int = HIGHEST,
) -> Passed:
    """All scans one after the other with `most` components kept, biases and levels held; K leading.

    What is not known of the biases counts as noise of each detection alone. A scan of a sensor that sees nothing and
    reports nothing updates nothing, and moves nothing if no time went by.
    """
    model, n = watch.model, len(watch.mean)

    def one(scan: Scan, mean: jax.Array, covariance: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        if update == "cubature":
            return updated_by_points(model, scan, mean, covariance, known)
        return updated(rows_from(model, scan, mean, known), mean, covariance)

    def read(scan: Scan, before: Intensity, hidden: jax.Array) -> tuple[_Detections, Intensity]:
        """The slots of a scan, and the components that each would make: (J D + D,) with unit weights."""
        there = present(scan)
        chance = jax.vmap(lambda x: detected(model, scan, views, x, known.z))(before.mean)
        evidence, mean, covariance = jax.vmap(partial(one, scan))(before.mean, before.covariance)  # (J, D), ...
        born, born_mean, born_covariance, share = births(watch, scan, views, cloud, known)
        false = jnp.log(jnp.maximum(scan.clutter * scan.density, TINY))
        pair = (_log(before.weight * chance)[:, None] + evidence).T
        seen = _Detections(there, chance, pair, jnp.log(jnp.maximum(hidden, TINY)) + born, false, share)
        D = len(there)
        means = jnp.concatenate([jnp.swapaxes(mean, 0, 1).reshape(-1, n), born_mean])
        spreads = jnp.concatenate([jnp.swapaxes(covariance, 0, 1).reshape(-1, n, n), born_covariance])
        return seen, Intensity(jnp.ones(D * (most + 1)), means, spreads)

    def step(carry: Carry, scan: Scan) -> tuple[Carry, Passed]:
        held, hidden, number = carry
        stays = jnp.exp(-scan.elapsed / chances.lifetime)
        born = chances.births * scan.elapsed
        later = _moved(watch, scan, held, stays, known)
        before, hidden, number = jax.tree.map(
            lambda new, old: jnp.where(scan.elapsed > 0, new, old),
            (later, hidden * stays + born, _outlived(number, stays, born) if kind == "cphd" else number),
            carry,
        )
        if kind == "cphd":  # the number that is cut at the highest rules
            factor = _moments(number)[0] / jnp.maximum(jnp.sum(before.weight) + hidden, TINY)
            factor = jnp.where(scan.elapsed > 0, factor, 1.0)
            before, hidden = before._replace(weight=before.weight * factor), hidden * factor
        seen, parts = read(scan, before, hidden)
        shares = (
            _as_cluster(seen, before, hidden, scan.clutter, number)
            if kind == "cphd"
            else _as_poisson(seen, before, hidden, scan.clutter)
        )
        taken = jnp.concatenate([(seen.pair + shares.slot[:, None]).reshape(-1), seen.fresh + shares.slot])
        on = jnp.concatenate([jnp.repeat(seen.there, most), seen.there])
        whole = Intensity(
            jnp.concatenate([before.weight * (1.0 - seen.chance) * shares.missed, jnp.where(on, jnp.exp(taken), 0.0)]),
            jnp.concatenate([before.mean, parts.mean]),
            jnp.concatenate([before.covariance, parts.covariance]),
        )
        told = jnp.any(seen.there) | (scan.probability > 0)
        new = reduced(whole, most, prune, merge), hidden * (1.0 - seen.share) * shares.missed, shares.number
        after, hidden, number = jax.tree.map(lambda a, b: jnp.where(told, a, b), new, (before, hidden, number))
        count = jnp.sum(after.weight) + hidden
        spread = _moments(number)[1] if kind == "cphd" else count
        passed = Passed(before, after, count, hidden, spread, jnp.where(told, shares.log_likelihood, 0.0))
        return (after, hidden, number), passed

    start = Intensity(jnp.zeros(most), jnp.tile(watch.mean[None], (most, 1)), jnp.tile(jnp.eye(n)[None], (most, 1, 1)))
    hidden = jnp.asarray(chances.undetected, float)
    number = _poisson(hidden, highest) if kind == "cphd" else jnp.zeros(0)
    return jax.lax.scan(step, (start, hidden, number), watch.scans)[1]


# tables


@dataclass(frozen=True, eq=False)
class Intensities:
    """The intensity of the objects in a table of detections after each of its scans.

    `count` has a line for each scan: its number, time, sensor, count (mean number of all objects), sd, and undetected
    (of it, the mean number never detected). `components` lists the Gaussians of each scan (scan, time, weight, and the
    mean and sd of each state component), the heaviest first; `peaks` those that are taken for objects: as many of the
    heaviest as the weights of the scan add up to, none of less than 0.05.
    """

    count: pd.DataFrame
    components: pd.DataFrame
    peaks: pd.DataFrame


@float64
def phd_filter(
    problem: Problem,
    z: Any = None,
    covariance: Any = None,
    *,
    kind: Kind = "phd",
    update: Update = "extended",
    objects: float = 3.0,
    births: float = 0.02,
    lifetime: float = 600.0,
    most: int = 32,
    sensors: Collection[str] = (),
) -> Intensities:
    """Count and place the objects behind detections that name none, with biases z (M,) held (in their scales; 0).

    A Gaussian-mixture PHD filter (Vo, Ma 2006) of at most `most` components, or with `kind="cphd"` a cardinalised one
    (Vo, Vo, Cantoni 2007), whose number of objects is surer; both follow objects without saying which is which, as
    `track_objects` does. What is not known of the biases, `covariance` (M, M), counts as noise of each detection.

    At the first scan `objects` are expected anywhere in the start of the motion, `births` a second appear later, and
    each stays for `lifetime` s in the mean; one begins with the first detection of it. `update` takes a detection in by
    derivatives at the mean of a component ("extended") or by points around it ("cubature"). `sensors` are the names of
    those that are heeded, all by default. Raises `InputError` where every row names its target, or the motion has no
    linear form.

    >>> seen = probcal.Detection(0.9, clutter=0.1, view=probcal.Sector(range=500.0))
    >>> sonars = probcal.Network([s.type.on(*s.nodes, detection=seen) for s in network.sensors])
    >>> boats = probcal.Target(motion, {"position": ((100.0, 100.0), 100.0), "velocity": ((0.0, 0.0), 10.0)})
    >>> unnamed = Problem(sonars, boats, run.table)
    >>> found = probcal.phd_filter(unnamed, covariance=np.eye(len(unnamed.labels)), kind="cphd")
    >>> round(found.count["count"].iloc[-1])
    1
    """
    for name, value, allowed in (("kind", kind, get_args(Kind)), ("update", update, get_args(Update))):
        if value not in allowed:
            raise InputError(f'phd_filter({name}={value!r}): give "{allowed[0]}" or "{allowed[1]}"')
    own, watch, views, known, chances, cloud = asked(
        "phd_filter", problem, z, covariance,
        objects=objects, births=births, lifetime=lifetime, most=most, sensors=sensors,
    )  # fmt: skip
    passed = filter_intensity(watch, views, known, chances, cloud, most, kind=kind, update=update)
    return _tables(jax.device_get(passed), own)


def _tables(passed: Passed, problem: Problem) -> Intensities:
    """The results of the filter, K leading, as tables with names."""
    scans = problem.scans
    assert scans is not None
    number, time = np.arange(len(scans)), scans.time
    sensor = np.array([placed.name for placed in problem.network.sensors])[scans.sensor]
    count = pd.DataFrame({"scan": number, "time": time, "sensor": sensor, "count": passed.count})
    count["sd"], count["undetected"] = np.sqrt(np.asarray(passed.spread)), np.asarray(passed.undetected)
    weight = np.asarray(passed.after.weight)
    order = np.argsort(-weight, axis=1, kind="stable")
    place = np.argsort(order, axis=1)  # 0 of the heaviest
    k, j = np.nonzero(weight > 0)
    line = np.lexsort((place[k, j], k))
    k, j = k[line], j[line]
    components = pd.DataFrame({"scan": k, "time": time[k], "weight": weight[k, j]})
    mean, covariance = np.asarray(passed.after.mean)[k, j], np.asarray(passed.after.covariance)[k, j]
    sd = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0))
    for i, name in enumerate(problem.epochs[0].components):
        components[name], components[f"{name}_sd"] = mean[:, i], sd[:, i]
    peak = (place[k, j] < np.round(weight.sum(1))[k]) & (weight[k, j] >= LEAST)
    return Intensities(count, components, components[peak].reset_index(drop=True))
