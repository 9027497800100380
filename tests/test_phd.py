"""PHD and cardinalised PHD filters against a loop in NumPy, what must change nothing, and how well they count."""

from functools import cache
from itertools import combinations
from math import comb, exp, factorial, log

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

import probcal as pc
from probcal.association.entry import cloud_of
from probcal.association.phd import Intensity, filter_intensity, reduced
from probcal.association.scan import watch_of
from probcal.association.update import Biases, Chances
from probcal.errors import InputError
from probcal.geometry import bearing, norm

LIMITS = {"x": (-300.0, 300.0), "y": (-300.0, 300.0)}
PROBABILITY, CLUTTER, STD, SCALE = 0.8, 1.5, 5.0, 10.0
START, SPREAD, SPEED, DRIVE = (20.0, -10.0), 100.0, 6.0, 0.7
Z, WIDE = np.array([0.4, -0.8]), np.array([0.3, 0.2])  # biases, and how uncertain each is
HIDDEN, BIRTHS, LIFETIME, HIGHEST, MOST = 1.7, 0.1, 40.0, 12, 24
DETECTED = {  # by time; of a scan without, a blank row
    0.0: [(35.0, 4.0), (-80.0, 60.0)],
    1.0: [(38.0, 9.0)],
    2.5: [],
    4.0: [(52.0, 11.0), (-79.0, 75.0)],
}


@pc.sensor(x=pc.Channel("m", std=STD), y=pc.Channel("m", std=STD))
def fix(target, pose):
    """Where a target is from the node."""
    line = target.position - pose.position
    return dict(x=line[0], y=line[1])


def scene(found, probability=PROBABILITY, clutter=CLUTTER):
    """Detections by time as a problem of one node that is known to within `SCALE`."""
    rows = [(t, "a", *place) for t, places in found.items() for place in places or [(None, None)]]
    table = pd.DataFrame(rows, columns=["time", "sensor", "x", "y"])
    seen = pc.Detection(probability, clutter=clutter, limits=LIMITS)
    network = pc.Network([fix.on(pc.Node("a", (0.0, 0.0), scale={"position": SCALE}), detection=seen)])
    start = {"position": (START, SPREAD), "velocity": ((0.0, 0.0), SPEED)}
    return pc.Problem(network, pc.Target(pc.ConstantVelocity(DRIVE), start), table)


def empty(watch, at):
    """The same scans and after number `at` twice one without rows, in no time, of no sensor."""
    scans = watch.scans
    which = np.sort(np.r_[np.arange(len(scans.elapsed)), at, at])
    taken = jax.tree.map(lambda leaf: leaf[which], scans)
    none = np.zeros(len(which), bool)
    none[[at + 1, at + 2]] = True
    rows = tuple(seen._replace(mask=seen.mask * ~none[:, None, None]) for seen in taken.epoch.rows)
    left = {k: getattr(taken, k) * ~none for k in ("elapsed", "probability", "clutter")}
    return watch._replace(scans=taken._replace(epoch=taken.epoch._replace(rows=rows), **left)), none


def filtered(watch, views, kind="phd", update="extended", prune=0.0, merge=-1.0, most=MOST):
    known = Biases(*jax.device_put((Z, np.diag(WIDE), np.zeros(0))))
    chances = Chances(*jax.device_put((HIDDEN, BIRTHS, LIFETIME)))
    found = filter_intensity(
        watch, views, known, chances, cloud_of(watch), most,
        kind=kind, update=update, prune=prune, merge=merge, highest=HIGHEST,
    )  # fmt: skip
    return jax.device_get(found)


@cache
def passed(kind="phd", update="extended", order=0):
    """The filter on the tiny scene, `order` turning the detections of each scan, with scans that are empty."""
    with jax.enable_x64(True):
        watch, views = watch_of(scene({t: found[order:] + found[:order] for t, found in DETECTED.items()}))
        longer, none = empty(watch, 3)
        return filtered(longer, views, kind, update), none


# a loop


def kalman(mean, covariance, y, H, R):
    residual, S = y - H @ mean, H @ covariance @ H.T + R
    gain = covariance @ H.T @ np.linalg.inv(S)
    density = exp(-0.5 * residual @ np.linalg.inv(S) @ residual) / (2 * np.pi * np.sqrt(np.linalg.det(S)))
    return density, mean + gain @ residual, covariance - gain @ S @ gain.T


def products(values, size):
    """Elementary symmetric function: the sum over all subsets of a size."""
    return sum(np.prod(chosen) for chosen in combinations(values, size))


def loop(kind):
    """Every scan of the tiny scene: components, mean number undetected, mean, variance and log likelihood."""
    H = np.eye(2, 4)
    R = np.diag(STD**2 + SCALE**2 * WIDE)
    root = DRIVE  # of the acceleration
    kappa = CLUTTER / np.prod([high - low for low, high in LIMITS.values()])
    birth = np.r_[START, 0.0, 0.0], np.diag([SPREAD**2] * 2 + [SPEED**2] * 2)
    parts, hidden, before = [], HIDDEN, 0.0
    number = np.array([HIDDEN**n / factorial(n) for n in range(HIGHEST + 1)])
    number /= number.sum()
    for time, detections in DETECTED.items():
        dt = time - before
        stays, born, before = exp(-dt / LIFETIME), BIRTHS * dt, time
        F = np.eye(4) + dt * np.eye(4, k=2)
        Q = np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(2)) * root**2
        parts = [(w * stays, F @ m, F @ P @ F.T + Q) for w, m, P in parts]
        hidden = hidden * stays + born
        left = [sum(comb(n, k) * stays**k * (1 - stays) ** (n - k) * number[n] for n in range(k, HIGHEST + 1))
                for k in range(HIGHEST + 1)]  # fmt: skip
        number = np.array([sum(left[n] * born ** (k - n) / factorial(k - n) for n in range(k + 1))
                           for k in range(HIGHEST + 1)])  # fmt: skip
        number /= number.sum()
        if kind == "cphd":
            scale = number @ np.arange(HIGHEST + 1) / (sum(w for w, _, _ in parts) + hidden)
            parts, hidden = [(w * scale, m, P) for w, m, P in parts], hidden * scale
        everything = [*parts, (hidden, *birth)]
        whole = sum(w for w, _, _ in everything)
        ys = [np.array(place) + SCALE * Z for place in detections]
        told = [[kalman(m, P, y, H, R) for _, m, P in everything] for y in ys]
        masses = [sum(w * PROBABILITY * q for (w, _, _), (q, _, _) in zip(everything, row, strict=True))
                  for row in told]  # fmt: skip
        if kind == "phd":
            missed, factors = 1.0, [1.0 / (kappa + mass) for mass in masses]
            value = -CLUTTER - PROBABILITY * whole + sum(log(kappa + mass) for mass in masses)
        else:
            def upsilon(u, ratios, n, whole=whole):
                size = len(ratios)
                return sum(
                    exp(-CLUTTER) * CLUTTER ** (size - j) * factorial(n) / factorial(n - j - u)
                    * ((1 - PROBABILITY) * whole) ** (n - j - u) / whole**n * products(ratios, j)
                    for j in range(min(size, n - u) + 1)
                )  # fmt: skip

            ratios = [CLUTTER / kappa * mass for mass in masses]
            n = range(HIGHEST + 1)
            none = np.array([upsilon(0, ratios, k) for k in n])
            total = none @ number
            missed = sum(upsilon(1, ratios, k) * number[k] for k in n) / total
            factors = [
                CLUTTER / kappa * sum(upsilon(1, ratios[:i] + ratios[i + 1 :], k) * number[k] for k in n) / total
                for i in range(len(ys))
            ]
            value = log(total) + len(ys) * log(kappa / CLUTTER)
            number = none * number / total
        parts = [(w * (1 - PROBABILITY) * missed, m, P) for w, m, P in parts] + [
            (w * PROBABILITY * q * factor, m, P)
            for row, factor in zip(told, factors, strict=True)
            for (w, _, _), (q, m, P) in zip(everything, row, strict=True)
        ]
        hidden *= (1 - PROBABILITY) * missed
        n = np.arange(HIGHEST + 1)
        count = sum(w for w, _, _ in parts) + hidden
        yield parts, hidden, count, count if kind == "phd" else number @ (n - number @ n) ** 2, value


@pytest.mark.parametrize("kind", ["phd", "cphd"])
def test_both_filters_are_those_of_a_loop(kind):
    """No merging, nothing dropped; scans without anything in no time change nothing."""
    found, none = passed(kind)
    for k, (parts, hidden, count, spread, value) in zip(np.flatnonzero(~none), loop(kind), strict=True):
        weight = np.array([w for w, _, _ in parts])
        mine, theirs = np.argsort(-found.after.weight[k])[: len(parts)], np.argsort(-weight)
        np.testing.assert_allclose(found.after.weight[k][mine], weight[theirs], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(found.after.mean[k][mine], [parts[i][1] for i in theirs], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(found.after.covariance[k][mine], [parts[i][2] for i in theirs], rtol=1e-9, atol=1e-8)
        assert found.after.weight[k].sum() == pytest.approx(weight.sum(), rel=1e-9)
        got = found.undetected[k], found.count[k], found.spread[k], found.log_likelihood[k]
        np.testing.assert_allclose(got, (hidden, count, spread, value), rtol=1e-9)
