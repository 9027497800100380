"""Five sensors that see directions only, of unknown heading: self-calibration of the DOA paper, simulated.

A target passes on a nearly straight line; every half second each sensor takes its direction to 1 degree, in axes of its
own that may point anywhere. Sensor 0 is the origin with a known heading, the distance to sensor 1 was measured: without
the one the answer may turn, without the other grow. Places of the others are stated as one point, to 300 m: nothing is
known of them. `space=True` is the 3-D case: azimuth and elevation of two targets, one of them with the velocity of the
paper, (-25, 25, 25) m/s; sensors are level. What the paper leaves open: places, headings, path.

    probcal fit models/doa_array.py --out array
"""

from functools import cache

import numpy as np

from probcal import Bias, Channel, ConstantVelocity, Network, Node, Problem, Truth, sensor, simulate
from probcal.geometry import bearing, elevation

PLACES = np.array([(0.0, 0.0), (120.0, 30.0), (200.0, -60.0), (60.0, -110.0), (-80.0, 40.0)])
HEIGHTS = np.array([0.0, 10.0, 25.0, -15.0, 30.0])
STD = np.deg2rad(1.0)
SEEN = 200  # bearings a sensor
PERIOD = {False: 0.5, True: 0.3}  # s
NOISE = {False: 0.05, True: 0.05}  # m s^-3/2: nearly straight
WIDE = 300.0  # m, spread of a place of which nothing is known


@sensor(azimuth=Channel("rad", std=STD, wrap=True))
def array_2d(target, pose):
    """Direction of arrival in the plane, in the sensor's own axes."""
    return dict(azimuth=bearing(pose.local(target.position)))


@sensor(azimuth=Channel("rad", std=STD, wrap=True), elevation=Channel("rad", std=STD))
def array_3d(target, pose):
    """Direction of arrival in space, in the sensor's own axes."""
    line = pose.local(target.position)
    return dict(azimuth=bearing(line), elevation=elevation(line))


def places(space=False):
    """True places (5, 2 or 3) in m."""
    return np.column_stack([PLACES, HEIGHTS]) if space else PLACES


def headings(run=0):
    """True headings (5,) in rad: the first is known to be 0, the others point anywhere."""
    return np.array([0.0, *np.random.default_rng(run).uniform(-np.pi, np.pi, len(PLACES) - 1)])


def network(space=False, known=2):
    """Sensor 0 known; the distance to sensor 1 (with `known=1` not even that); all else open."""
    kind, true = (array_3d if space else array_2d), places(space)
    centre = true.mean(0)
    nodes = []
    for k, place in enumerate(true):
        turn = {} if k == 0 else {"heading": Bias("rad", 2.0)}
        free = {} if k < known else {"position": WIDE}
        nodes.append(Node(f"sensor_{k}", place if k < known else centre, scale=turn | free))
    return Network([kind.on(node) for node in nodes])


def paths(run=0, space=False):
    """True tracks (SEEN, d) by target: nearly straight."""
    rng = np.random.default_rng(1000 + run)
    if not space:
        lines = {"target": ((-300.0, 150.0), (6.0, -1.5))}
    else:
        lines = {
            "climbing": ((700.0, -600.0, 50.0), (-25.0, 25.0, 25.0)),
            "level": ((-500.0, -300.0, 200.0), (18.0, 9.0, 0.0)),
        }
    found = {}
    for name, (start, velocity) in lines.items():
        shaken = NOISE[space] * np.sqrt(PERIOD[space]) * rng.standard_normal((SEEN, len(start)))
        found[name] = np.array(start) + np.cumsum(PERIOD[space] * (np.array(velocity) + np.cumsum(shaken, 0)), 0)
    return found


@cache
def scenario(key=0, space=False, known=2):
    """Table and truth of one run: headings drawn, path drawn."""
    own = network(space, known)
    biases = {}
    for node, place, heading in zip((s.nodes[0] for s in own.sensors), places(space), headings(key), strict=True):
        if "heading" in node.spread:
            biases[f"{node.name}.heading"] = float(heading)
        if "position" in node.spread:
            shift = place - node.position
            biases |= {f"{node.name}.position_{axis}": float(v) for axis, v in zip("xyz", shift, strict=False)}
    time = PERIOD[space] * np.arange(SEEN)
    return simulate(own, motion(space), time, key=key, biases=biases, tracks=paths(key, space))


def motion(space=False):
    """Nearly constant velocity."""
    return ConstantVelocity(NOISE[space])


def problem(data=None, run=0, space=False, known=2):
    """The array with bearings of its own (columns time, sensor, target, azimuth[, elevation]), or those of a run."""
    own = scenario(run, space, known).table if data is None else data
    return Problem(network(space, known), motion(space), own)


def truth(data=None, run=0, space=False, known=2):
    """What a run was simulated with."""
    return scenario(run, space, known).truth if data is None else Truth()
