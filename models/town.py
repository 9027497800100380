"""A grid town: bearings from eight roofs to three vehicles in the streets, headings unknown, simulated.

Streets every 60 m, seven by six of them, two of them one-way, one blind alley, one diagonal; extracts of OpenStreetMap
have a licence of their own and are not shipped, `probcal.read_roads` reads them. Two vehicles stay on the streets; the
third drives into a car park for a while (`LeavingRoad`). A bearing says nothing of the distance, and a roof sees the
streets from one side: off the roads scene and headings are poorly tied together, on them a street is a ruler. Biases:
heading (5 deg) and place (3 m) of each roof; noise 1.5 deg; roofs look at times of their own.

    probcal fit models/town.py --method em-particles --out town
"""

from functools import cache

import numpy as np
import pandas as pd

from probcal import LeavingRoad, Network, Node, Problem, Road, RoadNetwork, Truth, simulate
from probcal.sensors import doa

BLOCK, COLUMNS, ROWS = 60.0, 7, 6  # m between streets
HEADING, PLACE = np.deg2rad(5.0), 3.0  # rad, m
ROOFS = [(95, 35), (265, 25), (330, 150), (275, 265), (150, 275), (30, 210), (25, 90), (205, 145)]
SECONDS = 60
STARTS = {"bus": ((0.0, 60.0), 8.0), "van": ((300.0, 300.0), 7.0), "visitor": ((120.0, 0.0), 6.0)}


@cache
def roads():
    """The streets."""
    lines = {}
    for i in range(COLUMNS):
        for j in range(ROWS):
            here = np.array([i, j]) * BLOCK
            if i < COLUMNS - 1 and not (j == 3 and i == 2):  # a house stands in the way: blind alleys on both sides
                lines[f"street {j} from {i}"] = [here, here + np.array([BLOCK, 0.0])]
            if j < ROWS - 1:
                lines[f"avenue {i} from {j}"] = [here, here + np.array([0.0, BLOCK])]
    lines["diagonal"] = [np.array([4, 1]) * BLOCK, np.array([5.3, 1.7]) * BLOCK, np.array([6, 2]) * BLOCK]
    oneway = [name for name in lines if name.startswith(("street 2", "avenue 4"))]
    return RoadNetwork.from_lines(lines, oneway=oneway, bridges=("diagonal",))


def network():
    """Bearing sensors on the roofs."""
    return Network([
        doa.on(Node(f"roof_{k}", place, 0.0, scale={"position": PLACE, "heading": HEADING}))
        for k, place in enumerate(ROOFS, 1)
    ])  # fmt: skip


def motion():
    """Vehicles on the streets, one of which may leave them."""
    found = {}
    for name, (place, speed) in STARTS.items():
        road = Road(roads(), std=0.5, speed=(speed, 1.0), position=(place, 5.0), fastest=14.0)
        found[name] = LeavingRoad(road, std=1.0, leave=0.03, join=0.1) if name == "visitor" else road
    return found


@cache
def scenario(key=0):
    """Table and truth of one run: every roof looks at one vehicle after the other, a second each."""
    names, sensors = list(STARTS), [s.name for s in network().sensors]
    rows = [
        (second + 0.1 * v, name, sensor)
        for second in range(SECONDS) for v, name in enumerate(names) for s, sensor in enumerate(sensors)
        if (second + v + s) % 2 == 0
    ]  # fmt: skip
    schedule = pd.DataFrame(rows, columns=["time", "target", "sensor"])
    drawn = np.random.default_rng(key)
    biases = {b.label: b.scale * drawn.standard_normal() for b in network().biases}
    return simulate(network(), motion(), [0.0], key=key, biases=biases, schedule=schedule)


def problem(data=None):
    """The network with a table of its own (columns time, target, sensor, azimuth), or that of run 0."""
    return Problem(network(), motion(), scenario().table if data is None else data)


def setting(run=0):
    """Problem and truth of one run of a study."""
    drawn = scenario(run)
    return problem(drawn.table), drawn.truth


def truth(data=None):
    """Truth of run 0; a table written by `probcal simulate` brings its own beside it."""
    return scenario().truth if data is None else Truth()
