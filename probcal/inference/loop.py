"""The one outer loop: it runs the iterations of a task with progress, a limit, interruption, and a store to go on from.

A task has a first state and a step. Its state is a pytree of arrays; what else it needs is made anew from these, so
that a killed run goes on from the last state that was stored, to the same end.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal.errors import InputError
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


class Task(ABC):
    """Work in outer iterations. A step is a function of the state and of how many iterations are done.

    The course of a task says how many `iterations` it has, its `objective` after each, and goes on by `and_then`.
    """

    kind: ClassVar[str] = "climb"  # of the storage that keeps it

    @property
    @abstractmethod
    def name(self) -> str:
        """The name of the method, for reports of progress."""

    @property
    @abstractmethod
    def iterations(self) -> int:
        """The most iterations."""

    @property
    @abstractmethod
    def biases(self) -> int:
        """Number of the biases."""

    @abstractmethod
    def init(self) -> Any:
        """The state before the first iteration."""

    @abstractmethod
    def step(self, state: Any, count: int, pause: Pause) -> tuple[Any, Any]:
        """The state after some iterations, `count` done before, and their course; it returns early on a `pause`."""

    @abstractmethod
    def ended(self, state: Any, course: Any) -> bool:
        """True where no further iteration is needed."""

    def course(self, stored: Sequence[Any] = ()) -> Any:
        """The course that was stored, the empty one where nothing was."""
        return Trace(*(stored or (np.zeros(0), *np.zeros((2, 0, self.biases)))))

    def tell(self, monitor: Monitor, done: int, objective: float) -> None:
        """Report that some iterations are done."""
        monitor.tell(self.name, min(done, self.iterations), self.iterations, objective, bound=True)


def run(task: Task, monitor: Monitor, storage: Storage | None = None) -> tuple[Any, Any]:
    """Run a task until it has ended, is spent or stopped: its last state and its course.

    A storage keeps state and course on the way; what it holds of this loop is gone on with, by one step at least. Of a
    loop that begins when the call is stopped nothing is written, since it is not what an uninterrupted run does.
    """
    late = bool(monitor.stopped)
    state, course, moved = task.init(), task.course(), False
    kept = None if storage is None else storage.checkpoint(task.kind, arrays_of(state))

    def pause(done: int, objective: float) -> bool:
        task.tell(monitor, done, objective)
        return bool(monitor.stopped) or (kept is not None and not late and kept.due)

    if kept is not None and kept.found is not None:
        state, course = like(state, kept.found[0]), task.course(kept.found[1])
    while True:
        if done := course.iterations:
            task.tell(monitor, done, float(course.objective[-1]))
        if task.ended(state, course) or done >= task.iterations or (moved and monitor.stopped):
            break
        state, more = task.step(state, done, pause)
        course, moved = course.and_then(more), True
        if kept is not None and not late and kept.due:
            kept.write(arrays_of(state), course)
    if kept is not None and not late:
        kept.write(arrays_of(state), course)
    return state, course


def arrays_of(state: Any) -> list[np.ndarray]:
    """The leaves of a state as they are stored, random keys by their data."""
    return [np.asarray(jax.random.key_data(leaf) if is_key(leaf) else leaf) for leaf in jax.tree.leaves(state)]


def is_key(leaf: Any) -> bool:
    """True of a random key of its own type."""
    return isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def like(state: Any, leaves: Sequence[np.ndarray]) -> Any:
    """The stored leaves in the form of a state, on the device where its own are; raises `InputError` for others.

    What the state leaves empty at the beginning may have any shape.
    """
    own, form = jax.tree.flatten(state)
    first = arrays_of(state)
    if len(first) != len(leaves) or any(
        mine.size and mine.shape != leaf.shape for mine, leaf in zip(first, leaves, strict=True)
    ):
        raise InputError(
            "the state of the stored run has another form than this run's: begin anew with --overwrite (overwrite=True)"
        )

    def restored(stored: np.ndarray, own: Any) -> Any:
        if is_key(own):
            return jax.random.wrap_key_data(jnp.asarray(stored), impl=jax.random.key_impl(own))
        return jnp.asarray(stored) if isinstance(own, jax.Array) else stored

    return jax.tree.unflatten(form, [restored(*pair) for pair in zip(leaves, own, strict=True)])
