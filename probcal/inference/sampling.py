"""Draws of a sampler as a task of the loop: an iteration is a chunk of all chains."""

from __future__ import annotations

import os
import time
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, ClassVar

import jax
import numpy as np

from probcal.errors import FitError
from probcal.inference.chains import Draw
from probcal.inference.loop import Pause
from probcal.inference.method import MethodTask
from probcal.inference.mixed import settled
from probcal.inference.pose import Worth
from probcal.inference.posed import Form, Natural, Posed
from probcal.inference.posterior import SamplerRun, conclude_draws, side_of_draws
from probcal.inference.progress import Monitor
from probcal.inference.sampler import DRAWS, Sampler
from probcal.modes.explore import Mirrored
from probcal.results.answer import Answer

GROWTH = 4  # by how many times more steps a draw is tried again that has not mixed
WARM_UP = "warm-up"  # the phase that leaves no draws
MEAN = "mean_density"  # of all draws of a chunk, those that are not kept included


class DrawnChunks(tuple[Mapping[str, np.ndarray], ...]):
    """The course of chains: arrays (chains, draws, ...) by name, a chunk each."""

    @property
    def iterations(self) -> int:
        """Number of the chunks."""
        return len(self)

    @property
    def objective(self) -> list[float]:
        """Mean log density of each chunk."""
        return [float(chunk[MEAN]) for chunk in self]

    def and_then(self, other: Sequence[Mapping[str, np.ndarray]]) -> DrawnChunks:
        """These chunks and what came after them."""
        return DrawnChunks((*self, *other))


@dataclass(frozen=True)
class Plan:
    """Which chunks are drawn: first every step is a draw; where these have not mixed, all anew, more steps a draw."""

    method: Sampler
    thin: int = 1
    before: Plan | None = None

    @property
    def begin(self) -> int:
        """The first chunk."""
        return 0 if self.before is None else self.before.end

    @property
    def end(self) -> int:
        """The chunk after the last."""
        return self.begin - (-(self._unkept + self.method.draws) // self.method.chunk)

    @property
    def _unkept(self) -> int:
        return self.method.warmup if self.before is None else 0

    @property
    def last(self) -> bool:
        """Whether the method has no patience for a longer one."""
        return self.thin * GROWTH > self.method.patience

    def longer(self) -> Plan:
        """The next, of more steps between two draws; those before it are its warm-up."""
        return Plan(self.method, self.thin * GROWTH, self)

    def kept(self, chunk: int) -> int:
        """How many draws of a chunk are kept, the last ones."""
        size = self.method.chunk
        return max(0, min((chunk - self.begin + 1) * size - self._unkept, size))

    def done(self, count: int) -> int:
        """Draws that are there after so many chunks."""
        return max(0, (count - self.begin) * self.method.chunk - self._unkept)

    def phase(self, count: int) -> str:
        """The phase after so many chunks."""
        if self.done(count) == 0 and self.before is None and self._unkept:
            return WARM_UP
        return "draws" if self.thin == 1 else f"draws, {self.thin} steps each"

    def steps(self, count: int) -> int:
        """Steps of a chain after so many chunks."""
        own = (count - self.begin) * self.method.chunk * self.thin
        return own + (0 if self.before is None else self.before.steps(self.begin))

    def drawn(self, course: DrawnChunks) -> Draw:
        """Its own draws of a course."""
        own = course[self.begin : self.end]
        names = [name for name in own[-1] if name != MEAN]
        return gathered({name: np.concatenate([one[name] for one in own], 1)[:, : self.method.draws] for name in names})


@dataclass(eq=False)
class Chains(MethodTask):
    """The chains of a sampler; an iteration is a chunk of all of them.

    `init` says what they move on: `form`, `posed`, and where there is a frame its `worth`.
    """

    kind = "draws"
    iterations: ClassVar[int] = DRAWS  # more chunks than any plan has: `ended` knows the last

    sides: tuple[Mirrored, ...] = ()  # other sides of a mirror that they visit
    worth: Worth | None = None
    note: str = ""  # what happened on the way, a sentence or nothing
    phase: str = ""
    complete: bool = False  # whether all draws are made
    form: Form = field(init=False)
    posed: Posed | Natural = field(init=False)

    def __post_init__(self) -> None:
        self.asked, self.began = self.method, time.perf_counter()

    @abstractmethod
    def advance(self, state: Any, thin: int) -> tuple[Any, Draw]:
        """All chains one chunk further, every `thin`-th step kept."""

    def plan(self, number: int) -> Plan:
        """The plan of a chunk."""
        plan = Plan(self.method)
        while number >= plan.end:
            plan = plan.longer()
        return plan

    def step(self, state: Any, count: int, pause: Pause) -> tuple[Any, DrawnChunks]:
        """One more chunk."""
        plan = self.plan(count)
        self._enter(plan.phase(count))
        state, draws = self.advance(state, plan.thin)
        # draws as arrays (chains, draws, ...) by flat names, as a storage keeps them
        found = {name: getattr(draws, name) for name in ("theta", "gamma", "variance", "density")}
        found |= {f"phi_{name}": value for name, value in draws.phi.items()}
        found |= {f"stats_{name}": value for name, value in draws.stats.items()}
        found |= {f"states_{r}": value for r, value in enumerate(draws.states)}
        kept, arrays = plan.kept(count), {name: np.asarray(value) for name, value in found.items()}
        last: dict[str, Any] = {name: a[:, a.shape[1] - kept :].copy() for name, a in arrays.items()}
        return state, DrawnChunks([last | {MEAN: np.mean(arrays["density"])}])

    def ended(self, state: Any, course: DrawnChunks) -> bool:
        """True where the draws of a plan are made and have mixed, or it is the last."""
        count = len(course)
        plan = self.plan(max(count - 1, 0))
        if count == plan.end:
            drawn = plan.drawn(course)
            self.complete = plan.last or settled(np.asarray(drawn.theta), side_of_draws(drawn), 1 + len(self.sides))
        return self.complete

    def course(self, stored: Sequence[Any] = ()) -> DrawnChunks:
        """The chunks that were stored."""
        return DrawnChunks(stored)

    def tell(self, monitor: Monitor, done: int, objective: float) -> None:
        """Report steps of all that the plan takes, by its phase."""
        plan = self.plan(done - 1)
        self._enter(plan.phase(done))
        monitor.tell(self.name, plan.steps(done), plan.steps(plan.end), objective)

    def _enter(self, phase: str) -> None:
        if phase != self.phase:
            self.phase = phase
            self.context.monitor.enter(phase, self.name, answering=phase != WARM_UP)

    def outcome(self, state: Any, course: DrawnChunks) -> Answer:
        """The answer by the draws."""
        return conclude_draws(self.problem, self.prior, self.run(course))

    def run(self, course: DrawnChunks) -> SamplerRun:
        """The draws of a course: of chains that were stopped those of the plan before, if they are more.

        Raises `FitError` where there are none yet, and where some are not finite.
        """
        count, stopped = len(course), "" if self.complete else self.context.monitor.stopped
        plan = self.plan(count - 1 if self.complete else count)
        if plan.before is not None and plan.done(count) * GROWTH < plan.method.draws and not self.complete:
            plan = plan.before
        if not plan.done(count):
            raise FitError(f"{stopped} in the warm-up, before there was a draw: give a longer limit, or fewer steps")
        drawn, seconds = plan.drawn(course), time.perf_counter() - self.began
        if not np.isfinite(np.asarray(drawn.theta)).all():
            raise FitError(
                f"{self.name}: some draw is not finite; give biases that no row determines a survey, or fix them"
            )
        return SamplerRun(
            self.method, self.asked, self.form, self.posed, self.worth, drawn, seconds, stopped, self.note, self.sides,
            plan.thin,
        )  # fmt: skip


def each_chain(one: Callable[[Any], tuple[Any, Draw]], states: Any, chains: int, threads: int | None) -> Any:
    """States and draws of all chains, leading dim (chains,), a thread for each."""

    def alone(k: int) -> tuple[Any, Draw]:
        with jax.enable_x64(True):
            return jax.block_until_ready(one(jax.tree.map(lambda leaf: np.asarray(leaf)[k], states)))

    with ThreadPoolExecutor(threads or os.cpu_count()) as pool:
        found = list(pool.map(alone, range(chains)))
    return jax.tree.map(lambda *leaves: np.stack(leaves), *found)


def gathered(arrays: Mapping[str, np.ndarray]) -> Draw:
    """The draws of arrays by flat names: what `flat_arrays` made."""

    def group(prefix: str) -> dict[str, Any]:
        return {name.removeprefix(prefix): a for name, a in arrays.items() if name.startswith(prefix)}

    states = group("states_")
    fields: dict[str, Any] = {name: arrays[name] for name in ("theta", "gamma", "variance", "density")}
    in_order = tuple(states[str(r)] for r in range(len(states)))
    return Draw(phi=group("phi_"), stats=group("stats_"), states=in_order, **fields)
