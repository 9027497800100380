"""Formulas by hand, where a whole fit would hide a wrong constant: starts, learnt precisions, statuses, intervals."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from worlds import exact, linear, resting, ruler

from probcal import Channel, ConstantVelocity, Network, Node, Problem, Unknown, simulate
from probcal.gaussian.dense import DenseEngine
from probcal.gaussian.frame import _moves, _with_levels
from probcal.gaussian.information import at_levels, update_levels
from probcal.gaussian.linearised import laplace, marginal_variances
from probcal.gaussian.mode import Point, cost, factors, find_mode
from probcal.gaussian.recursion import trajectory
from probcal.gaussian.tails import Variances
from probcal.inference.ending import bias_status
from probcal.model.rows import noise_std
from probcal.priors import Precision
from probcal.sensors import doa


def test_an_undeclared_start_is_as_wide_as_network_and_recording():
    """Ten diagonals of the network around its middle; velocities that cross it in the time of the recording."""
    network = Network([ruler.on(Node("a", (0.0, 0.0))), ruler.on(Node("b", (30.0, 40.0)))])
    table = pd.DataFrame({"time": [0.0, 4.0, 0.0, 4.0], "sensor": ["a", "a", "b", "b"], "height": 1.0})
    part = Problem(network, ConstantVelocity(0.5), table).model.recursions[0]
    speed = 10 * 50.0 / 4.0 + 0.5 * 2.0
    np.testing.assert_allclose(np.diag(part.L[0]), [500.0, 500.0, speed, speed], rtol=1e-6)
    np.testing.assert_allclose(part.drift[0], [15.0, 20.0, 0.0, 0.0])


def test_a_bias_whose_chains_disagree_is_not_mixed():
    problem, _ = linear("plane")
    r_hat = np.ones(len(problem.labels))
    r_hat[1] = 1.06
    found = bias_status(problem, {"not mixed": r_hat > 1.05})
    assert found[1] == "not mixed"
    assert set(found[:1] + found[2:]) == {"estimated", "survey"}


@pytest.mark.ci
def test_a_wider_process_noise_costs_its_logarithm_and_leaves_the_trajectory_alone():
    """Two epochs of a ruler: four noises of unit prior at the start, four of the unknown level after it."""
    network = Network([ruler.on(Node("a", (0.0, 0.0)))])
    table = pd.DataFrame({"time": [0.0, 1.0], "sensor": "a", "height": [0.5, 1.0]})
    problem = Problem(network, ConstantVelocity(Unknown(0.5, 2.0)), table)
    with jax.enable_x64(True):
        part = problem.model.recursions[0]
        noises = 0.1 * np.arange(1.0, 9.0).reshape(2, 4)
        states = trajectory(part.F, part.L, part.drift[:, :, None], noises[:, :, None])[:, :, 0]
        here = Point((states,), (noises,), np.zeros(1), np.zeros(1))
        there = at_levels(problem.model, here, np.array([0.3]))
        np.testing.assert_allclose(there.noises[0], noises * [[1.0], [np.exp(-0.3)]])
        again = trajectory(part.F, factors(part, there.levels), part.drift[:, :, None], there.noises[0][:, :, None])
        np.testing.assert_allclose(again[:, :, 0], states)
        prior = Precision(np.ones(1))
        change = np.subtract(*(jax.jit(cost)(problem.model, at, prior) for at in (there, here)))
    wider = 4 * 0.3 + 0.5 * (np.exp(-0.6) - 1) * np.sum(noises[1] ** 2)
    assert float(change) == pytest.approx(wider + 0.5 * (0.3 / np.log(2.0)) ** 2)


def test_a_predicted_value_is_as_uncertain_as_biases_and_trajectory_make_it():
    problem, naive = linear("plane")
    order = [naive.labels.index(label) for label in problem.labels]
    whole, starts = exact("plane").covariance, []
    first = len(naive.labels)
    for chain in naive.chains:
        starts.append(first)
        first += len(chain.names) * len(chain.times)
    expected = []
    for d in naive.data:
        n = len(naive.chains[d.chain].names)
        row = np.zeros(len(whole))
        row[: len(d.G)], row[starts[d.chain] + n * d.epoch :][:n] = d.G, d.H
        expected.append(row @ whole @ row)
    with jax.enable_x64(True):
        model, point = problem.model, resting(problem)
        covariance = jnp.asarray(exact("plane").z[1][np.ix_(order, order)])
        at = DenseEngine().at(model, point)
        (variance,), _ = marginal_variances(model, at.rows, at.trajectories, covariance)
    np.testing.assert_allclose(np.asarray(variance)[np.asarray(model.rows[0].mask) > 0], expected, rtol=1e-8)


def test_a_row_with_a_std_of_its_own_does_not_feel_the_unknown_level():
    kind = replace(ruler, channels={"height": Channel("m", std=Unknown(2.0))})
    network = Network([kind.on(Node("a", (0.0, 0.0)))])
    table = pd.DataFrame({"time": [0.0, 1.0], "sensor": "a", "height": 1.0, "height_std": [0.5, np.nan]})
    (rows,) = Problem(network, ConstantVelocity(0.5), table).model.rows
    assert rows.level.ravel().tolist() == [1, 0], "one level: its number is 0, and 1 stands for none"
    with jax.enable_x64(True):
        found = jax.jit(noise_std)(rows, np.log([3.0]))
    np.testing.assert_allclose(found.ravel(), [0.5, 6.0], rtol=1e-6)


@pytest.mark.ci
def test_levels_border_a_frame_by_differences_of_its_likelihood():
    """Of a quadratic log-likelihood of three biases and two levels the differences give its matrix and slope."""
    random = np.random.default_rng(0)
    root = random.standard_normal((5, 5))
    matrix, slope = root @ root.T + 3.0 * np.eye(5), random.standard_normal(5)
    moved = np.pad(_moves(2), ((0, 0), (3, 0)))
    values = moved @ slope - 0.5 * np.sum((moved @ matrix) * moved, 1)
    slopes = slope[:3] - moved @ matrix[:, :3]
    with jax.enable_x64(True):
        given = (jnp.asarray(part) for part in (matrix[:3, :3], slope[:3], values, slopes))
        information, score = _with_levels(*given, 2)
    np.testing.assert_allclose(information, matrix, rtol=1e-6)
    np.testing.assert_allclose(score, slope, rtol=1e-6)


def test_what_data_determine_is_what_priors_leave():
    """tr(H^-1 J) = tr(I - H^-1 P): leverages of the data, and what noises and biases have lost of their priors."""
    problem, _ = linear("plane")
    with jax.enable_x64(True):
        prior = Precision(jnp.ones(problem.model.biases))
        at = DenseEngine().at(problem.model, resting(problem))
        covariance = laplace(problem.model, at.point, prior).covariance
        predicted, driven = marginal_variances(problem.model, at.rows, at.trajectories, covariance)
        data = sum(
            float(np.sum(np.asarray(lin.weight) * np.asarray(own))) for lin, own in zip(at.rows, predicted, strict=True)
        )
        noises = sum(float(np.sum(1 - np.asarray(own))) for own in driven)
    biases = np.sum(1 - np.diag(np.asarray(covariance)))
    assert data == pytest.approx(noises + biases, rel=1e-9)
    assert noises > 1.0


@pytest.mark.parametrize(("factor", "least", "most"), [(5.0, -1.0, -0.4), (1.1, -0.35, -0.1)])
def test_an_unknown_level_moves_as_far_as_its_prior_lets_it(factor, least, most):
    """One step: the data want a std half of the guess; a factor of 5 lets them, one of 1.1 holds it back."""
    kind = replace(ruler, channels={"height": Channel("m", std=Unknown(2.0, factor))})
    network = Network([kind.on(Node("a", (0.0, 0.0)))])
    rng = np.random.default_rng(0)
    heights = np.arange(40.0) + rng.standard_normal(40)
    table = pd.DataFrame({"time": np.arange(40.0), "sensor": "a", "height": heights})
    problem = Problem(network, ConstantVelocity(0.01), table)
    with jax.enable_x64(True):
        point = find_mode(problem.model, resting(problem), Precision(jnp.ones(1)), 30, 1e-9).point
        std = jax.jit(lambda level: problem.model.noise_std(level)[0])
        stds = [np.asarray(std(np.full(1, level))) for level in (0.0, 0.5)]
        variances = Variances.dense(DenseEngine().at(problem.model, point), jnp.eye(1))
        moved = float(jax.jit(lambda *own: update_levels(problem.model, *own).levels[0])(point, *variances))
    np.testing.assert_allclose(stds[1], np.exp(0.5) * stds[0])
    assert least < moved < most


def test_a_drawn_angle_lies_where_it_is_predicted():
    """Bearings around a node, drawn with next to no noise: within 1e-3 rad of the predicted ones, in (-pi, pi]."""
    finder = replace(doa, channels={"azimuth": Channel("rad", std=1e-5, wrap=True)})
    network = Network([finder.on(Node("a", (0.0, 0.0)))])
    angle = np.linspace(-3.0, 3.0, 9)
    path = 10.0 * np.stack([np.cos(angle), np.sin(angle)], 1)
    found = simulate(network, ConstantVelocity(1.0), np.arange(9.0), key=0, tracks={"one": path}).table["azimuth"]
    np.testing.assert_allclose(found, angle, atol=1e-3)
