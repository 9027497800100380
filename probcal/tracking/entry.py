"""The inputs of the verbs on detections without names, checked and converted to arrays."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, NamedTuple

import jax
import numpy as np

from probcal.errors import InputError, nearest
from probcal.problem import Problem, check_linear
from probcal.tracking.scan import View, Watch, alone, heeded, watch_of
from probcal.tracking.update import Biases, Chances

CLOUD = 512  # states among which that behind a first detection is looked for


class Asked(NamedTuple):
    """The detections of a problem as a filter reads them."""

    problem: Problem  # of the detections alone
    watch: Watch
    views: tuple[View, ...]
    known: Biases
    chances: Chances
    cloud: jax.Array  # (G, n)


def asked(
    verb: str,
    problem: Problem,
    z: Any,
    covariance: Any,
    *,
    objects: float,
    births: float,
    lifetime: float,
    most: int,
    sensors: Collection[str],
) -> Asked:
    """Arguments that trackers of objects without names share; raises `InputError` naming what is wrong."""
    if problem.scans is None:
        raise InputError(f"{verb}: every row names its target; use fit, or track with a calibration")
    check_linear(problem)
    for name, value in (("objects", objects), ("births", births), ("lifetime", lifetime)):
        if not (isinstance(value, (int, float)) and np.isfinite(value) and value > 0):
            raise InputError(f"{verb}({name}={value!r}): give a positive number")
    if not (isinstance(most, int) and most >= 1):
        raise InputError(f"{verb}(most={most!r}): most is a number of tracks or components, 1 or more")
    own = alone(problem)
    watch, views = watch_of(problem)
    if sensors:
        names = [placed.name for placed in problem.network.sensors]
        for name in sensors:
            if name not in names:
                raise InputError(f'{verb}: sensors names "{name}"{nearest(name, names)}')
        scans = own.scans
        assert scans is not None
        watch = heeded(watch, np.isin(np.array(names)[scans.sensor], list(sensors)))
    free = len(problem.labels)
    z = np.zeros(free) if z is None else np.asarray(z, float)
    if z.shape != (free,):
        raise InputError(f"{verb}: z has shape {z.shape}, the problem {free} free biases")
    covariance = np.zeros((free, free)) if covariance is None else np.asarray(covariance, float)
    if covariance.shape != (free, free):
        raise InputError(f"{verb}: covariance has shape {covariance.shape}, the problem {free} free biases")
    chances = Chances(*jax.device_put((float(objects), float(births), float(lifetime))))
    known = Biases(*jax.device_put((z, covariance, np.zeros(len(own.levels)))))
    return Asked(own, watch, views, known, chances, cloud_of(watch))


def cloud_of(watch: Watch) -> jax.Array:
    """States (G, n) spread as the start of the motion, whitened, for the search behind first detections."""
    from scipy.stats import norm, qmc

    root = np.asarray(watch.root)
    cloud = norm.ppf(np.clip(qmc.Sobol(len(root), scramble=False).random(CLOUD), 1e-3, 1 - 1e-3))
    return jax.device_put(cloud * np.any(root != 0, 0))
