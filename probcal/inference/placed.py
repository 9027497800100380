"""Climbs with the places of targets at rest integrated: what they add is a term of the biases, which
is renewed where a climb ends until it agrees with the point."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from probcal.gaussian.engine import Engine, Expansion, Factors
from probcal.gaussian.mode import Point
from probcal.gaussian.places import places_of, tilt_of
from probcal.problem import Problem

TILTS = 12  # most climbs with integrated places
ASIDE = 0.02  # sds by which the last may leave a bias aside
SLACK = 0.02  # nats by which the density of integrated places may fall by rounding


class Reached(NamedTuple):
    """The end of a climb."""

    problem: Problem  # that was solved
    at: Expansion
    factors: Factors  # of the prior
    value: float  # of what the climb raises
    state: Any  # what else the method knows


def with_places(
    climb: Callable[[Problem, Point], Reached],
    first: Reached,
    engine: Engine,
    stopped: Callable[[], Any],
) -> tuple[Reached, bool]:
    """Climb with what integrated places add where the density is largest; also whether both agree.

    What they add is known near a point: a climb that does not raise the density is repeated within
    a trust region, and has one where it leaves as much to go as the climb before.
    """
    here, chosen = first, places_of(first.at.model, first.at.point)
    if chosen is None or not any(np.any(own.on) for own in chosen):
        return first, True
    tilt, leash, wanted, done = (
        tilt_of(here.problem.model, here.at.point, chosen),
        0.0,
        np.inf,
        False,
    )
    if tilt is None:
        return first, False
    value = here.value + float(tilt.height)
    for _ in range(TILTS):
        held = tilt._replace(curvature=tilt.curvature + leash * _metric(here.at, tilt.curvature.ndim))
        tried = climb(here.problem.with_tilt(held), here.at.point)
        z = np.asarray(tried.at.point.z)
        after = tilt_of(tried.problem.untilted.model, tried.at.point, chosen)
        better = -np.inf if after is None else tried.value - float(held.value(z)) + float(after.height)
        if after is None or not better > value - SLACK:
            leash = max(4.0 * leash, 1.0)
            continue
        wants = _sds(tried, after.slope - held.pull(z))
        here, tilt, value, done = tried, after, better, wants < ASIDE
        if done or stopped():
            break
        looser = 0.25 * leash if leash > 0.1 else 0.0
        leash, wanted = max(4.0 * leash, 1.0) if wants > 0.5 * wanted else looser, wants
    problem = here.problem.with_tilt(tilt)
    return here._replace(problem=problem, at=engine.at(problem.model, here.at.point)), done


def _metric(at: Expansion, dimensions: int) -> np.ndarray:
    """Information (M, M) of the data and of a prior of unit scale; of many biases that of the prior
    (M,)."""
    information = at.information() if dimensions == 2 else None
    return np.ones(at.model.biases) if information is None else information + np.eye(len(information))


def _sds(reached: Reached, pull: np.ndarray) -> float:
    """The most sds by which a pull (M,) on the biases would move one."""
    every = np.arange(len(pull))[:, None]
    variance = np.asarray(reached.at.marginals(reached.factors, every))[:, 0, 0]
    moved = np.asarray(reached.at.solve(reached.factors, pull))
    return float(np.max(np.abs(moved) / np.sqrt(np.maximum(variance, np.finfo(float).tiny)), initial=0.0))
