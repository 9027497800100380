"""Networks whose biases are drawn from what they declare: does an answer hold the truth as often as it says?

`setting(run, network, share)` is for studies, one network at a time:

    probcal study models/networks.py --set network=beacons --method ea --method ea-printed --method em-ea --runs 100

- beacons: six range beacons with offsets and scales, four of them displaced by about 2 m;
- clocks: six arrival-time receivers with clocks of about 3 m, three displaced, emission times unknown;
- pass: four radars that see one straight pass;
- signal: eight signal-strength receivers whose gains share a loss of about 4 dB that nobody knows (every bias counts);
- bearings: six cameras surveyed to 2 m with free headings, where motion noise alone tells the size of the scene.
"""

import numpy as np

from probcal import Channel, ConstantVelocity, Network, Node, Problem, RandomWalk, Truth, White, sensor, simulate
from probcal.geometry import bearing
from probcal.sensors import radar, ranger, rss, toa

NAMES = ("beacons", "clocks", "pass", "signal", "bearings")
CAMERAS = np.array([(0, 0), (60, 0), (60, 40), (0, 40), (30, -10), (30, 50)], float)


@sensor(azimuth=Channel("rad", std=0.02, wrap=True))
def camera(target, pose):
    """Azimuth from a node of unknown heading."""
    return dict(azimuth=bearing(target.position - pose.position) - pose.heading)


def _beacons():
    places = [(0, 0), (40, 0), (80, 5), (0, 40), (45, 45), (80, 42)]
    scales = [None if k in (0, 2) else {"position": 2.0} for k in range(6)]
    return Network([ranger.on(Node(f"b{k}", p, scale=s)) for k, (p, s) in enumerate(zip(places, scales, strict=True))])


def _clocks():
    places = [(0, 0), (60, 5), (70, 60), (5, 55), (30, -5), (35, 62)]
    free = [None, *[{"clock": 3.0, "position": 1.0}] * 3, *[{"clock": 3.0}] * 2]
    return Network([toa.on(Node(f"m{k}", p, scale=s)) for k, (p, s) in enumerate(zip(places, free, strict=True))])


def _pass():
    places = [(0, 0), (90, 10), (20, 80), (100, 90)]
    return Network([radar.on(Node(f"r{k}", p, scale={"heading": np.deg2rad(5.0)})) for k, p in enumerate(places)])


def _signal():
    places = np.random.default_rng(0).uniform(0, 100, (8, 2))
    return Network([rss.on(Node(f"r{k}", p)) for k, p in enumerate(places)])


def _bearings(places=CAMERAS):
    return Network(
        [camera.on(Node(f"c{k}", p, survey={"position": 2.0}, scale={"heading": 0.05})) for k, p in enumerate(places)]
    )


NETWORKS = {"beacons": _beacons, "clocks": _clocks, "pass": _pass, "signal": _signal, "bearings": _bearings}


def motion(network):
    """The motion of the target of a network, and of what it sends out."""
    steps = {"beacons": 0.5, "clocks": 0.5, "pass": 0.3, "signal": 0.3, "bearings": 0.03}
    own = ConstantVelocity(steps[network])
    if network == "clocks":
        return own + White("emission", "m", 100.0)
    return own + RandomWalk("power", "dB", 0.1, (40.0, 10.0)) if network == "signal" else own


def _path(network, time, rng):
    """States of the target by component."""
    t = time
    if network == "bearings":
        return _wander(t, rng)
    place = {
        "beacons": (40 + 30 * np.cos(t / 7), 22 + 16 * np.sin(t / 4.5)),
        "clocks": (35 + 22 * np.cos(t / 9), 28 + 20 * np.sin(t / 6)),
        "pass": (-20 + 2.8 * t, 35 + 0.4 * t),
        "signal": (5 + 1.2 * t, 50 + 35 * np.sin(t / 9)),
    }[network]
    found = {"position_x": place[0], "position_y": place[1]}
    return found | ({"power": 40.0 + 0 * t} if network == "signal" else {})


def _wander(time, rng):
    """A path from the motion itself."""
    dt, q = time[1] - time[0], 0.03
    step = np.eye(4) + dt * np.eye(4, k=2)
    root = np.linalg.cholesky(q**2 * np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(2)))
    x, found = np.array([30.0, 20.0, 0.2, -0.1]), []
    for _ in time:
        x = step @ x + root @ rng.normal(size=4)
        found.append(x)
    return dict(zip(("position_x", "position_y", "velocity_x", "velocity_y"), np.array(found).T, strict=True))


def recording(network="beacons", run=0, share=0.3):
    """The network, and table and truth of one run: a share of the biases drawn at their scales, surveys always."""
    rng = np.random.default_rng(1000 + run)
    placed = NETWORKS[network]()
    time = {"beacons": 0.5 * np.arange(100), "bearings": 0.5 * np.arange(400)}.get(network, np.arange(80.0))
    biases = {
        bias.label: float(bias.scale * rng.normal()) if bias.kind == "survey" or rng.uniform() < share else 0.0
        for bias in placed.biases
    }
    if network == "signal":
        loss = 4.0 * rng.normal()
        biases |= {label: loss + 0.3 * rng.normal() for label in biases if label.endswith("gain")}
    path = pd_frame(_path(network, time, rng))
    return placed, simulate(placed, motion(network), time, run, biases=biases, tracks={"target": path})


def pd_frame(columns):
    """Columns as the table that `simulate` takes for a track."""
    import pandas as pd

    return pd.DataFrame(columns)


def setting(run=0, network="beacons", share=0.3):
    """Problem and truth of one run of a study."""
    placed, drawn = recording(network, run, share)
    return Problem(placed, motion(network), drawn.table), drawn.truth


def problem(data=None):
    """The beacons, with the simulated table of run 0 if none is given."""
    return setting()[0] if data is None else Problem(_beacons(), motion("beacons"), data)


def scenario(key=0):
    """Table and truth of the beacons."""
    return recording(run=key)[1]


def truth(data=None):
    """Truth of run 0; a table written by `probcal simulate` brings its own beside it."""
    return scenario().truth if data is None else Truth()
