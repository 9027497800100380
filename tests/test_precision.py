"""Double precision without touching jax: checked in this process, as a user's, and in a fresh one with x64 on."""

import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pandas as pd
import pytest
from contracts import only

import probcal
from probcal import ConstantVelocity, Network, Node, Target
from probcal.gaussian.mode import compress_rows

SCRIPT = """
import json
import sys

import jax

jax.config.update("jax_enable_x64", True)
import runpy
print(json.dumps(runpy.run_path("test_precision.py")["told"]()))
"""


def table(seed=0):
    """Twelve noisy ranges and azimuths of a straight walk past two radars, the second one shifted."""
    random, rows = np.random.default_rng(seed), []
    for t in np.arange(6.0):
        x, y = 5.0 + 4.0 * t, 10.0 + 2.0 * t
        for name, a, b in (("r0", 0.0, 0.0), ("r1", 46.0, 6.0)):
            noise = random.standard_normal(2) * (10.0, 0.17)
            rows.append((t, name, np.hypot(x - a, y - b) + noise[0], np.arctan2(y - b, x - a) + noise[1]))
    return pd.DataFrame(rows, columns=["time", "sensor", "range", "azimuth"])


def fitted(data):
    """A problem and its fit by EA (few iterations: its numbers matter, not where it ends)."""
    nodes = [Node("r0", (0.0, 0.0)), Node("r1", (40.0, 5.0), scale={"position": 5.0, "heading": 0.1})]
    start = {"position": ((5.0, 10.0), 5.0), "velocity": ((4.0, 2.0), 0.5)}
    motion = Target(ConstantVelocity(0.3), start)
    problem = probcal.Problem(Network([probcal.sensors.radar.on(node) for node in nodes]), motion, data)
    return problem, probcal.fit(problem, probcal.EA(iterations=20))


def told():
    """What a fit leaves in this process, and its numbers."""
    before = dict(jax.config.values)
    problem, tree = fitted(table())
    after = dict(jax.config.values)
    kinds = {}
    for node in tree.subtree:
        for name, variable in node.dataset.variables.items():
            kinds[f"{node.path}/{name}"] = (type(variable.values).__name__, str(variable.dtype))
    group, track = tree["calibration"].to_dataset(), only(tree)
    return {
        "changed_by_fit": sorted(k for k in after if after[k] != before.get(k, after[k])),
        "x64": bool(jax.config.jax_enable_x64),
        "default_dtype": str(jax.numpy.zeros(1).dtype),
        "kinds": kinds,
        "scales": str(problem.scales.dtype),
        "mean": group["mean"].values.tolist(),
        "covariance": group["covariance"].values.tolist(),
        "precision": group["precision"].values.tolist(),
        "track": track["mean"].values.tolist(),
        "track_sd": track["sd"].values.tolist(),
        "draws": tree["posterior"]["bias"].values[:, :3].tolist(),
        "evidence": tree.attrs["log_evidence_declared"],
    }


@pytest.fixture(scope="module")
def processes():
    """What a fit leaves in this process, as a user's, and in a fresh one with x64 on, with the same probcal."""
    paths = [str(Path(probcal.__file__).parents[1]), os.environ.get("PYTHONPATH", "")]
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT],
        cwd=Path(__file__).parent,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(path for path in paths if path)},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return {"plain": told(), "x64": json.loads(done.stdout.splitlines()[-1])}


@pytest.mark.ci
@pytest.mark.parametrize("mode", ["plain", "x64"])
def test_the_configuration_of_jax_stays(processes, mode):
    found = processes[mode]
    assert found["x64"] == (mode == "x64")
    assert found["default_dtype"] == ("float64" if mode == "x64" else "float32")
    assert found["changed_by_fit"] == []


def test_an_import_changes_no_configuration_and_allocates_no_array():
    code = (
        "import jax; before = dict(jax.config.values); import probcal; from probcal import EA, Problem, fit, sensors;"
        "after = dict(jax.config.values); assert not [k for k in after if after[k] != before.get(k, after[k])];"
        "assert not jax.live_arrays(); assert jax.numpy.zeros(1).dtype == 'float32'"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.ci
def test_results_are_numpy_in_double_precision(processes):
    kinds = processes["plain"]["kinds"]
    assert processes["plain"]["scales"] == "float64"
    assert {kind for kind, _ in kinds.values()} == {"ndarray"}
    for name in ("/posterior/bias", "/calibration/mean", "/track/target/sd", "/optimisation/objective"):
        assert kinds[name][1] == "float64"
    assert not [name for name, (_, dtype) in kinds.items() if dtype in ("float32", "float16", "int32")]


@pytest.mark.ci
@pytest.mark.parametrize("name", ["mean", "covariance", "precision", "track", "track_sd", "draws", "evidence"])
def test_results_equal_those_of_an_x64_process(processes, name):
    """The same kernels in the same precision: equal to the last bits (1e-12; float32 would leave 1e-7)."""
    plain, double = (np.array(processes[mode][name]) for mode in ("plain", "x64"))
    np.testing.assert_allclose(plain, double, rtol=1e-12, atol=1e-14)


@pytest.mark.ci
def test_results_carry_more_digits_than_float32(processes):
    for name in ("mean", "track", "draws"):
        values = np.array(processes["plain"][name]).ravel()
        assert (values != values.astype(np.float32)).mean() > 0.9


@pytest.mark.ci
def test_other_data_of_the_same_shape_compile_nothing(kept_kernels):
    """A kernel takes data as arguments: new numbers, and a network of the same form, reuse every trace."""
    _, first = fitted(table())
    traces = compress_rows._cache_size()
    assert traces > 0
    with pytest.raises(AssertionError, match="compilations"), NoCompile():
        jax.jit(lambda x: x + traces)(1.0)
    with NoCompile():
        _, second = fitted(table(1))
    assert compress_rows._cache_size() == traces
    assert not np.allclose(first["calibration"]["mean"], second["calibration"]["mean"])


class NoCompile:
    """Fails where jax compiles anything inside."""

    def __enter__(self):
        self.found = []
        self.listener = lambda event, duration, **_: (
            self.found.append(event) if event.endswith("backend_compile_duration") else None
        )
        jax.monitoring.register_event_duration_secs_listener(self.listener)

    def __exit__(self, kind, *_):
        jax.monitoring.unregister_event_duration_listener(self.listener)
        if kind is None:
            assert not self.found, f"{len(self.found)} compilations"
