"""Worlds that the tests share: small linear networks whose posterior `reference` knows exactly, and their fits.

Sensor types stand at the level of the module and every world is built once, so that one set of kernels serves all
tests of a worker. To save minutes, take a world from here (and, with `fitted`, its fit) before making a new one.
"""

from functools import cache

import numpy as np
import pandas as pd
import reference

import probcal
from probcal import (
    Bias,
    Channel,
    ConstantVelocity,
    Drift,
    Network,
    Node,
    Path,
    RandomWalk,
    Static,
    Target,
    White,
    sensor,
)
from probcal.gaussian.frame import frame_at
from probcal.gaussian.mode import Point
from probcal.inference import calibrate
from probcal.inference.hierarchy import hierarchy_of
from probcal.inference.posed import Form, Posed

fix = probcal.sensors.position


@sensor(level=Channel("dB", std=0.4))
def meter(target, pose, *, gain=Bias("dB", 2.0), common=Bias("dB", 0.7, nominal=3.0, shared="type")):
    line = target.position[0] - pose.position[0]
    return {"level": target.power + gain + 0.5 * common + 0.1 * line}


@sensor(arrival=Channel("m", std=0.5))
def pulse(target, pose):
    line = target.position[1] - pose.position[1]
    return {"arrival": 0.3 * line + 0.2 * target.velocity[0] + target.emission + pose.clock}


@sensor(difference=Channel("m", std=0.6), height=Channel("m", std=0.9))
def pair(target, first, second, *, difference_offset=Bias("m", 1.5)):
    shift = 0.7 * (second.position[0] - first.position[0]) - 0.2 * first.position[1]
    shift = shift + 0.4 * target.position[1]
    return {
        "difference": shift + second.clock - first.clock + difference_offset,
        "height": target.position[1] - 0.5 * second.position[1],
    }


@sensor(level=Channel("dB", std=0.4))
def gauge(
    target,
    pose,
    *,
    gain=Bias("dB", 2.0, drift=Drift((0.0, 0.75, 1.7, 3.1), std=1.1)),
    common=Bias("dB", 0.7, nominal=3.0, shared="type", drift=Drift((0.0, 3.0), scale=0.4)),
):
    return {"level": target.position[0] + gain + 0.5 * common - 0.1 * pose.position[0]}


def table_of(network, times, seed, missing=0.25, silent=None):
    """Every sensor sees every target at its times; random numbers, some blank, and one epoch without any."""
    random, rows = np.random.default_rng(seed), []
    for target, when in times.items():
        for t in when:
            for placed in network.sensors:
                names = [name for name, _ in placed.type.expand(network.dimension)]
                values = dict(zip(names, 4.0 * random.standard_normal(len(names)), strict=True))
                gone = random.uniform(size=len(names)) < missing
                if t == silent:
                    gone[:] = True
                rows.append(
                    {"time": t, "sensor": placed.name, "target": target}
                    | {name: np.nan if g else v for (name, v), g in zip(values.items(), gone, strict=True)}
                )
    return pd.DataFrame(rows)


def plane():
    """2-D, constant velocity of full rank, two targets of one motion, own noise levels in some rows."""
    nodes = [
        Node("a", (0.0, 1.0), 0.4, scale=2.0),
        Node("b", (5.0, -2.0), -1.3, scale=1.0),
        Node("c", (-3.0, 4.0), survey=0.5),
    ]
    network = Network([fix.on(node) for node in nodes])
    motion = Target(ConstantVelocity(0.8), start={"position": ((1.0, -1.0), 6.0), "velocity": (0.3, 1.5)})
    times = {"one": [0.0, 0.5, 1.5, 2.0, 4.0], "two": [0.2, 0.5, 2.0, 3.5]}
    table = table_of(network, times, 1, silent=2.0)
    row = np.arange(len(table))
    table["position_x_std"] = np.where(row % 3 == 0, 0.7 + 0.1 * row, np.nan)
    return network, motion, table, {}


def space():
    """3-D, singular constant velocity, known attitude, a survey, and biases fixed at non-zero values."""
    nodes = [
        Node("a", (0.0, 1.0, 2.0), 0.4, pitch=0.3, roll=-0.6, scale=2.0),
        Node("b", (5.0, -2.0, 0.0), -1.3, pitch=-0.2, roll=0.9, scale=1.0),
        Node("c", (-3.0, 4.0, 1.0), 2.0, survey=0.3),
    ]
    network = Network([fix.on(node) for node in nodes])
    start = {"position": (0.5, 4.0), "velocity": (0.0, 1.0)}
    motion = Target(ConstantVelocity(0.9, singular=True), start)
    table = table_of(network, {"one": [0.0, 1.0, 1.7, 3.0], "two": [1.0, 1.7, 2.0]}, 2, silent=1.7)
    return network, motion, table, {"a.position_x": 1.7, "b.position_z": -0.8}


def extras():
    """White emission and a drifting power, clocks, a bias shared by its type with a nominal value."""
    nodes = [
        Node("a", (0.0, 1.0), scale={"position": 2.0, "clock": 1.0}),
        Node("b", (5.0, -2.0), clock=0.5, scale={"clock": 2.0}),
        Node("c", (-3.0, 4.0), survey={"clock": 0.2}),
    ]
    placed = [fix.on(nodes[0], name="fix")]
    placed += [kind.on(node, name=f"{kind.name}_{node.name}") for kind in (meter, pulse) for node in nodes]
    network = Network(placed)
    moving = ConstantVelocity(0.8) + White("emission", "m", 3.0, mean=1.2)
    moving = moving + RandomWalk("power", "dB", 0.5, (4.0, 2.0))
    motion = Target(moving, start={"position": (0.5, 4.0), "velocity": (0.0, 1.0)})
    table = table_of(network, {"target": [0.0, 1.0, 1.7, 3.0, 3.2]}, 3, silent=1.7)
    return network, motion, table, {"meter_b.gain": 0.9}


def mixed():
    """Different motions (one static, two of one layout), a two-node sensor, a node on a known path."""
    path = Path([0.0, 2.0, 5.0], [(0.0, 0.0), (3.0, 1.0), (2.0, 6.0)], [0.0, 1.0, 4.0])
    robot = Node("robot", path=path, scale=1.2)
    box = Node("box", (5.0, -2.0), 0.7, scale={"position": Bias("m", 0.8), "clock": 1.0})
    network = Network([fix.on(robot), fix.on(box, name="box_fix"), pair.on(robot, box)])
    start = {"position": ((2.0, 1.0), 5.0), "velocity": (0.0, 1.0)}
    motion = {
        "walker": Target(ConstantVelocity(0.8), start),
        "car": Target(ConstantVelocity(0.7, singular=True), start),
        "rock": Target(Static(), {"position": (-1.0, 4.0)}),
    }
    times = {"walker": [0.0, 1.0, 2.5, 4.0], "rock": [0.5, 1.0, 3.0], "car": [0.1, 1.0, 2.6, 3.0]}
    table = table_of(network, times, 4)
    return network, motion, table, {}


def drifting():
    """Drifting position, survey, clock, gain and shared bias, each with times of its own; one step fixed."""
    walk, jumps = Drift((0.0, 1.0, 2.5), std=0.7), Drift((-9.0, -5.0, 1.7), scale=1.3)
    nodes = [
        Node("a", (0.0, 1.0), scale={"position": Bias("m", 2.0, drift=walk), "clock": Bias("m", 1.0, drift=jumps)}),
        Node("b", (5.0, -2.0), survey={"position": Bias("m", 0.5, drift=Drift((0.0, 3.0), std=0.2)), "clock": 0.3}),
    ]

    network = Network([kind.on(n, name=f"{kind.name}_{n.name}") for kind in (fix, gauge, pulse) for n in nodes])
    motion = Target(
        ConstantVelocity(0.8) + White("emission", "m", 3.0), start={"position": (0.5, 4.0), "velocity": (0.0, 1.0)}
    )
    table = table_of(network, {"one": [0.0, 1.0, 1.7, 3.0, 3.2], "two": [0.5, 1.0, 2.0, 3.5]}, 5, silent=1.7)
    return network, motion, table, {"gauge_b.gain@1.7": 0.6}


def shifted(offset=8.0):
    """The plane world with one bias that is plainly there: of the same form, so that nothing is compiled for it."""
    network, motion, table, _ = plane()
    table.loc[table["sensor"] == "a", "position_x"] += offset
    return network, motion, table, {}


LINEAR = {make.__name__: make for make in (plane, space, extras, mixed, drifting)}
DRAWN = ("plane", "mixed")  # worlds whose fit keeps its draws


def resting(problem):
    """A start for a fit: trajectories without process noise, biases zero."""
    states = []
    for part in problem.model.recursions:
        x, track = np.zeros(part.drift.shape[1]), []
        for F, drift in zip(np.asarray(part.F), np.asarray(part.drift), strict=True):
            x = F @ x + drift
            track.append(x)
        states.append(np.array(track))
    zeros = tuple(np.zeros_like(x) for x in states)
    return Point(tuple(states), zeros, np.zeros(len(problem.labels)), np.zeros(len(problem.levels)))


@cache
def linear(name):
    """A world as a problem and in its naive form."""
    network, motion, table, fixed = (LINEAR | {"shifted": shifted})[name]()
    problem = probcal.Problem(network, motion, table, fix=fixed)
    return problem, reference.Linear(network, motion, table, fixed)


@cache
def exact(name):
    """The posterior of a world under a standard normal prior, from its dense joint Gaussian."""
    naive = linear(name)[1]
    return reference.dense(naive, np.ones(len(naive.labels)))


@cache
def fitted(name):
    """The fit of a world by MAP under a standard normal prior: exact, so that nobody needs to fit it again.

    It is the tree as its method leaves it: some worlds have data that their model did not make, which `fit` widens.
    """
    problem, _ = linear(name)
    save = ("states", "predictive") if name in DRAWN else ()
    prior = probcal.priors.Gaussian()
    return calibrate(problem, probcal.MAP(), prior=prior, start=resting(problem), save=save)[0]


@sensor(height=Channel("m", std=1.0))
def ruler(target, pose, *, shift=Bias("m", 1.0)):
    return {"height": target.position[1] - pose.position[1] + shift}


def heights(run, size=2):
    """A problem of `size` rulers and its truth, for studies: a new world with every run."""
    network = Network([ruler.on(Node(f"n{k}", (0.0, float(k)))) for k in range(size)])
    drawn = probcal.simulate(network, ConstantVelocity(1.0), np.arange(4.0), key=run)
    return probcal.Problem(network, ConstantVelocity(1.0), drawn.table), drawn.truth


@cache
def small(kind=probcal.sensors.radar, motion=None, missing=0.2, scans=4):
    """Two radars, one of them on a surveyed node, and a few scans of each target."""
    nodes = [Node("a", (0.0, 0.0), scale={"heading": 0.1}), Node("b", (400.0, 0.0), survey={"position": 3.0})]
    network = Network([kind.on(node) for node in nodes])
    start = {"position": ((100.0, 200.0), 5.0), "velocity": ((20.0, 3.0), 2.0)}
    motion = Target(ConstantVelocity(1.0), start) if motion is None else motion(start)
    time = np.arange(float(scans))
    drawn = probcal.simulate(network, motion, time, key=1, missing=missing)
    return probcal.Problem(network, motion, drawn.table)


def two_motions(start):
    """Two recursions, and a process noise that is not known."""
    bent = probcal.ConstantAcceleration(0.5)
    return {"one": Target(ConstantVelocity(probcal.Unknown(1.0)), start), "two": Target(bent, start)}


def posed_of(problem, prior):
    """The package's own form of the posterior, its frame where the motion leads without noise."""
    form = Form(problem.model.biases, hierarchy_of(prior, problem))
    frame = frame_at(problem.model, resting(problem))
    return form, Posed(problem.model, frame, prior.precision(problem.labels, problem.surveyed))
