"""Three lidars and three radars along a fence, one of known pose, pedestrians walking: the twin of the SAPIENT network.

The network of Uney, Mulgrew and Clark (Separable likelihoods for network self-configuration, section 4): places and
boresights are those of Table 1. Every sensor reports range and azimuth from its boresight, out to 25 m: lidars within
240 deg, radars within 40 deg. Each has a clock of its own (period, phase, jitter), so that no two look together. Sensor
1 is the anchor; of the others only the middle of the fence and "west" are stated. The recording is not public: this one
is simulated. Noise, false alarms, clocks and walks are those of this file, since the paper does not print its own.

Three pedestrians walk for three minutes, each up the fence on one lane and down it on another, 3 to 14 m before it:
past all three lidars and through the view of every radar, as in Fig. 6. The sensors of the paper report upon detection
only. How often a sensor looked must be known here: a scan that detected nothing is a blank row.

    probcal fit models/sapient.py --method self-config-beliefs --out sapient
"""

from functools import cache

import numpy as np
import pandas as pd

from probcal import Channel, ConstantVelocity, Detection, Network, Node, Problem, Sector, Target, sensor, simulate
from probcal.geometry import bearing, norm

PLACES = [(0.0, 0.0), (-14.6, -20.4), (-29.2, -40.8), (5.8, 8.2), (-4.4, -6.1), (-15.2, -21.2)]  # m
BORESIGHT = np.deg2rad([144.4, 144.4, 144.4, 209.4, 209.4, 209.4])  # from east
RANGE, LIDAR, RADAR = 25.0, np.deg2rad(240.0), np.deg2rad(40.0)  # m, and width in rad
CENTRE, WEST = (-10.0, -13.0), np.pi  # stated of every sensor but the anchor
SCALE = {"position": 30.0, "heading": np.deg2rad(60.0)}
PERIOD, JITTER = (0.70, 0.75, 0.80, 0.85, 0.90, 0.95), 0.1  # s, and share of it
LAST = 180.0  # s
WALKERS, NOISE = 3, 0.3  # and of their motion in m s^-3/2
START = {"position": (CENTRE, 30.0), "velocity": ((0.0, 0.0), 1.0)}


def _place(line):
    """Range, and azimuth from the boresight."""
    return dict(range=norm(line), azimuth=bearing(line))


@sensor(range=Channel("m", std=0.1), azimuth=Channel("rad", std=np.deg2rad(0.5), wrap=True))
def lidar(target, pose):
    """A pedestrian, precisely."""
    return _place(pose.local(target.position))


@sensor(range=Channel("m", std=0.5), azimuth=Channel("rad", std=np.deg2rad(2.0), wrap=True))
def radar(target, pose):
    """A pedestrian, coarsely."""
    return _place(pose.local(target.position))


def report(probability, clutter, width):
    """What a sensor detects within its sector, where its false detections lie too."""
    limits = {"azimuth": (-0.5 * width, 0.5 * width)}
    return Detection(probability, clutter, view=Sector(RANGE, width), limits=limits)


def network():
    """Sensor 1 known, the others stated at the middle of the fence, towards the west."""
    nodes = [
        Node(f"sensor_{k + 1}", CENTRE if k else PLACES[0], WEST if k else BORESIGHT[0], scale=SCALE if k else None)
        for k in range(len(PLACES))
    ]
    return Network(
        [lidar.on(node, detection=report(0.95, 0.2, LIDAR)) for node in nodes[:3]]
        + [radar.on(node, detection=report(0.8, 0.5, RADAR)) for node in nodes[3:]]
    )


def stamps(rng):
    """When each sensor looks."""
    found = []
    for k, period in enumerate(PERIOD):
        time = np.arange(rng.uniform(0, period), LAST, period)
        time += rng.uniform(-JITTER, JITTER, len(time)) * period
        found.append(pd.DataFrame({"time": np.abs(time).round(4), "sensor": f"sensor_{k + 1}"}))
    return pd.concat(found).sort_values("time", ignore_index=True)


def walk(time, rng):
    """Places (T, 2) of a pedestrian: round and round, up the fence on one lane, in half a circle onto the other."""
    near, apart = rng.uniform(3.0, 7.0), rng.uniform(4.0, 7.0)  # m from the fence, and between the lanes
    first, last = rng.uniform(-18.0, -12.0), rng.uniform(60.0, 68.0)  # m along it from sensor 1
    straight, bend = last - first, 0.5 * np.pi * apart
    way = (rng.uniform(1.2, 1.6) * time + rng.uniform(0, 2 * (straight + bend))) % (2 * (straight + bend))
    back, on = way > straight + bend, way % (straight + bend)
    turn = np.clip(on - straight, 0.0, bend) / bend * np.pi
    along = np.minimum(on, straight) + 0.5 * apart * np.sin(turn)
    across = 0.5 * apart * (1.0 - np.cos(turn))
    along, across = np.where(back, straight - along, along), np.where(back, apart - across, across)
    return (first + along)[:, None] * _unit(BORESIGHT[0] + 0.5 * np.pi) + (near + across)[:, None] * _unit(BORESIGHT[0])


def _unit(angle):
    return np.array([np.cos(angle), np.sin(angle)])


@cache
def scenario(key=0):
    """Table and truth of one run."""
    rng = np.random.default_rng(key)
    looks = stamps(rng)
    time = np.unique(looks["time"])
    paths = {f"walker_{k}": walk(time, rng) for k in range(WALKERS)}
    biases = {}
    for k, (place, heading) in enumerate(zip(PLACES, BORESIGHT, strict=True)):
        if k:
            biases |= {f"sensor_{k + 1}.position_{a}": p - c for a, p, c in zip("xy", place, CENTRE, strict=True)}
            biases[f"sensor_{k + 1}.heading"] = float(heading - WEST)
    schedule = pd.concat([looks.assign(target=name) for name in paths], ignore_index=True)
    motion = dict.fromkeys(paths, ConstantVelocity(NOISE))
    return simulate(network(), motion, time, key=key, biases=biases, tracks=paths, schedule=schedule)


def problem(data=None, run=0):
    """Detections of your own (columns time, sensor, range, azimuth), or those of a run."""
    own = scenario(run).table if data is None else data
    return Problem(network(), Target(ConstantVelocity(NOISE), START), own)


def truth(data=None, run=0):
    """What a run was simulated with."""
    from probcal import Truth

    return scenario(run).truth if data is None else Truth()
