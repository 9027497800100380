"""A ferry's radar, lidar and cameras see two boats in a harbour: detections that nobody named, real.

Recording of the Autoferry sensor fusion dataset (NTNU 2021; Helgesen et al., Ocean Engineering 252, 2022, CC0): not
shipped, give the path of a `scenarioN_detections.json`. Radar and lidar report places (north, east) relative to the
ferry, infrared and optical cameras directions from north; most scans hold false ones, and a boat of 8 to 31 m gives
several, which are put together where they lie within `NEAR` m of each other, or `ABREAST` rad. The reference
`scenarioN_groundTruth.json` beside it, an antenna on each boat, is for judging only.

Unknown are the offsets in azimuth of radar and cameras against the lidar, and in range of radar and lidar.

    probcal fit models/harbour.py PATH --method self-config --out harbour
    probcal track models/harbour.py OTHER --calibration harbour --out other
"""

import json
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.cluster.hierarchy import fcluster, linkage

from probcal import (
    Bias,
    Channel,
    ConstantVelocity,
    Detection,
    InputError,
    Network,
    Node,
    Problem,
    Sector,
    Target,
    Truth,
    sensor,
)
from probcal import (
    Path as NodePath,
)
from probcal.geometry import bearing, norm

NAMES = {1: "lidar", 2: "radar", 3: "infrared", 4: "optical"}
NEAR, ABREAST = 15.0, np.deg2rad(3.0)  # m and rad within which detections are of one boat
RANGE = {"lidar": 130.0, "radar": 400.0}  # m
EVERY = 1.0  # s between two scans of a camera that are used
SPEED = 3.0  # m/s, of a boat


@sensor(range=Channel("m", std=3.0), azimuth=Channel("rad", std=np.deg2rad(2.0), wrap=True))
def ranging(target, pose, *, range_offset=Bias("m", 5.0), azimuth_offset=Bias("rad", 0.05)):
    """Distance and mathematical azimuth of the middle of a boat."""
    line = pose.local(target.position)
    return dict(range=norm(line) + range_offset, azimuth=bearing(line) + azimuth_offset)


@sensor(azimuth=Channel("rad", std=np.deg2rad(1.5), wrap=True))
def camera(target, pose, *, azimuth_offset=Bias("rad", 0.05)):
    """Mathematical azimuth of a boat."""
    return dict(azimuth=bearing(pose.local(target.position)) + azimuth_offset)


def detections(data):
    """The list of detections of a recording; raises `InputError` where there is none."""
    if data is None or not Path(data).is_file():
        where = "needs a recording" if data is None else f": {data} is no file"
        raise InputError(f"harbour.py {where}: give the path of a scenarioN_detections.json (Autoferry)")
    return json.loads(Path(data).read_text())


def middle(values, width):
    """Means (k, d) of the groups of detections (m, d) that hang together within a width."""
    if len(values) < 2:
        return values
    group = fcluster(linkage(values, "single"), width, "distance")
    return np.array([values[group == k].mean(0) for k in np.unique(group)])


def table(data, cameras=True):
    """Detections by scan, put together: time since the first, sensor, range and azimuth; a blank row for nothing."""
    rows, last = [], {}
    listed = detections(data)
    begun = min(scan["time"] for scan in listed)
    for scan in listed:
        name, time = NAMES[scan["sensorID"]], scan["time"] - begun
        found = np.atleast_1d(np.array(scan["measurement"], float))
        if name in RANGE:
            places = middle(found.reshape(2, -1).T, NEAR) if found.size else np.zeros((0, 2))
            polar = np.stack([np.hypot(*places.T), np.arctan2(places[:, 0], places[:, 1])], 1)
            polar = polar[polar[:, 0] < RANGE[name]]
        else:
            if not cameras or time - last.get(name, -np.inf) < EVERY:
                continue
            last[name] = time
            turned = middle(found.reshape(-1, 1), ABREAST)
            polar = np.column_stack([np.full(len(turned), np.nan), np.pi / 2 - turned[:, 0]])
        rows += [(time, name, r, a) for r, a in polar] or [(time, name, np.nan, np.nan)]
    return pd.DataFrame(rows, columns=["time", "sensor", "range", "azimuth"])


def path(data):
    """The way of the ferry (east, north) over time since the first detection."""
    listed = detections(data)
    time = np.array([scan["time"] for scan in listed])
    place = np.array([scan["ownshipPosition"][::-1] for scan in listed])
    time, first = np.unique(time - time.min(), return_index=True)
    return NodePath(time, place[first])


def network(data, cameras=True):
    """Four sensors on one ferry; the lidar's azimuth is the reference."""
    node = Node("ferry", path=path(data))
    placed = [
        ranging.on(node, name="lidar", detection=Detection(0.7, clutter=0.5, view=Sector(range=RANGE["lidar"]))),
        ranging.on(node, name="radar", detection=Detection(0.8, clutter=3.0, view=Sector(range=RANGE["radar"]))),
    ]
    if cameras:
        placed += [camera.on(node, name=n, detection=Detection(0.6, clutter=2.0)) for n in ("infrared", "optical")]
    return Network(placed)


def motion(data):
    """Boats that change their speed little by little, anywhere within reach at first."""
    centre = path(data).position.mean(0)
    start = {"position": (tuple(centre), 150.0), "velocity": ((0.0, 0.0), SPEED)}
    return Target(ConstantVelocity(0.2), start)


def problem(data=None, cameras=False):
    """Detections without names; the lidar's azimuth is taken as right."""
    return Problem(network(data, cameras), motion(data), table(data, cameras), fix="lidar.azimuth_offset")


def truth(data=None, cameras=False):
    """Where the antennas of the two boats were."""
    file = Path(str(data).replace("_detections", "_groundTruth"))
    if not file.is_file():
        return Truth()
    begun = min(scan["time"] for scan in detections(data))
    rows = [
        (own["time"] - begun, f"boat_{own['targetID']}", own["position"][1], own["position"][0])
        for instant in json.loads(file.read_text())
        for own in instant
    ]
    return Truth(pd.DataFrame(rows, columns=["time", "target", "position_x", "position_y"]).drop_duplicates())
