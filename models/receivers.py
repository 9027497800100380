"""GPS-synchronised Mode-S receivers and the aircraft that report their own position: the delay of each receiver.

Example data of LocaRDS (M. Schäfer, M. Strohmeier, M. Leonardi, V. Lenders, "LocaRDS: A Localization Reference Data
Set", Sensors 21(16), 2021, https://zenodo.org/record/4739276; CC BY-SA): messages that five receivers heard, with
the position that the aircraft sent along. Not shipped: give one `set_N.csv` that lies beside `sensors.csv`.

A row is the arrival time of a message at a receiver times the propagation speed: distance + emission range + delay.
The emission of every message is unknown, the position is known to some metres: a message tells the differences of
the delays of its receivers. The receivers fall into two groups that never hear the same message; in each the one with
the most rows is the reference and its delay is fixed at 0.
"""

import json
from pathlib import Path

import numpy as np
import pandas as pd

from probcal import (
    Bias,
    Channel,
    InputError,
    Known,
    LocalFrame,
    Network,
    Node,
    Problem,
    StudentT,
    Unknown,
    White,
    sensor,
)
from probcal.geometry import norm

SPEED = 299_792_458 / 1.0003  # m/s, in air
ROWS = 20  # a receiver with fewer rows is left out
EMISSION = 1e3  # m, spread of the emission ranges about what the loader takes off


@sensor(arrival=Channel("m", std=Unknown(20.0), noise=StudentT(2)))
def receiver(target, pose, *, delay=Bias("m", 30.0)):
    """Arrival time of a message times the propagation speed, with the delay of the receiver's electronics."""
    return dict(arrival=norm(target.position - pose.position) + target.emission + delay)


def read(data, name=None):
    """The table of one set, or the file `name` beside it."""
    if data is None:
        raise InputError(
            "receivers.py needs a recording: download the LocaRDS example data (https://zenodo.org/record/4739276) and "
            "give the path of one set_N.csv that lies beside sensors.csv"
        )
    file = Path(data) if name is None else Path(data).with_name(name)
    if not file.is_file():
        raise InputError(f"{file}: no such file; give one set_N.csv of LocaRDS that lies beside sensors.csv")
    return pd.read_csv(file)


def messages(data):
    """Rows (message, serial, arrival in m since the first receiver) and reports (by message) of a set."""
    reports = read(data).drop_duplicates(["aircraft", "timeAtServer"]).set_index("id")
    heard = [(message, *each) for message, text in reports["measurements"].items() for each in json.loads(text)]
    rows = pd.DataFrame(heard, columns=["message", "serial", "time", "strength"])
    first = rows.groupby("message")["time"].transform("min")  # ns since a common start: a huge number
    return rows.assign(arrival=(rows["time"] - first) * 1e-9 * SPEED).drop(columns=["time", "strength"]), reports


def groups(rows):
    """Group number of each receiver: those that share messages, directly or through others."""
    number = {serial: serial for serial in rows["serial"].unique()}
    for _, serials in rows.groupby("message")["serial"]:
        joined = {number[serial] for serial in serials}
        number = {serial: min(joined) if n in joined else n for serial, n in number.items()}
    return number


def problem(data=None):
    """One set of messages; the receiver with the most rows of each group is held at delay 0."""
    rows, reports = messages(data)
    rows = rows[rows.groupby("serial")["serial"].transform("size") >= ROWS]
    rows = rows[rows.groupby("message")["message"].transform("size") >= 2]
    reports = reports.loc[reports.index.isin(rows["message"])]
    stations = read(data, "sensors.csv").set_index("serial").loc[sorted(rows["serial"].unique())]
    frame = LocalFrame(stations["latitude"].mean(), stations["longitude"].mean())
    place = frame.to_local(stations["latitude"], stations["longitude"], stations["height"])
    station = dict(zip(stations.index, place, strict=True))
    nodes = [Node(f"receiver_{serial}", position) for serial, position in station.items()]

    spot = frame.to_local(reports["latitude"], reports["longitude"], reports["geoAltitude"])
    spot = pd.DataFrame(spot, reports.index, ["position_x", "position_y", "position_z"])
    spot = spot.assign(time=reports["timeAtServer"], target="aircraft_" + reports["aircraft"].astype(str))
    motions = {
        name: Known(track.sort_values("time").drop(columns="target")) + White("emission", "m", EMISSION)
        for name, track in spot.groupby("target")
    }

    distance = spot.loc[rows["message"]].filter(like="position").to_numpy() - np.stack(rows["serial"].map(station))
    late = rows["arrival"] - np.linalg.norm(distance, axis=1)
    table = rows.merge(spot[["time", "target"]], left_on="message", right_index=True)
    table["arrival"] -= late.groupby(rows["message"]).transform("median")
    table["sensor"] = "receiver_" + table["serial"].astype(str)

    count, number = rows["serial"].value_counts(), groups(rows)
    references = {max((s for s in number if number[s] == n), key=count.get) for n in set(number.values())}
    return Problem(
        Network([receiver.on(node) for node in nodes], frame=frame),
        motions,
        table[["time", "sensor", "target", "arrival"]],
        fix=[f"receiver_{serial}.delay" for serial in sorted(references)],
    )
