"""The core imports no wing, and does without each: what it leaves out, and what it says."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import NEEDS
from without_wings import ROOT, package_without

import probcal
from probcal.status import Status
from probcal.wings import COMMANDS, METHODS, NAMES, PARTS, PICTURES, WINGS, WingMissing, installed, loaded

ALONE = """
import contextlib, importlib, io, json, pkgutil, sys
import numpy as np
import pytest
def said(*words):
    sys.argv = ["probcal", *words]
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), contextlib.suppress(SystemExit):
        importlib.import_module("probcal.cli").main()
    return " ".join((out.getvalue() + err.getvalue()).split())
for folder, (orders, more) in ORDERS.items():
    for name in [*sys.modules]:
        if name.split(".")[0] == "probcal" or str(getattr(sys.modules[name], "__file__", "")).startswith(TESTS):
            del sys.modules[name]
    sys.path.insert(0, folder)
    pc = importlib.import_module("probcal")
    names = [*pc.__all__, *pc.plots.__all__, *said("--help").split()]
    found = {"file": pc.__file__, "names": names, "said": [said(*words) for words in orders]}
    if len(orders) == MOST:
        for module in pkgutil.walk_packages(pc.__path__, "probcal."):
            if not module.name.endswith("__main__"):
                importlib.import_module(module.name)
        places = {"a": (0, 0), "b": (9, 0), "c": (0, 9)}
        nodes = [pc.Node(name, place, scale={"position": 1.0}) for name, place in places.items()]
        network, motion = pc.Network([pc.sensors.ranger.on(node) for node in nodes]), pc.ConstantVelocity(1.0)
        path = np.stack([np.linspace(1, 8, 8), np.linspace(2, 5, 8)], 1)
        run = pc.simulate(network, motion, np.arange(8.0), key=1, tracks={"t": path})
        found["status"] = pc.fit(pc.Problem(network, motion, run.table), pc.MAP()).attrs["status"]
    with contextlib.redirect_stdout(io.StringIO()) as out:
        found["collected"] = int(pytest.main([TESTS, *QUICKLY, *more])), out.getvalue()[-3000:]
    print(json.dumps(found), flush=True)
    sys.path.remove(folder)
"""


def of(module, wings):
    return module.split(".")[1] in wings


def orders_of(wings):
    """Commands that ask for what wings give, by the name that is said to be missing and its wing."""
    asked = {f"probcal {name}": (home, (name, "--what", "ever")) for name, home in COMMANDS.items()}
    asked |= {name: (home, ("fit", "m.py", "--method", name)) for name, home in METHODS.items()}
    return {(name, home.split(".")[1]): words for name, (home, words) in asked.items() if of(home, wings)}


def named(path):
    """Whether a file of tests says that it needs a wing, or asks what is installed."""
    return path.name in NEEDS or re.search(r"installed\(|ImportError|WingMissing", path.read_text())


@pytest.mark.ci
def test_the_core_does_without_each_wing_and_without_all(tmp_path):
    """What is left says its help and collects its tests; without any wing all modules are imported, and one fits.

    Files of tests that name no wing are collected once, without any: what they import is there without one as well. So
    with modules: `test_floors.py` keeps the core and each wing from importing another wing.
    """
    without = {tmp_path / wing: [wing] for wing in WINGS} | {tmp_path / "all": [*WINGS]}
    orders = {str(package_without(folder, *wings)): orders_of(wings) for folder, wings in without.items()}
    settings = ["-c", str(ROOT / "pyproject.toml")]
    quickly = ["--collect-only", "-qq", "-n0", "-pno:cacheprovider", "--assert=plain"]
    core = [path for path in sorted((ROOT / "tests").glob("test_*.py")) if not named(path)]
    seen = {folder: [f"--ignore={path}" for path in core] for folder in orders} | {str(tmp_path / "all"): []}
    given = {
        "ORDERS": {folder: ([*own.values()], seen[folder]) for folder, own in orders.items()},
        "TESTS": str(ROOT / "tests"), "QUICKLY": settings + quickly, "MOST": max(map(len, orders.values())),
    }  # fmt: skip
    code = "".join(f"{name} = {value!r}\n" for name, value in given.items()) + ALONE
    run = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, check=False, timeout=900,
        env=os.environ | {"PYTHONPATH": ""},
    )  # fmt: skip
    assert run.returncode == 0, run.stdout[-3000:] + run.stderr[-3000:]
    for (folder, own), wings, line in zip(orders.items(), without.values(), run.stdout.splitlines(), strict=True):
        found = json.loads(line)
        assert found["file"] == f"{folder}/probcal/__init__.py"
        assert found["collected"][0] == 0, (wings, found["collected"][1])
        gone = {name for home, names in {**NAMES, **PICTURES}.items() if of(home, wings) for name in names.split()}
        assert not {*gone, *(name for name, home in COMMANDS.items() if of(home, wings))} & set(found["names"])
        for (name, wing), sentence in zip(own, found["said"], strict=True):
            assert sentence == f"probcal: {name} needs the folder probcal/{wing}, which is not installed"
    assert found["status"] in set(Status)


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
