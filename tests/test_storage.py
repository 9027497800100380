"""Files whole or absent, folders of parts, and what a fit read back from disk must hold: no command destroys work."""

import errno
import os
import re
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path

import committed
import h5py
import jax
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from worlds import plane, resting

import probcal
from probcal import (
    EA,
    MAP,
    Bias,
    Channel,
    Collapsed,
    Gaussian,
    InputError,
    Network,
    Node,
    Problem,
    StudentT,
    files,
    sensor,
)
from probcal.cli.outputs import FIT, results_of_a_run
from probcal.files import LOCK, NOTE, Lock, Outputs, make_folder, write_whole
from probcal.geometry import norm
from probcal.inference import identity
from probcal.inference.manifest import MANIFEST, remove_run, stored_run, write_manifest
from probcal.inference.storage import Chunks, Records, Storage
from probcal.results.io import SEAL, SMALL, _semi_definite, check_content
from probcal.results.modes import alike

RUN = {"method": "NUTS()", "seed": "1", "model": "abc"}


def listing(folder):
    """Visible files of a folder, and hidden ones that are neither lock nor note."""
    return sorted(name for name in os.listdir(folder) if name not in (LOCK, NOTE))


def chunks(path, count=4, identity=RUN, **options):
    """A run of a sampler that stops after some chunks."""
    with Storage(path, "draws", identity, **options) as storage:
        box = Chunks(storage)
        (k, *_), course = box.found or ([np.array(0)], [])
        while len(course) < count:
            course.append({"x": np.random.default_rng(int(k)).standard_normal((2, 3, 4))})
            box.write([k := k + 1, np.array([1, 2], np.uint32)], course)
        return np.concatenate([chunk["x"] for chunk in course], 1)


# files


def test_a_file_is_whole_or_absent_whatever_happens(tmp_path, monkeypatch):
    path = tmp_path / "a.csv"
    write_whole(path, "old\n")
    (tmp_path / "plain").touch()
    assert path.stat().st_mode == (tmp_path / "plain").stat().st_mode
    (tmp_path / "plain").unlink()

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    for call in ("fsync", "replace"):
        with monkeypatch.context() as patch:
            patch.setattr(os, call, full)
            with pytest.raises(InputError, match=r"a\.csv cannot be written: No space left on device"):
                write_whole(path, "new\n")
        assert listing(tmp_path) == ["a.csv"]
        assert path.read_text() == "old\n"
    write_whole(path, b"new\n")
    assert path.read_text() == "new\n"


def test_drafts_of_a_killed_write_are_cleared_by_the_next(tmp_path):
    left = tmp_path / ".fit.nc.probcal-0123abcd.part"
    others = [".fit.nc.part", ".mine.probcal-xyz.part", "thesis.part"]
    for name in (left.name, *others):
        (tmp_path / name).write_text("half")
    draft, handle = files._draft(tmp_path / "living.csv")  # of another process, that still writes
    write_whole(tmp_path / "b.csv", "b")
    assert listing(tmp_path) == sorted([*others, draft.name, "b.csv"])
    os.close(handle)
    write_whole(tmp_path / "b.csv", "b")
    assert listing(tmp_path) == sorted([*others, "b.csv"])


def test_a_folder_that_cannot_be_is_one_sentence(tmp_path):
    (tmp_path / "draws").write_text("a file")
    with pytest.raises(InputError, match="draws is a file; give the name of a folder"):
        make_folder(tmp_path / "draws")
    with pytest.raises(InputError, match="cannot be written: Not a directory"):
        make_folder(tmp_path / "draws" / "deeper")
    with pytest.raises(InputError, match="is a file; give the name of a folder"):
        chunks(tmp_path / "draws")


def test_one_process_at_a_time_works_in_a_folder(tmp_path):
    lock = Lock(tmp_path)
    text = "another process is working there; wait until it has ended, or give another folder"
    with pytest.raises(InputError, match=text):
        chunks(tmp_path)
    lock.release()
    chunks(tmp_path)
    with Storage(tmp_path, "draws", RUN, resume=True), pytest.raises(InputError, match=text):
        chunks(tmp_path, overwrite=True)
    assert len(chunks(tmp_path, resume=True)) == 2


def test_only_files_that_probcal_wrote_and_nobody_changed_are_replaced(tmp_path):
    outputs, path = Outputs(tmp_path, ["summary.csv", "fit.nc"]), tmp_path / "summary.csv"
    for text in ("first", "second"):
        with outputs.writing("run 1"):
            path.write_text(text)
    assert outputs.runs() == {"run 1"}
    assert outputs.there == ["summary.csv"]
    path.write_text("with my remarks")
    with pytest.raises(InputError, match=r"summary\.csv is no file that probcal wrote here, or it was changed since"):
        outputs.check()
    outputs.remove("summary.csv")
    assert path.read_text() == "with my remarks"
    path.unlink()
    with suppress(RuntimeError), outputs.writing("run 2"):  # killed on the way
        path.write_text("half")
        raise RuntimeError
    outputs.check()
    assert outputs.runs() == set()
    outputs.remove("summary.csv")
    assert listing(tmp_path) == []
    with outputs.writing("run 3"):
        path.write_text("third")
    (tmp_path / "fit.nc").write_text("mine")
    with pytest.raises(InputError, match=r"fit\.nc is no file that probcal wrote"):
        outputs.check()
    (tmp_path / "fit.nc").unlink()
    (tmp_path / NOTE).write_text("[garbage")
    with pytest.raises(InputError, match=r"summary\.csv is no file that probcal wrote"):
        outputs.check()


def test_results_of_another_run_are_not_replaced(tmp_path):
    def enter(**options):
        with results_of_a_run(tmp_path, FIT, "draws", **{"resume": False, "overwrite": False} | options) as outputs:
            return outputs

    digest = Storage(None, "draws", RUN).digest
    with enter().writing(digest):
        (tmp_path / "fit.nc").write_text("a fit")
    with pytest.raises(InputError, match=r"fit\.nc is the result of another run; give --resume \(resume=True\)"):
        enter()
    text = r"fit\.nc is the result of a run that is finished, or of another than the one to go on with; give --ov"
    with pytest.raises(InputError, match=text):
        enter(resume=True)
    chunks(tmp_path / "draws", identity=RUN | {"seed": "2"})
    with pytest.raises(InputError, match=text):
        enter(resume=True)
    chunks(tmp_path / "draws", overwrite=True)
    enter(resume=True)
    with pytest.raises(InputError, match="resume and overwrite exclude each other"):
        enter(resume=True, overwrite=True)
    enter(overwrite=True).begin()
    (tmp_path / "fit.nc").unlink()
    with pytest.raises(InputError, match=r"draws holds a sampler's run \(NUTS\(\)\) already; give --resume"):
        enter()
    with (
        pytest.raises(InputError, match="--overwrite needs --out, the folder whose run it replaces"),
        results_of_a_run(None, FIT, "draws", resume=False, overwrite=True),
    ):
        pass
    lock = Lock(tmp_path)
    with pytest.raises(InputError, match="another process is working there"):
        enter(overwrite=True)
    lock.release()
    assert listing(tmp_path) == ["draws"]


# runs


def test_a_stop_before_any_rename_loses_one_chunk_at_most(tmp_path, monkeypatch):
    wanted = chunks(None)
    genuine = os.replace
    for moment in range(5):
        folder, left = tmp_path / str(moment), [moment]

        def stop(a, b, left=left):
            if left[0] == 0:
                raise OSError(errno.EIO, "stopped")
            left[0] -= 1
            genuine(a, b)

        monkeypatch.setattr(os, "replace", stop)
        with pytest.raises(InputError, match="cannot be written: stopped"):
            chunks(folder, resume=True)
        monkeypatch.setattr(os, "replace", genuine)
        there = listing(folder) if folder.exists() else []
        assert len(there) == (moment if moment > 1 else 0), "the manifest, then a file a chunk; nothing without a chunk"
        assert np.array_equal(chunks(folder, resume=True), wanted)


def test_a_folder_with_a_run_is_refused_unless_it_is_resumed_or_replaced(tmp_path):
    first = chunks(tmp_path)
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(InputError, match=r"holds a sampler's run \(NUTS\(\)\) already; give --resume \(resume=True\)"):
        chunks(tmp_path)
    for name in RUN:
        with pytest.raises(
            InputError, match=f"the {name} has changed since the run there began; resume it as it began"
        ):
            chunks(tmp_path, identity=RUN | {name: "other"}, resume=True)
    with pytest.raises(InputError, match="the start has changed since the run there began"):
        chunks(tmp_path, identity=RUN | {"start": "x"}, resume=True)
    with pytest.raises(InputError, match=r"holds a run of another kind \(draws\); give another folder"):
        Storage(tmp_path, "sbc", RUN, resume=True)
    with pytest.raises(InputError, match="resume and overwrite exclude each other: go on"):
        chunks(tmp_path, resume=True, overwrite=True)
    assert np.array_equal(chunks(tmp_path, resume=True), first)
    chunks(tmp_path, 2, identity=RUN | {"seed": "2"}, overwrite=True)
    assert listing(tmp_path) == sorted(["chunk-000000.npz", "chunk-000001.npz", MANIFEST, "thesis.txt"])
    assert stored_run(tmp_path) == "a sampler's run (NUTS())"


def test_a_run_removes_its_own_parts_only(tmp_path):
    folder = tmp_path / "draws"
    with Storage(folder, "draws", RUN):
        pass
    assert not folder.exists(), "without a part nothing is left"
    chunks(folder)
    digest = Storage(None, "draws", RUN).digest
    remove_run(folder, Storage(None, "draws", RUN | {"seed": "2"}).digest)
    assert len(listing(folder)) == 5
    (folder / "thesis.txt").write_text("mine")
    remove_run(folder, digest)
    assert listing(folder) == ["thesis.txt"]
    remove_run(folder, digest)
    (folder / "thesis.txt").unlink()
    chunks(folder)
    whole = (folder / MANIFEST).read_text()
    (folder / MANIFEST).write_text("damaged")
    remove_run(folder, digest)
    assert len(listing(folder)) == 5
    (folder / MANIFEST).write_text(whole)
    remove_run(folder, digest)
    assert not folder.exists()
    assert stored_run(folder) == ""


def copied(folder):
    (folder / "chunk-000001.npz").write_bytes((folder / "chunk-000002.npz").read_bytes())


def truncated(folder):
    file = folder / "chunk-000001.npz"
    file.write_bytes(file.read_bytes()[:-40])


def zeroed(folder):
    file = folder / "chunk-000001.npz"
    content = bytearray(file.read_bytes())
    content[200:260] = bytes(60)
    file.write_bytes(content)


def foreign(folder):
    np.savez(folder / "chunk-000001.npz", x=np.zeros(3))


def pickled(folder):
    np.savez(folder / "chunk-000001.npz", x=np.array([{}], object))


def of_another_run(folder):
    chunks(folder / "other", identity=RUN | {"seed": "2"})
    (folder / "chunk-000001.npz").write_bytes((folder / "other" / "chunk-000001.npz").read_bytes())


DAMAGED = r"chunk-000001\.npz is damaged .*: delete it and every later chunk and --resume \(resume=True\) makes it anew"
DAMAGES = [
    (lambda f: (f / "chunk-000001.npz").unlink(), r"chunk-000001\.npz is missing: delete it and every later chunk"),
    (lambda f: (f / "chunk-000000.npz").unlink(), r"chunk-000000\.npz is missing: "),
    (copied, r"chunk-000001\.npz is damaged or does not belong to the run of its folder: delete it"),
    (of_another_run, "is damaged or does not belong to the run of its folder"),
    (foreign, "is damaged or does not belong to the run of its folder"),
    (truncated, DAMAGED),
    (zeroed, DAMAGED),
    (pickled, DAMAGED),
    (lambda f: (f / "chunk-000001.npz").write_bytes(b""), DAMAGED),
    (lambda f: (f / "chunk-000001.npz").write_bytes(b"garbage" * 99), DAMAGED),
    (lambda f: (f / MANIFEST).write_bytes(b""), r"probcal-run\.json is damaged; give another folder, or give --overwr"),
    (lambda f: (f / MANIFEST).write_text("[]"), r"probcal-run\.json is damaged; "),
    (lambda f: (f / MANIFEST).write_text('{"kind": 1}'), r"probcal-run\.json is damaged; "),
    (
        lambda f: (f / MANIFEST).write_text((f / MANIFEST).read_text().replace("NUTS", "EA")),
        r"probcal-run\.json is damaged; ",
    ),
    (lambda f: (f / MANIFEST).unlink(), r"holds parts of a run without its manifest probcal-run\.json"),
]  # fmt: skip


@pytest.mark.parametrize(("damage", "text"), DAMAGES, ids=[re.sub(r"\W+", "-", text)[:40] for _, text in DAMAGES])
def test_damage_is_one_sentence_and_never_a_shorter_run(damage, text, tmp_path):
    wanted = chunks(tmp_path / "run")
    damage(tmp_path / "run")
    before = listing(tmp_path / "run")
    with pytest.raises(InputError, match=text) as caught:
        chunks(tmp_path / "run", resume=True)
    assert "\n" not in str(caught.value)
    assert listing(tmp_path / "run") == before
    if MANIFEST in before:
        assert np.array_equal(chunks(tmp_path / "run", overwrite=True), wanted)


def test_a_run_that_lost_its_end_goes_on(tmp_path):
    wanted = chunks(tmp_path)
    (tmp_path / "chunk-000003.npz").unlink()
    (tmp_path / "chunk-000002.npz").unlink()
    assert np.array_equal(chunks(tmp_path, resume=True), wanted)


@pytest.mark.parametrize("name", ["state.npz", "chunk-000000.nc", "batch-000000.npz", "runs.json"])
def test_a_run_of_an_older_version_is_refused(name, tmp_path):
    (tmp_path / name).write_text("old")
    for options in ({}, {"resume": True}, {"overwrite": True}):
        with pytest.raises(
            InputError, match="or written by an older probcal\\): move them away, or give another folder"
        ):
            chunks(tmp_path, **options)
    assert listing(tmp_path) == [name]


def test_fits_of_an_older_version_are_refused(tmp_path):
    write_manifest(tmp_path, "study", RUN)
    (tmp_path / "fits-000000.npz").write_text("old")
    for options in ({}, {"resume": True}, {"overwrite": True}):
        with pytest.raises(InputError, match=r"holds fits-\*\.npz of an older probcal: move them away, or"):
            Storage(tmp_path, "study", RUN, **options)
    assert listing(tmp_path) == ["fits-000000.npz", MANIFEST]


def test_records_come_from_threads_and_missing_ones_are_made_anew(tmp_path):
    def record(run):
        return {"rank": np.arange(3) + run, "status": np.array("fine")}

    with Storage(tmp_path, "sbc", RUN) as storage:
        box = Records(storage)
        work = [threading.Thread(target=box.add, args=([k, k + 1], [record(k), record(k + 1)])) for k in (0, 2, 4, 6)]
        for thread in work:
            thread.start()
        for thread in work:
            thread.join()
    (tmp_path / "runs-000002.npz").unlink()
    with Storage(tmp_path, "sbc", RUN, resume=True) as storage:
        box = Records(storage)
        assert sorted(box.records) == [0, 1, 4, 5, 6, 7]
        assert box.records[5]["rank"].tolist() == [5, 6, 7]
        assert box.records[5]["status"] == "fine"
    (tmp_path / "runs-000004.npz").write_bytes(b"garbage")
    text = r"runs-000004\.npz is damaged \(BadZipFile\): delete it and --resume \(resume=True\) makes it anew"
    with Storage(tmp_path, "sbc", RUN, resume=True) as storage, pytest.raises(InputError, match=text):
        Records(storage)


# identity


def gauge(scale=1.0, offset=1.0, std=1.0, noise=None, table=(0.0, 1.0)):
    """A gauge declared in a function: the same source gives another object every time."""
    constants = np.array(table)

    @sensor(range=Channel("m", std=std, noise=noise or StudentT(4.0)))
    def ranger(target, pose, *, shift=Bias("m", offset)):
        return {"range": norm(target.position - pose.position) * scale + shift + (constants * pose.heading).sum()}

    return ranger


def world(x=0.0, power=1.0, value=5.0, fix=(), **changes):
    kind = gauge(**changes)
    network = Network([kind.on(Node(f"n{k}", (4.0 * k + x, 3.0 * k), scale={"position": 1.0})) for k in range(3)])
    frame = {"time": [0.0, 0.0, 1.0, 1.0], "sensor": ["n0", "n1", "n2", "n0"], "range": [value, 4.0, 3.0, 4.5]}
    return Problem(network, probcal.ConstantVelocity(power), pd.DataFrame(frame), fix=fix)


CHANGES = [
    ({"value": 5.1}, "data"),
    ({"fix": ["n1.shift"]}, "list of biases"),
    ({"scale": 1.05}, "model"),
    ({"table": (0.0, 1.5)}, "model"),
    ({"offset": 2.0}, "model"),
    ({"std": 1.1}, "model"),
    ({"noise": StudentT(5.0)}, "model"),
    ({"x": 0.1}, "model"),
    ({"power": 2.0}, "model"),
]


@pytest.mark.parametrize(("change", "name"), CHANGES, ids=[str(change) for change, _ in CHANGES])
def test_what_is_changed_is_named(change, name):
    with jax.enable_x64(True):
        mine = identity.identity_of(world(), method=EA())
        assert mine == identity.identity_of(world(), method=EA()), "the same content is the same run"
        other = identity.identity_of(world(**change), method=EA())
    assert next(key for key in mine if mine[key] != other[key]) == name


def test_identity_holds_settings_and_versions(monkeypatch):
    found = identity.identity(method=EA(), prior_of_the_truths=Gaussian(), seed="3")
    assert found["method"] == repr(EA())
    assert list(found)[:2] == ["version of probcal", "version of the results"]
    assert "prior of the truths" in found
    assert "0x" not in identity.identity(prior=object())["prior"]


# fits


METHOD = Collapsed(chains=2, warmup=50, draws=200, sweeps=1)


def fitted(method=METHOD, key=5, **options):
    network, motion, table, _ = plane()
    p = Problem(network, motion, table)
    return probcal.fit(p, method, prior=Gaussian(), start=resting(p), key=key, **options)


def test_ctrl_c_in_the_warm_up_leaves_nothing_to_report():
    def early(at):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fitted(Collapsed(chains=2, warmup=100, draws=200, sweeps=1), progress=early)


def test_a_climb_does_not_go_on_with_draws(tmp_path):
    chunks(tmp_path)
    with pytest.raises(InputError, match=r"holds a sampler's run \(NUTS\(\)\) already; give --resume"):
        fitted(MAP(), store=tmp_path)
    with pytest.raises(InputError, match=r"holds a run of another kind \(draws\); give another folder, or give --over"):
        fitted(MAP(), store=tmp_path, resume=True)
    fitted(MAP(), store=tmp_path, overwrite=True)
    assert stored_run(tmp_path).startswith("a climb (MAP(")


@pytest.mark.ci
def test_a_state_of_another_form_is_refused(tmp_path, monkeypatch):
    fitted(store=tmp_path)
    genuine = Chunks.__init__

    def shortened(self, storage):
        genuine(self, storage)
        self.found[0].pop()

    monkeypatch.setattr(Chunks, "__init__", shortened)
    with pytest.raises(InputError, match="the state of the stored run has another form than this run's"):
        fitted(store=tmp_path, resume=True)


# results


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A saved fit, and its bytes."""
    path = tmp_path_factory.mktemp("saved") / "fit.nc"
    tree = committed.tree("ea")
    probcal.save(tree, path)
    return tree, path.read_bytes()


def test_a_saved_fit_is_read_back_as_it_was(saved, tmp_path):
    tree, content = saved
    (tmp_path / "fit.nc").write_bytes(content)
    again = probcal.load(tmp_path)
    xr.testing.assert_identical(again, tree)
    probcal.save(again, tmp_path / "again.nc")
    xr.testing.assert_identical(probcal.load(tmp_path / "again.nc"), tree)
    for group in again.subtree:
        for name, variable in group.to_dataset(inherit=False).variables.items():
            packed = variable.encoding
            if variable.nbytes > SMALL:
                assert packed["fletcher32"], name
                assert packed["zlib"], name


def test_every_damaged_stretch_of_a_fit_is_noticed(saved, tmp_path):
    _, content = saved
    length = len(content) // 20 + 1
    for at in range(0, len(content), length):
        damaged = bytearray(content)
        damaged[at : at + length] = bytes(min(length, len(content) - at))
        (tmp_path / "fit.nc").write_bytes(damaged)
        with pytest.raises(InputError, match=r"fit\.nc is (damaged: its checksum does not match|not a fit written by)"):
            probcal.load(tmp_path)


def test_an_array_has_its_own_checksum(saved, tmp_path):
    """A file that other programs rewrote has no digest of the whole; HDF5's stand for every array."""
    tree, _ = saved
    tree.to_netcdf(tmp_path / "other.nc", engine="h5netcdf")
    xr.testing.assert_identical(probcal.load(tmp_path / "other.nc"), tree)
    probcal.save(tree, tmp_path / "fit.nc")
    content = bytearray((tmp_path / "fit.nc").read_bytes()[: -len(SEAL) - 32])
    with h5py.File(tmp_path / "fit.nc") as file:
        chunk = file["posterior/bias"].id.get_chunk_info(0)
    content[chunk.byte_offset : chunk.byte_offset + chunk.size] = bytes(chunk.size)
    (tmp_path / "fit.nc").write_bytes(content)
    with pytest.raises(InputError, match=r"fit\.nc is not a fit written by probcal \(OSError"):
        probcal.load(tmp_path / "fit.nc")


def without(group, *names):
    def change(tree):
        if not names:
            del tree[group]
        else:
            tree[group] = xr.DataTree(tree[group].to_dataset().drop_vars(names))

    return change


def unset(name):
    return lambda tree: tree.attrs.pop(name)


def set_to(group, name, value):
    def change(tree):
        tree[group] = xr.DataTree(tree[group].to_dataset().assign({name: tree[group][name] * 0 + value}))

    return change


def made(group, of, name):
    def change(tree):
        one = tree[group].to_dataset()
        tree[group] = xr.DataTree(one.assign({name: of(one)}))

    return change


def sparse(place, covariance=1.0):
    """The form of a fit in sparse form: a block of one bias each, and where it says that this stands there."""

    def change(tree):
        one = tree["calibration"].to_dataset().drop_vars(["covariance", "information", "bias_label_other"])
        M = one.sizes["bias_label"]
        columns = {"block": np.arange(M), "block_place": np.full(M, place)}
        one = one.assign({name: ("bias_label", values) for name, values in columns.items()})
        one["block_covariance"] = (("bias_label", "place"), np.full((M, 1), covariance))
        tree["calibration"] = xr.DataTree(one)

    return change


@pytest.mark.parametrize("kind", [{"kind": ("mirror", ["scene"])}, {}], ids=["", "the first files"])
def test_a_file_of_version_3_has_its_other_answers_in_one_group(kind, tmp_path):
    """A mirror, found again from start 1; starts 0 and 2 came to the reported answer, start 3 ended far below."""
    tree = committed.tree("map")
    group = tree["calibration"].to_dataset()
    mean, sd, labels = group["mean"].values, group["sd"].values, {"bias_label": group["bias_label"].values}
    there = mean + 5 * sd
    del tree["mode"]
    biases, dims = np.stack([mean, there, mean + 0.1 * sd, mean - 9 * sd]), ("optimum", "bias_label")
    scores = {"objective": ("optimum", [-1.0, -2.0, -1.0, -50.0]), "start": ("optimum", range(4))}
    tree["optimum"] = xr.DataTree(
        xr.Dataset({"bias": (dims, biases), "status": ("optimum", ["converged"] * 4), **scores}, labels)
    )
    apart = ("mirror", "bias_label")
    mirror = {"gain": ("mirror", [-1.0]), "bias": (apart, there[None])} | kind
    tree["mirror"] = xr.DataTree(xr.Dataset(mirror, {"mirror": ["turned"], **labels}, {"same": 3.0}))
    car = tree["track/car"].to_dataset()
    places = car["mean"].sel(component=["position_x", "position_y"]).values[None]
    position = {"position": (("mirror", "time", "axis"), 1.0 + places)}
    tree["mirror/track/car"] = xr.DataTree(xr.Dataset(position, {"time": car["time"]}, {"target": "car"}))
    tree.attrs["results_version"] = 3
    probcal.save(tree, tmp_path / "fit.nc")
    tree = probcal.load(tmp_path)
    found = tree["mode"].to_dataset()
    assert found["kind"].values.tolist() == ["reported", "scene", "again", "again", "again", "rejected"]
    assert found["start"].values.tolist() == [-1, -1, 0, 1, 2, 3]
    assert found["gain"].values.tolist() == [0.0, -1.0, 0.0, -1.0, 0.0, -49.0]
    assert alike(tree)["mode"].values.tolist() == ["turned"]
    np.testing.assert_allclose(found["apart"].max("bias_label"), [0.0, 5.0, 0.0, 5.0, 0.1, 9.0])
    shown = tree["mode/track/car"]["position"].values
    np.testing.assert_allclose(shown[1] - shown[0], 1.0)
    assert {"mirror", "optimum"}.isdisjoint(tree.children)


LACKS = [
    (without("calibration"), "is not a fit written by probcal: its group calibration is missing"),
    (without("constant_data"), "is incomplete: its group constant_data lacks what a fit holds; fit again"),
    (without("observed_data"), "is incomplete: its group observed_data lacks"),
    (without("posterior"), "is incomplete: its group posterior lacks"),
    (without("residual", "weight"), "is incomplete: its group residual lacks"),
    (without("calibration", "covariance"), "is incomplete: its group calibration lacks"),
    (without("constant_data", "moving"), "is incomplete: its group constant_data lacks"),
    (without("track/car", "sd"), "is incomplete: its group track lacks"),
    (without("verdict", "reason"), "is incomplete: its group verdict lacks"),
    (unset("method"), "is incomplete: it has no attribute method; fit again"),
    (unset("interval_probability"), "is incomplete: it has no attribute interval_probability"),
    (unset("results_version"), "was written by an older probcal; fit again"),
    (lambda tree: tree.attrs.update(results_version=99), "was written by a newer probcal; fit again"),
    (set_to("calibration", "mean", np.nan), "calibration/mean holds nan, which no fit can have; the file was changed"),
    (set_to("calibration", "sd", np.inf), "calibration/sd holds inf, which no fit can have"),
    (set_to("calibration", "covariance", np.nan), "calibration/covariance holds nan, which no fit can have"),
    (set_to("calibration", "sd", -0.1), "calibration/sd holds -0.1, which no fit can have"),
    (set_to("calibration", "gamma", 1.5), "calibration/gamma holds 1.5, which no fit can have"),
    (set_to("track/car", "sd", -2.0), "track/car/sd holds -2, which no fit can have"),
    (set_to("observed_data", "y", np.nan), "observed_data/y holds nan, which no fit can have"),
    (set_to("calibration", "lower", 1e6), r"calibration/lower of \S+ lies above its upper; the file was changed"),
    (set_to("calibration", "covariance", -1.0), "calibration/covariance is no covariance matrix; the file was changed"),
    (made("calibration", lambda one: one["covariance"].copy(data=np.triu(one["covariance"])), "covariance"),
     "calibration/covariance is no covariance matrix"),
    (made("residual", lambda one: one["std"].astype(str), "std"), "residual/std holds no numbers; the file"),
    (made("calibration", lambda one: one["covariance"], "sd"), "calibration/sd has the dimensions .* in place of"),
    (made("calibration", lambda one: one["bias_label"].values[::-1], "bias_label"), "labels that differ or repeat"),
    (sparse(5), "calibration/block names no block; the file was changed"),
    (sparse(0, -1.0), "calibration/block_covariance is no covariance matrix"),
    (lambda tree: tree.attrs.update(status="done"), 'its attribute status is "done", which no fit has; fit again'),
    (lambda tree: tree.attrs.update(interval_probability=1.5), "interval_probability does not lie between 0 and 1"),
]  # fmt: skip


@pytest.mark.parametrize(("change", "text"), LACKS, ids=range(len(LACKS)))
def test_what_a_fit_lacks_is_one_sentence(change, text, saved):
    tree = saved[0].copy(deep=True)
    change(tree)
    with pytest.raises(InputError, match=text):
        check_content(tree, Path("fit.nc"))


def test_a_correlation_may_pass_1_by_rounding_only():
    for correlation, fits in ((1.0, True), (1.0 + 1e-7, True), (1.0 + 1e-5, False), (-1.5, False)):
        covariance = np.array([[4.0, 2.0 * correlation], [2.0 * correlation, 1.0]])
        assert _semi_definite(covariance[None]) == fits, correlation


def test_a_fit_in_sparse_form_is_one(saved):
    tree = saved[0].copy(deep=True)
    sparse(0)(tree)
    check_content(tree, Path("fit.nc"))


@pytest.mark.parametrize(("change", "text"), [LACKS[5], LACKS[9]], ids=["array", "attribute"])
def test_a_saved_fit_that_lacks_something_is_one_sentence(change, text, saved, tmp_path):
    tree = saved[0].copy(deep=True)
    change(tree)
    probcal.save(tree, tmp_path / "fit.nc")
    with pytest.raises(InputError, match=text):
        probcal.load(tmp_path)


@pytest.mark.parametrize("content", [b"", b"garbage", b"\x89HDF\r\n\x1a\n" + bytes(100), None])
def test_what_is_no_fit_is_one_sentence(content, tmp_path):
    if content is None:
        (tmp_path / "fit.nc").mkdir()
    else:
        (tmp_path / "fit.nc").write_bytes(content)
    with pytest.raises(InputError, match="is not a fit written by probcal"):
        probcal.load(tmp_path)


FULL = """
import resource, sys
import probcal
from probcal import save
import numpy as np, xarray as xr
big = xr.DataTree.from_dict({"a": xr.Dataset({"x": ("n", np.random.default_rng(0).standard_normal(20000))})})
resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
import signal
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
try:
    save(big, sys.argv[1])
except probcal.InputError as error:
    print(error)
"""


@pytest.mark.ci
def test_a_full_disk_is_one_sentence(tmp_path):
    """A process that may not write more than 4 kB, in the place of a full disk."""
    done = subprocess.run([sys.executable, "-c", FULL, str(tmp_path / "fit.nc")], capture_output=True, text=True)
    assert done.returncode == 0
    assert done.stderr == ""
    assert re.fullmatch(r".*fit\.nc cannot be written: File too large\n", done.stdout)
    assert listing(tmp_path) == []
