"""Segments of a recording of many biases: what changes between them is what matrices of all biases tell."""

from functools import cache

import numpy as np
import pytest
from sparse_worlds import LIBRARIES, MOTION, TIME, drawn

import probcal as pc
from probcal.analysis import segments

DRIFTS = {"b": ("range", 12.0), "e": ("azimuth", 0.06)}  # of the sensor of a node, from the middle on


@cache
def drifting(*names):
    """The network in the plane, some of its sensors another one in the second half."""
    problem = drawn()[0]
    table = problem.measurements.table.frame.copy()
    for name in names:
        channel, change = DRIFTS[name]
        mine = (table["sensor"].astype(str) == name) & (table["time"] >= TIME[len(TIME) // 2])
        table.loc[mine, channel] += change
    return pc.Problem(problem.network, MOTION, table)


@cache
def assessed(form, problem):
    """Its MAP in one form, judged."""
    return pc.assess(problem, pc.fit(problem, pc.MAP(engine=form), prior=pc.Gaussian()))


@pytest.mark.ci
@pytest.mark.parametrize("library", LIBRARIES, indirect=True)
@pytest.mark.parametrize("names", [(), ("b", "e")], ids=["still", "two drift"])
def test_halves_are_those_of_matrices_of_all_biases(library, names):
    """The same changes and sds, and the same biases drift; left out, sensors and targets are predicted alike."""
    problem = drifting(*names)
    wanted = assessed("dense", problem)
    found = assessed(library, problem)
    a, b = wanted["halves"].to_dataset(), found["halves"].to_dataset()
    assert a["bias_label"].values.tolist() == b["bias_label"].values.tolist()
    np.testing.assert_allclose(b["change"], a["change"], rtol=5e-3, atol=5e-3 * a["sd"].values.min())
    np.testing.assert_allclose(b["sd"], a["sd"], rtol=0.08)  # quarters were let free there, halves here
    assert b.attrs["time"] == a.attrs["time"]
    drift = [tree["verdict"]["verdict"].values == "drifting" for tree in (wanted, found)]
    assert drift[1].tolist() == drift[0].tolist()
    assert drift[1].sum() == len(names)
    for name in ("sensor", "target"):
        left = found[f"{name}_left"].to_dataset()
        whole = wanted[f"{name}_check"].to_dataset().sel({name: left[name].values})
        np.testing.assert_allclose(left["elpd"], whole["elpd"], atol=2.5)
        np.testing.assert_allclose(left["rest_nis"], whole["rest_nis"], rtol=0.1)
    p = [tree["channel_check"].to_dataset()[name].values for name in ("p_misfit", "p_mean") for tree in (wanted, found)]
    np.testing.assert_allclose(p[1::2], p[::2], atol=0.1)


@pytest.mark.ci
def test_targets_that_disagree_are_told_at_every_size():
    """One target measured by a sensor that is another one for it: the same biases in conflict, for the same reason."""
    problem = drawn()[0]
    table = problem.measurements.table.frame.copy()
    odd = (table["sensor"].astype(str) == "b") & (table["target"].astype(str) == "van")
    table.loc[odd, "range"] += 15.0
    problem = pc.Problem(problem.network, MOTION, table)
    wanted, found = (assessed(form, problem)["verdict"].to_dataset() for form in ("dense", "cholmod"))
    assert found["verdict"].sel(bias_label="b.range_offset") == "conflicting"
    assert "the targets disagree, van most" in str(found["reason"].sel(bias_label="b.range_offset").values)
    assert found["verdict"].values.tolist() == wanted["verdict"].values.tolist()


@pytest.mark.slow
@pytest.mark.parametrize("prior", [pc.Horseshoe(), pc.Flat()], ids=["mixture", "flat"])
def test_a_drift_is_named_under_other_priors(prior):
    """Of precisions that are integrated, and without any: b drifts, nothing else does."""
    problem = drifting("b")
    method = pc.EA(engine="cholmod") if isinstance(prior, pc.Horseshoe) else pc.MAP(engine="cholmod")
    tree = pc.fit(problem, method, prior=prior)
    verdicts = pc.assess(problem, tree)["verdict"].to_dataset()["verdict"].to_series()
    assert verdicts.index[verdicts == "drifting"].tolist() == ["b.range_offset"]


@pytest.mark.ci
def test_what_cannot_be_compared_is_not():
    """A fit without a factor, or no room for one or for its solves: verdicts without halves."""
    problem = drifting("b")
    for prior in (pc.Gaussian(), pc.Flat()):
        tree = pc.fit(problem, pc.MAP(engine="iterative"), prior=prior)
        assert "halves" not in pc.assess(problem, tree).children
    tree = pc.fit(problem, pc.MAP(engine="cholmod"), prior=pc.Gaussian())
    for asked in ("__init__", "own_shift", "_of"):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(segments._Differences, asked, lambda *_: (_ for _ in ()).throw(MemoryError))
            checked = pc.assess(problem, tree)
        assert "halves" not in checked.children
        assert "drifting" not in checked["verdict"]["verdict"].values


def test_more_suspects_than_are_looked_at_are_a_finding(monkeypatch):
    problem = drifting("b")
    tree = pc.fit(problem, pc.MAP(engine="cholmod"), prior=pc.Gaussian())
    monkeypatch.setattr(segments, "TOGETHER", 4)
    checked = pc.assess(problem, tree)
    assert any("were not compared" in text for text in checked["finding"]["sentence"].values)


@pytest.mark.slow
def test_a_bias_without_a_level_of_its_own_is_left_out():
    """What only one half tells is no difference."""
    table = drawn()[0].measurements.table.frame
    late = (table["sensor"].astype(str) == "d") & (table["time"] < TIME[len(TIME) // 2])
    problem = pc.Problem(drawn()[0].network, MOTION, table[~late])
    tree = pc.fit(problem, pc.MAP(engine="cholmod"), prior=pc.Gaussian())
    compared = pc.assess(problem, tree)["halves"]["bias_label"].values
    dense = assessed("dense", problem)["halves"]["bias_label"].values
    assert "d.heading" not in compared
    assert len(compared)
    assert set(compared) <= set(dense)
