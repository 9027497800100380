"""Tracks of detections that name no target, with a calibration applied."""

from __future__ import annotations

from collections.abc import Callable

from probcal.errors import FitError
from probcal.lazy import xr
from probcal.problem import Problem, check_linear
from probcal.results.read import apply
from probcal.tracking.groups import with_objects
from probcal.tracking.objects import track_objects
from probcal.tracking.rates import of_calibration


def track_detections(
    problem: Problem, calibration: xr.DataTree, follow: Callable[[Problem, xr.DataTree], xr.DataTree]
) -> xr.DataTree:
    """Find the objects of a problem at a calibration, then `follow` their named rows.

    Raises `FitError` where no object is confirmed.
    """
    check_linear(problem)
    problem = of_calibration(problem, calibration)
    known = apply(problem, calibration)
    objects = track_objects(problem, known.z, known.covariance)
    if not objects.names:
        count = len(problem.scans or ())
        raise FitError(f"no object is confirmed in {count} scans: nothing stands out from clutter")
    tree = follow(problem.assigned(objects.rows), calibration)
    return with_objects(tree, objects, problem, known.z)
