"""The store of a study's fits: what is done survives a stop at any moment; damage is told; settings and runs grow."""

import json
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from probcal import InputError, load_study
from probcal.diagnostics import study_table
from probcal.inference.manifest import stored_run
from probcal.inference.storage import Storage
from probcal.plots import plot_study
from probcal.studies.fits import BATCH, open_fits

METHODS, LABELS = ["ml", "em"], ("a.x", "b.y", "b.z")
RUN = {"list of methods": "ml, em"}
AXES = {"kind": ["C1", "C2"], "share": [0.25, 0.5]}


def record(point, run, method):
    """What a fit would leave, every number its own."""
    seed = [run, METHODS.index(method), *(10 * AXES[name].index(value) for name, value in point.items())]
    drawn = np.random.default_rng(seed).random((8, len(LABELS)))
    vectors = dict(zip(("error", "lower", "upper", "true", "sd", "gamma"), drawn[2:], strict=True))
    scalars = dict(zip(("bias_rmse", "coverage", "position_rmse"), drawn[0], strict=True))
    status = "iterations spent" if run % 3 else "converged"
    return {"run": run, "method": method, "labels": LABELS, "status": status, "ran": method.upper(), "iterations": run,
            **scalars, **vectors}  # fmt: skip


def points(axes):
    return [{"kind": kind, "share": share} for kind in axes["kind"] for share in axes["share"]]


def fill(path, axes, runs, most=None, **options):
    """Make what is missing, `most` batches of it: the fits, and how many batches that was."""
    done = 0
    with Storage(path, "study", RUN, **options) as storage:
        fits = open_fits(storage, axes, METHODS, runs)
        for point in points(axes):
            for block in fits.missing(point):
                if done == most:
                    return fits.dataset(axes, runs), done
                made = [record(point, run, method) for method in METHODS for run in block]
                made[0]["problem"] = 1 + block[0]
                fits.add(point, made)
                done += 1
        return fits.dataset(axes, runs), done


WHOLE, _ = fill(None, AXES, range(25))


def test_a_store_holds_the_dataset_and_any_reader_of_zarr_opens_it(tmp_path):
    found, made = fill(tmp_path, AXES, range(25))
    xr.testing.assert_identical(found, WHOLE)
    assert made == 12
    assert list(found["error"].dims) == ["kind", "share", "estimator", "run", "bias_label"]
    whole = load_study(tmp_path)
    xr.testing.assert_equal(whole, WHOLE)
    assert whole.attrs["identity"] == Storage(None, "study", RUN).digest
    with xr.open_zarr(tmp_path / "fits.zarr", chunks=None) as plain:
        for name in ("bias_rmse", "error", "iterations"):
            np.testing.assert_array_equal(plain[name], WHOLE[name])
        assert plain["status"].dtype == np.int8
        words = plain["status"].attrs["flag_meanings"].split()
        assert words[int(plain["status"][0, 0, 0, 1])] == "iterations_spent"
        assert plain["ran"].attrs["flag_meanings"] == "ML EM"
        assert plain["share"].values.tolist() == [0.25, 0.5]
    assert stored_run(tmp_path) == "the fits of a study"


def test_more_runs_and_settings_are_added_and_fewer_are_chosen(tmp_path):
    first = {"kind": ["C2"], "share": [0.5]}
    assert fill(tmp_path, first, [12, 3, 7])[1] == 1
    found, made = fill(tmp_path, AXES, range(25), resume=True)
    xr.testing.assert_identical(found, WHOLE)
    assert made == 12
    assert load_study(tmp_path)["share"].values.tolist() == [0.5, 0.25]
    some, made = fill(tmp_path, first, [7, 20], resume=True)
    assert made == 0
    xr.testing.assert_identical(some, WHOLE.sel(kind=["C2"], share=[0.5], run=[7, 20]))
    turned = {"share": AXES["share"], "kind": AXES["kind"]}
    found, made = fill(tmp_path, turned, range(25), resume=True)
    assert (made, found["error"].dims[:2]) == (0, ("share", "kind"))
    xr.testing.assert_equal(found.transpose("kind", ...), WHOLE)


def test_a_stop_before_any_file_loses_one_batch_at_most(tmp_path, monkeypatch):
    genuine, calls = Path.replace, [0]

    def counted(self, target):
        calls[0] += 1
        return genuine(self, target)

    def halted(moment):
        left = [moment]

        def stop(self, target):
            left[0] -= 1
            if left[0] < 0:
                raise OSError(5, "stopped")
            return genuine(self, target)

        return stop

    axes = {"kind": ["C1"], "share": [0.25]}

    def grow(folder):
        for runs in (5, 25):
            fill(folder, axes, range(runs), resume=True)

    monkeypatch.setattr(Path, "replace", counted)
    grow(tmp_path / "whole")
    total = calls[0]
    for moment in range(0, total, 7):
        folder = tmp_path / str(moment)
        monkeypatch.setattr(Path, "replace", halted(moment))
        with pytest.raises(InputError, match=r"fits\.zarr cannot be written: stopped"):
            grow(folder)
        monkeypatch.setattr(Path, "replace", genuine)
        found, made = fill(folder, axes, range(25), resume=True)
        assert made <= 3
        xr.testing.assert_identical(found, WHOLE.sel(kind=["C1"], share=[0.25]))
        xr.testing.assert_equal(load_study(folder), found)
        with xr.open_zarr(folder / "fits.zarr", chunks=None) as plain:
            np.testing.assert_array_equal(plain["sd"], found["sd"])
        assert not list(folder.rglob("*.partial"))


def test_a_lost_file_of_a_chunk_is_made_anew(tmp_path):
    fill(tmp_path, AXES, range(25))
    for lost in ("error/c/0/0/0/1/0", "problem/c/1/1/2", "status/c/1/0/0/0"):
        (tmp_path / "fits.zarr" / lost).unlink()
        assert int((load_study(tmp_path)["status"] == "").sum()) in (2 * BATCH, 10)
        found, made = fill(tmp_path, AXES, range(25), resume=True)
        assert made == 1
        xr.testing.assert_identical(found, WHOLE)


@pytest.mark.parametrize("change", ["cut", "flipped", "empty"])
def test_a_damaged_chunk_is_told_by_its_file(change, tmp_path):
    fill(tmp_path, AXES, range(25))
    file = tmp_path / "fits.zarr" / "upper/c/0/1/0/2/0"
    content = file.read_bytes()
    flipped = content[:20] + bytes([content[20] ^ 1]) + content[21:]
    file.write_bytes({"cut": content[:-9], "flipped": flipped, "empty": b""}[change])
    text = r"upper/c/0/1/0/2/0 is damaged \(\w+\): delete it and --resume \(resume=True\) makes it anew"
    with pytest.raises(InputError, match=text):
        fill(tmp_path, AXES, range(25), resume=True)
    with pytest.raises(InputError, match=text):
        load_study(tmp_path)
    file.unlink()
    found, made = fill(tmp_path, AXES, range(25), resume=True)
    assert made == 1
    xr.testing.assert_identical(found, WHOLE)


def test_what_is_no_store_of_this_study_is_one_sentence(tmp_path):
    with pytest.raises(InputError, match="holds no finished fits of a study; give its store, or the --out"):
        load_study(tmp_path)
    fill(tmp_path, AXES, range(5))
    with (
        Storage(tmp_path, "study", RUN, resume=True) as storage,
        pytest.raises(InputError, match="is a study over kind, share; vary the same, give another folder"),
    ):
        open_fits(storage, {"size": [1]}, METHODS, range(5))
    described = tmp_path / "fits.zarr" / "zarr.json"
    genuine = described.read_text()
    described.write_text(genuine.replace(Storage(None, "study", RUN).digest, "0" * 64))
    with pytest.raises(InputError, match=r"fits\.zarr does not belong to the run of its folder; give another, or"):
        fill(tmp_path, AXES, range(5), resume=True)
    other = json.loads(genuine)
    del other["attributes"]["layout"]
    described.write_text(json.dumps(other))
    with pytest.raises(InputError, match=r"fits\.zarr cannot be read \(KeyError: .*\); give another folder, or give"):
        fill(tmp_path, AXES, range(5), resume=True)
    (tmp_path / "fits.zarr" / "mine.txt").write_text("a remark")
    found, made = fill(tmp_path, AXES, range(25), overwrite=True)
    assert made == 12
    xr.testing.assert_identical(found, WHOLE)
    assert (tmp_path / "fits.zarr" / "mine.txt").exists()


def test_half_a_study_has_a_table_and_a_picture(tmp_path):
    fill(tmp_path, AXES, range(25), most=7)
    part = load_study(tmp_path)
    table = study_table(part)
    assert table["runs"].tolist() == [25, 25, 25, 25, 10, 10]
    assert table["mean"].tolist() == study_table(WHOLE)["mean"].tolist()[:4] + table["mean"].tolist()[4:]
    assert np.isfinite(plot_study(part)[0].lines[0].get_ydata()).all()
    assert not np.isfinite(plot_study(part)[1].lines[0].get_ydata()).all()
    assert len(plot_study(WHOLE.isel(kind=0, drop=True))) == 1, "a single setting"
    for name in ("bias_rmse", "error", "gamma"):
        assert np.isnan(part[name].values[part["status"].values == ""]).all()
