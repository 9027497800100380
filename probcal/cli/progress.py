"""Progress of a command: a line or a bar on a terminal; where stderr is a file, a line now and then."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import Progress as Bar

from probcal.inference.progress import OnProgress
from probcal.inference.progress import Progress as At

FIRST, LONGEST = 30.0, 600.0  # s to the first line in a file, which doubles up to the other


@contextmanager
def line() -> Iterator[OnProgress]:
    """A line on a terminal that follows the iterations; in a file a line now and then."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield sparse()
        return
    with console.status("starting: compiling, finding the tracks") as status:
        yield lambda at: status.update(_text(at))


@contextmanager
def bar() -> Iterator[OnProgress]:
    """A progress bar on a terminal; in a file a line now and then."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield sparse()
        return
    with Bar(console=console, transient=True) as shown:
        task = shown.add_task("fits", total=None)
        yield lambda at: shown.update(task, description=at.what, completed=at.done, total=at.total)


def sparse(clock: Callable[[], float] = time.monotonic) -> OnProgress:
    """Lines on stderr at growing distances: after 30 s, one minute, two, and so on, ten at most."""
    began = clock()
    due, gap = began + FIRST, FIRST

    def say(at: At) -> None:
        nonlocal due, gap
        now = clock()
        if now < due:
            return
        gap = min(2 * gap, LONGEST)
        due = now + gap
        print(f"{_text(at)}, {now - began:.0f} s", file=sys.stderr, flush=True)

    return say


def _text(at: At) -> str:
    done = f"{at.what}: {at.done} of {at.total}"
    return done if at.objective is None else f"{done}, objective {at.objective:.3f}"
