"""Eight microphones and a car that chirps twice a second: arrival times with unknown emission and echoes in runs.

Real recording of the sensor fusion laboratory of Linköping University (course TSRT14, 2026; repository Aadak9/TSRT14
on GitHub, folder `Lab 1/SFlab1`). It has no licence and is not shipped: give the path of `dataset_1_exp2.mat`. A
motion capture system tracked the car; it is used for scoring only.

The detector always answers: when the loudspeaker faces away it takes an echo, up to ten pulses in a row, hence the
noise is a mixture of inliers (8 cm) and late echoes. The loudspeaker keeps its period to 0.3 ms, so the emission
range drifts slowly about it. All places are free (scale 1 m, sparse priors): what fixes the frame is that few of
them move. `swap=(5, 8)` exchanges the surveyed places of two microphones, as the papers do; a swap across the room
has another optimum, which `fit(..., starts=6)` tells from the right one by its evidence. `PRIOR` has one precision
for both coordinates of a microphone and keeps only what stands far out: echoes in runs look like small displacements.
"""

from pathlib import Path

import numpy as np
import pandas as pd
from scipy.io import loadmat

from probcal import (
    ARD,
    Channel,
    ConstantVelocity,
    InputError,
    Mixture,
    Network,
    Node,
    Problem,
    RandomWalk,
    Truth,
    sensor,
)
from probcal.geometry import norm

SPEED = 343.0  # m/s
SILENT = 8  # pulses before the loudspeaker starts
CLOCK = 0.16  # s, motion capture after audio
SCALE = 1.0  # m, of the places
DRIFT = 0.15  # m s^-1/2, of the emission range about its period
PRIOR = ARD(shape=4.0, by="node")


@sensor(arrival=Channel("m", std=0.08, noise=Mixture(share=0.15, scale=8.0, delay=3.0)))
def chirp(target, pose):
    """Arrival time of a chirp times the speed of sound: distance and emission range (thesis 2.7)."""
    return dict(arrival=norm(target.position - pose.position) + target.emission)


def recording(data):
    """The recording as a dict of arrays; raises `InputError` where there is none."""
    if data is None:
        raise InputError("sflab.py needs its recording: give the path of dataset_1_exp2.mat (TSRT14, lab 1, SFlab1)")
    path = Path(data)
    if not path.is_file():
        raise InputError(f"{path}: no such file; give the path of dataset_1_exp2.mat (TSRT14, lab 1, SFlab1)")
    return loadmat(path)


def places(data):
    """Surveyed places of the microphones (8, 2) in m."""
    return np.ravel(recording(data)["mic_locations"]).astype(float).reshape(8, 2)


def network(surveyed, swap=None):
    """Microphones at surveyed places (8, 2), those of the two in `swap` exchanged."""
    stated = np.array(surveyed, float)
    if swap is not None:
        pair = np.array(swap) - 1
        stated[pair] = stated[pair[::-1]]
    return Network([chirp.on(Node(f"mic_{n}", place, scale=SCALE)) for n, place in enumerate(stated, start=1)])


def table(arrival):
    """Rows of arrival times (8, pulses) in s: the emission of a steady period is taken off, the rest is in m."""
    arrival = arrival[:, SILENT:]
    pulse = np.arange(arrival.shape[1])
    emission = np.polyval(np.polyfit(pulse, np.median(arrival, 0), 1), pulse)
    frame = pd.DataFrame((SPEED * (arrival - emission)).T, columns=[f"mic_{n}" for n in range(1, 9)])
    frame.insert(0, "time", emission)
    return frame.melt("time", var_name="sensor", value_name="arrival")


def problem(data=None, swap=None):
    """The recording, the surveyed places of two microphones exchanged if asked."""
    found = recording(data)
    motion = ConstantVelocity(0.5) + RandomWalk("emission", "m", DRIFT, (0.0, 30.0))
    return Problem(network(places(data), swap), motion, table(found["tphat"]))


def truth(data=None, swap=None):
    """The car's track by motion capture, and the biases that a swap puts in."""
    track = recording(data)["position"]
    track = track[np.isfinite(track).all(1)]
    columns = {"time": track[:, 0] - CLOCK, "position_x": track[:, 1] / 1000, "position_y": track[:, 2] / 1000}
    surveyed = places(data)
    stated = np.stack([node.position for node in network(surveyed, swap).nodes])
    shift = surveyed - stated
    biases = {f"mic_{n + 1}.position_{axis}": float(shift[n, k]) for n in range(8) for k, axis in enumerate("xy")}
    return Truth(pd.DataFrame(columns), biases)
