"""Nine microphones beside a road and one passing vehicle: the twin of scenario C3 of Paper C, simulated.

Sound pressure levels (Paper C 48-54) of a vehicle whose sound power is known to 1 dB at first and drifts. Biases:
x and y of a microphone (7.5 m) and its gain (0.05); y of microphone 1 is off by 15 m in every run. Microphones 3,
6 and 7 are known, so that ML has an answer. Noise 2 dB, 81 levels each; the start is known to 1 m and 1 m/s. What
the paper leaves open: the places (its recording is not public), the path, two levels a second, process noise
1 m s^-3/2 and 0.1 dB s^-1/2.

The methods of the paper side by side (position and gain errors are in `error`, over their scales):

    probcal study models/microphones.py --methods em-ml,em,em-ea --runs 50 --out microphones-study
"""

import numpy as np
import pandas as pd

from probcal import ConstantVelocity, Network, Node, Problem, RandomWalk, Target, Truth, simulate
from probcal.sensors import sound

PLACES = {
    1: (20.0, 50.0), 2: (48.0, 8.0), 3: (72.0, 40.0), 4: (104.0, 12.0), 5: (128.0, 47.0),
    6: (156.0, 16.0), 7: (44.0, 78.0), 8: (88.0, 78.0), 9: (146.0, 80.0),
}  # fmt: skip
KNOWN = (3, 6, 7)
POSITION, GAIN = 7.5, 0.05
TIME = 0.5 * np.arange(81)  # s
POWER, DRIFT = 102.5, 0.1  # dB, dB s^-1/2
START = {"position": 1.0, "velocity": 1.0, "power": 1.0}
FIXED = tuple(f"mic_{n}.gain" for n in KNOWN)


def network():
    """The microphones at their stated places; three of them are known."""
    free = {"position": POSITION}
    return Network([sound.on(Node(f"mic_{n}", p, scale=None if n in KNOWN else free)) for n, p in PLACES.items()])


def path():
    """True states of the vehicle but for its power: through the network at 4 m/s, in a bend."""
    u = TIME / TIME[-1]
    position = np.stack([5 + 160 * u, 26 + 38 * np.sin(2.2 * u) ** 2], 1)
    velocity = np.gradient(position, TIME, axis=0)
    columns = ["position_x", "position_y", "velocity_x", "velocity_y"]
    return pd.DataFrame(np.hstack([position, velocity]), columns=columns)


def motion():
    """Constant velocity and a drifting sound power, the start known as the paper says (52, 54)."""
    first = path().iloc[0].to_numpy()
    start = {"position": (first[:2], START["position"]), "velocity": (first[2:], START["velocity"])}
    power = RandomWalk("power", "dB", DRIFT, (POWER, START["power"]))
    return Target(ConstantVelocity(1.0) + power, start)


def biases(key=0):
    """True biases of a run: drawn from their scales, microphone 1 moved by 15 m along y."""
    random = np.random.default_rng(key)
    drawn = {b.label: b.scale * random.standard_normal() for b in network().biases}
    return drawn | dict.fromkeys(FIXED, 0.0) | {"mic_1.position_y": 15.0}


def scenario(key=0):
    """Table and truth of one run."""
    return simulate(network(), motion(), TIME, key=key, biases=biases(key), tracks={"target": path()})


def problem(data=None):
    """The network with a table of its own (columns time, sensor, level), or that of run 0."""
    return Problem(network(), motion(), scenario().table if data is None else data, fix=FIXED)


def setting(run=0):
    """Problem and truth of one run of a study."""
    drawn = scenario(run)
    return problem(drawn.table), drawn.truth


def truth(data=None):
    """Truth of run 0; a table written by `probcal simulate` brings its own beside it."""
    return scenario().truth if data is None else Truth()
