"""A ferry's radar, lidar and cameras see two boats in a harbour: detections that nobody named, real.

Recording of the Autoferry sensor fusion dataset (NTNU 2021; Helgesen et al., Ocean Engineering 252, 2022, CC0): not
shipped, give the path of a `scenarioN_detections.json`. Radar and lidar report places (north, east) relative to the
ferry, infrared and optical cameras directions from north. The reference `scenarioN_groundTruth.json` beside it, an
antenna on each boat, is for judging only. A boat of 8 to 31 m gives several detections, which are put together where
they lie within `NEAR` m of each other, or `ABREAST` rad; where its middle seems to be depends on the side that is seen,
which the std allows for. Most false detections of the radar are no noise, and three kinds are left out:

- echoes: behind a boat, in its beam and half as far again or more, up to five times; they move as it does;
- what stands: reported within `STILL` m for longer than `LONG` s without a break of `BREAK` s; no boat under way is
  seen there either, which the view of the radar says;
- the ferry itself, within 25 m.

A camera, too, leaves out what it sees in one direction (`ABREAST`) for so long. What cameras alone see
(`cameras=True`) has a direction and no place: its sd says so, tens of metres and more.

Unknown are the offsets in azimuth of radar and cameras against the lidar, and in range of radar and lidar.

    probcal fit models/harbour.py PATH --method self-config --out harbour
    probcal track models/harbour.py OTHER --calibration harbour --out other
"""

import json
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
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
    Target,
    Truth,
    sensor,
)
from probcal import (
    Path as NodePath,
)
from probcal.geometry import bearing, norm, wrap

NAMES = {1: "lidar", 2: "radar", 3: "infrared", 4: "optical"}
NEAR, ABREAST = 25.0, np.deg2rad(3.0)  # m and rad within which detections are of one boat
REACH = {"lidar": (5.0, 130.0), "radar": (25.0, 400.0)}  # m, within which detections are used
SURE = {"lidar": 60.0, "radar": 150.0}  # m up to which small boats are seen as well as large ones
BEAM, BEHIND = np.deg2rad(12.0), 1.5  # rad on each side of a boat, and times its range, where the radar reports echoes
STILL, LONG, BREAK = 10.0, 40.0, 15.0  # m, s and s by which it is known what stands
EVERY = 1.0  # s between two scans of a camera that are used
SPEED = 3.0  # m/s, of a boat


@sensor(range=Channel("m", std=5.0), azimuth=Channel("rad", std=np.deg2rad(3.0), wrap=True))
def ranging(target, pose, *, range_offset=Bias("m", 5.0), azimuth_offset=Bias("rad", 0.05)):
    """Distance and mathematical azimuth of the middle of a boat."""
    line = pose.local(target.position)
    return dict(range=norm(line) + range_offset, azimuth=bearing(line) + azimuth_offset)


@sensor(azimuth=Channel("rad", std=np.deg2rad(2.0), wrap=True))
def camera(target, pose, *, azimuth_offset=Bias("rad", 0.05)):
    """Mathematical azimuth of a boat."""
    return dict(azimuth=bearing(pose.local(target.position)) + azimuth_offset)


@dataclass(frozen=True)
class Open:
    """What radar and lidar see: open water, all boats up to `sure` m and ever fewer out to `far` m.

    Nothing is seen within `STILL` m of what stands (east, north).
    """

    near: float
    sure: float
    far: float
    stands: tuple = ()

    def __call__(self, target, pose):
        """Share of boats that are seen."""
        away = norm(pose.local(target.position))
        share = jnp.clip(1.0 - 0.8 * (away - self.sure) / (self.far - self.sure), 0.2, 1.0)
        seen = (away >= self.near) & (away <= self.far)
        if self.stands:
            seen &= jnp.all(jnp.linalg.norm(target.position - jnp.array(self.stands), axis=1) > STILL)
        return share * seen


@dataclass(frozen=True)
class Clear:
    """What a camera sees: all but the directions (mathematical azimuths) in which something stands."""

    stands: tuple = ()

    def __call__(self, target, pose):
        """Whether a boat is seen, 1 or 0."""
        away = jnp.abs(wrap(bearing(pose.local(target.position)) - jnp.array(self.stands)))
        return jnp.all(away > ABREAST).astype(float)


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


def standing(data):
    """Places (k, 2), east and north, at which the radar reports something for long."""
    scans = [scan for scan in detections(data) if NAMES[scan["sensorID"]] == "radar" and scan["measurement"]]
    places = [np.reshape(scan["measurement"], (2, -1)).T + scan["ownshipPosition"] for scan in scans]
    time = np.repeat([scan["time"] for scan in scans], [len(own) for own in places])
    place = np.concatenate([np.zeros((0, 2)), *places])[:, ::-1]
    return middle(place[_stay(time, np.linalg.norm(place[:, None] - place, axis=2) < STILL)], STILL)


def fixed(azimuth, time):
    """Directions (k,) in which a camera reports something for long, of the azimuths and times (N,) that it reports."""
    stays = azimuth[_stay(time, _apart(azimuth) < ABREAST)]
    return np.unique(np.round(stays / ABREAST)) * ABREAST


def _stay(time, near):
    """Which detections (N,) have others near (N, N) for long without a break."""

    def goes_on(time):
        run = np.cumsum(np.diff(time, prepend=time[0]) > BREAK)
        return max(np.ptp(time[run == k]) for k in range(run[-1] + 1)) > LONG

    return np.array([goes_on(np.unique(time[own])) for own in near], bool)


def _apart(azimuth, other=None):
    """Angles (N, M) between directions."""
    other = azimuth if other is None else other
    return np.abs((azimuth[:, None] - other + np.pi) % (2 * np.pi) - np.pi)


def _echoes(polar):
    """Which detections (k, 2) of one scan of the radar lie behind another."""
    distance, azimuth = polar.T
    return ((_apart(azimuth) < BEAM) & (distance[:, None] > BEHIND * distance)).any(1)


def _open(polar, ferry, stands):
    """Those detections (k, 2) of one scan of the radar that are neither echoes nor of what stands."""
    at = ferry + polar[:, :1] * np.stack([np.cos(polar[:, 1]), np.sin(polar[:, 1])], 1)
    held = (np.linalg.norm(at[:, None] - stands, axis=2) <= STILL).any(1)
    return polar[~held & ~_echoes(polar)]


def table(data, cameras=True):
    """Detections by scan, put together: time since the first, sensor, range and azimuth; a blank row for nothing."""
    return reported(data, cameras)[0]


def reported(data, cameras=True):
    """The table, and what stands: places (k, 2) by the radar, directions (k,) by each camera."""
    scans, last = [], {}
    listed, stands = detections(data), {"radar": standing(data)}
    begun = min(scan["time"] for scan in listed)
    for scan in listed:
        name, time = NAMES[scan["sensorID"]], scan["time"] - begun
        found = np.atleast_1d(np.array(scan["measurement"], float))
        if name in REACH:
            places = middle(found.reshape(2, -1).T, NEAR) if found.size else np.zeros((0, 2))
            polar = np.stack([np.hypot(*places.T), np.arctan2(places[:, 0], places[:, 1])], 1)
            polar = polar[(polar[:, 0] > REACH[name][0]) & (polar[:, 0] < REACH[name][1])]
            if name == "radar":
                polar = _open(polar, np.array(scan["ownshipPosition"][::-1]), stands["radar"])
        else:
            if not cameras or time - last.get(name, -np.inf) < EVERY:
                continue
            last[name] = time
            turned = middle(found.reshape(-1, 1), ABREAST)
            polar = np.column_stack([np.full(len(turned), np.nan), np.pi / 2 - turned[:, 0]])
        scans.append((time, name, polar))
    for name in last:
        own = [(np.full(len(polar), time), polar[:, 1]) for time, camera, polar in scans if camera == name]
        time, azimuth = (np.concatenate(parts) for parts in zip(*own, strict=True))
        stands[name] = fixed(azimuth, time)
    rows = []
    for time, name, polar in scans:
        if name in last:
            polar = polar[~(_apart(polar[:, 1], stands[name]) < ABREAST).any(1)]
        rows += [(time, name, r, a) for r, a in polar] or [(time, name, np.nan, np.nan)]
    return pd.DataFrame(rows, columns=["time", "sensor", "range", "azimuth"]), stands


def path(data):
    """The way of the ferry (east, north) over time since the first detection."""
    listed = detections(data)
    time = np.array([scan["time"] for scan in listed])
    place = np.array([scan["ownshipPosition"][::-1] for scan in listed])
    time, first = np.unique(time - time.min(), return_index=True)
    return NodePath(time, place[first])


def network(data, cameras=True, stands=None):
    """Four sensors on one ferry; the lidar's azimuth is the reference."""
    node = Node("ferry", path=path(data))
    stands = reported(data, cameras)[1] if stands is None else stands
    places = {"lidar": (), "radar": tuple(map(tuple, stands["radar"].round(1).tolist()))}
    clutter = {"lidar": 0.5, "radar": 2.0}
    placed = []
    for name, (near, far) in REACH.items():
        view = Open(near, SURE[name], far, places[name])
        report = Detection(0.9, clutter[name], view, {"range": (near, far)})
        placed.append(ranging.on(node, name=name, detection=report))
    for name in ("infrared", "optical") if cameras else ():
        view = Clear(tuple(stands[name].round(4).tolist()))
        placed.append(camera.on(node, name=name, detection=Detection(0.6, 2.0, view)))
    return Network(placed)


def motion(data):
    """Boats that change their speed little by little, anywhere within reach at first."""
    centre = path(data).position.mean(0)
    start = {"position": (tuple(centre), 150.0), "velocity": ((0.0, 0.0), SPEED)}
    return Target(ConstantVelocity(0.2), start)


def problem(data=None, cameras=False):
    """Detections without names; the lidar's azimuth is taken as right."""
    rows, stands = reported(data, cameras)
    return Problem(network(data, cameras, stands), motion(data), rows, fix="lidar.azimuth_offset")


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
