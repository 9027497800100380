"""A fit of each method, from its file, is judged by the numbers that it has in memory."""

from dataclasses import fields, replace

import numpy as np
import pytest
from worlds import small

import probcal
from probcal.inference import METHODS, table

SHORT = {"chains": 2, "warmup": 40, "draws": 40, "patience": 1, "iterations": 8}  # what a method has of these


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name == "MAP" else pytest.mark.ci) for name in table().index]
)
def test_a_fit_of_each_method_is_judged_alike_in_memory_and_from_its_file(name, tmp_path):
    problem, method = small(), next(own for own, _ in METHODS.values() if type(own).__name__ == name)
    method = replace(method, **{own.name: SHORT[own.name] for own in fields(method) if own.name in SHORT})
    tree = probcal.fit(problem, method)
    loaded = probcal.load(probcal.save(tree, tmp_path / "fit.nc"))
    one, other = (probcal.assess(problem, own) for own in (tree, loaded))
    assert {node.path for node in one.subtree} == {node.path for node in other.subtree}
    for node in one.subtree:
        for variable, values in node.to_dataset(inherit=False).data_vars.items():
            np.testing.assert_array_equal(
                other[node.path][variable].values, values.values, err_msg=f"{node.path} {variable}"
            )
