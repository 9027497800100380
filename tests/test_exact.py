"""Linear-Gaussian networks: every number of a fit equals that of the dense joint Gaussian of `reference`.

Stated tolerance: 1e-10 of the largest entry of a quantity (means, sds, covariances) and of the log evidence.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from contracts import TOLERANCE, by_epoch, close
from scipy import stats
from worlds import DRAWN, LINEAR, exact, fitted, linear, resting

import probcal
from probcal.gaussian.mode import find_mode
from probcal.priors import Precision
from probcal.results.read import each_track

WORLDS = [
    pytest.param(name, marks=pytest.mark.ci if name in ("space", "extras", "mixed", "drifting") else ())
    for name in LINEAR
]
FALSE_ALARM = 1e-6  # of each statistical test below, all its comparisons together


def solved(name):
    """A world in its naive form, its exact posterior, the problem, and its MAP fit."""
    return linear(name)[1], exact(name), linear(name)[0], fitted(name)


@pytest.mark.parametrize("name", WORLDS)
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


@pytest.mark.parametrize("name", WORLDS)
def test_labels_and_scales(name):
    linear, _, problem, _ = solved(name)
    assert sorted(problem.labels) == sorted(linear.labels)
    assert dict(zip(problem.labels, problem.scales, strict=True)) == linear.scales


@pytest.mark.parametrize("name", WORLDS)
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


@pytest.mark.parametrize("name", WORLDS)
def test_tracks(name):
    """Mean and sd of every state, biases integrated out; and the mean without calibration (z held at 0)."""
    linear, exact, _, tree = solved(name)
    close(*by_epoch(tree, linear, exact.states[0], "mean"))
    close(*by_epoch(tree, linear, exact.states[1], "sd"))
    held = reference.dense(linear, None, hold=np.zeros(len(linear.labels)))
    close(*by_epoch(tree, linear, held.states[0], "before"))


@pytest.mark.parametrize("name", WORLDS)
def test_evidence(name):
    """log p(data | alpha) with all its normalising constants."""
    _, exact, _, tree = solved(name)
    assert tree.attrs["log_evidence"] == pytest.approx(exact.evidence, rel=TOLERANCE)


@pytest.mark.parametrize("name", ["plane", pytest.param("mixed", marks=pytest.mark.slow)])
def test_iterating_changes_nothing(name):
    """On a linear model one step reaches the mode and thirty leave it there: a datum counts once."""
    _, exact, problem, _ = solved(name)
    with jax.enable_x64(True):
        alpha = Precision(jnp.ones(len(problem.labels)))
        start = jax.tree.map(jnp.asarray, resting(problem))
        one = find_mode(problem.model, start, alpha, 1, 0.0)
        many = find_mode(problem.model, start, alpha, 30, 0.0)
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
    tracked = dict(each_track(tree))
    for chain in linear.chains:
        own = tracked[chain.target]["state"].sel(time=chain.times)
        columns.append(own.transpose("chain", "draw", "time", "component").values.reshape(1000, -1))
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
    problem, naive = linear("shifted")
    method = probcal.EA(iterations=2000, tolerance=1e-11, precisions="maximised")
    tree = probcal.fit(problem, method, start=resting(problem))
    return naive, tree


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
    assert tree.attrs["log_evidence_type_ii"] == pytest.approx(exact.evidence, rel=TOLERANCE)
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
    alpha, top = group["precision"].values, tree.attrs["log_evidence_type_ii"]
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
