"""Eight microphones hear the chirps of a radio-controlled car; two may have been surveyed the wrong way round.

Recordings of a student laboratory (course TSRT14, Linköping University, 2026, https://github.com/Aadak9/TSRT14,
folder "Lab 1/SFlab1"). The repository has no licence: not shipped, give the path of `dataset_1_exp2.mat` (the one
with motion capture) or of another recording with `tphat` and `mic_locations`.

A row is the arrival time of a chirp times the speed of sound: distance + emission range + clock. The emission of
every chirp is unknown and taken off roughly by the median of the arrivals. Microphones 1-4 stand around the arena,
5-8 nearly on one line at its side. Echoes come in runs of several chirps (a fifth of the rows is off by more than
0.3 m): the noise is heavy-tailed and of unknown level, and `PRIOR` has one precision for the place of a microphone
and keeps it only where the data call for it loudly: `fit(problem(path, swap=(1, 4)), EA(), prior=PRIOR)`. Nothing
else ties the frame than that most microphones stand where they were surveyed.
"""

from pathlib import Path

import numpy as np
import pandas as pd
import scipy.io

from probcal import ARD, ConstantVelocity, InputError, Network, Node, Problem, StudentT, Truth, Unknown, White
from probcal import Channel, sensor
from probcal.geometry import norm

SPEED = 343.0  # m/s
HEARD = 3.0  # m; a column whose arrivals spread further about their median is no chirp
LATE = 0.16  # s from the audio clock to that of the motion capture
PRIOR = ARD(shape=4.0, by="node")


@sensor(arrival=Channel("m", std=Unknown(0.1), noise=StudentT(4)))
def microphone(target, pose):
    """Arrival time of a chirp times the speed of sound."""
    return dict(arrival=norm(target.position - pose.position) + target.emission + pose.clock)


def read(data):
    """Arrival times (8, chirps) in s, positions of the microphones (8, 2) in m, and the track (T, 3) in s, mm."""
    if data is None:
        raise InputError(
            "sflab.py needs a recording: download dataset_1_exp2.mat from https://github.com/Aadak9/TSRT14, folder "
            '"Lab 1/SFlab1", and give its path'
        )
    if not Path(data).is_file():
        raise InputError(f"{data} is not a file; give the path of dataset_1_exp2.mat")
    found = scipy.io.loadmat(data)
    return found["tphat"], np.ravel(found["mic_locations"]).reshape(-1, 2), found["position"]


def table(data):
    """Rows of the columns that hold a chirp: time, sensor, arrival in m about the median of the chirp."""
    arrival = read(data)[0]
    time = np.median(arrival, axis=0)
    distance = SPEED * (arrival - time)
    chirps = np.flatnonzero(np.median(np.abs(distance), axis=0) < HEARD)
    names = [f"mic_{n}" for n in range(1, len(arrival) + 1)]
    parts = [pd.DataFrame({"time": time[k], "sensor": names, "arrival": distance[:, k]}) for k in chirps]
    return pd.concat(parts, ignore_index=True)


def places(data, swap=()):
    """Surveyed positions (8, 2), those of the two microphones in `swap` exchanged."""
    found = read(data)[1]
    order = np.arange(len(found))
    chosen = [n - 1 for n in swap]
    order[chosen] = order[chosen[::-1]]
    return found[order]


def problem(data=None, swap=()):
    """The recording in the file `data`; `swap` exchanges the surveyed positions of two microphones, as in `(5, 8)`."""
    nodes = [
        Node(f"mic_{n}", place, scale={"position": 1.0}, survey={"clock": 0.05})
        for n, place in enumerate(places(data, swap), 1)
    ]
    motion = ConstantVelocity(Unknown(0.3)) + White("emission", "m", 10.0)
    return Problem(Network([microphone.on(node) for node in nodes]), motion, table(data))


def truth(data=None, swap=()):
    """Track of the car, where it was recorded, and what undoes the swap."""
    track = read(data)[2]
    tracks = None
    if len(track):
        track = pd.DataFrame(track, columns=["time", "position_x", "position_y"]).dropna()
        tracks = track.assign(time=track["time"] - LATE, position_x=track["position_x"] / 1e3, position_y=track["position_y"] / 1e3)  # fmt: skip # noqa: E501
    shift = places(data) - places(data, swap)
    biases = {f"mic_{n}.position_{axis}": float(v) for n, row in enumerate(shift, 1) for axis, v in zip("xy", row, strict=True)}  # fmt: skip # noqa: E501
    return Truth(tracks, biases)
