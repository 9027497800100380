"""SIGKILL at random moments of every long command: after `--resume` the results are those of an undisturbed run."""

import random
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import xarray as xr
from terminal import call, run

MODEL = '''
"""Three gauges of range and azimuth around one target; the second reads 3 m too far."""

import numpy as np

from probcal import Bias, Channel, ConstantVelocity, Network, Node, Problem, sensor, simulate
from probcal.geometry import bearing, norm


@sensor(range=Channel("m", std=1.0), azimuth=Channel("rad", std=0.02, wrap=True))
def gauge(target, pose, *, range_offset=Bias("m", 2.0)):
    line = target.position - pose.position
    return dict(range=norm(line) + range_offset, azimuth=bearing(line) - pose.heading)


def network():
    return Network([gauge.on(Node(f"gauge_{k}", place)) for k, place in enumerate([(0, 0), (60, 0), (0, 60)])])


def scenario(key=0):
    track = np.stack([np.linspace(10, 50, 12), 25 + 10 * np.sin(np.linspace(0, 3, 12))], 1)
    true = {"gauge_0.range_offset": 0.0, "gauge_1.range_offset": 3.0, "gauge_2.range_offset": 0.0}
    return simulate(network(), ConstantVelocity(0.5), np.arange(12.0), key=key, tracks={"car": track}, biases=true)


def problem(data=None):
    return Problem(network(), ConstantVelocity(0.5), data)


def setting(run):
    made = scenario(run)
    return problem(made.table), made.truth
'''
KINDS = {  # command, its results, its parts while it runs, and groups that must not differ
    "collapsed": (("fit", "--method", "collapsed", "--chains", "2", "--draws"), "fit.nc", "draws/chunk-*.npz",
                  ("posterior", "sample_stats", "calibration")),
    "ea-maximised": (("fit", "--method", "ea-maximised", "--starts"), "fit.nc", "draws/loop-*.npz",
                     ("posterior", "mode", "optimisation")),
    "nuts": (("fit", "--method", "nuts", "--chains", "2", "--warmup", "100", "--draws"), "fit.nc", "draws/chunk-*.npz",
             ("posterior", "sample_stats", "calibration")),
    "sbc": (("sbc", "--method", "map", "--posterior", "--runs"), "sbc.nc", "runs/runs-*.npz",
            ("sbc", "uniformity", "coverage")),
    "study": (("study", "--methods", "ml,em", "--runs"), "study.nc", "runs/fits.zarr/status/c/*/*", ("",)),
}  # fmt: skip
OF_STUDIES = [pytest.param(kind, marks=pytest.mark.needs("studies")) for kind in ("sbc", "study")]
LONGER = {"collapsed": 3000, "ea-maximised": 60, "nuts": 800, "sbc": 100, "study": 200}


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    folder = tmp_path_factory.mktemp("small")
    (folder / "small.py").write_text(MODEL)
    assert run("simulate", "small.py", "--out", "rows.csv", cwd=folder).returncode == 0
    return folder


def order_of(kind, size, model, out):
    words, *_ = KINDS[kind]
    data = () if kind == "study" else (model / "rows.csv",)
    return [words[0], model / "small.py", *data, *words[1:], size, "--out", out]


def killed(kind, size, model, out, kills):
    """Run a command that is killed when it has written one more part than before, until it ends; kills that hit."""
    chance, happened = random.Random(kills), 0
    _, result, pattern, _ = KINDS[kind]
    words = [sys.executable, "-m", "probcal.cli", *map(str, [*order_of(kind, size, model, out), "--resume"])]
    while True:
        before = len(list(out.glob(pattern)))
        process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        if happened < kills:
            while process.poll() is None and len(list(out.glob(pattern))) <= before and not (out / result).exists():
                time.sleep(0.002)
            time.sleep(chance.uniform(0.0, 0.05))
            if process.poll() is None:
                process.send_signal(signal.SIGKILL)
                happened += 1
        _, complaint = process.communicate()
        if process.returncode != -signal.SIGKILL:
            assert process.returncode in (0, 1), complaint
            return happened


def check(kind, size, model, folder, kills):
    """The results of a killed and resumed command are those of an undisturbed one; nothing is left over."""
    whole, out = folder / "whole", folder / "killed"
    code, _, complaint = call(*order_of(kind, size, model, whole))
    assert code in (0, 1), complaint
    happened = killed(kind, size, model, out, kills)
    assert happened >= min(kills, 5), "the command lasts long enough to be killed"
    _, result, _, groups = KINDS[kind]
    with xr.open_datatree(whole / result) as wanted, xr.open_datatree(out / result) as found:
        for group in groups:
            a, b = (tree[group].to_dataset() if group else tree.to_dataset() for tree in (wanted, found))
            for name in a.variables:
                assert np.array_equal(a[name].values, b[name].values, equal_nan=a[name].dtype.kind == "f"), name
    assert not [*out.rglob("*.part"), *out.rglob("*.partial")], "drafts of killed writes are cleared"
    assert not (out / "draws").exists()
    return happened


@pytest.mark.ci
def test_a_killed_command_is_resumed_with_the_same_results(model, tmp_path):
    """A climb; the slow tests kill every kind, and test_resume.py and test_studies.py stop each in this process."""
    check("ea-maximised", 12, model, tmp_path, 1)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["collapsed", "ea-maximised", "nuts", *OF_STUDIES])
def test_ten_kills_change_nothing(kind, model, tmp_path):
    check(kind, LONGER[kind], model, tmp_path, 10)


@pytest.mark.ci
def test_an_edited_model_is_not_resumed(model, tmp_path):
    """One more line of a model is another model; its old draws stay."""
    (tmp_path / "small.py").write_text(MODEL)
    words = ["--method", "collapsed", "--chains", "2", "--draws", "100000", "--out", tmp_path / "out"]
    order = ["fit", tmp_path / "small.py", model / "rows.csv", *words]
    process = subprocess.Popen([sys.executable, "-m", "probcal.cli", *map(str, order)])
    while len(list((tmp_path / "out").glob("draws/chunk-*.npz"))) < 2:
        time.sleep(0.01)
    busy = run(*order, "--resume")
    process.kill()
    process.wait()
    assert busy.returncode == 2
    assert "another process is working there" in busy.stderr
    (tmp_path / "small.py").write_text(MODEL.replace("norm(line) + range_offset", "norm(line) * 1.05 + range_offset"))
    before = sorted((tmp_path / "out").rglob("chunk-*.npz"))
    for more, text in (
        ("--resume", "the model has changed since the run there began"),
        (None, "holds a sampler's run"),
    ):
        done = run(*order, *([more] if more else []))
        assert done.returncode == 2
        assert text in done.stderr
        assert done.stderr.count("\n") == 1
    done = run("fit", tmp_path / "small.py", model / "rows.csv", "--method", "ea", "--out", tmp_path / "out")
    assert done.returncode == 2
    assert "holds a sampler's run" in done.stderr
    assert sorted((tmp_path / "out").rglob("chunk-*.npz")) == before
