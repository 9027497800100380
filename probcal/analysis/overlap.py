"""The distance between two marginal posteriors of a bias: overlap coefficient and Wasserstein
distance, in scales.

A Gaussian posterior is taken as such, any other by its draws. Of a posterior with a point mass at zero (the spike of
spike and slab, a bias that evidence approximation pruned) nobody can say which density has the higher peak there:
where either has one, what lies within `ZERO` scales of zero counts as zero for both, and the rest is compared by
density.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from probcal.lazy import Later

if TYPE_CHECKING:
    from arviz_stats.base import array_stats
    from scipy import stats
else:
    array_stats = Later("arviz_stats.base.array_stats")
    stats = Later("scipy.stats")

ZERO = 0.05  # scales from zero that count as zero beside a point mass
POINTS = 1000  # quantiles that stand for a Gaussian
REACH = 8.0  # sd of a Gaussian on its grid
FEW = 5  # distinct draws below which their density is a Gaussian


class Marginal(NamedTuple):
    """Posterior of one bias in scales: a Gaussian (mean, sd), or draws where `gaussian` is None."""

    points: np.ndarray  # draws, or quantiles of the Gaussian, ascending
    gaussian: tuple[float, float] | None
    massed: bool  # whether it has a point mass at zero


def of_gaussian(mean: float, sd: float, pruned: bool) -> Marginal:
    """A Gaussian; `pruned` says that it stands for a bias that is taken as zero."""
    return Marginal(stats.norm.ppf((np.arange(POINTS) + 0.5) / POINTS, mean, sd), (mean, sd), pruned)


def of_draws(draws: np.ndarray) -> Marginal:
    """The marginal of draws (any shape); those that are exactly zero are a point mass."""
    return Marginal(np.sort(draws, axis=None), None, bool((draws == 0).any()))


def wasserstein(a: Marginal, b: Marginal) -> float:
    """Wasserstein-1 distance in scales: the mean distance between equal quantiles."""
    return float(stats.wasserstein_distance(a.points, b.points))


def overlap(a: Marginal, b: Marginal) -> float:
    """Overlap coefficient, the integral of the smaller density (Inman and Bradley 1989): 1 where they are equal.

    It is the same on any axis: the densities are those of u = asinh((x - centre) / width) about the narrower of the
    two, so that heavy tails do not blur a peak.
    """
    near = ZERO if a.massed or b.massed else 0.0
    centre, width = min((_middle(m) for m in (a, b)), key=lambda pair: pair[1])
    axis = _Axis(near, centre, max(width, 1e-9))
    parts = [_part(m, axis) for m in (a, b)]
    edges = axis.of(near * np.array([-1 - 1e-9, -1 + 1e-9, 1 - 1e-9, 1 + 1e-9]))
    grid = np.unique(np.concatenate([*(part.grid for part in parts), edges]))
    least = np.minimum(*(part.density(grid) for part in parts))
    return float(np.clip(min(part.mass for part in parts) + np.trapezoid(least, grid), 0.0, 1.0))


class _Axis(NamedTuple):
    """The axis u of one comparison, and how near to zero counts as zero."""

    near: float
    centre: float
    width: float

    def of(self, x: np.ndarray) -> np.ndarray:
        return np.arcsinh((x - self.centre) / self.width)


class _Part(NamedTuple):
    """Mass within `near` of zero, and the density of the rest over u, with a grid that resolves it."""

    mass: float
    grid: np.ndarray
    density: Callable[[np.ndarray], np.ndarray]


def _middle(marginal: Marginal) -> tuple[float, float]:
    """Median, and half of what the middle 68 % span."""
    low, middle, high = np.quantile(marginal.points, [0.16, 0.5, 0.84])
    return float(middle), float(high - low) / 2


def _part(marginal: Marginal, axis: _Axis) -> _Part:
    if marginal.gaussian is not None:
        return _normal(*marginal.gaussian, axis, 1.0, axis.near)
    points, near = marginal.points, axis.near
    rest = points[np.abs(points) > near] if near else points
    share = len(rest) / len(points)
    if not len(rest):
        return _Part(1.0, np.zeros(0), np.zeros_like)
    if len(np.unique(rest)) < FEW:
        part = _normal(float(np.mean(rest)), max(float(np.std(rest)), 1e-9), axis, share, 0.0)
        return part._replace(mass=1.0 - share)
    u, p, _ = array_stats.kde(axis.of(rest))
    p *= share / np.trapezoid(p, u)
    return _Part(1.0 - share, u, lambda grid: np.interp(grid, u, p, left=0.0, right=0.0))


def _normal(mean: float, sd: float, axis: _Axis, share: float, near: float) -> _Part:
    """A Gaussian of mass `share`, what lies within `near` of zero apart."""
    mass = float(np.diff(stats.norm.cdf([-near, near], mean, sd))[0])

    def density(u: np.ndarray) -> np.ndarray:
        x = axis.centre + axis.width * np.sinh(u)
        return np.where(np.abs(x) >= near, share * stats.norm.pdf(x, mean, sd) * axis.width * np.cosh(u), 0.0)

    return _Part(share * mass, axis.of(np.linspace(mean - REACH * sd, mean + REACH * sd, 513)), density)
