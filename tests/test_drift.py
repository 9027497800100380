"""Drifting biases: what they declare, what a fit tells of them, jumps found by a sparse prior, evidence for a drift.

Their numbers are exact on linear networks: the case `drifting` of test_exact.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from worlds import exact, fitted, linear, resting

import probcal
from probcal import (
    EA,
    MAP,
    BernoulliGaussian,
    Bias,
    Channel,
    Collapsed,
    ConstantVelocity,
    Drift,
    Gaussian,
    InputError,
    Network,
    Node,
    Problem,
    Target,
    drift_table,
    sensor,
    simulate,
)
from probcal.inference.ending import bias_status
from probcal.labels import label_parts
from probcal.plots import plot_drift, plot_gamma
from probcal.report import write_report

sys.path.insert(0, str(Path(__file__).parents[1] / "models"))
import plaza

TIMES = np.arange(0.0, 50.0, 10.0)
FALSE_ALARM = 1e-6


def watched(drift=None, survey=None):
    """Three sensors that see the position of one target; that of `b` moves, of `c` is surveyed."""
    kind = replace(probcal.sensors.position, channels={"position": Channel("m", std=0.5, per_axis=True)})
    nodes = [
        Node("a", (0.0, 0.0)),
        Node("b", (50.0, 10.0), scale={"position": Bias("m", 2.0, drift=drift)}),
        Node("c", (10.0, 60.0), survey={"position": Bias("m", 1.0, drift=survey)}),
    ]
    network = Network([kind.on(node) for node in nodes])
    motion = Target(ConstantVelocity(0.3), start={"position": (0.0, 20.0), "velocity": (1.0, 1.0)})
    return network, motion


def test_steps_have_times_scales_and_labels():
    walk, jumps = Drift((0.0, 1.0, 5.0), std=0.5), Drift(np.array([0.0, 0.25]), scale=3.0)
    assert walk.steps == ((1.0, 0.5), (5.0, 1.0))
    assert jumps.steps == ((0.25, 3.0),)
    network, motion = watched(walk, jumps)
    table = simulate(network, motion, np.arange(8.0), key=0).table
    problem = Problem(network, motion, table)
    kinds = {b.label: (b.kind, b.scale, b.since) for b in problem.biases if b.axis == 0}
    assert kinds == {
        "b.position_x": ("scale", 2.0, None), "b.position_x@1": ("drift", 0.5, 1.0),
        "b.position_x@5": ("drift", 1.0, 5.0), "c.position_x": ("survey", 1.0, None),
        "c.position_x@0.25": ("scale", 3.0, 0.25),
    }  # fmt: skip
    assert dict(zip(problem.labels, problem.surveyed, strict=True))["b.position_x@1"]
    ended = dict(zip(problem.labels, bias_status(problem, {}), strict=True))
    assert [ended[label] for label in kinds] == ["estimated", "drift", "drift", "survey", "estimated"]
    assert Problem(network, motion, table, fix=["*@*"]).labels == tuple(n for n in problem.labels if "@" not in n)
    assert label_parts("c.position_x@0.25") == ("c", "position_x@0.25")
    assert label_parts("mast.7@2.position_x@0.25") == ("mast.7@2", "position_x@0.25")
    assert label_parts("mast.7@2.position_x") == ("mast.7@2", "position_x")


def test_what_it_refuses():
    dates = np.array(["2024-01-01", "2024-01-02"], "M8[s]")
    for times in ([0.0], [0.0, 0.0], [[0.0, 1.0]], [0.0, np.inf], [0.0, "x"], dates):
        with pytest.raises(InputError, match="the pieces start, in seconds of the table, two or more, increasing"):
            Drift(times, std=1.0)
    for options in ({}, {"std": 1.0, "scale": 1.0}):
        with pytest.raises(InputError, match=r"give either std \(a random walk of known level\) or scale"):
            Drift((0.0, 1.0), **options)
    with pytest.raises(InputError, match=r"Drift: std is 0\.0; it must be positive"):
        Drift((0.0, 1.0), std=0.0)
    for size in ("x", -1.0, np.nan):
        with pytest.raises(InputError, match=r"Drift: std is .*; it must be positive"):
            Drift((0.0, 1.0), std=size)
    with pytest.raises(InputError, match="times are less than a millisecond apart; merge those pieces"):
        Drift((0.0, 1.0, 1.0001), std=1.0)
    with pytest.raises(InputError, match=r"Bias\('m', drift=3\): give Drift"):
        Bias("m", 1.0, drift=3)


@pytest.fixture(scope="module")
def moved():
    """A recording in which `b` wanders, its truth, and the fit of the problem that lets it drift."""
    network, motion = watched(Drift(TIMES, std=0.8))
    recording = simulate(network, motion, np.arange(50.0), key=3)
    problem = Problem(network, motion, recording.table)
    return problem, recording, probcal.fit(problem, MAP(), prior=Gaussian())


@pytest.mark.ci
def test_values_of_a_drifting_bias_are_its_steps_so_far(moved):
    problem, recording, tree = moved
    table = drift_table(tree)
    assert list(table["bias"].unique()) == ["b.position_x", "b.position_y"]
    group = tree["calibration"].to_dataset()
    for name, pieces in table.groupby("bias"):
        members = [label for label in problem.labels if label.startswith(name)]
        assert list(pieces["since"]) == TIMES.tolist()
        true = np.cumsum([recording.truth.biases[m] for m in members])
        np.testing.assert_allclose(pieces["mean"], np.cumsum(group["mean"].sel(bias_label=members)), rtol=1e-12)
        error = (pieces["mean"] - true) / pieces["sd"]
        assert np.abs(error).max() < 5.7  # ten normals, false alarms 1e-7
        covariance = group["covariance"].sel(bias_label=members, bias_label_other=members).values
        np.testing.assert_allclose(pieces["sd"].iloc[-1], np.sqrt(covariance.sum()), rtol=1e-12)
        assert (pieces["lower"] < pieces["mean"]).all()
        assert (pieces["mean"] < pieces["upper"]).all()
        assert pieces["sd"].max() < 0.5, "each piece is known to some share of its noise"


@pytest.mark.ci
def test_pictures_and_report_show_the_drift(moved, tmp_path):
    _, _, tree = moved
    ax = plot_drift(tree)
    assert isinstance(ax.get_figure(), Figure)
    assert len(ax.get_lines()) == 3
    assert "@" not in " ".join(text.get_text() for text in plot_gamma(tree).get_legend().get_texts())
    page = write_report(tree, tmp_path / "report.html").read_text()
    assert "Values of the drifting biases over time" in page


@pytest.mark.ci
def test_nodes_that_drift_are_left_out_of_the_file(moved, tmp_path):
    problem, _, tree = moved
    for given in (tree, problem.network.nodes):
        text = probcal.write_nodes(tmp_path / "nodes.csv", given).read_text()
        assert [line.split(",")[0] for line in text.splitlines()] == ["node", "a", "c"]


@pytest.mark.ci
def test_values_hold_fixed_steps_and_steps_before_the_data():
    """The linear world `drifting`: every piece is the sum of what has begun by then, its sd that of the exact sum."""
    problem, naive = linear("drifting")
    (mean, covariance), scale = exact("drifting").z, np.array(list(naive.scales.values()))
    table = drift_table(fitted("drifting"))
    gain = table.query("bias == 'gauge_b.gain'").set_index("since")
    assert list(gain.index) == [0.0, 0.75, 1.7, 3.1]
    clock = table.query("bias == 'a.clock'")
    assert list(clock["since"]) == [0.0, 1.7], "what begins before the data is part of the first value"
    begun = ["gauge_b.gain", "gauge_b.gain@0.75", "gauge_b.gain@3.1"]
    for since, members, fixed in ((0.75, begun[:2], 0.0), (1.7, begun[:2], 0.6), (3.1, begun, 0.6)):
        weight = scale * np.isin(naive.labels, members)
        assert gain["mean"][since] == pytest.approx(weight @ mean + fixed)
        assert gain["sd"][since] == pytest.approx(np.sqrt(weight @ covariance @ weight))
    early = scale * np.isin(naive.labels, ["a.clock", "a.clock@-5"])
    assert "a.clock@-5" in naive.labels
    assert clock["mean"].iloc[0] == pytest.approx(early @ mean)
    assert problem.fixed == {"gauge_b.gain@1.7": 0.6}


@pytest.mark.slow
def test_steps_before_and_after_the_data_change_nothing_else():
    network, motion = watched()
    table = simulate(network, motion, np.arange(12.0), key=1).table
    still = probcal.fit(Problem(network, motion, table), MAP(), prior=Gaussian())
    late = watched(Drift((0.0, 100.0), std=0.1))[0]
    tree = probcal.fit(Problem(late, motion, table), MAP(), prior=Gaussian())
    group, constant = tree["calibration"].to_dataset(), still["calibration"].to_dataset()
    own = constant["bias_label"].values
    np.testing.assert_allclose(group["mean"].sel(bias_label=own), constant["mean"], rtol=1e-9)
    assert group["gamma"].sel(bias_label="b.position_x@100").item() == pytest.approx(0.0, abs=1e-9)
    early = watched(Drift((-9.0, -5.0), std=0.1))[0]
    tree = probcal.fit(Problem(early, motion, table), MAP(), prior=Gaussian())
    both = tree["calibration"].to_dataset()["mean"].to_series()
    # the bias and a step before the data are one bias of their common spread
    wide = np.hypot(2.0, 0.1 * 2)
    other = Node("b", (50.0, 10.0), scale={"position": Bias("m", wide)})
    sensors = [other if p.name == "b" else p.nodes[0] for p in network.sensors]
    merged = Network([p.type.on(n) for p, n in zip(network.sensors, sensors, strict=True)])
    single = probcal.fit(Problem(merged, motion, table), MAP(), prior=Gaussian())
    mean = single["calibration"].to_dataset()["mean"].to_series()
    assert both["b.position_x"] + both["b.position_x@-5"] == pytest.approx(mean["b.position_x"], rel=1e-9)


@pytest.mark.slow
def test_evidence_tells_a_drift_from_a_constant_bias():
    """A Bayes factor has mean 1 under the smaller model: it passes 1 / FALSE_ALARM at most at that rate (Markov)."""
    constant, motion = watched()
    walk = watched(Drift(TIMES, std=0.8))[0]
    for drifts, seed in ((False, 5), (True, 6)):
        table = simulate(walk if drifts else constant, motion, np.arange(50.0), key=seed).table
        fits = [probcal.fit(Problem(n, motion, table), MAP(), prior=Gaussian()) for n in (constant, walk)]
        still, moving = (tree.attrs["log_evidence"] for tree in fits)
        compared = probcal.compare({"constant": fits[0], "drifting": fits[1]})
        elpd = [compared[f"method/{name}"].attrs["elpd"] for name in ("constant", "drifting")]
        if drifts:
            assert moving - still > 20
            assert elpd[1] - elpd[0] > 20
        else:
            assert moving - still < -np.log(FALSE_ALARM)
            assert elpd[1] - elpd[0] < 5


@pytest.mark.slow
def test_a_sparse_prior_finds_the_jump():
    """One step of a bias is large, the others zero: its inclusion stands out."""
    network, motion = watched(Drift(TIMES, scale=2.0))
    truth = {"b.position_x": 0.0, "b.position_x@20": 3.0}
    table = simulate(network, motion, np.arange(50.0), key=2, biases=truth).table
    problem = Problem(network, motion, table)
    tree = probcal.fit(problem, Collapsed(chains=2, draws=300, warmup=200), prior=BernoulliGaussian(), key=1)
    share = tree["calibration"].to_dataset()["inclusion"].to_series()
    steps = share[[label for label in problem.labels if "@" in label]]
    assert steps.drop("b.position_x@20").max() < 0.9 < steps["b.position_x@20"]
    found = drift_table(tree).query("bias == 'b.position_x'")
    assert ((found["lower"] <= [0, 0, 3, 3, 3]) & (found["upper"] >= [0, 0, 3, 3, 3])).all()


@pytest.mark.slow
def test_both_samplers_agree_on_a_drift():
    problem, _ = linear("drifting")
    options = {"prior": Gaussian(), "start": resting(problem)}
    known = fitted("drifting")["calibration"].to_dataset()
    drawn = probcal.fit(problem, Collapsed(chains=4, draws=1000), key=2, **options)["calibration"].to_dataset()
    error = (drawn["mean"] - known["mean"]) / (known["sd"] / np.sqrt(drawn["ess"]))
    assert np.abs(error).max() < 6.0
    np.testing.assert_allclose(drawn["sd"], known["sd"], rtol=0.15)


def test_a_clock_of_its_own_type_may_drift():
    @sensor(arrival=Channel("m", std=1.0))
    def receiver(target, pose, *, delay=Bias("m", 5.0, shared="type", drift=Drift((0.0, 5.0), std=1.0))):
        return {"arrival": target.position[0] - pose.position[0] + delay}

    network = Network([receiver.on(Node(name, (0.0, 0.0))) for name in "ab"])
    assert network.labels == ("receiver.delay", "receiver.delay@5")
    motion = Target(ConstantVelocity(0.1), start={"position": (0.0, 1.0), "velocity": (0.0, 1.0)})
    problem = Problem(network, motion, simulate(network, motion, np.arange(10.0), key=0).table)
    assert [m["component"] for m in problem.members] == ["delay", "delay_step"]


@pytest.mark.slow
def test_the_radios_of_plaza_stand_still():
    """Constant offsets and scales against walks of both: elpd and evidence agree that nothing drifts."""
    constant = plaza.problem()
    times = np.linspace(constant.measurements.time.min(), constant.measurements.time.max(), 7)[:-1]
    fits, evidence = {}, {}
    for name, step in (("constant", {}), ("range_offset", {"std": 0.05}), ("range_scale", {"std": 0.0003})):
        drift = {name: Drift(times, **step)} if step else {}
        kind = replace(plaza.radio, biases={n: replace(b, drift=drift.get(n)) for n, b in plaza.radio.biases.items()})
        network = Network([kind.on(node) for node in constant.network.nodes])
        problem = Problem(network, constant.motion, constant.measurements.table)
        fits[name] = probcal.fit(problem, EA())
        evidence[name] = fits[name].attrs["log_evidence_declared"]
    compared = probcal.compare(fits)
    for name in fits:
        found = compared[f"method/{name}"].attrs
        apart = f"{found['elpd_difference']:.1f} ± {found['elpd_difference_se']:.1f}"
        print(f"\nPlaza, {name}: elpd {apart} to the best, evidence {evidence[name] - evidence['constant']:.1f}")
    assert compared["method/constant"].attrs["elpd_difference"] == 0
    assert max(evidence, key=lambda name: evidence[name]) == "constant"


@pytest.mark.slow
def test_fixed_steps_and_steps_before_the_data_count_in_the_values():
    """A step fixed at its true 5 m, one 5 s before the data, one free: each piece has the sum of what began by then."""
    network, motion = watched(Drift((-9.0, -5.0, 4.0, 8.0), scale=3.0))
    truth = {"b.position_x": 1.0, "b.position_x@4": 5.0}
    table = simulate(network, motion, np.arange(12.0), key=0, biases=truth).table
    problem = Problem(network, motion, table, fix={"b.position_x@4": 5.0})
    found = drift_table(probcal.fit(problem, MAP(), prior=Gaussian())).query("bias == 'b.position_x'")
    assert list(found["since"]) == [0.0, 4.0, 8.0]
    assert (np.abs(found["mean"] - [1.0, 6.0, 6.0]) < 6 * found["sd"]).all()
    assert (found["sd"] < 0.6).all()
    steps = Problem(network, motion, table, fix=["b.position_?"])
    found = drift_table(probcal.fit(steps, MAP(), prior=Gaussian()))
    assert set(found["bias"]) == {"b.position_x", "b.position_y"}


@pytest.mark.slow
def test_a_drifting_sensor_is_checked_whole():
    """Noise spoilt after the step is the sensor's, though its first piece is fine; and its node may be written."""
    network, motion = watched()
    table = simulate(network, motion, np.arange(40.0), key=0).table
    late = (table["sensor"] == "b") & (table["time"] > 8)
    table.loc[late, "position_x"] += 2.0 * np.random.default_rng(0).standard_normal(late.sum())
    node = Node("b", (50.0, 10.0), scale={"position": Bias("m", 2.0, drift=Drift((0.0, 8.0), std=1e-4))})
    nodes = [node if s.name == "b" else s.nodes[0] for s in network.sensors]
    problem = Problem(Network([network.types[0].on(n) for n in nodes]), motion, table)
    tree = probcal.assess(problem, probcal.fit(problem, MAP(), prior=Gaussian()))
    check = tree["channel_check"].to_dataset()
    mine = (check["sensor"].values == "b") & (check["channel"].values == "position_x")
    assert check["p_misfit"].values[mine].item() < 0.01
    anchors = probcal.analysis.next_anchors(problem)["anchor"].values
    assert not [name for name in anchors if "@" in str(name)]


@pytest.mark.slow
def test_a_node_stands_still_though_its_sensor_drifts(tmp_path):
    kind = probcal.sensors.flight_time
    wander = replace(kind.biases["range_offset"], drift=Drift((0.0, 4.0), std=1.0))
    kind = replace(kind, biases={"range_offset": wander})
    nodes = [Node(n, place, scale=1.0) for n, place in zip("abcd", [(0, 0), (50, 0), (0, 50), (60, 60)], strict=True)]
    target = Target(ConstantVelocity(0.3), start={"position": (20.0, 5.0), "velocity": (1.0, 1.0)})
    network = Network([kind.on(node) for node in nodes])
    problem = Problem(network, target, simulate(network, target, np.arange(8.0), key=0).table)
    tree = probcal.fit(problem, MAP(), prior=Gaussian())
    assert len(probcal.write_nodes(tmp_path / "n.csv", tree).read_text().splitlines()) == 5
