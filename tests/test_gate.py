"""The gate of a stream: outliers, sensors that change, drifts and other noise, in numbers that were drawn."""

import sys
from functools import cache

import numpy as np
import pandas as pd
import pytest
from scipy import stats
from typer.testing import CliRunner

import probcal as pc
from probcal.cli.commands import app
from probcal.errors import InputError
from probcal.noise import gate_limits, normal_scores
from probcal.stream.checkpoint import pack_state, unpack_state
from probcal.stream.surveillance import Tallies

PLAIN = pc.AugmentedFilter(lag=0)
LAGGED = pc.AugmentedFilter(lag=8)
TRUE = {"g1.range_offset": 1.5}


@pc.sensor(range=pc.Channel("m", std=1.0), azimuth=pc.Channel("rad", std=0.02, wrap=True))
def gauge(target, pose, *, range_offset=pc.Bias("m", 2.0)):
    line = target.position - pose.position
    return dict(range=pc.geometry.norm(line) + range_offset, azimuth=pc.geometry.bearing(line) - pose.heading)


@pc.sensor(east=pc.Channel("m", 1.0), north=pc.Channel("m", 2.0))
def plain(target, pose, *, shift=pc.Bias("m", 2.0), lift=pc.Bias("m", 1.0)):
    """Linear in state and biases."""
    place = target.position - pose.position
    return {"east": place[0] + shift, "north": place[1] + 0.5 * place[0] + lift}


START = {"position": ((0.0, 0.0), 5.0), "velocity": ((1.0, 0.0), 1.0)}
LINE = pc.Target(pc.ConstantVelocity(0.5), START)


def row_of_plain():
    return pc.Network([plain.on(pc.Node(f"n{k}", (10.0 * k, 5.0))) for k in range(3)])


@cache
def rows():
    """Rows of two targets and three linear sensors, some cells blank, in the order of time."""
    run = pc.simulate(row_of_plain(), dict.fromkeys("ab", LINE), np.arange(12.0), key=3, missing=0.3)
    return run.table.dropna(how="all", subset=["east", "north"]).sort_values("time", kind="stable", ignore_index=True)


def filtered(method, frame, chunk=7):
    online = pc.Online(row_of_plain(), LINE, method, targets=3)
    for k in range(0, len(frame), chunk):
        online.update(frame.iloc[k : k + chunk])
    return online


def gauges():
    places = [(0.0, 0.0), (50.0, 10.0), (0.0, 40.0)]
    return pc.Network([gauge.on(pc.Node(f"g{k}", place)) for k, place in enumerate(places)])


@cache
def passes(count=6):
    """Passes of 50 epochs that three gauges see, one after another, by row in time order."""
    found = []
    for k in range(count):
        t = np.linspace(0, 3, 50)
        path = np.stack([np.linspace(5, 40, 50), 12 + 20 * np.sin(t + 0.3 * k)], 1)
        run = pc.simulate(
            gauges(), pc.ConstantVelocity(0.5), np.arange(50.0), key=k, biases=TRUE, tracks={"target": path}
        )
        found.append(run.table.assign(time=run.table["time"] + 50 * k, target=f"pass_{k}"))
    return pd.concat(found).sort_values("time", kind="stable", ignore_index=True)


def streamed(frame, method=LAGGED, chunk=150):
    online = pc.Online(gauges(), pc.ConstantVelocity(0.5), method)
    refused = [online.update(frame.iloc[k : k + chunk]).refused for k in range(0, len(frame), chunk)]
    refused.append(online.finish().refused)
    return online, pd.concat(refused, ignore_index=True)


def off(online, **truth):
    """Errors of the biases in their sds."""
    known = pd.Series(
        dict.fromkeys(online.labels, 0.0) | TRUE | {f"{name}.range_offset": v for name, v in truth.items()}
    )
    biases = online.biases
    return (biases["mean"] - known) / biases["sd"]


@pytest.mark.parametrize("df", [2.0, 4.0])
def test_limits_are_the_quantiles_of_the_noise(df):
    np.testing.assert_allclose(gate_limits(pc.noise.Normal(), 1e-6), stats.norm.ppf([5e-7, 1 - 5e-7]))
    np.testing.assert_allclose(gate_limits(pc.StudentT(df), 1e-6), stats.t.ppf([5e-7, 1 - 5e-7], df), rtol=1e-3)
    e, score = normal_scores(pc.StudentT(df))
    inside = np.abs(e) < 10
    np.testing.assert_allclose(stats.norm.cdf(score[inside]), stats.t.cdf(e[inside], df), atol=1e-5)
    low, high = gate_limits(pc.Mixture(0.1, 10.0, delay=5.0), 1e-4)
    assert high > -low  # echoes are late
    assert gate_limits(pc.Bernoulli(), 1e-6) == gate_limits(pc.noise.Normal(), 0.0) == (-np.inf, np.inf)


@pytest.mark.parametrize(
    "method", [PLAIN, LAGGED, pc.AugmentedFilter("unscented", lag=0), pc.ParticleFilter(300)], ids=str
)
def test_an_outlier_is_a_blank_cell(method):
    frame = rows()
    row = int(np.flatnonzero(frame["east"].notna())[20])
    blank, wrong = frame.copy(), frame.copy()
    blank.loc[row, "east"] = np.nan
    wrong.loc[row, "east"] += 500.0
    online, other = filtered(method, wrong), filtered(method, blank)
    if method.lag:
        online.finish(), other.finish()
    pd.testing.assert_frame_equal(online.biases, other.biases, rtol=1e-9)
    assert online.counts["outliers"] == 1
    assert online.log_evidence == pytest.approx(other.log_evidence)
    with_all = filtered(type(method)(**{**vars(method), "gate": 0.0}), wrong)
    assert with_all.counts["outliers"] == 0


@pytest.mark.ci
def test_an_outlier_is_named_with_its_line():
    frame = passes().copy()
    frame.loc[400, "range"] += 60.0
    online, refused = streamed(frame)
    assert refused["line"].tolist() == [400]
    sensor = frame["sensor"][400]
    assert refused["reason"][0].startswith(f"{sensor}.range of {frame['range'][400]:.6g} lies ")
    assert np.abs(off(online)).max() < 4
    assert not online.alarmed
    clean, none = streamed(passes())
    assert none.empty
    assert clean.message == ""
    assert clean.status == "converged"


@pytest.mark.ci
@pytest.mark.parametrize("method", [LAGGED, PLAIN], ids=str)
def test_a_sensor_that_jumps_begins_anew(method):
    frame = passes().copy()
    late = (frame["sensor"] == "g1") & (frame["time"] >= 170)
    frame.loc[late, "range"] += 15.0
    online, _ = streamed(frame, method)
    [event] = [own for own in online.check.events if own.kind == "changed"]
    assert (event.kind, event.sensor) == ("changed", "g1")
    assert 170 <= event.since < 175
    assert np.abs(off(online, g1=16.5)).max() < 4
    assert online.alarmed
    assert "g1.range_offset jumped at 17" in online.message
    assert "--jumps 0.1, where jumps are to be expected" in online.message


def test_a_large_jump_is_found_as_one_where_jumps_are_looked_for():
    frame = passes().copy()
    late = (frame["sensor"] == "g1") & (frame["time"] >= 170)
    frame.loc[late, "range"] += 15.0
    frame.loc[[100, 500], "range"] += 80.0  # outliers, which are no jumps
    online, refused = streamed(frame, pc.AugmentedFilter(lag=8, jumps=pc.Jumps()))
    [jump] = online.jumps
    assert jump.label == "g1.range_offset"
    assert abs(jump.since - 170) <= 1
    assert jump.size == pytest.approx(15.0, abs=1.5 * jump.sd)
    assert refused["line"].tolist() == [100, 500]
    assert np.abs(off(online, g1=16.5)).max() < 4
    assert not online.alarmed


EXCHANGED = {"g0": "g1", "g1": "g0"}
MISTAKES = {
    "exchanged": (lambda f: f.assign(sensor=f["sensor"].replace(EXCHANGED)), "The rows of g0 and g1 look exchanged"),
    "exchanged from 175 s on": (
        lambda f: f.assign(sensor=f["sensor"].where(f["time"] < 175, f["sensor"].replace(EXCHANGED))),
        "The rows of g0 and g1 look exchanged: exchange their names",
    ),
    "millimetres": (lambda f: f.assign(range=f["range"] * 1e3), "of all gauge sensors look like mm and not m"),
    "compass": (lambda f: f.assign(azimuth=np.pi / 2 - f["azimuth"]), "look like compass bearings: declare Channel("),
    "reversed": (
        lambda f: f.assign(azimuth=f["azimuth"].where(f["sensor"] != "g2", -f["azimuth"])),
        "Values of azimuth of g2 look reversed: change their sign",
    ),
}


@pytest.mark.ci
@pytest.mark.parametrize(
    "name",
    [
        name if name in ("millimetres", "exchanged from 175 s on") else pytest.param(name, marks=pytest.mark.ci)
        for name in MISTAKES
    ],
)
def test_a_mistake_is_no_answer_and_is_named(name):
    change, said = MISTAKES[name]
    online, _ = streamed(change(passes()))
    assert online.status == "misfit"
    assert online.alarmed
    assert online.message.startswith("The model does not explain g") or "does not explain g" in online.message
    tree = online.tree()
    assert tree.attrs["status"] == "misfit"
    assert said in tree.attrs["message"]
    with pytest.raises(InputError, match="misfit"):
        pc.track(pc.Problem(gauges(), pc.ConstantVelocity(0.5), passes()[:150]), tree)


@pytest.mark.ci
def test_a_ramp_and_more_noise_are_told():
    frame = passes(12).copy()
    mine = frame["sensor"] == "g1"
    ramp = frame["range"] + np.where(mine, 0.02 * np.maximum(frame["time"] - 150, 0.0), 0.0)
    online, _ = streamed(frame.assign(range=ramp))
    assert {(e.kind, e.sensor, e.channel) for e in online.check.events} >= {("drifts", "g1", "range")}
    assert "a bias of g1 drifts or has jumped; take AugmentedFilter(walk=...), --walk." in online.message
    rng = np.random.default_rng(0)
    noisy = frame["range"] + np.where(mine, rng.normal(size=len(frame)), 0.0)
    online, _ = streamed(frame.assign(range=noisy))
    assert "The innovations of g1.range scatter as if its variance were" in online.message
    names = [f"{owner}.{name}" for owner, name in zip(online.check.owners, online.check.names, strict=True)]
    assert online.check.wide[names.index("g1.range")] == pytest.approx(2.0, rel=0.35)
    plain = streamed(frame)[0].biases["sd"]
    assert online.biases["sd"]["g1.range_offset"] > 1.2 * plain["g1.range_offset"]
    tree = online.tree()["calibration"].to_dataset()
    np.testing.assert_allclose(tree["sd"].values, online.biases["sd"], rtol=1e-6)
    assert online.tree().attrs["widened"] > 1.2


def test_sums_show_variance_and_memory_and_stay_silent_without():
    rng = np.random.default_rng(1)
    white = rng.standard_normal(20_000)
    red = np.empty_like(white)
    red[0] = white[0]
    for k in range(1, len(white)):
        red[k] = 0.6 * red[k - 1] + 0.8 * white[k]
    for values, expected in ((white, 1.0), (1.5 * white, 2.25), (red, 4.0)):
        sums = Tallies.none(10)
        assert sums.add(3, values[:7777], np.zeros(7777, bool)) is None
        assert sums.add(3, values[7777:], np.zeros(len(values) - 7777, bool)) is None
        assert sums.wide[3] == pytest.approx(expected, rel=0.25)
        assert (sums.wide[[0, 9]] == 1.0).all()
    found = Tallies.none(10).add(0, white + 0.5, np.zeros(len(white), bool))
    assert found is not None
    assert found[1] == pytest.approx(0.5, abs=0.05)


@pytest.mark.slow
def test_a_sound_stream_is_called_drifting_or_widened_once_in_a_thousand():
    rng, sums = np.random.default_rng(2), Tallies.none(1000)
    drifts = sum(sums.add(k, rng.standard_normal(3000), np.zeros(3000, bool)) is not None for k in range(1000))
    assert drifts + (sums.wide > 1).sum() <= 1  # all channels share the rate


def test_what_was_seen_goes_on_after_a_kill():
    frame = passes().copy()
    late = (frame["sensor"] == "g1") & (frame["time"] >= 120)
    frame.loc[late, "range"] += 15.0
    whole, _ = streamed(frame[:600])
    online = pc.Online(gauges(), pc.ConstantVelocity(0.5), LAGGED)
    for k in range(0, 450, 150):
        online.update(frame.iloc[k : k + 150])
    again = pc.Online(gauges(), pc.ConstantVelocity(0.5), LAGGED)
    unpack_state(again, pack_state(online, {}), "state")
    again.update(frame.iloc[450:600])
    again.finish()
    pd.testing.assert_frame_equal(again.biases, whole.biases, rtol=1e-9)
    assert again.check.events == whole.check.events
    assert again.message == whole.message
    np.testing.assert_array_equal(again.check.tallies.held, whole.check.tallies.held)


def test_a_gate_that_is_no_small_probability_is_refused():
    for wrong in (0.5, -1e-6, "x"):
        with pytest.raises(InputError, match=r"give the probability of a datum to be left out, 0 to 0\.01"):
            pc.AugmentedFilter(gate=wrong)
        with pytest.raises(InputError, match=r"ParticleFilter\(gate="):
            pc.ParticleFilter(gate=wrong)


MODEL = """
import sys
sys.path.insert(0, {tests!r})
from test_gate import gauges
from probcal import ConstantVelocity, Problem

def problem(data=None):
    return Problem(gauges(), ConstantVelocity(0.5), data)
"""


@pytest.mark.slow
def test_a_watch_ends_with_its_status(tmp_path):
    model = tmp_path / "model.py"
    model.write_text(MODEL.format(tests=str(next(p for p in sys.path if p.endswith("tests")))))
    for name, change, code in (("sound", lambda f: f, 0), ("exchanged", MISTAKES["exchanged"][0], 1)):
        change(passes()).to_csv(tmp_path / f"{name}.csv", index=False)
        ended = CliRunner().invoke(
            app, ["watch", str(model), str(tmp_path / f"{name}.csv"), "--out", str(tmp_path / name)]
        )
        assert ended.exit_code == code, ended.output
        assert ("misfit" in ended.output) is bool(code)
        assert pc.load(tmp_path / name).attrs["status"] == ("misfit" if code else "converged")
    refused = pd.read_csv(tmp_path / "exchanged" / "refused.csv")
    assert refused["reason"].str.contains("sd from its prediction: left out").all()
    again = CliRunner().invoke(app, ["watch", str(model), str(tmp_path / "exchanged.csv")])
    assert "conflicting" in again.output
