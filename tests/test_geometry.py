"""Attitudes of nodes: from rotations to heading, pitch and roll and back by what a pose turns."""

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from probcal import InputError, Node
from probcal.geometry import attitude, norm
from probcal.network import Path
from probcal.types import PoseView


def turned(angles, vector):
    """A vector in the axes of a pose of these angles."""
    view = PoseView("the node", {"position": np.zeros(3)} | {name: float(angles[name]) for name in angles})
    return np.asarray(view.turn(vector))


@pytest.mark.parametrize("form", ["matrix", "quaternion", "scalar first", "scipy"])
def test_a_pose_turns_as_the_rotation_that_it_came_from(form):
    rotations = Rotation.random(20, random_state=0)
    given = {
        "matrix": rotations.as_matrix(), "quaternion": -2.5 * rotations.as_quat(),
        "scalar first": rotations.as_quat(scalar_first=True), "scipy": rotations,
    }[form]  # fmt: skip
    found = attitude(given, scalar_first=form == "scalar first")
    vector = np.array([1.0, -2.0, 3.0])
    with jax.enable_x64(True):
        for k in range(20):
            own = {name: found[name][k] for name in found}
            np.testing.assert_allclose(turned(own, vector), rotations[k].inv().apply(vector), atol=1e-9)


def test_straight_up_the_roll_is_none():
    up = np.array([[0.0, -0.6, -0.8], [0.0, 0.8, -0.6], [1.0, 0.0, 0.0]])
    found = attitude(up)
    assert found["roll"] == 0.0
    with jax.enable_x64(True):
        for vector in np.eye(3):
            np.testing.assert_allclose(turned(found, vector), up.T @ vector, atol=1e-6)


def test_nodes_and_paths_take_an_attitude_by_name():
    node = Node("box", (0.0, 0.0, 1.0), **attitude(Rotation.from_euler("z", 0.3)))
    assert node.components["heading"] == pytest.approx(0.3)
    flown = Rotation.from_euler("ZYX", [[0.1, -0.2, 0.3], [0.2, -0.2, 0.3]])
    path = Path([0.0, 1.0], np.zeros((2, 3)), **attitude(flown))
    np.testing.assert_allclose([path.heading, path.pitch, path.roll], [[0.1, 0.2], [0.2, 0.2], [0.3, 0.3]], atol=1e-12)
    plane = attitude([[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]])
    assert list(plane) == ["heading"]
    assert Node("box", (0.0, 0.0), **plane).components["heading"] == pytest.approx(0.4)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (np.diag([1.0, 1.0, -1.0]), "right-handed; its determinant is -1"),
        (np.stack([np.eye(3), 2 * np.eye(3)]), "rotation 1 is none"),
        (np.full((3, 3), np.nan), "rotation 0 is none"),
        (np.zeros(4), "a quaternion must be finite and not 0"),
        (np.zeros((2, 3)), r"attitude: give matrices .* or quaternions \(\.\.\., 4\); got"),
    ],
)
def test_what_is_no_rotation_is_refused(given, says):
    with pytest.raises(InputError, match=says):
        attitude(given)


@pytest.mark.slow
@pytest.mark.parametrize("dimension", [1, 2, 3])
def test_a_length_has_a_slope_everywhere_and_hides_no_gap(dimension):
    vector = np.random.default_rng(0).normal(size=dimension)
    with jax.enable_x64(True):
        assert norm(vector) == pytest.approx(np.linalg.norm(vector))
        np.testing.assert_allclose(jax.jacfwd(norm)(vector), vector / np.linalg.norm(vector))
        np.testing.assert_array_equal(jax.grad(norm)(np.zeros(dimension)), 0.0)
        vector[-1] = np.nan
        assert np.isnan(norm(vector))
