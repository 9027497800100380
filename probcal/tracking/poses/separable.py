"""Separable likelihoods: how well what one sensor tracks by itself explains the detections of another.

Each sensor is filtered once, alone, at its stated pose. Other poses carry what it knows along, since it measures in
its own axes; so the likelihood of the poses of a pair is evaluated without another filter (Uney, Mulgrew, Clark 2016).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal import linalg
from probcal.model.model import Model
from probcal.problem import Problem
from probcal.tracking.phd import Intensity
from probcal.tracking.poses.local import Alone, carried
from probcal.tracking.scan import Scan, View, detected, present
from probcal.tracking.update import TINY

TERMS = ("dual", "quad")


class Explained(NamedTuple):
    """The inputs to explain one sensor's scans by another's mixtures (K scans, J components)."""

    model: Model  # of the sensor that is explained
    scans: Scan
    other: Model  # of the sensor that explains
    stand: Scan  # its scan behind each of K, which tells its pose
    mixture: Intensity  # carried to each scan, at the stated pose of the sensor that explains
    background: jax.Array  # (K, D) density of detections that it does not know of
    used: jax.Array  # (K,) whether the scan has a partner
    levels: jax.Array  # (H,)


def background(one: Alone, count: np.ndarray) -> np.ndarray:
    """Density (K, D) of detections of a sensor that another need not know: clutter, and objects that it sees itself.

    `count` (K,) is how many it holds in the mean.
    """
    scans = one.watch.scans
    return np.asarray(scans.density) * (np.asarray(scans.clutter) + np.maximum(count, 1.0))[:, None]


def partners(time: np.ndarray, other: np.ndarray, window: float, *, before: bool) -> np.ndarray:
    """For each scan (K,) the scan of the other sensor that tells most of it, -1 of none (Separable likelihoods 15-16).

    A pair counts where stamps match both ways: the other's latest scan lies within `window` s, and itself has such a
    scan of the first. Taken is the latest scan at that time, or strictly `before` it, so that nothing counts twice.
    """

    def latest(at: np.ndarray, of: np.ndarray, side: Any) -> np.ndarray:
        return np.searchsorted(of, at, side=side) - 1

    here = latest(time, other, "right")
    there = other[np.maximum(here, 0)]
    back = latest(there, time, "right")
    matched = (here >= 0) & (time - there <= window) & (back >= 0)
    matched &= there - time[np.maximum(back, 0)] <= window
    taken = latest(time, other, "left") if before else here
    return np.where(matched & (taken >= 0), taken, -1)


def matched_scans(one: Alone, other: Alone, window: float, *, before: bool) -> np.ndarray:
    """The scan (K,) of the other sensor behind each of the first, -1 of none; padded scans have none."""
    pair = partners(one.time[one.there], other.time[other.there], window, before=before)
    return np.concatenate([pair, np.full(len(one.time) - len(pair), -1)])


def carry(problem: Problem, after: Intensity, which: np.ndarray, dt: np.ndarray, lifetime: float) -> Intensity:
    """Mixtures (K, J) of some scans carried on by times dt (K,) in s."""
    dt = np.maximum(dt, 0.0)
    F, L, drift = carried(problem, dt)
    weight, mean, covariance = (np.asarray(leaf)[which] for leaf in after)
    found: Any = (
        weight * np.exp(-dt / lifetime)[:, None],
        np.einsum("kij,kaj->kai", F, mean) + drift[:, None],
        np.einsum("kij,kajl,kml->kaim", F, covariance, F) + (L @ L.transpose(0, 2, 1))[:, None],
    )
    return Intensity(*found)


def explained(
    problem: Problem, one: Alone, other: Alone, after: Intensity, count: np.ndarray, window: float, lifetime: float, *,
    before: bool,
) -> Explained:  # fmt: skip
    """The inputs to explain the scans of `one` by mixtures (K, J) of `other` after its scans."""
    pair = matched_scans(one, other, window, before=before)
    behind = np.maximum(pair, 0)
    mixture = carry(problem, after, behind, np.where(pair >= 0, one.time - other.time[behind], 0.0), lifetime)
    stand = jax.tree.map(lambda leaf: leaf[behind], other.watch.scans)
    arrays: Any = (stand, mixture, background(one, count), pair >= 0, np.zeros(len(problem.levels)))
    return jax.device_put(Explained(one.watch.model, one.watch.scans, other.watch.model, *arrays))


def first_slot(scan: Scan) -> Scan:
    """A scan with its first slot alone, whose value is there: it tells the pose of the sensor."""
    rows = tuple(jax.tree.map(lambda leaf: leaf[:1], seen) for seen in scan.epoch.rows)
    rows = tuple(seen._replace(mask=jnp.ones_like(seen.mask)) for seen in rows)
    return scan._replace(epoch=scan.epoch._replace(rows=rows))


def _axes(target: Any, pose: Any, *rest: Any) -> jax.Array:
    """Place and axes (d + 1, d) of a node: a vector v of the common frame is `axes @ v` in its own."""
    d = pose.position.shape[0]
    return jnp.concatenate([pose.position[None], jnp.stack([pose.turn(e) for e in jnp.eye(d)], 1)])


def go_along(model: Model, scan: Scan, x: jax.Array, z: jax.Array) -> jax.Array:
    """A state x (n,) that a sensor knows at its stated pose, where it is if its biases are z.

    Positions go along with the node, vectors turn with it, other components stay.
    """
    first = first_slot(scan).epoch
    (stated,), (moved,) = (
        tuple(part[0] for part in model.look_at(first, (x[None],), at, _axes)) for at in (jnp.zeros_like(z), z)
    )
    turn = linalg.multiply(moved[1:].T, stated[1:])
    d = len(turn)
    for name, start, stop, per_axis in model.blocks[0].layout:
        if per_axis and stop - start == d:
            vector = x[start:stop]
            own = moved[0] + turn @ (vector - stated[0]) if name == "position" else turn @ vector
            x = x.at[start:stop].set(own)
    return x


class Told(NamedTuple):
    """The terms per mixture component for a scan's slots: detection chance, log density, slope.

    Minus the second derivative is that of Gauss and Newton: the covariance of the prediction is held.
    """

    chance: jax.Array  # (J,)
    density: jax.Array  # (J, D)
    slope: jax.Array  # (J, D, p) by the biases
    information: jax.Array  # (J, D, p, p)


class Crossed(NamedTuple):
    """Log-likelihood of scans given another sensor's mixtures over that of no object in common, and derivatives."""

    value: jax.Array  # ()
    slope: jax.Array  # (p,)
    information: jax.Array  # (p, p), positive semi-definite


def told(
    each: Explained, views: tuple[View, ...], scan: Scan, stand: Scan, mixture: Intensity, z: jax.Array,
    theta: jax.Array, at: jax.Array, spread: jax.Array,
) -> Told:  # fmt: skip
    """The detections of one scan as the components of a mixture at biases z see them, with z[at] = theta.

    `spread` (p, p) is the covariance of theta, which counts as noise of each detection. Noise that is not Gaussian
    counts by its expected information.
    """
    first = first_slot(scan).epoch

    def where(x: jax.Array, theta: jax.Array) -> jax.Array:
        return go_along(each.other, stand, x, z.at[at].set(theta))

    def predicted(x: jax.Array, theta: jax.Array) -> jax.Array:
        return each.model.predict_at(first, (where(x, theta)[None],), z.at[at].set(theta))[0][0]

    def of(x: jax.Array, P: jax.Array) -> Told:
        h = predicted(x, theta)
        H, B = jax.jacrev(predicted, argnums=(0, 1))(x, theta)
        ((off, information),) = each.model.innovations_at(scan.epoch, (h[None],), each.levels)
        wide = H @ P @ H.T + B @ spread @ B.T  # (C, C)
        root = jnp.sqrt(information)  # (D, C), 0 where missing
        S = jnp.eye(len(h))[None] + root[:, :, None] * wide[None] * root[:, None, :]
        inverse = jax.vmap(linalg.inverse_cholesky)(S)
        white = jnp.einsum("dij,dj->di", inverse, root * off)
        by = jnp.einsum("dij,dj,jp->dip", inverse, root, B)
        seen = information > 0
        volume = jnp.where(seen, jnp.log(jnp.where(seen, information, 1.0) / (2.0 * jnp.pi)), 0.0)
        density = 0.5 * jnp.sum(volume - white**2, 1) + jnp.sum(jnp.log(jnp.diagonal(inverse, axis1=1, axis2=2)), 1)
        n = len(x)
        away = jnp.sqrt(float(n)) * linalg.semi_cholesky(P[None])[0].T
        around = x[None] + jnp.concatenate([away, -away])  # cubature points: part of a wide component may be in view
        chance = jnp.mean(
            jax.vmap(lambda x: detected(each.model, scan, views, where(x, theta), z.at[at].set(theta)))(around)
        )
        return Told(chance, density, jnp.einsum("dip,di->dp", by, white), jnp.einsum("dip,diq->dpq", by, by))

    return jax.vmap(of)(mixture.mean, mixture.covariance)


def crossed(
    each: Explained, views: tuple[View, ...], z: jax.Array, theta: jax.Array, at: jax.Array, spread: jax.Array,
    missed: jax.Array | float = 1.0,
) -> Crossed:  # fmt: skip
    """The dual-term likelihood of all scans in one direction (Separable likelihoods 5).

    Detections are a Poisson process (Uney, Mulgrew, Clark 2016): those that the other sensor's mixture predicts where
    it is seen, and a background. With `missed` 0 nothing speaks against objects that were expected and not detected.
    """

    def of(scan: Scan, stand: Scan, mixture: Intensity, density: jax.Array, used: jax.Array) -> Crossed:
        seen = told(each, views, scan, stand, mixture, z, theta, at, spread)
        weight = mixture.weight * seen.chance
        share = weight[:, None] * jnp.exp(seen.density) / jnp.maximum(density, TINY)[None]  # (J, D)
        share = jnp.where(present(scan)[None], share, 0.0)
        total = jnp.sum(share, 0)
        value = jnp.sum(jnp.log1p(total)) - missed * jnp.sum(weight)
        share = share / (1.0 + total)[None]
        slope, information = (
            jnp.einsum("jd,jdp->p", share, seen.slope),
            jnp.einsum("jd,jdpq->pq", share, seen.information),
        )
        return jax.tree.map(lambda leaf: jnp.where(used, leaf, 0.0), Crossed(value, slope, information))

    parts = jax.vmap(of)(each.scans, each.stand, each.mixture, each.background, each.used)
    return jax.tree.map(lambda leaf: jnp.sum(leaf, 0), parts)
