"""Several recordings of one network: each as a fit of its own, spread, resumed, and in one table."""

import shutil
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest
import xarray as xr
from terminal import call, run

from probcal import InputError, load
from probcal.cli import recordings
from probcal.cli.models import ModelFile
from probcal.cli.recordings import NOTE, Recordings
from probcal.inference.manifest import check_same

DATA = Path(__file__).parent / "data"
NUMBERS = ("mean", "sd", "lower", "upper", "gamma")
METHOD = ("--method", "map", "--no-assess")


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """A model and five recordings, the last of them no table."""
    folder = tmp_path_factory.mktemp("several")
    shutil.copy(DATA / "small.py", folder)
    table = pd.read_csv(DATA / "small.csv")
    for k in range(4):
        table.iloc[: len(table) - 3 * k].to_csv(folder / f"day{k}.csv", index=False)
    (folder / "day4.csv").write_text("nothing")
    return folder / "small.py"


def days(model, *numbers):
    return [model.parent / f"day{k}.csv" for k in numbers]


def same(one, other):
    """Two fits have the same numbers."""
    a, b = (load(path)["calibration"].to_dataset() for path in (one, other))
    xr.testing.assert_identical(a[list(NUMBERS)], b[list(NUMBERS)])


@pytest.mark.slow
def test_each_recording_is_fitted_as_alone_and_only_what_is_missing_again(model, tmp_path):
    out = tmp_path / "out"
    code, said, complaint = call("fit", model, *days(model, 0, 1), *METHOD, "--out", out)
    assert code == 0, complaint
    assert "2 recordings, 2 of them fitted now" in said
    assert call("fit", model, *days(model, 1), *METHOD, "--out", tmp_path / "alone")[0] == 0
    same(tmp_path / "alone", out / "day1")
    table = pd.read_csv(out / "fits.csv")
    assert list(table.columns) == ["recording", "status", "bias", "mean", "sd"]
    assert table["recording"].unique().tolist() == ["day0", "day1"]
    summary = pd.read_csv(out / "day1" / "summary.csv")
    assert table.loc[table["recording"] == "day1", "mean"].tolist() == summary["mean"].tolist()

    code, _, complaint = call("fit", model, *days(model, 0, 1), *METHOD, "--out", out)
    assert (code, "fits.csv is the result of another run; give --resume" in complaint) == (2, True)
    code, _, complaint = call("fit", model, *days(model, 0, 1), *METHOD, "--seed", 1, "--out", out, "--resume")
    assert (code, "day0: the seed has changed since the run there began" in complaint) == (2, True)
    before = (out / "day0" / "fit.nc").stat().st_mtime_ns
    (out / "day1" / "fit.nc").unlink()
    code, said, complaint = call("fit", model, *days(model, 0, 1, 2, 4), *METHOD, "--out", out, "--resume")
    assert code == 1
    assert "4 recordings, 2 of them fitted now" in said  # day4 is refused
    assert "\nday4: " in "\n" + complaint  # behind a line of progress, where it takes long
    assert (out / "day0" / "fit.nc").stat().st_mtime_ns == before
    same(tmp_path / "alone", out / "day1")
    table = pd.read_csv(out / "fits.csv")
    assert table["recording"].unique().tolist() == ["day0", "day1", "day2", "day4"]
    assert table["status"].tolist()[-1] == "refused"


def test_the_network_is_part_of_what_a_recording_is_resumed_with(tmp_path):
    def identity(network):
        return Recordings(ModelFile(tmp_path, ""), tmp_path, {"network": network}, True, False).identity("rows")

    (tmp_path / "network.csv").write_text("one")
    first = identity(tmp_path / "network.csv")
    (tmp_path / "network.csv").write_text("two")
    assert "network" not in identity(None)
    with pytest.raises(InputError, match="the network has changed since the run there began"):
        check_same(tmp_path, identity(tmp_path / "network.csv"), first)


@pytest.mark.ci
def test_ctrl_c_leaves_the_table_of_what_is_finished(model, tmp_path, monkeypatch):
    def interrupted(work, batches, **_):
        yield 0, work(batches[0])
        raise KeyboardInterrupt

    monkeypatch.setattr("probcal.cli.recordings.spread", interrupted)
    code, _, complaint = call("fit", model, *days(model, 0, 1), *METHOD, "--out", tmp_path / "out")
    assert code == 130
    assert "interrupted; 1 of 2 recordings are finished, --resume goes on" in complaint
    assert pd.read_csv(tmp_path / "out" / "fits.csv")["recording"].unique().tolist() == ["day0"]


@pytest.mark.slow
def test_recordings_spread_over_workers_and_killed_give_the_same_fits(model, tmp_path):
    words = ["fit", model, *days(model, 0, 1, 2, 3), *METHOD, "--out", tmp_path / "out", "--resume"]
    order = [sys.executable, "-m", "probcal.cli", *map(str, words), "--scheduler", "local"]
    process = subprocess.Popen(order, stderr=subprocess.PIPE, text=True)
    while not list((tmp_path / "out").glob("*/fit.nc")):
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)
    process.kill()
    process.communicate()
    done = run(*words, "--scheduler", "local")
    assert done.returncode == 0, done.stderr
    assert call("fit", model, *days(model, 0, 1, 2, 3), *METHOD, "--out", tmp_path / "whole")[0] == 0
    for k in range(4):
        same(tmp_path / "whole" / f"day{k}", tmp_path / "out" / f"day{k}")
    assert (tmp_path / "whole" / "fits.csv").read_text() == (tmp_path / "out" / "fits.csv").read_text()


def test_a_folder_that_workers_write_elsewhere_is_told(tmp_path):
    with pytest.raises(InputError, match="day0 is written where this process does not see it; give an --out that"):
        recordings._check_seen(tmp_path, Path("day0.csv"))
    (tmp_path / "day0").mkdir()
    (tmp_path / "day0" / NOTE).write_text("{}")
    recordings._check_seen(tmp_path, Path("day0.csv"))
