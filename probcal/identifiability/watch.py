"""What a fit ran along: gauge directions that no row fixes, and starts of targets that nobody declared."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from probcal.gaussian.mode import Point
from probcal.identifiability.gauge import gauge, unfixed
from probcal.identifiability.patterns import common_shifts, rigid_motions
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
    z, free = np.asarray(point.z), ~problem.surveyed
    found = []
    for pattern in (*rigid_motions(problem, z), *common_shifts(problem)):
        vector = np.where(free, pattern.vector, 0.0)
        size = np.linalg.norm(vector)
        if size > 0 and np.count_nonzero(vector) > 1:
            vector = vector / size
            if abs(vector @ z) > ALONG:
                found.append((pattern.name, abs(float(vector @ z)), vector))
    if not found:
        return []
    if many:
        free = unfixed(problem, point, np.stack([vector for _, _, vector in found], 1))
        return [Run(name, far, bool(own)) for (name, far, _), own in zip(found, free, strict=True)]
    null = gauge(problem, point)
    return [
        Run(name, far, null.countable and float(np.linalg.norm(null.basis.T @ vector)) > INSIDE)
        for name, far, vector in found
    ]


def strained_starts(problem: Problem, point: Point) -> list[tuple[str, float]]:
    """Targets whose first position or velocity lies far out in a start that was never declared, and prior sd."""
    found = []
    for part, epochs, noises in problem.model.each_layout(problem.epochs, point.noises):
        begins, u = ~np.asarray(part.F).any((1, 2)), np.asarray(noises)
        for name in dict.fromkeys(epochs.target):
            target = problem.target(str(name))
            linear, _ = as_motion(target.motion).split
            parts = () if linear is None else linear.components
            own = {key for component in parts for key in component.start()}
            first = np.flatnonzero(begins & (epochs.target == name))[:1]
            spans = [
                slice(start, stop)
                for component, start, stop, _ in epochs.layout
                if component in ("position", "velocity") and component not in {*own, *dict(target.start)}
            ]
            far = max((float(np.abs(u[first, span]).max(initial=0.0)) for span in spans), default=0.0)
            if far > FIRST:
                found.append((str(name), far))
    return found
