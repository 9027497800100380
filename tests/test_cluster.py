"""Work spread over dask: the same numbers as in one process, whatever is killed on the way."""

import importlib.util
import os
import random
import signal
import socket
import subprocess
import sys
import time
from functools import partial

import cloudpickle
import pandas as pd
import pytest
import xarray as xr
from terminal import run
from worlds import heights

from probcal import MAP, FitError, Gaussian, InputError, load_study, sbc, study
from probcal.cli.models import ModelFile
from probcal.files import Outputs
from probcal.inference import spread as spreading
from probcal.inference.progress import Progress
from probcal.inference.spread import spread
from probcal.studies.run_study import PARTLY, partly

MODEL = '''
"""Two rulers and a thing that rises and falls; every setting takes a while."""

import time

import numpy as np

from probcal import Bias, Channel, ConstantVelocity, Network, Node, Problem, sensor, simulate


@sensor(height=Channel("m", std=0.5))
def ruler(target, pose, *, shift=Bias("m", 1.0)):
    return {"height": target.position[1] - pose.position[1] + shift}


def network():
    return Network([ruler.on(Node(f"n{k}", (0.0, float(k)))) for k in range(2)])


def scenario(key=0):
    return simulate(network(), ConstantVelocity(1.0), np.arange(4.0), key=key)


def problem(data=None):
    return Problem(network(), ConstantVelocity(1.0), scenario().table if data is None else data)


def setting(run, std=1.0):
    time.sleep(0.1)
    made = scenario(run)
    return problem(made.table), made.truth
'''


def double(batch):
    return 2 * batch


def refused(batch):
    raise InputError("the batch is refused")


# without a cluster


def test_threads_give_back_what_is_finished():
    assert sorted(spread(double, [1, 2, 3])) == [(0, 2), (1, 4), (2, 6)]
    assert list(spread(double, [])) == []
    finished = spread(double, [1, 2, 3], threads=1)
    assert next(finished) == (0, 2)
    finished.close()
    with pytest.raises(InputError, match="the batch is refused"):
        list(spread(refused, [1]))


def test_what_is_no_scheduler_is_one_sentence(monkeypatch):
    with pytest.raises(InputError, match=r'scheduler is 3; give "local", the address of a dask scheduler'):
        list(spread(double, [1], scheduler=3))
    with pytest.raises(InputError, match=r"no dask scheduler answers at nowhere .*: start one \(dask scheduler\), or"):
        list(spread(double, [1], scheduler="nowhere"))
    monkeypatch.setattr(spreading, "TIMEOUT", 0.1)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        with pytest.raises(InputError, match=r"no dask scheduler answers at tcp://127.*refused"):
            list(spread(double, [1], scheduler=f"tcp://127.0.0.1:{taken.getsockname()[1]}"))
    genuine = importlib.util.find_spec
    monkeypatch.setattr(spreading, "find_spec", lambda name: None if name == "distributed" else genuine(name))
    with pytest.raises(InputError, match=r'a scheduler needs dask: pip install "probcal\[cluster\]"'):
        list(spread(double, [1], scheduler="local"))


def test_a_worker_that_cannot_do_the_work_says_why(tmp_path, monkeypatch):
    packed, here = cloudpickle.dumps(double), spreading._here()
    assert spreading._task(3, packed, here) == 6
    other = here._replace(versions=here.versions | {"jax": "0.0.1"})
    with pytest.raises(InputError, match=r"a worker has jax .*, this process 0\.0\.1: install the same there"):
        spreading._task(3, packed, other)
    (tmp_path / "only_here.py").write_text("def f(batch):\n    return batch\n")
    monkeypatch.syspath_prepend(tmp_path)
    packed = cloudpickle.dumps(importlib.import_module("only_here").f)
    monkeypatch.delitem(sys.modules, "only_here")
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path != str(tmp_path)])
    with pytest.raises(InputError, match=r"a worker cannot import what the work needs \(No module named 'only_here'"):
        spreading._task(3, packed, here)


def test_a_setting_is_loaded_where_it_is_used(tmp_path):
    path = tmp_path / "small.py"
    path.write_text(MODEL)
    setting = cloudpickle.loads(cloudpickle.dumps(ModelFile.of(path).setting))
    assert setting(3)[0].labels == ("n0.shift", "n1.shift")
    moved = ModelFile(path, "another digest").setting
    path.unlink()
    with pytest.raises(InputError, match=r"small\.py is not there on .*, or another file than here; put it where all"):
        moved(3)


def test_local_workers_that_do_not_start_are_one_sentence(monkeypatch):
    import distributed

    def fails(**_):
        raise RuntimeError("Nanny failed to start")

    monkeypatch.setattr(distributed, "LocalCluster", fails)
    text = r"the workers of this machine did not start \(Nanny failed to start\); a script .* below if __name__ =="
    with pytest.raises(InputError, match=text):
        list(spread(double, [1], scheduler="local"))


@pytest.mark.slow
def test_table_and_picture_are_written_while_a_study_runs(tmp_path):
    outputs, now, told = Outputs(tmp_path, ("study.nc", "study.csv", "study.png")), [0.0], []
    tell = partly(outputs, told.append, lambda: now[0])
    seen = []

    def at(step):
        if not step.done:  # the phase begins
            return
        now[0] += 0.6 * PARTLY
        tell(step)
        seen.append(pd.read_csv(tmp_path / "study.csv")["runs"].tolist() if outputs.there else None)

    found = study(heights, {"size": [2]}, ["ml"], runs=45, store=tmp_path / "runs", progress=at)
    assert told[0].done == 10
    assert seen[0] is None, "not before its time"
    assert seen[1] == [told[1].done]
    assert seen[2] == seen[1]
    assert sorted(outputs.there) == ["study.csv", "study.png"]
    assert outputs.runs() == {found.attrs["identity"]}
    (tmp_path / "study.csv").write_text("mine")
    now[0] += 2 * PARTLY
    tell(Progress("fits", 5, 45))
    assert (tmp_path / "study.csv").read_text() == "mine"


# with one


def place(_, batch):
    import distributed

    time.sleep(0.05)
    return distributed.get_worker().address


@pytest.mark.parametrize(("size", "count"), [(0, 2), (0, 24), (20_000, 24)])
def test_every_worker_gets_batches(size, count):
    """Also where the work is large, so that it lies with one worker at first."""
    import distributed

    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None) as made,
        distributed.Client(made, set_as_default=False) as client,
    ):
        places = [found for _, found in spread(partial(place, b"x" * size), list(range(count)), scheduler=client)]
    shares = [places.count(one) / count for one in set(places)]
    assert len(shares) == 2
    assert min(shares) >= 0.25


def surroundings(batch):
    return [os.environ.get(name) for name in ("NPROC", "MALLOC_TRIM_THRESHOLD_", "PROBCAL_MINE")]


@pytest.mark.ci
def test_local_workers_have_their_environment_and_leave_this_process_its_own(monkeypatch):
    monkeypatch.setenv("PROBCAL_MINE", "kept")
    monkeypatch.setattr("dask.system.CPU_COUNT", 6)
    before = dict(os.environ)
    found = [place for _, place in spread(surroundings, [0, 1], scheduler="local")]
    assert found == [["3", None, "kept"]] * 2
    assert dict(os.environ) == before


@pytest.fixture(scope="module")
def cluster():
    """A scheduler and a worker in this process, and a client."""
    import distributed

    with (
        distributed.LocalCluster(n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None) as made,
        distributed.Client(made, set_as_default=False) as client,
    ):
        yield client


@pytest.mark.slow
def test_a_client_is_taken_and_left_open(cluster):
    assert sorted(spread(double, [1, 2, 3], scheduler=cluster)) == [(0, 2), (1, 4), (2, 6)]
    with pytest.raises(InputError, match="the batch is refused"):
        list(spread(refused, [1, 2], scheduler=cluster))
    finished = spread(double, [1, 2, 3], scheduler=cluster)
    assert next(finished)[1] in (2, 4, 6)
    finished.close()
    assert cluster.status == "running"
    whole = study(heights, {"size": [2]}, ["ml"], runs=12)
    xr.testing.assert_identical(study(heights, {"size": [2]}, ["ml"], runs=12, scheduler=cluster), whole)
    problem = heights(0)[0]
    one, other = (sbc(problem, MAP(), prior=Gaussian(), runs=7, scheduler=at) for at in (None, cluster))
    xr.testing.assert_identical(one["sbc"].to_dataset(), other["sbc"].to_dataset())


def deadly(batch):
    if batch == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return batch


@pytest.mark.ci
def test_a_batch_that_kills_its_workers_is_given_up():
    with pytest.raises(FitError, match=r"one batch ended 4 workers, one after the other .*: what was finished is kept"):
        list(spread(deadly, [0, 1], scheduler="local"))


class Machines:
    """A scheduler and workers in processes of their own, as they run on other machines."""

    def __init__(self, folder, workers):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.address, self.folder, self.workers = f"tcp://127.0.0.1:{self.port}", folder, []
        self.log = (folder / "dask.log").open("w")
        self.scheduler = self.start("dask_scheduler", "--host", "127.0.0.1", "--port", str(self.port))
        for _ in range(workers):
            self.add()

    def start(self, name, *words):
        order = [sys.executable, "-m", f"distributed.cli.{name}", *words, "--no-dashboard"]
        return subprocess.Popen(order, stdout=self.log, stderr=self.log, cwd=self.folder)

    def add(self):
        words = (self.address, "--nthreads", "1", "--no-nanny", "--local-directory", str(self.folder))
        self.workers.append(self.start("dask_worker", *words))

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for process in (*self.workers, self.scheduler):
            process.kill()
            process.wait()
        self.log.close()


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "small.py"
    path.write_text(MODEL)
    return path


RUNS = 100
WORDS = ("--methods", "ml,em", "--set", "std=1,2", "--runs", RUNS)


@pytest.fixture(scope="module")
def whole(model, tmp_path_factory):
    """The study in one process."""
    folder = tmp_path_factory.mktemp("whole") / "out"
    done = run("study", model, *WORDS, "--out", folder)
    assert done.returncode == 0, done.stderr
    return load_study(folder)


def started(model, out, address):
    words = ["study", model, *WORDS, "--out", out, "--resume", "--scheduler", address]
    order = [sys.executable, "-m", "probcal.cli", *map(str, words)]
    return subprocess.Popen(order, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def wait_for(out, count, process):
    """Wait until so many fits are done."""
    while done_in(out) < count:
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)


def done_in(out):
    try:
        return int((load_study(out)["status"] != "").sum())
    except InputError:
        return 0


@pytest.mark.slow
def test_a_killed_worker_and_a_restarted_client_change_no_number(model, whole, tmp_path):
    """Separate worker processes: one is killed, then the client; a second client goes on with what is missing."""
    out, chance = tmp_path / "out", random.Random(1)
    with Machines(tmp_path, 3) as machines:
        client = started(model, out, machines.address)
        wait_for(out, 40, client)
        machines.workers[0].send_signal(signal.SIGKILL)
        wait_for(out, 120, client)
        time.sleep(chance.uniform(0.0, 0.3))
        client.send_signal(signal.SIGKILL)
        client.communicate()
        kept = done_in(out)
        assert 120 <= kept < 400
        files = {file: file.stat().st_mtime_ns for file in out.glob("runs/fits.zarr/error/c/**/*") if file.is_file()}
        client = started(model, out, machines.address)
        said, complaint = client.communicate()
        assert client.returncode == 0, complaint
    assert "400 fits" in said
    xr.testing.assert_identical(load_study(out), whole)
    assert all(file.stat().st_mtime_ns == before for file, before in files.items()), "what was kept is not made again"
    assert not [*out.rglob("*.partial"), *out.rglob("*.part")]


@pytest.mark.slow
def test_a_lost_scheduler_is_one_sentence_and_a_rerun_goes_on(model, whole, tmp_path):
    out = tmp_path / "out"
    with Machines(tmp_path, 2) as machines:
        client = started(model, out, machines.address)
        wait_for(out, 40, client)
        machines.scheduler.kill()
        _, complaint = client.communicate()
    assert client.returncode == 1
    assert complaint.splitlines()[-1].startswith("probcal: the dask scheduler tcp://127.0.0.1:")
    assert "went away: what was finished is kept" in complaint
    kept = done_in(out)
    assert 40 <= kept < 400
    done = run("study", model, *WORDS, "--out", out, "--resume", "--scheduler", "local")
    assert done.returncode == 0, done.stderr
    xr.testing.assert_identical(load_study(out), whole)
