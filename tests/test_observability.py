"""What data can determine: gauge directions counted against dense ranks, named, anchored; what to measure next."""

from fnmatch import fnmatch
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from worlds import resting

import probcal
from probcal import (
    EA,
    Bias,
    Channel,
    ConstantVelocity,
    InputError,
    Known,
    Network,
    Node,
    Problem,
    Static,
    Target,
    White,
    fit,
    sensor,
    sensors,
    simulate,
)
from probcal.analysis import next_anchors, next_passes, next_sensors, observability
from probcal.gaussian.dense import DenseEngine
from probcal.gaussian.mode import Point
from probcal.geometry import bearing, norm
from probcal.identifiability.directions import weak_directions
from probcal.identifiability.gauge import gauge
from probcal.model import rows as waist
from probcal.modes import automatic_start
from probcal.types import float64

TIME = np.arange(30.0)


@sensor(range=Channel("m", std=1.0))
def plain_range(target, pose, *, range_offset=Bias("m", 10.0)):
    return dict(range=norm(target.position - pose.position) + range_offset)


@sensor(range=Channel("m", std=1.0))
def stretched(target, pose, *, range_scale=Bias("1", 0.1, shared="type")):
    return dict(range=(1 + range_scale) * norm(target.position - pose.position))


@sensor(azimuth=Channel("rad", std=0.01, wrap=True))
def compass(target, pose):
    return dict(azimuth=bearing(target.position - pose.position) - pose.heading)


@sensor(range=Channel("m", std=1.0), azimuth=Channel("rad", std=0.01, wrap=True))
def scanner(target, pose):
    line = target.position - pose.position
    return dict(range=norm(line), azimuth=bearing(line) - pose.heading)


@sensor(forward=Channel("m", std=1.0), left=Channel("m", std=1.0), above=Channel("m", std=1.0))
def tracker(target, pose):
    local = pose.local(target.position)
    return dict(forward=local[0], left=local[1], above=local[2])


@sensor(arrival=Channel("m", std=1.0))
def arrival(target, pose, *, delay=Bias("m", 10.0)):
    return dict(arrival=norm(target.position - pose.position) + target.emission + delay)


@sensor(difference=Channel("m", std=1.0))
def difference(target, a, b):
    return dict(difference=norm(target.position - a.position) + a.clock - norm(target.position - b.position) - b.clock)


@sensor(azimuth=Channel("rad", std=0.01, wrap=True), level=Channel("dB", std=1.0))
def ear(target, pose, *, gain_scale=Bias("1", 0.1)):
    azimuth = bearing(target.position - pose.position)
    return dict(azimuth=azimuth, level=(1 + gain_scale) * 60.0)


def path(dimension, time=TIME):
    u = time / TIME[-1]
    flat = np.stack([50 + 400 * u, 250 + 80 * np.sin(2 * np.pi * u)], 1)
    return flat if dimension == 2 else np.hstack([flat, (60 + 40 * np.cos(5 * u))[:, None]])


def places(count, dimension):
    """Scattered places, the same in every run; in 3-D not in one plane."""
    random = np.random.default_rng(3)
    return random.uniform(0, 500, (count, dimension)) * np.array([1.0, 1.0, 0.4])[:dimension]


def truth_of(problem, tracks=None):
    """The point at which every bias is zero and targets move on their tracks: no start has to be searched."""
    states = []
    for epochs in problem.epochs:
        x = np.zeros((len(epochs.time), len(epochs.components)))
        for target in dict.fromkeys(epochs.target):
            mine = np.asarray(epochs.target) == target
            track = path(problem.network.dimension) if tracks is None else tracks[target]
            track = track[: mine.sum()]
            x[mine, : track.shape[1]] = track
            if len(track) > 1 and len(epochs.components) >= 2 * track.shape[1]:
                x[mine, track.shape[1] : 2 * track.shape[1]] = np.gradient(track, epochs.time[mine], axis=0)
        states.append(x)
    zeros = tuple(np.zeros_like(x) for x in states)
    return Point(tuple(states), zeros, np.zeros(len(problem.labels)), np.zeros(len(problem.levels)))


def problem_of(kinds, dimension, scale, motion=None, fix=(), count=5):
    nodes = [Node(f"node_{k}", place, scale=scale) for k, place in enumerate(places(count, dimension))]
    placed = [
        kind.on(*nodes[k : k + kind.arity], name=f"{kind.name}_{k}")
        for kind in kinds
        for k in range(count - kind.arity + 1)
    ]
    network = Network(placed)
    motion = motion or ConstantVelocity(3.0)
    track = path(dimension)[: 1 if isinstance(motion, Static) else None]
    run = simulate(network, motion, TIME, key=1, share=0.0, tracks={"target": track})
    return Problem(network, motion, run.table, fix=fix)


EMITTED = ConstantVelocity(3.0) + White("emission", "m", 1e3)
FREE = {"position": 10.0, "heading": 0.1}
TURNED = FREE | {"pitch": 0.1, "roll": 0.1}
MOVED_2D = ["translation of all nodes along x", "translation of all nodes along y", "rotation"]
MOVED_3D = [f"translation of all nodes along {a}" for a in "xyz"] + [f"rotation around {a}" for a in "xyz"]
DILATED = "dilation: all positions grow or shrink together"
CASES = {  # kinds, dimension, scale, motion, gauge directions by name
    "radars": ([scanner], 2, FREE, None, MOVED_2D),
    "bearings": ([compass], 2, FREE, None, [*MOVED_2D, DILATED]),
    "ranges of one scale": ([stretched], 2, {"position": 10.0}, None, [*MOVED_2D, DILATED]),
    "arrivals": ([arrival], 2, None, EMITTED, ["a common delay of all"]),
    "clocks": ([difference], 2, {"clock": 10.0}, None, ["a common clock of all"]),
    "trackers": ([tracker], 3, TURNED, None, MOVED_3D),
    "mixed": ([plain_range, compass], 2, FREE, None, MOVED_2D),
    "arrivals in space": ([arrival], 3, None, EMITTED, ["a common delay of all"]),
}


@float64
def dense_gauge(problem, point):
    """Null space of the rows with free positions, by a dense singular value decomposition; its dimension."""
    jacobians = []
    (x,), z = point.states, point.z
    for block, data in zip(problem.model.blocks, problem.model.rows, strict=True):

        def predicted(x, z, block=block, data=data):
            return (waist.predict(block, data, x, z) / data.std).ravel()

        by_x, by_z = jax.jacfwd(predicted, argnums=(0, 1))(x, z)
        jacobians.append(np.hstack([np.asarray(by_x).reshape(len(by_x), -1), np.asarray(by_z)]))
    whole = np.concatenate(jacobians)
    states = whole[:, : x.size]
    return problem.model.biases - (np.linalg.matrix_rank(whole, rtol=1e-9) - np.linalg.matrix_rank(states, rtol=1e-9))


ALWAYS, SECOND = ("radars",), ("trackers", "bearings", "ranges of one scale", "arrivals", "clocks")


def tiers(always, second):
    """All cases: some in every run, some in CI, the others long."""
    marks = dict.fromkeys(always, ()) | dict.fromkeys(second, pytest.mark.ci)
    return pytest.mark.parametrize("name", [pytest.param(n, marks=marks.get(n, pytest.mark.slow)) for n in CASES])


@cache
def free_radars():
    """Five radars of which nothing is known, the point of the truth, and what can be observed there."""
    problem = problem_of([scanner], 2, FREE)
    point = truth_of(problem)
    return problem, point, observability(problem, point=point)


@pytest.mark.slow
@tiers(ALWAYS, SECOND)
def test_gauge_directions_are_counted_and_named(name):
    kinds, dimension, scale, motion, expected = CASES[name]
    problem = problem_of(kinds, dimension, scale, motion)
    point = truth_of(problem)
    tree = observability(problem, point=point)
    assert tree.attrs["countable"] == 1
    assert tree.attrs["gauge"] == dense_gauge(problem, point) == len(expected)
    found = tree["direction"].to_dataset()
    named = [str(n) for n, kind in zip(found["direction"].values, found["kind"].values, strict=True) if kind == "gauge"]
    assert sorted(named) == sorted(expected)
    assert tree.attrs["status"] == "open"


@tiers((), ())
def test_a_gauge_is_no_answer_until_anchored_as_advised(name):
    kinds, dimension, scale, motion, expected = CASES[name]
    free = problem_of(kinds, dimension, scale, motion)
    tree = fit(free, EA())
    assert tree.attrs["status"] == "at bound" or "Weakly determined" in tree.attrs["message"]
    assert expected[0].split(":")[0] in tree.attrs["message"]
    group = observability(free)["direction"].to_dataset()
    advice = sorted({label for labels in group["fix"].values.tolist() for label in labels.split()})
    assert advice, "no remedy was offered"
    anchored = free.rebuild(fix=advice)
    again = observability(anchored)
    assert again.attrs["weak"] == 0
    assert again.attrs["status"] == "determined"
    found = fit(anchored, EA())
    assert found.attrs["status"] == "converged"
    assert "Weakly determined" not in found.attrs["message"]
    error = np.abs(found["calibration"]["mean"].values) / found["calibration"]["scale"].values  # the truth is 0
    assert error.max() < 1.0


@float64
@pytest.mark.ci
def test_a_fit_of_free_radars_says_what_the_data_leave_open():
    problem, point, _ = free_radars()
    tree = probcal.fit(problem, EA(), start=point)
    assert tree.attrs["status"] == "at bound" or "Weakly determined" in tree.attrs["message"]
    for name in MOVED_2D:
        assert name in tree.attrs["message"]
    assert tree["direction"]["direction"].values.tolist() == MOVED_2D
    advice = tree["direction"]["remedy"].values.tolist()
    assert all("fix " in words and "done" not in words for words in advice)


def test_each_remedy_is_verified_by_recomputing():
    """To hold biases is to take their rows and columns out of the information."""
    problem, point, tree = free_radars()
    information, group = spectrum(problem, point), tree["direction"].to_dataset()
    fixed, count = set(), group.sizes["direction"]
    assert count == 3
    for k, labels in enumerate(group["fix"].values.tolist()):
        fixed |= set(labels.split())
        kept = [m for m, label in enumerate(problem.labels) if label not in fixed]
        assert (np.linalg.eigvalsh(information[np.ix_(kept, kept)]) < 1).sum() <= count - (k + 1)


def test_a_surveyed_anchor_counts_as_one():
    nodes = [Node(f"node_{k}", p, scale=FREE) for k, p in enumerate(places(5, 2))]
    anchored = [Node("node_0", places(5, 2)[0], survey={"position": 0.1, "heading": 0.01}), *nodes[1:]]
    network = Network([scanner.on(node) for node in anchored])
    run = simulate(network, ConstantVelocity(3.0), TIME, key=1, share=0.0, tracks={"target": path(2)})
    problem = Problem(network, ConstantVelocity(3.0), run.table)
    tree = observability(problem, point=truth_of(problem))
    assert tree.attrs["gauge"] == 0
    assert tree.attrs["status"] == "determined"


@pytest.mark.ci
def test_a_straight_pass_trades_a_range_offset_for_a_position():
    """Thesis figure 4.1: a target that passes radially tells the distance of a sensor and nothing else."""
    known = [Node(f"anchor_{k}", p) for k, p in enumerate([(0.0, 300.0), (400.0, 300.0), (200.0, -300.0)])]
    free = Node("mic", (-200.0, 0.0), scale=10.0)
    offsets = [f"anchor_{k}.range_offset" for k in range(3)]
    network = Network([plain_range.on(node) for node in (*known, free)])

    def check(track):
        run = simulate(network, ConstantVelocity(0.1), TIME, key=0, share=0.0, tracks={"target": track})
        problem = Problem(network, ConstantVelocity(0.1), run.table, fix=offsets)
        return observability(problem, point=truth_of(problem, {"target": track}))

    u = TIME[:, None] / TIME[-1]
    straight = check(np.array([0.0, 0.0]) + u * np.array([400.0, 0.0]))
    found = straight["direction"].to_dataset()
    names = found["direction"].values.tolist()
    assert {"range_offset of mic against its position_x", "position_x of mic against its range_offset"} & set(names)
    assert any("the target passed on one line" in words for words in found["words"].values.tolist())
    angle = 2 * np.pi * u[:, 0]
    around = check(np.stack([-200 + 150 * np.cos(angle), 150 * np.sin(angle)], 1))
    assert around.attrs["status"] == "determined"


@pytest.mark.ci
def test_a_bias_that_no_row_depends_on_is_named():
    node = Node("tower", (0.0, 0.0), scale={"position": 5.0})
    others = [Node("other", (100.0, 0.0)), Node("third", (0.0, 100.0))]
    still = Network([plain_range.on(n) for n in (node, *others)])
    table = pd.DataFrame({"time": np.repeat(TIME, 3), "sensor": ["tower", "other", "third"] * len(TIME), "range": 50.0})
    straight = Known((TIME, np.stack([TIME * 0 + 50.0, TIME * 0], 1)))
    problem = Problem(still, straight, table)
    tree = observability(problem, point=resting(problem))
    assert "position_y of tower alone" in tree["direction"]["direction"].values.tolist()


@pytest.mark.ci
def test_asynchronous_rows_are_not_counted_but_named():
    """One range at a time: what is fixed hangs on the motion, and the weak directions carry the names."""
    problem = problem_of([stretched], 2, {"position": 10.0}, ConstantVelocity(0.5))
    alone = problem.measurements.table.frame.copy()
    alone["time"] += 0.01 * (np.arange(len(alone)) % 5)
    later = Problem(problem.network, ConstantVelocity(0.5), alone)
    tree = observability(later, point=truth_of(later, {"target": path(2, later.epochs[0].time)}))
    assert tree.attrs["countable"] == 0
    assert {*MOVED_2D, DILATED} <= set(tree["direction"]["direction"].values.tolist())


@float64
def spectrum(problem, point):
    return DenseEngine().at(problem.model, point).information()


def turned(angle, moved):
    """The radar network, its target and its data in a world that was turned and moved."""
    c, s = np.cos(angle), np.sin(angle)
    R = np.array([[c, -s], [s, c]])
    nodes = [
        Node(f"node_{k}", R @ p + moved, heading=angle, scale={"position": 10.0, "heading": 0.1})
        for k, p in enumerate(places(5, 2))
    ]
    network = Network([scanner.on(node) for node in nodes])
    table = problem_of([scanner], 2, FREE).measurements.table.frame.replace(
        {"sensor": {f"scanner_{k}": f"node_{k}" for k in range(5)}}
    )
    track = path(2) @ R.T + moved
    start = {"position": (track[0], 100.0), "velocity": (track[1] - track[0], 50.0)}
    return Problem(network, Target(ConstantVelocity(3.0), start), table), track


@float64
def test_moving_the_world_changes_nothing():
    values = []
    for angle, moved in ((0.0, np.zeros(2)), (0.7, np.array([3e3, -2e3]))):
        problem, track = turned(angle, moved)
        values.append(np.linalg.eigvalsh(spectrum(problem, truth_of(problem, {"target": track}))))
    np.testing.assert_allclose(values[0], values[1], rtol=1e-6, atol=1e-6)


def test_more_rows_never_take_information_away():
    problem, point, _ = free_radars()
    data = problem.measurements
    half = problem.select(data.sensor != 4)  # every epoch stays
    np.testing.assert_array_equal(half.epochs[0].time, problem.epochs[0].time)
    assert np.linalg.eigvalsh(spectrum(problem, point) - spectrum(half, point)).min() > -1e-8


def test_shares_and_leverages_add_up():
    _, _, tree = free_radars()
    information = tree["bias"]["information"].values
    covariance = np.linalg.inv(information + np.eye(len(information)))
    share = tree["bias"]["share"].values
    np.testing.assert_allclose(share, 1 - np.diag(covariance), atol=1e-9)
    told = tree["datum"]["leverage"].values
    assert told.min() >= 0
    total = told.sum() + tree["target"].attrs["motion"]
    np.testing.assert_allclose(total, share.sum(), rtol=1e-9)
    np.testing.assert_allclose(tree["sensor"]["leverage"].values.sum(), told.sum(), rtol=1e-9)


@pytest.mark.ci
def test_leverages_are_those_of_a_dense_regression():
    """With known states the leverage of a datum is the diagonal of the hat matrix of a ridge regression."""
    network = Network([plain_range.on(Node(f"n_{k}", p, scale=5.0)) for k, p in enumerate(places(2, 2))])
    motion = Known((TIME, path(2)))
    table = simulate(network, ConstantVelocity(3.0), TIME, key=0, tracks={"target": path(2)}).table
    problem = Problem(network, motion, table)
    point = resting(problem)
    H = by_bias(problem, point)
    hat = np.einsum("im,mn,in->i", H, np.linalg.inv(H.T @ H + np.eye(H.shape[1])), H)
    tree = observability(problem, point=point)
    np.testing.assert_allclose(tree["datum"]["leverage"].values, hat, rtol=1e-8)
    assert tree["target"].attrs["motion"] < 1e-9


@float64
def by_bias(problem, point):
    (block,), (data,) = problem.model.blocks, problem.model.rows
    return np.asarray(
        jax.jacfwd(lambda z: (waist.predict(block, data, point.states[0], z) / data.std).ravel())(point.z)
    )


@float64
@pytest.mark.ci
def test_the_gain_of_a_pass_is_what_its_rows_tell():
    problem, point, _ = free_radars()
    line = np.array([[100.0, 150.0], [400.0, 300.0]])  # within the reach of all
    found = next_passes(problem, point=point, passes=[line])
    track = line[0] + TIME[:, None] / TIME[-1] * (line[1] - line[0])
    table = problem.measurements.table.frame.assign(target="old")
    both = pd.concat([table, table.assign(target="new")], ignore_index=True)
    wider = Problem(problem.network, ConstantVelocity(3.0), both)
    added = np.hstack([track, np.gradient(track, TIME, axis=0)])
    states = np.concatenate([np.asarray(point.states[0]), added])
    after = spectrum(wider, point._replace(states=(states,), noises=(np.zeros_like(states),)))
    before, eye = spectrum(problem, point), np.eye(len(after))
    gain = 0.5 * (np.linalg.slogdet(after + eye)[1] - np.linalg.slogdet(before + eye)[1])
    np.testing.assert_allclose(found["gain"].values, [gain], rtol=1e-8)


def test_the_gain_of_an_anchor_has_a_closed_form():
    problem, point, _ = free_radars()
    found = next_anchors(problem, point=point, survey=0.1)
    covariance = np.linalg.inv(spectrum(problem, point) + np.eye(len(problem.labels)))
    m = problem.labels.index("node_3.heading")
    own, gain = (found[name].sel(anchor="node_3.heading").item() for name in ("own", "gain"))
    np.testing.assert_allclose(own, 0.5 * np.log1p(covariance[m, m] / 0.01), rtol=1e-9)
    rest = np.delete(np.arange(len(covariance)), m)
    with_it = np.linalg.inv(np.linalg.inv(covariance) + 100.0 * np.outer(*[np.eye(len(covariance))[m]] * 2))
    parts = [np.linalg.slogdet(c[np.ix_(rest, rest)])[1] for c in (covariance, with_it)]
    np.testing.assert_allclose(gain, 0.5 * (parts[0] - parts[1]), rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(found["std"].sel(anchor="node_3.heading").item(), 0.1 * 0.1)
    assert (np.diff(found["gain"].values) <= 1e-12).all()
    for anchor in ("node_3.position_*", "node_0.heading", "node_1.position_x"):
        stays = [fnmatch(label, anchor) for label in problem.labels]
        held = spectrum(problem, point) + np.diag(100.0 * np.array(stays))
        assert found["weak"].sel(anchor=anchor).item() == (np.linalg.eigvalsh(held) < 1).sum()
    assert found["weak"].sel(anchor="node_3.position_*").item() < found.attrs["weak_before"]


@float64
@pytest.mark.ci
def test_a_further_sensor_stands_where_it_is_tried_for_all_targets():
    """Also where they are of several kinds: at rest and on their way."""
    problem = problem_of([plain_range], 2, {"position": 10.0})
    frame = problem.measurements.table.frame
    rest = pd.DataFrame({"time": TIME, "sensor": "plain_range_0", "target": "mast", "range": 1.0})
    both = pd.concat([frame.assign(target="car"), rest], ignore_index=True)
    network, motion = problem.network, {"car": ConstantVelocity(3.0), "mast": Static()}
    problem, place = Problem(network, motion, both), np.array([240.0, 60.0])
    point = automatic_start(problem)
    found = next_sensors(problem, point=point, places=[place])
    further = Network([*network.sensors, plain_range.on(Node("further", place))])
    seen = both.drop_duplicates(["time", "target"]).assign(sensor="further", range=1.0)
    wider = Problem(further, motion, pd.concat([both, seen], ignore_index=True))
    whole = spectrum(wider, point._replace(z=np.append(point.z, 0.0)))  # its offset is the last bias
    after = whole[:-1, :-1] - np.outer(whole[:-1, -1], whole[:-1, -1]) / (whole[-1, -1] + 1.0)
    before, eye = spectrum(problem, point), np.eye(15)
    gain = 0.5 * (np.linalg.slogdet(after + eye)[1] - np.linalg.slogdet(before + eye)[1])
    np.testing.assert_allclose(found["gain"].values, [gain], rtol=1e-8)


@float64
@pytest.mark.ci
def test_the_gain_of_a_sensor_is_what_its_rows_tell():
    problem = problem_of([plain_range], 2, {"position": 10.0})
    point = truth_of(problem)
    place = np.array([240.0, 60.0])
    found = next_sensors(problem, point=point, places=[place])
    network = Network([*problem.network.sensors, plain_range.on(Node("further", place))])
    frame = problem.measurements.table.frame
    rows = pd.DataFrame({"time": TIME, "sensor": "further", "range": 1.0})
    wider = Problem(network, ConstantVelocity(3.0), pd.concat([frame, rows], ignore_index=True))
    after = spectrum(wider, truth_of(wider)) + np.eye(16)
    before, eye = spectrum(problem, point), np.eye(15)
    inside = after[:-1, :-1] - np.outer(after[-1, :-1], after[-1, :-1]) / after[-1, -1]
    gain = 0.5 * (np.linalg.slogdet(inside)[1] - np.linalg.slogdet(before + eye)[1])
    np.testing.assert_allclose(found["gain"].values, [gain], rtol=1e-8)


@pytest.mark.parametrize(
    ("kinds", "dimension", "scale", "motion"),
    [
        pytest.param([sensors.radar_3d], 3, FREE, None, marks=pytest.mark.slow),
        pytest.param([difference], 2, {"clock": 10.0, "position": 5.0}, None, marks=pytest.mark.slow),
        pytest.param([arrival, compass], 2, {"position": 5.0}, EMITTED, marks=pytest.mark.slow),
        pytest.param([plain_range], 2, {"position": 5.0}, Static(), marks=pytest.mark.slow),
    ],
    ids=["3-D", "two nodes", "mixed", "static"],
)
def test_planning_works_for_every_kind(kinds, dimension, scale, motion, monkeypatch):
    """And by either engine the same."""
    problem = problem_of(kinds, dimension, scale, motion)
    point = automatic_start(problem)
    wanted = [plan(problem, point=point)["gain"].values for plan in (next_passes, next_sensors)]
    with monkeypatch.context() as patch:
        patch.setattr("probcal.gaussian.choose.ROOM", 0)
        for plan, gain in zip((next_passes, next_sensors), wanted, strict=True):
            np.testing.assert_allclose(plan(problem, point=point)["gain"].values, gain, rtol=1e-5, atol=1e-6)
    for plan in (next_passes, next_anchors, next_sensors):
        found = plan(problem, point=point)
        gain = found["gain"].values
        assert np.isfinite(gain).all()
        assert (gain >= -1e-9).all()
        assert gain[0] > 0 or len(problem.labels) == 1
        assert (np.diff(gain) <= 1e-12).all()


def test_a_gauge_is_that_of_two_recursions_and_missing_rows():
    """A second target with another state, half of the data missing: the count stays."""
    nodes = [Node(f"node_{k}", p, scale=FREE) for k, p in enumerate(places(5, 2))]
    network = Network([scanner.on(node) for node in nodes])
    motion = {"car": ConstantVelocity(3.0), "mast": Static()}
    tracks = {"car": path(2), "mast": np.array([[222.0, 111.0]])}
    run = simulate(network, motion, TIME, key=1, share=0.0, tracks=tracks, missing=0.3)
    problem = Problem(network, motion, run.table)
    assert gauge_count(problem, truth_of(problem, tracks)) == 3


@float64
def gauge_count(problem, point):
    return gauge(problem, point).basis.shape[1]


@pytest.mark.parametrize(
    ("information", "names"),
    [
        ([[0.9, 0.5, 0.0], [0.5, 0.9, 0.0], [0.0, 0.0, 100.0]], ["range_offset of plain_range_0 against range_offset"]),
        (np.diag([0.2, 0.5, 100.0]), ["range_offset of plain_range_0 alone", "range_offset of plain_range_1 alone"]),
        ([[1.2, 0.5, 0.0], [0.5, 1.2, 0.0], [0.0, 0.0, 0.5]], ["range_offset of plain_range_2 alone", "against"]),
    ],
)
def test_as_many_directions_are_named_as_there_are_and_each_has_a_remedy(information, names):
    problem = problem_of([plain_range], 2, None, count=3)
    found = weak_directions(problem, np.array(information), truth_of(problem))
    assert len(found) == (np.linalg.eigvalsh(information) < 1).sum() == len(names)
    for name in names:
        assert any(name in direction.name for direction in found)
    assert all(direction.fix for direction in found)
    fixed = {label for direction in found for label in direction.fix}
    stay = [k for k, label in enumerate(problem.labels) if label not in fixed]
    assert (np.linalg.eigvalsh(np.array(information)[np.ix_(stay, stay)]) >= 1).all()


@pytest.mark.ci
def test_an_anchor_fixed_at_a_value_is_the_centre_of_rotation():
    held = free_radars()[0].rebuild(fix={"node_0.position_x": 30.0, "node_0.position_y": 0.0})
    tree = observability(held, point=truth_of(held))
    assert "rotation about the anchor" in tree["direction"]["direction"].values.tolist()


@pytest.mark.ci
def test_only_what_moves_along_is_named_in_a_dilation():
    """Bearings know no range: a scale on another channel has nothing to do with the size of the scene."""

    problem = problem_of([ear], 2, {"position": 10.0})
    group = observability(problem, point=truth_of(problem))["direction"].to_dataset()
    (dilation,) = (k for k, name in enumerate(group["direction"].values.tolist()) if name == DILATED)
    assert "scale" not in group["words"].values[dilation] + group["remedy"].values[dilation]


def test_misuse_is_told():
    problem = problem_of([plain_range], 2, None)
    fixed = problem.rebuild(fix="*")
    for call in (observability, next_passes, next_anchors, next_sensors):
        with pytest.raises(InputError, match="every bias of the problem is fixed"):
            call(fixed)
    point = truth_of(problem)
    with pytest.raises(InputError, match=r"passes has shape \(1, 2, 3\); give \(passes, points, 2\)"):
        next_passes(problem, point=point, passes=np.zeros((1, 2, 3)))
    with pytest.raises(InputError, match=r"places has shape \(2,\); give \(places, 2\)"):
        next_sensors(problem, point=point, places=[1.0, 2.0])
    with pytest.raises(InputError, match="survey=0 must be positive, a std over the scale"):
        next_anchors(problem, point=point, survey=0)
    grazing = point._replace(states=(jnp.full(point.states[0].shape, np.nan),))
    with pytest.raises(InputError, match="no finite derivatives at the start"):
        observability(problem, point=grazing)
