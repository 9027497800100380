"""A method of one's own in thirty lines: the loop, the store, the answer and the checks come with it."""

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import pytest
from worlds import linear, resting

import probcal as pc
from probcal.gaussian.dense import DenseEngine
from probcal.gaussian.engine import Factors, evidence
from probcal.gaussian.mode import Point
from probcal.inference import storage
from probcal.inference.ending import conclude_at
from probcal.inference.loop import Trace
from probcal.inference.method import Iterated, MethodTask
from probcal.inference.mixture import gaussian_at
from probcal.report import write_report


class Stand(NamedTuple):
    """Where a climb stands."""

    point: Point
    done: Any


@dataclass(eq=False)
class DampedClimb(MethodTask):
    """Parts of a Newton step of the marginal density of the biases, one after the other."""

    def __post_init__(self):
        self.first = self.prior.precision(self.problem.labels, self.problem.surveyed)

    def init(self):
        return Stand(self.start, np.array(False))

    def step(self, state, count, pause):
        at, factors = DenseEngine().settled(self.problem.model, state.point), Factors.of(self.first)
        slope = np.asarray(at.score()) + factors.pull(at.point.z)
        step = np.asarray(at.solve(factors, slope))
        value = at.density() + factors.value(at.point.z)
        course = Trace(np.array([value]), np.asarray(at.point.z)[None], np.asarray(self.first.alpha)[None])
        return Stand(at.moved(self.method.part * step), np.array(slope @ step < self.method.tolerance)), course

    def ended(self, state, course):
        return bool(state.done)

    def outcome(self, state, course):
        at = DenseEngine().settled(self.problem.model, state.point)
        worth = evidence(at, self.first)
        own = self.problem, self.method, self.prior, gaussian_at(self.problem, self.prior, at, worth), course
        stopped = self.context.monitor.stopped
        return conclude_at(*own, converged=bool(state.done), evidence=worth.value, stopped=stopped)


@dataclass(frozen=True)
class Damped(Iterated):
    """The mode of the marginal density by damped steps."""

    part: float = 0.5
    iterations: int = 60
    tolerance: float = 1e-9
    name: ClassVar[str] = "damped"
    priors: ClassVar[tuple[type, ...]] = (pc.Gaussian, pc.Flat)
    intervals: ClassVar[str] = "Laplace"
    work = DampedClimb


@pytest.fixture(scope="module")
def problem():
    return linear("plane")[0]


def fitted(problem, **options):
    return pc.fit(problem, Damped(), start=resting(problem), **options)


@pytest.mark.ci
def test_a_method_of_thirty_lines_has_an_answer_its_course_and_checks(problem, tmp_path):
    seen = []
    found = fitted(problem, progress=seen.append)
    known = pc.fit(problem, pc.MAP(), start=resting(problem))
    assert found.attrs["status"] == "converged"
    assert found.attrs["method"] == "damped"
    for name in ("mean", "sd"):
        np.testing.assert_allclose(found["calibration"][name], known["calibration"][name], atol=1e-4)
    assert found.attrs["log_evidence"] == pytest.approx(known.attrs["log_evidence"], abs=1e-6)
    course = found["optimisation"].to_dataset()
    assert (np.diff(course["objective"]) > -1e-9).all()
    steps = [at for at in seen if at.what == "damped" and at.phase == "climb" and at.done]
    assert [at.done for at in steps] == [*range(1, course.sizes["iteration"] + 1)]
    pc.save(found, tmp_path / "fit.nc")
    again = pc.load(tmp_path / "fit.nc")
    assert (
        pc.assess(problem, again)["verdict"]["verdict"].values == pc.assess(problem, known)["verdict"]["verdict"].values
    ).all()
    assert "damped" in write_report(again, tmp_path / "report.html").read_text()


def test_it_is_stopped_by_a_limit_and_goes_on_where_it_was_killed(problem, tmp_path, monkeypatch):
    monkeypatch.setattr(storage, "EVERY", 0.0)
    monkeypatch.setattr(storage, "SELDOM", 0.0)
    whole = fitted(problem)

    class Killed(Exception):
        pass

    def kill(at):
        if at.done == 5:
            raise Killed

    with pytest.raises(Killed):
        fitted(problem, store=tmp_path, progress=kill)
    short = fitted(problem, store=tmp_path, resume=True, limit=1e-9)
    assert short.attrs["status"] == "not converged"
    assert "Ended by the limit" in short.attrs["message"]
    assert short["optimisation"].sizes["iteration"] == 5 + 1  # a step at least
    again = fitted(problem, store=tmp_path, resume=True)
    for tree in (again, whole):
        for name in ("seconds", "identity"):
            tree.attrs.pop(name, None)
    assert again.identical(whole)
