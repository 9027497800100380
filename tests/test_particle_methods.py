"""Methods whose trajectories are particles: EM, particle Gibbs and tracks, against exact answers and on roads."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
import reference
import worlds
import xarray as xr

import probcal
from probcal import (
    EM,
    EMEA,
    NUTS,
    Channel,
    ConstantVelocity,
    Gaussian,
    InputError,
    LeavingRoad,
    Network,
    Node,
    ParticleGibbs,
    Particles,
    Problem,
    RandomWalk,
    Road,
    RoadNetwork,
    Target,
    Unknown,
    White,
    fit,
    particle_filter,
    sensor,
    simulate,
    track,
)
from probcal.inference.loop import Trace
from probcal.inference.run import given_of
from probcal.particles.em import Wandering, wandering
from probcal.particles.ensemble import ensemble, nearest_states
from probcal.particles.targets import targets_of
from probcal.particles.weighted import SD_ERROR, Ended, Paths, conclude_particles, louis, regressed_scores, score_slope
from probcal.plots import plot_particles, plot_roads
from probcal.plots.base import write_figure

pytest.importorskip("cuthbert", reason="cuthbert is not installed: uv sync --extra particles")
pytest.importorskip("shapely", reason="shapely is not installed: uv sync --extra roads")
ROOT = Path(__file__).parents[1]
TIME = np.arange(12.0)
START = {"position": ((0.0, 0.0), 2.0), "velocity": ((2.0, 1.0), 0.5)}
MOTION = Target(ConstantVelocity(0.5), START)
STREET = RoadNetwork.from_lines({"street": [(-200.0, 0.0), (300.0, 0.0)]}, oneway=("street",))


@sensor(place=Channel("m", std=0.5, per_axis=True))
def relative(target, pose):
    """Where a target is, seen from a node: linear in both."""
    return {"place": target.position - pose.position}


def offsets():
    """A network whose posterior is Gaussian: two nodes at unknown places, one known."""
    nodes = [Node("known", (0.0, 0.0)), *(Node(name, (0.0, 0.0), scale=3.0) for name in "ab")]
    return Network([relative.on(node) for node in nodes])


@pytest.fixture(scope="module")
def linear():
    """A linear problem of one target, and the exact answer."""
    network = offsets()
    run = simulate(network, MOTION, TIME, key=3)
    problem = Problem(network, MOTION, run.table)
    return problem, fit(problem, probcal.MAP(), prior=Gaussian())


def same(found, exact, *, shift, ratio):
    """Means within `shift` sd of the exact ones, sds within a `ratio`."""
    mine, theirs = found["calibration"].to_dataset(), exact["calibration"].to_dataset()
    assert (np.abs(mine["mean"] - theirs["mean"]) < shift * theirs["sd"]).all()
    assert (np.abs(np.log(mine["sd"] / theirs["sd"])) < np.log(ratio)).all()


@pytest.mark.ci
def test_a_climb_of_all_iterations_that_a_limit_stops_has_not_converged(monkeypatch):
    """The biases may only scatter by then, but more iterations were asked for."""
    monkeypatch.setattr("probcal.particles.em.wandering", lambda *_: Wandering(True, 0, 0.0))
    problem, method = worlds.linear("plane")[0], EM(Particles(20), iterations=60, tolerance=0.0)
    found = fit(problem, method, prior=Gaussian(), start=worlds.resting(problem), limit=1e-9)
    assert found.attrs["status"] == "not converged"
    assert "Ended by the limit of 1e-09 s after 5 iterations" in found.attrs["message"]


@pytest.mark.slow
@pytest.mark.parametrize("m_step", ["averaged", "mean", "paths"])
def test_em_by_particles_ends_where_the_exact_answer_is(linear, m_step):
    """One run of 60 iterations each; the noise of 400 particles is below 0.1 sd, the limit three times that."""
    problem, exact = linear
    found = fit(problem, EM(Particles(400, m_step=m_step), iterations=60, tolerance=0.0), prior=Gaussian())
    assert found.attrs["status"] in ("converged", "iterations spent")
    same(found, exact, shift=0.3, ratio=1.2)
    assert abs(found.attrs["log_evidence"] - exact.attrs["log_evidence"]) < 0.5
    mine, theirs = (tree["track/target"].to_dataset() for tree in (found, exact))
    assert (np.abs(mine["mean"] - theirs["mean"]) < 0.4 * theirs["sd"]).all()
    assert (np.abs(np.log(mine["sd"] / theirs["sd"])) < np.log(1.4)).all()
    assert np.isfinite(found["log_likelihood"]["y"].values).all()


def ended_at(problem, away, how):
    """Mean and covariance of the exact answer in units of the scales; what is said some sd away from it."""
    group, scale = fit(problem, probcal.MAP(), prior=Gaussian())["calibration"].to_dataset(), 3.0
    mean, covariance = group["mean"].values / scale, group["covariance"].values / scale**2
    z = mean + away * np.sqrt(np.diag(covariance))
    method, prior = EM(how), Gaussian()
    with jax.enable_x64(True):
        given, levels = given_of(method, problem, prior), np.zeros(len(problem.levels))
        trace = Trace(np.zeros(1), z[None], np.ones_like(z)[None])
        ended = Ended(jnp.asarray(z), jnp.asarray(levels), given.prior.alpha, trace, True, "")
        targets, key = targets_of(problem.model), jax.random.key(2)
        told = louis(Paths(problem, how, targets), z, levels, key)
        return mean, covariance, z, told, conclude_particles(problem, method, how, prior, given, targets, ended, key)


@pytest.mark.ci
@pytest.mark.parametrize(("away", "status"), [(0.0, "converged"), (2.0, "not converged")])
def test_where_a_climb_is_not_at_the_top_its_slope_says_so(linear, away, status):
    """Eight filters of 400 particles: score and information exact within a fifth, and the status with them."""
    problem, _ = linear
    mean, covariance, z, told, answer = ended_at(problem, away, Particles(400))
    curvature, sd = np.linalg.inv(covariance), np.sqrt(np.diag(covariance))
    assert np.abs((told.score - z + curvature @ (z - mean)) * sd).max() < 0.6
    assert np.abs(sd[:, None] * (told.information - curvature + np.eye(len(sd))) * sd).max() < 0.25
    assert str(answer.status) == status
    assert ("asks for a step of" in answer.message) == (away > 0)


def test_sds_of_em_by_particles_are_the_exact_ones_whatever_the_key(linear):
    """Six keys of four biases: ratios within 15 %, 2.5 of the largest error stated; false alarms below 1e-2."""
    problem, exact = linear
    group, levels = exact["calibration"].to_dataset(), np.zeros(0)
    z, sd = group["mean"].values / 3.0, group["sd"].values / 3.0
    with jax.enable_x64(True):
        paths = Paths(problem, Particles(400), targets_of(problem.model))
        for key in map(jax.random.key, range(6)):
            found = score_slope(paths, louis(paths, z, levels, key), np.eye(4), z, levels, key)
            ratio = np.sqrt(np.diag(np.linalg.inv(found.information + np.eye(4)))) / sd
            assert (np.abs(np.log(ratio)) < np.log(1.15)).all()
            assert (found.sd_error <= SD_ERROR).all()


def test_sds_that_filters_leave_open_are_said_to_be(linear, monkeypatch):
    problem, _ = linear
    monkeypatch.setattr("probcal.particles.weighted.SD_ERROR", 1e-4)
    monkeypatch.setattr("probcal.particles.weighted.FILTERED", 16)
    answer = ended_at(problem, 0.0, Particles(400))[-1]
    assert str(answer.status) == "not converged"
    assert "after 16 filters: take more particles" in answer.message


def test_the_error_of_an_sd_is_that_of_a_regression_and_lost_filters_count_less():
    """200 regressions of 24 scores on places: the scatter of the sds is the error stated, within a fifth."""
    rng, information = np.random.default_rng(0), np.array([[4.0, 1.0], [1.0, 2.0]])
    ratios, errors = [], []
    for _ in range(200):
        away = rng.normal(size=(24, 2))
        scores = -away @ information + rng.normal(size=(24, 2))
        scores[0], logs = 1e4, np.r_[-1e4, rng.normal(size=23)]
        found = regressed_scores(away, scores, logs, np.eye(2))
        ratios.append(np.diag(np.linalg.inv(found.information + np.eye(2))))
        errors.append(found.sd_error)
    sd, exact = np.sqrt(ratios), np.sqrt(np.diag(np.linalg.inv(information + np.eye(2))))
    np.testing.assert_allclose(np.median(sd, 0), exact, rtol=0.05)
    np.testing.assert_allclose(np.median(errors, 0), np.std(np.log(sd), 0), rtol=0.25)


def test_a_trace_that_drifts_is_not_still():
    """A line or an approach that has some sd to go is none, whatever its pace; noise about a place is."""
    k, noise = np.arange(60.0)[:, None], np.random.default_rng(0).normal(size=(60, 3))
    assert wandering(0.3 * noise, np.ones(3)).still
    for trace in (0.1 * k, 10.0 * k, -20.0 * np.exp(-k / 20.0), 0.5 * k + 0.3 * noise[:, :1]):
        assert not wandering(np.hstack([0.3 * noise[:, :2], trace * np.ones(1)]), np.ones(3)).still


@pytest.mark.ci
def test_particles_that_collapsed_are_not_called_converged(linear):
    """A bootstrap filter of few particles under very sharp rows, by `track` and by `particle_filter`."""
    kind = replace(relative, channels={"place": replace(relative.channels["place"], std=0.1)})
    network = Network([kind.on(Node("known", (0.0, 0.0)))])
    problem = Problem(network, MOTION, simulate(network, MOTION, TIME, key=1).table)
    few = Particles(50, proposal="bootstrap")
    for tree in (track(problem, calibrated(problem), smoother=few), particle_filter(problem, few, runs=4)):
        assert tree.attrs["status"] == "not converged"
        assert "more particles" in tree.attrs["message"]
    assert tree.attrs["log_likelihood_se"] > 0.5
    assert track(problem, calibrated(problem), smoother=Particles(400)).attrs["status"] == "converged"


def test_the_first_path_is_a_draw_like_any_other():
    """One particle that has nearly all the weight stands first as often as it has weight: 400 keys, limit five sd."""
    network = Network([relative.on(Node("known", (0.0, 0.0)))])
    problem = Problem(network, MOTION, simulate(network, MOTION, np.arange(2.0), key=1).table)
    with jax.enable_x64(True):
        model, targets, z = problem.model, targets_of(problem.model), np.zeros(0)

        @jax.jit
        def ends(keys):
            how = Particles(40, proposal="bootstrap")
            return jax.lax.map(lambda k: ensemble(model, targets, z, z, k, how).states[0][-1, :, 0], keys)

        last = np.asarray(ends(jax.random.split(jax.random.key(0), 400)))
    rest, first = last.mean(1), last[:, 0]
    spread = np.sqrt(((last - rest[:, None]) ** 2).mean(1))
    z = (first - rest) / np.maximum(spread, 1e-9)
    assert abs(z.mean()) < 5 / np.sqrt(400)
    assert 0.7 < (z**2).mean() < 1.35


@pytest.mark.ci
def test_the_state_that_stands_for_particles_on_a_road_is_like_them_in_all_it_is():
    """Not only in its place: no further, in sd, than particles are on average, however uneven their weights."""
    network, motion = offsets(), crossing("road")
    model = Problem(network, motion, simulate(network, motion, TIME, key=4).table).model
    with jax.enable_x64(True):
        found = ensemble(
            model, targets_of(model), np.zeros(model.biases), np.zeros(0), jax.random.key(0), Particles(60)
        )
        drawn = np.random.default_rng(0).gumbel(size=found.weights[0].shape) * 40.0
        weights = np.exp(drawn - np.logaddexp.reduce(drawn, axis=1, keepdims=True))
        found = found._replace(weights=(jnp.asarray(weights),))
        seen = np.stack([np.asarray(model.vectors(0, jax.tree.map(lambda a, k=k: a[:, k], found.states[0])))
                         for k in range(60)], 1)  # fmt: skip
        mean = np.einsum("en,enu->eu", weights, seen)
        variance = np.einsum("en,enu->eu", weights, (seen - mean[:, None]) ** 2)
        off = np.asarray(model.vectors(0, nearest_states(model, found)[0])) - mean
    assert (np.sum(off**2 / np.maximum(variance, 1e-12), 1) <= mean.shape[1] + 1e-6).all()


@pytest.mark.slow
def test_particle_gibbs_draws_the_exact_posterior(linear):
    problem, exact = linear
    found = fit(problem, ParticleGibbs(chains=2, warmup=100, draws=500, particles=Particles(60)), prior=Gaussian())
    assert found.attrs["status"] == "converged"
    same(found, exact, shift=0.3, ratio=1.25)
    stats = found["sample_stats"].to_dataset()
    assert float(stats["renewed"].mean()) > 0.8
    assert float(stats["acceptance_rate"].mean()) > 0.2


@pytest.mark.slow
def test_a_run_of_particle_gibbs_goes_on_where_it_was_stopped(linear, tmp_path):
    """The draws of a run in two pieces are those of one run."""
    problem, _ = linear
    method = ParticleGibbs(chains=1, warmup=25, draws=75, particles=Particles(20), patience=1)
    whole = fit(problem, method, prior=Gaussian(), key=5)

    class Stopped(Exception):
        pass

    def stop(step):
        if step.done >= 50:
            raise Stopped

    with pytest.raises(Stopped):
        fit(problem, method, prior=Gaussian(), key=5, store=tmp_path / "draws", progress=stop)
    again = fit(problem, method, prior=Gaussian(), key=5, store=tmp_path / "draws", resume=True)
    np.testing.assert_array_equal(whole["posterior"]["bias"], again["posterior"]["bias"])


@pytest.mark.ci
def test_em_ea_by_particles_prunes_what_is_zero(linear):
    problem, _ = linear
    found = fit(problem, EMEA(Particles(100), iterations=20))
    assert found.attrs["precisions"] == "maximised"
    assert ((found["calibration"]["gamma"] >= 0) & (found["calibration"]["gamma"] <= 1)).all()


@pytest.mark.slow
def test_an_unknown_noise_level_is_found_by_particles():
    """sd of a level from 24 data of two axes and three sensors is 9 %; limits four of them, false alarms below 1e-3."""
    network, motion = offsets(), Target(ConstantVelocity(Unknown(0.2, 5.0)), START)
    run = simulate(network, MOTION, np.arange(40.0), key=1)
    problem = Problem(network, motion, run.table)
    methods = (EM(Particles(200), iterations=80, tolerance=0.0), EM())
    by_particles, exact = (float(fit(problem, m, prior=Gaussian())["level"]["std"][0]) for m in methods)
    assert 0.3 < by_particles < 0.8, "0.5 is true, 0.2 was guessed"
    assert abs(np.log(by_particles / exact)) < 0.3


@pytest.mark.ci
def test_filtered_and_smoothed_particles_are_a_tree(linear, tmp_path):
    """Weights sum to one, means are those of the smoother, and the likelihood is exact within four of its errors."""
    problem, exact = linear
    tree = particle_filter(problem, Particles(2000, smoother="marginal"), calibration=exact, runs=16)
    assert tree.attrs["status"] == "converged"
    for kind in ("filtered", "smoothed"):
        group = tree[f"{kind}/target"].to_dataset()
        np.testing.assert_allclose(group["weight"].sum("particle"), 1.0)
        assert group["state"].dims == ("particle", "time", "component")
    mean = (group["state"] * group["weight"]).sum("particle").transpose("time", "component")
    track_there = exact["track/target"].to_dataset()
    assert (np.abs(mean - track_there["mean"]) < 0.3 * track_there["sd"]).all()
    held = Problem(problem.network, problem.motion, problem.measurements.table.frame,
                   fix=exact["calibration"]["mean"].to_series().to_dict())  # fmt: skip
    naive = reference.Linear(held.network, {"target": MOTION}, held.measurements.table.frame, held.fixed)
    evidence = reference.dense(naive, None, hold=np.zeros(len(naive.labels))).evidence
    assert abs(tree.attrs["log_likelihood"] - evidence) < 4 * tree.attrs["log_likelihood_se"] + 1e-6
    assert 0 < tree.attrs["log_likelihood_se"] < 0.3
    axes = plot_particles(tree, times=[0.0, 5.0, 11.0], roads=CROSS, kind="filtered")
    plot_roads(STREET, axes[0], names=True)
    write_figure(axes[0].get_figure(), tmp_path / "particles.png", 60)
    assert (tmp_path / "particles.png").stat().st_size > 5000


def calibrated(problem):
    """What `track` reads of a fit: biases of zero, known."""
    labels, M = list(problem.labels), len(problem.labels)
    values = {
        "mean": ("bias_label", np.zeros(M)),
        "covariance": (("bias_label", "bias_label_other"), np.zeros((M, M))),
    }
    group = xr.Dataset(values, {"bias_label": labels, "bias_label_other": labels})
    return xr.DataTree.from_dict({"calibration": group, "constant_data": xr.Dataset()})


def smoothed_along(measured, std, noise, place, pace):
    """Mean and sd of place and speed along a line by the information matrix of all epochs, one second apart."""
    K, Q = len(measured), noise**2 * np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]])
    F, J, b = np.array([[1.0, 1.0], [0.0, 1.0]]), np.zeros((2 * K, 2 * K)), np.zeros(2 * K)
    J[:2, :2] += np.diag([1 / place[1] ** 2, 1 / pace[1] ** 2])
    b[:2] += [place[0] / place[1] ** 2, pace[0] / pace[1] ** 2]
    for k in range(K - 1):
        step = np.hstack([-F, np.eye(2)])
        J[2 * k : 2 * k + 4, 2 * k : 2 * k + 4] += step.T @ np.linalg.inv(Q) @ step
    J[::2, ::2] += np.eye(K) / std**2
    b[::2] += measured / std**2
    P = np.linalg.inv(J)
    return (P @ b).reshape(K, 2), np.sqrt(np.diag(P)).reshape(K, 2)


@pytest.mark.ci
def test_a_road_of_one_long_edge_is_smoothed_as_a_line():
    """Mean and sd of place and speed against the Gaussian of all epochs; 4,000 particles, limits 0.15 sd and 12 %."""
    motion = Road(STREET, std=0.4, speed=(3.0, 0.5), position=((0.0, 0.0), 2.0))
    network = Network([relative.on(Node("known", (0.0, 0.0)))])
    run = simulate(network, motion, TIME, key=2)
    problem = Problem(network, motion, run.table)
    tree = track(problem, calibrated(problem), smoother=Particles(4000))
    assert tree.attrs["status"] == "converged"
    found = tree["track/target"].to_dataset()
    x = run.table.sort_values("time")["place_x"].to_numpy(float)
    mean, sd = smoothed_along(x, relative.channels["place"].std, 0.4, (0.0, 2.0), (3.0, 0.5))
    for j, component in enumerate(("position_x", "velocity_x")):
        mine = found.sel(component=component)
        assert (np.abs(mine["mean"] - mean[:, j]) < 0.15 * sd[:, j]).all()
        assert (np.abs(np.log(mine["sd"] / sd[:, j])) < np.log(1.12)).all()
    np.testing.assert_allclose(found["mean"].sel(component="position_y"), 0.0, atol=1e-9)


CROSS = RoadNetwork.from_lines({
    "west": [(-60.0, 0.0), (0.0, 0.0)], "east": [(0.0, 0.0), (60.0, 5.0)], "north": [(0.0, 0.0), (5.0, 60.0)],
    "south": [(0.0, -60.0), (0.0, 0.0)],
})  # fmt: skip


def crossing(kind):
    """A target that comes from the west, with a power beside it, on the road or free to leave it."""
    road = Road(CROSS, std=0.3, speed=(4.0, 0.5), position=((-40.0, 0.0), 2.0))
    return (road if kind == "road" else LeavingRoad(road, 0.5, 0.05, 0.05)) + RandomWalk("power", "dB", 0.5, (4.0, 2.0))


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind", [pytest.param("leaving", marks=pytest.mark.slow), pytest.param("road", marks=pytest.mark.slow)]
)
def test_a_network_is_calibrated_from_targets_on_roads(kind):
    """Two targets at times of their own; the places of two sensors, 3 sd about the truth (NEES below 3 in 1e-4)."""
    network = offsets()
    schedule = pd.DataFrame(
        [(t + 0.3 * k, name, s.name) for k, name in enumerate(("one", "two")) for t in np.arange(18.0 + k)
         for s in network.sensors], columns=["time", "target", "sensor"],
    )  # fmt: skip
    biases = {"a.position_x": 3.0, "a.position_y": -2.0, "b.position_x": 0.0, "b.position_y": 4.0}
    motions = {name: crossing(kind) for name in ("one", "two")}
    run = simulate(network, motions, [0.0], key=1, biases=biases, schedule=schedule)
    problem = Problem(network, motions, run.table)
    found = fit(problem, EM(Particles(200), iterations=60), prior=Gaussian())
    assert found.attrs["status"] == "converged", found.attrs["message"]
    group = found["calibration"].to_dataset()
    error = group["mean"].values - np.array([run.truth.biases[label] for label in problem.labels])
    assert error @ np.linalg.solve(group["covariance"].values, error) / len(error) < 6.0
    assert (group["sd"] < 1.0).all(), "the rows say where they are"
    tracks = probcal.tracks(found)
    assert list(tracks.columns[:4]) == ["time", "target", "power", "power_sd"]
    if kind == "road":
        _, _, away = CROSS.nearest(run.truth.tracks[["position_x", "position_y"]].to_numpy(float))
        assert away.max() < 1e-6


def test_a_target_that_no_road_explains_has_a_status():
    network, far = Network([relative.on(Node("known", (0.0, 0.0)))]), np.arange(8.0)
    table = pd.DataFrame({"time": far, "sensor": "known", "place_x": 4.0 * far, "place_y": 300.0 + far})
    problem = Problem(network, Road(CROSS, std=0.3, speed=(4.0, 0.5)), table)
    tree = track(problem, calibrated(problem), smoother=Particles(200))
    assert tree.attrs["status"] == "misfit"
    assert 'No path of target "target" explains its rows' in tree.attrs["message"]
    assert np.isfinite(tree["track/target"]["mean"].values).all()


def unexplained():
    """Rows far from every road."""
    rows = [(t, s, 4.0 * t, 300.0 + t) for t in np.arange(8.0) for s in ("known", "a", "b")]
    table = pd.DataFrame(rows, columns=["time", "sensor", "place_x", "place_y"])
    return Problem(offsets(), Road(CROSS, std=0.3, speed=(4.0, 0.5)), table)


@pytest.mark.ci
def test_em_by_particles_says_where_nothing_explains_the_rows():
    problem = unexplained()
    tree = fit(problem, EM(Particles(100), iterations=10), prior=Gaussian())
    assert tree.attrs["status"] == "misfit"


@pytest.mark.slow
def test_particle_gibbs_says_where_nothing_explains_the_rows():
    problem = unexplained()
    tree = fit(problem, ParticleGibbs(chains=1, warmup=0, draws=25, particles=Particles(20)), prior=Gaussian())
    assert tree.attrs["status"] == "misfit"


def test_later_rows_of_a_road_may_not_lie_further_apart():
    network = Network([relative.on(Node("known", (0.0, 0.0)))])
    table = pd.DataFrame({"time": TIME, "sensor": "known", "place_x": TIME, "place_y": 0.0})
    problem = Problem(network, crossing("road"), table[table["time"] < 6])
    assert problem.later(table[table["time"] == 6]).time.shape == (1,)
    with pytest.raises(InputError, match="later: 3 s pass between two epochs, more than the 1 s"):
        problem.later(table[table["time"] == 8])


ERRORS = [
    (lambda p: track(p, calibrated(p), smoother="particles"), "smoother is the text .* as in Particles\\(2000\\)"),
    (lambda p: particle_filter(p, 100), "particle_filter: particles is of type int"),
    (lambda p: particle_filter(p, runs=1), "at least 2 filters give an error"),
    (lambda p: EM("particles"), "Cubature\\(\\) or Particles\\(500\\)"),
    (lambda p: ParticleGibbs(particles=200), r"ParticleGibbs\(particles=200\): give settings such as Particles"),
    (lambda p: ParticleGibbs(steps=0), "ParticleGibbs\\(steps=0\\): it must be at least 1"),
    (lambda p: fit(Problem(p.network, Target(ConstantVelocity(0.5) + White("power", "dB", Unknown(1.0)), START), p.
                   measurements.table.frame), EM(Particles(50))),
     "particles do not learn the level of a noise without memory"),
    (lambda p: fit(Problem(p.network, Target(ConstantVelocity(0.5, singular=True), START), p.measurements.table.frame),
                   ParticleGibbs()), "the motion has no density: its noise"),
]  # fmt: skip


@pytest.mark.parametrize(("call", "text"), ERRORS, ids=[text[:30] for _, text in ERRORS])
def test_what_particles_cannot_is_said(linear, call, text):
    with pytest.raises(InputError, match=text):
        call(linear[0])


@pytest.mark.slow
def test_particle_gibbs_and_nuts_agree_on_yes_and_no():
    """Presence sensors beside a way: means within 0.35 sd, sds within 20 %, of some hundred effective draws each."""
    sys.path.insert(0, str(ROOT / "models"))
    import presence

    nodes = [Node(f"p{k}", (4.0 * k, 2.0 * (-1) ** k), scale=2.0) for k in (1, 2, 3)]
    gates = [Node("g", (0.0, 10.0)), Node("h", (16.0, -10.0))]
    network = Network([*(presence.presence.on(n) for n in nodes), *(presence.gate.on(n) for n in gates)])
    motions = {name: Target(ConstantVelocity(0.3), {"position": ((0.0, 0.0), 1.0), "velocity": ((1.4, 0.0), 0.2)})
               for name in ("one", "two")}  # fmt: skip
    problem = Problem(network, motions, simulate(network, motions, TIME, key=0).table)
    gibbs = fit(problem, ParticleGibbs(chains=2, warmup=200, draws=1500, particles=Particles(50)), prior=Gaussian())
    nuts = fit(problem, NUTS(chains=2, draws=500), prior=Gaussian())
    same(gibbs, nuts, shift=0.35, ratio=1.2)


@pytest.mark.slow
def test_the_command_line_fits_and_tracks_by_particles(tmp_path):
    model = str(ROOT / "models" / "road_microphones.py")
    base = [sys.executable, "-m", "probcal.cli"]
    done = subprocess.run(
        [*base, "fit", model, "--set", "motion=road", "--method", "em-particles", "--out", str(tmp_path / "fit")],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "EM (Gaussian): converged" in done.stdout
    out = tmp_path / "tracks.csv"
    done = subprocess.run(
        [*base, "track", model, "--set", "motion=road", "--calibration", str(tmp_path / "fit"), "--smoother",
         "particles", "--out", str(out)], capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert len(pd.read_csv(out)) == 30
    done = subprocess.run(
        [*base, "track", model, "--calibration", str(tmp_path / "fit"), "--smoother", "particle"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert '--smoother "particle" is not known' in done.stderr


@pytest.mark.slow
def test_a_study_takes_methods_by_particles_and_refuses_others_on_roads():
    sys.path.insert(0, str(ROOT / "models"))
    import road_microphones

    method = EM(Particles(60), iterations=10, tolerance=0.0)
    found = probcal.study(road_microphones.setting, {"motion": ["road"]}, {"em": (method, Gaussian())}, runs=2)
    assert found.sizes["run"] == 2
    assert np.isfinite(found["bias_rmse"]).all()
    with pytest.raises(InputError, match="which has no linear form"):
        probcal.study(road_microphones.setting, {"motion": ["road"]}, ("em",), runs=1)
