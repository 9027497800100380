"""Leaving data out: PSIS-LOO by row, exact refits by sensor and by target.

For a whole sensor or target importance sampling fails nearly always, so each is left out for good: its rows are
masked (shapes stay, one compiled kernel serves all), the mode is found again at the fit's precisions, and the log
predictive density of what was left out is the difference of two Laplace evidences: exact on a linear problem.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
import xarray as xr
from scipy import special

from probcal.gaussian.climb import climb_to_mode
from probcal.gaussian.engine import Factors, evidence
from probcal.gaussian.mode import smooth_tracks
from probcal.gaussian.places import tilt_at
from probcal.inference.fitted import Judged
from probcal.inference.pose import TAILED
from probcal.inference.psis import smoothed
from probcal.results.read import summed_log_likelihood

STEPS = 20  # Gauss-Newton steps of a refit
TOLERANCE = 1e-5  # nats
WORK = 3e9  # operations of all eliminations beyond which a refit is one step from the fit
PLACED = 30_000  # rows of all refits up to which places of targets at rest are integrated anew
PLAIN = ", places by Laplace's formula"  # beyond that
PINNED = 1e12  # precision that holds a bias at zero, and leaves the evidence as if it were fixed there
TARGETS = 32  # beyond which targets are not left out one by one


class _Refits(NamedTuple):
    """Refits of a problem with data masked and other precisions."""

    fit: Judged
    quick: bool  # one step from the fit instead of a search
    placed: bool  # with the places of static targets integrated anew
    plain: bool  # with these by Laplace's formula, in all

    @classmethod
    def of(cls, fit: Judged, jobs: int) -> _Refits:
        """Of a fit, for this many jobs."""
        model = fit.problem.model
        quick = not fit.whole or 2.0 * jobs * model.state_size * model.biases**2 > WORK
        few = jobs * len(fit.problem.measurements.time) <= PLACED
        places = fit.problem.tilted and not quick
        return cls(fit, quick, places and few, places and not few)

    def run(self, out: np.ndarray | None, alpha: np.ndarray) -> tuple[float, float]:
        """Evidence by Laplace's formula, and least squares, at the mode without the rows (of the table) in `out`."""
        fit, point = self.fit, self.fit.point
        model = (fit.problem.untilted if self.plain else fit.problem).model
        if out is not None:
            model = model.weighted([~out[index][:, None] for index in fit.problem.row_index])
            if self.placed:
                point = smooth_tracks(model, point)
                model = model.with_tilt(tilt_at(model, point))
        prior = fit.prior._replace(alpha=jax.device_put(alpha))
        point = point._replace(z=jax.device_put(np.where(alpha < PINNED, point.z, 0.0)))
        expand = partial(fit.engine.at, model)
        how = (1, 0.0) if self.quick else (STEPS, TOLERANCE)
        factors = Factors.of(prior)
        at = climb_to_mode(expand, point, factors, *how, marginal=False).at
        roots = [lin.score / np.sqrt(np.maximum(lin.weight, 1e-300)) for lin in jax.tree.map(np.asarray, at.rows)]
        noises = sum(float(np.square(own).sum()) for own in (*roots, *at.point.noises))
        square = noises + float(prior.square(at.point.z))
        return evidence(at, prior, factors).value, square


class Left(NamedTuple):
    """The scores of sensors or targets that were left out, predicted by the rest, each (groups,).

    `elpd` is the log predictive density given the rest, `rest_nis` the mean square of its innovations predicted by the
    rest. Of sensors also the same with their own biases held at 0, and the `difference` of both densities: how much
    better a sensor fits the rest calibrated than as stated.
    """

    values: dict[str, np.ndarray]
    refits: str  # how they were made


def leave_out(fit: Judged, name: str, chosen: Sequence[str]) -> Left | None:
    """Chosen ones of each "sensor" or "target" left out; the biases that only one sensor reads have their declared
    scales then.

    None for a single one, and for more than 32 targets.
    """
    problem, readers, sensors, rows = fit.problem, fit.readers, name == "sensor", list[Any]()
    if fit.data[name].nunique() < 2 or (len(chosen) > TARGETS and not sensors):
        return None
    data, alpha, none = problem.measurements, np.asarray(fit.prior.alpha), np.zeros(problem.model.biases, bool)
    owner, names = data.target, list(data.target_names)
    if sensors:
        owner, names = data.sensor, [placed.name for placed in problem.network.sensors]
    refits = _Refits.of(fit, (3 if sensors else 1) * len(chosen))
    whole = [] if sensors else [refits.run(None, alpha)]
    for k in map(names.index, chosen):
        own = readers[k] & (readers.sum(0) == 1) if sensors else none
        wide = np.where(own & ~problem.surveyed, 1.0, alpha)
        stated = np.where(own, PINNED, wide)
        rows.append([refits.run(owner == k, wide), *(whole or [refits.run(None, how) for how in (wide, stated)])])
    found, count = np.array(rows), fit.data[name].value_counts()[list(chosen)].to_numpy()  # found (groups, 2 or 3, 2)
    elpd, nis = np.moveaxis(found[:, 1:] - found[:, :1], 2, 0) / np.stack([np.ones(len(count)), count])[:, :, None]
    values = {"elpd": elpd[:, 0], "rest_nis": nis[:, 0]}
    if sensors:
        values |= {"elpd_stated": elpd[:, 1], "difference": elpd[:, 0] - elpd[:, 1], "stated_nis": nis[:, 1]}
    return Left(values, ("one step" if refits.quick else "full") + PLAIN * refits.plain)


class Pointwise(NamedTuple):
    """PSIS-LOO of groups of data, each (groups,): log predictive density, Pareto k, and the density with them."""

    elpd: np.ndarray
    pareto_k: np.ndarray
    within: np.ndarray


def psis(tree: xr.DataTree, group: np.ndarray, count: int, efficiency: float = 1.0) -> Pointwise:
    """PSIS-LOO of the log-likelihood in a tree, summed over groups (data,); `az.loo` where each is a datum."""
    values = tree["log_likelihood"].to_dataset()["y"].values
    values = values.reshape(-1, values.shape[2])
    order = np.argsort(group, kind="stable")
    summed = np.add.reduceat(values[:, order], np.searchsorted(group[order], np.arange(count)), axis=1).T
    weights, pareto_k = smoothed(-summed, efficiency)
    elpd, within = special.logsumexp([weights + summed, summed], axis=2)
    return Pointwise(elpd, pareto_k, within - np.log(len(values)))


def tailed(tree: xr.DataTree) -> bool:
    """True if a tree has a log-likelihood of every datum, of draws enough for a Pareto tail, and is no misfit."""
    return "log_likelihood" in tree.children and weighable(tree)


def weighable(tree: xr.DataTree) -> bool:
    """True if a tree has the log-likelihood of draws enough for a Pareto tail, and is no misfit."""
    summed = summed_log_likelihood(tree)
    return summed is not None and tree.attrs["status"] != "misfit" and summed.size >= TAILED


def good_k(tree: xr.DataTree) -> float:
    """Pareto k up to which importance sampling can be trusted with so many draws (Vehtari et al. 2024)."""
    posterior = tree["log_likelihood"].to_dataset()
    return min(1.0 - 1.0 / float(np.log10(posterior.sizes["chain"] * posterior.sizes["draw"])), 0.7)


def standard_error(elpd: np.ndarray) -> float:
    """Standard error of a sum of log predictive densities, as ArviZ has it."""
    return float(np.sqrt(len(elpd) * np.var(elpd, ddof=1)))
