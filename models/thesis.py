"""Eight sensors and one passing target: the thesis on sensitivity, observability and bounds, simulated.

Flight-time sensors (noise 10 m) with free positions and range offsets, for the sensitivity of tracks to biases
(Syldatk 2013, section 3.4); one more sensor beside a straight pass, whose range offset and position cannot be told
apart (figure 4.1); direction sensors (noise 10 deg), for the map of the position bound (section 4.4.2). What the
thesis leaves open: the places, the paths, one scan a second, process noise 1 m s^-3/2.

    probcal check models/thesis.py --out thesis-check
"""

import numpy as np

from probcal import Bias, Channel, ConstantVelocity, Network, Node, Problem, Target, Truth, sensor, simulate
from probcal.geometry import bearing, norm

PLACES = [(60, 90), (230, 40), (410, 70), (450, 250), (420, 430), (240, 460), (50, 400), (150, 250)]  # m
SCANS = 50
SCALE = 20.0  # m, of positions and range offsets
SHARE = 0.3  # of the biases that are not zero


@sensor(range=Channel("m", std=10.0))
def flight_time(target, pose, *, range_offset=Bias("m", SCALE)):
    """Time of flight times propagation speed, emission time known (thesis 2.5-2.6)."""
    return dict(range=norm(target.position - pose.position) + range_offset)


@sensor(azimuth=Channel("rad", std=np.deg2rad(10.0), wrap=True))
def direction(target, pose):
    """Direction of arrival (thesis 2.10)."""
    return dict(azimuth=bearing(target.position - pose.position) - pose.heading)


def path():
    """True positions (50, 2): through the network in a wave."""
    u = np.linspace(0, 1, SCANS)
    return np.stack([80 + 330 * u, 240 + 110 * np.sin(2 * np.pi * u)], 1)


def target():
    """Constant velocity, the start known to 10 m and 5 m/s."""
    first = path()
    return Target(ConstantVelocity(1.0), {"position": (first[0], 10.0), "velocity": (first[1] - first[0], 5.0)})


def nodes(**spread):
    """The eight masts."""
    return [Node(f"mast_{k}", place, **spread) for k, place in enumerate(PLACES)]


def scenario(key=0):
    """Table and truth of one run of the flight-time sensors."""
    network = Network([flight_time.on(node) for node in nodes(scale=SCALE)])
    return simulate(network, target(), np.arange(float(SCANS)), key=key, share=SHARE, tracks={"target": path()})


def problem(data=None):
    """The flight-time sensors, all positions and range offsets free, with a table of their own or that of run 0."""
    network = Network([flight_time.on(node) for node in nodes(scale=SCALE)])
    return Problem(network, target(), scenario().table if data is None else data)


def truth(data=None):
    """Truth of run 0; a table written by `probcal simulate` brings its own beside it."""
    return scenario().truth if data is None else Truth()


def beside_a_line(straight=True):
    """Figure 4.1: a sensor whose place and range offset are unknown, the others known; a straight pass, or a circle."""
    u = np.linspace(0, 1, SCANS)
    around = np.stack([250 + 120 * np.cos(2 * np.pi * u), 230 + 120 * np.sin(2 * np.pi * u)], 1)
    track = np.stack([320 + 400 * u, np.full(SCANS, 230.0)], 1) if straight else around
    known = [flight_time.on(node) for node in nodes()]
    network = Network([*known, flight_time.on(Node("free", (250.0, 230.0), scale=SCALE))])
    drawn = simulate(network, ConstantVelocity(1.0), np.arange(float(SCANS)), share=0.0, tracks={"target": track})
    fixed = [f"{placed.name}.range_offset" for placed in known]
    return Problem(network, ConstantVelocity(1.0), drawn.table, fix=fixed), drawn.truth


def directions():
    """Section 4.4.2: the masts with direction sensors; the map of the bound needs no data of theirs."""
    network = Network([direction.on(node) for node in nodes(scale={"position": 10.0, "heading": np.deg2rad(10.0)})])
    drawn = simulate(network, target(), np.arange(float(SCANS)), share=0.0, tracks={"target": path()})
    return Problem(network, target(), drawn.table)
