"""A harbour approach watched without end: two radars, a camera, a laser, and vessels that come and go.

The radars (range and azimuth) are turned and have a range offset, the camera (azimuth alone) is turned, the laser
(range alone, within 2 km) has an offset. A vessel comes every 75 s and stays for five minutes, each with its own name.
At half time the mounting of `radar_east` slips by `jump` degrees, none by default. Simulated, 15 minutes:

    probcal fit models/online.py
    probcal simulate models/online.py --out harbour.csv
    probcal watch models/online.py harbour.csv --out watched

`watch` prints `4,362 rows up to time 899.9 s` and ends within a hundredth of an sd of `MAP(trajectory="joint")`. The
same with a slip of half a degree, from the folder of the models:

    python -c "import online; online.scenario(jump=0.5).write('slipped.csv')"
    probcal watch online.py slipped.csv --jumps 0.1 --out slipped

prints `4,362 rows up to time 899.9 s, 1 jumps, the last of radar_east.heading at 448.9 s`: true is 450 s, and the data
up to 459.9 s were enough (column `found` of `slipped/jumps.csv`).
"""

from functools import cache

import numpy as np
import pandas as pd

from probcal import Bias, Channel, ConstantVelocity, Network, Node, Problem, Simulation, Target, Truth, sensor
from probcal.geometry import bearing, norm

DURATION = 900.0  # s
EVERY, STAY = 75.0, 300.0  # s between two vessels; for which one is in sight
HEADING, OFFSET, SURVEY = np.deg2rad(2.0), 10.0, 0.5  # scales of headings and radar offsets; survey of places, m
SLIPS = DURATION / 2  # s, when radar_east does
NOISE = {"radar": (5.0, np.deg2rad(0.3)), "camera": np.deg2rad(0.1), "laser": 1.0}
PLACES = {"radar_west": (0, 0), "radar_east": (3000, 200), "pier_camera": (1500, -100), "pier_laser": (900, 600)}  # m
PERIOD = {"radar_west": 3.0, "radar_east": 3.0, "pier_camera": 2.0, "pier_laser": 4.0}  # s between two looks
DRIVE = 0.1  # m s^-3/2, of a vessel
REACH = {"pier_laser": 2000.0}  # m


@sensor(range=Channel("m", std=NOISE["radar"][0]), azimuth=Channel("rad", std=NOISE["radar"][1], wrap=True))
def radar(target, pose, *, range_offset=Bias("m", OFFSET)):
    """Range, and azimuth in the radar's own axes."""
    line = pose.local(target.position)
    return dict(range=norm(line) + range_offset, azimuth=bearing(line))


@sensor(azimuth=Channel("rad", std=NOISE["camera"], wrap=True))
def camera(target, pose):
    """Azimuth in the image."""
    return dict(azimuth=bearing(pose.local(target.position)))


@sensor(range=Channel("m", std=NOISE["laser"]))
def laser(target, pose, *, range_offset=Bias("m", 2.0)):
    """Range."""
    return dict(range=norm(target.position - pose.position) + range_offset)


KINDS = {"radar_west": radar, "radar_east": radar, "pier_camera": camera, "pier_laser": laser}


def network():
    """The four sensors, their places surveyed, their headings free where they measure one."""
    nodes = {
        name: Node(name, place, survey={"position": SURVEY}, scale={} if name == "pier_laser" else {"heading": HEADING})
        for name, place in PLACES.items()
    }
    return Network([kind.on(nodes[name]) for name, kind in KINDS.items()])


def motion():
    """Every vessel: somewhere in the approach, at some speed."""
    return Target(ConstantVelocity(DRIVE), {"position": ((1500.0, 1500.0), 1500.0), "velocity": ((0.0, 0.0), 8.0)})


def course(vessel, time):
    """Places (N, 2) of a vessel at times: in from the sea, pushed as its motion says."""
    rng = np.random.default_rng([7, vessel])
    begin, end = rng.uniform((0, 2200), (3000, 2800)), rng.uniform((600, 600), (2400, 1200))
    pushes = DRIVE * rng.standard_normal((int(STAY), 2))  # one a second
    places = begin + np.cumsum((end - begin) / STAY + np.cumsum(pushes, 0), 0)
    return np.stack([np.interp(time - EVERY * vessel, np.arange(STAY), column) for column in places.T], 1)


@cache
def scenario(key=0, jump=0.0):
    """Table and truth; where `radar_east` slips the truth has its heading from then on."""
    rng = np.random.default_rng(key)
    scales = problem(pd.DataFrame({"time": [0.0], "sensor": "pier_laser", "range": 1.0})).scales
    biases = dict(zip(network().labels, (scales * rng.standard_normal(len(scales))).tolist(), strict=True))
    rows, tracks = [], []
    for vessel in range(int(DURATION / EVERY)):
        begin, end, name = EVERY * vessel, min(EVERY * vessel + STAY, DURATION), f"vessel_{vessel}"
        for number, (where, kind) in enumerate(KINDS.items()):
            time = np.arange(begin + 0.3 * (number + 1), end, PERIOD[where])
            turned = biases.get(f"{where}.heading", 0.0) + np.deg2rad(jump) * (where == "radar_east") * (time >= SLIPS)
            place = [biases[f"{where}.position_{axis}"] for axis in "xy"]
            line = course(vessel, time) - PLACES[where] - place
            length, angle = np.hypot(*line.T), np.arctan2(line[:, 1], line[:, 0]) - turned
            std = np.broadcast_to(NOISE[kind.name], 2)
            noise = std * rng.standard_normal((len(time), 2))
            found = pd.DataFrame({"time": time, "sensor": where, "target": name})
            if "range" in kind.channels:
                found["range"] = length + biases[f"{where}.range_offset"] + noise[:, 0]
            if "azimuth" in kind.channels:
                found["azimuth"] = np.angle(np.exp(1j * (angle + noise[:, 1])))
            rows.append(found[length < REACH.get(where, np.inf)])
        time = np.arange(begin, end)
        columns = dict(zip(("position_x", "position_y"), course(vessel, time).T, strict=True))
        tracks.append(pd.DataFrame({"time": time, "target": name, **columns}))
    biases["radar_east.heading"] += np.deg2rad(jump)
    table = pd.concat(rows, ignore_index=True).sort_values("time", kind="stable", ignore_index=True)
    return Simulation(table, Truth(pd.concat(tracks, ignore_index=True), biases))


def problem(data=None, jump=0.0, key=0):
    """The rows of a scenario, or your own (columns time, sensor, target, range, azimuth)."""
    return Problem(network(), motion(), scenario(key, jump).table if data is None else data)


def truth(data=None, jump=0.0, key=0):
    """What it was simulated with; a table written by `probcal simulate` brings its own beside it."""
    return scenario(key, jump).truth if data is None else Truth()
