"""Checks that several test modules share: what every result holds, and tracks of a fit beside those of `reference`."""

import numpy as np

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
                assert np.isfinite(variable.values).all(), (node.path, name)
    gamma = tree["calibration"]["gamma"].values
    assert ((gamma >= 0) & (gamma <= 1)).all()
    assert Status(tree.attrs["status"]) is not Status.MISFIT


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
