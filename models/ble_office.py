"""Twelve Bluetooth receivers in an office hear a beacon that somebody carries: gains and exponent, real.

Recording of F. S. Danis, A. T. Cemgil, C. Ersoy, "Position-annotated BLE RSSI data set" (CC0, GitHub
philotuxo/Position-Annotated-BLE-RSSI-Dataset), described in Pervasive and Mobile Computing 81 (2022): not shipped, give
the path of a folder with `cnf_tetam.dev` and the tracks `*.mbd`. Places of the beacon are known to centimetres by
cameras; they are used for scoring only.

Levels in dBm twice a second. The body of the carrier shadows a receiver for a second or two by several decibels, so
that successive levels are no independent data: the mean level of `PERIOD` seconds is one row, and its noise is learnt.
What shadows a receiver for the whole of a walk is another on the next: regressions on single walks differ by a decibel,
three times more than their own noise. So a gain drifts from walk to walk, by `CHANGE` in the hour of the recording, and
a walk that was not calibrated on has wider gains. The nominal exponent 2 is that of free space.
Calibrate on three straight walks, track others:

    probcal fit models/ble_office.py PATH --out ble
    probcal track models/ble_office.py PATH --calibration ble --set walks=rectangular_without_rotation --out ble-track
"""

import ast
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pandas as pd

from probcal import (
    ARD,
    Bias,
    Channel,
    ConstantVelocity,
    Drift,
    InputError,
    Network,
    Node,
    Problem,
    RandomWalk,
    Truth,
    Unknown,
    sensor,
)

STRAIGHT = ("straight_01", "straight_02", "straight_03")
OTHERS = ("rectangular_without_rotation", "zigzagging_without_rotation")
BEGAN = 1581249601.0  # s, Unix time of the first walk
STARTS = (0.0, 1100.0, 1550.0, 2680.0, 3250.0)  # s after that, of each walk in the order of their recording
PERIOD = 1.0  # s, of which one row is made
HEIGHT = 1.8  # m, at which the beacon is carried
GAIN = 4.0  # dB, spread of the gains
CHANGE = 0.05  # dB s^-1/2, their random walk: a decibel or two from one walk to the next
POWER = (-60.0, 5.0)  # dBm at 1 m, and how well that is known
PRIOR = ARD(by="component", rate=0.5)  # one learnt spread for all gains: every receiver has one of its own


@sensor(level=Channel("dB", std=Unknown(4.0)))
def receiver(
    target,
    pose,
    *,
    gain=Bias("dB", GAIN, drift=Drift(STARTS, std=CHANGE)),
    exponent=Bias("1", 0.7, nominal=2.0, shared="type"),
):
    """Level of a beacon carried at a known height."""
    squared = jnp.sum((target.position - pose.position) ** 2) + (pose.height - HEIGHT) ** 2
    return dict(level=target.power + gain - 5 * exponent * jnp.log10(squared))


def folder(data):
    """The folder of the recording; raises `InputError` where there is none."""
    if data is None or not (Path(data) / "cnf_tetam.dev").is_file():
        where = "needs a recording" if data is None else f": {data} has no cnf_tetam.dev"
        raise InputError(f"ble_office.py {where}: give the path of the folder of the data set (README of the model)")
    return Path(data)


def receivers(data):
    """Name and place (x, y, z) of each receiver by its address."""
    text = (folder(data) / "cnf_tetam.dev").read_text().split("Dongles:", 1)[1].split("\n", 1)[0]
    return {
        mac: (f"receiver_{alias.removeprefix('sensor')}", place)
        for mac, (place, _, alias) in ast.literal_eval(text).items()
    }


def walk(data, name):
    """Rows of one track: time from the first walk, address, level, x, y."""
    path = folder(data) / f"{name}_all_sensors.mbd"
    if not path.is_file():
        raise InputError(f"{path}: no such track; give walks=(...) of those in the folder")
    rows = pd.read_csv(
        path, header=None, usecols=[0, 1, 3, 4, 5], names=["time", "mac", "level", "x", "y"], dtype={1: str}
    )
    return rows.assign(time=rows["time"] - BEGAN)


def named(walks):
    """Names of tracks, of one given as text too."""
    return (walks,) if isinstance(walks, str) else tuple(walks)


def table(data, walks=STRAIGHT):
    """Rows of several tracks, each a target of its own: mean levels of each period and receiver."""
    names = {mac: name for mac, (name, _) in receivers(data).items()}
    parts = [walk(data, w).assign(target=w) for w in named(walks)]
    rows = pd.concat(parts, ignore_index=True)
    middle = (np.floor(rows["time"] / PERIOD) + 0.5) * PERIOD
    rows = rows.assign(time=middle, sensor=rows["mac"].map(names))
    return rows.groupby(["target", "time", "sensor"], as_index=False)["level"].mean()


def network(data):
    """Twelve receivers at surveyed places; their height is known."""
    return Network([
        receiver.on(Node(name, (x, y), height=z))
        for name, (x, y, z) in sorted(receivers(data).values())
    ])  # fmt: skip


def motion():
    """A walk, and a beacon whose power hardly changes."""
    return ConstantVelocity(0.4) + RandomWalk("power", "dB", 0.05, POWER)


def problem(data=None, walks=STRAIGHT):
    """Tracks of the recording in the folder `data`."""
    return Problem(network(data), motion(), table(data, walks))


def truth(data=None, walks=STRAIGHT):
    """Places of the beacon by cameras."""
    parts = [walk(data, w).assign(target=w).drop_duplicates("time") for w in named(walks)]
    rows = pd.concat(parts, ignore_index=True).rename(columns={"x": "position_x", "y": "position_y"})
    return Truth(rows[["time", "target", "position_x", "position_y"]])
