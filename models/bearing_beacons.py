"""Nine places of a rotating infrared detector and four beacons at the corners of a room: bearings only, real.

Recording of H. C. Roh (KAIST, 2010) in the TriangulationToolbox of S. Choi, https://github.com/sunglok/TriangulationToolbox
(BSD-2), folder `dataset_roh`: not shipped, give the path of a folder with `landmark.csv` and `x1.5_y1.5.csv`, ...: at
each of nine places 200 bearings to each of four beacons, in degrees from a direction that was meant to be north (90
degrees). At (1.5, 4.5) and (3, 1.5) m the detector stood turned by 5 and 3 degrees, elsewhere by less than 2.

The 200 repeats of a bearing agree to half a degree and miss by up to 3 degrees, the same for all: reflections, and
places that are off by centimetres. They are one datum with a level to be learnt, not 200. `beacons_are="open"`
leaves out where the beacons stand, `heading="any"` where north is: then the crossings of the lines of sight start it.

    probcal fit models/bearing_beacons.py PATH --out beacons
"""

from pathlib import Path

import numpy as np
import pandas as pd

from probcal import Bias, Channel, InputError, Network, Node, Problem, Static, Target, Truth, Unknown, sensor
from probcal.geometry import bearing

NORTH = np.pi / 2  # stated heading of the detector
TURN = {"stated": np.deg2rad(3.0), "any": 2.0}  # rad, spread of the headings
SURVEY = 0.05  # m, of the places of the detector and of the beacons


@sensor(azimuth=Channel("rad", std=Unknown(np.deg2rad(1.0)), wrap=True))
def detector(target, pose):
    """Azimuth of a beacon from the detector's own north."""
    return dict(azimuth=bearing(target.position - pose.position) - pose.heading)


def folder(data):
    """The folder of the recording; raises `InputError` where there is none."""
    if data is None or not (Path(data) / "landmark.csv").is_file():
        where = "needs a recording" if data is None else f": {data} has no landmark.csv"
        raise InputError(f"bearing_beacons.py {where}: give the path of the folder dataset_roh (TriangulationToolbox)")
    return Path(data)


def places(data):
    """Place (x, y) in m of the detector by file name."""
    files = sorted(folder(data).glob("x*_y*.csv"))
    return {f.stem: tuple(float(part[1:]) for part in f.stem.split("_")) for f in files}


def beacons(data):
    """Places (4, 2) of the beacons in m."""
    return np.loadtxt(folder(data) / "landmark.csv", delimiter=",")


def table(data):
    """One row a place and beacon: the median of the repeats."""
    rows = []
    for name in places(data):
        turned = np.deg2rad(np.loadtxt(folder(data) / f"{name}.csv", delimiter=","))
        centre = np.angle(np.exp(1j * turned).mean(0))
        middle = centre + np.median((turned - centre + np.pi) % (2 * np.pi) - np.pi, axis=0)
        rows += [(0.0, name, f"beacon_{k}", angle) for k, angle in enumerate(middle, start=1)]
    return pd.DataFrame(rows, columns=["time", "sensor", "target", "azimuth"])


def network(data, heading="stated"):
    """The detector at its nine places, each a node whose north may be turned."""
    scale = {"heading": Bias("rad", TURN[heading])}
    nodes = [Node(n, p, NORTH, survey={"position": SURVEY}, scale=scale) for n, p in places(data).items()]
    return Network([detector.on(node) for node in nodes])


def problem(data=None, heading="stated", beacons_are="surveyed"):
    """The recording; `beacons_are="open"`: nobody said where they stand."""
    rows, corners = table(data), beacons(data)
    stand = {
        f"beacon_{k}": Target(Static(), {"position": (tuple(place), SURVEY)} if beacons_are == "surveyed" else {})
        for k, place in enumerate(corners, start=1)
    }
    return Problem(network(data, heading), stand, rows)


def truth(data=None, heading="stated", beacons_are="surveyed"):
    """Turn of each place of the detector: the mean over the beacons of what is left at the stated places."""
    rows, corners, stand = table(data), beacons(data), places(data)
    place = np.array([stand[name] for name in rows["sensor"]])
    line = corners[rows["target"].str.removeprefix("beacon_").astype(int) - 1] - place
    left = NORTH - (np.arctan2(line[:, 1], line[:, 0]) - rows["azimuth"])
    turn = ((left + np.pi) % (2 * np.pi) - np.pi).groupby(rows["sensor"]).mean()
    return Truth(biases={f"{name}.heading": -float(value) for name, value in turn.items()})
