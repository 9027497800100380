"""Answers laid on a truth in another frame: the inverse of what moved it, never a mirror image, named in the score."""

import committed
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from scipy.spatial.transform import Rotation

from probcal import InputError, Truth, add_scores
from probcal.results.alignment import KINDS, align
from probcal.results.scores import scores

PLACES = np.random.default_rng(0).normal(size=(30, 3)) * [10.0, 5.0, 2.0]


def rotation(d):
    whole = Rotation.from_euler("ZYX", [2.0, 0.7, -0.4] if d == 3 else [2.0, 0.0, 0.0]).as_matrix()
    return whole[:d, :d]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("d", [2, 3])
def test_what_moved_the_places_is_found(d, kind):
    factor = 1.7 if kind == "similarity" else 1.0
    true = factor * PLACES[:, :d] @ rotation(d).T + np.arange(1.0, d + 1)
    found = align(PLACES[:, :d], true, kind)
    assert found.scale == pytest.approx(factor)
    np.testing.assert_allclose(found.rotation, rotation(d), atol=1e-9)
    np.testing.assert_allclose(found(PLACES[:, :d]), true, atol=1e-9)
    np.testing.assert_allclose(found.back(true), PLACES[:, :d], atol=1e-9)


@pytest.mark.parametrize("d", [2, 3])
def test_a_mirror_image_stays_apart(d):
    mirrored = PLACES[:, :d] * ([1.0] * (d - 1) + [-1.0])
    found = align(PLACES[:, :d], mirrored, "rigid")
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)
    assert np.abs(found(PLACES[:, :d]) - mirrored).max() > 1.0


def test_no_other_frame_lies_nearer():
    """Least squares: small turns, shifts and scales of a noisy answer only add to its error."""
    true = PLACES[:, :2] @ rotation(2).T + np.random.default_rng(1).normal(size=(30, 2))
    found = align(PLACES[:, :2], true, "similarity")

    def error(angle=0.0, shift=0.0, factor=1.0):
        c, s = np.cos(angle), np.sin(angle)
        moved = (
            factor * found.scale * PLACES[:, :2] @ found.rotation.T @ np.array([[c, s], [-s, c]]) + found.shift + shift
        )
        return np.sum((moved - true) ** 2)

    assert all(error() < error(**{name: base + step}) for step in (-0.01, 0.01)
               for name, base in (("angle", 0.0), ("shift", 0.0), ("factor", 1.0)))  # fmt: skip


def test_a_score_says_how_it_was_aligned():
    time = np.arange(30.0)
    names = ["position_x", "position_y"]
    states = {kind: (("time", "component"), PLACES[:, :2] + shift) for kind, shift in (("mean", 3.0), ("before", 0.0))}
    group = xr.Dataset(states, coords={"time": time, "component": names}, attrs={"target": "target"})
    tree = xr.DataTree.from_dict({"track/target": group})
    true = PLACES[:, :2] @ rotation(2).T

    truth = Truth(pd.DataFrame({"time": time, "position_x": true[:, 0], "position_y": true[:, 1]}))
    assert scores(tree, truth)["position_rmse_after"] > 3.0
    found = scores(tree, truth, align="rigid")
    assert set(found) == {"position_rmse_before_rigid", "position_rmse_after_rigid"}
    assert found["position_rmse_after_rigid"] == pytest.approx(0.0, abs=1e-9)
    with pytest.raises(InputError, match='align="affine": give "rigid" or "similarity"'):
        scores(tree, truth, align="affine")


def test_a_track_without_a_name_is_that_of_a_single_target():
    time, nothing = np.arange(2.0), np.zeros((2, 2))
    states = dict.fromkeys(("mean", "before"), (("time", "component"), nothing))
    group = xr.Dataset(states, coords={"time": time, "component": ["position_x", "position_y"]})
    one, two = (group.assign_attrs(target=name) for name in ("one", "two"))
    truth = Truth(pd.DataFrame({"time": time, "position_x": 3.0, "position_y": 4.0}))
    assert scores(xr.DataTree.from_dict({"track/one": one}), truth)["position_rmse_after"] == pytest.approx(5.0)
    said = 'truth data has no column "target", by which 2 targets'
    with pytest.raises(InputError, match=said):
        scores(xr.DataTree.from_dict({"track/one": one, "track/two": two}), truth)
    with pytest.raises(InputError, match=said):
        truth.positions(time, np.array(["one", "two"]), 2)


def test_too_few_places_are_refused():
    with pytest.raises(InputError, match="at least 3 different finite places are needed in 3-D"):
        align(np.zeros((5, 3)), np.zeros((5, 3)), "rigid")
    with pytest.raises(InputError, match="align: places and truth have shape"):
        align(np.zeros((5, 3)), np.zeros((4, 3)), "rigid")


def test_scores_of_another_alignment_are_forgotten():
    tree, truth = committed.tree("ea"), Truth(committed.DATA / "small.tracks.csv")
    add_scores(tree, truth)
    add_scores(tree, truth, align="rigid")
    assert "position_rmse_after" not in tree.attrs
    assert "position_rmse_after_rigid" in tree.attrs
    assert "truth" not in tree.children  # this truth has no biases
    assert all("true" in node.data_vars for node in tree["track"].children.values())
