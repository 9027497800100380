"""Clocks of nodes: rows measured at another time than the stated one."""

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

import probcal as pc
from probcal.gaussian.mode import Point
from probcal.geometry import bearing, norm
from probcal.motion import CoordinatedTurn
from probcal.motion.layout import flow_of, layout_of, view
from probcal.results.read import apply

TIME = np.arange(0.0, 40.0, 2.0)
PLACES = ((0.0, 0.0), (400.0, 0.0), (200.0, 300.0))
DRIVE = pc.ConstantAcceleration(0.5)
WAY = np.stack([200 + 150 * np.cos(TIME / 9), 120 + 90 * np.sin(TIME / 6)], 1)


@pc.sensor(range=pc.Channel("m", std=0.5), azimuth=pc.Channel("rad", std=0.003, wrap=True))
def scope(target, pose):
    """Range and azimuth, of which the function knows no time."""
    line = pose.local(target.position)
    return dict(range=norm(line), azimuth=bearing(line))


@pc.sensor(range=pc.Channel("m", std=0.5), azimuth=pc.Channel("rad", std=0.003, wrap=True))
def own_scope(target, pose):
    """The same with the target moved by the function itself."""
    line = pose.local(target.at(pose.time_offset).position)
    return dict(range=norm(line), azimuth=bearing(line))


def network(scale=0.5, kind=scope, more=None, **stated):
    loose = {"time_offset": scale, "heading": 0.02} | (more or {})
    nodes = [pc.Node(f"n{k}", place, **(stated if k else {}), scale=loose if k else None) for k, place in
             enumerate(PLACES)]  # fmt: skip
    return pc.Network([kind.on(node) for node in nodes])


def late_rows(offsets, seed=0, way=None, time=TIME, headings=(0.0, 0.0, 0.0)):
    """Rows of the three nodes, made without the package: at stated time t the target is seen at t + offset."""
    rng = np.random.default_rng(seed)
    way = way or (lambda t: np.stack([200 + 150 * np.cos(t / 9), 120 + 90 * np.sin(t / 6)], 1))
    parts = []
    for k, place in enumerate(PLACES):
        line = way(time + offsets[k]) - place
        azimuth = np.arctan2(line[:, 1], line[:, 0]) - headings[k] + 0.003 * rng.standard_normal(len(time))
        parts.append(pd.DataFrame({
            "time": time, "sensor": f"n{k}", "range": np.hypot(*line.T) + 0.5 * rng.standard_normal(len(time)),
            "azimuth": (azimuth + np.pi) % (2 * np.pi) - np.pi,
        }))  # fmt: skip
    return pd.concat(parts).sort_values("time", kind="stable")


@pytest.fixture(scope="module")
def problem():
    return pc.Problem(network(), DRIVE, late_rows((0.0, 0.4, -1.3)))


def z_of(problem, **values):
    named = {label.replace(".", "_"): m for m, label in enumerate(problem.labels)}
    z = np.zeros(len(problem.labels))
    for label, value in values.items():
        z[named[label]] = value / problem.scales[named[label]]
    return z


def test_rows_of_a_free_clock_have_epochs_of_their_own_and_retiming_keeps_every_shape(problem):
    epochs = problem.epochs[0]
    assert len(epochs.time) == 3 * len(TIME)  # n0 by the table, n1 and n2 by their clocks
    assert problem.clocks.tolist() == [0, 2, 3]
    later = problem.retimed(z_of(problem, n1_time_offset=0.4, n2_time_offset=-1.3))
    shapes = [[leaf.shape for leaf in jax.tree.leaves(p.model)] for p in (problem, later)]
    assert shapes[0] == shapes[1]
    assert jax.tree.structure(problem.model) == jax.tree.structure(later.model)
    assert np.all(np.diff(later.epochs[0].time) >= 0)
    expected = np.concatenate([TIME, TIME + 0.4, TIME - 1.3])
    assert np.allclose(np.sort(later.epochs[0].time), np.sort(expected))
    assert np.abs(later.lateness(later.first_z)).max() < 1e-12
    assert later.retimed(later.first_z) is later


def test_states_are_carried_between_times_by_their_rows(problem):
    later = problem.retimed(z_of(problem, n1_time_offset=3.0))
    there = later.reordered(problem, [np.asarray(later.epochs[0].time)[:, None]])[0][:, 0]
    moved = there - problem.epochs[0].time
    assert set(np.round(moved, 9)) == {0.0, 3.0}


@pytest.mark.parametrize("kind", [scope, own_scope])
def test_a_row_is_read_where_its_clock_puts_it(kind):
    known = pc.Problem(network(kind=kind), DRIVE, late_rows((0.0, 0.4, -1.3)))
    offsets = z_of(known, n1_time_offset=0.4, n2_time_offset=-1.3)
    with jax.enable_x64(True):
        states = [np.zeros((len(known.epochs[0].time), 6))]
        states[0][:, :2] = 100.0 + 5.0 * known.epochs[0].time[:, None]
        states[0][:, 2:4] = 5.0
        later = known.retimed(offsets)
        moved = [np.array(x) for x in states]
        moved[0][:, :2] = 100.0 + 5.0 * later.epochs[0].time[:, None]
        by_row = [
            np.asarray(p.model.predict(Point(tuple(x), (), np.asarray(offsets), np.zeros(0)))[0])
            for p, x in ((known, states), (later, moved))
        ]
    assert np.allclose(*by_row, atol=1e-9)


def test_stated_offsets_and_rates_move_rows_too():
    stated = network(time_offset=0.4, time_rate=1e-3)
    problem = pc.Problem(stated, DRIVE, late_rows((0.0, 0.4, 0.4)))
    mine = np.isin(problem.measurements.sensor, [1, 2])
    moved = problem.retimed(problem.first_z).moved
    assert np.allclose(moved[mine], (0.4 + 1e-3 * (problem.measurements.time[mine])) / (1 - 0 * 1e-3), atol=2e-3)
    assert not moved[~mine].any()


def test_a_motion_that_turns_goes_on_by_its_own_transition():
    turn = CoordinatedTurn(0.1, rate=0.3)
    assert flow_of([pc.ConstantVelocity(0.1)], 2) == () == flow_of([DRIVE, pc.White("power", "dB", 1.0)], 3)
    (part,) = flow_of([turn], 2)
    assert part == CoordinatedTurn(1.0, rate=0.3)  # whatever its std
    state = np.array([10.0, 20.0, 3.0, -1.0])

    @jax.jit
    def seen(state):
        later = view(layout_of([turn], 2), state, (part,)).at(0.7)
        return jnp.concatenate([later.position, later.velocity])

    assert np.allclose(seen(state), turn.transition(np.array([0.7]), 2)[0] @ state, atol=1e-6)


@pytest.mark.ci
def test_offsets_are_found_from_anywhere_within_their_scale():
    problem = pc.Problem(network(), DRIVE, late_rows((0.0, 0.4, -1.3), headings=(0.0, 0.03, 0.0)))
    tree = pc.fit(problem)
    found = pc.summary(tree).set_index("bias")
    for label, true in {"n1.time_offset": 0.4, "n2.time_offset": -1.3, "n1.heading": 0.03}.items():
        assert abs(found.loc[label, "mean"] - true) < 4 * found.loc[label, "sd"], label
        assert found.loc[label, "sd"] < 0.1
    assert tree.attrs["status"] == "converged"
    track = tree["track/target"].to_dataset()
    assert track.sizes["time"] == 3 * len(TIME)
    true = np.stack([200 + 150 * np.cos(track["time"] / 9), 120 + 90 * np.sin(track["time"] / 6)], 1)
    error = track["mean"].sel(component=["position_x", "position_y"]).values - true
    assert np.sqrt((error**2).sum(1).mean()) < 1.5
    checked = pc.assess(problem, tree)
    assert checked["verdict"].to_dataset()["verdict"].sel(bias_label="n2.time_offset").item() == "determined"
    again = pc.track(problem, tree)["track/target"].to_dataset()
    assert np.allclose(again["mean"], track["mean"], atol=0.2)
    assert np.allclose(again["time"], track["time"], atol=0.1 * found.loc["n2.time_offset", "sd"])


def test_a_time_of_an_emission_is_refused():
    @pc.sensor(arrival=pc.Channel("m", std=1.0))
    def pulse(target, pose):
        return dict(arrival=norm(target.position - pose.position) + target.emission)

    rows = late_rows((0.0, 0.0, 0.0)).rename(columns={"range": "arrival"}).drop(columns="azimuth")
    nodes = [pc.Node(f"n{k}", place, scale={"time_offset": 0.1} if k else None) for k, place in enumerate(PLACES)]
    with pytest.raises(pc.InputError, match=r'sensor "n1" reads target.emission, of which every epoch has its own'):
        pc.Problem(pc.Network([pulse.on(node) for node in nodes]), DRIVE + pc.White("emission", "m", 100.0), rows)


def test_only_the_first_node_of_a_sensor_gives_its_rows_their_time():
    @pc.sensor(difference=pc.Channel("m", std=1.0))
    def apart(target, first, second):
        return dict(difference=norm(target.position - second.position) - norm(target.position - first.position))

    first, second = pc.Node("a", (0.0, 0.0)), pc.Node("b", (400.0, 0.0), scale={"time_offset": 0.1})
    with pytest.raises(pc.InputError, match="time_offset has a scale, but none of its sensors reads it"):
        pc.Network([apart.on(first, second)])


def test_a_method_without_motion_is_refused(problem):
    with pytest.raises(pc.InputError, match="without a motion nothing tells the time of a row: hold the clocks"):
        pc.fit(problem, pc.LeastSquares())
    held = pc.Problem(problem.network, DRIVE, problem.measurements.table, fix=("*.time_*",))
    assert not held.clocks.any()
    assert len(held.unlinked().epochs[0].time) == len(TIME)


def test_posterior_calibration_with_clocks_is_refused(problem):
    with pytest.raises(pc.InputError, match="sbc: rows of free clocks have other times in every truth"):
        pc.sbc(problem, pc.EA(), runs=2, around="data")


def test_a_simulated_row_is_drawn_at_its_true_time():
    way = np.stack([10.0 * TIME, 50.0 + 0.0 * TIME], 1)
    run = pc.simulate(network(), DRIVE, TIME, key=3, biases={"n1.time_offset": 2.0}, tracks={"target": way})
    rows = run.table[run.table["sensor"] == "n1"]
    expected = np.hypot(10.0 * (rows["time"] + 2.0) - 400.0, 50.0)
    assert np.abs(rows["range"] - expected).max() < 4 * 0.5 + 1e-9
    assert run.truth.tracks["time"].max() == TIME[-1] + 2.0


def test_a_moving_node_goes_on_along_its_path_too():
    path = pc.Path([0.0, 60.0], position=[(0.0, 0.0), (60.0, 0.0)], heading=[0.0, 0.6])
    nodes = [pc.Node("still", (0.0, 300.0)), pc.Node("boat", path=path, scale={"time_offset": 0.5})]
    network = pc.Network([scope.on(node) for node in nodes])
    way = np.stack([np.full(len(TIME), 100.0), np.full(len(TIME), 100.0)], 1)
    run = pc.simulate(network, DRIVE, TIME, key=1, biases={"boat.time_offset": 0.8}, tracks={"target": way})
    rows = run.table[run.table["sensor"] == "boat"]
    assert np.abs(rows["range"] - np.hypot(100.0 - (rows["time"] + 0.8), 100.0)).max() < 4 * 0.5
    assert np.abs(rows["azimuth"] - np.arctan2(100.0, 100.0 - (rows["time"] + 0.8)) + 0.01 * (rows["time"] + 0.8)
                  ).max() < 4 * 0.003  # fmt: skip


@pytest.mark.ci
@pytest.mark.parametrize("dated", [False, True])
def test_a_clock_that_runs_counts_from_the_rows_of_its_calibration(dated):
    loose = network(0.5, more={"time_rate": 1e-2})
    running = {"n1.time_offset": 0.3, "n1.time_rate": 8e-3, "n2.time_rate": -4e-3}

    def written(table, begin):
        time = table["time"] + begin
        return table.assign(time=pd.Timestamp("2026-03-01") + pd.to_timedelta(time, unit="s") if dated else time)

    first = pc.simulate(loose, DRIVE, TIME, key=1, biases=running, tracks={"target": WAY}).table
    tree = pc.fit(pc.Problem(loose, DRIVE, written(first, 0.0)))
    found = pc.summary(tree).set_index("bias")
    assert abs(found.loc["n1.time_rate", "mean"] - 8e-3) < 4 * found.loc["n1.time_rate", "sd"]
    later = pc.Problem(loose, DRIVE, written(first, 100.0))
    applied = apply(later, tree).problem
    assert applied.begin == pytest.approx(-100.0 if dated else 0.0)
    mine = later.measurements.sensor == 1
    since = later.measurements.time[mine] - applied.begin
    ahead = found.loc["n1.time_offset", "mean"] + found.loc["n1.time_rate", "mean"] * since
    assert np.allclose(applied.moved[mine], ahead, rtol=0.03)


@pytest.mark.slow
@pytest.mark.parametrize(("offset", "scale"), [(10.0, 10.0), (-10.0, 3.0), (10.0, 1.0)])
def test_an_offset_far_beyond_the_reach_is_never_determined_and_wrong(offset, scale):
    """Turns within a second, rows every two: of ten times the reach, other lags fit as tracks do."""
    time, confident = np.arange(0.0, 80.0, 2.0), 0
    for seed in range(3):
        rng = np.random.default_rng(seed)
        rate, phase, size = (rng.uniform(low, high, (2, 3)) for low, high in ((0.5, 1.5), (0, 6.3), (10, 40)))

        def way(t, rate=rate, phase=phase, size=size):
            return np.array([200, 120]) + np.sum(size * np.sin(t[:, None, None] * rate + phase), 2)

        rows = late_rows((0.0, offset, 0.0), 100 + seed, way, time)
        problem = pc.Problem(network(scale), pc.ConstantAcceleration(20.0), rows)
        tree = pc.assess(problem, pc.fit(problem))
        table = pc.summary(tree).set_index("bias")
        confident += tree.attrs["status"] == "converged"
        truth = [offset if label == "n1.time_offset" else 0.0 for label in table.index]
        sure = (table["verdict"] == "determined") & (np.abs(table["mean"] - truth) > 4 * table["sd"])
        assert not sure.any(), table[sure]
    assert confident, "the verdicts are put to the test"
