"""What a fit ran along, starts that strain it, and intervals widened where the innovations reject the model."""

from dataclasses import replace

import committed
import numpy as np
import pytest
from contracts import only
from worlds import linear, resting

import probcal
from probcal import Channel, ConstantVelocity, Network, Node, Problem, simulate
from probcal.analysis.residuals import Innovations
from probcal.analysis.widen import rejection, widened
from probcal.identifiability.watch import runs, strained_starts
from probcal.sensors import doa


def anchored():
    """Five bearings-only nodes, the first one known: only the motion tells the size of the scene."""
    places, free = [(0, 0), (200, 0), (200, 150), (0, 150), (100, -40)], {"position": 30.0, "heading": np.deg2rad(3)}
    network = Network([doa.on(Node(f"d{k}", place, scale=free if k else None)) for k, place in enumerate(places)])
    biases = dict.fromkeys(network.labels, 0.0) | {"d1.heading": 0.07, "d2.position_x": 15.0, "d4.position_y": -9.0}
    time = np.arange(80.0)
    path = np.stack([100 + 80 * np.cos(time / 12), 75 + 50 * np.sin(time / 7)], 1)
    drawn = simulate(network, ConstantVelocity(0.5), time, key=0, biases=biases, tracks={"target": path})
    return Problem(network, ConstantVelocity(0.5), drawn.table)


@pytest.mark.ci
def test_an_estimate_that_ran_along_a_gauge_is_none_and_names_it():
    """The path is smoother than its motion allows, so that a smaller scene fits better; no bias is determined."""
    problem = anchored()
    tree = probcal.fit(problem)
    assert tree.attrs["status"] == "along a gauge"
    assert "prior sd along dilation" in tree.attrs["message"]
    assert "determined" not in probcal.assess(problem, tree)["verdict"]["verdict"].values
    found = probcal.observability(problem)
    assert found.attrs["gauge"] > 0
    assert found.attrs["status"] != "determined"


def test_a_stated_network_ran_nowhere():
    problem, _ = linear("plane")
    start = resting(problem)
    assert runs(problem, start) == []
    assert strained_starts(problem, start) == []


def far_away(std, distance):
    """Four direction finders 20 m apart, three of unknown heading, and a target far beyond them."""
    places, kind = (
        [(0, 0), (20, 0), (20, 20), (0, 20)],
        replace(doa, channels={"azimuth": Channel("rad", std=std, wrap=True)}),
    )
    network = Network(
        [kind.on(Node(f"d{k}", place, scale={"heading": 0.02} if k else None)) for k, place in enumerate(places)]
    )
    time = np.arange(60.0)
    path = np.stack([distance + 20 * time, 0.3 * distance + 5 * time], 1)
    drawn = simulate(network, ConstantVelocity(0.1), time, key=0, share=1.0, tracks={"target": path})
    return Problem(network, ConstantVelocity(0.1), drawn.table), path


@pytest.mark.ci
def test_an_undeclared_start_of_a_small_array_reaches_far():
    """A target at 1 km, 50 arrays away: the track holds it within 3 sd, as with a start that is declared."""
    problem, path = far_away(0.0175, 1000.0)
    track = only(probcal.fit(problem))
    off = np.abs(track["mean"].values[:, :2] - path) / track["sd"].values[:, :2]
    assert off.max() < 3.0


@pytest.mark.ci
def test_a_start_that_was_never_declared_and_strains_the_fit_is_named():
    problem, _ = far_away(1e-5, 60_000.0)
    assert "was never declared and strains the fit" in probcal.fit(problem).attrs["message"]


def channels(white=1.0, autocorrelation=0.0):
    """Whiteness of two channels as `assess` writes it."""
    import xarray as xr

    values = {"white": [white, 1.0], "autocorrelation": [autocorrelation, 0.0], "data": [100, 100]}
    names = {"sensor": ("part", ["a", "b"]), "channel": ("part", ["range", "range"])}
    return xr.Dataset({name: ("part", value) for name, value in values.items()}, names)


def test_a_test_that_rejects_says_which():
    random = np.random.default_rng(0)
    value, none = random.normal(size=500), np.zeros(500)
    assert rejection(Innovations(value, none, none), channels()) == ""
    assert "mean square is" in rejection(Innovations(1.5 * value, none, none), channels())
    assert rejection(Innovations(0.5 * value, none, none), channels()) == "", "noise declared too large widens nothing"
    assert "a.range follow each other (0.40)" in rejection(Innovations(value, none, none), channels(1e-5, 0.4))


def test_widening_takes_the_share_that_the_data_gave():
    tree = committed.tree("ea")
    tree.attrs.pop("widened", None)
    tree.attrs["status"] = "converged"
    before, M = tree["calibration"].to_dataset(), tree["calibration"].sizes["bias_label"]
    result, findings = widened(tree, np.full(M, 4.0), "their mean square is 4")
    after = result["calibration"].to_dataset()
    wide = np.sqrt(1 + 3 * before["gamma"].values)
    np.testing.assert_allclose(after["sd"], before["sd"] * wide, rtol=1e-12)
    np.testing.assert_allclose(after["covariance"], before["covariance"] * np.outer(wide, wide), rtol=1e-12)
    np.testing.assert_allclose(after["upper"] - after["mean"], wide * (before["upper"] - before["mean"]), rtol=1e-9)
    np.testing.assert_array_equal(after["mean"], before["mean"])
    spread = [t["posterior"]["bias"].std(("chain", "draw")).values for t in (result, tree)]
    np.testing.assert_allclose(spread[0], spread[1] * wide, rtol=1e-9)
    assert "widened by up to" in findings[0].sentence
    again, nothing = widened(result, np.full(M, 4.0), "their mean square is 4")
    assert not nothing
    np.testing.assert_array_equal(again["calibration"]["sd"], after["sd"])
