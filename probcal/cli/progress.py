"""Progress on a terminal: a line that follows the iterations, a bar of fits."""

from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import Progress as Bar

from probcal.inference.progress import OnProgress
from probcal.inference.progress import Progress as At


@contextmanager
def line() -> Iterator[OnProgress | None]:
    """A line on a terminal that follows the iterations; nothing where stderr is a file."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield None
        return
    with console.status("starting: compiling, finding the tracks") as status:
        yield lambda at: status.update(_text(at))


def _text(at: At) -> str:
    done = f"{at.what}: {at.done} of {at.total}"
    return done if at.objective is None else f"{done}, objective {at.objective:.3f}"


@contextmanager
def bar() -> Iterator[OnProgress]:
    """A progress bar on a terminal; nothing where stderr is a file."""
    console = Console(stderr=True)
    with Bar(console=console, transient=True, disable=not console.is_terminal) as shown:
        task = shown.add_task("fits", total=None)
        yield lambda at: shown.update(task, description=at.what, completed=at.done, total=at.total)
