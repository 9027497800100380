"""Twelve microphones beside a road, two pairs of them swapped: the twin of scenario A of Paper A, simulated.

Log powers (Paper A 6, its natural logarithm) of one vehicle, 30 of them a second apart, noise 0.2. True places are
those of its Table 1; the stated ones of microphones 3 and 4 are swapped, and of 7 and 8, so that the biases of
microphone 3 are about (-16.6, -6.3) m (its Table 2 has survey minus truth). Biases: x and y (5 m) and gain (0.1) of
each; process noise of the paper in its form of full rank. What the paper leaves open: the roads (twelve,
with five junctions), the start (2 m, 0.5 m/s), and 5 m/s along a way that turns at every junction.

The vehicle moves freely, or on the road (`--set motion=road`):

    probcal fit models/road_microphones.py --set motion=road --method em-particles --out microphones-on-road
"""

from functools import cache
from typing import Literal

import jax.numpy as jnp
import numpy as np
import pandas as pd

from probcal import Bias, Channel, ConstantVelocity, Network, Node, Problem, RandomWalk, Target, Truth, sensor, simulate
from probcal.geometry import norm

PLACES = {
    1: (77.0, 7.0), 2: (88.6, 22.2), 3: (43.3, 10.0), 4: (59.9, 16.3), 5: (10.0, 10.2), 6: (30.6, 16.8),
    7: (23.4, 34.9), 8: (9.1, 40.0), 9: (46.0, 41.4), 10: (37.7, 50.3), 11: (78.1, 52.3), 12: (65.5, 36.7),
}  # fmt: skip
SWAPPED = {3: 4, 4: 3, 7: 8, 8: 7}
TIME = np.arange(30.0)  # s
SPEED = 5.0  # m/s
START, PACE = 2.0, 0.5  # m, m/s: how well the start is known
ROADS = {
    "west": [(0.0, 27.0), (8.0, 25.0), (17.0, 26.0)],
    "north west": [(17.0, 26.0), (16.0, 45.0), (20.0, 60.0)],
    "first": [(17.0, 26.0), (19.0, 16.0), (23.0, 5.0)],
    "south west": [(23.0, 5.0), (10.0, -4.0)],
    "lower": [(23.0, 5.0), (37.0, 4.0), (51.0, 6.0)],
    "south": [(51.0, 6.0), (56.0, -10.0)],
    "second": [(51.0, 6.0), (52.0, 26.0), (54.0, 45.0)],
    "north": [(54.0, 45.0), (50.0, 64.0)],
    "upper": [(54.0, 45.0), (72.0, 44.0)],
    "north east": [(72.0, 44.0), (95.0, 50.0)],
    "third": [(72.0, 44.0), (73.0, 28.0), (80.0, 14.0)],
    "south east": [(80.0, 14.0), (84.0, 0.0), (90.0, -8.0)],
}
WAY = ("west", "first", "lower", "second", "upper", "third", "south east")  # that the vehicle takes
POWER = RandomWalk("power", "1", np.sqrt(0.1), (10.0, 1.0))  # natural logarithm


@sensor(log_power=Channel("1", std=0.2))
def microphone(target, pose, *, gain=Bias("1", 0.1)):
    """Natural logarithm of the received power (Paper A 6): power - 2 log r + gain."""
    distance = jnp.maximum(norm(target.position - pose.position), 0.5)
    return dict(log_power=target.power - 2.0 * jnp.log(distance) + gain)


def network():
    """The microphones at their stated places, two pairs of which are swapped."""
    nodes = {n: Node(f"mic_{n}", PLACES[SWAPPED.get(n, n)], scale=5.0) for n in PLACES}
    return Network([microphone.on(node) for node in nodes.values()])


@cache
def roads():
    """The roads: twelve, with five junctions, at each of which the vehicle turns a corner."""
    from probcal.roads import RoadNetwork

    return RoadNetwork.from_lines(ROADS)


def path():
    """True places and velocities of the vehicle (30, 4): along its way."""
    line = np.array(ROADS[WAY[0]] + [point for name in WAY[1:] for point in ROADS[name][1:]])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    gone = 3.0 + SPEED * TIME
    place = np.stack([np.interp(gone, along, column) for column in line.T], 1)
    ahead = np.stack([np.interp(gone + 0.1, along, column) for column in line.T], 1)
    return np.hstack([place, SPEED * (ahead - place) / np.linalg.norm(ahead - place, axis=1)[:, None]])


def motion(kind: Literal["free", "road"] = "free"):
    """Constant velocity in the plane, or along the road, with a power that wanders."""
    first = path()[0]
    if kind == "free":
        start = {"position": (first[:2], START), "velocity": (first[2:], PACE)}
        return Target(ConstantVelocity(5.0) + POWER, start)
    from probcal.roads import Road

    return Target(Road(roads(), std=0.1, speed=(SPEED, PACE), position=(tuple(first[:2]), START)) + POWER)


def biases():
    """True biases: what is added to a stated place to get the true one; gains are right."""
    found = {f"mic_{n}.gain": 0.0 for n in PLACES}
    for n, place in PLACES.items():
        away = np.array(place) - PLACES[SWAPPED.get(n, n)]
        found |= {f"mic_{n}.position_{axis}": float(d) for axis, d in zip("xy", away, strict=True)}
    return found


@cache
def scenario(key=0):
    """Table and truth of one run: noise and power are drawn, the path stays."""
    columns = ["position_x", "position_y", "velocity_x", "velocity_y"]
    return simulate(
        network(), motion(), TIME, key=key, biases=biases(), tracks={"target": pd.DataFrame(path(), columns=columns)}
    )


def problem(data=None, motion: Literal["free", "road"] = "free"):
    """The network with a table of its own (columns time, sensor, log_power), or that of run 0."""
    kind = motion
    return Problem(network(), globals()["motion"](kind), scenario().table if data is None else data)


def setting(run=0, motion: Literal["free", "road"] = "free"):
    """Problem and truth of one run of a study."""
    drawn = scenario(run)
    return problem(drawn.table, motion), drawn.truth


def truth(data=None):
    """Truth of run 0; a table written by `probcal simulate` brings its own beside it."""
    return scenario().truth if data is None else Truth()
