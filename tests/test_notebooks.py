"""Notebooks: what is committed is whole and uses names that exist; one runs in CI, the others with `-m slow`.

The recording of the first is fitted by `test_endtoend.py`.
"""

import ast
import importlib
from pathlib import Path

import nbclient
import nbformat
import pytest

from probcal.wings import loaded

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))
SAMPLE = ("02_declare_a_sensor",)
LARGEST = 300_000  # bytes of a notebook with its outputs

every = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def code(book):
    return [cell for cell in book.cells if cell.cell_type == "code"]


def test_the_sample_exists():
    assert set(SAMPLE) <= {path.stem for path in NOTEBOOKS}


@every
def test_a_notebook_is_committed_with_the_outputs_of_one_run(path):
    book = nbformat.read(path, as_version=4)
    nbformat.validate(book)
    cells = code(book)
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1)), "run it from top to bottom"
    outputs = [output for cell in cells for output in cell.outputs]
    assert not [output for output in outputs if output.output_type == "error"]
    assert outputs
    assert path.stat().st_size < LARGEST


@every
def test_a_notebook_imports_names_that_exist(path):
    for cell in code(nbformat.read(path, as_version=4)):
        for node in ast.walk(ast.parse(cell.source)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("probcal"):
                module = loaded(node.module, node.module)
                for alias in node.names:
                    if not hasattr(module, alias.name):
                        importlib.import_module(f"{node.module}.{alias.name}")
            elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "probcal":
                assert hasattr(importlib.import_module("probcal"), node.attr), node.attr


# the kernel client leaves sockets and event loops to the garbage collector
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning", "ignore::pytest.PytestUnraisableExceptionWarning")  # fmt: skip # noqa: E501
@pytest.mark.parametrize(
    "path",
    [pytest.param(p, marks=pytest.mark.ci if p.stem in SAMPLE else pytest.mark.slow)
     for p in NOTEBOOKS],
    ids=lambda path: path.stem,
)  # fmt: skip
def test_a_notebook_runs(path, monkeypatch):
    if path.stem >= "06":  # samplers: their work is run time, not compilation
        monkeypatch.delenv("XLA_FLAGS", raising=False)
    book = nbformat.read(path, as_version=4)
    client = nbclient.NotebookClient(book, timeout=900, resources={"metadata": {"path": str(path.parent)}})
    client.execute()
