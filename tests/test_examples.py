"""The examples in docstrings run."""

import doctest
import importlib
from pathlib import Path

import jax
import pytest

import probcal

ROOT = Path(probcal.__file__).parent
SHOWN = [path for path in sorted(ROOT.rglob("*.py")) if ">>>" in path.read_text()]


@pytest.mark.parametrize("path", SHOWN, ids=lambda path: path.stem)
def test_the_examples_of_a_module_run(path):
    module = importlib.import_module(".".join(["probcal", *path.relative_to(ROOT).with_suffix("").parts]))
    with jax.enable_x64(True):
        found = doctest.testmod(module)
    assert found.attempted
    assert not found.failed
