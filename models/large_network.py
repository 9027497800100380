"""Ten thousand radars on a grid and a few vehicles that pass: a network whose dense form does not fit a laptop.

Short-range radars stand 100 m apart, `side` along each edge; each sees what passes between 20 and 280 m away, some
25 of them at any time. A third is displaced (sd 2 m), a third turned (3 deg), a third has a range offset (3 m). The
joint precision of all states and biases is sparse: one Cholesky factor fits it. Simulated.

    probcal fit models/large_network.py --set side=30 --set targets=4 --set epochs=300 --out large
"""

from functools import cache

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
    """Places (epochs, 2) of a vehicle that turns back at the edges."""
    velocity = rng.uniform(5.0, 15.0) * _unit(rng.uniform(0, 2 * np.pi))
    pushes = DRIVE * np.sqrt(STEP) * rng.standard_normal((epochs, 2))
    place, path = rng.uniform(0, edge, 2), np.empty((epochs, 2))
    for k in range(epochs):
        path[k] = place
        before, velocity = velocity, velocity + pushes[k]
        place = place + 0.5 * STEP * (before + velocity)
        out = (place < 0) | (place > edge)
        velocity, place = np.where(out, -velocity, velocity), np.clip(place, 0, edge)
    return path


def _unit(angle):
    return np.array([np.cos(angle), np.sin(angle)])


@cache
def scenario(key=0, side=100, targets=20, epochs=1000):
    """Table and truth; rows are drawn by formula, since each radar sees few of the epochs."""
    from scipy.spatial import cKDTree

    rng = np.random.default_rng(key)
    stated = places(side)
    sds = np.array([SCALE["position"], SCALE["position"], SCALE["heading"], OFFSET])
    biases = sds * rng.standard_normal((len(stated), 4)) * (rng.random((len(stated), 4)) < SHARE)
    placed = stated + biases[:, :2]
    tree, names = cKDTree(placed), np.array([f"radar_{k}" for k in range(len(placed))])
    rows, tracks = [], []
    for t in range(targets):
        path = drive(APART * (side - 1), epochs, rng)
        seen = tree.query_ball_point(path, REACH)
        epoch = np.repeat(np.arange(epochs), [len(own) for own in seen])
        k = np.concatenate([np.asarray(own, int) for own in seen])
        line = path[epoch] - placed[k]
        away = np.hypot(*line.T)
        epoch, k, line, away = (part[away > NEAR] for part in (epoch, k, line, away))
        azimuth = np.arctan2(line[:, 1], line[:, 0]) - biases[k, 2] + NOISE["azimuth"] * rng.standard_normal(len(k))
        measured = {
            "range": away + biases[k, 3] + NOISE["range"] * rng.standard_normal(len(k)),
            "azimuth": np.angle(np.exp(1j * azimuth)),
        }
        rows.append(pd.DataFrame({"time": STEP * epoch, "target": f"vehicle_{t}", "sensor": names[k], **measured}))
        columns = {"position_x": path[:, 0], "position_y": path[:, 1]}
        tracks.append(pd.DataFrame({"time": STEP * np.arange(epochs), "target": f"vehicle_{t}", **columns}))
    words = ("position_x", "position_y", "heading", "range_offset")
    labels = {f"radar_{k}.{word}": float(b) for k, own in enumerate(biases) for word, b in zip(words, own, strict=True)}
    return pd.concat(rows, ignore_index=True), Truth(pd.concat(tracks, ignore_index=True), labels)


def problem(data=None, side=100, targets=20, epochs=1000, key=0):
    """The rows of a scenario, or your own (columns time, target, sensor, range, azimuth)."""
    table = scenario(key, side, targets, epochs)[0] if data is None else data
    return Problem(network(side, set(table["sensor"])), ConstantVelocity(DRIVE), table)


def truth(data=None, side=100, targets=20, epochs=1000, key=0):
    """What it was simulated with."""
    return scenario(key, side, targets, epochs)[1] if data is None else Truth()
