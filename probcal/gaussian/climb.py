"""Climbs to the mode of the marginal density: from the host by any engine, traced by the dense one.

The step is that of the posterior at the point under the factors of a prior, and what the secants of
the last steps say of log det W (`search`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

from probcal.gaussian.dense import DenseEngine
from probcal.gaussian.engine import Expansion, Factors
from probcal.gaussian.marginal import volume_slope
from probcal.gaussian.mode import SETTLED, TRACK_STEPS, Eliminated, Mode, Point, cost, eliminate, find_tracks, follow
from probcal.gaussian.search import Search, climb_on_host, climb_traced
from probcal.gaussian.solves import Dense
from probcal.linalg import library
from probcal.model.model import Model
from probcal.priors import Precision


class _Expanded(NamedTuple):
    """The density of the biases times factors, by the expansions of any engine."""

    expand: Callable[[Point], Expansion]
    factors: Factors
    marginal: bool

    def moved(self, at: Expansion, dz: np.ndarray) -> Point:
        return at.moved(dz)

    def value(self, at: Expansion) -> np.ndarray:
        volume = 0.0 if self.marginal else 0.5 * float(at.eliminated.logdet)
        return np.asarray(-at.density() - volume - self.factors.value(at.point.z))

    def slope(self, at: Expansion) -> np.ndarray:
        return np.asarray(at.score() if self.marginal else at.slope()) + self.factors.pull(at.point.z)

    def solve(self, at: Expansion, right: np.ndarray, damping: np.ndarray) -> np.ndarray:
        more = Factors.alone(np.full(len(right), damping)) if damping else Factors()
        try:
            return np.asarray(at.solve(self.factors + more if damping else self.factors, right))
        except np.linalg.LinAlgError:  # not positive definite
            return np.full(len(right), np.nan)


class _Eliminated(NamedTuple):
    point: Point
    solved: Eliminated


class _Traced(NamedTuple):
    """The marginal density of the biases, by eliminations that can be traced."""

    model: Model
    prior: Precision

    def expand(self, point: Point) -> _Eliminated:
        point = find_tracks(self.model, point, TRACK_STEPS, SETTLED)
        return _Eliminated(point, eliminate(self.model, point, expected=True))

    def moved(self, at: _Eliminated, dz: jax.Array) -> Point:
        return follow(self.model, at.point, at.solved.parts, dz)

    def value(self, at: _Eliminated) -> jax.Array:
        return cost(self.model, at.point, self.prior) + 0.5 * at.solved.logdet

    def slope(self, at: _Eliminated) -> jax.Array:
        volume, _ = volume_slope(self.model, at.point, at.solved)
        return at.solved.score - self.prior.pull(at.point.z) - 0.5 * volume

    def solve(self, at: _Eliminated, right: jax.Array, damping: jax.Array) -> jax.Array:
        return Dense.of(at.solved.information + self.prior.matrix() + damping * jnp.eye(len(right))).solve(right)


def find_marginal_mode(
    model: Model, start: Point, prior: Precision, iterations: int, tolerance: Any
) -> tuple[Mode, Eliminated]:
    """The mode of the marginal density by a climb of the dense engine, and the system eliminated there.

    It ends where a step promises less than `tolerance`; levels are held. The cost of the mode is
    that of the marginal density. Called from Python it goes from step to step by kernels that other
    parts of a fit use too; inside a compiled function it is a loop.
    """
    if library(*jax.tree.leaves((model, start, prior, tolerance))) is np:
        expanded = _Expanded(partial(DenseEngine().settled, model), Factors.of(prior), True)
        s, *_ = climb_on_host(expanded, start, model.biases, iterations, tolerance)
        solved = s.at.eliminated
    else:
        s = climb_traced(_Traced(model, prior), start, model.biases, iterations, tolerance)
        solved = s.at.solved
    volume = library(solved.logdet).multiply(0.5, solved.logdet)
    refused = (s.taken <= 1) & ~s.converged
    return Mode(s.at.point, s.value, s.count - 1, s.converged, refused, s.begun - s.value, volume), solved


class Climbed(NamedTuple):
    """A climb that ended, or was stopped: the search, whose `at` is the posterior there, and its course."""

    search: Search
    trace: np.ndarray  # (I,) log marginal density with the prior at the start and after every step
    places: np.ndarray  # (I, M) biases there

    @property
    def at(self) -> Expansion:
        """The posterior at the end."""
        return cast("Expansion", self.search.at)

    @property
    def value(self) -> float:
        """Negative log marginal density with the prior."""
        return float(self.search.value)

    @property
    def converged(self) -> bool:
        """True if a step promised less than the tolerance."""
        return bool(self.search.converged)


def climb_to_mode(
    expand: Callable[[Point], Expansion], start: Point, factors: Factors, iterations: int, tolerance: float,
    told: Callable[[int, float], bool] | None = None, *, marginal: bool = True, search: Search | None = None,
) -> Climbed:  # fmt: skip
    """Climb to the mode of the marginal density times factors until a step promises less than
    tolerance.

    Without `marginal` it is the joint mode of biases and trajectory. `expand` gives the posterior
    at a point whose tracks it settles first. It ends where `told`, called with the number of steps
    and the density, says so; a `search` that was stopped goes on.
    """
    expanded = _Expanded(expand, factors, marginal)
    return Climbed(*climb_on_host(expanded, start, len(start.z), iterations, tolerance, told, search))
