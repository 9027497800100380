"""Draws of a sampler as a task of the loop: an iteration is a chunk of all chains."""

from __future__ import annotations

import os
import time
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import jax
import numpy as np

from probcal.errors import FitError
from probcal.inference.chains import Draw
from probcal.inference.loop import Pause
from probcal.inference.method import MethodTask
from probcal.inference.mixed import effective_draws
from probcal.inference.pose import Worth
from probcal.inference.posed import Form, Natural, Posed
from probcal.inference.posterior import SamplerRun, conclude_draws
from probcal.inference.progress import Monitor
from probcal.inference.sampler import DRAWS, Sampler
from probcal.modes.explore import Mirrored
from probcal.results.answer import Answer

FIRST = 50  # draws of a chain at which it is first looked whether enough of them are effective
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


class Thinning(NamedTuple):
    """Draws that are kept of the chunks of a chain: every one, and where as many as asked have not
    mixed every second one of twice as many steps, and so on."""

    draws: np.ndarray  # (D,) numbers of the draws, of all that the chunks hold
    thin: int  # steps from one to the next
    steps: int  # of the chain, warm-up included
    held: int  # draws that the chunks hold

    def full(self, method: Sampler) -> bool:
        """True where these are all that a method keeps."""
        return len(self.draws) >= method.draws

    def after(self, method: Sampler) -> Thinning:
        """The same after one more chunk."""
        own, thin = (self.draws[::-2][::-1], 2 * self.thin) if self.full(method) else (self.draws, self.thin)
        steps = self.steps + method.chunk * thin
        new = self.held + np.arange(np.clip(steps - method.warmup, 0, method.chunk))
        return Thinning(np.append(own, new)[: method.draws], thin, steps, self.held + len(new))


def thinning(method: Sampler, chunks: int) -> Thinning:
    """The draws that are kept of so many chunks."""
    found = Thinning(np.arange(0), 1, 0, 0)
    for _ in range(chunks):
        found = found.after(method)
    return found


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
    share: float | None = None  # of the effective draws that are asked for, at the last look
    form: Form = field(init=False)
    posed: Posed | Natural = field(init=False)

    def __post_init__(self) -> None:
        self.asked, self.began = self.method, time.perf_counter()

    @abstractmethod
    def advance(self, state: Any, thin: int) -> tuple[Any, Draw]:
        """All chains one chunk further, every `thin`-th step kept."""

    def step(self, state: Any, count: int, pause: Pause) -> tuple[Any, DrawnChunks]:
        """One more chunk."""
        self._enter(kept := thinning(self.method, count))
        after = kept.after(self.method)
        state, draws = self.advance(state, after.thin)
        # draws as arrays (chains, draws, ...) by flat names, as a storage keeps them
        found = {name: getattr(draws, name) for name in ("theta", "gamma", "variance", "density")}
        found |= {f"phi_{name}": value for name, value in draws.phi.items()}
        found |= {f"stats_{name}": value for name, value in draws.stats.items()}
        found |= {f"states_{r}": value for r, value in enumerate(draws.states)}
        new, arrays = after.held - kept.held, {name: np.asarray(value) for name, value in found.items()}
        last: dict[str, Any] = {name: a[:, a.shape[1] - new :].copy() for name, a in arrays.items()}
        return state, DrawnChunks([last | {MEAN: np.mean(arrays["density"])}])

    def ended(self, state: Any, course: DrawnChunks) -> bool:
        """True where enough draws are effective, or the method has no patience for more steps."""
        method, kept = self.method, thinning(self.method, len(course))
        last = thinning(method, len(course) - 1)
        look = kept.full(method) or (
            method.effective and len(kept.draws) >= FIRST and _growth(kept.steps) > _growth(last.steps)
        )
        if len(course) and look:
            drawn = self._drawn(course, kept)
            found = effective_draws(drawn, len(self.sides) + 1, method.effective)
            self.share = found.least / method.effective if method.effective else None
            spent = kept.full(method) and 2 * kept.thin > method.patience
            self.complete = found.settled or spent
        return self.complete

    def course(self, stored: Sequence[Any] = ()) -> DrawnChunks:
        """The chunks that were stored."""
        return DrawnChunks(stored)

    def tell(self, monitor: Monitor, done: int, objective: float) -> None:
        """Report the steps made, of those until all draws are made or, so far, enough effective."""
        kept, method = thinning(self.method, done), self.method
        self._enter(kept)
        drawn = method.draws * kept.thin
        if method.effective:  # known from the first look on
            drawn = int((kept.steps - method.warmup) / self.share) if self.share else 0
        total = method.warmup + drawn
        monitor.tell(self.name, kept.steps, max(total, kept.steps), objective)

    def _enter(self, kept: Thinning) -> None:
        thin = kept.after(self.method).thin
        phase = "draws" if thin == 1 else f"draws, {thin} steps each"
        phase = WARM_UP if not len(kept.draws) and self.method.warmup else phase
        if phase != self.phase:
            self.phase = phase
            self.context.monitor.enter(phase, self.name, answering=phase != WARM_UP)

    def outcome(self, state: Any, course: DrawnChunks) -> Answer:
        """The answer by the draws."""
        return conclude_draws(self.problem, self.prior, self.run(course))

    def run(self, course: DrawnChunks) -> SamplerRun:
        """The draws of a course; raises `FitError` where there are none or some are not finite."""
        kept, stopped = thinning(self.method, len(course)), "" if self.complete else self.context.monitor.stopped
        if not len(kept.draws):
            raise FitError(f"{stopped} in the warm-up, before there was a draw: give a longer limit, or fewer steps")
        drawn, seconds = self._drawn(course, kept), time.perf_counter() - self.began
        if not np.isfinite(np.asarray(drawn.theta)).all():
            raise FitError(
                f"{self.name}: some draw is not finite; give biases that no row determines a survey, or fix them"
            )
        return SamplerRun(
            self.method, self.asked, self.form, self.posed, self.worth, drawn, seconds, stopped, self.note, self.sides,
            kept.thin,
        )  # fmt: skip

    @staticmethod
    def _drawn(course: DrawnChunks, kept: Thinning) -> Draw:
        """The draws that are kept of a course."""
        names = [name for name in course[-1] if name != MEAN]
        return gathered({name: np.concatenate([one[name] for one in course], 1)[:, kept.draws] for name in names})


def _growth(steps: int) -> int:
    """A number that grows by 1 where steps grow by a quarter."""
    return int(np.log(max(steps, 1)) / np.log(1.25))


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
