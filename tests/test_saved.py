"""A fit from its file is judged by the numbers that it has in memory; `test_resume.py` asks it of the other methods."""

import pytest
from contracts import judged_alike
from worlds import small

import probcal


@pytest.mark.parametrize(
    "method",
    [
        pytest.param(lambda: probcal.MAP(), id="MAP"),
        pytest.param(lambda: probcal.SelfConfiguration(probcal.MAP()), id="SelfConfiguration", marks=pytest.mark.ci),
    ],
)
def test_a_fit_is_judged_alike_in_memory_and_from_its_file(method, tmp_path):
    problem = small()
    tree = probcal.fit(problem, method())
    judged_alike(problem, tree, probcal.load(probcal.save(tree, tmp_path / "fit.nc")))
