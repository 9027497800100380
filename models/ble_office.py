"""Twelve Bluetooth receivers in an office hear a beacon that somebody carries: gains and exponent, real.

Recording of F. S. Danis, A. T. Cemgil, C. Ersoy, "Position-annotated BLE RSSI data set" (CC0, GitHub
philotuxo/Position-Annotated-BLE-RSSI-Dataset), described in Pervasive and Mobile Computing 81 (2022): not shipped, give
the path of a folder with `cnf_tetam.dev` and the tracks `*.mbd`. Places of the beacon are known to centimetres by
cameras; they are used for scoring only.

Levels in dBm twice a second. The body of the carrier shadows a receiver for a second or two by several decibels: to a
model of independent noise that is a gain, so the shadow of each receiver is a state of its own, whose level is learnt.
The nominal exponent 2 is that of free space. Calibrate on three straight walks, track others:

    probcal fit models/ble_office.py PATH --out ble
    probcal track models/ble_office.py PATH --calibration ble --set walks=rectangular_without_rotation --out ble-track
"""

import ast
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
import pandas as pd

from probcal import (
    Bias,
    Channel,
    ConstantVelocity,
    Gaussian,
    InputError,
    Network,
    Node,
    Problem,
    RandomWalk,
    Truth,
    Unknown,
    sensor,
)
from probcal.noise import guess_of

STRAIGHT = ("straight_01", "straight_02", "straight_03")
OTHERS = ("rectangular_without_rotation", "zigzagging_without_rotation")
RECEIVERS = ("10", "11", "12", "20", "21", "22", "30", "31", "32", "40", "41", "42")
HEIGHT = 1.8  # m, at which the beacon is carried
GAIN = 4.0  # dB, spread of the gains
POWER = (-60.0, 5.0)  # dBm at 1 m, and how well that is known
PRIOR = Gaussian()  # every receiver has a gain of its own


@dataclass(frozen=True)
class Shadow:
    """Shadow before each receiver: independent, mean 0, `std` in dB, correlation exp(-t / memory), `memory` in s."""

    memoryless: ClassVar[bool] = False
    driven: ClassVar[str] = "shadow"

    std: Any
    memory: float

    def names(self):
        """One scalar component a receiver."""
        return tuple((f"shadow_{n}", False) for n in RECEIVERS)

    def transition(self, dt, dimension):
        """Decay over each time step, shape (E, receivers, receivers)."""
        return np.exp(-dt / self.memory)[:, None, None] * np.eye(len(RECEIVERS))

    def noise_factor(self, dt, dimension):
        """What keeps the variance at 1, shape (E, receivers, receivers)."""
        return np.sqrt(-np.expm1(-2 * dt / self.memory))[:, None, None] * np.eye(len(RECEIVERS))

    def means(self, time, dimension):
        """Zero, shape (E, receivers)."""
        return np.zeros((len(time), len(RECEIVERS)))

    def start(self):
        """The stationary spread."""
        return {name: (0.0, guess_of(self.std)) for name, _ in self.names()}


@sensor(level=Channel("dB", std=Unknown(4.0)))
def receiver(target, pose, *, gain=Bias("dB", GAIN), exponent=Bias("1", 0.7, nominal=2.0, shared="type")):
    """Level of a beacon carried at a known height, behind the shadow of the body."""
    squared = jnp.sum((target.position - pose.position) ** 2) + (pose.height - HEIGHT) ** 2
    shadow = jnp.stack([getattr(target, f"shadow_{n}") for n in RECEIVERS])[pose.number.astype(int)]
    return dict(level=target.power + gain - 5 * exponent * jnp.log10(squared) - shadow)


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
    """Rows of one track: time from its start, address, level, x, y."""
    path = folder(data) / f"{name}_all_sensors.mbd"
    if not path.is_file():
        raise InputError(f"{path}: no such track; give walks=(...) of those in the folder")
    rows = pd.read_csv(
        path, header=None, usecols=[0, 1, 3, 4, 5], names=["time", "mac", "level", "x", "y"], dtype={1: str}
    )
    return rows.assign(time=rows["time"] - rows["time"].min())


def named(walks):
    """Names of tracks, of one given as text too."""
    return (walks,) if isinstance(walks, str) else tuple(walks)


def table(data, walks=STRAIGHT):
    """Rows of several tracks, each a target of its own."""
    names = {mac: name for mac, (name, _) in receivers(data).items()}
    parts = [walk(data, w).assign(target=w) for w in named(walks)]
    rows = pd.concat(parts, ignore_index=True)
    return rows.assign(sensor=rows["mac"].map(names))[["time", "target", "sensor", "level"]]


def network(data):
    """Twelve receivers at surveyed places; their height is known."""
    return Network([
        receiver.on(Node(name, (x, y), height=z, number=RECEIVERS.index(name.removeprefix("receiver_"))))
        for name, (x, y, z) in sorted(receivers(data).values())
    ])  # fmt: skip


def motion():
    """A walk, a beacon whose power hardly changes, and the shadows."""
    own = ConstantVelocity(0.4) + RandomWalk("power", "dB", 0.05, POWER)
    return own + Shadow(Unknown(4.0), memory=2.0)


def problem(data=None, walks=STRAIGHT):
    """Tracks of the recording in the folder `data`, brought to common epochs of half a second."""
    return Problem(network(data), motion(), table(data, walks), epoch=0.5)


def truth(data=None, walks=STRAIGHT):
    """Places of the beacon by cameras."""
    parts = [walk(data, w).assign(target=w).drop_duplicates("time") for w in named(walks)]
    rows = pd.concat(parts, ignore_index=True).rename(columns={"x": "position_x", "y": "position_y"})
    return Truth(rows[["time", "target", "position_x", "position_y"]])
