"""Five robots on known paths range and point a camera at fifteen landmarks whose places nobody gave us.

UTIAS MRCLAM data set 6 (K. Leung, Y. Halpern, T. Barfoot, H. Liu, "The UTIAS multi-robot cooperative localization
and mapping dataset", International Journal of Robotics Research 2011, http://asrl.utias.utoronto.ca/datasets/mrclam),
free for research with citation, no formal licence: not shipped, give the folder of its files.

The poses of the robots come from motion capture and are known. Unknown are the range offset of each robot, its
heading (its camera points off; a bearing bias is minus the heading bias), and the place of every landmark. The
landmarks were surveyed too, for scoring only. Noise is heavy-tailed (up to 4 % gross outliers), its level unknown.
"""

from pathlib import Path as File

import numpy as np
import pandas as pd

from probcal import Bias, Channel, InputError, Network, Node, Path, Problem, Static, StudentT, Truth, Unknown, sensor
from probcal.geometry import bearing, norm

ROBOTS = (1, 2, 3, 4, 5)
LANDMARKS = range(6, 21)
HZ = 20.0  # poses a second that are kept of the 100 in the files
HEADING = np.deg2rad(2.0)  # scale of the heading biases


@sensor(
    range=Channel("m", std=Unknown(0.1), noise=StudentT(4)),
    azimuth=Channel("rad", std=Unknown(np.deg2rad(0.5)), noise=StudentT(4), wrap=True),
)
def camera(target, pose, *, range_offset=Bias("m", 0.1)):
    """Range from the apparent size of a barcode and its azimuth in the image."""
    line = target.position - pose.position
    return dict(range=norm(line) + range_offset, azimuth=bearing(line) - pose.heading)


def read(data, name):
    """Columns of one file of the data set, plain or compressed."""
    if data is None:
        raise InputError(
            "robots.py needs a recording: download MRCLAM data set 6 (http://asrl.utias.utoronto.ca/datasets/mrclam) "
            "and give the path of its folder, MRCLAM_Dataset6"
        )
    for file in (File(data) / f"{name}.dat", File(data) / f"{name}.dat.gz"):
        if file.is_file():
            return np.loadtxt(file)
    raise InputError(f"{data}: there is no {name}.dat in it; give the folder of an MRCLAM data set")


def robot(data, number, turn=0.0):
    """A robot on its known path, its heading stated wrong by `turn` (rad)."""
    time, x, y, heading = read(data, f"Robot{number}_Groundtruth").T
    kept = np.unique(np.searchsorted(time, [*np.arange(time[0], time[-1], 1 / HZ), time[-1]]))
    path = Path(time[kept], np.stack([x, y], 1)[kept], np.unwrap(heading)[kept])
    return Node(f"robot_{number}", path=path, heading=turn, scale={"heading": HEADING})


def table(data):
    """Rows of all robots that see a landmark: time, sensor, target, range, azimuth."""
    subject = {int(code): int(who) for who, code in read(data, "Barcodes")}
    parts = []
    for number in ROBOTS:
        frame = pd.DataFrame(read(data, f"Robot{number}_Measurement"), columns=["time", "code", "range", "azimuth"])
        who = frame["code"].map(subject)
        frame = frame.assign(sensor=f"robot_{number}", target=who.map("landmark_{:.0f}".format))[who.isin(LANDMARKS)]
        parts.append(frame.drop(columns="code").drop_duplicates(["time", "target"]))
    return pd.concat(parts, ignore_index=True)


def problem(data=None, turn=None):
    """The recording in the folder `data`; `turn` states headings wrong, as in `{"robot_2": np.deg2rad(5)}`."""
    turn = turn or {}
    network = Network([camera.on(robot(data, n, turn.get(f"robot_{n}", 0.0))) for n in ROBOTS])
    return Problem(network, Static(), table(data))


def truth(data=None, turn=None):
    """Surveyed landmarks, and the biases of each robot: medians over its rows, given those landmarks."""
    landmarks = {int(row[0]): row[1:3] for row in read(data, "Landmark_Groundtruth")}
    tracks = [{"time": 0.0, "target": f"landmark_{n}", "position_x": x, "position_y": y}
              for n, (x, y) in landmarks.items()]  # fmt: skip
    rows, biases = table(data), {}
    place = {f"landmark_{n}": xy for n, xy in landmarks.items()}
    for n in ROBOTS:
        mine = rows[rows["sensor"] == f"robot_{n}"]
        position, heading = robot(data, n).path.at(mine["time"].to_numpy())
        line = np.stack(mine["target"].map(place)) - position
        azimuth = mine["azimuth"] - np.arctan2(line[:, 1], line[:, 0]) + heading
        biases[f"robot_{n}.range_offset"] = float(np.median(mine["range"] - np.hypot(*line.T)))
        wrapped = (azimuth + np.pi) % (2 * np.pi) - np.pi
        biases[f"robot_{n}.heading"] = -float(np.median(wrapped)) - (turn or {}).get(f"robot_{n}", 0.0)
    return Truth(pd.DataFrame(tracks), biases)
