"""The pose of one sensor by another's: a population that narrows, then the modes that it found and their evidence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal import linalg
from probcal.linalg import solve_square
from probcal.tracking.poses.quad import Paired, normaliser
from probcal.tracking.poses.separable import Crossed, Explained, crossed
from probcal.tracking.scan import View

POPULATION = 512  # points of the search
CLOSE, FOLLOWED = 0.1, 160  # width from which on so many of them go on
BATCH = 32  # of them evaluated at once
WIDTHS = 0.5 ** np.arange(1, 10)  # of the kernel, in scales of the biases
SPREAD = 8  # share of the population that counts after each step
FEW = 24  # scans that the search looks at
RUNS = 2  # of populations
AWAY = 0.5  # from known modes, in scales, that a further population keeps
MODES = 4  # that are kept
BEHIND = 30.0  # nats by which a mode may lie behind the best and is followed
CLIMB = 50  # steps at most
STILL = 1e-3  # of an sd, by which a step that ends a climb moves


def _spread_out(worth: np.ndarray, count: int) -> np.ndarray:
    """Numbers (count,) spread over the scans (K,) by what each is worth."""
    total = np.cumsum(worth)
    if not total[-1] > 0:
        return np.zeros(count, int)
    return np.minimum(np.searchsorted(total, (np.arange(count) + 0.5) / count * total[-1]), len(worth) - 1)


class Term(NamedTuple):
    """One part of the potential of an edge: what explains one sensor's scans, and the views of its model."""

    each: Explained
    views: tuple[View, ...]
    power: float = 1.0

    def few(self) -> Term:
        """The same on at most `FEW` of the scans that have a partner and a detection."""
        held = np.asarray(self.each.mixture.weight).sum(1)
        seen = np.sum([np.asarray(rows.mask).any(2).sum(1) for rows in self.each.scans.epoch.rows], 0)
        worth = np.where(np.asarray(self.each.used), np.minimum(held, seen), 0.0)
        kept = _spread_out(worth, FEW)
        used = worth > 0
        each = self.each
        taken = {
            name: jax.tree.map(lambda leaf: np.asarray(leaf)[kept], getattr(each, name))
            for name in ("scans", "stand", "mixture", "background")
        }
        return self._replace(each=jax.device_put(each._replace(**taken, used=used[kept])))


@partial(jax.jit, static_argnames=("views",))
def _values(
    each: Explained, views: Any, z: jax.Array, theta: jax.Array, at: jax.Array, spread: jax.Array, missed: jax.Array
) -> jax.Array:
    """Log-likelihood (L,) at each of the theta (L, p)."""
    return jax.lax.map(lambda one: crossed(each, views, z, one, at, spread, missed).value, theta, batch_size=BATCH)


@partial(jax.jit, static_argnames=("views",))
def _expanded(each: Explained, views: Any, z: jax.Array, theta: jax.Array, at: jax.Array) -> Crossed:
    """Value, slope (p,) and information (p, p) at one theta (p,)."""
    return crossed(each, views, z, theta, at, jnp.zeros((len(theta), len(theta))))


@jax.jit
def _normalised(each: Paired, z: jax.Array, theta: jax.Array, at: jax.Array) -> Crossed:
    """`normaliser` at each of the theta (L, p)."""
    return jax.lax.map(lambda one: normaliser(each, z, one, at), theta, batch_size=BATCH)


@dataclass(frozen=True, eq=False)
class Potential:
    """The log of an edge's potential, as a function of the biases theta (p,) at the places `at` of z."""

    terms: tuple[Term, ...]
    z: np.ndarray  # (M,) where the others are held
    at: np.ndarray  # (p,)
    period: np.ndarray  # (p,) of angles, inf of the others
    quad: tuple[Paired, ...] = ()  # of the quad term

    def apart(self, theta: np.ndarray, other: np.ndarray) -> np.ndarray:
        """Difference (..., p) of biases, angles the short way round."""
        turns = np.where(np.isfinite(self.period), self.period, 1.0)
        off = theta - other
        return np.where(np.isfinite(self.period), off - turns * np.round(off / turns), off)

    def values(self, theta: np.ndarray, width: float = 0.0, missed: float = 1.0) -> np.ndarray:
        """At each of the theta (L, p), blurred by a kernel; with `missed` 0 what was not detected does not count."""
        spread = width**2 * np.eye(theta.shape[1])
        parts = [t.power * np.asarray(_values(*t[:2], self.z, theta, self.at, spread, missed)) for t in self.terms]
        parts += [np.asarray(_normalised(each, self.z, theta, self.at).value) for each in self.quad]
        return np.sum(parts, 0)

    def expanded(self, theta: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Value, slope (p,) and information (p, p) at theta (p,)."""
        parts = [
            jax.tree.map(lambda leaf, w=t.power: w * leaf, jax.device_get(_expanded(*t[:2], self.z, theta, self.at)))
            for t in self.terms
        ]
        for each in self.quad:
            parts.append(
                jax.tree.map(lambda leaf: leaf[0], jax.device_get(_normalised(each, self.z, theta[None], self.at)))
            )
        value, slope, information = (np.sum(leaves, 0) for leaves in zip(*parts, strict=True))
        return float(value), slope, information

    def few(self) -> Potential:
        """The same on a few of its scans."""
        return Potential(tuple(term.few() for term in self.terms), self.z, self.at, self.period)


class Peak(NamedTuple):
    """A maximum of potential times prior: biases (p,), their covariance by the curvature, and log evidence."""

    theta: np.ndarray
    covariance: np.ndarray
    evidence: float  # over that of no object in common


def search(potential: Potential, rng: np.random.Generator) -> list[Peak]:
    """Modes of a potential under the prior N(0, I) of its biases, the one of most evidence first.

    A population drawn from the prior is weighed by the potential blurred by a kernel, tempered so that an eighth of it
    counts, drawn anew and moved, the kernel narrower by half each time; its best points are where climbs begin. A
    second population keeps away from what the first one found.
    """
    few, found = potential.few(), list[Peak]()
    for _ in range(RUNS):
        theta = _narrowed(few, len(potential.at), rng, [mode.theta for mode in found])
        value = potential.values(theta, float(WIDTHS[-1]))
        found = climbed(potential, _best(potential, theta, value), found)
    return found


def _narrowed(few: Potential, p: int, rng: np.random.Generator, known: Sequence[np.ndarray]) -> np.ndarray:
    """Points (L, p) to which a population has narrowed, away from what is known."""
    from scipy.stats import norm, qmc

    theta = norm.ppf(np.clip(qmc.Sobol(p, seed=rng).random(POPULATION), 1e-6, 1 - 1e-6))
    for width in WIDTHS:
        value = few.values(theta, width, missed=0.0)
        for place in known:
            value = np.where(np.abs(few.apart(theta, place)).max(1) < min(3.0 * width, AWAY), value.min(), value)
        size = POPULATION if width > CLOSE else FOLLOWED
        theta = theta[_drawn(value, size, rng)] + 0.5 * width * rng.standard_normal((size, p))
    return theta


def climbed(potential: Potential, starts: np.ndarray, known: Sequence[Peak] = ()) -> list[Peak]:
    """The different modes that starts (S, p) lead to, and those known."""
    found = list(known)
    for start in starts:
        mode = ascend(potential, start)
        if mode is not None and not any(same(potential, mode, other) for other in found):
            found.append(mode)
    found.sort(key=lambda mode: -mode.evidence)
    return [mode for mode in found if mode.evidence > found[0].evidence - BEHIND]


def ascend(potential: Potential, start: np.ndarray) -> Peak | None:
    """The maximum of potential times prior by damped Gauss-Newton steps, with Laplace's evidence; None at none."""
    eye = np.eye(len(start))
    theta, damping = start, 1e-3
    value, slope, H = potential.expanded(theta)
    for _ in range(CLIMB):
        W = H + eye
        step = solve_square(W + damping * np.diag(np.diagonal(W)), slope - theta)
        new = potential.expanded(theta + step)
        if new[0] - 0.5 * np.sum((theta + step) ** 2) >= value - 0.5 * theta @ theta - 1e-9:
            theta, (value, slope, H), damping = theta + step, new, 0.1 * damping
            if np.sqrt(step @ W @ step) < STILL:
                break
        else:
            damping = max(10.0 * damping, 1e-3)
            if damping > 1e8:
                break
    W = H + eye
    if not np.isfinite(W).all():
        return None
    covariance, logdet = (np.asarray(part) for part in linalg.inverse_and_logdet(jnp.asarray(W)))
    return Peak(theta, covariance, float(value - 0.5 * theta @ theta - 0.5 * logdet))


def same(potential: Potential, one: Peak, other: Peak) -> bool:
    """True if two modes lie within three of their sds."""
    away = potential.apart(one.theta, other.theta)
    return bool(np.all(np.abs(away) < 3.0 * np.sqrt(np.diagonal(one.covariance + other.covariance))))


def _drawn(value: np.ndarray, size: int, rng: np.random.Generator) -> np.ndarray:
    """Numbers (size,) drawn by weights exp(power value), the power such that a share of the population counts."""
    L = len(value)
    low, high, weight = 0.0, 1.0, np.full(L, 1.0 / L)
    for _ in range(40):
        power = 0.5 * (low + high)
        weight = np.exp(power * (value - value.max()))
        weight /= weight.sum()
        low, high = (power, high) if 1.0 / np.sum(weight**2) > L / SPREAD else (low, power)
    return np.minimum(np.searchsorted(np.cumsum(weight), (rng.random() + np.arange(size)) / size), L - 1)


def _best(potential: Potential, theta: np.ndarray, value: np.ndarray) -> np.ndarray:
    """The best points that lie apart from better ones."""
    order, kept = np.argsort(-value), list[int]()
    for k in order[value[order] > value[order[0]] - BEHIND]:
        near = [np.abs(potential.apart(theta[k], theta[other])).max() < 8.0 * WIDTHS[-1] for other in kept]
        if len(kept) < MODES and not any(near):
            kept.append(int(k))
    return theta[kept]
