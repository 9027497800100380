"""Leaving data out: PSIS-LOO by row, exact refits by sensor and by target.

For a whole sensor or target importance sampling fails nearly always, so each is left out for good: its rows are
masked (shapes stay, one compiled kernel serves all), the mode is found again at the fit's precisions, and the log
predictive density of what was left out is the difference of two Laplace evidences: exact on a linear problem.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
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


class Refit(NamedTuple):
    """Where one refit ends."""

    evidence: jax.Array  # log p(data), but for the determinant of the prior
    square: jax.Array  # least squares of all innovations, noises and biases in the linearised problem


def _stepped(at: Expansion, factors: Factors, held: np.ndarray, prior: Precision) -> Refit:
    """One Fisher-scoring step from a point to the mode, and Laplace's evidence there; biases in `held` (M,) go to 0.

    The step counts only where it raises the density: at a mode it changes nothing, on a linear problem it is exact.
    """
    z = np.asarray(at.point.z)
    pinned = factors + Factors.alone(np.where(held, PINNED, 0.0))
    start = at.point._replace(z=jnp.asarray(np.where(held, 0.0, z)))
    moved = at.moved(at.solve(pinned, np.asarray(at.slope()) + pinned.pull(z)))
    least, square = _ends(at.model, at.point, start, moved, prior, at.rows)
    volume = at.log_det(pinned).value - np.count_nonzero(held) * np.log(PINNED) + at.eliminated.logdet
    return Refit(-least - 0.5 * volume, square)


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
        prior = fit.prior._replace(alpha=jnp.asarray(alpha))
        weights = None if out is None else [~out[index][:, None] for index in fit.problem.row_index]
        if not self.quick:
            model = model if weights is None else model.weighted(weights)
            if weights is not None and self.placed:
                point = smooth_tracks(model, point)
                model = model.with_tilt(tilt_at(model, point))
            frozen = variants.without(model, held)
            start = point._replace(z=jnp.asarray(np.where(held, 0.0, point.z)))
            at = fit.engine.at(frozen, find_mode(frozen, start, prior, STEPS, TOLERANCE).point)
        elif weights is not None:
            at = at.weighed(tuple(jnp.asarray(own) for own in weights))
        found = _stepped(at, Factors.of(prior), held, prior)
        return float(found.evidence) + 0.5 * _logdet(prior, held), float(found.square)


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
    """What the rest says of groups of data (sensors or targets) that were left out, each (groups,)."""

    names: list[str]
    elpd: np.ndarray  # log predictive density given the rest
    nis: np.ndarray  # normalised square of its innovation predicted by the rest, a datum
    stated: np.ndarray  # elpd with the group's own biases held at 0
    stated_nis: np.ndarray
    quick: bool  # one step from the fit instead of a search


def leave_sensors(fit: Judged, chosen: Collection[str]) -> Left | None:
    """Chosen sensors left out, None for a single one; the biases that only it reads have their declared scales.

    `elpd` less `stated` says how much better the sensor fits the rest calibrated than as stated.
    """
    problem, readers = fit.problem, fit.readers
    alpha, none = np.asarray(fit.prior.alpha), np.zeros(problem.model.biases, bool)
    sensor = problem.measurements.sensor
    counted = set(fit.data["sensor"])  # some have rows of weight 0 only
    present = [s for s in np.unique(sensor) if problem.network.sensors[s].name in counted]
    if len(present) < 2:
        return None
    present = [s for s in present if problem.network.sensors[s].name in chosen]
    refits, rows = _Refits(fit, 3 * len(present)), []
    for s in present:
        own = readers[s] & (readers.sum(0) == 1)
        wide = np.where(own & ~problem.surveyed, 1.0, alpha)
        rest = refits.run(sensor == s, wide, none)
        rows.append([rest, refits.run(None, wide, none), refits.run(None, wide, own)])
    return _left([problem.network.sensors[s].name for s in present], rows, fit.data["sensor"], refits.quick)


def leave_targets(fit: Judged, chosen: Collection[str]) -> Left | None:
    """Chosen targets left out; None where there is one only, or more than 32 are chosen."""
    problem, target = fit.problem, fit.problem.measurements.target
    counted = set(fit.data["target"])
    present = [t for t in np.unique(target) if problem.measurements.target_names[t] in counted]
    if len(present) < 2 or len(chosen) > TARGETS:
        return None
    present = [t for t in present if problem.measurements.target_names[t] in chosen]
    alpha, none = np.asarray(fit.prior.alpha), np.zeros(problem.model.biases, bool)
    refits = _Refits(fit, len(present))
    whole = refits.run(None, alpha, none)
    rows = [[refits.run(target == t, alpha, none), whole, whole] for t in present]
    names = [problem.measurements.target_names[t] for t in present]
    return _left(names, rows, fit.data["target"], refits.quick)


def _left(names: list[str], rows: list[Any], owner: pd.Series, quick: bool) -> Left:
    values = np.array(rows)  # (groups, 3, 2)
    count = owner.value_counts()[names].to_numpy()
    elpd, square = values[:, 1:, 0] - values[:, :1, 0], (values[:, 1:, 1] - values[:, :1, 1]) / count[:, None]
    return Left(names, elpd[:, 0], square[:, 0], elpd[:, 1], square[:, 1], quick)


class Pointwise(NamedTuple):
    """PSIS-LOO of groups of data, each (groups,): log predictive density and Pareto k."""

    elpd: np.ndarray
    pareto_k: np.ndarray


def psis(tree: xr.DataTree, group: np.ndarray, count: int) -> Pointwise:
    """PSIS-LOO of the log-likelihood in a tree, summed over groups (data,); `az.loo` where each is a datum."""
    values = tree["log_likelihood"].to_dataset()["y"].values
    values = values.reshape(-1, values.shape[2])
    order = np.argsort(group, kind="stable")
    summed = np.add.reduceat(values[:, order], np.searchsorted(group[order], np.arange(count)), axis=1).T
    weights, pareto_k = smoothed(-summed)
    return Pointwise(special.logsumexp(weights + summed, axis=1), pareto_k)


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
