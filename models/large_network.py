"""Thousands of radars on a grid and a few vehicles that pass: a network whose dense form does not fit a laptop.

Short-range radars stand 100 m apart, `side` along each edge; each sees what passes between 20 and 280 m away, some
25 of them at any time. A third is displaced (sd 2 m), a third turned (3 deg), a third has a range offset (3 m). The
joint precision of all states and biases is sparse: one Cholesky factor fits it. Simulated.

    probcal fit models/large_network.py --out large                                  (2500 radars)
    probcal fit models/large_network.py --set side=100 --set targets=20 --set epochs=1000 --out larger
    probcal fit models/large_network.py --set side=25 --set targets=3 --set epochs=250 --method gibbs --out sampled
"""

from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from probcal import Bias, Channel, ConstantVelocity, Network, Node, Problem, Truth, sensor
from probcal.geometry import bearing, norm

APART, NEAR, REACH = 100.0, 20.0, 280.0  # m
NOISE = {"range": 1.0, "azimuth": 0.02}  # m and rad
SCALE = {"position": 2.0, "heading": np.deg2rad(3.0)}
OFFSET = 3.0  # m
SHARE = 1 / 3  # of the biases that are not zero
DRIVE = 0.5  # m s^-3/2, of the vehicles
STEP = 1.0  # s


@sensor(range=Channel("m", std=NOISE["range"]), azimuth=Channel("rad", std=NOISE["azimuth"], wrap=True))
def radar(target, pose, *, range_offset=Bias("m", OFFSET)):
    """Range, and azimuth in the radar's own axes."""
    line = pose.local(target.position)
    return dict(range=norm(line) + range_offset, azimuth=bearing(line))


def places(side):
    """Stated places (side^2, 2)."""
    return APART * np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2)


def network(side, heard):
    """Those of side x side radars that reported something."""
    pairs = [(f"radar_{k}", place) for k, place in enumerate(places(side))]
    return Network([radar.on(Node(name, place, scale=SCALE)) for name, place in pairs if name in heard])


def drive(edge, epochs, rng):
    """Places (epochs, 2) of a vehicle that a spring, weak beside the pushes of its motion, holds in the square."""
    held = (DRIVE / (edge / 4)) ** (2 / 3) / 2 ** (1 / 3)  # 1/s: damped by half, an sd of a quarter of the edge
    place = edge / 2 + edge / 4 * rng.standard_normal(2)
    velocity = DRIVE / np.sqrt(2 * held) * rng.standard_normal(2)
    pushes, path = DRIVE * np.sqrt(STEP) * rng.standard_normal((epochs, 2)), np.empty((epochs, 2))
    for k in range(epochs):
        path[k] = place
        before = velocity
        velocity = before + pushes[k] - STEP * held * (held * (place - edge / 2) + before)
        place = place + 0.5 * STEP * (before + velocity)
    return path


class Scenario(NamedTuple):
    """What was measured, and the truth."""

    table: pd.DataFrame
    truth: Truth


@cache
def scenario(key=0, side=50, targets=6, epochs=500, reach=REACH):
    """Table and truth, drawn by formula, since each radar sees few of the epochs; every key has the same ways."""
    from scipy.spatial import cKDTree

    rng, ways = np.random.default_rng(key), np.random.default_rng(side)
    stated, sds = places(side), np.array([*(SCALE["position"],) * 2, SCALE["heading"], OFFSET])
    biases = sds * rng.standard_normal((len(stated), 4)) * (rng.random((len(stated), 4)) < SHARE)
    tree, rows, tracks = cKDTree(stated), [], []
    for t in range(targets):
        path = drive(APART * (side - 1), epochs, ways)
        seen = tree.query_ball_point(path, reach)
        epoch = np.repeat(np.arange(epochs), [len(own) for own in seen])
        k = np.concatenate([np.asarray(own, int) for own in seen])
        clear = np.hypot(*(path[epoch] - stated[k]).T) > NEAR
        epoch, k = epoch[clear], k[clear]
        line = path[epoch] - stated[k] - biases[k, :2]
        azimuth = np.arctan2(line[:, 1], line[:, 0]) - biases[k, 2] + NOISE["azimuth"] * rng.standard_normal(len(k))
        measured = {
            "range": np.round(np.hypot(*line.T) + biases[k, 3] + NOISE["range"] * rng.standard_normal(len(k)), 3),
            "azimuth": np.round(np.angle(np.exp(1j * azimuth)), 5),
        }
        names = np.char.add("radar_", k.astype(str))
        rows.append(pd.DataFrame({"time": STEP * epoch, "target": f"vehicle_{t}", "sensor": names, **measured}))
        columns = {"position_x": path[:, 0], "position_y": path[:, 1]}
        tracks.append(pd.DataFrame({"time": STEP * np.arange(epochs), "target": f"vehicle_{t}", **columns}))
    table, words = pd.concat(rows, ignore_index=True), ("position_x", "position_y", "heading", "range_offset")
    heard = np.unique(table["sensor"]).tolist()
    labels = {f"{name}.{w}": float(b) for name in heard for w, b in zip(words, biases[int(name[6:])], strict=True)}
    return Scenario(table, Truth(pd.concat(tracks, ignore_index=True), labels))


def problem(data=None, side=50, targets=6, epochs=500, reach=REACH, key=0):
    """The rows of a scenario, or your own (columns time, target, sensor, range, azimuth)."""
    table = scenario(key, side, targets, epochs, reach).table if data is None else data
    heard = scenario(key, side, targets, epochs, reach).table if isinstance(data, (str, Path)) else table
    return Problem(network(side, set(heard["sensor"])), ConstantVelocity(DRIVE), table)


def truth(data=None, side=50, targets=6, epochs=500, reach=REACH, key=0):
    """What it was simulated with."""
    return scenario(key, side, targets, epochs, reach).truth if data is None else Truth()
