"""Networks whose biases are drawn from what they declare: does an answer hold the truth as often as it says?

`setting(run, network, share)` is for studies, one network at a time:

    probcal study models/networks.py --set network=beacons --method ea --method ea-printed --method em-ea --runs 100

- beacons: six range beacons with offsets and scales, four of them displaced by about 2 m;
- clocks: six arrival-time receivers with clocks of about 3 m, three displaced, emission times unknown;
- pass: four radars that see one straight pass;
- signal: eight signal-strength receivers whose gains share a loss of about 4 dB that nobody knows (every bias counts);
- line: four range beacons on one line, two of them free; the target on the other side of it fits as well;
- ceiling: six range anchors at one height above a drone (3-D), two of them free: the drone above them fits as well;
- beside: seven range beacons at both sides of a path that bends by 2 m, four of them surveyed to 6 m: which of these
  stand on which side of it hangs on that bend;
- corners: the beacons, and a target that goes straight and turns five times; with `tails="student"` its process noise
  has heavy tails, as the motion has;
- bearings: six cameras surveyed to 2 m with free headings, where motion noise alone tells the size of the scene.
"""

from fnmatch import fnmatch

import numpy as np

from probcal import (
    Bias,
    Channel,
    ConstantVelocity,
    Network,
    Node,
    Problem,
    RandomWalk,
    StudentT,
    Target,
    Truth,
    Unknown,
    White,
    sensor,
    simulate,
)
from probcal.geometry import bearing, norm
from probcal.noise import Normal
from probcal.sensors import radar, ranger, rss, toa

NAMES = ("beacons", "clocks", "pass", "signal", "bearings", "line", "ceiling", "beside", "corners")
FIXED = {"line": ("*.range_scale", "*.range_offset")}
CAMERAS = np.array([(0, 0), (60, 0), (60, 40), (0, 40), (30, -10), (30, 50)], float)


@sensor(range=Channel("m", std=0.1))
def anchor(target, pose, *, range_offset=Bias("m", 0.3)):
    """Range of an ultra-wideband anchor."""
    return dict(range=norm(target.position - pose.position) + range_offset)


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


def _line():
    scales = {1: {"position": 3.0}, 2: {"position": 3.0}}
    return Network([ranger.on(Node(f"b{k}", (30.0 * k, 0.0), scale=scales.get(k))) for k in range(4)])


def _ceiling():
    places = [(0, 0, 3), (10, 0, 3), (10, 8, 3), (0, 8, 3), (5, 0, 3), (5, 8, 3)]
    scales = {4: {"position": 0.5}, 5: {"position": 0.5}}
    return Network([anchor.on(Node(f"a{k}", p, scale=scales.get(k))) for k, p in enumerate(places)])


def _beside():
    places = [(0, 10), (40, -14), (80, 12), (120, -9), (60, 40), (20, -40), (100, -38)]
    scales = [{"position": 6.0} if k < 4 else None for k in range(7)]
    return Network([ranger.on(Node(f"b{k}", p, scale=s)) for k, (p, s) in enumerate(zip(places, scales, strict=True))])


NETWORKS = {"beacons": _beacons, "clocks": _clocks, "pass": _pass, "signal": _signal, "bearings": _bearings}
NETWORKS |= {"line": _line, "ceiling": _ceiling, "beside": _beside, "corners": _beacons}


STEPS = {"beacons": 0.5, "clocks": 0.5, "pass": 0.3, "signal": 0.3, "bearings": 0.03, "line": 0.5, "ceiling": 0.5}
STEPS |= {"beside": 0.5}
TAILS = {"gaussian": Normal(), "student": StudentT(4.0), "heavy": StudentT(2.0)}


def motion(network, noise=None, tails="gaussian"):
    """The motion of the target of a network, and of what it sends out; another process noise if given."""
    if network == "corners":
        return ConstantVelocity(Unknown(0.3), noise=TAILS[tails])
    own = ConstantVelocity(STEPS[network] if noise is None else noise)
    if network == "clocks":
        return own + White("emission", "m", 100.0)
    return own + RandomWalk("power", "dB", 0.1, (40.0, 10.0)) if network == "signal" else own


def _path(network, time, rng):
    """States of the target by component."""
    t = time
    if network == "bearings":
        return _wander(t, rng)
    if network == "corners":
        return _corners(t, rng)
    place = {
        "beacons": (40 + 30 * np.cos(t / 7), 22 + 16 * np.sin(t / 4.5)),
        "clocks": (35 + 22 * np.cos(t / 9), 28 + 20 * np.sin(t / 6)),
        "pass": (-20 + 2.8 * t, 35 + 0.4 * t),
        "signal": (5 + 1.2 * t, 50 + 35 * np.sin(t / 9)),
        "beside": (-10 + 2.3 * t, 2 * np.sin(t / 9)),
        "line": (-10 + 1.9 * t, 15 + 8 * np.sin(t / 8)),
        "ceiling": (5 + 3 * np.cos(t / 3), 4 + 2.5 * np.sin(t / 2.2), 1.2 + 0.5 * np.sin(t / 4)),
    }[network]
    found = {f"position_{axis}": column for axis, column in zip("xyz", place, strict=False)}
    return found | ({"power": 40.0 + 0 * t} if network == "signal" else {})


def _corners(time, rng):
    """Straight at 2.5 m/s, and five turns of a right angle within 2 s, always back towards the beacons."""
    place, angle, rate, found = np.array([15.0, 10.0]), 0.4, 0.0, []
    turns = np.linspace(time[0], time[-1], 7)[1:-1] + rng.uniform(-3.0, 3.0, 5)
    for before, now in zip([time[0], *time[:-1]], time, strict=True):
        new = [t for t in turns if before < t <= now]
        if new:
            away = np.array([40.0, 22.0]) - place
            side = np.cos(angle) * away[1] - np.sin(angle) * away[0]
            rate, left = np.copysign(np.pi / 4, side), 2.0
        if rate:
            angle, left = angle + rate * (now - before), left - (now - before)
            rate = rate if left > 1e-9 else 0.0
        place = place + 2.5 * (now - before) * np.array([np.cos(angle), np.sin(angle)])
        found.append(place)
    return dict(zip(("position_x", "position_y"), np.array(found).T, strict=True))


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


def times(network):
    """Times of the measurements of a network."""
    steps = {"beacons": (100, 0.5), "bearings": (400, 0.5), "line": (120, 0.5), "ceiling": (150, 0.2)}
    steps |= {"corners": (120, 0.5), "beside": (120, 0.5)}
    count, step = steps.get(network, (80, 1.0))
    return step * np.arange(count)


def recording(network="beacons", run=0, share=0.3):
    """The network, and table and truth of one run: a share of the biases drawn at their scales, surveys always."""
    rng = np.random.default_rng(1000 + run)
    placed, time = NETWORKS[network](), times(network)
    biases = {
        bias.label: float(bias.scale * rng.normal()) if bias.kind == "survey" or rng.uniform() < share else 0.0
        for bias in placed.biases
        if not any(fnmatch(bias.label, pattern) for pattern in FIXED.get(network, ()))
    }
    if network == "signal":
        loss = 4.0 * rng.normal()
        biases |= {label: loss + 0.3 * rng.normal() for label in biases if label.endswith("gain")}
    path = pd_frame(_path(network, time, rng))
    return placed, simulate(placed, motion(network), time, key=run, biases=biases, tracks={"target": path})


def own_path(network="beacons", run=0, share=0.3, noise=0.05):
    """Problem and truth of one run whose path is drawn from its motion too, from a start that is declared."""
    placed, rng = NETWORKS[network](), np.random.default_rng(run)
    middle = np.mean([node.position for node in placed.nodes], 0)
    begin = {"position": (tuple(middle + rng.uniform(-15, 15, 2)), 1.0), "velocity": ((0.0, 0.0), 0.5)}
    target = Target(motion(network, noise), begin)
    drawn = simulate(placed, target, times(network), key=run, share=share)
    return Problem(placed, target, drawn.table), drawn.truth


def pd_frame(columns):
    """Columns as the table that `simulate` takes for a track."""
    import pandas as pd

    return pd.DataFrame(columns)


def setting(run=0, network="beacons", share=0.3, tails="gaussian"):
    """Problem and truth of one run of a study."""
    placed, drawn = recording(network, run, share)
    return Problem(placed, motion(network, tails=tails), drawn.table, fix=FIXED.get(network, ())), drawn.truth


def problem(data=None):
    """The beacons, with the simulated table of run 0 if none is given."""
    return setting()[0] if data is None else Problem(_beacons(), motion("beacons"), data)


def scenario(key=0):
    """Table and truth of the beacons."""
    return recording(run=key)[1]


def truth(data=None):
    """Truth of run 0; a table written by `probcal simulate` brings its own beside it."""
    return scenario().truth if data is None else Truth()
