"""Checks that several test modules share: what every result holds, and tracks of a fit beside those of `reference`."""

import numpy as np

import probcal
from probcal.results.read import each_track
from probcal.status import Status

TOLERANCE = 1e-10


def check_tree(tree, problem):
    """Schema, finiteness and honesty of a result."""
    assert set(tree.children) >= {"posterior", "calibration", "track", "observed_data", "residual", "constant_data"}
    assert tree["posterior"]["bias"].dims == ("chain", "draw", "bias_label")
    assert tree["posterior"].sizes["chain"] == 4
    assert tuple(tree["calibration"]["bias_label"].values) == problem.labels
    for node in tree.subtree:
        for name, variable in node.data_vars.items():
            assert isinstance(variable.values, np.ndarray)
            if variable.dtype.kind == "f":
                assert variable.dtype == np.float64, name
                # of an answer to which no start led there is none
                led = node["start"].values >= 0 if (node.path, name) == ("/mode", "objective") else ...
                assert np.isfinite(variable.values[led]).all(), (node.path, name)
    gamma = tree["calibration"]["gamma"].values
    assert ((gamma >= 0) & (gamma <= 1)).all()
    assert Status(tree.attrs["status"]) is not Status.MISFIT


def only(tree):
    """The track of the only target of a tree."""
    ((_, track),) = each_track(tree)
    return track


def by_epoch(tree, linear, values, variable):
    """Pairs of a track variable of a fit and a flat vector of the reference, epoch by epoch."""
    tracked, found, offset = dict(each_track(tree)), [], 0
    for chain in linear.chains:
        track = tracked[chain.target]
        assert list(track["component"].values) == chain.names
        for time in chain.times:
            found.append((track[variable].sel(time=time).values, values[offset : offset + len(chain.names)]))
            offset += len(chain.names)
    assert offset == len(values)
    return np.concatenate([a for a, _ in found]), np.concatenate([b for _, b in found])


def close(found, expected, tolerance=TOLERANCE):
    found, expected = np.asarray(found), np.asarray(expected)
    assert found.dtype == np.float64
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance * np.abs(expected).max())


def judged_alike(problem, *trees):
    """The verdicts on two trees of one fit are the same in every number."""
    one, other = (probcal.assess(problem, tree) for tree in trees)
    assert {node.path for node in one.subtree} == {node.path for node in other.subtree}
    for node in one.subtree:
        for variable, values in node.to_dataset(inherit=False).data_vars.items():
            np.testing.assert_array_equal(
                other[node.path][variable].values, values.values, err_msg=f"{node.path} {variable}"
            )
