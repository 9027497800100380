"""Rates of detection and of clutter that are unknown, by what the objects of a round tell of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from probcal.detection import Detection
from probcal.lazy import pd, xr
from probcal.noise import Unknown
from probcal.problem import Problem
from probcal.tracking.groups import looks_of
from probcal.tracking.objects import Objects


def rated(problem: Problem, objects: Objects, z: np.ndarray) -> tuple[Problem, pd.DataFrame]:
    """The problem with the rates that its objects call for where they are unknown, and a table of these.

    Columns sensor, rate, mean, sd of the posterior of each by itself: clutter by counts beside a Gamma prior, a
    probability of detection by looks beside a Beta prior, whose spreads are those of the stated factors.
    """
    network, scans = problem.network, problem.scans
    assert scans is not None
    asked = {
        s: sensor.detection
        for s, sensor in enumerate(network.sensors)
        if sensor.detection is not None
        and (isinstance(sensor.detection.probability, Unknown) or isinstance(sensor.detection.clutter, Unknown))
    }
    if not asked:
        return problem, pd.DataFrame(columns=["sensor", "rate", "mean", "sd"])
    S = len(network.sensors)
    pairs = looks_of(problem, objects, z)
    looks = np.bincount(pairs["sensor"], pairs["looks"], S)
    found = np.bincount(pairs["sensor"], pairs["detections"], S)
    false = np.maximum(np.bincount(scans.sensor, scans.count, S) - found, 0.0)
    number = np.bincount(scans.sensor, minlength=S)
    changed, rows = {}, []
    for s, detection in asked.items():
        name, own = network.sensors[s].name, detection
        if isinstance(detection.clutter, Unknown):
            mean, sd = by_gamma(detection.clutter, float(false[s]), int(number[s]))
            rows.append((name, "clutter", mean, sd))
            own = replace(own, clutter=mean)
        if isinstance(detection.probability, Unknown):
            hit = min(float(found[s]), float(looks[s]))
            mean, sd = by_beta(detection.probability, hit, float(looks[s]) - hit)
            rows.append((name, "probability", mean, sd))
            own = replace(own, probability=mean)
        changed[name] = own
    table = pd.DataFrame(rows, columns=["sensor", "rate", "mean", "sd"])
    return with_detections(problem, changed), table


def with_detections(problem: Problem, detections: dict[str, Detection]) -> Problem:
    """The same problem, some sensors by name with other detection."""
    network = problem.network.with_detections(detections)
    return Problem(network, problem.motion, problem.measurements.table, fix=problem.fixed, epoch=problem.epoch)


def of_calibration(problem: Problem, calibration: xr.DataTree) -> Problem:
    """The problem with the rates that a calibration found in place of those that are unknown."""
    if "rate" not in calibration.children:
        return problem
    group = calibration["rate"].to_dataset()
    known = {
        (str(name), str(rate)): float(mean)
        for name, rate, mean in zip(*(group[column].values for column in ("sensor", "rate", "mean")), strict=True)
    }
    changed = {}
    for sensor in problem.network.sensors:
        own = sensor.detection
        for rate in ("clutter", "probability"):
            if own is not None and isinstance(getattr(own, rate), Unknown) and (sensor.name, rate) in known:
                value = known[sensor.name, rate]
                own = replace(own, clutter=value) if rate == "clutter" else replace(own, probability=value)
        if own is not None and own is not sensor.detection:
            changed[sensor.name] = own
    return with_detections(problem, changed) if changed else problem


def by_gamma(prior: Unknown, count: float, scans: int) -> tuple[float, float]:
    """Posterior mean and sd of a Poisson rate a scan."""
    shape = 1.0 / np.log(prior.factor) ** 2
    a, b = shape + count, shape / prior.guess + scans
    return float(a / b), float(np.sqrt(a) / b)


def by_beta(prior: Unknown, hits: float, misses: float) -> tuple[float, float]:
    """Posterior mean and sd of a probability, whose odds are known to within a factor."""
    strength = 1.0 / (prior.guess * (1.0 - prior.guess) * np.log(prior.factor) ** 2)
    a, b = strength * prior.guess + hits, strength * (1.0 - prior.guess) + misses
    mean = a / (a + b)
    return float(mean), float(np.sqrt(mean * (1.0 - mean) / (a + b + 1.0)))
