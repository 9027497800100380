"""Sensors that know next to nothing of where they stand: found from detections without names, or said not to be."""

import numpy as np
import pandas as pd
import pytest

import probcal as pc
from probcal.errors import FitError
from probcal.geometry import bearing, elevation, norm

TIME = np.arange(40.0)
REPORT = pc.Detection(0.9, clutter=3.0, view=pc.Sector(range=3000.0))
METHOD = pc.SelfConfiguration(pc.MAP(), start="beliefs")


@pc.sensor(range=pc.Channel("m", std=5.0), azimuth=pc.Channel("rad", std=0.01, wrap=True))
def radar(target, pose):
    """Range and azimuth in the node's own axes."""
    line = pose.local(target.position)
    return dict(range=norm(line), azimuth=bearing(line))


@pc.sensor(range=pc.Channel("m", std=5.0), azimuth=pc.Channel("rad", std=0.01, wrap=True))
def late_radar(target, pose, *, clock=pc.Bias("s", 3.0)):
    """A radar whose clock is wrong: it reports where a target is so many seconds later."""
    line = pose.local(target.at(clock).position)
    return dict(range=norm(line), azimuth=bearing(line))


@pc.sensor(
    range=pc.Channel("m", std=5.0),
    azimuth=pc.Channel("rad", std=0.01, wrap=True),
    elevation=pc.Channel("rad", std=0.01),
)
def space_radar(target, pose):
    """Range, azimuth and elevation in the node's own axes."""
    line = pose.local(target.position)
    return dict(range=norm(line), azimuth=bearing(line), elevation=elevation(line))


def network(scale, kind=radar, first=radar, d=2, report=REPORT):
    nodes = [pc.Node("west", (0.0,) * d), pc.Node("east", (1000.0, *(0.0,) * (d - 1)), scale=scale)]
    return pc.Network([first.on(nodes[0], detection=report), kind.on(nodes[1], detection=report)])


def paths(seed, d=2):
    rng = np.random.default_rng(seed)
    low, high = [-800.0, -800.0, 100.0][:d], [1500.0, 1500.0, 600.0][:d]
    speed = [15.0, 15.0, 5.0][:d]
    return {f"t{k}": rng.uniform(low, high) + np.outer(TIME, rng.uniform(-1, 1, d) * speed) for k in range(4)}


def fitted(simulated, stated, biases, tracks, seed):
    """The tree of a fit of detections of some networks."""
    d = stated.dimension
    motion = dict.fromkeys(tracks, pc.ConstantVelocity(0.5))
    table = pc.simulate(simulated, motion, TIME, tracks=tracks, biases=biases, key=seed).table
    start = {"position": ((300.0,) * d, 1500.0), "velocity": ((0.0,) * d, 12.0)}
    problem = pc.Problem(stated, pc.Target(pc.ConstantVelocity(0.5), start), table)
    return pc.fit(problem, METHOD, prior=pc.Gaussian())


def check(tree, biases):
    """Settled, four objects, and every bias within four sds."""
    assert tree.attrs["status"] == "converged", tree.attrs["message"]
    assert tree.attrs["objects"] == 4
    for label, value in biases.items():
        mean, sd = (float(tree["calibration"][k].sel(bias_label=label)) for k in ("mean", "sd"))
        assert abs(mean - value) < 4 * sd, label


@pytest.mark.slow
def test_a_radar_turned_anyhow_and_far_from_where_it_is_stated():
    """Hundreds of metres off, its heading anywhere: the biases within four sds, in one round or two."""
    biases = {"east.position_x": -320.0, "east.position_y": 410.0, "east.heading": 2.4}
    whole = network({"position": 500.0, "heading": 2.0})
    tree = fitted(whole, whole, biases, paths(1), 1)
    check(tree, biases)
    assert tree.attrs["rounds"] <= 2


@pytest.mark.slow
def test_a_radar_in_space():
    biases = {"east.position_x": 120.0, "east.position_y": -80.0, "east.position_z": 60.0, "east.heading": 0.5}
    report = pc.Detection(0.9, 3.0, view=pc.Sector(range=3000.0), limits={"elevation": (-1.5, 1.5)})
    whole = network({"position": 150.0, "heading": 0.5}, space_radar, space_radar, 3, report)
    check(fitted(whole, whole, biases, paths(2, 3), 2), biases)


@pytest.mark.slow
def test_a_clock_that_is_declared_is_found():
    biases = {"east.position_x": 30.0, "east.heading": 0.05, "east.clock": 4.0}
    whole = network({"position": 50.0, "heading": 0.1}, late_radar)
    check(fitted(whole, whole, biases, paths(0), 0), biases)


@pytest.mark.slow
def test_a_clock_that_nobody_declared_is_a_misfit():
    """Objects that fit only with another clock run beside themselves: no confident answer."""
    scale = {"position": 50.0, "heading": 0.1}
    biases = {"east.position_x": 30.0, "east.heading": 0.05, "east.clock": 4.0}
    tree = fitted(network(scale, late_radar), network(scale), biases, paths(0), 0)
    assert tree.attrs["status"] == "misfit"
    assert "the two differ by what no bias allows for" in tree.attrs["message"]


@pytest.mark.slow
def test_two_poses_that_explain_as_much_are_named():
    """Two objects that change places when the scene is turned by half about the second radar."""
    middle = np.array([1000.0, 0.0])
    one = np.array([400.0, -300.0]) + np.outer(TIME, (6.0, 8.0))
    whole = network({"position": 50.0, "heading": 2.0})
    tree = fitted(whole, whole, {"east.heading": 0.3}, {"a": one, "b": 2 * middle - one}, 0)
    assert tree.attrs["status"] == "not converged"
    assert "Several poses explain the detections as well (how many): east" in tree.attrs["message"]


@pytest.mark.slow
def test_one_sensor_of_three_that_reports_clutter_alone_is_named():
    """The radar that sees no object is not placed, and there is no fit with it; the other is found beside it."""
    biases = {"east.position_x": -120.0, "east.position_y": 150.0, "east.heading": 0.4}
    wide = {"position": 200.0, "heading": 0.6}
    nodes = [
        pc.Node("west", (0.0, 0.0)), pc.Node("east", (1000.0, 0.0), scale=wide),
        pc.Node("north", (0.0, 1000.0), scale=wide),
    ]  # fmt: skip
    whole = pc.Network([radar.on(node, detection=REPORT) for node in nodes])
    tracks = paths(1)
    motion = dict.fromkeys(tracks, pc.ConstantVelocity(0.5))
    table = pc.simulate(whole, motion, TIME, tracks=tracks, biases=biases, key=1).table
    rng = np.random.default_rng(0)
    false = [
        (t, "north", rng.uniform(0, 3000.0), rng.uniform(-np.pi, np.pi))
        for t in TIME for _ in range(max(rng.poisson(REPORT.clutter), 1))
    ]  # fmt: skip
    clutter = pd.DataFrame(false, columns=["time", "sensor", "range", "azimuth"])
    table = pd.concat([table[table["sensor"] != "north"], clutter], ignore_index=True)
    start = {"position": ((300.0, 300.0), 1500.0), "velocity": ((0.0, 0.0), 12.0)}
    problem = pc.Problem(whole, pc.Target(pc.ConstantVelocity(0.5), start), table)
    with pytest.raises(FitError, match="No detection of north belongs to an object that is confirmed"):
        pc.fit(problem, METHOD, prior=pc.Gaussian())
    found = pc.propagate_beliefs(problem)
    assert found.apart == ("north",)
    sd = np.sqrt(np.diag(found.covariance))
    for label, value in biases.items():
        m = problem.labels.index(label)
        assert abs(found.z[m] - value / problem.scales[m]) < 4 * sd[m], label
