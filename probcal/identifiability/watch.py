"""The directions in which a fit ran far: gauge directions that no row fixes, and undeclared starts
of targets."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from probcal.gaussian.mode import Point
from probcal.identifiability.gauge import gauge, unfixed
from probcal.identifiability.patterns import directed
from probcal.model.motions import linear_of
from probcal.motion import as_motion
from probcal.problem import Problem

ALONG = 4.0  # prior sd along a combination of biases beyond which an estimate ran along it
INSIDE = 0.7  # size of a unit direction within the gauge from which it belongs to it
FIRST = 3.0  # prior sd beyond which the first state of a target strains a start that was never declared


class Run(NamedTuple):
    """A combination of biases along which an estimate went far."""

    name: str
    far: float  # prior sd
    gauge: bool  # whether no row fixes it


def runs(problem: Problem, point: Point, *, many: bool = False) -> list[Run]:
    """Rigid motions and common shifts along which the biases of a point lie far from the stated network.

    Whether no row fixes them is looked up only where there are such, each by itself where biases are `many`.
    """
    z = np.asarray(point.z)
    found = [(pattern.name, vector) for pattern, vector in directed(problem, z) if abs(vector @ z) > ALONG]
    if not found:
        return []
    vectors = np.stack([vector for _, vector in found], 1)
    if many:
        free = unfixed(problem, point, vectors)
    else:
        null = gauge(problem, point)
        free = null.countable & (np.linalg.norm(null.basis.T @ vectors, axis=0) > INSIDE)
    return [Run(name, float(abs(vector @ z)), bool(own)) for (name, vector), own in zip(found, free, strict=True)]


def strained_starts(problem: Problem, point: Point) -> list[tuple[str, float]]:
    """Targets whose first position or velocity lies far out in a start that was never declared, and prior sd."""
    found = []
    for part, epochs, noises in problem.model.each_layout(problem.epochs, point.noises):
        begins, u = ~np.asarray(part.F).any((1, 2)), np.abs(noises)
        for name, mine in epochs.members.items():
            target = problem.target(name)
            own = {key for component in linear_of(as_motion(target.motion)) for key in component.start()}
            free = {"position", "velocity"} - own - {*dict(target.start)}
            first = np.flatnonzero(begins & mine)[:1]
            spans = [u[first, start:stop] for component, start, stop, _ in epochs.layout if component in free]
            far = max((float(span.max(initial=0.0)) for span in spans), default=0.0)
            if far > FIRST:
                found.append((name, far))
    return found
