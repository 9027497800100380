"""Noise levels that the data ask for, biases that hang on them or on others that change, and outliers."""

import sys
from copy import deepcopy
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats

import probcal
from probcal import MAP, Bias, Channel, ConstantVelocity, Network, Node, Problem, Target, simulate
from probcal.analysis import levels, pieces
from probcal.analysis.assess import assess
from probcal.gaussian.engine import noise_score
from probcal.inference.fit import calibrate
from probcal.inference.fitted import take_up
from probcal.noise import Unknown
from probcal.sensor import Drift
from probcal.types import float64

sys.path.insert(0, str(Path(__file__).parents[1] / "models"))
import plaza

TIME = np.arange(0.0, 40.0, 0.5)
START = {"position": ((0.0, 0.0), 5.0), "velocity": ((1.0, 0.5), 1.0)}
PLACES = {"a": (0.0, 0.0), "b": (10.0, 5.0), "c": (-5.0, 8.0)}
take_up = float64(take_up)
members_of, ask, score = (float64(one) for one in (levels.members_of, levels.ask, noise_score))
TRUE = {"a.shift": 1.0, "a.tilt": 0.0, "b.shift": -0.5, "b.tilt": 0.4, "c.shift": 0.0, "c.tilt": 0.0}


def fixer(place, rate, drift=None):
    """A linear sensor: a place per axis, shifted, and a slower one, tilted."""

    @probcal.sensor(place=Channel("m", std=place, per_axis=True), rate=Channel("m/s", std=rate))
    def fixer(target, pose, *, shift=Bias("m", 1.0, drift=drift), tilt=Bias("m/s", 1.0)):
        line = target.position - pose.position
        return {"place": line + shift, "rate": target.velocity[0] + 0.3 * target.velocity[1] + tilt}

    return fixer


def world(place=0.5, rate=0.2, motion=0.4, *, table=None, drift=None, key=0):
    """Three fixers and two targets with rows missing here and there; drawn at these levels unless there is a table."""
    kind = fixer(place, rate, drift)
    network = Network([kind.on(Node(name, where), name=name) for name, where in PLACES.items()])
    targets = {name: Target(ConstantVelocity(motion), START) for name in ("t", "u")}
    if table is None:
        table = simulate(network, targets, TIME, key=key, biases=TRUE).table
        table = table[(table["target"] == "t") | (table["time"] < 30.0)].reset_index(drop=True)
        table.loc[table.index % 7 == 3, "rate"] = np.nan
        table = table[table.index % 11 != 5]
    return Problem(network, targets, table), table


def learnt(fit):
    levels = fit.problem.levels
    return {own.label: own.guess * float(np.exp(log)) for own, log in zip(levels, fit.point.levels, strict=True)}


def evidence(**stds):
    problem, _ = world(table=world()[1], **stds)
    return float(probcal.fit(problem, MAP(trajectory="joint")).attrs["log_evidence"])


@pytest.mark.slow
def test_slope_and_curvature_are_those_of_the_evidence():
    problem, _ = world()
    fit = take_up(problem, probcal.fit(problem, MAP(trajectory="joint")))
    problem, members = fit.problem, members_of(fit.problem)
    assert [level.label for level in members.levels] == ["fixer.place_std", "fixer.rate_std", "motion.velocity_std"]
    assert [(index == 0).sum() for index in members.rows] == [2 * problem.measurements.measured[:, 0].sum()]
    found = members.sums(*score(fit.expansion, fit.factors))
    asked = ask(fit, members, fit.factors)
    step, names = 0.005, {"place": 0.5, "rate": 0.2, "motion": 0.4}
    middle = evidence()
    sides = {
        name: [evidence(**{name: value * np.exp(side * step)}) for side in (1, -1)] for name, value in names.items()
    }
    slope = [(up - down) / (2 * step) for up, down in sides.values()]
    np.testing.assert_allclose(found, slope, atol=0.05)
    curvature = [-(up + down - 2 * middle) / step**2 for up, down in sides.values()]
    precision = np.diag(np.linalg.inv(np.diag(asked.sd) @ np.diag(asked.sd)))
    np.testing.assert_allclose(precision, curvature, rtol=0.06)


@pytest.mark.parametrize(
    ("name", "times"),
    [
        pytest.param("place", 2.0, marks=pytest.mark.slow),
        pytest.param("place", 0.4, marks=pytest.mark.ci),
        pytest.param("rate", 4.0, marks=pytest.mark.slow),
        pytest.param("motion", 1.6, marks=pytest.mark.ci),
    ],
)
def test_a_level_that_is_declared_wrong_is_named_with_what_the_data_ask_for(name, times):
    right = {"place": 0.5, "rate": 0.2, "motion": 0.4}
    problem, _ = world(table=world()[1], **{name: right[name] / times})
    tree = assess(problem, probcal.fit(problem, MAP()))
    label = "motion.velocity_std" if name == "motion" else f"fixer.{name}_std"
    check = tree["level_check"].to_dataset()
    assert check["factor"].sel(level=label).item() == pytest.approx(times, rel=0.15)
    said = tree["finding"].to_dataset()
    (sentence,) = said["sentence"].values[(said["kind"].values == "level") & (said["subject"].values == label)]
    assert f"declare Unknown({right[name] / times:g})" in sentence
    others = check.drop_sel(level=label)
    assert (others["square"] < check["square"].sel(level=label)).all()


@pytest.mark.slow
def test_levels_in_the_table_and_unknown_ones_have_their_place():
    _, table = world()
    table = table.assign(rate_std=0.2)
    kind = fixer(Unknown(0.4), 0.3)
    network = Network([kind.on(Node(name, where), name=name) for name, where in PLACES.items()])
    problem = Problem(network, {n: Target(ConstantVelocity(s), START) for n, s in (("t", 0.4), ("u", 0.41))}, table)
    members = members_of(problem)
    assert [(level.label, level.declared, level.unknown) for level in members.levels] == [
        ("fixer.rate_std", None, -1), ("fixer.place_std", 0.4, 0),
        ("motion.velocity_std", 0.4, -1), ("motion.velocity_std", 0.41, -1),
    ]  # fmt: skip
    tree = assess(problem, probcal.fit(problem, MAP()))
    check = tree["level_check"].to_dataset()
    assert check["level"].values.tolist()[2:] == ["motion.velocity_std", "motion.velocity_std#2"]
    assert abs(np.log(check["factor"].sel(level="fixer.place_std").item())) < 0.02  # it was learnt
    assert "level" not in tree["finding"]["kind"].values


@pytest.mark.slow
def test_what_is_asked_of_all_levels_is_where_a_fit_of_all_ends():
    """One level is unknown with a prior that two wrong ones pull it from; then all three are."""
    _, table = world()
    told = world(place=Unknown(0.5, 1.05), rate=0.1, motion=0.02, table=table)[0]
    fit = take_up(told, probcal.fit(told, MAP()))
    members = members_of(fit.problem)
    asked = ask(fit, members, fit.factors)
    found = {level.label: level.declared for level in members.levels} | learnt(fit)
    free = world(place=Unknown(0.5, 1.05), rate=Unknown(0.1), motion=Unknown(0.02), table=table)[0]
    wanted = learnt(take_up(free, probcal.fit(free, MAP())))
    ends = {name: found[name] * factor for name, factor in zip(found, np.exp(asked.step), strict=True)}
    assert ends == pytest.approx(wanted, rel=0.03)


@pytest.mark.slow
def test_levels_that_are_right_are_left_alone():
    """Chi-squares of 30 recordings over three levels: their mean within 3 standard errors of one."""
    squares = []
    for key in range(30):
        problem, _ = world(key=key)
        tree, _ = calibrate(problem, MAP())
        checked = assess(problem, tree)
        squares += checked["level_check"]["square"].values.tolist()
        assert "level" not in checked["finding"]["kind"].values
    assert abs(np.mean(squares) - 1.0) < 3 * np.sqrt(2 / len(squares))
    assert stats.kstest(squares, stats.chi2(1).cdf).pvalue > 1e-3


@pytest.mark.slow
def test_a_network_whose_size_the_declared_motion_sets_hangs_on_it():
    network = plaza.network(scale=1.0)
    problem = Problem(network, ConstantVelocity(1.0), plaza.HERE / "plaza_ranges.csv")
    tree = assess(problem, probcal.fit(problem))
    sentences = " ".join(tree["finding"]["sentence"].values.tolist())
    assert "motion.velocity_std: the data ask for 0.83" in sentences
    verdict = tree["verdict"].to_dataset().sel(bias_label="beacon_1.range_scale")
    assert verdict["verdict"] == "weak"
    assert "with the motion.velocity_std that the data ask for" in verdict["reason"].item()


def jumped(by, axes="xy"):
    """A recording in which the shift of `b` jumps in the middle."""
    _, table = world()
    late = (table["sensor"] == "b") & (table["time"] >= 20.0)
    for axis in axes:
        table.loc[late, f"place_{axis}"] += by
    return table


@pytest.mark.ci
def test_what_moves_where_others_may_change_is_that_of_a_fit_where_they_do():
    table = jumped(3.0)
    problem, _ = world(table=table)
    fit = take_up(problem, probcal.fit(problem, MAP(trajectory="joint")))
    late = (problem.measurements.time >= 20.0).astype(float)
    divided = float64(pieces.divide)(fit, late[:, None])
    m = problem.labels.index("b.shift")
    moved = pieces.freed(divided, [(m, np.array([[0.0], [1.0]]))]) * problem.scales
    free = deepcopy(divided)
    prior = np.eye(len(problem.labels))
    prior[m, m] = 0.0
    M = len(prior)
    to = np.eye(2 * M)[:, [*range(M), M + m]]
    here = np.asarray(fit.point.z)
    K, z = to.T @ free.information @ to, np.r_[here, 0.0]
    K[:M, :M] += prior
    right = to.T @ (free.score + free.information @ np.r_[here, np.zeros(M)])
    np.testing.assert_allclose(moved, (np.linalg.solve(K, right) - z)[:M] * problem.scales, atol=1e-6)
    stepped, _ = world(table=table, drift=Drift([0.0, 20.0], scale=100.0))
    tree = probcal.fit(stepped, MAP(trajectory="joint"))
    mean = tree["calibration"]["mean"].to_series()
    for label in ("a.tilt", "c.tilt"):
        k = problem.labels.index(label)
        assert here[k] * problem.scales[k] + moved[k] == pytest.approx(mean[label], abs=0.02)


@pytest.mark.ci
def test_a_bias_beside_one_that_jumps_is_weak_where_it_would_move():
    problem, _ = world(table=jumped(8.0))
    tree = assess(problem, probcal.fit(problem, MAP()))
    verdict = tree["verdict"].to_dataset()
    assert verdict["verdict"].sel(bias_label="b.shift") == "drifting"
    reason = verdict["reason"].sel(bias_label="a.shift").item()
    assert verdict["verdict"].sel(bias_label="a.shift") == "weak", reason
    assert "sd if b.shift may change" in reason
    assert tree["finding"]["kind"].values[0] == "drifting"  # the cause comes first


@pytest.mark.ci
def test_single_data_far_off_are_called_outliers_and_a_jump_is_not():
    _, table = world()
    rng, gross = np.random.default_rng(0), table.copy()
    hit = rng.random(len(gross)) < 0.05
    gross.loc[hit, "place_x"] += rng.choice([-20.0, 20.0], hit.sum())
    problem, _ = world(table=gross)
    tree = assess(problem, probcal.fit(problem, MAP()))
    said = tree["finding"].to_dataset()
    kinds = said["kind"].values.tolist()
    assert kinds[0] == "outliers"
    assert "level" not in kinds  # which they raise
    (sentence,) = said["sentence"].values[said["kind"].values == "outliers"]
    assert sentence.startswith("single data lie more than 4 std off: ")
    assert "place_x" in sentence
    assert "noise=StudentT(4)" in sentence
    burst = table.copy()
    burst.loc[(burst["sensor"] == "b") & burst["time"].between(20.0, 24.0), "place_x"] += 6.0
    for spoiled in (jumped(8.0, "x"), burst):
        problem, _ = world(table=spoiled)
        tree = assess(problem, probcal.fit(problem, MAP()))
        assert "outliers" not in tree["finding"]["kind"].values
    assert isinstance(tree["level_check"].to_dataset().to_dataframe(), pd.DataFrame)


@pytest.mark.ci
def test_of_a_motion_that_was_left_out_nothing_is_asked():
    problem, _ = world()
    tree = assess(problem, probcal.fit(problem, probcal.LeastSquares()))
    check = tree["level_check"].to_dataset() if "level_check" in tree.children else {"level": np.zeros(0, str)}
    assert not [name for name in np.asarray(check["level"]).tolist() if name.startswith("motion")]


def test_a_level_that_is_far_off_may_be_another_fault():
    level = levels.Level("radar.range_std", 0.5)
    assert levels._sentence(level, 1.2, 0.1).endswith("1.20 ± 0.10 times the declared 0.5: declare Unknown(0.5)")
    far = "far more than the declared 0.5: declare Unknown(0.5), unless a unit, a sensor or the motion is wrong"
    assert levels._sentence(level, 5.0, 0.1).endswith(far)
