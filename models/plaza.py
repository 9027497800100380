"""Plaza 2: radio ranges between a lawn mower and four surveyed beacons; the bias is a range scale of 7 %.

Real recording of J. Djugash, B. Hamner, S. Roth, "Navigating with Ranging Radios: Five Data Sets with Ground
Truth", Journal of Field Robotics 2009; the GPS track is used for scoring only. See `models/data/README.md`.
"""

from pathlib import Path

from probcal import Bias, Channel, ConstantVelocity, Network, Node, Problem, StudentT, Truth, Unknown, sensor
from probcal.geometry import norm

HERE = Path(__file__).parent / "data"
BEACONS = {
    "beacon_0": (-33.620537, 26.967797),
    "beacon_1": (-68.926537, 18.377797),
    "beacon_5": (1.709463, -5.812203),
    "beacon_6": (-37.580537, 69.227797),
}
SURVEY = 0.02  # m, of the beacon positions
MOTION = ConstantVelocity(Unknown(1.0))  # nobody knows how sharply a mower turns, and the size of the scene hangs on it


@sensor(range=Channel("m", std=0.55, noise=StudentT(4)))
def radio(target, pose, *, range_offset=Bias("m", 1.0), range_scale=Bias("1", 0.1)):
    """Radio range: the clock of each beacon stretches it, the electronics shift it."""
    return dict(range=(1 + range_scale) * norm(target.position - pose.position) + range_offset)


def network(survey=SURVEY, scale=None):
    """Four beacons with a radio each; `scale` frees their positions instead of the survey."""
    spread = {"survey": survey} if scale is None else {"scale": scale}
    return Network([radio.on(Node(name, position, **spread)) for name, position in BEACONS.items()])


def problem(data=None):
    """The recording, or another one with the same beacons (columns time, sensor, range)."""
    return Problem(network(), MOTION, HERE / "plaza_ranges.csv" if data is None else data)


def truth(data=None):
    """GPS track of the mower (about 2 cm) and the range scales regressed on it."""
    scales = {"beacon_1": 0.0697, "beacon_6": 0.0689, "beacon_0": 0.0687, "beacon_5": 0.0693}
    return Truth(tracks=HERE / "plaza_gps.csv", biases={f"{k}.range_scale": v for k, v in scales.items()})
