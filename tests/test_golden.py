"""The golden table: every method answers what it answered when its row was written."""

import copy

import golden
import pytest

MARKS = {"quick": (), "ci": (pytest.mark.ci,), "slow": (pytest.mark.slow,)}
ROADS = ("town",)  # problems with a wing
CLIMB = {
    "tolerance": "climb", "status": "converged", "means": {"a": 3.0, "b": 0.0}, "sds": {"a": 0.5, "b": 0.0},
    "values": {"level": 2.0}, "evidence": {"model": -7.0}, "verdicts": {"a": "weak"}, "findings": [["loo", "rows"]],
}  # fmt: skip
DRAWS = {"tolerance": "draws", "means": {"a": 3.0}, "sds": {"a": 0.5}, "ess": {"a": 100.0}}
POINT = {"tolerance": "point", "values": {"a": 3.0}}


def marks_of(key):
    """The tier of a row, and the wing that it needs."""
    wing = (pytest.mark.needs("roads"),) if key.split()[0] in ROADS else ()
    return (*MARKS[golden.tier_of(key)], *wing)


@pytest.mark.parametrize("key", [pytest.param(key, marks=marks_of(key)) for key in golden.ROWS])
def test_an_answer_is_that_of_the_table(key):
    said = golden.differences(golden.stored()[key], golden.make(key))
    assert not said, "; ".join(said)


def test_the_table_has_every_row_and_no_other():
    assert list(golden.stored()) == golden.ROWS


@pytest.mark.parametrize(
    ("row", "part", "label", "value", "moved"),
    [
        (CLIMB, "means", "a", 3.009, ""),
        (CLIMB, "means", "a", 3.011, "means a: 3 -> 3.011, 1.1 times"),
        (CLIMB, "means", "b", 1e-6, "means b"),  # one that is zero for certain stays so
        (CLIMB, "sds", "a", 0.49, ""),
        (CLIMB, "sds", "a", 0.48, "sds a"),
        (CLIMB, "values", "level", 2.05, "values level"),
        (CLIMB, "values", "level", float("nan"), "values level"),
        (CLIMB, "evidence", "model", -7.03, "evidence model"),
        (CLIMB, "status", None, "misfit", "status: converged -> misfit"),
        (CLIMB, "verdicts", "a", "determined", "('weak', 'determined')"),
        (CLIMB, "findings", None, [], "findings: [['loo', 'rows']] -> []"),
        (CLIMB, "means", "c", 1.0, "means: other labels, ['c']"),
        (DRAWS, "means", "a", 3.28, ""),  # 4 standard errors of the difference are 0.283
        (DRAWS, "means", "a", 3.29, "means a"),
        (DRAWS, "sds", "a", 0.71, "sds a"),
        (POINT, "values", "a", 3.0 + 2e-9, ""),
        (POINT, "values", "a", 3.0 + 4e-9, "values a"),
    ],
)
def test_what_moves_beyond_its_tolerance_is_named(row, part, label, value, moved):
    new = copy.deepcopy(row)
    if label is None:
        new[part] = value
    else:
        new[part][label] = value
    assert moved in "; ".join(golden.differences(row, new))
    assert bool(moved) == bool(golden.differences(row, new))
