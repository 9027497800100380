"""Detections that name no target: scans, association against enumeration, tracks, and biases found with them."""

from functools import cache
from itertools import permutations

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

import probcal as pc
from probcal.errors import FitError, InputError
from probcal.geometry import bearing, norm
from probcal.tracking.bernoulli import associate
from probcal.tracking.gospa import gospa
from probcal.tracking.rates import by_beta, by_gamma, of_calibration

REPORT = pc.Detection(0.9, clutter=3.0, view=pc.Sector(range=3000.0))
TIME = np.arange(40.0)
TRUE = {"east.position_x": 20.0, "east.position_y": -35.0, "east.heading": 0.04}
START = {"position": ((300.0, 300.0), 1500.0), "velocity": ((0.0, 0.0), 12.0)}


@pc.sensor(range=pc.Channel("m", std=5.0), azimuth=pc.Channel("rad", std=0.01, wrap=True))
def radar(target, pose):
    """Range and azimuth in the node's own axes."""
    line = pose.local(target.position)
    return dict(range=norm(line), azimuth=bearing(line))


def network(detection=REPORT):
    nodes = [pc.Node("west", (0.0, 0.0)), pc.Node("east", (1000.0, 0.0), scale={"position": 30.0, "heading": 0.05})]
    return pc.Network([radar.on(node, detection=detection) for node in nodes])


def paths(objects, seed=0):
    rng = np.random.default_rng(seed)
    return {f"t{k}": rng.uniform(-800, 1500, 2) + np.outer(TIME, rng.uniform(-15, 15, 2)) for k in range(objects)}


@cache
def drawn(objects=4, seed=1, named=False):
    """A recording of two radars, detections without names unless asked for."""
    tracks = paths(objects, seed)
    motion = {name: pc.ConstantVelocity(0.5) for name in tracks}
    return pc.simulate(network(None if named else REPORT), motion, TIME, tracks=tracks, biases=TRUE, key=seed)


def problem(table, detection=REPORT):
    return pc.Problem(network(detection), pc.Target(pc.ConstantVelocity(0.5), START), table)


# declaration


def test_scans_are_what_a_sensor_reports_at_one_time():
    table = pd.DataFrame(
        {"time": [0.0, 0.0, 0.0, 1.0, 1.0], "sensor": ["west", "west", "east", "west", "east"],
         "range": [10.0, 20.0, 30.0, None, 40.0], "azimuth": [0.0, 0.1, 0.2, None, 0.3]}
    )  # fmt: skip
    scans = problem(table).scans
    assert scans.time.tolist() == [0.0, 0.0, 1.0, 1.0]
    assert scans.sensor.tolist() == [0, 1, 0, 1]
    assert scans.count.tolist() == [2, 1, 0, 1], "a blank row is a scan in which nothing was detected"
    assert problem(table.assign(target="a").drop(index=1)).scans is None


@pytest.mark.ci
def test_what_is_simulated_has_the_rates_that_were_declared():
    table = drawn().table
    scans = problem(table).scans
    seen = [
        sum(np.hypot(*(path[k] - node)) < 3000.0 for path in paths(4, 1).values())
        for k in range(len(TIME)) for node in ((0.0, 0.0), (1000.0, 0.0))
    ]  # fmt: skip
    expected = 0.9 * np.array(seen) + 3.0
    sd = np.sqrt(np.sum(0.09 * np.array(seen) + 3.0))
    assert abs(scans.count.sum() - expected.sum()) < 4 * sd
    assert "target" not in table
    tracks = paths(4)
    motion = dict.fromkeys(tracks, pc.ConstantVelocity(0.5))
    sharp = pc.simulate(network(pc.Detection(0.7, clutter=0.0)), motion, TIME, tracks=tracks, key=1).table
    looked = 2 * len(tracks) * len(TIME)
    assert abs(sharp["range"].notna().sum() - 0.7 * looked) < 4 * np.sqrt(0.21 * looked), "no clutter hides the misses"


def test_rows_with_the_names_put_to_them_are_the_labelled_problem():
    named = drawn(named=True).table
    named = named.sort_values("time", kind="stable", ignore_index=True)
    truth = named["target"].to_numpy()
    free = problem(named.drop(columns="target"))
    tracks = pd.DataFrame({"row": np.arange(len(named)), "track": truth, "weight": 1.0})
    assigned, labelled = free.assigned(tracks), problem(named)
    assert assigned.measurements.target_names == labelled.measurements.target_names
    for mine, known in zip(assigned.model.rows, labelled.model.rows, strict=True):
        for leaf, other in zip(mine, known, strict=True):
            np.testing.assert_array_equal(leaf, other)
    half = free.assigned(tracks.assign(weight=0.5))
    np.testing.assert_allclose(half.model.rows[0].mask, 0.5 * np.asarray(labelled.model.rows[0].mask))


@pytest.mark.parametrize(
    ("act", "said"),
    [
        (lambda: pc.Detection(1.5), "lies above 0, up to 1"),
        (lambda: pc.Detection(0.9, clutter=-1.0), "a mean number of false detections a scan, 0 or more"),
        (lambda: pc.Detection(0.9, view=3.0), "view is a function of target and pose"),
        (lambda: pc.Detection(0.9, limits={"range": 3.0}), "limits are low and high by channel"),
        (lambda: pc.Detection(0.9, limits={"range": (3.0, 1.0)}), "low lies below high"),
        (lambda: pc.Sector(range=0.0), "range is positive in m"),
        (lambda: network(pc.Detection(0.9, limits={"rang": (0.0, 1.0)})), 'detection limits "rang"'),
        (lambda: network(0.9), "give Detection(probability, clutter)"),
        (lambda: pc.fit(problem(drawn().table)), "take SelfConfiguration(EA())"),
        (lambda: pc.track_objects(problem(drawn(named=True).table)),
         "every row names its target; use fit, or track with a calibration"),
        (lambda: problem(drawn(named=True).table).assigned([]), "every row names its target already"),
        (lambda: problem(drawn().table).assigned({"row": [0]}), 'assigned: the tracks have no column "track"'),
        (lambda: problem(drawn().table).assigned({"row": [9999], "track": ["a"]}), "row counts the rows"),
        (lambda: problem(drawn().table).assigned({"row": [0, 0], "track": ["a", "b"]}), "add up to 1 at most"),
        (lambda: pc.track_objects(problem(drawn().table), births=0.0), "track_objects(births=0.0)"),
        (lambda: pc.track_objects(problem(drawn().table), most=0), "most is a number of tracks"),
        (lambda: pc.track_objects(problem(drawn().table), z=[0.0]), "z has shape (1,)"),
        (lambda: pc.SelfConfiguration("ea"), "give the method that fits labelled rows"),
        (lambda: pc.SelfConfiguration(pc.EA(), iterations=0), "take 1 or more"),
        (lambda: pc.SelfConfiguration(pc.EA(), start="here"), "start is stated or beliefs, window seconds above 0"),
        (lambda: pc.track_objects(problem(drawn().table), sensors=["north"]), 'track_objects: sensors names "north"'),
        (lambda: problem(drawn().table.assign(weight=2.0)), 'column "weight": 2 does not lie between 0 and 1'),
        (lambda: problem(drawn().table.assign(target=["object", *[None] * (len(drawn().table) - 1)])),
         '"object" stands for the detections'),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said(act, said):
    with pytest.raises(InputError) as caught:
        act()
    assert said in str(caught.value)


def test_a_blank_name_is_refused_where_nothing_is_detected():
    named = drawn(named=True).table.copy()
    named.loc[0, "target"] = None
    with pytest.raises(InputError, match="place the sensor with detection"):
        problem(named, None)


def test_clutter_without_limits_asks_for_them():
    @pc.sensor(level=pc.Channel("dB", std=1.0))
    def ear(target, pose):
        return dict(level=-norm(target.position - pose.position))

    own = pc.Network([ear.on(pc.Node("a", (0.0, 0.0), scale=1.0), detection=pc.Detection(0.9))])
    with pytest.raises(InputError, match="nothing tells where"):
        pc.simulate(own, pc.Static(), [0.0, 1.0], key=0)
    table = pd.DataFrame({"time": [0.0, 1.0], "sensor": "a", "level": [-3.0, -3.0]})
    with pytest.raises(InputError, match="do not tell where false detections"):
        pc.track_objects(pc.Problem(own, pc.Target(pc.Static(), {"position": ((0.0, 0.0), 9.0)}), table))


# association


def enumerated(ratio):
    """Marginals of every pair by the sum over all associations."""
    T, D = ratio.shape
    pairs, none, total = np.zeros((T, D)), np.zeros(D), 0.0
    for choice in set(permutations([*range(D), *[-1] * T], T)):
        weight = np.prod([ratio[t, d] for t, d in enumerate(choice) if d >= 0])
        total += weight
        for t, d in enumerate(choice):
            if d >= 0:
                pairs[t, d] += weight
        none += weight * ~np.isin(np.arange(D), choice)
    return pairs / total, none / total


@pytest.mark.parametrize("shape", [(1, 4), (4, 1), (3, 3), (2, 4)])
def test_marginals_are_near_those_of_all_associations(shape):
    """Exact where the graph is a tree; else the Bethe approximation, within 0.12 where ratios compete."""
    rng = np.random.default_rng(sum(shape))
    with jax.enable_x64(True):
        for _ in range(20):
            ratio = np.exp(rng.normal(0.0, 2.0, shape))
            pairs, none = jax.jit(associate)(jnp.asarray(ratio))
            exact = enumerated(ratio)
            atol = 1e-9 if 1 in shape else 0.12
            np.testing.assert_allclose(pairs, exact[0], atol=atol)
            np.testing.assert_allclose(none, exact[1], atol=atol)


def test_likelihoods_of_any_size_leave_no_difference_of_large_numbers():
    with jax.enable_x64(True):
        pairs, none = jax.jit(associate)(jnp.asarray([[1e25, 1e-3], [1e-3, 1e20]]))
    np.testing.assert_allclose(pairs, np.eye(2), atol=1e-9)
    np.testing.assert_allclose(none, 0.0, atol=1e-9)


def test_every_object_has_one_track_and_keeps_its_detections():
    """Biases known: as many tracks as objects, near the true paths, and their rows hold what was detected."""
    known = problem(drawn().table)
    z = np.array([TRUE[label] for label in known.labels]) / known.scales
    found = pc.track_objects(known, z)
    assert len(found.names) == 4
    last = found.path[found.path["time"] == TIME[-1]].groupby("track")[["position_x", "position_y"]].last().to_numpy()
    apart = [np.hypot(*(last - path[-1]).T).min() for path in paths(4, 1).values()]
    assert max(apart) < 15.0
    share = found.rows["weight"].sum() / (0.9 * 2 * 4 * len(TIME))
    assert 0.9 < share < 1.1
    assert found.rows.groupby("row")["weight"].sum().max() <= 1 + 1e-9


@pytest.mark.slow
def test_a_sensor_that_sees_nothing_in_common_is_named():
    """One radar in clutter: nothing places it, its bias stays as stated, and the fit says that it is not found."""
    table = drawn().table
    rng = np.random.default_rng(0)
    blind = table["sensor"] == "east"
    table = table.assign(
        range=table["range"].mask(blind, rng.uniform(0.0, 3000.0, len(table))),
        azimuth=table["azimuth"].mask(blind, rng.uniform(-3.0, 3.0, len(table))),
    )
    found = pc.propagate_beliefs(problem(table))
    assert found.apart == ("east",)
    assert not found.z.any()
    np.testing.assert_array_equal(found.covariance, np.eye(3))
    tree = pc.fit(problem(table), pc.SelfConfiguration(pc.MAP(), start="beliefs"), prior=pc.Gaussian())
    assert tree.attrs["status"] == "not converged"
    assert "The objects of east do not tell how they stand" in tree.attrs["message"]


def test_clutter_alone_confirms_nothing():
    rng = np.random.default_rng(3)
    rows = [
        dict(time=t, sensor=s, range=rng.uniform(0, 3000.0), azimuth=rng.uniform(-np.pi, np.pi))
        for t in TIME for s in ("west", "east") for _ in range(3)
    ]  # fmt: skip
    alone = problem(pd.DataFrame(rows))
    assert pc.track_objects(alone).names == []
    with pytest.raises(FitError, match="no object is confirmed"):
        pc.fit(alone, pc.SelfConfiguration(pc.EA()))


def test_a_row_with_a_name_is_not_assigned_again():
    table = drawn(named=True).table.copy()
    table.loc[1:, "target"] = None
    mixed = pc.Problem(network(), {"t0": pc.ConstantVelocity(0.5), "object": pc.ConstantVelocity(0.5)}, table)
    with pytest.raises(InputError, match="names its target; only detections are assigned"):
        mixed.assigned({"row": [0], "track": ["a"]})
    both = mixed.assigned({"row": [5, 6], "track": ["a", "a"]})
    assert set(both.measurements.target_names) == {"t0", "a"}


@pytest.mark.ci
@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow), pytest.param(3, marks=pytest.mark.slow)])
def test_biases_are_found_with_the_objects(seed):
    """Two radars that share no names: each bias within 4 sds of the truth, no wider than twice the labelled fit."""
    own = problem(drawn(seed=seed).table)
    tree = pc.fit(own, pc.SelfConfiguration(pc.MAP()), prior=pc.Gaussian())
    assert tree.attrs["status"] == "converged"
    assert tree.attrs["objects"] == 4
    known = pc.fit(problem(drawn(seed=seed, named=True).table), pc.MAP(), prior=pc.Gaussian())
    for label, value in TRUE.items():
        mean, sd = (float(tree["calibration"][k].sel(bias_label=label)) for k in ("mean", "sd"))
        assert abs(mean - value) < 4 * sd, label
        assert sd < 2 * float(known["calibration"]["sd"].sel(bias_label=label))
    rng = np.random.default_rng(0)
    empty = pd.DataFrame({"time": TIME, "sensor": ["west", "east"] * 20, "range": 2999.0 * rng.uniform(size=40)})
    with pytest.raises(FitError, match="scans: nothing stands out from clutter"):
        pc.track(problem(empty.assign(azimuth=rng.uniform(-3.0, 3.0, 40))), tree)
    later = pc.track(own, tree)
    assert len(later["track"].children) == 4


# rates


def test_rates_by_counts_beside_their_prior():
    """Nothing counted: the guess; much counted: the share; the spread of the prior is that of its factor."""
    prior = pc.Unknown(2.0, factor=1.2)
    mean, sd = by_gamma(prior, 0.0, 0)
    assert (mean, sd / mean) == pytest.approx((2.0, np.log(1.2)))
    assert by_gamma(prior, 5e6, 1_000_000)[0] == pytest.approx(5.0, rel=1e-4)
    odds = pc.Unknown(0.9, factor=1.2)
    mean, sd = by_beta(odds, 0.0, 0.0)
    assert mean == pytest.approx(0.9)
    assert sd / (0.9 * 0.1) == pytest.approx(np.log(1.2), rel=0.2)
    assert by_beta(odds, 700.0, 300.0)[0] == pytest.approx(0.7, abs=0.1)
    with pytest.raises(InputError, match="it lies above 0, up to 1"):
        pc.Detection(pc.Unknown(1.0))


@pytest.mark.slow
def test_rates_that_are_unknown_are_found():
    """Clutter 3 and a probability of 0.9, guessed 1 and 0.6: found within four sds, and taken to other data."""
    unknown = pc.Detection(pc.Unknown(0.6), clutter=pc.Unknown(1.0), view=pc.Sector(range=3000.0))
    tree = pc.fit(problem(drawn().table, unknown), pc.SelfConfiguration(pc.MAP()), prior=pc.Gaussian())
    assert tree.attrs["objects"] == 4
    table = tree["rate"].to_dataset().to_dataframe()
    assert len(table) == 4
    for _, row in table.iterrows():
        assert abs(row["mean"] - {"clutter": 3.0, "probability": 0.9}[row["rate"]]) < 4 * row["sd"], row
    later = of_calibration(problem(drawn(seed=2).table, unknown), tree)
    assert [s.detection.rate for s in later.network.sensors] == table[table["rate"] == "clutter"]["mean"].tolist()
    assert of_calibration(problem(drawn().table), tree).network.sensors[0].detection == REPORT


# distances between sets


def test_gospa_counts_what_is_missed_and_what_is_false():
    here, there = [(0.0, 0.0), (100.0, 0.0)], [(3.0, 4.0)]
    one = gospa([here], [there], cut=20.0)
    assert one.distance == pytest.approx(np.sqrt(25.0 + 200.0))
    assert (one.place, one.missed, one.false) == (5.0, 0.0, 1.0)
    assert one.ospa == pytest.approx(np.sqrt((25.0 + 400.0) / 2))
    swapped = gospa([there], [here], cut=20.0)
    assert (swapped.distance, swapped.missed, swapped.false) == (one.distance, 1.0, 0.0)
    assert gospa([here, []], [here, []]).distance == 0.0
    far = gospa([[(0.0, 0.0)]], [[(500.0, 0.0)]], cut=20.0)
    assert (far.distance, far.missed, far.false) == (20.0, 1.0, 1.0)


@pytest.mark.parametrize(
    ("found", "true", "cut", "said"),
    [([[]], [], 20.0, "give the same instants, one or more"), ([[]], [[]], 0.0, "the cut is a distance in m above 0")],
)
def test_gospa_says_what_is_wrong(found, true, cut, said):
    with pytest.raises(InputError, match=said):
        gospa(found, true, cut)
