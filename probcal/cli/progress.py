"""Progress of a command on stderr: a live line on a terminal; in a file a line now and then."""

import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.spinner import Spinner
from rich.text import Text

from probcal.inference.progress import OnProgress, Progress, Terminated, handled

FIRST = 5.0  # s to the first line in a file, and least between two where the phase changes
GAP = 20.0  # s, least time to the next line of a phase
SHARE = 0.1  # time to the next line over all time so far
LONGEST = 600.0  # s, longest time to the next line


class Line:
    """The last line of progress; it says whether it is time to print it in a file."""

    def __init__(self, clock: Callable[[], float] = time.monotonic):
        self._clock, self._began, self._phase = clock, clock(), ""
        self._printed: float | None = None
        self.at = Progress("starting", 0, 1)
        self._told = self._began

    def __call__(self, at: Progress) -> None:
        """Take what is to be shown."""
        self.at, self._told = at, self._clock()

    def __str__(self) -> str:
        now = self._clock()
        left = None if self.at.left is None else max(self.at.left - (now - self._told), 0.0)
        return str(self.at._replace(seconds=now - self._began, left=left))

    def due(self) -> bool:
        """True where a line is due now; it then counts as printed."""
        now, phase = self._clock(), self.at.phase
        if self._printed is None:
            wait = now - self._began >= FIRST
        else:
            gap = min(max(GAP, SHARE * (now - self._began)), LONGEST)
            wait = now - self._printed >= (gap if phase == self._phase else FIRST)
        if wait:
            self._printed, self._phase = now, phase
        return wait


@contextmanager
def shown() -> Iterator[OnProgress]:
    """Show the phase, the time so far and an estimate of the rest while a command works.

    Within it SIGTERM acts as Ctrl-C.
    """
    with handled(_terminate, [signal.SIGTERM]), _on_stderr() as line:
        yield line


def _terminate(*_: Any) -> None:
    raise Terminated


@contextmanager
def _on_stderr() -> Iterator[Line]:
    """A line that is printed, live on a terminal."""
    console, line = Console(stderr=True), Line()
    if console.is_terminal:
        spinner = Spinner("dots")

        def render() -> Spinner:
            spinner.update(text=Text(str(line)))
            return spinner

        with Live(get_renderable=render, console=console, transient=True, refresh_per_second=4):
            yield line
        return
    ended = threading.Event()

    def write() -> None:
        while not ended.wait(1.0):
            if line.due():
                print(line, file=sys.stderr, flush=True)

    threading.Thread(target=write, daemon=True).start()
    try:
        yield line
    finally:
        ended.set()
