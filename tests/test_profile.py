"""Mixtures along ridges and over two sides of tracks, beside exact posteriors and the truth."""

from dataclasses import replace
from unittest.mock import patch

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
import scipy.stats

import probcal
from probcal import (
    MAP,
    Bias,
    Channel,
    ConstantVelocity,
    Gaussian,
    Network,
    Node,
    Problem,
    RandomWalk,
    Target,
    sensor,
)
from probcal.geometry import norm
from probcal.inference import profile
from probcal.results.modes import rivals

PLACES = np.array([(-3.0, -3.0), (3.0, -3.0), (-3.0, 3.0), (3.0, 3.0)])
HEIGHTS = np.array([1.54, 1.60, 1.66, 1.58])
NOISE, SCALE = 0.05, 0.3


@sensor(range=Channel("m", std=NOISE))
def slant(target, pose, *, range_offset=Bias("m", SCALE)):
    """Range to a target whose height is a state of its own."""
    away = target.position - pose.position
    return dict(range=jnp.hypot(norm(away), target.height - pose.height) + range_offset)


def recording(nodes, path, times, height, offsets, seed):
    """The network and its rows of ranges to a path (T, 2) at one height."""
    rng = np.random.default_rng(seed)
    network = Network([slant.on(Node(f"a{k}", PLACES[k], height=HEIGHTS[k])) for k in nodes])
    tables = [
        pd.DataFrame({"time": times, "sensor": f"a{k}", "range": np.hypot(
            np.linalg.norm(path - PLACES[k], axis=1), height - HEIGHTS[k]) + own + NOISE * rng.normal(size=len(times))})
        for k, own in zip(nodes, offsets, strict=True)
    ]  # fmt: skip
    return network, pd.concat(tables)


def known_path(seed, height):
    """A problem of two ranges to a known path of unknown height; mean and sd of offsets and height by quadrature."""
    times, prior = np.arange(0, 20, 0.5), (1.5, 0.6)
    path = np.stack([0.4 * times - 4, 1 + 0 * times], 1)
    network, table = recording((0, 1), path, times, height, (-0.1, -0.07), seed)
    start = {"position": (path[0], 1e-3), "velocity": ((0.4, 0.0), 1e-4)}
    problem = Problem(network, Target(ConstantVelocity(1e-4) + RandomWalk("height", "m", 0.0, prior), start), table)
    h = np.linspace(-1.5, 4.5, 6001)
    far = np.linalg.norm(path[:, None] - PLACES[:2], axis=2)
    left = table["range"].values.reshape(2, -1, 1) - np.hypot(far.T[:, :, None], h - HEIGHTS[:2, None, None])
    variance = 1 / (len(times) / NOISE**2 + SCALE**-2)
    mean = variance * left.sum(1) / NOISE**2
    density = 0.5 * (mean**2 / variance - (left**2).sum(1) / NOISE**2).sum(0) - 0.5 * ((h - prior[0]) / prior[1]) ** 2
    weight = np.exp(density - density.max())
    values = np.stack([*mean, h])
    middle = values @ weight / weight.sum()
    spread = (values - middle[:, None]) ** 2 @ weight / weight.sum() + np.array([variance, variance, 0.0])
    return problem, middle, np.sqrt(spread)


def told(tree):
    """Mean and sd of the offsets and of the height at the first epoch."""
    track, own = tree["track/target"].to_dataset().sel(component="height"), tree["calibration"]
    return (np.append(own[name].values, track[name].values[0]) for name in ("mean", "sd"))


@pytest.mark.ci
@pytest.mark.parametrize("seed", [0, 1])
def test_a_height_on_two_sides_has_the_exact_moments(seed):
    problem, exact, exact_sd = known_path(seed, 3.0)
    tree = probcal.fit(problem, MAP(), prior=Gaussian())
    mean, sd = told(tree)
    assert (np.abs(mean - exact) < 0.1 * exact_sd).all()
    np.testing.assert_allclose(sd, exact_sd, rtol=0.05)
    assert "on which side height lies" in tree.attrs["message"]
    parts = tree["mode"].to_dataset().pipe(lambda group: group.isel(mode=group["kind"].values == "part"))
    weight = np.exp(parts["gain"].values)
    assert weight.sum() == pytest.approx(1)
    assert all(str(name).startswith("height ") for name in parts["mode"].values)
    np.testing.assert_allclose(weight @ parts["bias"].values, mean[:-1], rtol=1e-9)
    assert not rivals(tree).sizes["mode"]
    assert tree.attrs["intervals"].startswith("a mixture of 2 answers, each: Laplace")


def drawn(seed, targets):
    """A recording of anchors nearly in a plane and tags of unknown heights, all drawn from the model; its offsets."""
    network = Network([slant.on(Node(f"a{k}", PLACES[k], height=HEIGHTS[k])) for k in range(4)])
    motion = ConstantVelocity(0.05) + RandomWalk("height", "m", 0.003, (1.6, 0.7))
    tags = {f"tag{k}": Target(motion, {"position": ((0, 0), 1.2), "velocity": ((0, 0), 0.15)}) for k in range(targets)}
    simulation = probcal.simulate(network, tags, np.arange(0, 40, 0.2), key=seed)
    return Problem(network, tags, simulation.table), np.array(list(simulation.truth.biases.values()))


@pytest.mark.ci
@pytest.mark.parametrize(("targets", "seeds", "least"), [(1, (3, 9, 15), 9), (3, (4, 6, 8, 28), 14)])
def test_offsets_that_trade_with_heights_are_in_their_intervals(targets, seeds, least, tmp_path):
    """Of 12 and 16 offsets 10 and 16 are; of the first answers, at the plane or on wrong sides, 5 and 7."""
    holds = 0
    for seed in seeds:
        problem, offsets = drawn(seed, targets)
        tree = probcal.fit(problem, MAP(), prior=Gaussian())
        own = tree["calibration"]
        holds += ((own["lower"].values < offsets) & (offsets < own["upper"].values)).sum()
    assert holds >= least
    probcal.save(tree, tmp_path / "fit.nc")
    assert probcal.load(tmp_path / "fit.nc").attrs["message"] == tree.attrs["message"]


@pytest.mark.ci
def test_answers_along_a_ridge_are_weighed_as_those_on_both_sides_are():
    problem, _, _ = known_path(0, 3.0)
    sides = probcal.fit(problem, MAP(), prior=Gaussian())
    with patch.multiple(profile, FAR=0.0, ALIKE=0.0):
        ridge = probcal.fit(problem, MAP(), prior=Gaussian())
    assert "hardly tell height" in ridge.attrs["message"]
    (mean, sd), (wanted, wanted_sd) = told(ridge), told(sides)
    assert (np.abs(mean - wanted) < 0.2 * wanted_sd).all()
    np.testing.assert_allclose(sd, wanted_sd, rtol=0.15)
    own = ridge["calibration"].to_dataset()  # the factors that hold a place are no data
    np.testing.assert_allclose(own["gamma"], 1 - (own["sd"].values / SCALE) ** 2, atol=1e-6)


def test_a_held_start_is_measured_once_more():
    """Mean, covariance and density of a first state that one entry of is measured, beside the textbook's."""
    problem, _, _ = known_path(0, 3.0)
    state = problem.model.recursions[0].drift.shape[1]
    L = np.tril(np.random.default_rng(0).normal(size=(state, state))).astype(np.float32)
    part = problem.model.recursions[0]
    part = part._replace(L=jnp.asarray(np.concatenate([L[None], part.L[1:]])))
    model, density = replace(problem.model, recursions=(part,)).with_start((0, 0, 2), 0.7, 0.3)
    known, S, mean = model.recursions[0], L @ L.T, np.asarray(part.drift)[0]
    total = S[2, 2] + 0.09
    np.testing.assert_allclose(known.drift[0], mean + S[2] * (0.7 - mean[2]) / total, rtol=1e-5)
    np.testing.assert_allclose(known.L[0] @ known.L[0].T, S - np.outer(S[2], S[2]) / total, rtol=1e-4, atol=1e-5)
    assert density == pytest.approx(scipy.stats.norm.logpdf(0.7, mean[2], total**0.5), rel=1e-5)
    np.testing.assert_array_equal(known.L[1:], part.L[1:])
