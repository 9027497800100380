"""The core imports no wing, and does without each: what it leaves out, and what it says."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from without_wings import ROOT, package_without

import probcal
from probcal.status import Status
from probcal.wings import COMMANDS, METHODS, NAMES, PARTS, PICTURES, WINGS, WingMissing, installed, loaded

ALONE = """
import contextlib, importlib, io, pkgutil, sys
import numpy as np
import pytest
import probcal as pc
from probcal import sensors
from probcal.cli import main
def said(*words):
    sys.argv = ["probcal", *words]
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), contextlib.suppress(SystemExit):
        main()
    return " ".join((out.getvalue() + err.getvalue()).split())
for module in pkgutil.walk_packages(pc.__path__, "probcal."):
    if not module.name.endswith("__main__"):
        importlib.import_module(module.name)
nodes = [pc.Node(name, place, scale={"position": 1.0}) for name, place in (("a", (0, 0)), ("b", (9, 0)), ("c", (0, 9)))]
network, motion = pc.Network([sensors.ranger.on(node) for node in nodes]), pc.ConstantVelocity(1.0)
path = np.stack([np.linspace(1, 8, 8), np.linspace(2, 5, 8)], 1)
run = pc.simulate(network, motion, np.arange(8.0), key=1, tracks={"t": path})
print(pc.__file__, pc.fit(pc.Problem(network, motion, run.table), pc.EA()).attrs["status"])
print(*pc.__all__, *pc.plots.__all__, said("--help"))
for words in ORDERS:
    print(said(*words))
sys.exit(pytest.main(TESTS))
"""


def of(module, wing):
    return module.split(".")[1] == wing


def orders_of(wing):
    """Commands that ask for what a wing gives, each with the name that is said to be missing."""
    commands = {f"probcal {name}": (name, "--what", "ever") for name, home in COMMANDS.items() if of(home, wing)}
    return commands | {name: ("fit", "m.py", "--method", name) for name, home in METHODS.items() if of(home, wing)}


def alone(wing, folder):
    """All that is left without a wing is imported, says its help, fits, and collects its tests."""
    environment = os.environ | {"PYTHONPATH": str(package_without(folder, wing))}
    quickly = ["--collect-only", "-qq", "-n", "0", "-p", "no:cacheprovider", "--assert=plain"]
    tests = [str(ROOT / "tests"), "-c", str(ROOT / "pyproject.toml"), *quickly]
    code = ALONE.replace("ORDERS", repr([*orders_of(wing).values()])).replace("TESTS", repr(tests))
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=folder, env=environment, check=False,
        timeout=900,
    )  # fmt: skip


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """The package without each wing and its process, two at a time."""
    pool, folders = ThreadPoolExecutor(2), {wing: tmp_path_factory.mktemp(wing) for wing in WINGS}
    yield {wing: (folder, pool.submit(alone, wing, folder)) for wing, folder in folders.items()}
    pool.shutdown(cancel_futures=True)


@pytest.mark.ci
@pytest.mark.parametrize("wing", WINGS)
def test_the_core_does_without_a_wing(wing, runs):
    folder, run = runs[wing]
    done, missing = run.result(), orders_of(wing)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    where, names, *sentences = done.stdout.splitlines()[: 2 + len(missing)]
    assert where.split()[0] == str(folder / "probcal" / "__init__.py")
    assert where.removeprefix(where.split()[0] + " ") in set(Status)
    gone = {name for home, own in {**NAMES, **PICTURES}.items() if of(home, wing) for name in own.split()}
    assert not {*gone, *(name for name, home in COMMANDS.items() if of(home, wing))} & set(names.split())
    for name, sentence in zip(missing, sentences, strict=True):
        assert sentence == f"probcal: {name} needs the folder probcal/{wing}, which is not installed"


def test_what_is_of_a_wing_that_is_missing_says_so(monkeypatch):
    monkeypatch.setattr("probcal.wings.WINGS", (*WINGS, "sails"))
    assert not installed("probcal.sails.canvas")
    monkeypatch.setitem(probcal._homes, "hoist", "probcal.sails.canvas")
    with pytest.raises(WingMissing, match=r"^hoist needs the folder probcal/sails, which is not installed$"):
        probcal.hoist  # noqa: B018
    with pytest.raises(ImportError, match="the folder probcal/sails, which is not installed"):
        from probcal import hoist  # noqa: F401
    with pytest.raises(WingMissing, match=r"^probcal.sails needs the folder probcal/sails"):
        probcal.sails  # noqa: B018
    assert loaded("probcal.labels", "labels").__name__ == "probcal.labels"


def test_every_wing_is_a_folder_of_the_package():
    """`WINGS` lists them all; one that is missing here was taken out on purpose."""
    folders = {path.parent.name for path in Path(probcal.__file__).parent.glob("*/__init__.py")}
    assert folders >= {wing for wing in WINGS if installed(f"probcal.{wing}")}
    homes = [*NAMES, *PARTS, *PICTURES, *COMMANDS.values(), *METHODS.values()]
    assert {home.split(".")[1] for home in homes} <= set(WINGS)
