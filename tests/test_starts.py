"""Starts from the data alone: what a sensor measures, open headings, open places, exchanged nodes; compass bearings."""

import importlib
import itertools
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

import probcal
from probcal import Bias, Channel, ConstantVelocity, InputError, Network, Node, Problem, sensor, simulate
from probcal.geometry import bearing, norm
from probcal.modes import automatic, grid, optima
from probcal.modes.recognise import kinds, seen_directions
from probcal.sensors import doa, radar, ranger, tdoa, toa
from probcal.types import float64

sys.path.insert(0, str(Path(__file__).parents[1] / "models"))
array_model = importlib.import_module("doa_array")


@sensor(
    azimuth=Channel("deg", std=1.0, wrap=True),
    speed=Channel("m/s", std=1.0),
)
def compass_card(target, pose, *, offset=Bias("deg", 5.0)):
    """A bearing clockwise from north in degrees, written out, and something else."""
    line = target.position - pose.position
    return dict(azimuth=jnp.rad2deg(jnp.arctan2(line[0], line[1])) + offset, speed=norm(target.velocity))


@sensor(azimuth=Channel("rad", std=0.01, wrap=True, compass=True))
def compass(target, pose):
    return dict(azimuth=bearing(target.position - pose.position) - pose.heading)


def placed(kind, count=3, **node):
    nodes = [Node(f"n{k}", (40.0 * k, 15.0 * k**2), **node) for k in range(count)]
    if kind.arity == 2:
        return Network([kind.on(a, b) for a, b in itertools.pairwise(nodes)])
    return Network([kind.on(n) for n in nodes])


def rows_of(network, motion, **settings):
    path = np.stack([np.linspace(-30.0, 110.0, 12), 40.0 + 20.0 * np.sin(np.linspace(0, 3, 12))], 1)
    return simulate(network, motion, np.arange(12.0), key=1, tracks={"target": path}, **settings)


@pytest.mark.parametrize(
    ("kind", "channel", "family", "sign", "shift"),
    [
        (doa, "azimuth", "azimuth", 1.0, 0.0),
        (radar, "range", None, None, None),
        (radar, "azimuth", "azimuth", 1.0, 0.0),
        (toa, "arrival", None, None, None),
        (tdoa, "difference", None, None, None),
        (compass_card, "azimuth", "azimuth", -1.0, np.pi / 2),
        (compass_card, "speed", None, None, None),
    ],
    ids=lambda v: getattr(v, "name", str(v)),
)
@float64
def test_what_a_function_measures_is_found_by_trying_it(kind, channel, family, sign, shift):
    motion = ConstantVelocity(1.0)
    for component in sorted(kind.target_components & {"power", "emission"}):
        motion = motion + probcal.RandomWalk(component, "1", 1.0, (50.0, 10.0))
    network = placed(kind)
    rows = pd.DataFrame({"time": [0.0, 1.0], "sensor": network.sensors[0].name, channel: [1.0, 1.1]})
    found = kinds(Problem(network, motion, rows)).get((kind.name, channel))
    if family is None:
        assert found is None
        return
    assert found.family == family
    assert abs(found.sign - sign) < 1e-6
    assert shift is None or abs(found.shift - shift) < 1e-6
    assert ("offset" in found.by) == (kind is compass_card)


@float64
def test_compass_bearings_are_turned_at_the_door():
    """Three lines of data: north, east, and a quarter left of north."""
    rows = pd.DataFrame({"time": [0.0, 1.0, 2.0], "sensor": "n0", "azimuth": np.deg2rad([0.0, 90.0, 315.0])})
    problem = Problem(placed(compass, 1), ConstantVelocity(1.0), rows)
    value = problem.measurements.value[:, 0]
    np.testing.assert_allclose(np.exp(1j * value), np.exp(1j * np.deg2rad([90.0, 0.0, 135.0])), atol=1e-12)
    again = problem.redrawn([np.asarray(rows_.y) for rows_ in problem.model.rows])
    np.testing.assert_allclose(again.measurements.table.frame["azimuth"], rows["azimuth"], atol=1e-12)
    np.testing.assert_allclose(seen_directions(problem)[0].angles[:, 0] % (2 * np.pi), value % (2 * np.pi), atol=1e-12)
    run = rows_of(placed(compass), ConstantVelocity(1.0))
    plain = rows_of(placed(doa), ConstantVelocity(1.0))
    left = (run.table["azimuth"] + plain.table["azimuth"] - np.pi / 2 + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(left).max() < 0.2  # two noises apart
    with pytest.raises(InputError, match=r"compass=True\): a compass bearing wraps; give wrap=True too"):
        Channel("rad", compass=True)


@float64
def test_a_network_that_is_known_well_has_one_start_and_no_trials(monkeypatch):
    """The families are not asked where no heading and no place is open."""
    network = placed(radar, scale={"position": 3.0, "heading": 0.05})
    motion = ConstantVelocity(1.0)
    problem = Problem(network, motion, rows_of(network, motion, biases={"n1.heading": 0.05}).table)
    monkeypatch.setattr("probcal.modes.bearings.seen_directions", lambda problem: pytest.fail("not needed"))
    assert len(optima(problem)) == 1


@pytest.mark.parametrize("turn", [1.6, 3.1])
@float64
def test_radars_of_any_heading_start_right(turn):
    """At half a turn the wrapped innovations cancel, and no descent moves the heading."""
    network = placed(radar, scale={"heading": Bias("rad", 2.0)})
    motion = ConstantVelocity(1.0)
    biases = {"n0.heading": turn, "n1.heading": -turn, "n2.heading": 0.1, "n0.range_offset": 0.0}
    fix = ("*.range_offset",)
    run = rows_of(network, motion, biases=biases | {f"n{k}.range_offset": 0.0 for k in range(3)})
    problem = Problem(network, motion, run.table, fix=fix)
    found = dict(zip(problem.labels, np.asarray(optima(problem)[0].point.z) * problem.scales, strict=True))
    for label, value in found.items():
        assert abs((value - biases[label] + np.pi) % (2 * np.pi) - np.pi) < 0.15, (label, value)


def off_by(problem, truth, point):
    """Largest error of a place in m and of a heading in rad."""
    z = np.asarray(point.z) * problem.scales
    places, turns = [], []
    for label, value in zip(problem.labels, z, strict=True):
        error = value - truth.biases[label]
        if "position" in label:
            places.append(abs(error))
        else:
            turns.append(abs((error + np.pi) % (2 * np.pi) - np.pi))
    return max(places, default=0.0), max(turns)


@pytest.mark.parametrize(
    "space", [pytest.param(False, marks=pytest.mark.ci), pytest.param(True, marks=pytest.mark.slow)],
    ids=["plane", "space"],
)  # fmt: skip
@float64
def test_an_array_of_which_nothing_is_known_starts_right(space):
    """The five sensors of the DOA paper, headings drawn from all around, places unknown: 3 runs each."""
    for run in range(3):
        problem, truth = array_model.problem(run=run, space=space), array_model.truth(run=run, space=space)
        place, turn = off_by(problem, truth, optima(problem)[0].point)
        assert place < 8.0
        assert turn < np.deg2rad(2.0)


@pytest.mark.ci
@float64
def test_open_headings_of_known_places_are_found_by_crossings():
    """A target that winds, so that no single sensor's track tells anything; sensors turned at will."""
    nodes = [Node(f"n{k}", p, scale={"heading": Bias("rad", 2.0)}) for k, p in enumerate(array_model.PLACES)]
    network, motion = Network([doa.on(n) for n in nodes]), ConstantVelocity(3.0)
    t = np.arange(60.0)
    path = np.stack([60 + 90 * np.sin(0.23 * t), -10 + 70 * np.cos(0.37 * t)], 1)
    rng = np.random.default_rng(0)
    biases = {f"n{k}.heading": float(rng.uniform(-np.pi, np.pi)) for k in range(5)}
    run = simulate(network, motion, t, key=2, biases=biases, tracks={"target": path}, missing=0.2)
    problem = Problem(network, motion, run.table)
    assert off_by(problem, run.truth, optima(problem)[0].point)[1] < np.deg2rad(2.0)


@pytest.mark.ci
@float64
def test_exchanged_nodes_are_found_without_being_asked_for():
    places = [(0, 0), (60, 5), (70, 60), (5, 55), (30, -5), (35, 62)]
    stated = [places[k] for k in (0, 3, 2, 1, 4, 5)]
    network = Network([ranger.on(Node(f"n{k}", p, scale=3.0)) for k, p in enumerate(stated)])
    motion = ConstantVelocity(0.5)
    shift = {f"n{k}.position_{a}": float(places[k][i] - stated[k][i]) for k in range(6) for i, a in enumerate("xy")}
    rest = {label: 0.0 for label in network.labels if label not in shift}
    t = np.arange(60.0)
    path = np.stack([30 + 35 * np.sin(0.11 * t), 30 + 30 * np.sin(0.17 * t)], 1)
    run = simulate(network, motion, t, key=0, biases=shift | rest, tracks={"target": path})
    problem = Problem(network, motion, run.table, fix=("*.range_*",))
    best = optima(problem)[0].point
    found = dict(zip(problem.labels, np.asarray(best.z) * problem.scales, strict=True))
    assert max(abs(found[label] - value) for label, value in shift.items()) < 3.0


@pytest.mark.ci
@float64
def test_one_bearing_sensor_alone_gives_no_confident_answer():
    """The start must not fail, and the fit must not call the open heading and places determined."""
    network = Network([doa.on(Node("n0", (0.0, 0.0), scale={"heading": Bias("rad", 2.0), "position": 50.0}))])
    motion = ConstantVelocity(1.0)
    run = rows_of(network, motion, biases=dict.fromkeys(network.labels, 0.0))
    problem = Problem(network, motion, run.table)
    assert len(optima(problem)) >= 1
    found = probcal.observability(problem)
    assert found["bias"]["gamma"].max() < 0.5 if "gamma" in found["bias"] else True


@pytest.mark.ci
@float64
def test_collinear_sensors_of_open_headings_are_no_failure():
    nodes = [Node(f"n{k}", (40.0 * k, 0.0), scale={"heading": Bias("rad", 2.0)}) for k in range(3)]
    network, motion = Network([doa.on(n) for n in nodes]), ConstantVelocity(1.0)
    run = rows_of(network, motion, biases={"n0.heading": 1.0, "n1.heading": -2.0, "n2.heading": 3.0})
    problem = Problem(network, motion, run.table)
    found = optima(problem)
    assert all(np.isfinite(one.value) for one in found)
    # a mirror about the line turns every bearing round: it is told apart by the headings alone
    assert off_by(problem, run.truth, found[0].point)[1] < 0.2


def test_the_place_to_add_a_family_is_one_tuple():
    assert automatic.FAMILIES
    assert all(callable(family) for family in automatic.FAMILIES)


def test_the_cheapest_path_is_that_of_all_paths():
    drawn = np.random.default_rng(1)
    loss, places, steps = drawn.random((4, 5)), drawn.random((5, 2)), np.array([0.5, 0.4, 0.7])

    def price(path):
        moves = np.diff(places[list(path)], axis=0) / steps[:, None]
        return loss[np.arange(4), list(path)].sum() + 0.5 * (moves**2).sum()

    assert tuple(grid._viterbi(loss, places, steps)) == min(itertools.product(range(5), repeat=4), key=price)
