"""A bent network of radars and ears for tests of the sparse form, and the libraries of factors."""

from dataclasses import replace
from functools import cache

import numpy as np

import probcal as pc
from probcal.geometry import bearing, norm

TIME = np.arange(30.0)
MOTION = {"car": pc.ConstantVelocity(1.0), "van": pc.ConstantVelocity(1.0), "mast": pc.Static()}
LIBRARIES = ("cholmod", "superlu")


@pc.sensor(range=pc.Channel("m", std=2.0), azimuth=pc.Channel("rad", std=0.02, wrap=True))
def radar(target, pose, *, range_offset=pc.Bias("m", 3.0), gain=pc.Bias("1", 0.01, shared="type")):
    """Range with an offset of its own and a gain of its type, and azimuth."""
    line = pose.local(target.position)
    return dict(range=(1 + gain) * norm(line) + range_offset, azimuth=bearing(line))


half_radar = replace(radar, channels=radar.channels | {"range": pc.Channel("m", std=1.0)})


@pc.sensor(azimuth=pc.Channel("rad", std=0.01, wrap=True))
def ear(target, pose):
    """Azimuth alone."""
    return dict(azimuth=bearing(pose.local(target.position)))


@pc.sensor(azimuth=pc.Channel("rad", std=pc.Unknown(0.02), wrap=True))
def loud_ear(target, pose):
    """Azimuth alone, of unknown noise."""
    return dict(azimuth=bearing(pose.local(target.position)))


@pc.sensor(range=pc.Channel("m", std=pc.Unknown(1.0), noise=pc.StudentT(4.0)))
def sonar(target, pose, *, range_offset=pc.Bias("m", 2.0, drift=pc.Drift([0.0, 6.0], scale=1.0))):
    """Range of unknown noise with heavy tails."""
    return dict(range=pc.geometry.norm(target.position - pose.position) + range_offset)


@cache
def loud():
    """Unknown levels and heavy tails of data and of process noise, a bias that drifts."""
    places = [(0.0, 0.0), (300.0, 0.0), (0.0, 300.0), (300.0, 300.0)]
    nodes = [pc.Node(f"n{k}", p, scale={"position": 3.0} if k > 1 else None) for k, p in enumerate(places)]
    network = pc.Network([*(sonar.on(node) for node in nodes[:3]), loud_ear.on(nodes[3])])
    time = np.arange(12.0)
    way = np.stack([60 + 15 * time, 100 + 40 * np.sin(time / 4)], 1)
    run = pc.simulate(network, pc.ConstantVelocity(1.0), time, key=2, tracks={"t": way})
    return pc.Problem(network, pc.ConstantVelocity(pc.Unknown(1.0), noise=pc.StudentT(4.0)), run.table)


@cache
def drawn():
    """Two moving targets and one at rest, seen by three radars, one surveyed, and two ears; some rows lost."""
    turned = {"heading": 0.05}
    nodes = [
        pc.Node("a", (0.0, 0.0), survey={"position": 0.5}, scale=turned),
        pc.Node("b", (400.0, 0.0), scale={"position": 5.0} | turned),
        pc.Node("c", (0.0, 400.0), scale={"position": 5.0} | turned),
        pc.Node("d", (400.0, 400.0), scale=turned),
        pc.Node("e", (-200.0, 200.0), scale=turned),
    ]
    network = pc.Network([kind.on(node) for kind, node in zip((radar, radar, radar, ear, ear), nodes, strict=True)])
    way = np.stack([np.linspace(50, 350, len(TIME)), 120 + 60 * np.sin(TIME / 5)], 1)
    tracks = {"car": way, "van": way[::-1] + np.array([0.0, 100.0]), "mast": np.array([[150.0, 250.0]])}
    biases = {"b.position_x": 6.0, "c.heading": 0.08, "radar.gain": 0.015, "b.range_offset": -4.0}
    run = pc.simulate(network, MOTION, TIME, key=3, tracks=tracks, biases=biases)
    table = run.table.sample(frac=0.67, random_state=0)
    return pc.Problem(network, MOTION, table), run.truth


@cache
def drawn_in_space():
    """Two moving targets in 3-D, seen by two radars and two rangers, one of them surveyed; some rows lost."""
    kinds = [pc.sensors.radar_3d, pc.sensors.radar_3d, pc.sensors.ranger, pc.sensors.ranger]
    places = [(0.0, 0.0, 0.0), (400.0, 0.0, 30.0), (0.0, 400.0, 60.0), (400.0, 400.0, 0.0)]
    nodes = [
        pc.Node(name, place, **({"survey": {"position": 0.5}} if name == "a" else {"scale": {"position": 4.0}}))
        for name, place in zip("abcd", places, strict=True)
    ]
    network = pc.Network([kind.on(node) for kind, node in zip(kinds, nodes, strict=True)])
    up = np.linspace(60, 160, len(TIME))
    way = np.stack([np.linspace(50, 350, len(TIME)), 120 + 60 * np.sin(TIME / 5), up], 1)
    tracks = {"car": way, "van": way[::-1] + np.array([0.0, 100.0, 20.0])}
    motion = {name: pc.ConstantVelocity(1.0) for name in tracks}
    run = pc.simulate(network, motion, TIME, key=3, tracks=tracks, biases={"b.position_z": 5.0})
    return pc.Problem(network, motion, run.table.sample(frac=0.7, random_state=0)), run.truth
