"""Stone Soup: a table through detections and back, its own updaters and trackers on models of declared sensors."""

import copy
from datetime import UTC, datetime, timedelta
from pathlib import Path

import jax
import numpy as np
import pandas as pd
import pytest

import probcal
from probcal import Bias, Censored, Channel, Detection, InputError, Network, Node, sensor, sensors
from probcal import Path as Course
from probcal.adapters.stone_soup.function import SensorFunction, StateMapping, channel_stds
from probcal.cli.models import load_model
from probcal.geometry import norm

pytest.importorskip("stonesoup")
from stonesoup.dataassociator.neighbour import NearestNeighbour
from stonesoup.deleter.error import CovarianceBasedDeleter
from stonesoup.hypothesiser.distance import DistanceHypothesiser
from stonesoup.initiator.simple import SinglePointInitiator
from stonesoup.measures import Mahalanobis
from stonesoup.models.measurement.linear import LinearGaussian
from stonesoup.models.measurement.nonlinear import (
    CartesianToBearingRange,
    CartesianToElevationBearing,
    CartesianToElevationBearingRange,
)
from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
from stonesoup.predictor.kalman import ExtendedKalmanPredictor
from stonesoup.sensor.passive import PassiveElevationBearing
from stonesoup.sensor.radar.radar import RadarBearing, RadarBearingRange, RadarElevationBearingRange
from stonesoup.tracker.simple import SingleTargetTracker
from stonesoup.types.angle import Bearing
from stonesoup.types.array import StateVector, StateVectors
from stonesoup.types.detection import Detection as Seen
from stonesoup.types.detection import TrueDetection
from stonesoup.types.groundtruth import GroundTruthPath, GroundTruthState
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.prediction import GaussianStatePrediction
from stonesoup.types.state import GaussianState, State
from stonesoup.types.track import Track
from stonesoup.updater.kalman import ExtendedKalmanUpdater, UnscentedKalmanUpdater
from stonesoup.updater.particle import ParticleUpdater

from probcal import adapters

DATA = Path(__file__).parent / "data"
START = datetime(2024, 5, 1, 12)
SMALL = load_model(DATA / "small.py")
NETWORK = SMALL.network()


@pytest.fixture(scope="module")
def tree():
    return probcal.load(DATA / "ea.nc")


@pytest.fixture(scope="module")
def radars():
    nodes = [Node("west", (10.0, -5.0), 0.3, scale={"heading": 0.1}), Node("east", (90.0, 0.0), 2.5)]
    return Network([sensors.radar.on(node) for node in nodes])


def wrapped(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


def state(*values, **more):
    return State(StateVector([float(v) for v in values]), **more)


def test_a_table_goes_through_detections_and_back(tree):
    table = pd.read_csv(DATA / "small.csv").assign(range_std=lambda f: np.where(f["time"] == 3.0, 0.25, np.nan))
    detections = adapters.to_detections(table, NETWORK, tree, start=START)
    assert len(detections) == table[["range", "azimuth"]].notna().any(axis=1).sum()
    assert {d.metadata["target"] for d in detections} == {"car", "van"}
    back = adapters.from_detections(detections, NETWORK, start=START)
    keys = ["time", "sensor", "target"]
    wanted = table.dropna(subset=["range", "azimuth"], how="all").sort_values(keys).reset_index(drop=True)
    back = back.sort_values(keys).reset_index(drop=True)
    assert back.columns.tolist() == [*keys, "range", "azimuth"]  # the level of the range is unknown: no column
    assert (back[keys] == wanted[keys]).all(axis=None)
    np.testing.assert_allclose(back["range"], wanted["range"], rtol=0, atol=1e-9)
    np.testing.assert_allclose(wrapped(back["azimuth"] - wanted["azimuth"]), 0 * wanted["azimuth"], atol=1e-9)
    own = [
        d for d in detections if d.timestamp == START + timedelta(seconds=3) and "range" in d.measurement_model.channels
    ]
    assert all(d.measurement_model.covar()[0, 0] == pytest.approx(0.25**2) for d in own)
    assert own


def test_stds_units_compass_and_unnamed_targets_go_there_and_back():
    @sensor(
        direction=Channel("deg", std=2.0, wrap=True, compass=True), level=Channel("dB", std=1.0, noise=Censored(-95.0))
    )
    def ear(target, pose, *, gain=Bias("dB", 3.0)):
        line = target.position - pose.position
        return dict(direction=jax.numpy.rad2deg(jax.numpy.arctan2(line[1], line[0])), level=gain - norm(line))

    network = Network(
        [ear.on(Node("01", (0.0, 0.0)), detection=Detection(0.9, clutter=1.0, limits={"level": (-95, 0)}))]
    )
    table = pd.DataFrame(
        {"time": [0.0, 0.5, 1.0], "sensor": "01", "direction": [350.0, 20.0, None], "level": ["-40.5", "<-95", "<-95"],
         "level_std": [0.5, None, None]}
    )  # fmt: skip
    detections = adapters.to_detections(table, network)
    assert len(detections) == 2  # the last row heard nothing
    north = detections[0].state_vector[0]
    assert isinstance(north, Bearing)
    assert float(north) == pytest.approx(np.deg2rad(100.0))  # 10 degrees west of north, from east
    model, place = detections[0].measurement_model, state(-30.0, 0.0, 40.0, 0.0)
    np.testing.assert_allclose(np.diag(model.covar()), [np.deg2rad(2.0) ** 2, 0.25])  # Stone Soup has radians
    np.testing.assert_allclose(np.asarray(model.function(place), float)[:, 0], [np.arctan2(40.0, -30.0), -50.0])
    np.testing.assert_allclose(model.jacobian(place), [[-40 / 2500, 0, -30 / 2500, 0], [0.6, 0, -0.8, 0]], atol=1e-9)
    assert detections[0].timestamp == datetime(1970, 1, 1)
    assert "target" not in detections[0].metadata
    back = adapters.from_detections(detections, network)
    assert back["level_std"].tolist()[0] == pytest.approx(0.5)
    assert "target" not in back
    assert np.mod(back["direction"], 360.0).tolist() == pytest.approx([350.0, 20.0])
    assert back["sensor"].tolist() == ["01", "01"]
    probcal.read_table(back)


def update(updater, prior, vector, model):
    detection = Seen(vector, timestamp=START, measurement_model=model)
    prediction = GaussianStatePrediction(prior.state_vector, prior.covar, timestamp=START)
    return updater.update(SingleHypothesis(prediction, detection))


class Exact(CartesianToBearingRange):
    """Stone Soup's own model with its derivative written out, where Stone Soup takes differences."""

    def jacobian(self, state, **kwargs):
        x, y = (np.asarray(state.state_vector, float)[[0, 2]] - np.asarray(self.translation_offset, float))[:, 0]
        square = x**2 + y**2
        return np.array([[-y / square, 0, x / square, 0], [x / square**0.5, 0, y / square**0.5, 0]])


@pytest.mark.parametrize(
    ("updater", "kind", "within"),
    [
        (ExtendedKalmanUpdater(None), Exact, 1e-9),
        (ExtendedKalmanUpdater(None), CartesianToBearingRange, 1e-4),  # by what its differences are off
        (UnscentedKalmanUpdater(None), CartesianToBearingRange, 1e-9),
    ],
    ids=["ekf", "ekf by differences", "ukf"],
)
def test_updates_are_those_of_stone_soups_own_model(radars, updater, kind, within):
    """Behind the node, where bearings wrap: the prediction lies on the other side of the cut."""
    own = kind(
        4, (0, 2), np.diag([0.01**2, 0.5**2]), translation_offset=StateVector([10.0, -5.0]),
        rotation_offset=StateVector([0.0, 0.0, 0.3 + 0.05]),
    )  # fmt: skip
    ours = adapters.measurement_model("west", radars, {"west.heading": 0.05})
    ours.noise_covar = np.diag([0.5**2, 0.01**2]).view(type(ours.noise_covar))
    prior = GaussianState(StateVector([-60.0, 1.0, 20.0, -2.0]), np.diag([4.0, 1.0, 9.0, 1.0]))
    angle = Bearing(np.arctan2(25.0, -70.0) - 0.35 + 0.9)
    assert float(angle) < 0
    first = update(updater, prior, StateVector([angle, 76.0]), own)
    second = update(updater, prior, StateVector([76.0, angle]), ours)
    np.testing.assert_allclose(np.asarray(second.mean, float), np.asarray(first.mean, float), rtol=0, atol=within)
    np.testing.assert_allclose(np.asarray(second.covar, float), np.asarray(first.covar, float), rtol=0, atol=within)


def test_particles_are_weighed_around_the_circle(radars):
    model = adapters.measurement_model("west", radars, channels=["azimuth"])
    behind = state(10.0 - np.cos(0.3), 0.0, -5.0 - np.sin(0.3), 0.0)  # seen at -pi
    found = model.logpdf(State(StateVector([Bearing(np.pi - 1e-3)])), behind)
    std = np.deg2rad(10.0)
    assert found == pytest.approx(-0.5 * (1e-3 / std) ** 2 - 0.5 * np.log(2 * np.pi * std**2), abs=1e-9)
    several = model.logpdf(State(StateVector([Bearing(3.0)])), State(StateVectors(np.tile(behind.state_vector, 3))))
    assert several.shape == (3,)
    assert ParticleUpdater(model).measurement_model is model
    drawn = model.rvs(500, random_state=np.random.RandomState(1))
    assert np.std(np.asarray(drawn, float)) == pytest.approx(std, rel=0.2)
    noisy = model.function(behind, noise=True, random_state=np.random.RandomState(1))
    assert 0 < abs(wrapped(float(noisy[0]) - np.pi)) < 6 * std
    again = copy.deepcopy(model)  # as trackers of several hypotheses do
    again.noise_covar = again.noise_covar * 4
    assert float(again.function(behind)[0]) == pytest.approx(float(model.function(behind)[0]))
    assert model.covar()[0, 0] == pytest.approx(std**2)


BIASES = {"north.range_offset": 8.0, "south.heading": 0.1}


@pytest.fixture(scope="module")
def passage():
    """Three sonars, one reading 8 m too far and one turned by 0.1 rad, and 60 s of a target that passes."""

    @sensor(range=Channel("m", std=1.0), azimuth=Channel("rad", std=0.01, wrap=True))
    def sonar(target, pose, *, range_offset=Bias("m", 5.0)):
        line = target.position - pose.position
        return dict(range=norm(line) + range_offset, azimuth=jax.numpy.arctan2(line[1], line[0]) - pose.heading)

    turned = {"heading": np.deg2rad(5)}
    places = {"west": (0.0, 0.0), "north": (200.0, 0.0), "south": (80.0, 150.0)}
    network = Network([sonar.on(Node(name, place, scale=turned)) for name, place in places.items()])
    random, time = np.random.default_rng(1), np.arange(60.0)
    path = np.stack([np.linspace(-50, 250, 60), 80 + 40 * np.sin(np.linspace(0, 6, 60))], 1)
    parts = []
    for name, place in places.items():
        x, y = (path - place).T
        distance = np.hypot(x, y) + BIASES.get(f"{name}.range_offset", 0.0) + random.normal(size=60)
        angle = wrapped(np.arctan2(y, x) - BIASES.get(f"{name}.heading", 0.0) + 0.01 * random.normal(size=60))
        parts.append(pd.DataFrame({"time": time, "sensor": name, "range": distance, "azimuth": angle}))
    return network, pd.concat(parts).sort_values("time", kind="stable"), path


def tracked(passage, calibration):
    """RMSE in m of a tracker of Stone Soup, an extended Kalman filter fed by the sensors of a network."""
    network, rows, path = passage
    detections = adapters.to_detections(rows, network, calibration, start=START)
    covar = np.diag([100.0, 25.0, 100.0, 25.0])
    prior = GaussianState(StateVector([path[0, 0], 5.0, path[0, 1], 0.0]), covar, timestamp=START)
    predictor = ExtendedKalmanPredictor(CombinedLinearGaussianTransitionModel([ConstantVelocity(0.3)] * 2))
    updater = ExtendedKalmanUpdater(None)
    tracker = SingleTargetTracker(
        SinglePointInitiator(prior, None),
        CovarianceBasedDeleter(covar_trace_thresh=1e9),
        [(d.timestamp, {d}) for d in detections],
        NearestNeighbour(DistanceHypothesiser(predictor, updater, Mahalanobis(), missed_distance=1e6)),
        updater,
    )
    track = [tracks for _, tracks in tracker][-1].pop()
    found = adapters.from_tracks([track], start=START).groupby("time").last()
    assert len(found) == 60
    away = found[["position_x", "position_y"]].to_numpy() - path
    return float(np.sqrt((away[5:] ** 2).sum(axis=1).mean()))


def test_a_tracker_fed_by_the_calibrated_network_tracks_better(passage):
    before, after = tracked(passage, None), tracked(passage, BIASES)
    assert before > 3.0
    assert after < 1.0


@pytest.mark.ci
def test_a_fit_serves_the_tracker_as_the_true_biases_do(passage):
    network, rows, _ = passage
    tree = probcal.fit(probcal.Problem(network, probcal.ConstantVelocity(0.5), rows), probcal.MAP())
    assert tracked(passage, tree) < 1.0
    placed = adapters.to_sensors(network, tree)
    assert type(placed["north"]).__name__ == "DeclaredSensor"
    assert placed["south"].orientation[2] == pytest.approx(0.1, abs=0.01)


def test_sensors_are_those_of_stone_soup_where_it_has_them(radars):
    found = adapters.to_sensors(radars, {"west.heading": 0.05, "east.range_offset": 4.0})
    west, east = found["west"], found["east"]
    assert type(west) is RadarBearingRange
    assert np.asarray(west.position, float).ravel().tolist() == [10.0, -5.0]
    assert west.orientation[2] == pytest.approx(0.35)
    assert np.diag(west.noise_covar).tolist() == pytest.approx([np.deg2rad(10.0) ** 2, 100.0])
    assert type(east).__name__ == "DeclaredSensor"  # Stone Soup has no range offset
    truth = GroundTruthPath([GroundTruthState([50.0, 1.0, 60.0, -1.0], timestamp=START)], id="car")
    one = east.measure({truth}, noise=False).pop()
    assert float(one.state_vector[0]) == pytest.approx(np.hypot(40.0, 60.0) + 4.0)
    assert float(one.state_vector[1]) == pytest.approx(wrapped(np.arctan2(60.0, -40.0) - 2.5))
    assert east.measure({truth}, noise=True, random_state=np.random.RandomState(0)).pop().timestamp == START
    row = adapters.from_detections([one], radars).iloc[0]
    assert (row["sensor"], row["target"], row["time"]) == ("east", "car", 0.0)
    seen = west.measure({truth}, noise=False).pop()
    frame = adapters.from_detections([seen], radars, sensor="west")  # bearing first in Stone Soup
    assert frame.loc[0, "range"] == pytest.approx(np.hypot(40.0, 65.0))
    assert frame.loc[0, "azimuth"] == pytest.approx(np.arctan2(65.0, 40.0) - 0.35)
    lone = Network([sensors.doa.on(Node("ear", (0.0, 0.0), 0.2))])
    assert type(adapters.to_sensors(lone)["ear"]) is RadarBearing


def test_sensors_in_space(tree):
    pose = {"heading": 0.4, "pitch": 0.2, "roll": -0.3}
    nodes = [Node("dish", (1.0, 2.0, 3.0), **pose), Node("eye", (0.0, 0.0, 5.0), **pose), Node("post", (9.0, 0.0, 0.0))]
    network = Network([sensors.radar_3d.on(nodes[0]), sensors.doa_3d.on(nodes[1]), sensors.ranger.on(nodes[2])])
    found = adapters.to_sensors(network)
    kinds = {name: type(one).__name__ for name, one in found.items()}
    assert kinds == {"dish": "RadarElevationBearingRange", "eye": "PassiveElevationBearing", "post": "DeclaredSensor"}
    target = state(200, 1, -50, 2, 80, 3)
    for name, kind, order in (
        ("dish", RadarElevationBearingRange, ["elevation", "azimuth", "range"]),
        ("eye", PassiveElevationBearing, ["elevation", "azimuth"]),
    ):
        assert isinstance(found[name], kind)
        ours = adapters.measurement_model(name, network, channels=order)
        assert ours.channels == tuple(order)
        other = found[name].measurement_model.function(target)
        np.testing.assert_allclose(np.asarray(ours.function(target), float), np.asarray(other, float), atol=1e-9)
    late = {"dish.range_offset": 30.0}
    assert type(adapters.to_sensors(network, late)["dish"]).__name__ == "DeclaredSensor"
    for model in (CartesianToElevationBearingRange, CartesianToElevationBearing):
        made = model(6, np.array([0, 2, 4]), np.eye(3 if "Range" in model.__name__ else 2))
        name = "dish" if "Range" in model.__name__ else "eye"
        frame = adapters.from_detections([Seen(made.function(target), START, made, metadata={"sensor": name})], network)
        assert frame.loc[0, "elevation"] == pytest.approx(float(made.function(target)[0]))
        assert frame.loc[0, "azimuth"] == pytest.approx(float(made.function(target)[1]))


def test_further_components_moving_nodes_and_drifts(tree):
    """A received level reads the power; a node that moves or turns has another model at every time."""
    network = Network([sensors.rss.on(Node("mic", (0.0, 0.0)))])
    mapping = {"position": (0, 1), "power": 2}
    biases = {"mic.gain": 1.5, "rss.exponent": 0.5}
    model = adapters.measurement_model("mic", network, biases, mapping=mapping)
    loud = state(30.0, 40.0, 90.0)
    assert float(model.function(loud)[0]) == pytest.approx(90 - 2.5 * 10 * np.log10(50.0) + 1.5)
    slope = -2.5 * 10 / np.log(10) / 50.0
    np.testing.assert_allclose(model.jacobian(loud), [[slope * 0.6, slope * 0.8, 1.0]], atol=1e-9)
    path = Course([0.0, 10.0], position=[(0.0, 0.0), (100.0, 0.0)])
    moving = Network([sensors.position.on(Node("still", (0.0, 0.0))), sensors.radar.on(Node("ship", path=path))])
    model = adapters.measurement_model("ship", moving, start=START, channels=["range"])
    later = state(50.0, 0.0, 7.0, 0.0, timestamp=START + timedelta(seconds=5))
    assert float(model.function(later)[0]) == pytest.approx(7.0)
    with pytest.raises(InputError, match="moves or drifts: give its measurement model start="):
        model.function(state(50.0, 0.0, 7.0, 0.0))
    assert type(adapters.to_sensors(moving, start=START)["ship"]).__name__ == "DeclaredSensor"
    rows = pd.DataFrame({"time": [5.0], "sensor": "ship", "range": 8.0})
    taken = adapters.to_detections(rows, moving)[0].measurement_model  # at the time of its row
    assert float(taken.function(state(50.0, 0.0, 7.0, 0.0))[0]) == pytest.approx(7.0)
    place = adapters.measurement_model("still", moving)
    np.testing.assert_allclose(np.asarray(place.function(state(3, 0, 4, 0)), float).ravel(), [3.0, 4.0])
    mean = tree["calibration"]["mean"].to_series()
    turned = {}
    for seconds in (3.0, 4.0):
        north = state(50.0, 0.0, 10.0, 0.0, timestamp=START + timedelta(seconds=seconds))
        model = adapters.measurement_model("b", NETWORK, tree, start=START, channels=["azimuth"])
        turned[seconds] = float(model.function(north)[0])
    x, y = -mean["b.position_x"], 10.0 - mean["b.position_y"]
    assert turned[3.0] == pytest.approx(np.arctan2(y, x) - 0.5 - mean["b.heading"])
    assert turned[4.0] - turned[3.0] == pytest.approx(-mean["b.heading@4"])
    level = tree["level"]["std"].to_series()["gauge.range_std"]
    assert channel_stds(NETWORK.sensors[0], NETWORK, tree).tolist() == pytest.approx([level, 0.02])
    assert channel_stds(NETWORK.sensors[0], NETWORK, None).tolist() == [1.0, 0.02]


def test_tracks_of_a_fit_go_to_stone_soup_and_back(tree):
    tracks = adapters.to_tracks(tree, start=START)
    assert [track.id for track in tracks] == ["car", "van"]
    assert tracks[0].states[2].timestamp == START + timedelta(seconds=2)
    frame = adapters.from_tracks(tracks, start=START)
    wanted = probcal.tracks(tree)[frame.columns]
    pd.testing.assert_frame_equal(frame, wanted, check_exact=False, rtol=0, atol=1e-9)
    probcal.Truth(tracks=frame)
    flat = adapters.to_tracks(tree, mapping=(0, 1))
    assert flat[0].states[0].state_vector.shape == (2, 1)
    found = adapters.from_tracks(flat)
    assert found["position_y"].tolist() == pytest.approx(wanted["position_y"].tolist())
    named = Track([State(StateVector([1.0, 2.0, 3.0]), timestamp=START)], init_metadata={"target": "bird"})
    assert adapters.from_tracks([named]).to_dict("records") == [
        {"time": 0.0, "target": "bird", "position_x": 1.0, "position_y": 2.0, "position_z": 3.0}
    ]


def test_detections_of_other_models_say_what_they_hold():
    network = Network([sensors.position.on(Node("gps", (0.0, 0.0)))])
    linear = LinearGaussian(4, (0, 2), np.diag([9.0, 25.0]))
    path = GroundTruthPath([GroundTruthState([1.0, 0.0, 2.0, 0.0], timestamp=START)])
    one = TrueDetection(StateVector([1.5, 2.5]), groundtruth_path=path, timestamp=START, measurement_model=linear)
    frame = adapters.from_detections([(START, {one})], network, sensor=lambda detection: "gps")
    assert frame.loc[0, ["position_x", "position_y"]].tolist() == [1.5, 2.5]
    assert frame.loc[0, "position_x_std"] == 3.0
    assert "position_y_std" not in frame  # 5 m is what the channel declares
    assert frame.loc[0, "target"] == path.id
    bare = Seen(StateVector([1.5, 2.5]), timestamp=START, metadata={"sensor": "gps"})
    names = {"gps": ["position_y", "position_x"]}
    frame = adapters.from_detections([bare], network, channels=names, target=lambda detection: "car")
    assert frame.loc[0, ["target", "position_x"]].tolist() == ["car", 2.5]
    assert [time for time, _ in adapters.by_time([bare, one])] == [START]


def seen(values=(1.0, 2.0), timestamp=START, **more):
    return Seen(StateVector(list(values)), timestamp=timestamp, **more)


GPS = {"metadata": {"sensor": "west"}}
ERRORS = [
    (
        lambda n, t: adapters.measurement_model("wets", n),
        'no sensor of the network is called "wets"; did you mean "west"?',
    ),
    (
        lambda n, t: adapters.measurement_model("west", n, channels=["rnge"]),
        'sensor "west" measures no "rnge"; did you',
    ),
    (lambda n, t: adapters.measurement_model("west", n, t), 'the fit says nothing of the bias "west.heading" of this'),
    (lambda n, t: adapters.measurement_model("west", n, t["track"]), "the tree holds no calibration; give what fit"),
    (lambda n, t: adapters.measurement_model("west", n, 3), "the calibration is int; give a fit, or biases by label"),
    (
        lambda n, t: adapters.measurement_model("west", n, {"west.head": 1}),
        'the calibration names the bias "west.head"',
    ),
    (
        lambda n, t: adapters.measurement_model("west", n, mapping=(0, 2, 4)),
        "mapping gives the position as (0, 2, 4); a 2-D",
    ),
    (
        lambda n, t: adapters.measurement_model("west", n, mapping=(0, 9), ndim_state=4),
        "does not fit a state vector of 4",
    ),
    (lambda n, t: adapters.from_detections([], n), "there are no detections; give those of Stone Soup"),
    (lambda n, t: adapters.from_detections([seen()], n), "detection 0 does not say which sensor made it: put sensor"),
    (lambda n, t: adapters.from_detections([seen(timestamp=None)], n), "a detection has the timestamp None; every"),
    (
        lambda n, t: adapters.from_detections([seen(**GPS)], n),
        "has the model NoneType, of which it is not known what it",
    ),
    (
        lambda n, t: adapters.from_detections([seen(**GPS)], n, channels={"west": ["range"]}),
        'detection 0 of sensor "west" holds 2 numbers, but 1 channels are named: range',
    ),
    (
        lambda n, t: adapters.from_detections([seen(**GPS)], n, channels={"west": ["range", "azimut"]}),
        'detection 0: sensor "west" has no channel "azimut"; did you mean "azimuth"?',
    ),
    (lambda n, t: adapters.from_detections([seen(**GPS)], n, start=5.0), "start is 5.0; give the datetime of time 0"),
    (
        lambda n, t: adapters.from_detections([seen(**GPS)], n, start=START.replace(tzinfo=UTC)),
        "give both a time zone, or neither",
    ),
    (lambda n, t: adapters.from_tracks([Track()]), "there are no tracks with states; give those of a Stone Soup"),
    (
        lambda n, t: adapters.from_tracks([Track([state(*range(5), timestamp=START)])]),
        "a state has 5 numbers; say what",
    ),
    (lambda n, t: adapters.to_tracks(t["calibration"]), "the tree holds no tracks; give what fit() or track()"),
    (
        lambda n, t: adapters.to_tracks(t, mapping={"position": (0, 1), "power": 2}),
        'the tracks have no component "power"; known: position_x',
    ),
]


@pytest.mark.parametrize(("call", "text"), ERRORS, ids=[text[:30] for _, text in ERRORS])
def test_what_cannot_be_taken_is_refused_in_one_sentence(call, text, radars, tree):
    with pytest.raises(InputError) as caught:
        call(radars, tree)
    assert text in str(caught.value)


def test_sensors_that_no_gaussian_model_holds_are_refused():
    lights = Network([sensors.presence.on(Node("gate", (0.0, 0.0)))])
    with pytest.raises(InputError, match="is yes or no, which no Gaussian measurement model holds"):
        adapters.measurement_model("gate", lights)
    fast = Network([sensors.doppler.on(Node("gun", (0.0, 0.0)))])
    with pytest.raises(InputError, match=r"reads target\.velocity, for which the mapping has no entry"):
        SensorFunction(fast.sensors[0], fast, {}, StateMapping((0, 1), 2))
