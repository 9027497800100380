"""Long runs are safe: a kill at any moment, an interrupt, a resume, and another run in the same folder."""

import os
import random
import signal
import subprocess
import sys
import textwrap
import time
from dataclasses import replace

import numpy as np
import pytest
from worlds import plane, resting

import probcal
from probcal import NUTS, Collapsed, Gaussian, InputError
from probcal.inference.store import STATE, Store

METHOD = Collapsed(chains=2, warmup=50, draws=200, sweeps=1)
SCRIPT = """
import sys, time
sys.path.insert(0, {tests!r})
from worlds import plane, resting
import probcal
from probcal import NUTS, Collapsed, Gaussian
network, motion, table, _ = plane()
problem = probcal.Problem(network, motion, table)
def slowly(*_):
    print("chunk", flush=True)
    time.sleep({pause})
tree = probcal.fit(problem, {method!r}, prior=Gaussian(), start=resting(problem), key=5, store={store!r},
                   resume=True, progress=slowly)
probcal.save(tree, {out!r})
"""


def problem():
    network, motion, table, _ = plane()
    return probcal.Problem(network, motion, table)


def fitted(method=METHOD, key=5, **options):
    p = problem()
    return probcal.fit(p, method, prior=Gaussian(), start=resting(p), key=key, **options)


def killed(tmp_path, method, kills, seed):
    """Run a fit in a process that is killed at random moments and resumed until it ends; its tree."""
    random.seed(seed)
    out, store = tmp_path / "fit.nc", tmp_path / "draws"
    text = SCRIPT.format(
        tests=os.path.dirname(__file__), method=method, store=str(store), out=str(out), pause=0.05
    )  # fmt: skip
    script = tmp_path / "run.py"
    script.write_text(textwrap.dedent(text))
    happened = 0
    while not out.exists():
        process = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True)
        if happened < kills:
            assert process.stdout is not None
            process.stdout.readline()  # the first chunk is there: what follows is work and files
            time.sleep(random.uniform(0.0, 0.3))
            if process.poll() is None:
                process.send_signal(signal.SIGKILL)
                happened += 1
            process.communicate()
        else:
            process.communicate()
            assert process.returncode == 0
    assert happened > 0, "the run was long enough to be killed"
    return probcal.load(out)


def test_a_killed_run_is_resumed_with_the_same_draws(tmp_path):
    tree = killed(tmp_path, METHOD, 2, 0)
    whole = fitted()
    assert np.array_equal(tree["posterior"]["bias"], whole["posterior"]["bias"])
    assert np.array_equal(tree["sample_stats"]["lp"], whole["sample_stats"]["lp"])


@pytest.mark.slow
@pytest.mark.parametrize("method", [replace(METHOD, draws=1500), NUTS(chains=2, warmup=100, draws=300)])
def test_ten_kills_change_nothing(tmp_path, method):
    tree = killed(tmp_path, method, 10, 1)
    assert np.array_equal(tree["posterior"]["bias"], fitted(method)["posterior"]["bias"])


def steps(store, count, at=None):
    """Add chunks to a store; `at` is called before each file is renamed."""
    while store.count < count:
        k = store.count
        rng = np.random.default_rng(k if store.state is None else int(store.state[0]))
        store.add({"x": rng.standard_normal((2, 3, 4))}, [np.array(k + 1), np.array([1, 2], np.uint32)])


def test_a_stop_before_any_rename_loses_one_chunk_at_most(tmp_path, monkeypatch):
    steps(whole := Store(None, {"seed": "1"}, resume=False), 5)
    wanted = np.concatenate([c["x"] for c in whole.chunks()], 1)
    genuine = os.replace
    for moment in range(10):
        folder, left = tmp_path / str(moment), [moment]

        def stop(a, b, left=left):
            if left[0] == 0:
                raise OSError("stopped")
            left[0] -= 1
            genuine(a, b)

        monkeypatch.setattr(os, "replace", stop)
        with pytest.raises(OSError, match="stopped"):
            steps(Store(folder, {"seed": "1"}, resume=True), 5)
        monkeypatch.setattr(os, "replace", genuine)
        again = Store(folder, {"seed": "1"}, resume=True)
        assert again.count == moment // 2, "two renames a chunk: draws, then state"
        steps(again, 5)
        assert np.array_equal(np.concatenate([c["x"] for c in again.chunks()], 1), wanted)


def test_another_run_in_the_folder_is_refused_by_name(tmp_path):
    fitted(store=tmp_path / "draws")
    for changed, name in (({"key": 6}, "seed"), ({"method": replace(METHOD, draws=300)}, "method")):
        with pytest.raises(InputError, match=f"has another {name}; resume it as it began"):
            fitted(store=tmp_path / "draws", resume=True, **changed)
    again = fitted(store=tmp_path / "draws", resume=True)
    assert np.array_equal(again["posterior"]["bias"], fitted()["posterior"]["bias"]), "a finished run is read back"
    before = (tmp_path / "draws" / STATE).stat().st_mtime_ns
    fitted(store=tmp_path / "draws")
    assert (tmp_path / "draws" / STATE).stat().st_mtime_ns > before, "without resume it begins anew"


def test_an_interrupt_leaves_a_valid_partial_fit(tmp_path):
    def stop(name, count, value):
        if count >= 150:
            raise KeyboardInterrupt

    tree = fitted(progress=stop, store=tmp_path / "draws")
    assert tree.attrs["status"] == "not converged"
    assert "Interrupted after 100 of 200 draws" in tree.attrs["message"]
    assert tree["posterior"].sizes["draw"] == 100
    probcal.save(tree, tmp_path / "fit.nc")
    assert probcal.load(tmp_path / "fit.nc")["calibration"]["mean"].notnull().all()
    whole = fitted(store=tmp_path / "draws", resume=True)
    assert np.array_equal(whole["posterior"]["bias"].values[:, :100], tree["posterior"]["bias"].values)

    def early(name, count, value):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fitted(replace(METHOD, warmup=100), progress=early)
