"""Every method is killed, interrupted and ended by a limit on one tiny problem, and resumed to the identical result.

The result is judged by the same numbers from its file as in memory.
"""

from contextlib import suppress
from types import SimpleNamespace

import numpy as np
import pytest
from contracts import judged_alike
from worlds import linear, resting, small

import probcal as pc
from probcal.inference import loop, storage, table


class Killed(Exception):
    """Ends a fit as SIGKILL does: nobody handles it."""


CLIMBS = {
    "MAP": pc.MAP(),
    "EA": pc.EA(),
    "EA maximised": pc.EA(precisions="maximised"),
    "EA sparse": pc.EA(engine="superlu"),
    "LeastSquares": pc.LeastSquares(),
    "EM": pc.EM(pc.Cubature(), iterations=9, tolerance=0.0),
    "EMEA": pc.EMEA(iterations=12),
}
SAMPLERS = {
    "Collapsed": pc.Collapsed(chains=2, warmup=50, draws=100, sweeps=1),
    "MCMC": pc.MCMC(chains=2, warmup=50, draws=100, effective=150),
    "NUTS": pc.NUTS(chains=2, warmup=25, draws=25),
    "Gibbs": pc.Gibbs(chains=2, warmup=10, draws=20),
    "SVI": pc.SVI(),
}
with suppress(ImportError):  # where the wing of particles is not installed
    CLIMBS["EM by particles"] = pc.EM(pc.Particles(20), iterations=12)
    SAMPLERS["ParticleGibbs"] = pc.ParticleGibbs(2, 5, 50, particles=pc.Particles(20), steps=2, patience=1)
SOON = ("EMEA",)  # whose kernels others of the default tests compile too
LATE = ("EA sparse",)  # whose turns are stopped below


def test_every_method_is_among_them():
    """A self-configuration fits by the method that it holds."""
    assert {type(method).__name__ for method in (CLIMBS | SAMPLERS).values()} >= {*table().index} - {
        "SelfConfiguration"
    }


def stop_and_resume(fitted):
    """The result of a fit that is killed, interrupted and ended by a limit, and that of an undisturbed one."""
    seen = list[object]()
    whole = fitted("whole", seen.append)

    def stopped(share, error, **options):
        """A run that ends after a share of the reports of progress that an undisturbed one makes."""
        left = max(2, int(share * len(seen)))

        def progress(at):
            nonlocal left
            left -= 1
            if left == 0:
                raise error

        try:
            fitted("stopped", progress, **options)
        except (error, pc.FitError):  # before there is an answer
            return

    stopped(0.4, Killed)
    stopped(0.7, KeyboardInterrupt, resume=True)
    stopped(9.0, Killed, resume=True, limit=1e-9)
    found = fitted("stopped", resume=True)
    for tree in (found, whole):
        tree.attrs.pop("seconds", None)
    return found, whole


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in SOON else pytest.mark.slow if name in LATE else pytest.mark.ci)
        for name in CLIMBS | SAMPLERS
    ],
)
def test_what_is_stopped_is_resumed_to_the_same_result(name, tmp_path, monkeypatch):
    monkeypatch.setattr(storage, "EVERY", 0.0)
    problem = linear("plane")[0] if name in SOON else small()
    given = {"method": (CLIMBS | SAMPLERS)[name], "start": resting(problem) if name in SOON else None}

    def fitted(place, progress=None, key=3, **options):
        return pc.fit(problem, **given, key=key, store=tmp_path / place, progress=progress, **options)

    found, whole = stop_and_resume(fitted)
    assert found.identical(whole)
    with pytest.raises(pc.InputError, match="the seed has changed"):
        fitted("stopped", key=4, resume=True)
    if name not in SOON:
        judged_alike(problem, found, pc.load(pc.save(found, tmp_path / "fit.nc")))
    if name in CLIMBS:
        course = found["optimisation"].to_dataset()
        last = course.isel(iteration=-1)
        assert course["bias"].dims == course["precision"].dims == ("iteration", "bias_label")
        if "integrated" not in found.attrs["precisions"] and "particles" not in name:
            np.testing.assert_allclose(last["bias"], found["calibration"]["mean"], rtol=1e-9)


@pytest.mark.parametrize(
    "engine", [pytest.param("dense", marks=pytest.mark.slow), pytest.param("superlu", marks=pytest.mark.ci)]
)
def test_turns_of_several_starts_are_resumed_too(engine, tmp_path, monkeypatch):
    """An unknown level, starts and mirrors: the climbs before the one that was stopped are read back."""
    monkeypatch.setattr(storage, "EVERY", 0.0)
    level = pc.Channel("m", std=pc.Unknown(1.0))

    @pc.sensor(range=level)
    def ranger(target, pose, *, range_offset=pc.Bias("m", 1.0)):
        return {"range": pc.geometry.norm(target.position - pose.position) + range_offset}

    nodes = [pc.Node(f"n{k}", place, scale=0.5) for k, place in enumerate([(0, 0), (9, 1), (4, 8), (12, 9)])]
    network, motion = pc.Network([ranger.on(node) for node in nodes]), pc.ConstantVelocity(0.2)
    run = pc.simulate(network, motion, np.arange(15.0), key=1, tracks={"t": np.stack([np.arange(15.0)] * 2, 1)})
    problem, starts = pc.Problem(network, motion, run.table), 3 if engine == "dense" else 1

    def fitted(place, progress=None, **options):
        method = pc.EA(engine=engine)
        return pc.fit(problem, method, starts=starts, store=tmp_path / place, progress=progress, **options)

    found, whole = stop_and_resume(fitted)
    assert found.identical(whole)
    assert len(list((tmp_path / "whole").glob("loop-*.npz"))) > 1


class Counted(loop.Task):
    """Counts its steps; a limit is reached while it begins."""

    name, iterations, biases = "counted", 9, 1

    def __init__(self, monitor):
        self.monitor = monitor

    def init(self):
        self.monitor.stopped = "the limit of time was reached"
        return np.zeros(1)

    def step(self, state, count, pause):
        return state + 1, loop.Trace(state, state[None], state[None])

    def ended(self, state, course):
        return False


def test_a_limit_that_ends_in_the_beginning_of_a_loop_leaves_a_step_and_lets_a_resumed_one_go_on():
    kept, found = SimpleNamespace(found=None, due=True), []
    kept.write = lambda arrays, course: found.append((arrays, list(course)))
    for steps in (1, 2, 3):
        monitor = SimpleNamespace(stopped="", tell=lambda *_, **__: None)
        state, course = loop.run(Counted(monitor), monitor, SimpleNamespace(checkpoint=lambda *_: kept))
        assert (state, course.iterations) == (steps, steps)
        kept.found = found[-1]
    with pytest.raises(pc.InputError, match="another form"):
        loop.like(np.zeros(2), found[-1][0])
