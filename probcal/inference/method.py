"""The base classes of methods, and the state of a climb between two iterations."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import jax
import numpy as np

from probcal.errors import InputError
from probcal.gaussian.engine import Engine
from probcal.gaussian.linearised import LaplaceApproximation
from probcal.gaussian.mode import Point
from probcal.inference.loop import Task, run
from probcal.inference.progress import Monitor
from probcal.inference.storage import Storage
from probcal.model.model import Mixing
from probcal.priors import Precision, Prior
from probcal.problem import Problem
from probcal.results.answer import Answer

if TYPE_CHECKING:
    import xarray as xr


class Given(NamedTuple):
    """The constants of the outer loop."""

    prior: Precision  # first precisions, and the couplings of correlated biases
    surveyed: jax.Array  # (M,) biases whose precision is never learnt
    group: jax.Array  # (M,) which learnt precision governs each bias
    tolerance: jax.Array  # ()


class State(NamedTuple):
    """The state of the outer loop: `found` belongs to `point` and `alpha`; objective -inf: none
    found yet."""

    point: Point
    alpha: jax.Array  # (M,)
    found: LaplaceApproximation
    objective: jax.Array  # ()
    worth: jax.Array  # () what is maximised where precisions or levels are learnt: evidence and their hyper-prior
    best: jax.Array  # () the best of it so far
    refused: jax.Array  # () whether no step of any search has lowered the cost yet, though one promised to
    done: jax.Array  # ()
    seed: jax.Array  # key of what the method draws next
    carry: Any  # what the method keeps between two iterations, a pytree of fixed form
    mixing: Mixing  # weights of process noise that is not Gaussian


class Context(NamedTuple):
    """The surroundings of a run: key, monitor, storage, threads."""

    key: jax.Array
    monitor: Monitor = Monitor()  # what says how far it is, and when to stop: this one never does
    storage: Storage | None = None  # where a sampler keeps its draws, and a climb its states
    threads: int | None = None
    fallback: Any = None  # the sampler that takes over where a collapse does not fit

    def run(self, task: Task) -> tuple[Any, Any]:
        """The last state of a task and its course."""
        return run(task, self.monitor, self.storage)


@dataclass(eq=False)
class MethodTask(Task):
    """A method on a problem: its state before the first iteration, its steps, and the answer of its last state.

    A method is written as one of these: `init`, `step`, `ended` and `outcome`. The loop owns all else.
    """

    method: Any
    problem: Problem
    prior: Prior
    start: Point
    context: Context

    @property
    def name(self) -> str:
        """The name of the method."""
        return str(self.method.name)

    @property
    def iterations(self) -> int:
        """The most iterations of the method."""
        return int(self.method.iterations)

    @property
    def biases(self) -> int:
        """Number of the biases of the problem."""
        return self.problem.model.biases

    @abstractmethod
    def outcome(self, state: Any, course: Any) -> Answer:
        """The answer of the last state and the course."""

    def beyond_memory(self, error: MemoryError) -> Answer:
        """The answer in another way; raises the error, or one that says what to do, where there is none."""
        raise error

    def singular(self, error: np.linalg.LinAlgError) -> Answer:
        """The same where some matrix is not positive definite."""
        raise error


class Method(ABC):
    """The base of every method: a frozen dataclass of static fields."""

    name: ClassVar[str]
    priors: ClassVar[tuple[type, ...]]  # the first is its own
    intervals: ClassVar[str]  # what the intervals are worth
    work: ClassVar[type[MethodTask]]  # what it does on a problem, where `task` does not choose
    climbs: ClassVar[bool] = True  # to a mode; others start at the joint mode where noise levels are unknown
    chooses: ClassVar[bool] = False  # whether another method, of its own choice, does the work
    engined: ClassVar[bool] = False  # whether it asks the engine that suits the size, and no other form
    roomy: ClassVar[bool] = True  # whether it takes a padded problem: not what draws all states together

    @property
    def by_particles(self) -> bool:
        """True if trajectories are particles, so that any motion will do and no start is needed."""
        return False

    def task(self, problem: Problem, prior: Prior, start: Point, context: Context) -> MethodTask:
        """The work of the method on a problem, from a start."""
        return self.work(self, problem, prior, start, context)

    def answer(self, problem: Problem, prior: Prior, start: Point, context: Context) -> Answer:
        """Solve a problem from a start."""
        task = self.task(problem, prior, start, context)
        try:
            return task.outcome(*context.run(task))
        except MemoryError as error:
            return task.beyond_memory(error)
        except np.linalg.LinAlgError as error:
            return task.singular(error)

    def first_prior(self) -> Prior:
        """The prior where none is given."""
        return self.priors[0]()

    def takes(self, prior: Prior) -> bool:
        """True if the method can be used with a prior."""
        return isinstance(prior, self.priors)

    def note(self, prior: Prior) -> str:
        """A note on the validity of the intervals with these settings and a prior."""
        return self.intervals

    def remark(self, prior: Prior) -> str:
        """A remark on the method under a prior for the message of a fit; empty where there is
        none."""
        return ""

    def suited(self, problem: Problem) -> Method:
        """The method that runs on a problem; itself, unless it chooses."""
        return self

    def prepare(self, problem: Problem) -> Problem:
        """The problem that is solved in the place of the given one."""
        return problem

    def configured(
        self, problem: Problem, prior: Prior, context: Context, fit: FitLabelled
    ) -> tuple[xr.DataTree, Answer]:
        """The tree and the answer of detections that name no target; `fit` fits rows that do.

        Raises `InputError`: most methods take rows that name their targets.
        """
        assert problem.scans is not None
        raise InputError(
            f"{int(problem.scans.count.sum())} detections in {problem.measurements.table.source} name no target: take"
            f" SelfConfiguration({self.name.replace('-', '')}()), on the command line --method self-config, or name"
            " them, as in problem.assigned(track_objects(problem).rows)"
        )

    def check_kept(self, problem: Problem, keep: tuple[str, ...]) -> None:  # noqa: B027
        """Raise `InputError` where an answer could not give the draws that are to be kept."""


type FitLabelled = Callable[[Problem, Method], tuple[xr.DataTree, Answer]]  # of rows that name their targets


class Iterated(Method, ABC):
    """A method whose outer loop ends."""

    iterations: int  # most outer iterations
    tolerance: float  # change of the objective at which it stops
    engine: str | Engine = "dense"  # that expands the posterior, by name or as a value


class ParticleSmoother(ABC):
    """The interface that the core requires of particles."""

    @abstractmethod
    def task(self, method: Iterated, problem: Problem, prior: Prior, start: Point, context: Context) -> MethodTask:
        """The climb of EM whose E-step draws particles, from the biases of a start."""

    @abstractmethod
    def tracked(
        self, problem: Problem, z: np.ndarray, covariance: np.ndarray, levels: np.ndarray, key: jax.Array
    ) -> xr.DataTree:
        """Tracks by particles at biases z (M,) of a covariance (M, M)."""
