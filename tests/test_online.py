"""Filters of a stream against a naive filter in NumPy, the batch answer, and themselves in other order."""

import copy
import io
import json
import subprocess
import sys
from collections import Counter
from dataclasses import dataclass
from functools import cache
from typing import ClassVar

import jax
import numpy as np
import pandas as pd
import pytest
import worlds
import xarray as xr

import probcal as pc
from probcal.errors import InputError
from probcal.stream.checkpoint import pack_state, sealed, unpack_state
from probcal.stream.relearnt import relearnt


@pc.sensor(east=pc.Channel("m", 1.0), north=pc.Channel("m", 2.0))
def plain(target, pose, *, shift=pc.Bias("m", 2.0), lift=pc.Bias("m", 1.0)):
    """Linear in state and biases."""
    place = target.position - pose.position
    return {"east": place[0] + shift, "north": place[1] + 0.5 * place[0] + lift}


@pc.sensor(range=pc.Channel("m", 1.0))
def tape(target, pose):
    return {"range": ((target.position - pose.position) ** 2).sum() ** 0.5}


MOTION = {
    name: pc.Target(pc.ConstantVelocity(0.5), {"position": ((x, 0.0), 5.0), "velocity": ((1.0, 0.0), 1.0)})
    for name, x in (("a", 0.0), ("b", 50.0))
}


def network():
    return pc.Network([plain.on(pc.Node(f"n{k}", (10.0 * k, 5.0))) for k in range(3)])


@cache
def rows(names="ab", missing=0.3):
    found = pc.simulate(network(), {n: MOTION[n] for n in names}, np.arange(12.0), key=3, missing=missing)
    return found.table.dropna(how="all", subset=["east", "north"]).sort_values("time", kind="stable", ignore_index=True)


def filtered(method, frame=None, chunk=7, motion=MOTION, **settings):
    frame = rows() if frame is None else frame
    online = pc.Online(network(), motion, method, targets=3, **settings)
    for k in range(0, len(frame), chunk):
        online.update(frame.iloc[k : k + chunk])
    return online


def naive(frame, walk=None, considered=None, jump=None):
    """The augmented filter with one covariance of everything: mean and covariance of biases, then of the targets.

    `jump` is (bias, time): a further state that this bias has from then on.
    """
    problem = pc.Problem(network(), MOTION, frame)
    names, labels, scales = sorted(set(frame["target"])), list(problem.labels), problem.scales
    M = len(labels)
    D = M + 4 * len(names) + (jump is not None)
    mean, P, last, now = np.zeros(D), np.zeros((D, D)), {}, None
    P[:M, :M] = np.diag(scales**2)
    if jump is not None:
        P[-1, -1] = scales[jump[0]] ** 2
    for time, group in frame.groupby("time"):
        if walk is not None and now is not None:
            P[:M, :M] += np.diag(walk**2 * (time - now))
        now = time
        for name in [n for n in dict.fromkeys(frame["target"]) if n in set(group["target"])]:
            own = slice(M + 4 * names.index(name), M + 4 * names.index(name) + 4)
            if name not in last:
                start = MOTION[name].start
                mean[own] = [*start["position"][0], *start["velocity"][0]]
                P[own, own] = np.diag([25.0, 25.0, 1.0, 1.0])
            else:
                dt = time - last[name]
                F = np.eye(D)
                F[own, own] = np.kron([[1, dt], [0, 1]], np.eye(2))
                Q = np.zeros((D, D))
                Q[own, own] = 0.25 * np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(2))
                mean, P = F @ mean, F @ P @ F.T + Q
            last[name] = time
            for _, row in group[group["target"] == name].iterrows():
                place = np.array([10.0 * int(row["sensor"][1]), 5.0])
                for channel, std in (("east", 1.0), ("north", 2.0)):
                    if np.isnan(row[channel]):
                        continue
                    h, fixed = np.zeros(D), 0.0
                    h[own] = [1, 0, 0, 0] if channel == "east" else [0.5, 1, 0, 0]
                    fixed = -place[0] if channel == "east" else -place[1] - 0.5 * place[0]
                    m = labels.index(f"{row['sensor']}.{'shift' if channel == 'east' else 'lift'}")
                    h[m] = 1.0
                    if jump is not None and m == jump[0] and time >= jump[1]:
                        h[-1] = 1.0
                    S = h @ P @ h + std**2
                    K = P @ h / S
                    if considered is not None:
                        K = np.where(np.append(considered, np.zeros(D - M, bool)), 0.0, K)
                    mean = mean + K * (row[channel] - fixed - h @ mean)
                    away = np.eye(D) - np.outer(K, h)
                    P = away @ P @ away.T + np.outer(K, K) * std**2
    return mean, P, M


def compare(online, mean, P, M, tolerance=1e-8):
    scales = online.biases["scale"].to_numpy()
    np.testing.assert_allclose(online.biases["mean"] / scales, mean[:M] / scales, atol=tolerance)
    np.testing.assert_allclose(online.biases["sd"], np.sqrt(np.diag(P)[:M]), rtol=tolerance)


@pytest.mark.parametrize("by", ["extended", "unscented", "cubature"])
def test_a_linear_network_has_the_exact_filter(by):
    online = filtered(pc.AugmentedFilter(by, lag=0))
    mean, P, M = naive(rows())
    compare(online, mean, P, M, 1e-7)
    covariance = online.end.root @ online.end.root.T * np.outer(*2 * [online.biases["scale"].to_numpy()])
    np.testing.assert_allclose(covariance, P[:M, :M], atol=1e-6)


def test_tracks_are_those_of_the_exact_filter_and_smoother():
    whole = pc.Problem(network(), MOTION, rows())
    batch = pc.fit(whole, pc.MAP(trajectory="joint"), prior=pc.Gaussian())
    online = filtered(pc.AugmentedFilter(lag=32), chunk=100)
    tracks = online.finish().tracks
    for name in "ab":
        truth, own = batch[f"track/{name}"].to_dataset(), tracks[tracks["target"] == name]
        np.testing.assert_allclose(own["position_x"], truth["mean"].sel(component="position_x"), atol=1e-6)
        np.testing.assert_allclose(own["velocity_y_sd"], truth["sd"].sel(component="velocity_y"), rtol=1e-6)


def test_walking_biases_of_one_target_are_exact():
    one = rows("a")
    walk = np.tile([0.3, 0.0], 3)
    online = filtered(pc.AugmentedFilter(lag=0, walk={"*.shift": 0.3}), one)
    compare(online, *naive(one, walk=walk))


def test_considered_biases_are_those_of_schmidt():
    one = rows("a")
    considered = np.tile([False, True], 3)
    online = filtered(pc.AugmentedFilter(lag=0, consider="*.lift"), one)
    mean, P, M = naive(one, considered=considered)
    compare(online, mean, P, M)
    kept = online.biases[considered]
    np.testing.assert_allclose(kept["mean"], 0.0, atol=1e-12)
    np.testing.assert_allclose(kept["sd"], kept["scale"], rtol=1e-9)


@pytest.mark.parametrize("lag", [0, 8])
def test_the_size_of_a_chunk_changes_nothing(lag):
    whole, pieces = (filtered(pc.AugmentedFilter(lag=lag), chunk=n).biases for n in (1000, 5))
    np.testing.assert_allclose(whole["mean"], pieces["mean"], atol=1e-7)
    np.testing.assert_allclose(whole["sd"], pieces["sd"], rtol=1e-7)


@pytest.mark.ci
def test_rows_within_the_lag_may_come_in_any_order():
    frame = rows()
    mixed = frame.copy()
    for k in range(0, len(frame), 10):
        some = frame.iloc[k : k + 10].sample(frac=1.0, random_state=k)
        mixed.iloc[k : k + 10] = some.to_numpy()
    mixed = mixed.astype(frame.dtypes.to_dict())
    ordered, other = (filtered(pc.AugmentedFilter(lag=32), own, chunk=3) for own in (frame, mixed))
    assert other.counts["late"] == 0
    np.testing.assert_allclose(ordered.biases["mean"], other.biases["mean"], atol=1e-7)


def test_late_and_repeated_rows_are_counted_and_left_out():
    frame = rows()
    clean = filtered(pc.AugmentedFilter(lag=0))
    online = filtered(pc.AugmentedFilter(lag=0))
    online.update(frame.iloc[:4])
    online.update(frame.iloc[[-1]])
    twice = pd.concat([frame.iloc[[-1]].assign(time=20.0)] * 2)
    online.update(twice)
    clean.update(twice.iloc[:1])
    assert online.counts == {
        "rows": len(frame) + 7,
        "late": 4,
        "duplicates": 2,
        "refused": 0,
        "retired": 0,
        "outliers": 0,
    }
    np.testing.assert_allclose(clean.biases["mean"], online.biases["mean"], atol=1e-12)


def test_rows_of_one_time_may_come_one_by_one():
    together, alone = (filtered(pc.AugmentedFilter(lag=0), chunk=n) for n in (1000, 1))
    assert alone.counts["late"] == alone.counts["duplicates"] == 0
    np.testing.assert_allclose(together.biases["sd"], alone.biases["sd"], rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(("lag", "chunk"), [(0, 1), (0, 7), (8, 3)])
def test_rows_at_common_epochs_are_those_of_their_times(lag, chunk):
    frame = rows()
    jitter = np.random.default_rng(0).uniform(-0.4, 0.4, len(frame))
    moved = frame.assign(time=frame["time"] + jitter)
    moved = moved.iloc[np.argsort(frame["time"] + 1e-3 * jitter, kind="stable")]  # in an epoch by their own times
    method = pc.AugmentedFilter(lag=lag)
    online = pc.Online(network(), MOTION, method, epoch=1.0)
    for k in range(0, len(moved), chunk):
        online.update(moved.iloc[k : k + chunk])
    online.finish()
    assert online.counts["late"] == online.counts["duplicates"] == 0
    plain = filtered(method)
    plain.finish()
    np.testing.assert_allclose(online.biases["mean"], plain.biases["mean"], atol=1e-9)
    np.testing.assert_allclose(online.biases["sd"], plain.biases["sd"], rtol=1e-9)
    online.update(moved.iloc[-1:])
    assert online.counts["duplicates"] == 1


def test_dates_are_seconds_since_the_first():
    frame = rows()
    dated = frame.assign(time=pd.Timestamp("2026-01-01T00:00Z") + pd.to_timedelta(frame["time"], unit="s"))
    text = dated.assign(time=dated["time"].map(lambda stamp: stamp.isoformat()))
    for own in (dated, text, frame.rename(columns={"time": "time [ms]"}).assign(**{"time [ms]": frame["time"] * 1e3})):
        found = filtered(pc.AugmentedFilter(lag=0), own)
        np.testing.assert_allclose(found.biases["mean"], filtered(pc.AugmentedFilter(lag=0)).biases["mean"], atol=1e-9)


def test_a_target_that_is_silent_gives_up_its_slot():
    frame = rows("a", 0.0)
    frames = [frame.assign(target=name, time=frame["time"] + 20.0 * k) for k, name in enumerate("abcd")]
    online = pc.Online(network(), MOTION["a"], pc.AugmentedFilter(lag=0), targets=2)
    for own in frames:
        online.update(own)
    assert online.counts["retired"] == 2
    assert set(online.arrivals.targets) == {"c", "d"}
    more = pc.Online(network(), MOTION["a"], pc.AugmentedFilter(lag=0), targets=4)
    for own in frames:
        more.update(own)
    np.testing.assert_allclose(online.biases["mean"], more.biases["mean"], atol=1e-10)
    with pytest.raises(InputError, match="more than 2 targets are seen at once"):
        online.update(pd.concat([frame.assign(target=name, time=frame["time"] + 100.0) for name in "efg"]))


@pytest.mark.slow
def test_a_jump_is_what_a_further_state_of_the_filter_says():
    one = rows("a", 0.0)
    online = filtered(pc.AugmentedFilter(lag=0, jumps=pc.Jumps(within=1e4, starts=1, false_alarms=1e-9)), one[:15], 15)
    online.since = [5.0]
    later = one[15:]
    online.update(later)
    told, problem = jax.tree.map(np.asarray, online.belief.candidates), online._problem
    for m in range(6):
        mean, P, _ = naive(one, jump=(m, float(one["time"].iloc[15])))
        precision = told.information[m] + 1.0
        scale = problem.scales[m]
        assert told.score[m] / precision == pytest.approx(mean[-1] / scale, abs=1e-7)
        assert precision**-0.5 == pytest.approx(P[-1, -1] ** 0.5 / scale, rel=1e-7)
        with jax.enable_x64(True):
            from probcal.stream.filters.belief import jumped

            after = jumped(online.belief, np.asarray(m), told.score[m] / precision, 1.0 / precision)
        after = jax.tree.map(np.asarray, after)
        present = mean[:6] + mean[-1] * (np.arange(6) == m)
        turn = np.eye(len(mean))
        turn[m, -1] = 1.0
        np.testing.assert_allclose(after.mean * problem.scales, present, atol=1e-6)
        covariance = after.root @ after.root.T * np.outer(problem.scales, problem.scales)
        np.testing.assert_allclose(covariance, (turn @ P @ turn.T)[:6, :6], atol=1e-6)
        own = after.slots[0]
        state = own.m[0] + own.B[0] @ after.mean
        np.testing.assert_allclose(state, mean[6:10], atol=1e-6)
        reach = own.B[0] @ after.root
        np.testing.assert_allclose(own.R[0] @ own.R[0].T + reach @ reach.T, P[6:10, 6:10], atol=1e-6)


def jumping(size):
    frame = pc.simulate(network(), MOTION, np.arange(120.0), key=5).table.sort_values("time", kind="stable")
    later = (frame["sensor"] == "n1") & (frame["time"] >= 60.0)
    return frame.assign(east=frame["east"] + np.where(later, size, 0.0))


@pytest.mark.ci
@pytest.mark.parametrize("lag", [0, 8])
def test_a_jump_is_found_soon_and_none_where_there_is_none(lag):
    method = pc.AugmentedFilter(lag=lag, jumps=pc.Jumps(within=40.0))
    still = filtered(method, jumping(0.0), 30)
    assert still.jumps == []
    online = filtered(method, jumping(6.0), 30)
    (jump,) = online.jumps
    assert jump.label == "n1.shift"
    assert 50.0 <= jump.since <= 60.0 < jump.found <= 80.0
    assert abs(jump.size - 6.0) < 3 * jump.sd
    assert 0.0 < jump.bound <= jump.found - jump.since
    moved = online.biases["mean"]["n1.shift"] - still.biases["mean"]["n1.shift"]
    assert moved == pytest.approx(6.0, abs=3 * online.biases["sd"]["n1.shift"])


@pytest.mark.ci
def test_a_window_of_everything_ends_at_the_batch_answer():
    network_ = pc.Network(
        [tape.on(pc.Node(f"n{k}", place, scale=3.0)) for k, place in enumerate(((0, 0), (60, 5), (20, 70)))]
    )
    motion = pc.Target(pc.ConstantVelocity(0.3), {"position": ((5.0, 30.0), 5.0), "velocity": ((2.0, 0.0), 1.0)})
    frame = pc.simulate(network_, motion, np.arange(20.0), key=1).table
    batch = pc.fit(pc.Problem(network_, motion, frame), pc.MAP(trajectory="joint"), prior=pc.Gaussian())
    group = batch["calibration"].to_dataset()
    online = pc.Online(network_, motion, pc.AugmentedFilter(lag=32, tolerance=1e-4, passes=30))
    for k in range(0, len(frame), 15):
        assert online.update(frame.iloc[k : k + 15]).settled
    assert (np.abs(online.biases["mean"] - group["mean"].values) < 0.002 * group["sd"].values).all()
    np.testing.assert_allclose(online.biases["sd"], group["sd"].values, rtol=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [name if name == "mixed" else pytest.param(name, marks=pytest.mark.slow) for name in worlds.LINEAR]
)
def test_every_linear_world_ends_at_its_exact_posterior(name):
    """In 2-D and 3-D, with sensors of two nodes, moving nodes, drifts, targets of several motions, blank rows."""
    world, motion, table, fixed = worlds.LINEAR[name]()
    known, scales = worlds.exact(name), worlds.linear(name)[0].scales
    table = table.sort_values("time", kind="stable")
    for lag, chunk in ((0, 1000), (8, 4)):
        online = pc.Online(world, motion, pc.AugmentedFilter(lag=lag, gate=0.0), fix=fixed)
        begun = int(np.flatnonzero(table.drop(columns=["time", "sensor", "target"]).notna().any(axis=1))[0]) + 1
        for part in (table.iloc[:begun], *(table.iloc[k : k + chunk] for k in range(begun, len(table), chunk))):
            online.update(part)
        online.finish()
        M = len(scales)
        np.testing.assert_allclose(online.biases["mean"] / scales, known.mean[:M], atol=1e-9)
        np.testing.assert_allclose(online.biases["sd"] / scales, np.sqrt(np.diag(known.covariance)[:M]), rtol=1e-9)


@pytest.mark.ci
def test_a_target_without_a_start_is_placed_by_its_first_rows():
    places = ((0.0, 0.0), (400.0, 20.0), (100.0, 500.0), (450.0, 480.0))
    network_ = pc.Network([tape.on(pc.Node(f"n{k}", place, scale=0.5)) for k, place in enumerate(places)])
    motion = pc.Target(pc.ConstantVelocity(0.3), {"position": ((300.0, 150.0), 1.0), "velocity": ((2.0, 1.0), 1.0)})
    run = pc.simulate(network_, motion, np.arange(12.0), key=1)
    for lag in (0, 16):
        online = pc.Online(network_, pc.ConstantVelocity(0.3), pc.AugmentedFilter(lag=lag))
        online.update(run.table)
        tracks = pd.concat([online.finish().tracks]) if lag else None
        last = online.end.slots[0].m[0] + online.end.slots[0].B[0] @ online.end.mean
        truth = run.truth.tracks.iloc[-1]
        assert np.hypot(last[0] - truth["position_x"], last[1] - truth["position_y"]) < 4.0
        assert lag == 0 or len(tracks) == 12


def test_a_plain_filter_says_where_a_target_was_not_placed():
    network_ = pc.Network(
        [tape.on(pc.Node(f"n{k}", place, scale=0.5)) for k, place in enumerate(((0, 0), (60, 5), (9, 70)))]
    )
    first = pd.DataFrame({"time": [0.0], "sensor": ["n0"], "range": [40.0]})
    near = pc.Target(pc.ConstantVelocity(0.3), {"position": ((30.0, 20.0), 1.0), "velocity": ((1.0, 0.0), 1.0)})
    for motion, lag, settled in (
        (pc.ConstantVelocity(0.3), 0, False),
        (near, 0, True),
        (pc.ConstantVelocity(0.3), 8, True),
    ):
        assert pc.Online(network_, motion, pc.AugmentedFilter(lag=lag)).update(first).settled is settled


@pytest.mark.ci
def test_a_killed_filter_goes_on_as_if_it_had_not_been():
    frame = rows()
    for method in (pc.AugmentedFilter(lag=8), pc.ParticleFilter(50), pc.AugmentedFilter(lag=0, jumps=pc.Jumps())):
        whole, first = filtered(method, chunk=6), filtered(method, frame[:24], chunk=6)
        second = pc.Online(network(), MOTION, method, targets=3)
        assert unpack_state(second, pack_state(first, {"offset": 5}), "state") == {"offset": 5}
        for k in range(24, len(frame), 6):
            second.update(frame.iloc[k : k + 6])
        pd.testing.assert_frame_equal(whole.biases, second.biases, rtol=1e-9)
        assert whole.counts == second.counts
        assert whole.log_evidence == pytest.approx(second.log_evidence, rel=1e-9)


def test_a_state_of_something_else_is_refused():
    online = filtered(pc.AugmentedFilter(lag=0))
    state = pack_state(online, {})
    for content in (b"nothing", state[:-1], bytes([*state[:900], state[900] ^ 1, *state[901:]])):
        with pytest.raises(InputError, match="is damaged, or no state of this version of probcal watch; move it away"):
            unpack_state(pc.Online(network(), MOTION, pc.AugmentedFilter(lag=0)), content, "x")
    with pytest.raises(InputError, match="is the checkpoint of other settings"):
        unpack_state(pc.Online(network(), MOTION), state, "x")


def stage(std=1.0, place=0.0, heard=3.0, survey=None, function=lambda x: x, name="n1", noise=None):
    """A network that differs in one declaration."""

    @pc.sensor(east=pc.Channel("m", std, noise=noise or pc.StudentT(4.0)))
    def gauge(target, pose, *, shift=pc.Bias("m", heard)):
        return {"east": function(target.position[0] - pose.position[0]) + shift}

    return pc.Network([
        gauge.on(pc.Node("n0", (0.0, 5.0))), gauge.on(pc.Node(name, (10.0 + place, 5.0), survey=survey)),
    ])  # fmt: skip


LINE = pc.Target(pc.ConstantVelocity(0.5), MOTION["a"].start)


@dataclass(frozen=True)
class Louder(pc.StudentT):
    """A family of a user: what it computes is no field."""

    factor: ClassVar[float] = 1.0

    def log_likelihood(self, y, predicted, std, period):
        return self.factor * super().log_likelihood(y, predicted, std, period)


class LouderStill(Louder):
    factor = 2.0


LouderStill.__name__ = "Louder"
EDITS = {
    "sensor gauge": [
        dict(network=stage(std=2.0)), dict(network=stage(heard=4.0)), dict(network=stage(function=lambda x: 1.01 * x)),
        dict(network=stage(noise=Louder(4.0))),
    ],
    "node n1": [dict(network=stage(place=1.0)), dict(network=stage(survey=0.1))],
    "sensor n2": [dict(network=stage(name="n2"))],
    "motion": [
        dict(motion=pc.ConstantVelocity(0.5)), dict(motion=pc.Target(pc.ConstantVelocity(0.6), LINE.start)),
        dict(motion=pc.Target(LINE.motion, LINE.start | {"velocity": ((1.0, 0.0), 2.0)})),
        dict(motion=pc.Target(pc.ConstantAcceleration(0.5), LINE.start)),
    ],
    "fixed biases": [dict(fix="n0.shift"), dict(fix={"n0.shift": 1.0})],
    "epoch": [dict(epoch=0.5)],
    "number of targets": [dict(targets=4)],
    "motion of a": [dict(motion=MOTION)],
}  # fmt: skip


@pytest.mark.ci
def test_a_state_belongs_to_what_was_declared():
    def begun(network=None, motion=LINE, **settings):
        return pc.Online(network or stage(), motion, pc.AugmentedFilter(lag=0), **settings)

    online = begun()
    found = rows("a").drop(columns="north")
    online.update(found[found["sensor"] != "n2"].dropna())
    state = pack_state(online, {})
    unpack_state(begun(stage(), pc.Target(pc.ConstantVelocity(0.5), LINE.start)), state, "x")
    for name, edits in EDITS.items():
        for edit in edits:
            with pytest.raises(
                InputError, match=f"x: the {name} has changed since the run there began; .* another --out"
            ):
                unpack_state(begun(**edit), state, "x")
    tree = online.tree()
    with pytest.raises(InputError, match="x: the calibration has changed"):
        unpack_state(begun(calibration=tree), state, "x")
    state = pack_state(one := begun(stage(noise=Louder(4.0))), {})
    assert begun(stage(noise=LouderStill(4.0))).identity != one.identity
    tree["calibration"]["mean"] = tree["calibration"]["mean"] + 1e-9
    assert begun(calibration=tree).identity != begun(calibration=online.tree()).identity


DECLARED = """
import numpy as np
import probcal as pc
from probcal import Road, RoadNetwork

@pc.sensor(east=pc.Channel("m", pc.Unknown(1.0), noise=pc.Censored()))
def gauge(target, pose, *, shift=pc.Bias("m", 2.0, drift=pc.Drift([0.0, 9.0], std=0.1))):
    return {"east": target.position[0] - pose.position[0] + shift + np.arange(3.0).sum()}

path = pc.Path([0.0, 9.0], [(0.0, 0.0), (5.0, 5.0)])
network = pc.Network([gauge.on(pc.Node("n0", path=path)), gauge.on(pc.Node("n1", (0.0, 9.0), survey=0.1))])
roads = RoadNetwork.from_lines({"west": [(-9.0, 0.0), (20.0, 0.0)], "east": [(20.0, 0.0), (90.0, 0.0)]})
motion = {
    "a": pc.Known(([0.0, 9.0], [(0.0, 0.0), (5.0, 5.0)]), std=0.1), "b": Road(roads, 0.1, (1.0, 0.2)),
    "c": pc.ConstantVelocity(0.5, noise=pc.StudentT(4.0)) + pc.RandomWalk("power", "dB", 1.0, (0.0, 3.0)),
}
identity = pc.Online(network, motion, pc.ParticleFilter(10)).identity
"""


def test_what_was_declared_is_the_same_in_another_process():
    here = {}
    exec(DECLARED, here)
    assert {"sensor n1", "node n0", "motion of b", "list of sensors"} <= set(here["identity"])
    there = subprocess.run(
        [sys.executable, "-c", DECLARED + "\nprint(identity)"], capture_output=True, text=True, check=True
    )
    assert there.stdout.strip() == str(here["identity"])


def test_a_floor_of_the_first_rows_is_kept():
    heard = rows("a").drop(columns="north")
    heard = heard[heard["sensor"] != "n2"].dropna().assign(east=lambda frame: frame["east"].clip(lower=-4.0))

    def begun():
        return pc.Online(stage(noise=pc.Censored()), LINE, pc.AugmentedFilter(lag=0))

    first, second = begun(), begun()
    first.update(heard[:14])
    unpack_state(second, pack_state(first, {}), "x")
    assert len(first.arrivals.floors) == 1
    assert first.arrivals.floors == second.arrivals.floors
    for online in (first, second):
        online.update(heard[14:])
    pd.testing.assert_frame_equal(first.biases, second.biases, rtol=1e-9)


def opened(state):
    """JSON and arrays of a state."""
    with np.load(io.BytesIO(state)) as file:
        arrays = dict(file.items())
    return json.loads(arrays.pop("said").tobytes()), arrays


def closed(said, arrays):
    """A state whose digest was computed anew."""
    packed = io.BytesIO()
    np.savez(packed, said=np.frombuffer(json.dumps(said).encode(), np.uint8), **arrays)
    return sealed(packed.getvalue())


def tampered(state):
    """Name and bytes of states of which one member was changed."""
    said, arrays = opened(state)
    for name, array in arrays.items():
        number = array.dtype.kind == "f"
        broken = [None, array[..., None], array.astype(np.float32), array.astype("U")]
        broken += [np.full_like(array, value) for value in (np.nan, -np.inf, np.inf)] if number else [array - 10**6]
        for other in broken if array.size else broken[:2]:
            kept = {key: own for key, own in arrays.items() if key != name}
            yield name, closed(said, kept if other is None else kept | {name: other})
    for name in said["members"]:
        for value in (..., None, True, "x", -7, 1e999, 10**400, [], {}, [[]], {"x": 1e999}, {"x": ["y"], "time": [1]}):
            if value == said["members"][name]:
                continue
            members = {key: own for key, own in said["members"].items() if key != name or value is not ...}
            yield name, closed(said | {"members": members if value is ... else members | {name: value}}, arrays)
    for name in ("version", "method", "identity", "members"):
        for value in (None, 7, "x", [], {}):
            yield name, closed(said | {name: value}, arrays)


GOOD = {  # members of which other values make a filter: counts, times and what was found
    "arrivals.counts", "arrivals.floors", "arrivals.origin", "arrivals.targets", "arrivals.duration", "doubts",
    "arrivals.earlier", "arrivals.first", "arrivals.latest", "arrivals.until", "points", "jumps", "time", "walked",
    "log_evidence", "epochs", "last", "check.changed", "check.targets", "check.snapshots",
    "check.moments", "check.restarts", "check.events", "check.cause",
}  # fmt: skip


@pytest.mark.ci
@pytest.mark.parametrize(
    "method",
    [pc.AugmentedFilter(lag=8, jumps=pc.Jumps()), pytest.param(pc.ParticleFilter(20), marks=pytest.mark.slow)],
    ids=["augmented", "particles"],
)
def test_a_changed_state_is_one_sentence_or_as_good(method):
    whole, refused = filtered(method, rows()[:24], chunk=6), Counter()
    state, fresh = pack_state(whole, {}), rows().assign(time=rows()["time"] + 50.0)
    for name, other in tampered(state):
        online = pc.Online(network(), MOTION, method, targets=3)
        try:
            unpack_state(online, other, "x")
        except InputError as error:
            refused["member " in str(error)] += 1
            continue
        assert name in GOOD
        pd.testing.assert_frame_equal(online.biases, whole.biases)
        online.update(fresh)
    assert refused[True] > 200
    assert refused[False] < 20  # of another version, or of something else


@pytest.mark.slow
def test_sparse_priors_are_laid_on_what_was_filtered():
    whole = pc.Problem(network(), MOTION, rows())
    online = filtered(pc.AugmentedFilter(lag=0))
    for prior, method in ((pc.Horseshoe(), pc.EA()), (pc.ARD(), pc.EA(precisions="maximised"))):
        batch = pc.fit(whole, method, prior=prior)["calibration"].to_dataset()
        found = online.under(prior)
        np.testing.assert_allclose(found["mean"] / found["scale"], batch["mean"] / batch["scale"], atol=0.1)
        np.testing.assert_allclose(found["sd"] / found["scale"], batch["sd"] / batch["scale"], atol=0.05)
    with pytest.raises(InputError, match="give a prior with precisions, Horseshoe"):
        online.under(pc.Gaussian())
    walking = filtered(pc.AugmentedFilter(lag=0, walk={"*.shift": 0.1}))
    with pytest.raises(InputError, match="have no prior that could be replaced; fit the rows as a batch"):
        walking.under(pc.Horseshoe())


def test_surveyed_biases_share_no_precision_with_a_group_that_is_learnt():
    problem = worlds.linear("plane")[0]
    M = len(problem.labels)
    half = np.random.default_rng(2).normal(size=(M, M))
    covariance = np.linalg.inv(half @ half.T + np.eye(M))
    mean, root = np.where(problem.surveyed, 3.0, 0.3), np.linalg.cholesky(covariance)
    with jax.enable_x64(True):
        held = pc.Gaussian().precision(problem.labels, problem.surveyed)
        found = relearnt(problem, pc.ARD(by="type"), held, mean, root, 0)
    alpha, own = (1.0 - found.gamma) / np.diag(found.covariance), ~problem.surveyed
    np.testing.assert_allclose(alpha[~own], 1.0)
    np.testing.assert_allclose(alpha[own], found.gamma[own].sum() / (found.mean[own] ** 2).sum(), rtol=1e-3)


def test_biases_that_a_calibration_held_stay_held():
    labels = [label for label in network().labels if label != "n0.shift"]
    known = {"bias_label": labels, "bias_label_other": labels}
    spread = ("bias_label", "bias_label_other"), np.diag(np.full(len(labels), 0.25))
    group = xr.Dataset({"mean": ("bias_label", np.ones(len(labels))), "covariance": spread}, known)
    held = xr.Dataset({"fixed": ("fixed_label", [1.5])}, {"fixed_label": ["n0.shift"]})
    tree = xr.DataTree.from_dict({"calibration": group, "constant_data": held})
    online = filtered(pc.AugmentedFilter(lag=0), calibration=tree)
    assert list(online.labels) == labels
    assert (online.biases["sd"] < 0.5).all()
    assert online.arrivals.fixed == {"n0.shift": 1.5}
    other = pc.Online(network(), MOTION, fix={"n0.*": 0.5}, calibration=tree)
    assert other.arrivals.fixed == {"n0.shift": 0.5, "n0.lift": 0.5}


@pytest.mark.ci
def test_the_tree_serves_track_and_a_further_stream(tmp_path):
    online = filtered(pc.AugmentedFilter(lag=0))
    tree = pc.load(pc.save(online.tree(), tmp_path / "fit.nc"))
    group = tree["calibration"].to_dataset()
    np.testing.assert_allclose(group["mean"], online.biases["mean"], atol=1e-9)
    assert tree.attrs["stream_rows"] == len(rows())
    assert (tree.attrs["status"], tree.attrs["message"]) == ("converged", "")
    assert "a" in pc.track(pc.Problem(network(), MOTION, rows()), tree)["track"].children
    further = pc.Online(network(), MOTION, pc.AugmentedFilter(lag=0), calibration=tree)
    later = rows().assign(time=rows()["time"] + 100.0)
    further.update(later)
    assert (further.biases["sd"] < online.biases["sd"]).all()


@pytest.mark.ci
def test_particles_approach_the_exact_filter():
    one = rows("a")[:9]
    exact = filtered(pc.AugmentedFilter(lag=0), one).biases
    online = filtered(pc.ParticleFilter(4000), one)
    assert (np.abs(online.biases["mean"] - exact["mean"]) < 0.15 * exact["sd"]).all()
    np.testing.assert_allclose(online.biases["sd"], exact["sd"], rtol=0.1)
    update = online.update(rows("a")[9:12])
    assert update.settled
    assert not filtered(pc.ParticleFilter(10), one).update(rows("a")[9:12]).settled


@pytest.mark.ci
def test_intervals_hold_as_often_as_they_say():
    held, count = [], 40
    for seed in range(count):
        run = pc.simulate(network(), MOTION, np.arange(12.0), key=100 + seed, missing=0.3)
        frame = run.table.dropna(how="all", subset=["east", "north"]).sort_values("time", kind="stable")
        found = filtered(pc.AugmentedFilter(lag=8), frame, 40).biases
        true = np.array([run.truth.biases[label] for label in found.index])
        held.append(((found["lower"] <= true) & (true <= found["upper"])).mean())
    assert abs(np.mean(held) - 0.89) < 3.5 * np.std(held) / count**0.5


WRONG = {
    r'AugmentedFilter\(by="middle"\): give one of': lambda: pc.AugmentedFilter("middle"),
    "give 0 or a number of epochs that 4 divides": lambda: pc.AugmentedFilter(lag=3),
    r"AugmentedFilter\(passes=0": lambda: pc.AugmentedFilter(passes=0),
    "cannot be tested for jumps; drop one of both": lambda: pc.AugmentedFilter(jumps=pc.Jumps(), consider="a"),
    "give a positive std for one second": lambda: pc.AugmentedFilter(walk={"a": 0.0}),
    r"Jumps\(within=-1\): give a positive number": lambda: pc.Jumps(within=-1),
    "give 2 or more, some hundred as a rule": lambda: pc.ParticleFilter(1),
    r"ParticleFilter\(threshold=2.0\): give a share of the particles, 0 to 1": lambda: pc.ParticleFilter(threshold=2.0),
    r"give AugmentedFilter\(...\) or ParticleFilter": lambda: pc.Online(network(), MOTION, pc.EA()),
    r"Online\(epoch=-1": lambda: pc.Online(network(), MOTION, epoch=-1.0),
    r"Online\(targets=0": lambda: pc.Online(network(), MOTION, targets=0),
    r"the filter takes Gaussian\(\); sparse priors are laid on": lambda: pc.Online(network(), MOTION, prior=pc.ARD()),
    "nothing is known before the first rows": lambda: pc.Online(network(), MOTION).biases,
    "matches no bias": lambda: filtered(pc.AugmentedFilter(lag=0, walk={"x.*": 1.0})),
    'has no column "sensor"; a stream needs time and sensor': lambda: filtered(None, rows().drop(columns="sensor")),
    'column "target" is blank; an online filter takes': lambda: filtered(None, rows().assign(target=None)),
    'unit "m" is not a time; use s, ms': lambda: filtered(None, rows().rename(columns={"time": "time [m]"})),
    "is not a finite time; give seconds or ISO dates": lambda: filtered(None, rows().assign(time="noon")),
    "the time is infinite; give seconds or ISO dates": lambda: filtered(None, rows().assign(time=np.inf)),
    'target "q" has no motion': lambda: filtered(None, rows("a").assign(target="q")),
    'target "a" moves by ConstantVelocity with noise=StudentT': lambda: filtered(
        None, rows("a"), motion=pc.Target(pc.ConstantVelocity(0.5, noise=pc.StudentT(2.5)), MOTION["a"].start)
    ),
    "rows have no measured value; fill the channel columns": lambda: filtered(
        None, rows()[["time", "sensor", "target"]].assign(east=None)
    ),
}  # fmt: skip


@pytest.mark.parametrize("said", WRONG)
def test_what_is_wrong_is_said_in_one_sentence(said):
    with pytest.raises(InputError, match=said):
        WRONG[said]()


def test_blank_rows_are_no_rows():
    online, frame = filtered(pc.AugmentedFilter(lag=0)), rows()
    before = copy.deepcopy(online.biases)
    channels = [name for name in frame if name not in ("time", "sensor", "target")]
    blank = frame.assign(time=frame["time"] + 50.0, **dict.fromkeys(channels, np.nan))
    assert online.update(blank).epochs == 0
    fresh = frame.assign(time=frame["time"] + 100.0)
    online.update(fresh)
    other = filtered(pc.AugmentedFilter(lag=0))
    pd.testing.assert_frame_equal(before, other.biases)
    other.update(fresh)
    pd.testing.assert_frame_equal(online.biases, other.biases)


@pytest.mark.ci
@pytest.mark.parametrize("method", [pc.AugmentedFilter(lag=0), pc.ParticleFilter(50)], ids=["augmented", "particles"])
def test_the_last_rows_of_a_tree_are_those_that_say_something(method):
    frame = rows()
    channels = [name for name in frame if name not in ("time", "sensor", "target")]
    b = frame["target"] == "b"
    blank = frame[b].assign(time=frame["time"][b] + 50.0, **dict.fromkeys(channels, np.nan))
    online = filtered(method)
    online.update(pd.concat([frame[~b].assign(time=frame["time"][~b] + 50.0), blank], ignore_index=True))
    tree = online.tree()
    assert "a" in tree["track"]
    assert "b" not in tree["track"]


def test_a_table_that_is_refused_leaves_nothing_behind():
    online = filtered(pc.AugmentedFilter(lag=0))
    before = copy.deepcopy(online.biases)
    with pytest.raises(InputError, match='sensor "q" is not in the network'):
        online.update(rows().assign(time=rows()["time"] + 50.0, sensor="q"))
    pd.testing.assert_frame_equal(before, online.biases)
    assert online.counts["rows"] == len(rows())


@pytest.mark.parametrize("lag", [0, 4])
def test_a_table_that_breaks_off_midway_leaves_nothing_behind(lag, monkeypatch):
    """Some calls of the filter are over when it stops."""
    method = pc.AugmentedFilter(lag=lag, jumps=pc.Jumps(within=5.0) if lag else None)
    online, other = filtered(method), filtered(method)
    fresh = rows().assign(time=rows()["time"] + 50.0)
    later = pd.concat([fresh.assign(time=fresh["time"] + 20.0 * k) for k in range(4)], ignore_index=True)
    run, calls = online._rows_of, []

    def stops(*given):
        calls.append(given)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return run(*given)

    monkeypatch.setattr("probcal.stream.online.PLAIN", (1, 32))
    monkeypatch.setattr("probcal.stream.online.BULK", 2)
    with monkeypatch.context() as patched:
        patched.setattr(online, "_rows_of", stops)
        with pytest.raises(KeyboardInterrupt):
            online.update(later)
    assert online.walked == other.walked
    assert online.counts == other.counts
    for one in (online, other):
        one.update(later)
    pd.testing.assert_frame_equal(online.biases, other.biases)
    assert online.log_evidence == other.log_evidence
    assert online.since == other.since


@pytest.mark.ci
def test_a_tree_has_the_tracks_of_the_last_rows_wherever_they_began():
    found = pc.simulate(network(), {"a": MOTION["a"]}, np.arange(200.0), key=3).table.sort_values("time", kind="stable")
    online = pc.Online(network(), {"a": MOTION["a"]}, pc.AugmentedFilter(lag=0))
    for k in range(0, len(found), 60):
        last = online.update(found.iloc[k : k + 60]).tracks
    track = online.tree()["track/a"]
    assert len(last) == len(track["time"]) == 20
    away = track["mean"].sel(component=["position_x", "position_y"]).to_numpy() - last[["position_x", "position_y"]]
    assert (np.abs(away.to_numpy()) < 4 * last[["position_x_sd", "position_y_sd"]].to_numpy()).all()


def test_detections_without_a_name_are_refused():
    seen = pc.Network([plain.on(pc.Node("n0", (0.0, 0.0)), detection=pc.Detection(0.9, clutter=1.0))])
    online = pc.Online(seen, MOTION["a"])
    with pytest.raises(InputError, match="an online filter takes rows that name their target, no detections"):
        online.update(rows("a")[rows("a")["sensor"] == "n0"].drop(columns="target", errors="ignore"))


def test_too_many_biases_are_refused(monkeypatch):
    monkeypatch.setattr(sys.modules["probcal.stream.online"], "MANY", 3)
    with pytest.raises(InputError, match="6 biases are too many for an online filter, which takes 3"):
        filtered(pc.AugmentedFilter(lag=0))


def test_a_filter_that_leaves_the_numbers_says_when(monkeypatch):
    online = filtered(pc.AugmentedFilter(lag=0))
    online.belief = online.belief._replace(mean=np.full(6, np.nan))
    with pytest.raises(InputError, match="state where the targets start, or take a lag"):
        online.update(rows().assign(time=rows()["time"] + 50.0))
    lost = filtered(pc.ParticleFilter(20), rows()[:6])
    lost.cloud = lost.cloud._replace(mean=np.full((20, 6), np.nan))
    with pytest.raises(InputError, match="no particle explains the rows at time 50"):
        lost.update(rows()[:6].assign(time=50.0))


@pc.sensor(range=pc.Channel("m", 1.0), azimuth=pc.Channel("rad", 0.02, wrap=True), level=pc.Channel("dB", 1.0))
def gauge(target, pose, *, offset=pc.Bias("m", 2.0)):
    line = target.position - pose.position
    away = (line**2).sum() ** 0.5
    azimuth = jax.numpy.arctan2(line[1], line[0])
    return {"range": away + offset, "azimuth": azimuth, "level": 60.0 - 20.0 * jax.numpy.log10(away)}


@cache
def gauges():
    nodes = [pc.Node(f"g{k}", place) for k, place in enumerate([(0.0, 0.0), (40.0, 0.0), (0.0, 40.0)])]
    network_ = pc.Network([gauge.on(node) for node in nodes])
    run = pc.simulate(network_, pc.ConstantVelocity(0.3), np.arange(50.0), key=2)
    return network_, run.table.sort_values("time", kind="stable", ignore_index=True)


def with_cell(column, row, value):
    def change(frame):
        frame = frame.assign(range_std=frame.get("range_std", 1.0))
        frame.loc[row, column] = value
        return frame

    return change


NONSENSE = {  # a change of 150 rows, the rows that are refused, the words of the reason
    "sentinel early": (with_cell("range", 4, -9999.0), [4], "-9999 looks like a mark for a missing value"),
    "sentinel": (with_cell("level", 70, 9999.0), [70], "looks like a mark for a missing value"),
    "sentinel last": (with_cell("azimuth", 149, -999.0), [149], 'row 149 column "azimuth": -999 looks like a mark'),
    "far": (with_cell("range", 70, 1e12), [70], "is far from all others"),
    "degrees": (with_cell("azimuth", 70, 90.0), [70], "90 rad looks like degrees; write the header as azimuth [deg]"),
    "std": (with_cell("range_std", 70, 1e-12), [70], "many orders of magnitude smaller than the values"),
    "epoch": (with_cell("time", 70, 1.7e12), [70], "looks like ms since 1970"),
    "century": (with_cell("time", 149, 1e10), [149], "1e+10 s after the row before it in time"),
    "past": (with_cell("time", 70, -1e10), [70], "1e+10 s before the row after it in time"),
    "many": (
        lambda d: d.assign(range=d["range"].where(d.index % 3 > 0, -9999.0)),
        list(range(0, 150, 3)), "looks like a mark for a missing value",
    ),
}  # fmt: skip


@pytest.mark.ci
@pytest.mark.parametrize("kind", NONSENSE)
def test_rows_that_cannot_be_meant_are_refused_and_the_rest_is_filtered(kind):
    change, bad, says = NONSENSE[kind]
    network_, frame = gauges()
    changed = change(frame)
    online = pc.Online(network_, pc.ConstantVelocity(0.3), pc.AugmentedFilter(lag=8))
    update = online.update(changed)
    assert update.refused["line"].tolist() == bad
    assert update.refused["reason"].str.contains(says, regex=False).all()
    assert online.counts["refused"] == len(bad)
    other = pc.Online(network_, pc.ConstantVelocity(0.3), pc.AugmentedFilter(lag=8))
    assert other.update(changed.drop(bad)).refused.empty
    pd.testing.assert_frame_equal(online.biases, other.biases)
    assert online.tree()["observed_data"].sizes["datum"] == 3 * (150 - len(bad))


CELLS = [
    ("range", -9999.0), ("level", 9999.0), ("azimuth", 90.0), ("range", 1e12), ("range_std", 1e-12), ("time", 1.7e12),
    ("time", 1e10),
]  # fmt: skip


@pytest.mark.parametrize("chunk", [1, 7, 100])
def test_a_stream_refuses_the_same_rows_in_every_chunk_and_after_a_restart(chunk):
    network_, frame = gauges()
    changed, bad = frame, list(range(30, 30 + 11 * len(CELLS), 11))
    for row, (column, value) in zip(bad, CELLS, strict=True):
        changed = with_cell(column, row, value)(changed)
    online, found = pc.Online(network_, pc.ConstantVelocity(0.3), pc.AugmentedFilter(lag=0)), []
    for k in range(0, len(changed), chunk):
        if k // chunk == 60 // chunk:  # as of a process that was killed
            fresh = pc.Online(network_, pc.ConstantVelocity(0.3), pc.AugmentedFilter(lag=0))
            unpack_state(fresh, pack_state(online, {}), "state")
            online = fresh
        found += online.update(changed.iloc[k : k + chunk]).refused["line"].tolist()
    assert found == bad
    assert online.counts["refused"] == len(bad)


def test_a_column_of_degrees_or_powers_is_refused_whole():
    network_, frame = gauges()
    for changed, says in (
        (frame.assign(azimuth=np.rad2deg(frame["azimuth"])), "looks like degrees"),
        (frame.assign(level=np.geomspace(1e-4, 0.09, 150)), "looks like power in W, as all of the column"),
    ):
        online = pc.Online(network_, pc.ConstantVelocity(0.3), pc.AugmentedFilter(lag=0))
        refused = online.update(changed).refused
        assert refused["line"].tolist() == list(range(150))
        assert refused["reason"].str.contains(says).all()
        with pytest.raises(InputError, match=r"all 150 rows were refused; Update\.refused names the reasons"):
            online.tree()


def test_values_that_change_for_good_are_taken_after_some_rows():
    network_, frame = gauges()
    still = frame.assign(level=1e-7 * np.arange(150) % 7e-7)
    later = frame.assign(time=frame["time"] + 50.0)
    online = pc.Online(network_, pc.ConstantVelocity(0.3), pc.AugmentedFilter(lag=0, gate=0.0))
    assert online.update(still).refused.empty
    found = [len(online.update(later.iloc[k : k + 5]).refused) for k in range(0, 150, 5)]
    assert 0 < sum(found) < 40
    assert not any(found[8:])


def test_a_header_that_cannot_be_meant_is_one_sentence():
    network_, frame = gauges()
    kilometres = frame.assign(range=frame["range"] / 1e3, range_std=1.0).rename(columns={"range": "range [km]"})
    online = pc.Online(network_, pc.ConstantVelocity(0.3), pc.AugmentedFilter(lag=0))
    with pytest.raises(InputError, match=r'"range_std" has no unit beside "range \[km\]"'):
        online.update(kilometres)


@pytest.mark.ci
def test_robust_channels_refuse_sentinels_too():
    network_ = pc.Network([robust.on(pc.Node(f"n{k}", (10.0 * k, 5.0))) for k in range(3)])
    frame = pc.simulate(network_, MOTION["a"], np.arange(20.0), key=1).table
    frame.loc[59, "east"] = -9999.0
    online = pc.Online(network_, MOTION["a"], pc.AugmentedFilter(lag=8))
    assert online.update(frame).refused["line"].tolist() == [59]
    assert online.tree().attrs["stream_refused"] == 1


def dated(frame, start="2026-01-01T00:00Z"):
    return frame.assign(time=pd.Timestamp(start) + pd.to_timedelta(frame["time"], unit="s"))


@pytest.mark.slow
@pytest.mark.parametrize("times", [lambda d: d, dated], ids=["seconds", "dates"])
@pytest.mark.parametrize("epoch", [None, 2.0])
def test_rows_that_a_fit_has_counted_are_refused(times, epoch):
    frame = rows()
    tree = pc.fit(pc.Problem(network(), MOTION, times(frame[10:40]), epoch=epoch), pc.EA())
    online = pc.Online(network(), MOTION, pc.AugmentedFilter(lag=0), calibration=tree, epoch=epoch)
    refused = online.update(times(frame)).refused
    assert refused["line"].tolist() == list(range(10, 40))
    assert refused["reason"].str.endswith("the calibration has counted this row").all()
    other = pc.Online(network(), MOTION, pc.AugmentedFilter(lag=0), calibration=tree, epoch=epoch)
    assert other.update(times(frame.assign(east=frame["east"] + 1e-9))).refused["line"].size < 30
    whole = pc.Online(network(), MOTION, pc.AugmentedFilter(lag=0), calibration=tree)
    assert whole.update(dated(frame, "2027-03-01T00:00Z")).refused.empty


@pytest.mark.ci
@pytest.mark.parametrize("times", [lambda d: d, dated], ids=["seconds", "dates"])
def test_rows_that_a_stream_has_counted_are_refused_far_back(times, monkeypatch):
    monkeypatch.setattr("probcal.stream.online.RECENT", 8)
    frame, tree, lag = times(rows()), None, pc.AugmentedFilter(lag=4)
    for seen, counted in ((20, 0), (35, 20), (len(frame), 35)):  # each goes on where the last stood
        online = pc.Online(network(), MOTION, lag, calibration=tree, targets=3)
        found = pd.concat([online.update(frame.iloc[k : min(k + 6, seen)]).refused for k in range(0, seen, 6)])
        known = frame["time"][:seen] <= frame["time"][:counted].max() if counted else np.zeros(seen, bool)
        assert found["line"].tolist() == np.flatnonzero(known).tolist()
        tree = online.tree()
    other = frame.assign(east=frame["east"] + 1.0, north=frame["north"] + 1.0)
    assert pc.Online(network(), MOTION, lag, calibration=tree, targets=3).update(other).refused.empty


@pc.sensor(east=pc.Channel("m", 1.0, noise=pc.StudentT(4.0)), north=pc.Channel("m", 2.0, noise=pc.StudentT(4.0)))
def robust(target, pose, *, shift=pc.Bias("m", 2.0)):
    place = target.position - pose.position
    return {"east": place[0] + shift, "north": place[1]}


@pytest.mark.ci
@pytest.mark.parametrize("lag", [0, 16])
def test_rows_that_lie_far_off_do_not_throw_a_robust_filter_off(lag):
    network_ = pc.Network([robust.on(pc.Node(f"n{k}", (10.0 * k, 5.0))) for k in range(3)])
    for seed in range(4):
        run = pc.simulate(network_, MOTION["a"], np.arange(60.0), key=seed, outliers=0.05, outlier_scale=50.0)
        online = pc.Online(network_, MOTION["a"], pc.AugmentedFilter(lag=lag))
        tracks = [online.update(run.table.iloc[k : k + 30]).tracks for k in range(0, len(run.table), 30)]
        both = pd.concat([*tracks, online.finish().tracks]).merge(run.truth.tracks, on="time", suffixes=("", "_true"))
        away = np.hypot(both["position_x"] - both["position_x_true"], both["position_y"] - both["position_y_true"])
        assert len(both) == 60
        assert away.max() < 8.0
