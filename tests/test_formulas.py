"""Formulas by hand, where a whole fit would hide a wrong constant: starts, learnt precisions, statuses, intervals."""

import jax
import numpy as np
import pandas as pd
import pytest
from worlds import linear, ruler

from probcal import ARD, ConstantVelocity, Network, Node, Problem
from probcal.inference.posterior import _bias_status


def test_an_undeclared_start_is_as_wide_as_network_and_recording():
    """Ten diagonals of the network around its middle; velocities that cross it in the time of the recording."""
    network = Network([ruler.on(Node("a", (0.0, 0.0))), ruler.on(Node("b", (30.0, 40.0)))])
    table = pd.DataFrame({"time": [0.0, 4.0, 0.0, 4.0], "sensor": ["a", "a", "b", "b"], "height": 1.0})
    part = Problem(network, ConstantVelocity(0.5), table).system.recursions[0]
    speed = 10 * 50.0 / 4.0 + 0.5 * 2.0
    np.testing.assert_allclose(np.diag(part.L[0]), [500.0, 500.0, speed, speed], rtol=1e-6)
    np.testing.assert_allclose(part.drift[0], [15.0, 20.0, 0.0, 0.0])


@pytest.mark.parametrize(("shape", "rate"), [(1.0, 0.0), (2.0, 1.5)])
def test_precisions_are_learnt_by_their_formulas(shape, rate):
    """Paper B (25) and Paper C (40) with a Gamma hyper-prior, for biases that share a precision."""
    gamma, variance, z = np.array([0.9, 0.5, 0.2]), np.array([0.1, 0.3, 0.7]), np.array([1.5, -0.4, 0.8])
    group, more, less = np.array([0, 0, 2]), 2 * (shape - 1), 2 * rate
    with jax.enable_x64(True):
        mackay, em = (ARD(shape, rate).learn(gamma, variance, z, group, rule) for rule in ("mackay", "em"))
    square, spread = z**2, z**2 + variance
    for found, count, total in ((mackay, gamma, square), (em, np.ones(3), spread)):
        shared = (count[:2].sum() + more) / (total[:2].sum() + less)
        np.testing.assert_allclose(found, [shared, shared, (count[2] + more) / (total[2] + less)], rtol=1e-9)


def test_a_bias_whose_chains_disagree_is_not_mixed():
    problem, _ = linear("plane")
    r_hat = np.ones(len(problem.labels))
    r_hat[1] = 1.06
    found = _bias_status(problem, {"r_hat": r_hat}, len(r_hat))
    assert found[1] == "not mixed"
    assert set(found[:1] + found[2:]) == {"estimated", "survey"}
