"""Linear-Gaussian networks: every number of a fit equals that of the dense joint Gaussian of `reference`.

Stated tolerance: 1e-10 of the largest entry of a quantity (means, sds, covariances) and of the log evidence.
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
import reference
from scipy import stats

import probcal
from probcal import (
    Bias,
    Channel,
    ConstantVelocity,
    Drift,
    Network,
    Node,
    Path,
    RandomWalk,
    Static,
    Target,
    White,
    sensor,
)
from probcal.priors import Precision
from probcal.smoothing.mode import Point, find_mode

TOLERANCE = 1e-10
FALSE_ALARM = 1e-6  # of each statistical test below, all its comparisons together

fix = probcal.sensors.position


@sensor(level=Channel("dB", std=0.4))
def meter(target, pose, *, gain=Bias("dB", 2.0), common=Bias("dB", 0.7, nominal=3.0, shared="type")):
    line = target.position[0] - pose.position[0]
    return {"level": target.power + gain + 0.5 * common + 0.1 * line}


@sensor(arrival=Channel("m", std=0.5))
def pulse(target, pose):
    line = target.position[1] - pose.position[1]
    return {"arrival": 0.3 * line + 0.2 * target.velocity[0] + target.emission + pose.clock}


@sensor(difference=Channel("m", std=0.6), height=Channel("m", std=0.9))
def pair(target, first, second, *, difference_offset=Bias("m", 1.5)):
    shift = 0.7 * (second.position[0] - first.position[0]) - 0.2 * first.position[1]
    shift = shift + 0.4 * target.position[1]
    return {
        "difference": shift + second.clock - first.clock + difference_offset,
        "height": target.position[1] - 0.5 * second.position[1],
    }


def table_of(network, times, seed, missing=0.25, silent=None):
    """Every sensor sees every target at its times; random numbers, some blank, and one epoch without any."""
    random, rows = np.random.default_rng(seed), []
    for target, when in times.items():
        for t in when:
            for placed in network.sensors:
                names = [name for name, _ in placed.type.expand(network.dimension)]
                values = dict(zip(names, 4.0 * random.standard_normal(len(names)), strict=True))
                gone = random.uniform(size=len(names)) < missing
                if t == silent:
                    gone[:] = True
                rows.append(
                    {"time": t, "sensor": placed.name, "target": target}
                    | {name: np.nan if g else v for (name, v), g in zip(values.items(), gone, strict=True)}
                )
    return pd.DataFrame(rows)


def plane():
    """2-D, constant velocity of full rank, two targets of one motion, own noise levels in some rows."""
    nodes = [
        Node("a", (0.0, 1.0), 0.4, scale=2.0),
        Node("b", (5.0, -2.0), -1.3, scale=1.0),
        Node("c", (-3.0, 4.0), survey=0.5),
    ]
    network = Network([fix.on(node) for node in nodes])
    motion = Target(ConstantVelocity(0.8), start={"position": ((1.0, -1.0), 6.0), "velocity": (0.3, 1.5)})
    times = {"one": [0.0, 0.5, 1.5, 2.0, 4.0], "two": [0.2, 0.5, 2.0, 3.5]}
    table = table_of(network, times, 1, silent=2.0)
    row = np.arange(len(table))
    table["position_x_std"] = np.where(row % 3 == 0, 0.7 + 0.1 * row, np.nan)
    return network, motion, table, {}


def space():
    """3-D, singular constant velocity, known attitude, a survey, and biases fixed at non-zero values."""
    nodes = [
        Node("a", (0.0, 1.0, 2.0), 0.4, pitch=0.3, roll=-0.6, scale=2.0),
        Node("b", (5.0, -2.0, 0.0), -1.3, pitch=-0.2, roll=0.9, scale=1.0),
        Node("c", (-3.0, 4.0, 1.0), 2.0, survey=0.3),
    ]
    network = Network([fix.on(node) for node in nodes])
    start = {"position": (0.5, 4.0), "velocity": (0.0, 1.0)}
    motion = Target(ConstantVelocity(0.9, singular=True), start)
    table = table_of(network, {"one": [0.0, 1.0, 1.7, 3.0], "two": [1.0, 1.7, 2.0]}, 2, silent=1.7)
    return network, motion, table, {"a.position_x": 1.7, "b.position_z": -0.8}


def extras():
    """White emission and a drifting power, clocks, a bias shared by its type with a nominal value."""
    nodes = [
        Node("a", (0.0, 1.0), scale={"position": 2.0, "clock": 1.0}),
        Node("b", (5.0, -2.0), clock=0.5, scale={"clock": 2.0}),
        Node("c", (-3.0, 4.0), survey={"clock": 0.2}),
    ]
    placed = [fix.on(nodes[0], name="fix")]
    placed += [kind.on(node, name=f"{kind.name}_{node.name}") for kind in (meter, pulse) for node in nodes]
    network = Network(placed)
    moving = ConstantVelocity(0.8) + White("emission", "m", 3.0, mean=1.2)
    moving = moving + RandomWalk("power", "dB", 0.5, (4.0, 2.0))
    motion = Target(moving, start={"position": (0.5, 4.0), "velocity": (0.0, 1.0)})
    table = table_of(network, {"target": [0.0, 1.0, 1.7, 3.0, 3.2]}, 3, silent=1.7)
    return network, motion, table, {"meter_b.gain": 0.9}


def mixed():
    """Different motions (one static, two of one layout), a two-node sensor, a node on a known path."""
    path = Path([0.0, 2.0, 5.0], [(0.0, 0.0), (3.0, 1.0), (2.0, 6.0)], [0.0, 1.0, 4.0])
    robot = Node("robot", path=path, scale=1.2)
    box = Node("box", (5.0, -2.0), 0.7, scale={"position": Bias("m", 0.8), "clock": 1.0})
    network = Network([fix.on(robot), fix.on(box, name="box_fix"), pair.on(robot, box)])
    start = {"position": ((2.0, 1.0), 5.0), "velocity": (0.0, 1.0)}
    motion = {
        "walker": Target(ConstantVelocity(0.8), start),
        "car": Target(ConstantVelocity(0.7, singular=True), start),
        "rock": Target(Static(), {"position": (-1.0, 4.0)}),
    }
    times = {"walker": [0.0, 1.0, 2.5, 4.0], "rock": [0.5, 1.0, 3.0], "car": [0.1, 1.0, 2.6, 3.0]}
    table = table_of(network, times, 4)
    return network, motion, table, {}


def drifting():
    """Drifting position, survey, clock, gain and shared bias, each with times of its own; one step fixed."""
    walk, jumps = Drift((0.0, 1.0, 2.5), std=0.7), Drift((-5.0, 1.7), scale=1.3)
    nodes = [
        Node("a", (0.0, 1.0), scale={"position": Bias("m", 2.0, drift=walk), "clock": Bias("m", 1.0, drift=jumps)}),
        Node("b", (5.0, -2.0), survey={"position": Bias("m", 0.5, drift=Drift((0.0, 3.0), std=0.2)), "clock": 0.3}),
    ]

    @sensor(level=Channel("dB", std=0.4))
    def gauge(
        target,
        pose,
        *,
        gain=Bias("dB", 2.0, drift=Drift((0.0, 0.75, 1.7, 3.1), std=1.1)),
        common=Bias("dB", 0.7, nominal=3.0, shared="type", drift=Drift((0.0, 3.0), scale=0.4)),
    ):
        return {"level": target.position[0] + gain + 0.5 * common - 0.1 * pose.position[0]}

    network = Network([kind.on(n, name=f"{kind.name}_{n.name}") for kind in (fix, gauge, pulse) for n in nodes])
    motion = Target(
        ConstantVelocity(0.8) + White("emission", "m", 3.0), start={"position": (0.5, 4.0), "velocity": (0.0, 1.0)}
    )
    table = table_of(network, {"one": [0.0, 1.0, 1.7, 3.0, 3.2], "two": [0.5, 1.0, 2.0, 3.5]}, 5, silent=1.7)
    return network, motion, table, {"gauge_b.gain@1.7": 0.6}


DRAWN = ("plane", "mixed")
CASES = {make.__name__: make for make in (plane, space, extras, mixed, drifting)}


def resting(problem):
    """A start for a fit: trajectories without process noise, biases zero."""
    states = []
    for part in problem.system.recursions:
        x, track = np.zeros(part.drift.shape[1]), []
        for F, drift in zip(np.asarray(part.F), np.asarray(part.drift), strict=True):
            x = F @ x + drift
            track.append(x)
        states.append(np.array(track))
    zeros = tuple(np.zeros_like(x) for x in states)
    return Point(tuple(states), zeros, np.zeros(len(problem.labels)), np.zeros(0))


@cache
def solved(name):
    """A case with its naive form, its exact posterior, and its MAP fit."""
    network, motion, table, fixed = CASES[name]()
    linear = reference.Linear(network, motion, table, fixed)
    exact = reference.dense(linear, np.ones(len(linear.labels)))
    problem = probcal.Problem(network, motion, table, fix=fixed)
    prior, wanted = probcal.priors.Gaussian(), None if name in DRAWN else False
    tree = probcal.fit(problem, probcal.MAP(), prior=prior, start=resting(problem), predictive_draws=wanted)
    return linear, exact, problem, tree


def suffixes(dataset):
    """Suffixes of the recursions in a group: "", or "_0", "_1", ..."""
    return [str(n).removeprefix("epoch_target") for n in dataset.coords if str(n).startswith("epoch_target")]


def at(dataset, suffix, target, time):
    """Which epochs of a recursion are those of a target at a time."""
    owner, when = (dataset[f"epoch_{what}{suffix}"].values for what in ("target", "time"))
    return (owner == target) & (when == time)


def by_epoch(tree, linear, values, variable):
    """Pairs of a track variable of a fit and a flat vector of the reference, epoch by epoch."""
    track = tree["track"].to_dataset()
    found, offset = [], 0
    for chain in linear.chains:
        for time in chain.times:
            rows = [(s, e) for s in suffixes(track) for e in np.flatnonzero(at(track, s, chain.target, time))]
            assert len(rows) == 1
            s, e = rows[0]
            assert list(track[f"component{s}"].values) == chain.names
            found.append((track[f"{variable}{s}"].values[e], values[offset : offset + len(chain.names)]))
            offset += len(chain.names)
    assert offset == len(values)
    return np.concatenate([a for a, _ in found]), np.concatenate([b for _, b in found])


def close(found, expected, tolerance=TOLERANCE):
    found, expected = np.asarray(found), np.asarray(expected)
    assert found.dtype == np.float64
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance * np.abs(expected).max())


@pytest.mark.parametrize("name", CASES)
def test_reference_agrees_with_itself(name):
    """Loop Kalman filter with RTS smoother against the dense Gaussian: two naive forms, one answer."""
    linear, exact, _, _ = solved(name)
    evidence, smoothed = reference.kalman(linear, np.ones(len(linear.labels)))
    M = len(linear.labels)
    assert evidence == pytest.approx(exact.evidence, rel=1e-11)
    close(smoothed[0][0][:M], exact.z[0], 1e-9)
    close(smoothed[0][1][:M, :M], exact.z[1], 1e-9)
    close(np.concatenate([m[M:] for m, _ in smoothed]), exact.states[0], 1e-9)
    close(np.concatenate([np.sqrt(np.diag(P)[M:]) for _, P in smoothed]), exact.states[1], 1e-9)


@pytest.mark.parametrize("name", CASES)
def test_labels_and_scales(name):
    linear, _, problem, _ = solved(name)
    assert sorted(problem.labels) == sorted(linear.labels)
    assert dict(zip(problem.labels, problem.scales, strict=True)) == linear.scales


@pytest.mark.parametrize("name", CASES)
def test_biases(name):
    """Mean, sd, covariance and gamma = 1 - alpha Sigma of the biases."""
    linear, exact, _, tree = solved(name)
    mean, covariance = exact.z
    scales = np.array(list(linear.scales.values()))
    group = tree["calibration"].to_dataset().sel(bias_label=linear.labels, bias_label_other=linear.labels)
    close(group["mean"].values / scales, mean)
    close(group["sd"].values / scales, np.sqrt(np.diag(covariance)))
    close(group["covariance"].values / np.outer(scales, scales), covariance)
    close(group["gamma"].values, 1 - np.diag(covariance))
    close(group["information"].values, np.linalg.inv(covariance) - np.eye(len(mean)))
    half = stats.norm.ppf(0.5 + tree.attrs["interval_probability"] / 2) * group["sd"].values
    close(group["upper"].values - group["mean"].values, half, 1e-9)
    assert tree.attrs["status"] == "converged"


@pytest.mark.parametrize("name", CASES)
def test_tracks(name):
    """Mean and sd of every state, biases integrated out; and the mean without calibration (z held at 0)."""
    linear, exact, _, tree = solved(name)
    close(*by_epoch(tree, linear, exact.states[0], "mean"))
    close(*by_epoch(tree, linear, exact.states[1], "sd"))
    held = reference.dense(linear, None, hold=np.zeros(len(linear.labels)))
    close(*by_epoch(tree, linear, held.states[0], "before"))


@pytest.mark.parametrize("name", CASES)
def test_evidence(name):
    """log p(data | alpha) with all its normalising constants."""
    _, exact, _, tree = solved(name)
    assert tree.attrs["log_evidence"] == pytest.approx(exact.evidence, rel=TOLERANCE)


@pytest.mark.parametrize("name", ["plane", "mixed"])
def test_iterating_changes_nothing(name):
    """On a linear model one step reaches the mode and thirty leave it there: a datum counts once."""
    _, exact, problem, _ = solved(name)
    with jax.enable_x64(True):
        alpha = Precision.single(jnp.ones(len(problem.labels)))
        start = jax.tree.map(jnp.asarray, resting(problem))
        one = find_mode(problem.spec, problem.system, start, alpha, 1, 0.0)
        many = find_mode(problem.spec, problem.system, start, alpha, 30, 0.0)
    assert float(many.cost) == pytest.approx(float(one.cost), rel=1e-12)
    order = [problem.labels.index(label) for label in solved(name)[0].labels]
    for mode in (one, many):
        close(np.asarray(mode.point.z)[order], exact.z[0])
    for once, often in zip(one.point.states, many.point.states, strict=True):
        close(np.asarray(often), np.asarray(once))


@pytest.mark.parametrize("name", DRAWN)
def test_draws(name):
    """Joint draws of biases and states have the exact moments: z-tests with 1e-6 false alarms altogether.

    Whitened by the exact covariance (its range, where the process noise is singular), the draws are standard
    normal: means, variances and all correlations are compared.
    """
    linear, exact, _, tree = solved(name)
    posterior = tree["posterior"].to_dataset()
    scales = np.array(list(linear.scales.values()))
    columns = [posterior["bias"].sel(bias_label=linear.labels).values.reshape(1000, -1) / scales]
    for chain in linear.chains:
        for time in chain.times:
            for s in suffixes(posterior):
                mine = at(posterior, s, chain.target, time)
                if mine.any():
                    columns.append(posterior[f"state{s}"].values[:, :, mine].reshape(1000, -1))
    draws = np.concatenate(columns, 1)
    assert draws.shape == (1000, len(exact.mean))
    values, vectors = np.linalg.eigh(exact.covariance)
    solid = values > 1e-9 * values.max()
    assert np.abs((draws - exact.mean) @ vectors[:, ~solid]).max(initial=0.0) < 1e-3 * np.sqrt(values.max())
    white = (draws - exact.mean) @ vectors[:, solid] / np.sqrt(values[solid])
    n, d = white.shape
    pairs = d * (d - 1) // 2
    limit = stats.norm.isf(FALSE_ALARM / (2 * (2 * d + pairs)))
    assert np.abs(white.mean(0) * np.sqrt(n)).max() < limit
    probability = stats.chi2(n).cdf((white**2).sum(0))
    assert np.abs(stats.norm.ppf(probability)).max() < limit
    products = (white.T @ white / np.sqrt(n))[np.triu_indices(d, 1)]
    assert np.abs(products).max() < 1.1 * limit  # a product of normals has heavier tails than a normal


@pytest.fixture(scope="module")
def learnt():
    """EA on the plane network with one bias that is plainly there and others that are not."""
    network, motion, table, _ = plane()
    table = table_of(network, {"one": [0.0, 0.5, 1.5, 2.0, 4.0], "two": [0.2, 0.5, 2.0, 3.5]}, 7, missing=0.0)
    table.loc[table["sensor"] == "a", "position_x"] += 8.0
    problem = probcal.Problem(network, motion, table)
    method = probcal.EA(iterations=2000, tolerance=1e-11)
    tree = probcal.fit(problem, method, start=resting(problem), predictive_draws=False)
    return reference.Linear(network, motion, table), tree


def test_ea_fixed_point(learnt):
    """Where EA stops, alpha = gamma / z^2 for every kept bias, at the exact posterior for that alpha."""
    linear, tree = learnt
    group = tree["calibration"].to_dataset().sel(bias_label=linear.labels)
    alpha = group["precision"].values
    exact = reference.dense(linear, alpha)
    mean, covariance = exact.z
    gamma = 1 - alpha * np.diag(covariance)
    scales = np.array(list(linear.scales.values()))
    np.testing.assert_allclose(group["mean"].values / scales, mean, rtol=0, atol=1e-9)
    np.testing.assert_allclose(group["gamma"].values, gamma, rtol=0, atol=1e-9)
    assert tree.attrs["log_evidence"] == pytest.approx(exact.evidence, rel=TOLERANCE)
    status = group["status"].values
    assert {"estimated", "pruned", "survey"} >= set(status)
    kept = status == "estimated"
    assert kept.any(), "the case must hold a kept bias"
    assert (status == "pruned").any(), "the case must hold a pruned bias"
    np.testing.assert_allclose(alpha[kept], gamma[kept] / mean[kept] ** 2, rtol=1e-4)
    assert (alpha[status == "survey"] == 1).all()


def test_ea_maximises_the_evidence(learnt):
    """The dense evidence falls when log alpha of a kept bias moves, quadratically and to both sides."""
    linear, tree = learnt
    group = tree["calibration"].to_dataset().sel(bias_label=linear.labels)
    alpha, top = group["precision"].values, tree.attrs["log_evidence"]
    for m in np.flatnonzero(group["status"].values == "estimated"):
        drops = []
        for step in (-0.3, 0.3):
            moved = alpha.copy()
            moved[m] *= np.exp(step)
            drops.append(top - reference.dense(linear, moved).evidence)
        assert min(drops) > 1e-4
        assert max(drops) < 3 * min(drops)
    for m in np.flatnonzero(group["status"].values == "pruned"):
        moved = alpha.copy()
        moved[m] = 1.0
        assert reference.dense(linear, moved).evidence < top


def test_track_applies_a_calibration():
    """Tracks with a calibration: biases held at its means, its covariance carried into the sd."""
    linear, exact, problem, tree = solved("plane")
    tracked = probcal.track(problem, tree)
    mean, covariance = exact.z
    held = reference.dense(linear, None, hold=mean)
    moved = [reference.dense(linear, None, hold=mean + unit).states[0] for unit in np.eye(len(mean))]
    response = np.stack(moved, 1) - held.states[0][:, None]
    close(*by_epoch(tracked, linear, held.states[0], "mean"))
    spread = np.sqrt(held.states[1] ** 2 + np.einsum("em,mk,ek->e", response, covariance, response))
    close(*by_epoch(tracked, linear, spread, "sd"))
