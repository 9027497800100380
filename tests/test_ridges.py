"""Biases that look well told at the mode and are open along a curve: anchors near one plane, a tag above it."""

from unittest.mock import patch

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
import worlds

import probcal
from probcal import Bias, Channel, ConstantVelocity, Network, Node, Problem, RandomWalk, Target, sensor
from probcal.analysis.check import Case
from probcal.analysis.ridges import check_ridges, moved_together
from probcal.inference.fitted import take_up
from probcal.types import float64

ANCHORS = np.array([(-3.0, -3.0, 1.54), (3.0, -3.0, 1.60), (-3.0, 3.0, 1.66), (3.0, 3.0, 1.58)])
OFFSETS = np.array([-0.11, -0.09, -0.07, -0.10])


@sensor(range=Channel("m", std=0.035))
def ranged(target, pose, *, range_offset=Bias("m", 0.2)):
    """Range of a tag whose height is a state of its own."""
    flat = jnp.sum((target.position - pose.position) ** 2)
    return dict(range=jnp.sqrt(flat + (target.height - pose.height) ** 2) + range_offset)


@pytest.fixture(scope="module")
def flat():
    """The tag moves half a metre above the plane of the anchors, and the answer lies on that plane."""
    time, rng = 0.2 * np.arange(150), np.random.default_rng(3)
    path = np.stack([1.6 * np.cos(time / 3), 1.6 * np.sin(time / 3), np.full(len(time), 2.1)], 1)
    away = np.linalg.norm(path[:, None] - ANCHORS, axis=2) + OFFSETS + 0.035 * rng.standard_normal((len(time), 4))
    rows = pd.DataFrame({
        "time": np.repeat(time, 4), "sensor": np.tile([f"a{k}" for k in range(4)], len(time)), "range": away.ravel(),
    })  # fmt: skip
    network = Network([ranged.on(Node(f"a{k}", place[:2], height=place[2])) for k, place in enumerate(ANCHORS)])
    motion = ConstantVelocity(0.5) + RandomWalk("height", "m", 0.003, (1.6, 0.7))
    problem = Problem(network, Target(motion, {"position": ((1.6, 0.0), 0.1)}), rows)
    with patch("probcal.inference.solve.profiled", lambda answer, *_: answer):  # as one Gaussian has it
        return problem, probcal.fit(problem, probcal.MAP())


@float64
def checked(problem, tree):
    """The check alone."""
    return check_ridges(Case(take_up(problem, tree), tree, None, []))


@pytest.mark.ci
def test_offsets_that_trade_with_a_height_are_not_determined(flat):
    """They are off at the plane; the ridge is named and followed beyond the truth, and they are in doubt."""
    problem, tree = flat
    off = (tree["calibration"]["mean"].values - OFFSETS) / tree["calibration"]["sd"].values
    assert off.min() > 2.0
    assert off.max() > 4.0
    found = checked(problem, tree)
    (ridge,) = found.findings
    assert ridge.sentence.startswith("range_offset of a0, a1, a2, a3 may be off together by -0.1 m and more")
    assert sorted(found.doubts["weak"]) == [0, 1, 2, 3]


@pytest.mark.ci
def test_the_mean_under_a_gaussian_prior_counts_the_volume_of_the_tracks(flat):
    """At the mode under that prior it is the mode; the slope without the volume leads elsewhere."""
    problem, tree = flat
    found = tree["calibration"].to_dataset()
    mean = float64(lambda: Case(take_up(problem, tree), tree, None, []).declared_mean)()
    assert np.abs(mean * problem.scales - found["mean"].values).max() < 0.05 * found["sd"].values.min()


@pytest.mark.ci
def test_a_linear_problem_falls_as_a_gaussian():
    problem, tree = worlds.linear("plane")[0], worlds.fitted("plane")

    @float64
    def falls():
        ways = (way for way, _ in moved_together(take_up(problem, tree), told=1.0))
        return [way.held(4.0, way.mode.at.moved(4.0 / way.sd * way.response))[1] for way in ways]

    found = falls()
    assert len(found) >= 2
    np.testing.assert_allclose(found, 8.0, rtol=1e-3)
    assert not checked(problem, tree).findings
