"""Smoothed importance weights of many rows at once are those of ArviZ, row by row."""

import numpy as np
import pytest
from arviz_stats.base import array_stats

from probcal.inference.psis import ROWS, smoothed


@pytest.mark.parametrize("draws", [40, 100, 300, 1000])
def test_weights_and_k_are_those_of_arviz(draws):
    random = np.random.default_rng(draws)
    log_ratios = np.concatenate([s * random.normal(size=(20, draws)) for s in (1e-3, 0.3, 1.0, 3.0)])
    log_ratios = np.concatenate([log_ratios, random.standard_t(5, size=(20, draws))])
    weights, k = smoothed(log_ratios)
    wanted, wanted_k = array_stats.psislw(-log_ratios)
    np.testing.assert_allclose(weights, wanted, rtol=1e-10)
    np.testing.assert_allclose(k, wanted_k, atol=1e-12)


def test_more_rows_than_are_smoothed_at_once():
    log_ratios = np.random.default_rng(0).normal(size=(ROWS + 3, 30))
    weights, k = smoothed(log_ratios)
    alone, alone_k = smoothed(log_ratios[-2:])
    np.testing.assert_array_equal(weights[-2:], alone)
    np.testing.assert_array_equal(k[-2:], alone_k)


def test_a_tail_too_heavy_for_a_double_is_fitted_in_silence():
    """Ratios over ten thousand nats: quantiles beyond 1e308 are cut to the largest ratio."""
    with np.errstate(over="raise", divide="raise", invalid="raise"):
        weights, k = smoothed(-1e4 * np.random.default_rng(0).exponential(size=(40, 1000)))
    assert (k > 1).all()
    np.testing.assert_allclose(np.exp(weights).sum(1), 1.0)


def test_rows_without_a_tail_to_fit():
    """Equal weights are the best there are; one draw with all the weight leaves no tail; few draws have none."""
    equal, lone = np.zeros(100), np.zeros(100)
    lone[3] = 1e4
    weights, k = smoothed(np.stack([equal, lone]))
    np.testing.assert_allclose(weights[0], -np.log(100))
    assert k[0] == 0.0
    assert k[1] == np.inf
    assert np.isfinite(weights).all()
    np.testing.assert_allclose(np.exp(weights).sum(1), 1.0)
    weights, k = smoothed(np.arange(12.0)[None])
    assert k[0] == np.inf
    np.testing.assert_allclose(np.exp(weights).sum(1), 1.0)
