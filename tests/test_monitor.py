"""What ends a fit before it is done: a limit of time, Ctrl-C, SIGTERM; and what is said of how far it is."""

import signal
import subprocess
import sys
from contextlib import contextmanager

import numpy as np
import pytest
import worlds
from terminal import call

import probcal as pc
from probcal.errors import FitError, InputError
from probcal.inference import calibrate
from probcal.inference.progress import Monitor, Stopped, duration
from probcal.modes.explore import Sides


class Clock:
    """A time that is set."""

    now = 0.0

    def __call__(self):
        return self.now


def test_a_rate_is_measured_from_the_first_news():
    """The first chunk compiles: it does not count, and the draws go on with the speed of the warm-up."""
    clock, seen = Clock(), []
    monitor = Monitor(seen.append, clock=clock)
    monitor.enter("warm-up", "NUTS")
    for now, done in ((30.0, 50), (40.0, 100)):
        clock.now = now
        monitor.tell("NUTS", done, 1100, -3.0)
    monitor.enter("draws", "NUTS", answering=True)
    clock.now = 50.0
    monitor.tell("NUTS", 150, 1100, -3.0)
    assert [at.left for at in seen] == [None, None, 200.0, None, 190.0]
    assert str(seen[-1]) == "NUTS, draws: 150 of 1100, objective -3.000, 50 s, about 3 min 10 s left"
    monitor.tell("EA", 5, 200, -1.0, bound=True)
    monitor.tell("EA", 10, 200, -1.0, bound=True)
    assert seen[-1].left is None, "a climb may end at once"


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.4, "0 s"), (119, "119 s"), (190, "3 min 10 s"), (3600, "60 min"), (7500, "2 h 5 min")]
)
def test_durations(seconds, text):
    assert duration(seconds) == text


def test_a_limit_stops_and_is_named():
    clock = Clock()
    monitor = Monitor(limit=300.0, clock=clock)
    monitor.check()
    clock.now = 300.0
    assert monitor.stopped == "Ended by the limit of 300 s"
    assert monitor.silent().stopped == monitor.stopped
    with pytest.raises(Stopped):
        monitor.check()


@pytest.mark.parametrize("limit", [0.0, -1.0, np.nan, np.inf])
def test_a_limit_is_positive(limit):
    with pytest.raises(InputError, match=r"the limit of the search is .* s; give a positive number of seconds"):
        Monitor(limit=limit)


@pytest.fixture
def default_ctrl_c():
    """The handler of a terminal; a test run in the background ignores Ctrl-C."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield signal.default_int_handler
    signal.signal(signal.SIGINT, before)


def test_ctrl_c_is_raised_until_there_is_an_answer_and_then_once_kept(default_ctrl_c):
    monitor = Monitor()
    with monitor.interruptible():
        monitor.enter("start", "EA")
        monitor.tell("MAP", 5, 200, -1.0)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    monitor = Monitor()
    with monitor.interruptible():
        monitor.enter("climb", "EA", answering=True)
        monitor.tell("EA", 5, 200, -1.0)
        signal.raise_signal(signal.SIGINT)
        assert monitor.stopped == "Interrupted"
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is default_ctrl_c


def test_a_handler_of_another_is_left_in_place():
    heard = []
    before = signal.signal(signal.SIGINT, lambda *_: heard.append("theirs"))
    try:
        with Monitor().interruptible():
            signal.raise_signal(signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, before)
    assert heard == ["theirs"]


def test_an_interrupted_climb_keeps_the_best_answer_so_far():
    """Stopped after its first iterations, a climb says so; the search for other answers does not begin."""
    problem = worlds.linear("plane")[0]

    def stop(at):
        if at.phase == "climb" and at.done:
            raise KeyboardInterrupt

    found = pc.fit(problem, pc.EM(iterations=100, tolerance=1e-12), start=worlds.resting(problem), progress=stop)
    assert (found.attrs["status"], found.attrs["interrupted"]) == ("not converged", 1)
    assert (
        "Interrupted after 5 iterations, before it converged: this is the best estimate so far."
        in (found.attrs["message"])
    )
    assert found["optimisation"].sizes["iteration"] == 5
    assert np.isfinite(found["calibration"]["sd"]).all()


@pytest.mark.slow
@pytest.mark.parametrize("make", [lambda: pc.EA(engine="cholmod"), lambda: pc.EM(pc.Particles(50), iterations=60)])
def test_climbs_in_sparse_form_and_by_particles_are_interrupted(make):
    problem = worlds.linear("plane")[0]

    def stop(at):
        if at.phase == "climb" and at.done:
            raise KeyboardInterrupt

    found = pc.fit(problem, make(), start=worlds.resting(problem), progress=stop)
    assert (found.attrs["status"], found.attrs["interrupted"]) == ("not converged", 1)
    assert found.attrs["message"].startswith("Interrupted after ")
    assert found.attrs["message"].count("Interrupted") == 1
    assert np.isfinite(found["calibration"]["sd"]).all()


def test_ctrl_c_after_the_climb_is_said(monkeypatch):
    """Where the search for other answers has nothing left to leave out, the message names the interruption too."""

    def stop(at):
        if at.phase == "mirror images":
            raise KeyboardInterrupt

    monkeypatch.setattr("probcal.inference.solve.other_sides", lambda _, point, climb: Sides(point, False, ()))
    problem = worlds.linear("plane")[0]
    found = pc.fit(problem, pc.MAP(), start=worlds.resting(problem), progress=stop)
    assert (found.attrs["status"], found.attrs["interrupted"]) == ("not converged", 1)
    assert found.attrs["message"].startswith("Interrupted while other answers were looked for.")


def ended(problem, phase, limit=300.0, method=None, **options):
    """The fit of a problem whose limit passes as a phase begins, its answer and the phases."""
    clock, phases = Clock(), []

    def late(at):
        phases.append(at.phase)
        if at.phase == phase:
            clock.now = limit

    tree, _ = calibrate(problem, method or pc.MAP(), monitor=Monitor(late, limit, clock=clock), **options)
    return tree, list(dict.fromkeys(phases))


def test_a_limit_ends_the_search_for_other_starts():
    """The second climb ends after its first iteration; the third is not begun, which the message says."""
    tree, phases = ended(worlds.linear("plane")[0], "start 2 of 3", starts=3)
    assert phases[:3] == ["start", "climb", "start 2 of 3"]
    assert "start 3 of 3" not in phases
    assert "Ended by the limit of 300 s before 1 of 3 starts were looked at" in tree.attrs["message"]
    assert (tree.attrs["status"], tree.attrs["interrupted"]) == ("converged", 0)


@pytest.mark.ci
def test_a_limit_in_the_warm_up_leaves_no_answer():
    with pytest.raises(FitError, match="in the warm-up, before there was a draw"):
        ended(worlds.linear("plane")[0], "warm-up", method=pc.Gibbs(chains=2, warmup=400, draws=10))


MODEL = '''
"""Three gauges of range and azimuth around one target."""

import numpy as np

from probcal import Bias, Channel, ConstantVelocity, Network, Node, Problem, sensor, simulate
from probcal.geometry import bearing, norm


@sensor(range=Channel("m", std=1.0), azimuth=Channel("rad", std=0.02, wrap=True))
def gauge(target, pose, *, range_offset=Bias("m", 2.0)):
    line = target.position - pose.position
    return dict(range=norm(line) + range_offset, azimuth=bearing(line) - pose.heading)


def problem(data=None):
    nodes = [Node(f"gauge_{k}", place) for k, place in enumerate([(0, 0), (60, 0), (0, 60)])]
    network, motion = Network([gauge.on(node) for node in nodes]), ConstantVelocity(0.5)
    track = np.stack([np.linspace(10, 50, 12), 25 + 10 * np.sin(np.linspace(0, 3, 12))], 1)
    return Problem(network, motion, simulate(network, motion, np.arange(12.0), key=0, tracks={"car": track}).table)
'''


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("gauges") / "gauges.py"
    path.write_text(MODEL)
    return path


def told(process, words):
    """Wait for a line of progress."""
    for line in process.stderr:
        if words in line:
            return
    raise AssertionError(f"no line with {words}")


@pytest.mark.ci
def test_sigterm_keeps_the_draws_so_far(model, tmp_path):
    """The command line writes everything that a fit writes, and the mark that it was interrupted."""
    out = tmp_path / "out"
    order = [sys.executable, "-m", "probcal.cli", "fit", model, "--method", "gibbs", "--draws", "100000", "--out", out]
    with subprocess.Popen(order, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            told(process, "Gibbs, draws: ")
            process.send_signal(signal.SIGTERM)
            said, complaint = process.communicate(timeout=200)
        finally:
            process.kill()  # nothing, where it has ended
    assert process.returncode == 143, complaint
    tree = pc.load(out)
    assert (tree.attrs["status"], tree.attrs["interrupted"]) == ("not converged", 1)
    assert "Interrupted after" in tree.attrs["message"]
    assert "The checks are missing, since the fit was interrupted." in tree.attrs["message"]
    assert "gauge_0.range_offset" in said
    assert (out / "summary.csv").exists()


@pytest.mark.ci
def test_sigterm_before_an_answer_ends_a_command(model, tmp_path, monkeypatch):
    @contextmanager
    def on_stderr():
        yield lambda at: signal.raise_signal(signal.SIGTERM)  # at the first news, of whichever phase it comes

    monkeypatch.setattr("probcal.cli.progress._on_stderr", on_stderr)
    code, _, complaint = call("fit", model, "--out", tmp_path / "out")
    assert code == 143
    assert "Traceback" not in complaint
    assert not (tmp_path / "out" / "fit.nc").exists()


@pytest.mark.ci
@pytest.mark.needs("studies")
def test_an_interrupted_study_says_what_it_keeps(default_ctrl_c, tmp_path, monkeypatch):
    @contextmanager
    def shown():
        yield lambda at: at.done and signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr("probcal.studies.run_study.shown", shown)
    model = tmp_path / "rulers.py"
    model.write_text("from worlds import heights\n\n\ndef setting(run):\n    return heights(run)\n")
    code, _, complaint = call("study", model, "--methods", "ml", "--runs", 40, "--out", tmp_path / "out")
    assert code == 130
    assert "--resume goes on with it" in complaint
    assert "Traceback" not in complaint


@pytest.mark.ci
def test_a_limit_is_an_option(model):
    code, _, complaint = call("fit", model, "--method", "em-ea", "--limit", 0.001)
    assert code == 1
    assert "Ended by the limit of 0.001 s " in complaint
    code, _, complaint = call("fit", model, "--limit", -1)
    assert (code, "give a positive number of seconds" in complaint) == (2, True)
