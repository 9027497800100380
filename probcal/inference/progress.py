"""How far a long call has come: what every `progress` argument is called with."""

from collections.abc import Callable
from typing import NamedTuple


class Progress(NamedTuple):
    """How far a call has come: a fit by iterations or steps of a chain, `sbc` by runs, a study by fits.

    `fit(problem, progress=print)` prints each.
    """

    what: str  # the method, "runs" or "fits"
    done: int
    total: int  # a climb may end before; it grows where draws have not mixed and are made anew
    objective: float | None = None  # of a climb, or the mean log density of the last draws; None of runs and fits


OnProgress = Callable[[Progress], None]
