"""Progress on a terminal: a line that follows the iterations, a bar of fits."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import Progress

Iterations = Callable[[str, int, float], None]  # method, iteration, objective


@contextmanager
def line() -> Iterator[Iterations | None]:
    """A line on a terminal that follows the iterations; nothing where stderr is a file."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield None
        return
    with console.status("starting: compiling, finding the tracks") as status:
        yield lambda method, count, value: status.update(f"{method}: iteration {count}, objective {value:.3f}")


@contextmanager
def bar() -> Iterator[Callable[[int, int], None]]:
    """A progress bar on a terminal; nothing where stderr is a file."""
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as shown:
        task = shown.add_task("fits", total=None)
        yield lambda done, total: shown.update(task, completed=done, total=total)
