"""Residuals that follow the geometry, and readings that are counted another way."""

import re
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
import reference
import worlds

import probcal
from probcal import Bias, Channel, ConstantVelocity, Network, Node, Problem, Unknown, sensor
from probcal.analysis.check import Case
from probcal.analysis.pieces import contrast
from probcal.analysis.slopes import SAID, TOLD, _Looked
from probcal.geometry import bearing, elevation, norm
from probcal.inference.fitted import take_up
from probcal.simulate import as_key, derived_keys
from probcal.types import float64

sys.path.insert(0, str(Path(__file__).parents[1] / "models"))
import networks

PLACES = np.array([(0, 0), (4000, 300), (3800, 4200), (-200, 3900)], float)
TIME = np.arange(0.0, 600.0, 5.0)
PATH = np.stack([2000 + 1700 * np.sin(0.013 * TIME), 2000 + 1500 * np.sin(0.021 * TIME + 1)], 1)
NAMES = {"jnp": jnp, "bearing": bearing, "norm": norm, "elevation": elevation}


def finder(added="0.0", channel=None, **biases):
    """A direction finder, to whose azimuth a formula is added."""
    kind = channel or Channel("rad", std=np.deg2rad(1.0), wrap=True)
    names = "".join(f", {name}=biases['{name}']" for name in biases)
    given = {"channel": kind, "biases": biases, "sensor": sensor, **NAMES}
    exec(
        "@sensor(azimuth=channel)\n"
        f"def finder(target, pose{', *' * bool(biases)}{names}):\n"
        f"    a = bearing(target.position - pose.position)\n"
        f"    return {{'azimuth': a - pose.heading + {added}}}",
        given,
    )
    return given["finder"]


def drawn(seed, curve=(), turned=()):
    """Bearings of four finders: amplitudes of the errors that go with the direction, and which count from north."""
    rng, rows = np.random.default_rng(seed), []
    for k, place in enumerate(PLACES):
        line = PATH - place
        a = np.arctan2(line[:, 1], line[:, 0]) + np.deg2rad(1.0) * rng.standard_normal(len(TIME))
        east, north = curve[k] if curve else (0.0, 0.0)
        a += east * np.cos(a) + north * np.sin(a)
        a = np.pi / 2 - a if k in turned else a
        rows.append(pd.DataFrame({"time": TIME, "sensor": f"d{k}", "azimuth": np.angle(np.exp(1j * a))}))
    return pd.concat(rows)


def network(kind):
    scale = {"heading": np.deg2rad(5.0)}
    return Network([kind.on(Node(f"d{k}", place, scale=scale), name=f"d{k}") for k, place in enumerate(PLACES)])


def checked(table, kind=None, engine="auto"):
    problem = Problem(network(kind or finder()), ConstantVelocity(Unknown(1.0)), table)
    return problem, probcal.assess(problem, probcal.fit(problem, probcal.EA(engine=engine)))


def said(tree, kind):
    found = tree["finding"].to_dataset()
    return found["sentence"].values[found["kind"].values == kind].tolist()


@pytest.fixture
def looked(monkeypatch):
    """The shapes of a world's fit, of few data too."""
    monkeypatch.setattr("probcal.analysis.regressors.FEWEST", 3)

    def of(name):
        problem, _ = worlds.linear(name)
        tree = worlds.fitted(name)
        return _Looked(Case(float64(take_up)(problem, tree), tree, None, derived_keys(as_key(0), range(3))))

    return of


@pytest.mark.parametrize("name", ["plane", "space"])
@float64
def test_a_shape_is_tested_as_in_a_dense_joint_posterior(name, looked):
    own = looked(name)
    M, compared = own.fit.problem.model.biases, 0
    for part in {(shape.name, shared) for shape, shared in own.shapes.items()}:
        wider = own.widened([shape for shape, shared in own.shapes.items() if (shape.name, shared) == part])
        naive = reference.NaiveEngine().at(wider.at.model, wider.at.point, wider.at.rows)
        whole, slope = np.asarray(naive.information()), np.asarray(naive.slope())
        prior = np.diag(np.minimum(own.fit.factors.diagonal(M), 1.0))
        known = np.linalg.inv(whole[:M, :M] + prior)
        tested = own.tests(wider)
        for k, members in enumerate(wider.members):
            mine = members[members < len(whole)]
            cross = whole[np.ix_(mine, np.arange(M))]
            information = whole[np.ix_(mine, mine)] - cross @ known @ cross.T
            score = slope[mine] - cross @ known @ (slope[:M] - prior @ own.fit.point.z)
            size = np.sqrt(wider.alone[mine])
            expected = contrast(information / np.outer(size, size), score / size, TOLD) if size.all() else None
            if expected is not None:
                np.testing.assert_allclose(tested[k].square, expected.square, rtol=1e-4, atol=1e-6)
                compared += 1
    assert compared > 5


@float64
def test_every_shape_is_tried_where_it_can_be(looked):
    found = {(shape.name, shared) for shape, shared in looked("space").shapes.items()}
    assert {name for name, _ in found} == set(SAID)
    assert {shared for _, shared in found} == {True, False}
    assert {shape.name for shape in looked("plane").shapes} == set(SAID) - {"elevation"}


@pytest.mark.ci
def test_a_deviation_curve_is_named_and_what_is_advised_mends_it():
    curve = [(0.16, 0.10), (0.0, 0.0), (0.0, 0.0), (-0.10, 0.15)]
    table = drawn(0, curve)
    _, tree = checked(table)
    (text,) = said(tree, "slope")
    assert text.startswith(("d0.azimuth, d3.azimuth: ", "d3.azimuth, d0.azimuth: "))
    assert "follow the direction of the target" in text
    for silent in ("nis", "level", "rest", "predictive", "drifting"):  # signs of it
        assert not said(tree, silent), silent
    assert set(tree["verdict"]["verdict"].values.tolist()) >= {"weak"}
    formula, unit, size = re.search(
        r'add (.*) to azimuth of finder, a = probcal.geometry.bearing\(.*\), .* north=Bias\("(.*)", (.*)\)', text
    ).groups()
    kind = finder(formula, east=Bias(unit, float(size)), north=Bias(unit, float(size)))
    problem, tree = checked(table, kind)
    assert said(tree, "slope") == said(tree, "widened") == []
    answer = tree["calibration"].to_dataset()
    true = {
        f"d{k}.{name}": value for k, own in enumerate(curve) for name, value in zip(("east", "north"), own, strict=True)
    }
    true |= {f"d{k}.heading": 0.0 for k in range(4)}
    away = [(float(answer["mean"][m]) - true[name]) / float(answer["sd"][m]) for m, name in enumerate(problem.labels)]
    assert max(map(abs, away)) < 4.0


@pytest.mark.ci
def test_a_deviation_curve_is_named_without_matrices_of_all_biases():
    _, tree = checked(drawn(0, [(0.16, 0.10), (0.0, 0.0), (0.0, 0.0), (-0.10, 0.15)]), engine="cholmod")
    (text,) = said(tree, "slope")
    assert {"d0.azimuth", "d3.azimuth"} == {name.strip() for name in text.partition(":")[0].split(",")}


@pytest.mark.ci
def test_a_heading_that_jumps_is_drifting_and_not_silenced_by_a_shape():
    table = drawn(3)
    table.loc[(table["sensor"] == "d1") & (table["time"] >= 300), "azimuth"] += 0.06
    _, tree = checked(table)
    assert [text.partition(":")[0] for text in said(tree, "drifting")][:1] == ["d1.heading"]


@pytest.mark.ci
def test_a_sound_network_has_no_slope():
    _, tree = checked(drawn(1))
    assert said(tree, "slope") == said(tree, "recoded") == []


@pytest.mark.ci
@pytest.mark.parametrize("turned", [(2,), (0, 1, 2, 3)])
def test_bearings_that_are_counted_from_another_axis_are_named(turned):
    compass = Channel("rad", std=np.deg2rad(1.0), wrap=True, compass=True)
    table = drawn(0, turned=[k for k in range(4) if k not in turned])  # the others are compass bearings
    _, tree = checked(table, finder(channel=compass))
    (text,) = said(tree, "recoded")
    name = "d2" if len(turned) == 1 else "finder"
    assert text.startswith(f"{name}.azimuth: its values look like unit-circle angles: counted so, the mean square")


@pytest.mark.ci
def test_ranges_that_are_late_or_bend_are_named():
    places = [(0, 0), (60, 0), (60, 40), (0, 40)]
    anchors = Network([probcal.sensors.ranger.on(Node(f"b{k}", place), name=f"b{k}") for k, place in enumerate(places)])
    time = np.arange(0.0, 60.0, 0.25)

    def path(t):
        return np.stack([30 + 25 * np.cos(t / 5), 20 + 15 * np.sin(t / 3.1)], 1)

    def table(late=0.0, bent=0.0):
        rng, rows = np.random.default_rng(2), []
        for k, place in enumerate(places):
            r = np.linalg.norm(path(time - late * (k == 1)) - place, axis=1)
            value = r + bent * ((r - 30) / 15) ** 2 + 0.1 * rng.standard_normal(len(time))
            rows.append(pd.DataFrame({"time": time, "sensor": f"b{k}", "range": value, "range_std": 0.1}))
        return pd.concat(rows)

    def sentences(rows):
        problem = Problem(anchors, ConstantVelocity(2.0), rows)
        return said(probcal.assess(problem, probcal.fit(problem)), "slope")

    assert not sentences(table())
    (late,) = sentences(table(late=0.05))
    assert late.startswith("b1.range: the residuals follow the rate of the reading")
    size = float(re.search(r'scale=\{"time_offset": (.*)\}', late)[1])
    assert 0.04 < size < 0.06
    (bent,) = sentences(table(bent=0.3))
    assert "the residuals follow the distance of the target" in bent
    assert 'shared="type"' in bent


@pytest.mark.ci
def test_a_beacon_so_late_that_its_place_is_given_up_is_named():
    """The fit ends far off, at its bound, where a step alone does not mend it."""
    problem, _ = networks.own_path("beacons", 11, 0.3, 0.1)
    rows = problem.measurements.table.frame.copy()
    mine, window = rows["sensor"] == "b3", np.hanning(21) / np.hanning(21).sum()
    smooth = np.convolve(np.pad(rows.loc[mine, "range"], 10, mode="edge"), window, "valid")
    rows.loc[mine, "range"] -= 7.0 * np.gradient(smooth, 0.5)
    problem = problem.rebuild(rows)
    tree = probcal.fit(problem)
    assert tree.attrs["status"] == "at bound"
    (late,) = said(probcal.assess(problem, tree), "slope")
    assert late.startswith("b3.range: the residuals follow the rate of the reading")
