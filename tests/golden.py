"""The golden table: what every method answers to small problems, written down, so that a change of any answer is seen.

`uv run python tests/golden.py` makes every row anew, prints those that moved and ends with 1 where there are some;
`--only PATTERN` takes the rows whose name ("radars ea") holds the pattern, `--write` writes them. A row that changes
needs its reason in the commit. Everything here is the public interface: problems as a user declares them, the verbs,
and the readers of results.

A problem is a function with `@world("names of rows")`; a row is a fit of `FITS` or a function with `@verb(tolerance)`.
How far a number may move says the tolerance of its row:

- "point": evaluated at a given point, without a search; 1e-9 of its size.
- "climb": the end of a search; 0.02 sd, and 0.02 of a number that has no sd.
- "draws": by Monte Carlo; four standard errors of the difference.

Statuses, verdicts and findings must be the same.
"""

import argparse
import fnmatch
import json
import multiprocessing
import os
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path
from typing import Any, NamedTuple

# as the tests compile: quickly, and with kernels kept
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".pytest_cache" / "kernels"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "0")

import numpy as np
import pandas as pd
from terminal import call

import probcal as pc
from probcal.geometry import bearing, norm
from probcal.results.modes import rivals

DATA = Path(__file__).parent / "data"
TABLE = DATA / "golden.json"
POINT = 1e-9  # of the size of a number: most that it may move where nothing is searched for
CLIMB = 0.02  # sd, or a part of a number that has none: most that the end of a search may move
DRAWS = 4.0  # standard errors of the difference: most that numbers from draws may move
INVALID = ("at bound", "diverged", "along a gauge", "misfit")  # statuses of fits whose numbers are no estimate
DIGITS = {"point": 13, "climb": 7, "draws": 7}  # that the table holds


@dataclass(frozen=True, eq=False)
class World:
    """A problem as it is declared, and its truth."""

    network: pc.Network
    motion: Any
    table: pd.DataFrame
    truth: pc.Truth | None = None
    settings: dict[str, Any] = field(default_factory=dict)

    @cached_property
    def problem(self):
        return pc.Problem(self.network, self.motion, self.table, **self.settings)


class Fit(NamedTuple):
    """A method with its prior, the method's own where there is none, and the tolerance of its rows.

    A method of a wing is a function that makes it.
    """

    tolerance: str
    method: Any
    prior: Any = None
    starts: int = 1


class Verb(NamedTuple):
    """A row that is no fit: a function of the name of a problem, and its tolerance."""

    tolerance: str
    function: Callable[[str], dict[str, Any]]


WORLDS: dict[str, tuple[Callable[[], World], tuple[str, ...]]] = {}
VERBS: dict[str, Verb] = {}


def world(rows):
    """Enter a problem with the names of its rows."""

    def enter(make):
        WORLDS[make.__name__] = cache(make), tuple(rows.split())
        return make

    return enter


def verb(tolerance):
    """Enter a row that is no fit."""

    def enter(function):
        VERBS[function.__name__.replace("_", "-")] = Verb(tolerance, function)
        return function

    return enter


# Problems. Most share three sensors and eight epochs, so that they share kernels.

TIME = 2.0 * np.arange(8)
PLACES = {"a": (0.0, 0.0), "b": (400.0, 0.0), "c": (200.0, 300.0)}
WAY = np.stack([np.linspace(50, 350, 8), 120 + 40 * np.sin(TIME / 8)], 1)
BACK = np.stack([np.linspace(320, 80, 8), 220 - 40 * np.cos(TIME / 8)], 1)
DRIVE = pc.ConstantVelocity(1.0)
START = {"position": ((60.0, 120.0), 20.0), "velocity": ((20.0, 10.0), 10.0)}
BIASES = {"b.heading": 0.12, "c.range_offset": 8.0}
LOOSE = {"position": 5.0, "heading": 0.1}


@pc.sensor(range=pc.Channel("m", std=1.0), azimuth=pc.Channel("rad", std=0.02, wrap=True))
def scope(target, pose, *, range_offset=pc.Bias("m", 5.0)):
    """Range with an offset, and azimuth in the node's axes."""
    line = pose.local(target.position)
    return dict(range=norm(line) + range_offset, azimuth=bearing(line))


def nodes(scale, survey=None, known="a"):
    """The three nodes: `known` as stated, the others with biases of some scale, or with a survey."""
    loose = {"scale": scale} if survey is None else {"survey": survey}
    return [pc.Node(name, place, **({} if name in known else loose)) for name, place in PLACES.items()]


def drawn(network, motion=DRIVE, *, key=1, biases=None, tracks=None, **settings):
    """A world simulated from its network and motion; its target passes as `WAY` says."""
    tracks = {"target": WAY} if tracks is None else tracks
    run = pc.simulate(network, motion, TIME, key=key, biases=biases or {}, tracks=tracks, **settings)
    return World(network, motion, run.table, run.truth)


@world(
    "simulate observability bounds bounds-parametric map least-squares em map-em ea ea-maximised assess evidence"
    " evidence-gaussian track stream stream-window stream-particles nuts collapsed gibbs svi em-particles"
    " saved saved-track"
)
def linear():
    """Fixes of places: all is linear and Gaussian."""
    network = pc.Network([pc.sensors.position.on(node) for node in nodes({"position": 5.0})])
    return drawn(network, pc.Target(DRIVE, START), biases={"b.position_x": 12.0, "c.position_y": -7.0})


def scopes(key=1, biases=BIASES, **settings):
    """Three scopes, one of known pose, and one target."""
    return drawn(pc.Network([scope.on(node) for node in nodes(LOOSE)]), key=key, biases=biases, **settings)


@world(
    "simulate observability bounds bounds-hybrid passes anchors more-sensors area map map-joint map-l1 ml least-squares"
    " em em-ml em-unscented em-ea ea ea-maximised ea-printed ea-em ea-spike ea-groups assess compare evidence"
    " changes track stream-window collapsed collapsed-spike nuts gibbs svi carried"
)
def radars():
    """One radar turned, one with an offset in range."""
    return scopes()


@world("ea assess")
def later():
    """The same network another day: one more radar has turned."""
    return scopes(key=2, biases=BIASES | {"c.heading": -0.15})


@world("ea assess")
def noisy():
    """Rows three times as noisy as declared."""
    world = scopes(key=3)
    loud = pc.simulate(world.network, DRIVE, TIME, key=3, biases=BIASES, tracks={"target": WAY}, outliers=0.9999,
                       outlier_scale=3.0)  # fmt: skip
    return World(world.network, DRIVE, loud.table, world.truth)


@world("ea assess")
def outlying():
    """One datum far off."""
    world = scopes(key=4)
    table = world.table.copy()
    table.loc[10, "range"] += 30.0
    return World(world.network, DRIVE, table, world.truth)


@world("map assess-map")
def slipped():
    """A radar that turns by 0.15 rad at half time, which nobody declared."""
    world = scopes(key=5)
    table = world.table.copy()
    late = (table["time"] > 7.0) & (table["sensor"] == "c")
    table.loc[late, "azimuth"] -= 0.15
    return World(world.network, DRIVE, table, world.truth)


@world("map")
def exchanged():
    """Rows whose sensors have exchanged their names: nothing explains them."""
    world = scopes(key=6)
    table = world.table.assign(sensor=world.table["sensor"].map({"a": "b", "b": "a", "c": "c"}))
    return World(world.network, DRIVE, table, world.truth)


@world("observability map ml ea")
def floating():
    """No radar of known pose: the whole scene may shift and turn."""
    return drawn(pc.Network([scope.on(node) for node in nodes(LOOSE, known="")]), biases=BIASES)


@world("map assess-map ea")
def surveyed():
    """Places and headings by survey, one heading 0.15 rad from where it is said to be to 0.02 rad."""
    network = pc.Network([scope.on(node) for node in nodes(None, {"position": 0.5, "heading": 0.02})])
    return drawn(network, biases={"b.heading": 0.15, "c.range_offset": 8.0})


@world("observability map ea assess nuts")
def space():
    """Radars in 3-D."""
    high = {"a": (0.0, 0.0, 0.0), "b": (400.0, 0.0, 40.0), "c": (200.0, 300.0, 80.0)}
    loose = [pc.Node(n, p, **({} if n == "a" else {"scale": {"position": 10.0}})) for n, p in high.items()]
    way = np.column_stack([WAY, np.linspace(50, 120, 8)])
    network = pc.Network([pc.sensors.radar_3d.on(node) for node in loose])
    return drawn(network, biases={"b.range_offset": 40.0, "c.position_z": 15.0}, tracks={"target": way})


@world("map ea assess track gibbs")
def two_targets():
    """Two targets of one motion, a quarter of the rows missing."""
    network = pc.Network([scope.on(node) for node in nodes(LOOSE)])
    return drawn(network, dict(car=DRIVE, van=DRIVE), biases=BIASES, tracks={"car": WAY, "van": BACK}, missing=0.25)


@world("map ea")
def motions():
    """Targets of different motions, one of them static."""
    network = pc.Network([scope.on(node) for node in nodes(LOOSE)])
    motion = {"car": DRIVE, "plane": pc.ConstantAcceleration(0.5), "mast": pc.Static()}
    tracks = {"car": WAY, "plane": BACK, "mast": np.array([[150.0, 250.0]])}
    return drawn(network, motion, biases=BIASES, tracks=tracks)


@world("map ea")
def turning():
    """A coordinated turn, with range rates."""
    posts, kinds = nodes({"position": 5.0}), {"r": pc.sensors.flight_time, "d": pc.sensors.doppler}
    network = pc.Network([kind.on(node, name=name + node.name) for name, kind in kinds.items() for node in posts])
    start = {"position": ((200.0, 60.0), 20.0), "velocity": ((15.0, 0.0), 5.0)}
    motion = pc.Target(pc.CoordinatedTurn(0.3, rate=0.1), start)
    angle = 0.1 * TIME
    way = np.stack([200 + 150 * np.sin(angle), 60 + 150 * (1 - np.cos(angle))], 1)
    return drawn(network, motion, biases={"rb.range_offset": 3.0, "dc.rate_offset": 1.0}, tracks={"target": way})


@world("map ea")
def asynchronous():
    """Every radar looks at times of its own; rows are put at common epochs of 2 s."""
    network = pc.Network([scope.on(node) for node in nodes(LOOSE)])
    rows = [(t + 0.3 * k, "target", name) for t in TIME for k, name in enumerate(PLACES)]
    schedule = pd.DataFrame(rows, columns=["time", "target", "sensor"]).sort_values("time", ignore_index=True)
    run = pc.simulate(network, pc.Target(DRIVE, START), [0.0], key=1, biases=BIASES, schedule=schedule)
    return World(network, pc.Target(DRIVE, START), run.table, run.truth, {"epoch": 2.0})


def drifting(drift):
    """Scopes whose heading drifts."""
    heading = pc.Bias("rad", 0.1, drift=drift)
    return pc.Network([scope.on(node) for node in nodes({"position": 5.0, "heading": heading})])


@world("map ea drifts")
def jumping():
    """Headings that may jump at stated times."""
    return drawn(drifting(pc.Drift((0.0, 8.0), scale=0.1)), biases={"b.heading": 0.05, "b.heading@8": 0.2})


@world("map drifts-map")
def walking():
    """Headings that walk."""
    return drawn(drifting(pc.Drift((0.0, 4.0, 8.0), std=0.03)), biases={"b.heading": 0.05, "b.heading@4": 0.06})


@world("map ea assess")
def levels():
    """Noise of sensors and motion not known."""

    @pc.sensor(range=pc.Channel("m", std=pc.Unknown(1.0)), azimuth=pc.Channel("rad", std=0.02, wrap=True))
    def loud(target, pose, *, range_offset=pc.Bias("m", 5.0)):
        line = pose.local(target.position)
        return dict(range=norm(line) + range_offset, azimuth=bearing(line))

    network = pc.Network([loud.on(node) for node in nodes(LOOSE)])
    tracks = {"car": WAY, "van": BACK}
    return drawn(network, dict.fromkeys(tracks, pc.ConstantVelocity(pc.Unknown(1.0))), biases=BIASES, tracks=tracks)


def heavy(noise):
    """Ranges whose noise is of a family."""

    @pc.sensor(range=pc.Channel("m", std=1.0, noise=noise))
    def tape(target, pose, *, range_offset=pc.Bias("m", 5.0)):
        return dict(range=norm(target.position - pose.position) + range_offset)

    network = pc.Network([tape.on(node) for node in nodes({"position": 5.0})])
    biases = {"b.range_offset": 8.0}
    return drawn(network, pc.Target(DRIVE, START), biases=biases, outliers=0.08, outlier_scale=20.0)


@world("map ea outliers")
def tails():
    """Student-t noise, and some outliers."""
    return heavy(pc.StudentT(4.0))


@world("map ea outliers")
def echoes():
    """A mixture of sound ranges and echoes."""
    return heavy(pc.Mixture(0.1, 10.0))


@world("map ea")
def manoeuvre():
    """Process noise of heavy tails: straight on, and one sharp turn."""
    network = pc.Network([scope.on(node) for node in nodes(LOOSE)])
    way = np.concatenate([WAY[:4], WAY[3] + np.outer(np.arange(1, 5), [0.0, 45.0])])
    return drawn(network, pc.ConstantVelocity(0.5, noise=pc.StudentT(4)), biases=BIASES, tracks={"target": way})


@world("map particle-gibbs")
def presence():
    """Yes-or-no sensors among rangers."""
    near = {f"p{k}": (60.0 + 60 * k, 120.0 + 40 * (-1) ** k) for k in range(4)}

    @pc.sensor(present=pc.Channel("1", noise=pc.Bernoulli()))
    def nearby(target, pose):
        return dict(present=(60.0 - norm(target.position - pose.position)) / 8.0)

    placed = [nearby.on(pc.Node(name, place, scale={"position": 15.0})) for name, place in near.items()]
    network = pc.Network(placed + [pc.sensors.flight_time.on(pc.Node(n, p)) for n, p in PLACES.items()])
    return drawn(network, pc.Target(DRIVE, START), biases={"p1.position_y": 20.0})


@world("map ea least-squares")
def static():
    """Tags that do not move, ranged from three anchors and among each other by none."""
    network = pc.Network([pc.sensors.flight_time.on(node) for node in nodes({"position": 2.0})])
    places = {f"tag_{k}": np.array([[80.0 * k + 40, 60.0 + 30 * k]]) for k in range(4)}
    return drawn(network, dict.fromkeys(places, pc.Static()), biases={"b.range_offset": 3.0}, tracks=places)


@world("map ea assess starts")
def mirror():
    """Rangers near a line: the target passes on one side or on the other."""
    line = [pc.Node("a", (0.0, 0.0)), pc.Node("b", (200.0, 1.0), scale=2.0), pc.Node("c", (400.0, -1.0), scale=2.0)]
    network = pc.Network([pc.sensors.flight_time.on(node) for node in line])
    return drawn(network, biases={"b.range_offset": 3.0})


@world("map ml least-squares")
def known():
    """Levels in dB from a known path, with one exponent for all."""
    network = pc.Network([pc.sensors.rss.on(node) for node in nodes({})])
    motion = pc.Known(pd.DataFrame({"time": TIME, "position_x": WAY[:, 0], "position_y": WAY[:, 1]}))
    motion = motion + pc.RandomWalk("power", "dB", 0.0, (30.0, 1.0))
    return drawn(network, motion, biases={"b.gain": 5.0, "rss.exponent": 0.4})


@world("map")
def distances():
    """Distances between nodes, without a target."""

    @pc.sensor(distance=pc.Channel("m", std=0.5))
    def gap(target, first, second, *, distance_offset=pc.Bias("m", 2.0)):
        return dict(distance=norm(first.position - second.position) + distance_offset)

    posts = [*nodes({"position": 5.0}, known="ab"), pc.Node("d", (100.0, 200.0), scale={"position": 5.0})]
    a, b, c, d = posts
    network = pc.Network([gap.on(*pair) for pair in ((a, c), (a, d), (b, c), (b, d), (c, d))])
    rows = [(t, s.name) for t in TIME for s in network.sensors]
    schedule = pd.DataFrame(rows, columns=["time", "sensor"])
    run = pc.simulate(network, None, [0.0], key=1, biases={"d.position_x": 6.0}, schedule=schedule)
    return World(network, None, run.table, run.truth)


@world("map ea")
def floor():
    """Receivers that hear nothing below a floor, and say so."""

    @pc.sensor(level=pc.Channel("dB", std=2.0, noise=pc.Censored(-52.0)))
    def receiver(target, pose, *, offset=pc.Bias("dB", 3.0)):
        return dict(level=offset - 20.0 * pc.sensors.jnp.log10(norm(target.position - pose.position)))

    posts, kinds = nodes({}), {"r": receiver, "s": scope}
    network = pc.Network([kind.on(node, name=name + node.name) for name, kind in kinds.items() for node in posts])
    return drawn(network, biases={"rb.offset": 6.0})


@world("map ea")
def clocks():
    """Arrivals of a sound of unknown instant at four nodes, and differences of two."""
    places = {**PLACES, "d": (0.0, 300.0)}
    loose = {"clock": 5.0}
    posts = [pc.Node(n, p, **({} if n == "a" else {"scale": loose})) for n, p in places.items()]
    network = pc.Network([*(pc.sensors.toa.on(n, name=f"toa_{n.name}") for n in posts), pc.sensors.tdoa.on(*posts[:2])])
    motion = pc.Target(DRIVE + pc.White("emission", "m", 100.0), START)
    return drawn(network, motion, biases={"b.clock": 7.0})


@world("map ea")
def robot():
    """A node that moves on a known path."""
    path = pc.Path([0.0, 7.0, 14.0], [(0.0, 0.0), (50.0, 80.0), (20.0, 160.0)], [0.0, 1.0, 2.0])
    posts = [pc.Node("robot", path=path, scale=LOOSE), *nodes({"heading": 0.1}, known="b")[1:]]
    return drawn(pc.Network([scope.on(node) for node in posts]), biases={"robot.heading": 0.15})


@world("map ea saved saved-track")
def bearings():
    """Bearings alone, clockwise from north."""

    @pc.sensor(azimuth=pc.Channel("rad", std=0.01, wrap=True, compass=True))
    def ear(target, pose):
        return dict(azimuth=bearing(target.position - pose.position) - pose.heading)

    network = pc.Network([ear.on(node) for node in nodes({"heading": 0.1}, known="")])
    return drawn(network, pc.Target(DRIVE, START), biases={"b.heading": 0.15})


@world("map")
def dipole():
    """The field of a dipole whose moment has two axes."""
    posts = [pc.Node(name, np.array(place) / 20, scale={"heading": 0.1}) for name, place in PLACES.items()]
    kinds = {"m": pc.sensors.magnetometer, "f": pc.sensors.flight_time}
    network = pc.Network([kind.on(node, name=name + node.name) for name, kind in kinds.items() for node in posts])
    motion = pc.Target(
        pc.ConstantVelocity(0.2) + pc.RandomWalk("moment", "A m2", 1.0, (0.0, 300.0), per_axis=True),
        {"position": ((3.0, 6.0), 2.0), "velocity": ((1.0, 0.5), 0.5)},
    )
    return drawn(network, motion, biases={"mb.offset_x": 12.0}, tracks={"target": WAY / 20})


@world("map")
def globe():
    """Nodes in latitude and longitude."""
    degrees = {"latitude": [57.0, 57.0, 57.0027], "longitude": [12.0, 12.0066, 12.0033]}
    scales = {"scale_position": [np.nan, 5.0, 5.0], "scale_heading": [np.nan, 0.1, 0.1]}
    found = pc.read_nodes(pd.DataFrame({"name": list("abc")} | degrees | scales))
    network = pc.Network([scope.on(node) for node in found.values()], frame=found.frame)
    return drawn(network, biases={"b.heading": 0.12})


REPORT = pc.Detection(0.95, clutter=0.5, view=pc.Sector(range=600.0))
SCANS = np.arange(12.0)


@world("self-configuration objects intensities counts beliefs separable")
def scans():
    """Detections of two objects, missed, false, and without names."""
    network = pc.Network([scope.on(node, detection=REPORT) for node in nodes({"heading": 0.1})[:2]])
    tracks = {"one": np.array([50.0, 60.0]) + np.outer(SCANS, [20.0, 12.0]),
              "two": np.array([330.0, 180.0]) + np.outer(SCANS, [-18.0, -4.0])}  # fmt: skip
    run = pc.simulate(network, dict.fromkeys(tracks, DRIVE), SCANS, key=1, biases={"b.heading": 0.08}, tracks=tracks)
    start = {"position": ((200.0, 100.0), 200.0), "velocity": ((0.0, 0.0), 20.0)}
    return World(network, pc.Target(DRIVE, start), run.table, run.truth)


def stream():
    """Two targets that one after the other pass three scopes, whose start is declared."""
    network = pc.Network([scope.on(node) for node in nodes(LOOSE)])
    motion = pc.Target(DRIVE, {"position": ((200.0, 150.0), 200.0), "velocity": ((0.0, 0.0), 20.0)})
    when = np.arange(0.0, 40.0, 2.0)
    path = np.stack([50 + 7.5 * when, 120 + 60 * np.sin(when / 5)], 1)
    run = pc.simulate(network, dict(car=motion, van=motion), when, key=1, biases=BIASES,
                      tracks={"car": path, "van": path[::-1]})  # fmt: skip
    gone = ((run.table["target"] == "car") & (run.table["time"] > 26)) | (
        (run.table["target"] == "van") & (run.table["time"] < 10)
    )
    return World(network, motion, run.table[~gone].reset_index(drop=True), run.truth)


@world("stream stream-window stream-short stream-unscented stream-walk stream-sparse saved saved-track")
def passing():
    """A stream of two targets that come and go."""
    return stream()


@world("stream-jumps")
def bumped():
    """A stream in which a radar is turned by 0.2 rad at 20 s."""
    world = stream()
    late = (world.table["time"] >= 20.0) & (world.table["sensor"] == "c")
    table = world.table.assign(azimuth=world.table["azimuth"] - 0.2 * late)
    return World(world.network, world.motion, table, world.truth)


@world("map-sparse map-iterative ea-sparse assess-sparse bounds")
def grid():
    """625 radars that each see what passes within 250 m."""
    rng, side = np.random.default_rng(0), 25
    places = 100.0 * np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2)
    biases = rng.standard_normal((len(places), 4)) * (rng.random((len(places), 4)) < 0.3) * [2.0, 2.0, 0.05, 3.0]
    rows = []
    for t in range(12):
        when = np.arange(side)
        path = np.stack([100.0 * when, 100.0 + 200 * t + 30 * np.sin(when / 3)], 1)
        epoch, k = np.nonzero(norm_of(path[:, None] - places) < 250)
        line = path[epoch] - places[k] - biases[k, :2]
        keep = norm_of(line) > 20
        epoch, k, line = epoch[keep], k[keep], line[keep]
        noise = rng.standard_normal((len(k), 2)) * [1.0, 0.02]
        columns = {"range": norm_of(line) + biases[k, 3] + noise[:, 0],
                   "azimuth": np.arctan2(line[:, 1], line[:, 0]) - biases[k, 2] + noise[:, 1]}  # fmt: skip
        names = np.char.add("r", k.astype(str))
        rows.append(pd.DataFrame({"time": 10.0 * when[epoch], "target": f"t{t}", "sensor": names, **columns}))
    scale = {"position": 2.0, "heading": 0.05}
    network = pc.Network([scope.on(pc.Node(f"r{k}", place, scale=scale)) for k, place in enumerate(places)])
    return World(network, pc.ConstantVelocity(0.5), pd.concat(rows, ignore_index=True), None)


def norm_of(line):
    """Lengths (...) of vectors (..., d)."""
    return np.sqrt((line**2).sum(-1))


@world("particles em-road")
def town():
    """A target that follows roads."""
    lines = {"west": [(0.0, 100.0), (200.0, 100.0)], "east": [(200.0, 100.0), (400.0, 120.0)],
             "north": [(200.0, 100.0), (200.0, 300.0)]}  # fmt: skip
    road = pc.Road(pc.RoadNetwork.from_lines(lines), 0.5, (20.0, 3.0), position=((20.0, 100.0), 10.0), fastest=40.0)
    network = pc.Network([scope.on(node) for node in nodes(LOOSE)])
    run = pc.simulate(network, road, TIME, key=1, biases=BIASES)
    return World(network, road, run.table, run.truth)


@world("command")
def small():
    """The model that the committed results are of."""
    sys.path.insert(0, str(DATA))
    import small as model

    return World(model.network(), pc.ConstantVelocity(0.5), model.scenario(3).table)


# Rows.

SHORT = dict(chains=2, draws=100)
FITS = {
    "map": Fit("climb", pc.MAP()),
    "map-joint": Fit("climb", pc.MAP(trajectory="joint")),
    "map-l1": Fit("climb", pc.MAP(), pc.Laplace()),
    "ml": Fit("climb", pc.MAP(), pc.Flat()),
    "map-sparse": Fit("climb", pc.MAP(engine="cholmod")),
    "map-iterative": Fit("climb", pc.MAP(engine="iterative")),
    "least-squares": Fit("climb", pc.LeastSquares()),
    "em": Fit("climb", pc.EM()),
    "em-ml": Fit("climb", pc.EM(), pc.Flat()),
    "em-unscented": Fit("climb", pc.EM(pc.Unscented())),
    "em-particles": Fit("draws", lambda: pc.EM(pc.Particles(100), iterations=8)),
    "em-road": Fit("draws", lambda: pc.EM(pc.Particles(100), iterations=8)),
    "em-ea": Fit("climb", pc.EMEA()),
    "ea": Fit("climb", pc.EA()),
    "ea-maximised": Fit("climb", pc.EA(precisions="maximised")),
    "ea-printed": Fit("climb", pc.EA.as_printed()),
    "ea-em": Fit("climb", pc.EA.as_printed(update="em", iterations=2000)),
    "ea-spike": Fit("climb", pc.EA(), pc.BernoulliGaussian()),
    "ea-groups": Fit("climb", pc.EA(), pc.ARD(by="owner")),
    "ea-sparse": Fit("climb", pc.EA(engine="cholmod")),
    "starts": Fit("climb", pc.MAP(), starts=3),
    "collapsed": Fit("draws", pc.Collapsed(**SHORT, warmup=50)),
    "collapsed-spike": Fit("draws", pc.Collapsed(**SHORT, warmup=50), pc.BernoulliGaussian()),
    "nuts": Fit("draws", pc.NUTS(**SHORT, warmup=100)),
    "gibbs": Fit("draws", pc.Gibbs(**SHORT, warmup=50)),
    "particle-gibbs": Fit("draws", lambda: pc.ParticleGibbs(**SHORT, warmup=50), pc.Gaussian()),
    "svi": Fit("draws", pc.SVI(**SHORT)),
    "self-configuration": Fit("climb", lambda: pc.SelfConfiguration(pc.EA())),
}


def made(name):
    """The problem of a name."""
    return WORLDS[name][0]()


@cache
def tree(name, method):
    """The fit of a problem by a method of `FITS`."""
    fit = FITS[method]
    method = fit.method() if callable(fit.method) else fit.method
    return pc.fit(made(name).problem, method, prior=fit.prior, starts=fit.starts)


def column(values, labels=None):
    """Numbers by label."""
    return {str(k): float(v) for k, v in zip(values.index if labels is None else labels, values, strict=True)}


def noted(found):
    """Kinds and subjects of the findings of a tree."""
    group = found["finding"].to_dataset()
    return sorted([str(k), str(s)] for k, s in zip(group["kind"].values, group["subject"].values, strict=True))


def read(found):
    """The row of a tree: biases, ends of tracks, levels, evidence, status; verdicts and findings where it has them."""
    row: dict[str, Any] = {"status": str(found.attrs["status"])}
    if row["status"] in INVALID:  # its numbers are no estimate
        return row
    frame = pc.summary(found).set_index("bias")
    frame = frame.iloc[:: max(1, len(frame) // 40)]
    row |= {"means": column(frame["mean"]), "sds": column(frame["sd"])}
    if "ess" in frame:
        row["ess"] = column(frame["ess"])
    if "ess" not in frame:
        add_tracks(row, found)
    if "level" in found.children:
        row.setdefault("values", {}).update(column(found["level"].to_dataset()["std"].to_series()))
    if len(gain := rivals(found)["gain"].values):
        row["evidence"] = {f"other answer {k}": float(v) for k, v in enumerate(np.sort(gain)[::-1])}
    for name in ("objects", "rounds"):
        if name in found.attrs:
            row.setdefault("values", {})[name] = float(found.attrs[name])
    evidence = [float(v) for k, v in found.attrs.items() if k.startswith("log_evidence") and not k.endswith("_error")]
    if evidence:
        row["evidence"] = row.get("evidence", {}) | {"model": evidence[0]}
    if "verdict" in frame:
        row |= {"verdicts": {str(k): str(v) for k, v in frame["verdict"].items()}, "findings": noted(found)}
    return row


def add_tracks(row, found):
    """Enter the last place of the first four targets of a tree."""
    frame = pc.tracks(found)
    for target, own in list(frame.groupby("target", sort=False))[:4]:
        last = own.iloc[-1]
        for name in (n for n in frame.columns if n.startswith("position") and not n.endswith("_sd")):
            row.setdefault("means", {})[f"{target}.{name}"] = float(last[name])
            row.setdefault("sds", {})[f"{target}.{name}"] = float(last[f"{name}_sd"])


@verb("point")
def simulate(name):
    """The first and the last row of the data, and the mean of each column."""
    numbers = made(name).table.select_dtypes("number")
    parts = {"first": numbers.iloc[0], "last": numbers.iloc[-1], "mean": numbers.mean()}
    return {"values": {f"{part}.{k}": v for part, own in parts.items() for k, v in column(own).items()}}


@verb("point")
def observability(name):
    """What data determine at the true tracks and biases."""
    found = pc.observability(made(name).problem, truth=made(name).truth)
    bias = found["bias"].to_dataset()
    spectrum = found["spectrum"].to_dataset()["information"].values
    row = {"status": str(found.attrs["status"]), "sds": column(bias["sd"].to_series())}
    row["values"] = column(bias["share"].to_series()) | {"largest": float(spectrum[-1])}
    row["verdicts"] = {str(k): str(v) for k, v in bias["verdict"].to_series().items()}
    if "direction" in found.children:
        row["findings"] = sorted([str(kind), ""] for kind in found["direction"].to_dataset()["kind"].values)
    return row


def bounded(name, **settings):
    """Bounds of biases and of the places of targets."""
    found = pc.bounds(made(name).problem, truth=made(name).truth, draws=5, **settings)
    sds = column(found["bias"].to_dataset()["sd"].to_series().iloc[:40])
    for target, node in list(found["track"].children.items())[:4]:
        sds[f"{target}.position"] = float(node.to_dataset()["position_rmse"].values[-1])
    return {"sds": sds}


@verb("point")
def bounds(name):
    return bounded(name)


@verb("point")
def bounds_hybrid(name):
    return bounded(name, kind="hybrid")


@verb("point")
def bounds_parametric(name):
    return bounded(name, kind="parametric")


def gains(found, name):
    """The largest gains of what could be added."""
    return {"values": {f"{name}_{k}": float(v) for k, v in enumerate(np.sort(found["gain"].values.ravel())[::-1][:5])}}


@verb("point")
def passes(name):
    return gains(pc.next_passes(made(name).problem, truth=made(name).truth), "pass")


@verb("point")
def anchors(name):
    return gains(pc.next_anchors(made(name).problem, truth=made(name).truth), "anchor")


@verb("point")
def more_sensors(name):
    return gains(pc.next_sensors(made(name).problem, truth=made(name).truth), "sensor")


@verb("point")
def area(name):
    """Bounds of a place over the area."""
    found = pc.bound_map(made(name).problem, ((0.0, 400.0), (50.0, 300.0)), cells=3)
    return {"values": {str(k): float(v) for k, v in enumerate(next(iter(found.data_vars.values())).values.ravel())}}


@verb("climb")
def map_em(name):
    """What two methods of one answer say of each other."""
    return compared(name, "map", "em")


@verb("climb")
def compare(name):
    return compared(name, "map", "ea")


def compared(name, *methods):
    found = pc.compare({method: tree(name, method) for method in methods})
    return {"findings": noted(found)}


@verb("climb")
def changes(name):
    """What moved until another day."""
    found = pc.changes(tree(name, "ea"), tree("later", "ea"))
    group = found["change"].to_dataset()
    row = {"means": column(group["change"].to_series()), "sds": column(group["sd"].to_series())}
    row["verdicts"] = {str(k): str(v) for k, v in group["verdict"].to_series().items()}
    return row | {"findings": noted(found)}


@verb("climb")
def evidence(name):
    """The evidence under the prior of `ea`, by draws that are many beside its error."""
    found = pc.log_evidence(made(name).problem)
    return {"evidence": {"model": float(found.value)}, "evidence_error": float(found.error)}


@verb("point")
def evidence_gaussian(name):
    """The evidence under Gaussian priors: exact where all is linear."""
    return {"evidence": {"model": float(pc.log_evidence(made(name).problem, prior=pc.Gaussian()).value)}}


@verb("climb")
def carried(name):
    """Another day from the network that a fit has calibrated."""
    first, second = made(name), made("later")
    network = pc.with_calibration(first.network, tree(name, "map"))
    return read(pc.fit(pc.Problem(network, second.motion, second.table), pc.MAP()))


def assessed(name, method):
    world = made(name)
    return read(pc.assess(world.problem, tree(name, method), truth=world.truth))


@verb("climb")
def assess(name):
    return assessed(name, "ea")


@verb("climb")
def assess_map(name):
    return assessed(name, "map")


@verb("climb")
def assess_sparse(name):
    return assessed(name, "map-sparse")


@verb("climb")
def track(name):
    """Tracks of the problem with the calibration that `ea` found."""
    row: dict[str, Any] = {}
    add_tracks(row, pc.track(made(name).problem, tree(name, "ea")))
    return row


def drifts_of(name, method):
    """The values of biases that drift, by the time since when they hold."""
    frame = pc.drift_table(tree(name, method))
    labels = [f"{bias}@{since:g}" for bias, since in zip(frame["bias"], frame["since"], strict=True)]
    return {"means": column(frame["mean"], labels), "sds": column(frame["sd"], labels)}


@verb("climb")
def drifts(name):
    return drifts_of(name, "ea")


@verb("climb")
def drifts_map(name):
    return drifts_of(name, "map")


@verb("climb")
def outliers(name):
    """Data that count little."""
    frame = pc.outliers(tree(name, "ea"))
    return {"findings": [["outlier", str(row)] for row in sorted(frame["row"])]}


def online(name, method, prior=None):
    """What a stream says at its end."""
    world = made(name)
    found = pc.Online(world.network, world.motion, method, targets=3)
    for _, rows in world.table.groupby(world.table["time"] // 8):
        found.update(rows)
    frame = found.biases if prior is None else found.under(prior)
    row = {"status": str(found.status), "means": column(frame["mean"]), "sds": column(frame["sd"])}
    row |= {"values": {k: float(v) for k, v in found.counts.items()}}
    row |= {"evidence": {"filtered for good": float(found.log_evidence)}}
    return row | {"findings": sorted(["jump", jump.label] for jump in found.jumps)}


@verb("point")
def stream_(name):
    return online(name, pc.AugmentedFilter(lag=0))


@verb("climb")
def stream_window(name):
    return online(name, pc.AugmentedFilter())


@verb("point")
def stream_unscented(name):
    return online(name, pc.AugmentedFilter("unscented", lag=0))


@verb("point")
def stream_walk(name):
    return online(name, pc.AugmentedFilter(lag=0, walk={"*.heading": 0.01}, consider="*.range_offset"))


@verb("climb")
def stream_jumps(name):
    return online(name, pc.AugmentedFilter(jumps=pc.Jumps()))


@verb("climb")
def stream_short(name):
    return online(name, pc.AugmentedFilter(lag=4))


@verb("draws")
def stream_particles(name):
    row = online(name, pc.ParticleFilter(1000))
    return row | {"ess": dict.fromkeys(row["means"], 50.0)}  # first particles of which the last ones descend, at least


@verb("climb")
def stream_sparse(name):
    """The stream under a sparse prior."""
    return online(name, pc.AugmentedFilter(), pc.Horseshoe())


@verb("point")
def objects(name):
    """The objects behind detections, with biases of zero."""
    found = pc.track_objects(made(name).problem)
    last = found.path.groupby("track").tail(1)
    values = {"objects": float(len(found.names)), "weight": float(found.rows["weight"].sum())}
    values |= column(last["existence"], last["track"])
    return {"values": values | column(last["position_x"], last["track"] + ".x")}


def intensity(name, kind):
    found = pc.phd_filter(made(name).problem, kind=kind).count
    return {"values": {str(k): float(v) for k, v in enumerate(found["count"].iloc[::5])}}


@verb("point")
def intensities(name):
    return intensity(name, "phd")


@verb("point")
def counts(name):
    return intensity(name, "cphd")


@verb("climb")
def beliefs(name):
    """Where sensors stand, by belief propagation."""
    found = pc.propagate_beliefs(made(name).problem)
    labels = made(name).problem.labels
    return {"means": column(found.z, labels), "sds": column(np.sqrt(np.diag(found.covariance)), labels)}


@verb("point")
def separable(name):
    """How well the objects of one sensor explain the detections of the other."""
    z = np.linspace(-1, 1, 3)[:, None] * np.ones(len(made(name).problem.labels))
    found = pc.separable_likelihood(made(name).problem, "a", "b", z)
    return {"values": {str(k): float(v) for k, v in enumerate(found)}}


@verb("draws")
def particles(name):
    """Particles of a target, biases zero."""
    found = pc.particle_filter(made(name).problem, pc.Particles(200), runs=4)
    error = float(found.attrs["log_likelihood_se"])
    return {"evidence": {"model": float(found.attrs["log_likelihood"])}, "evidence_error": error}


VERBS["stream"] = VERBS.pop("stream-")


@verb("climb")
def command(name):
    """`probcal fit` on a model file and a table."""
    with tempfile.TemporaryDirectory() as folder:
        made(name).table.to_csv(f"{folder}/rows.csv", index=False)
        code, _, _ = call("fit", DATA / f"{name}.py", f"{folder}/rows.csv", "--out", f"{folder}/fit")
        row = read(pc.load(f"{folder}/fit"))
    row.setdefault("values", {})["exit code"] = float(code)
    return row


def saved_by(name):
    """A result of version 3, saved once: "bearings ea", "linear collapsed", and the tree of "passing stream-window"."""
    return pc.load(DATA / f"golden_{name}.nc")


@verb("point")
def saved(name):
    """What readers take from the file of a result."""
    return read(saved_by(name))


@verb("climb")
def saved_track(name):
    """Tracks of the problem with the calibration in a file."""
    row: dict[str, Any] = {}
    add_tracks(row, pc.track(made(name).problem, saved_by(name)))
    return row


# Which tests make a row: a problem whose form no other has compiles kernels for ten seconds or more.
QUICK = (  # of the linear problem
    "simulate observability bounds bounds-parametric map least-squares em ea assess evidence-gaussian track stream"
    " saved saved-track"
)
SLOW_LINEAR = "collapsed nuts"  # which `test_samplers.py` compares with the exact answer
LIKE_RADARS = "radars later noisy outlying slipped exchanged"  # problems of one form, the form of `radars`
SLOW_PROBLEMS = (
    "space motions turning asynchronous walking manoeuvre presence static known floor clocks robot bearings dipole"
    " globe scans grid town small floating surveyed jumping echoes mirror"
)
SLOW_ROWS = (  # of other problems than the linear one
    "collapsed collapsed-spike nuts gibbs particle-gibbs svi em-particles ea-printed ea-em"
    " em-unscented em-ea ea-spike stream-particles carried"
)


def tier_of(key):
    """The tests that make a row: those by default ("quick"), those of CI ("ci") or those outside it ("slow")."""
    name, row = key.split()
    if name == "linear":
        return "quick" if row in QUICK.split() else "slow" if row in SLOW_LINEAR.split() else "ci"
    own = row in ("saved", "saved-track")
    return "slow" if (name in SLOW_PROBLEMS.split() and not own) or row in SLOW_ROWS.split() else "ci"


ROWS = [f"{name} {row}" for name, (_, rows) in WORLDS.items() for row in rows]


def tolerance_of(key):
    """The tolerance of a row."""
    row = key.split()[1]
    return (FITS[row] if row in FITS else VERBS[row]).tolerance


@cache
def make(key):
    """A row, made anew: its name is that of its problem and of its fit or verb."""
    name, row = key.split()
    found = read(tree(name, row)) if row in FITS else VERBS[row].function(name)
    kind = tolerance_of(key)
    if kind == "draws" and "evidence_error" not in found:
        found.pop("evidence", None)  # nobody knows how far it may move
    return json.loads(json.dumps({"tolerance": kind} | rounded(found, DIGITS[kind])))


def rounded(value, digits):
    """The same with its numbers to some digits."""
    if isinstance(value, dict):
        return {key: rounded(v, digits) for key, v in value.items()}
    return float(f"{value:.{digits}g}") if isinstance(value, float) else value


def stored():
    """The rows of the table by name."""
    return json.loads(TABLE.read_text()) if TABLE.exists() else {}


def differences(old, new):
    """Sentences on what moved between two rows beyond the tolerance of the old one."""
    said = []
    for part in ("tolerance", "status", "verdicts", "findings"):
        if old.get(part) != new.get(part):
            said.append(f"{part}: {changed(old.get(part), new.get(part))}")
    for part in ("means", "sds", "values", "evidence"):
        before, after = old.get(part, {}), new.get(part, {})
        if before.keys() != after.keys():
            said.append(f"{part}: other labels, {sorted(before.keys() ^ after.keys())}")
            continue
        for label, value in before.items():
            allowed = allowance(old, new, part, label, value)
            moved = abs(after[label] - value)
            if not (moved <= allowed or value == after[label] or (np.isnan(value) and np.isnan(after[label]))):
                times = f"{moved / allowed:.3g} times its tolerance"
                said.append(f"{part} {label}: {value:.9g} -> {after[label]:.9g}, {times}")
    return said


def changed(old, new):
    """What changed of a status, of verdicts or of findings."""
    if isinstance(old, dict) and isinstance(new, dict):
        return {key: (old.get(key), new.get(key)) for key in old | new if old.get(key) != new.get(key)}
    return f"{old} -> {new}"


def allowance(old, new, part, label, value):
    """Most that a number of a row may move."""
    kind, sd = old["tolerance"], old.get("sds", {}).get(label)
    if kind == "point":
        return POINT * max(abs(value), sd or 0.0, 1e-3)
    if part == "evidence":
        return DRAWS * float(np.hypot(old.get("evidence_error", 0.0), new.get("evidence_error", 0.0))) or CLIMB
    if kind == "climb":
        return CLIMB * (abs(value) if sd is None or part == "values" else sd) + POINT
    sizes = [row.get("ess", {}) for row in (old, new)]
    ess = [own.get(label, min(own.values(), default=100.0)) for own in sizes]
    spread = abs(value) if sd is None else sd
    error = spread * float(np.sqrt(sum(1 / e for e in ess)))
    return DRAWS * (error / np.sqrt(2) if part == "sds" else error) + POINT


def write(rows):
    """Write rows into the table, one a line, in the order of the problems."""
    order = {key: number for number, key in enumerate(ROWS)}
    kept = {key: row for key, row in (stored() | rows).items() if key in order}
    lines = [f"{json.dumps(key)}: {json.dumps(kept[key])}" for key in sorted(kept, key=order.get)]
    TABLE.write_text("{\n" + ",\n".join(lines) + "\n}\n")


def batches(keys):
    """Rows by problem, for a process each: those of `radars` and of what shares its kernels together."""
    found: dict[str, list[str]] = {}
    for key in keys:
        name = key.split()[0]
        found.setdefault("radars" if name in LIKE_RADARS.split() else name, []).append(key)
    return list(found.values())


def made_of(keys):
    """Rows by name with the seconds of the processor that each took; a text in the place of one that failed."""
    found = {}
    for key in keys:
        begun = time.process_time()
        try:
            row = make(key)
        except Exception as error:
            row = f"{type(error).__name__}: {error}"
        found[key] = row, time.process_time() - begun
    return found


def main():
    parser = argparse.ArgumentParser(description="Compare the golden table with what is answered today, or write it.")
    parser.add_argument("--only", default="*", help='rows whose name holds this pattern, such as "radars ea"')
    parser.add_argument("--write", action="store_true", help="write the rows into the table")
    parser.add_argument("--seconds", action="store_true", help="print the seconds of every row")
    parser.add_argument("--jobs", type=int, default=2, help="processes that make rows (default 2)")
    given = parser.parse_args()
    keys = [key for key in ROWS if fnmatch.fnmatch(key, given.only) or fnmatch.fnmatch(key, f"*{given.only}*")]
    table, moved = stored(), 0
    with ProcessPoolExecutor(given.jobs, multiprocessing.get_context("spawn")) as pool:
        for done in as_completed([pool.submit(made_of, batch) for batch in batches(keys)]):
            for key, (row, seconds) in done.result().items():
                if given.seconds:
                    print(f"{key}: {seconds:.1f} s", flush=True)
                if isinstance(row, str):
                    said = [row]
                elif given.write:
                    write({key: row})
                    continue
                else:
                    said = differences(table[key], row) if key in table else ["not in the table"]
                if said:
                    moved += 1
                    print(key, *said, sep="\n    ", flush=True)
    print(f"{moved} of {len(keys)} rows {'failed' if given.write else 'moved'}")
    return int(moved > 0)


if __name__ == "__main__":
    sys.exit(main())
