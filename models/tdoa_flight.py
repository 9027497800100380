"""A drone flies among eight ultra-wideband anchors; two of them may have been surveyed the wrong way round.

Flight 0425-traj3 (mode TDOA2) of W. Zhao, A. Goudar, X. Qiao, A. Schoellig, "UTIL: An ultra-wideband
time-difference-of-arrival indoor localization dataset", International Journal of Robotics Research 2024,
https://github.com/utiasDSL/util-uwb-dataset. The repository has no licence: not shipped, give a folder with
`tdoa.csv` (time_s, anchor_a, anchor_b, distance_difference_m), `anchors.csv` (anchor, x_m, y_m, z_m) and, for
scoring, `tag_position.csv` (time_s, x_m, y_m, z_m; motion capture).

Every coordinate of every anchor is free and nothing else ties the frame: that most anchors stand where they were
surveyed has to fix it, so the prior must be sparse. Reflections and shadowing lengthen the path from an anchor by
some decimetres for a second or so; to a model of independent noise these runs look like displaced anchors. The
`Excess` of each path is therefore a state of its own, and `PRIOR` keeps no bias that stands out by less than about
five standard deviations: `fit(problem(folder, swap=(3, 4)), EA(), prior=PRIOR)`.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
import pandas as pd

from probcal import ARD, Channel, ConstantVelocity, InputError, Network, Node, Problem, StudentT, Truth, Unknown, sensor
from probcal.geometry import norm
from probcal.noise import guess_of

ANCHORS = 8
FLIGHT = (3.0, 29.0)  # s, between take-off and landing
HZ = 10.0  # rows a second that are kept of the 50 of each pair
FREQUENT = 100  # rows of the recording below which a pair is left out
PRIOR = ARD(shape=4.0)


@dataclass(frozen=True)
class Excess:
    """Excess path from each anchor: independent, mean 0, `std` in m, correlation exp(-t / memory), `memory` in s."""

    memoryless: ClassVar[bool] = False
    driven: ClassVar[str] = "excess"

    std: Any
    memory: float

    def names(self):
        """One scalar component an anchor."""
        return tuple((f"excess_{n}", False) for n in range(ANCHORS))

    def transition(self, dt, dimension):
        """Decay over each time step, shape (E, anchors, anchors)."""
        return np.exp(-dt / self.memory)[:, None, None] * np.eye(ANCHORS)

    def noise_factor(self, dt, dimension):
        """What keeps the variance at 1, shape (E, anchors, anchors)."""
        return np.sqrt(-np.expm1(-2 * dt / self.memory))[:, None, None] * np.eye(ANCHORS)

    def means(self, time, dimension):
        """Zero, shape (E, anchors)."""
        return np.zeros((len(time), ANCHORS))

    def start(self):
        """The stationary spread."""
        return {name: (0.0, guess_of(self.std)) for name, _ in self.names()}


def excess(target, node):
    """Excess path from an anchor, by its number."""
    return jnp.stack([getattr(target, f"excess_{n}") for n in range(ANCHORS)])[node.number.astype(int)]


@sensor(difference=Channel("m", std=Unknown(0.07), noise=StudentT(4)))
def uwb(target, first, second):
    """Path from the second anchor minus path from the first, each with its excess."""
    paths = [norm(target.position - node.position) + excess(target, node) for node in (first, second)]
    return dict(difference=paths[1] - paths[0])


def read(data, name, columns):
    """A table of the recording, its columns renamed."""
    if data is None:
        raise InputError(
            "tdoa_flight.py needs a recording: download a flight from https://github.com/utiasDSL/util-uwb-dataset and "
            "give the path of a folder with tdoa.csv, anchors.csv and tag_position.csv"
        )
    if not (Path(data) / name).is_file():
        raise InputError(f"{data}: there is no {name} in it; give the folder of a flight")
    return pd.read_csv(Path(data) / name).set_axis(columns, axis=1)


def anchors(data, swap=()):
    """Surveyed positions (8, 3), those of the two anchors in `swap` exchanged."""
    places = read(data, "anchors.csv", ["anchor", "x", "y", "z"]).set_index("anchor").to_numpy()
    order = np.arange(len(places))
    order[list(swap)] = order[list(swap)[::-1]]
    return places[order]


def table(data):
    """Rows in flight, thinned: in each step of time the row of each pair that is nearest to its middle."""
    rows = read(data, "tdoa.csv", ["time", "first", "second", "difference"])
    rows["sensor"] = "anchor_" + rows["first"].astype(str) + "-anchor_" + rows["second"].astype(str)
    frequent = rows.groupby("sensor")["sensor"].transform("size") >= FREQUENT
    rows = rows[rows["time"].between(*FLIGHT) & frequent]
    middle = (np.floor(rows["time"] * HZ) + 0.5) / HZ
    rows = rows.assign(time=middle, away=(rows["time"] - middle).abs()).sort_values(["time", "away"])
    return rows.drop_duplicates(["time", "sensor"])[["time", "sensor", "difference"]]


def problem(data=None, swap=()):
    """The flight in the folder `data`; `swap` exchanges the surveyed positions of two anchors, as in `(3, 4)`."""
    places = anchors(data, swap)
    nodes = {f"anchor_{n}": Node(f"anchor_{n}", place, number=n, scale=1.0) for n, place in enumerate(places)}
    rows = table(data)
    network = Network([uwb.on(*(nodes[name] for name in pair.split("-"))) for pair in sorted(rows["sensor"].unique())])
    return Problem(network, ConstantVelocity(1.0) + Excess(Unknown(0.15), memory=1.0), rows)


def truth(data=None, swap=()):
    """Track of the tag, and what undoes the swap."""
    track = read(data, "tag_position.csv", ["time", "position_x", "position_y", "position_z"])
    shift = anchors(data) - anchors(data, swap)
    labels = [f"anchor_{n}.position_{axis}" for n in range(len(shift)) for axis in "xyz"]
    return Truth(track, dict(zip(labels, shift.ravel().tolist(), strict=True)))
