"""A check of a fit: what it needs, what it may ask, and what it returns.

A check is a function of a `Case` with the decorator `check`, in a file of its own, and a line of
`probcal.analysis.checks.CHECKS`. `assess` runs all whose needs a fit meets and knows none by name.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import jax
import numpy as np
import xarray as xr

from probcal.analysis import predictive
from probcal.analysis.findings import Finding
from probcal.errors import InputError
from probcal.gaussian.draws import many_data
from probcal.gaussian.engine import Factors
from probcal.inference import residuals
from probcal.inference.fitted import Judged
from probcal.inference.widen import Rejection, rejection
from probcal.linalg import invert
from probcal.results.blocks import SensorBlocks
from probcal.simulate import Truth
from probcal.status import INVALID, Status

# no misfit; no invalid end; a factor of the biases; draws of tracks; the truth
NEEDS = ("explained", "answer", "factor", "draws", "truth")


class Checked(NamedTuple):
    """The results of a check."""

    groups: Mapping[str, xr.Dataset] = {}  # of the tree, by name
    findings: Sequence[Finding] = ()
    doubts: Mapping[str, Mapping[int, str]] = {}  # reason by bias, by the verdict that it is for
    explains: Sequence[str] = ()  # checks whose findings are only a sign of what this one found
    inflation: np.ndarray | None = None  # (M,) of the variances of biases, where the check measured it
    remarks: Mapping[int, str] = {}  # further words to the reason of a bias


@dataclass(frozen=True, eq=False)
class Case:
    """A fit to be checked, and what several checks ask of it."""

    fit: Judged
    tree: xr.DataTree
    truth: Truth | None
    keys: list[jax.Array]  # of the draws, of the replicas, of what a check draws itself

    @cached_property
    def has(self) -> frozenset[str]:
        """The entries of `NEEDS` that the fit provides."""
        status, engine = Status(self.tree.attrs["status"]), self.fit.engine
        drawable = engine.cheap or (engine.exact and not many_data(self.fit.problem.model))
        facts = status.explains, status not in INVALID, engine.exact, drawable, self.truth is not None
        return frozenset(name for name, holds in zip(NEEDS, facts, strict=True) if holds)

    @cached_property
    def _known(self) -> dict[Callable[[Case], Any], Any]:
        return {}

    def once(self, of: Callable[[Case], Any]) -> Any:
        """The result of a function of this case, worked out once for all checks."""
        if of not in self._known:
            self._known[of] = of(self)
        return self._known[of]

    @cached_property
    def drawn(self) -> predictive.FitDraws:
        """Draws of the fit."""
        return predictive.draws_of(self.fit, self.tree, self.keys[0])

    @cached_property
    def replicas(self) -> predictive.Predictive | None:
        """The data compared with their replicas; None without draws."""
        return predictive.check_replicas(self.fit, self.drawn, self.keys[1]) if "draws" in self.has else None

    @cached_property
    def filtered(self) -> residuals.Filtered:
        """The innovations and the filters behind them."""
        replicas = self.replicas
        kurtosis = residuals.measured_kurtosis(self.fit) if replicas is None else replicas.kurtosis
        return residuals.innovations(self.fit, kurtosis)

    @property
    def innovations(self) -> residuals.Innovations:
        """The innovations."""
        return self.filtered.innovations

    @cached_property
    def channels(self) -> residuals.Channels:
        """The innovations of each channel of each sensor."""
        return residuals.channels_of(self.fit.data, self.innovations)

    @cached_property
    def rejected(self) -> Rejection:
        """The verdict of the innovations on the model, and the inflation that they call for."""
        return rejection(self.fit, self.innovations, self.channels)

    @cached_property
    def declared(self) -> SensorBlocks:
        """The covariance of z that the data leave under the declared scales."""
        found = self.fit.declared(self.tree)
        if found is not None:
            return found
        information = self.tree["calibration"].to_dataset()["information"].values
        return SensorBlocks.of(invert(information + np.eye(len(information))))

    @cached_property
    def declared_mean(self) -> np.ndarray:
        """The mean (M,) of z under a Gaussian prior of the declared scales, about the fit."""
        at, z = self.fit.expansion, np.asarray(self.fit.point.z)
        return z + np.asarray(at.solve(Factors.alone(np.ones(len(z))), np.asarray(at.score()) - z))


@dataclass(frozen=True)
class Check:
    """A check: a function of a case, and what it needs of one."""

    function: Callable[[Case], Checked]
    needs: frozenset[str]  # of `Case.has`
    causes: Sequence[str]  # of an end without an answer that its findings may tell, "misfit" and "other"

    def __call__(self, case: Case) -> Checked:
        """The results of the check on a case."""
        return self.function(case)


def check(*needs: str, causes: Sequence[str] = ()) -> Any:
    """Make a check of a function of a `Case`.

    Raises `InputError` for a need that no fit can have.
    """
    if unknown := set(needs) - set(NEEDS):
        raise InputError(f'check: no fit has "{min(unknown)}"; a check may need {", ".join(NEEDS)}')
    return lambda function: Check(function, frozenset(needs), causes)
