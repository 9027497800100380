"""The course of a long call: how far it has come, and what ends it before it is done.

A `Monitor` is the one place that knows both. A loop tells it where it stands, and asks whether it
shall stop.
"""

import math
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from copy import copy
from typing import Any, NamedTuple, Self

from probcal.errors import InputError


class Progress(NamedTuple):
    """The steps done of a call, in a phase of a fit, runs of `sbc` or fits of a study.

    A line as text.

    `fit(problem, progress=print)` prints each.
    """

    what: str  # the method, "runs", "fits" or "recordings"
    done: int
    # 1 where the steps of a phase are not counted; it grows where draws have not mixed and are made
    # anew
    total: int
    # of a climb, or the mean log density of the last draws; None where there is none
    objective: float | None = None
    # "start", "climb", "start 2 of 3", "mirror images", "checks", "warm-up", "draws"
    phase: str = ""
    seconds: float = 0.0  # since the call began
    left: float | None = None  # estimate of the seconds that are left; None where it is not known
    bound: bool = False  # whether a climb may end before `total`

    def __str__(self) -> str:
        name = ", ".join(part for part in (self.what, self.phase) if part)
        counted = f"{self.done} of {'at most ' if self.bound else ''}{self.total}"
        parts = [f"{name}: {counted}" if self.total > 1 else name]
        parts += [] if self.objective is None else [f"objective {self.objective:.3f}"]
        parts += [duration(self.seconds)]
        parts += [] if self.left is None else [f"about {duration(self.left)} left"]
        return ", ".join(parts)


STOPPING = "stopping"  # the phase after an interruption
OnProgress = Callable[[Progress], None]


def duration(seconds: float) -> str:
    """A length of time in the words of a line of progress."""
    whole = round(seconds)
    if whole < 120:
        return f"{whole} s"
    minutes, rest = divmod(whole, 60)
    if minutes < 120:
        return f"{minutes} min {rest} s" if rest and minutes < 10 else f"{minutes} min"
    return f"{minutes // 60} h {minutes % 60} min"


def check_limit(limit: float | None) -> None:
    """Raise `InputError` for a limit of time that is not positive."""
    if limit is not None and not 0.0 < limit < math.inf:
        raise InputError(f"the limit of the search is {limit:g} s; give a positive number of seconds")


class Terminated(KeyboardInterrupt):
    """SIGTERM, which ends a command as Ctrl-C does."""


class Stopped(Exception):
    """The search for other answers shall end."""


class Monitor:
    """Reports how far a call has come, and says whether it shall stop: at a limit of time, or
    interrupted.

    An interruption, Ctrl-C or a `progress` that raises `KeyboardInterrupt`, stops the loops once
    there is an answer to keep. Before that, and a second time, it is raised. Raises `InputError`
    for a limit that is not positive.
    """

    def __init__(
        self,
        progress: OnProgress | None = None,
        limit: float | None = None,
        signals: Sequence[int] = (signal.SIGINT,),
        clock: Callable[[], float] = time.monotonic,
    ):
        check_limit(limit)
        self._progress, self._limit, self._signals, self._clock = progress, limit, signals, clock
        self._began = clock()
        self._first, self._counted = (
            (self._began, 0),
            ("", 0),
        )  # from which the speed is measured; what was last
        self._at = Progress("", 0, 1)
        self._answering = self._answered = False
        self.signal = 0  # number of the signal that interrupted the call

    @property
    def stopped(self) -> str:
        """The words that begin the sentence on why the call ended early; empty while it goes on."""
        if self.signal:
            return "Interrupted"
        if self._limit is not None and self._clock() - self._began >= self._limit:
            return f"Ended by the limit of {self._limit:g} s"
        return ""

    def check(self) -> None:
        """Raise `Stopped` where the call shall end."""
        if self.stopped:
            raise Stopped

    def silent(self) -> Self:
        """One with the same limit that reports nothing and keeps nothing: for a start, which is no
        answer."""
        other = copy(self)
        other._progress = None
        return other

    def enter(self, phase: str, what: str | None = None, *, answering: bool = False) -> None:
        """A phase begins; in one that is `answering`, the first step leaves an answer to keep."""
        self._answering = answering
        phase = STOPPING if self.signal else phase
        self._at = self._at._replace(phase=phase, what=self._at.what if what is None else what)
        self._report(Progress(self._at.what, 0, 1, None, phase, self._clock() - self._began))

    def tell(
        self,
        what: str,
        done: int,
        total: int,
        objective: float | None = None,
        *,
        bound: bool = False,
    ) -> None:
        """A loop has done some steps of all; of a `bound` the time that is left is not known."""
        self._answered = self._answered or self._answering
        now, (before, last) = self._clock(), self._counted
        if what != before or done <= last:
            self._first = (now, done)
        self._counted, (since, first) = (what, done), self._first
        left = (now - since) / (done - first) * (total - done) if done > first and not bound else None
        self._at = Progress(what, done, total, objective, self._at.phase, now - self._began, left, bound)
        self._report(self._at)

    def _report(self, at: Progress) -> None:
        if self._progress is None:
            return
        try:
            self._progress(at)
        except Terminated:
            self.interrupt(signal.SIGTERM)
        except KeyboardInterrupt:
            self.interrupt()

    def interrupt(self, number: int = signal.SIGINT, _: Any = None) -> None:
        """The handler of a signal: stop the call where it has an answer.

        Raise `KeyboardInterrupt` else, or again.
        """
        again, self.signal, self._at = bool(self.signal), number, self._at._replace(phase=STOPPING)
        if again or not self._answered:
            raise Terminated if number == signal.SIGTERM else KeyboardInterrupt

    @contextmanager
    def interruptible(self) -> Iterator[None]:
        """Within it signals interrupt the call, in the main thread, and where nobody else handles
        Ctrl-C."""
        with handled(self.interrupt, self._handled()):
            yield

    def _handled(self) -> list[int]:
        """The signals that it handles: Ctrl-C only where nobody else does."""
        return [s for s in self._signals if s != signal.SIGINT or signal.getsignal(s) is signal.default_int_handler]

    @contextmanager
    def leaving(self) -> Iterator[None]:
        """Within it a signal ends the block only: the call has its answer already."""

        def leave(number: int, _: Any) -> None:
            self.signal = number
            raise KeyboardInterrupt

        with suppress(KeyboardInterrupt), handled(leave, self._handled()):
            yield


@contextmanager
def handled(handler: Callable[[int, Any], Any], signals: Sequence[int]) -> Iterator[None]:
    """Within it a handler takes signals.

    Another thread than the main one leaves them as they are.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, handler) for number in signals}
    try:
        yield
    finally:
        for number, other in before.items():
            signal.signal(number, other)
