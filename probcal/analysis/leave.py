"""Leaving data out: PSIS-LOO by row, exact refits by sensor and by target.

For a whole sensor or target importance sampling fails nearly always, so each is left out for good: its rows are
masked (shapes stay, one compiled kernel serves all), the mode is found again at the fit's precisions, and the log
predictive density of what was left out is the difference of two Laplace evidences: exact on a linear problem.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from scipy import special

from probcal.gaussian.engine import Expansion, Factors
from probcal.gaussian.mode import Point, cost, find_mode, smooth_tracks
from probcal.gaussian.places import tilt_at
from probcal.inference.fitted import Judged
from probcal.inference.pose import TAILED
from probcal.inference.psis import smoothed
from probcal.linalg import log_determinant
from probcal.model import variants
from probcal.model.model import Model
from probcal.model.rows import Linearised, standardised
from probcal.priors import Precision
from probcal.results.read import summed_log_likelihood

STEPS = 20  # Gauss-Newton steps of a refit
TOLERANCE = 1e-5  # nats
WORK = 3e9  # operations of all eliminations beyond which a refit is one step from the fit
PLACED = 100  # refits up to which the places of targets at rest are integrated anew
PINNED = 1e12  # precision by which a bias is held at zero
TARGETS = 32  # beyond which targets are not left out one by one


def _stepped(at: Expansion, factors: Factors, held: np.ndarray, prior: Precision) -> tuple[float, float]:
    """Evidence, by Laplace's formula, and least squares one Fisher-scoring step from a point, biases `held` (M,) at 0.

    The step counts only where it raises the density: at a mode it changes nothing, on a linear problem it is exact.
    """
    z = np.asarray(at.point.z)
    pinned = factors + Factors.alone(np.where(held, PINNED, 0.0))
    start = at.point._replace(z=jax.device_put(np.where(held, 0.0, z)))
    moved = at.moved(at.solve(pinned, np.asarray(at.slope()) + pinned.pull(z)))
    least, square = _ends(at.model, at.point, start, moved, prior, at.rows)
    volume = at.log_det(pinned).value - np.count_nonzero(held) * np.log(PINNED) + float(at.eliminated.logdet)
    return 0.5 * (_logdet(prior, held) - volume) - float(least), float(square)


@jax.jit
def _ends(
    model: Model, point: Point, start: Point, moved: Point, prior: Precision, lins: Sequence[Linearised]
) -> tuple[jax.Array, jax.Array]:
    """The lesser cost of a start and of a step from it, and the least squares of all at the step."""
    ends = jax.tree.map(lambda a, b: jnp.stack([a, b]), start, moved)
    before, after = jax.vmap(lambda end: cost(model, end, prior))(ends)
    square = sum(jnp.sum(u**2) for u in moved.noises) + prior.square(moved.z)
    dx = model.each(lambda _, x, before_: (x - before_)[:, :, None], moved.states, point.states)
    for lin, change in zip(lins, model.responses(lins, dx, (moved.z - point.z)[:, None]), strict=True):
        square = square + jnp.sum((standardised(lin.score, lin.weight) - jnp.sqrt(lin.weight) * change[:, :, 0]) ** 2)
    return jnp.where(after < before, after, before), square


class _Refits:
    """Refits of a problem with data masked, precisions changed or biases held at 0."""

    def __init__(self, fit: Judged, jobs: int):
        model = fit.problem.model
        work = 2.0 * jobs * model.state_size * model.biases**2
        self.fit, self.quick = fit, work > WORK or not fit.whole
        self.placed = fit.problem.tilted and jobs <= PLACED and not self.quick

    def run(self, out: np.ndarray | None, alpha: np.ndarray, held: np.ndarray) -> tuple[float, float]:
        """Evidence and least squares without the rows (of the table) in `out`, at precisions alpha (M,)."""
        fit, model, point, at = self.fit, self.fit.problem.model, self.fit.point, self.fit.expansion
        prior = fit.prior._replace(alpha=jax.device_put(alpha))
        weights = None if out is None else [~out[index][:, None] for index in fit.problem.row_index]
        if not self.quick:
            model = model if weights is None else model.weighted(weights)
            if weights is not None and self.placed:
                point = smooth_tracks(model, point)
                model = model.with_tilt(tilt_at(model, point))
            frozen = variants.without(model, held)
            start = point._replace(z=jax.device_put(np.where(held, 0.0, point.z)))
            at = fit.engine.at(frozen, find_mode(frozen, start, prior, STEPS, TOLERANCE).point)
        elif weights is not None:
            at = at.weighed(tuple(jnp.asarray(own) for own in weights))
        return _stepped(at, Factors.of(prior), held, prior)


def _logdet(prior: Precision, held: np.ndarray) -> float:
    """Log determinant of the prior of the biases that are not held, a flat one counted as one."""
    alpha = np.where((np.asarray(prior.alpha) > 0) & ~held, prior.alpha, 1.0)
    total = float(np.log(alpha).sum())
    for members, added in prior.coupling:
        left = ~held[members]
        own = np.diag(alpha[members][left])
        both = own + np.asarray(added)[np.ix_(left, left)]
        total += float(log_determinant(both) - log_determinant(own))
    return total


class Left(NamedTuple):
    """What the rest says of sensors or targets that were left out, each (groups,).

    `elpd` is the log predictive density given the rest, `rest_nis` the mean square of its innovations predicted by the
    rest. Of sensors also the same with their own biases held at 0, and the `difference` of both densities: how much
    better a sensor fits the rest calibrated than as stated.
    """

    values: dict[str, np.ndarray]
    quick: bool  # one step from the fit instead of a search


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
    refits = _Refits(fit, (3 if sensors else 1) * len(chosen))
    whole = [] if sensors else [refits.run(None, alpha, none)]
    for k in map(names.index, chosen):
        own = readers[k] & (readers.sum(0) == 1) if sensors else none
        wide = np.where(own & ~problem.surveyed, 1.0, alpha)
        rows.append([refits.run(owner == k, wide, none), *(whole or [refits.run(None, wide, h) for h in (none, own)])])
    found, count = np.array(rows), fit.data[name].value_counts()[list(chosen)].to_numpy()  # found (groups, 2 or 3, 2)
    elpd, nis = np.moveaxis(found[:, 1:] - found[:, :1], 2, 0) / np.stack([np.ones(len(count)), count])[:, :, None]
    values = {"elpd": elpd[:, 0], "rest_nis": nis[:, 0]}
    if sensors:
        values |= {"elpd_stated": elpd[:, 1], "difference": elpd[:, 0] - elpd[:, 1], "stated_nis": nis[:, 1]}
    return Left(values, refits.quick)


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
    """Whether a tree has a log-likelihood of every datum, of draws enough for a Pareto tail, and is no misfit."""
    return "log_likelihood" in tree.children and weighable(tree)


def weighable(tree: xr.DataTree) -> bool:
    """Whether a tree has the log-likelihood of draws enough for a Pareto tail, and is no misfit."""
    summed = summed_log_likelihood(tree)
    return summed is not None and tree.attrs["status"] != "misfit" and summed.size >= TAILED


def good_k(tree: xr.DataTree) -> float:
    """Pareto k up to which importance sampling can be trusted with so many draws (Vehtari et al. 2024)."""
    posterior = tree["log_likelihood"].to_dataset()
    return min(1.0 - 1.0 / float(np.log10(posterior.sizes["chain"] * posterior.sizes["draw"])), 0.7)


def standard_error(elpd: np.ndarray) -> float:
    """Standard error of a sum of log predictive densities, as ArviZ has it."""
    return float(np.sqrt(len(elpd) * np.var(elpd, ddof=1)))
