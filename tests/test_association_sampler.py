"""Associations, objects and biases sampled together, against the sum over all associations."""

from functools import cache
from itertools import product
from types import SimpleNamespace

import jax
import numpy as np
import pandas as pd
import pytest

import probcal as pc
from probcal.association.sampled import Association, fitted
from probcal.errors import InputError
from probcal.inference.associations import SWEEP, begun_at, run, scene_of
from probcal.inference.hierarchy import hierarchy_of
from probcal.inference.mixed import mixing

CHANCE, CLUTTER, SIZE = 0.8, 0.6, 12.0  # of detection; false ones a scan; of the interval that they fill
STD, SHIFT, START, SPEED, DRIVE = 0.4, 1.0, 3.0, 1.5, 0.3
OBJECTS, SLOTS = 1.5, 2
CHAINS, DRAWS, WARMUP = 4, 1000, 50
SIGMAS = 5.0  # of the Monte Carlo error: 1e-6 a comparison, 1e-4 for all of a scene


@pc.sensor(height=pc.Channel("m", std=STD))
def ruler(target, pose, *, shift=pc.Bias("m", SHIFT)):
    """Height above the node."""
    return dict(height=target.position[1] - pose.position[1] + shift)


def problem_of(scans):
    """A problem of scans (time, sensor, heights); the shift of the first sensor is known."""
    rows = [
        {"time": t, "sensor": f"ruler_{s}", "height": y}
        for t, s, heights in scans for y in (heights or [None])
    ]  # fmt: skip
    seen = pc.Detection(CHANCE, clutter=CLUTTER, limits={"height": (-SIZE / 2, SIZE / 2)})
    network = pc.Network([ruler.on(pc.Node(s, (0.0, 0.0)), name=f"ruler_{s}", detection=seen) for s in "ab"])
    start = {"position": ((0.0, 0.0), START), "velocity": ((0.0, 0.0), SPEED)}
    motion = pc.Target(pc.ConstantVelocity(DRIVE), start)
    return pc.Problem(network, motion, pd.DataFrame(rows), fix="ruler_a.shift")


PLAIN = [
    (0.0, "a", [1.0, -2.1]), (0.0, "b", [1.6, -1.4, 4.0]), (1.0, "a", []), (1.0, "b", [2.7, 0.3, -2.6]),
    (2.0, "a", [3.3, -3.2]),
]  # fmt: skip
CROSSING = [
    (0.0, "a", [0.6, -0.6]), (0.0, "b", [1.4, 0.1, 5.5]), (1.0, "a", []), (1.0, "b", [0.8, 0.6, -4.1]),
    (2.0, "a", [0.5, -0.7]),
]  # fmt: skip


# all associations, naively


def log_normal(y, C):
    return -0.5 * (y @ np.linalg.solve(C, y) + np.linalg.slogdet(C)[1] + len(y) * np.log(2 * np.pi))


def arrangements(present, count):
    """Every choice of a detection, or None, for each slot that is present, no detection taken twice."""
    each = [[None, *range(count)] if there else [None] for there in present]
    for choice in product(*each):
        taken = [d for d in choice if d is not None]
        if len(set(taken)) == len(taken):
            yield choice


def weighed(scans, slots=SLOTS):
    """Every association with its log weight, the mean of the shift of b and its variance, by one dense Gaussian each."""
    t = np.array([time for time, *_ in scans]) - scans[0][0]
    early, late = np.minimum.outer(t, t), np.maximum.outer(t, t)
    track = START**2 + SPEED**2 * np.outer(t, t) + DRIVE**2 * early**2 * (3 * late - early) / 6
    found = []
    for present in product([False, True], repeat=slots):
        n = sum(present)
        prior = np.log(OBJECTS**n) - np.sum(np.log(np.arange(1, n + 1)))  # Poisson
        prior -= np.log(len([p for p in product([0, 1], repeat=slots) if sum(p) == n]))  # which slots
        for whole in product(*[list(arrangements(present, len(heights))) for _, _, heights in scans]):
            pairs = [(s, k, d) for k, choice in enumerate(whole) for s, d in enumerate(choice) if d is not None]
            total = sum(len(heights) for *_, heights in scans)
            weight = prior + len(pairs) * np.log(CHANCE) + (n * len(scans) - len(pairs)) * np.log(1 - CHANCE)
            weight += (total - len(pairs)) * np.log(CLUTTER / SIZE)
            mean, variance = 0.0, SHIFT**2
            if pairs:
                s, k, d = (np.array(column) for column in zip(*pairs, strict=True))
                y = np.array([scans[j][2][i] for j, i in zip(k, d, strict=True)])
                b = np.array([scans[j][1] == "b" for j in k], float)
                C = np.where(np.equal.outer(s, s), track[np.ix_(k, k)], 0.0) + STD**2 * np.eye(len(y))
                C += SHIFT**2 * np.outer(b, b)
                gain = SHIFT**2 * np.linalg.solve(C, b)
                weight, mean, variance = weight + log_normal(y, C), gain @ y, SHIFT**2 - SHIFT**2 * gain @ b
            found.append((present, whole, weight, mean, variance))
    return found


@cache
def enumerated(name):
    """The exact posterior of a scene."""
    scans = {"plain": PLAIN, "crossing": CROSSING}[name]
    found = weighed(scans)
    weight = np.array([w for *_, w, _, _ in found])
    p = np.exp(weight - weight.max())
    D = max(len(heights) for *_, heights in scans)
    choice = np.array(
        [[[D if d is None else d for d in of] for of in zip(*whole, strict=True)] for _, whole, *_ in found]
    )
    return SimpleNamespace(
        scans=scans, a=Association(choice, np.array([present for present, *_ in found])), weight=weight,
        p=p / p.sum(), mean=np.array([m for *_, m, _ in found]), variance=np.array([v for *_, v in found]), D=D,
    )  # fmt: skip


def exchanged(a):
    """Whether the object that is high at first is the low one at the end (of the crossing scene), or None is clear."""
    first, last = a.choice[..., 0], a.choice[..., 4]
    both = (first < 2).all(-1) & (last < 2).all(-1)
    return both & (first == last).all(-1), both & (first != last).all(-1)


def sampled(name, schedule, draws=DRAWS, key=1):
    """Draws of a schedule of moves, odd chains from nothing, even ones from a likely association."""
    e = enumerated(name)
    problem = problem_of(e.scans)
    with jax.enable_x64(True):
        scene, views, _ = scene_of(problem, pc.Gaussian(), OBJECTS, np.zeros(1))
        begin = [0, int(np.argmax(e.p))] * (CHAINS // 2)
        first = Association(e.a.choice[begin], e.a.present[begin])
        known = hierarchy_of(pc.Gaussian(), problem)
        found = run(scene, views, known, begun_at(first, 1, {}), schedule, WARMUP + draws, jax.random.key(key))
    return jax.tree.map(lambda leaf: leaf[:, WARMUP:], found)


def compared(name, kept):
    """Names of what is compared, draws of it (C, N, Q), and the exact expectations (Q,)."""
    e = enumerated(name)
    there = np.array([(k, d) for k, (_, _, heights) in enumerate(e.scans) for d in range(len(heights))])

    def of(a):
        each = a.choice[..., there[:, 0]] == there[:, 1]  # (..., T, R)
        pairs = np.einsum("...tr,...ts->...rs", each.astype(float), each.astype(float))[
            ..., *np.triu_indices(len(there))
        ]
        number = a.present.sum(-1)[..., None] == np.arange(SLOTS + 1)
        return np.concatenate([number, pairs, np.stack(exchanged(a), -1)], -1).astype(float)

    z2 = e.variance + e.mean**2
    exact = np.concatenate([e.p @ of(e.a), [e.p @ e.mean, e.p @ z2]])
    square = np.concatenate([e.p @ of(e.a), [e.p @ z2, e.p @ (z2**2 + 2 * e.variance * (z2 + e.mean**2))]])
    return np.concatenate([of(kept.a), kept.z, kept.z**2], 2), exact, np.sqrt(np.maximum(square - exact**2, 0.0))


def errors(drawn, exact, sd):
    """By how many Monte Carlo errors the means of draws (C, N, Q) are off; what is all but sure must be within 0.01."""
    off = drawn.mean((0, 1)) - exact
    open_ = sd > 0.1
    assert (np.abs(off[~open_]) < 0.01).all()
    return off[open_] / sd[open_] * np.sqrt(mixing(drawn[..., open_])["ess"])
