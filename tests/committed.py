"""Results that are committed in `tests/data`, for tests of whatever reads a result: nothing is fitted for them.

`uv run python tests/committed.py` makes them anew (seed 3). `test_cli.py` says when that is due: it compares their
structure with what `probcal fit` writes today.
"""

from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import probcal
from probcal import add_scores

DATA = Path(__file__).parent / "data"
MODEL, ROWS = DATA / "small.py", DATA / "small.csv"
METHODS = {  # and how many draws of each chain are kept
    "ea": (probcal.EA(), 10),
    "map": (probcal.MAP(), 10),
    "collapsed": (probcal.Collapsed(chains=2, draws=60, warmup=50), 20),
}


@cache
def _read(name):
    return probcal.load(DATA / f"{name}.nc")


def tree(name):
    """A committed result, as a copy that a test may change."""
    return _read(name).copy(deep=True)


def structure(tree):
    """What a result consists of: (group, name) -> dimensions and kind of every variable, and the attributes."""
    found = {}
    for node in tree.subtree:
        found[node.path, "attributes"] = sorted(map(str, node.attrs))
        for name, values in node.to_dataset(inherit=False).variables.items():
            kind = "text" if values.dtype.kind in "OUT" else values.dtype.name
            found[node.path, str(name)] = (values.dims, kind)
    return found


def shortened(tree, draws):
    """A result with its first draws only."""
    short = tree.map_over_datasets(lambda d: d.isel(draw=slice(None, draws)) if "draw" in d.dims else d)
    short.attrs.update(tree.attrs)
    return short


def make():
    """Write the table with its truth, and a result of each method."""
    import sys

    sys.path.insert(0, str(DATA))
    import small

    simulation = small.scenario(3)
    simulation.write(ROWS)
    problem = small.problem(ROWS)
    for name, (method, draws) in METHODS.items():
        with TemporaryDirectory() as folder:  # as the command line does
            found = probcal.fit(problem, method, store=folder)
        found = probcal.assess(problem, found, truth=simulation.truth)
        found.attrs["model"] = "small"
        add_scores(found, simulation.truth)
        probcal.save(shortened(found, draws), DATA / f"{name}.nc")


if __name__ == "__main__":
    make()
