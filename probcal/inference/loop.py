"""The one outer loop: it runs the iterations of a task with progress, a limit, interruption, and a store to go on from.

A task has a first state and a step. Its state is a pytree of arrays; what else it needs is made anew from these, so
that a killed run goes on from the last state that was stored, to the same end.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal.inference.progress import Monitor
from probcal.inference.storage import Storage

Pause = Callable[[int, float], bool]  # told iterations and objective within a long step: whether it shall return


class Trace(NamedTuple):
    """The course of a loop, by iteration."""

    objective: Any  # (I,)
    z: Any  # (I, M) biases after each
    alpha: Any  # (I, M) their precisions

    @property
    def iterations(self) -> int:
        """Number of the iterations."""
        return len(self.objective)

    def and_then(self, other: Trace) -> Trace:
        """This course and what came after it."""
        return Trace(*(np.concatenate([a, np.asarray(b)]) for a, b in zip(self, other, strict=True)))


@dataclass(eq=False)
class Task(ABC):
    """Work in outer iterations. A step is a function of the state and of how many iterations are done."""

    name: str  # of the method, for reports of progress
    iterations: int  # at most
    biases: int

    @abstractmethod
    def init(self) -> Any:
        """The state before the first iteration."""

    @abstractmethod
    def step(self, state: Any, count: int, pause: Pause) -> tuple[Any, Trace]:
        """The state after some iterations, `count` done before, and their course; it returns early on a `pause`."""

    @abstractmethod
    def ended(self, state: Any, trace: Trace) -> bool:
        """True where no further iteration is needed."""


def run(task: Task, monitor: Monitor, storage: Storage | None = None) -> tuple[Any, Trace]:
    """Run a task until it has ended, is spent or stopped: its last state and its course.

    A storage keeps state and course on the way; what it holds of this loop is gone on with. Of a loop that begins when
    the call is stopped nothing is written, since it is not what an uninterrupted run does.
    """
    state, moved = task.init(), False
    trace = Trace(np.zeros(0), *np.zeros((2, 0, task.biases)))
    kept, late = None if storage is None else storage.checkpoint(arrays_of(state)), bool(monitor.stopped)

    def tell(done: int, objective: float) -> None:
        monitor.tell(task.name, min(done, task.iterations), task.iterations, objective, bound=True)

    def pause(done: int, objective: float) -> bool:
        tell(done, objective)
        return bool(monitor.stopped) or (kept is not None and not late and kept.due)

    if kept is not None and kept.found is not None:
        state, trace, moved = like(state, kept.found[0]), Trace(*kept.found[1]), True
    while True:
        if done := trace.iterations:
            tell(done, float(trace.objective[-1]))
        if done >= task.iterations or task.ended(state, trace) or (moved and monitor.stopped):
            break
        state, course = task.step(state, done, pause)
        trace, moved = trace.and_then(course), True
        if kept is not None and not late and kept.due:
            kept.write(arrays_of(state), trace)
    if kept is not None and not late:
        kept.write(arrays_of(state), trace)
    return state, trace


def arrays_of(state: Any) -> list[np.ndarray]:
    """The leaves of a state as they are stored, random keys by their data."""
    return [np.asarray(jax.random.key_data(leaf) if is_key(leaf) else leaf) for leaf in jax.tree.leaves(state)]


def is_key(leaf: Any) -> bool:
    """True of a random key of its own type."""
    return isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def like(state: Any, leaves: Sequence[np.ndarray]) -> Any:
    """The stored leaves in the form of a state, on the device where its own are."""

    def restored(stored: np.ndarray, own: Any) -> Any:
        if is_key(own):
            return jax.random.wrap_key_data(jnp.asarray(stored), impl=jax.random.key_impl(own))
        return jnp.asarray(stored) if isinstance(own, jax.Array) else stored

    own, form = jax.tree.flatten(state)
    return jax.tree.unflatten(form, [restored(*pair) for pair in zip(leaves, own, strict=True)])
