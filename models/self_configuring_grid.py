"""Sixteen radars on a grid, one of known pose: the scene of the self-configuration paper.

The scene of Uney, Mulgrew and Clark (Separable likelihoods for network self-configuration, Fig. 2): sensors 4 x 4 over
4500 m, each sees ranges up to 5000 m and azimuths, misses one object in ten, reports false ones, and names none. Five
objects pass. One inner sensor is the anchor; of the others only the middle of the field is stated, and north within ten
degrees. Noise, false alarms and detection are those of this file, since the paper does not print its own. Simulated.

    probcal fit models/self_configuring_grid.py --method self-config-beliefs --out grid
"""

from functools import cache

import numpy as np

from probcal import Channel, ConstantVelocity, Detection, Network, Node, Problem, Sector, Target, sensor, simulate
from probcal.geometry import bearing, norm

PLACES = [(x, y) for y in (-2000.0, -500.0, 1000.0, 2500.0) for x in (-2000.0, -500.0, 1000.0, 2500.0)]
ANCHOR, CENTRE = 5, (250.0, 250.0)
SCALE = {"position": 1700.0, "heading": 0.1}  # m and rad of what is not known
REPORT = Detection(0.9, clutter=5.0, view=Sector(range=5000.0))
TIME = 2.0 * np.arange(60)  # s
OBJECTS, NOISE = 5, 0.5  # and of their motion in m s^-3/2
START = {"position": (CENTRE, 2500.0), "velocity": ((0.0, 0.0), 12.0)}


@sensor(range=Channel("m", std=10.0), azimuth=Channel("rad", std=0.01, wrap=True))
def radar(target, pose):
    """Range and azimuth in the sensor's own axes."""
    line = pose.local(target.position)
    return dict(range=norm(line), azimuth=bearing(line))


def network(named=False):
    """The anchor known, the others stated at the middle; `named` for sensors whose rows name their targets."""
    nodes = [
        Node(f"sensor_{k}", place) if k == ANCHOR else Node(f"sensor_{k}", CENTRE, scale=SCALE)
        for k, place in enumerate(PLACES)
    ]
    return Network([radar.on(node, detection=None if named else REPORT) for node in nodes])


def shaken(rng):
    """Places (T, 2) of an object that begins at rest: velocity and its integral driven by white noise, exactly."""
    step = np.diff(TIME)[:, None]
    first, second = rng.standard_normal((2, len(step), 2))
    gained = NOISE * np.sqrt(step) * first
    velocity = np.cumsum(gained, 0) - gained
    moved = step * (velocity + gained / 2) + NOISE * np.sqrt(step**3 / 12) * second
    return np.concatenate([np.zeros((1, 2)), np.cumsum(moved, 0)])


@cache
def scenario(key=0, named=False):
    """Table and truth of one run."""
    rng = np.random.default_rng(key)
    biases = {}
    for k, place in enumerate(PLACES):
        if k != ANCHOR:
            biases |= {f"sensor_{k}.position_{a}": p - c for a, p, c in zip("xy", place, CENTRE, strict=True)}
    paths = {}
    for k in range(OBJECTS):
        begin, speed = rng.uniform(-1500, 2000, 2), rng.uniform(-15, 15, 2)
        paths[f"object_{k}"] = begin + np.outer(TIME, speed) + shaken(rng)
    motion = dict.fromkeys(paths, ConstantVelocity(NOISE))
    return simulate(network(named), motion, TIME, key=key, biases=biases, tracks=paths)


def problem(data=None, run=0):
    """Detections of your own (columns time, sensor, range, azimuth), or those of a run."""
    own = scenario(run).table if data is None else data
    return Problem(network(), Target(ConstantVelocity(NOISE), START), own)


def truth(data=None, run=0):
    """What a run was simulated with."""
    from probcal import Truth

    return scenario(run).truth if data is None else Truth()
