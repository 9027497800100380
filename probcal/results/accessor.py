"""`tree.probcal`: what a tree of results says, as methods of the tree itself."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

from probcal.lazy import pd, xr
from probcal.results.display import install

if TYPE_CHECKING:
    from probcal.simulate import Truth


class Accessor:
    """The tables of a tree that `fit`, `assess`, `track` or `load` returned: `tree.probcal.summary()`."""

    def __init__(self, tree: xr.DataTree):
        self._tree = tree

    def summary(self) -> pd.DataFrame:
        """One row a bias, as `probcal.summary`."""
        from probcal.results.read import summary

        return summary(self._tree)

    def tracks(self) -> pd.DataFrame:
        """One row an epoch of a target, as `probcal.tracks`."""
        from probcal.results.read import tracks

        return tracks(self._tree)

    def outliers(self, *, below: float = 0.5) -> pd.DataFrame:
        """Data that count less than `below`, as `probcal.outliers`."""
        from probcal.results.read import outliers

        return outliers(self._tree, below=below)

    def drifts(self) -> pd.DataFrame:
        """One row a piece of a drifting bias, as `probcal.drift_table`."""
        from probcal.results.drifts import drift_table

        return drift_table(self._tree)

    def scores(self, truth: Truth, *, align: str | None = None) -> dict[str, float]:
        """Scores the tree by a truth, as `probcal.scores`."""
        from probcal.results.scores import scores

        return scores(self._tree, truth, align=align)


@cache
def register() -> None:
    """Let every `xarray.DataTree` have `.probcal`; called where results are made or read, since it loads xarray."""
    xr.register_datatree_accessor("probcal")(Accessor)
    install()
