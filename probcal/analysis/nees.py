"""Normalised squared errors (NEES) of positions and biases against a truth, with limits."""

from typing import NamedTuple

import numpy as np
import xarray as xr
from scipy import special

from probcal import linalg
from probcal.analysis.verdict import RATE
from probcal.inference.fitted import Judged
from probcal.labels import coordinates
from probcal.linalg import eigenvalues, spectrum
from probcal.results.schema import matrix_of
from probcal.simulate import Truth

EXACT = 1e-9  # sd over the size of the scene, or the scale of a bias, below which a position or bias is known


class Nees(NamedTuple):
    """Squared errors over what the posterior expects: of each epoch known (E,), and of all with its limits."""

    value: np.ndarray  # (E,) a dimension
    known: np.ndarray  # (E,) boolean, epochs that the truth covers
    mean: float
    lower: float
    upper: float


def of_positions(target: str, track: xr.Dataset, states: np.ndarray, truth: Truth) -> Nees | None:
    """NEES of the positions of one target, a dimension, from draws of its states (D, E, n); None without a truth.

    Errors of neighbouring epochs are alike: the limits of the mean are those of the posterior's own draws.
    """
    names, times = track["component"].values.tolist(), track["time"].values
    axes = coordinates(names)
    if truth.tracks is None:
        return None
    true = truth.positions(times, np.full(len(times), target), len(axes))
    known = np.isfinite(true).all(1)
    draws = states[:, known][:, :, [names.index(axis) for axis in axes]]  # (S, E, d)
    if not known.any() or len(draws) < 10 * len(axes):
        return None
    deviation = draws - draws.mean(0)
    covariance = np.einsum("sei,sej->eij", deviation, deviation) / (len(draws) - 1)
    free = eigenvalues(covariance)[:, 0] > (EXACT * (1.0 + np.abs(true[known]).max())) ** 2
    if not free.any():
        return None
    known[known] = free
    draws, deviation, covariance = draws[:, free], deviation[:, free], covariance[free]
    whiten = linalg.invert(linalg.cholesky(covariance))
    error = track["mean"].sel(component=axes).values[known] - true[known]
    value = (np.einsum("eij,ej->ei", whiten, error) ** 2).mean(1)
    own = (np.einsum("eij,sej->sei", whiten, deviation) ** 2).mean((1, 2))
    lower, upper = np.quantile(own, [RATE / 2, 1 - RATE / 2])
    return Nees(value, known, float(value.mean()), float(lower), float(upper))


def of_biases(tree: xr.DataTree, truth: Truth) -> tuple[float, int, float, float] | None:
    """NEES of all biases that the truth knows, the rank of their covariance and limits; None where it knows none.

    A bias without spread, as in the spike of a prior, adds nothing where it is true and makes the NEES infinite
    where it is not. Of others that depend on each other the combinations that have a spread are judged.
    """
    group = tree["calibration"].to_dataset()
    labels = [label for label in group["bias_label"].values.tolist() if label in truth.biases]
    if not labels:
        return None
    matrix_of(group, "covariance", "nees")
    chosen = group.sel(bias_label=labels, bias_label_other=labels)
    error = (chosen["mean"].values - np.array([truth.biases[label] for label in labels])) / chosen["scale"].values
    covariance = chosen["covariance"].values / np.outer(chosen["scale"].values, chosen["scale"].values)
    sd = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    free = sd > EXACT
    variance, vectors = spectrum(covariance[np.ix_(free, free)] / np.outer(sd[free], sd[free]))
    spread = variance > len(variance) * np.finfo(float).eps * variance.max(initial=1.0)
    along = ((error[free] / sd[free]) @ vectors)[spread]
    value = np.inf if (np.abs(error[~free]) > EXACT).any() else float(np.sum(along**2 / variance[spread]))
    return _judged(value, int(spread.sum()))


def of_all_biases(fit: Judged, truth: Truth) -> tuple[float, int, float, float] | None:
    """The same where the covariance of all is not held, by their precision; None where the truth lacks one."""
    if not set(fit.problem.labels) <= set(truth.biases):
        return None
    known = np.array([truth.biases[label] for label in fit.problem.labels]) / fit.problem.scales
    error = np.asarray(fit.point.z) - known
    told = np.asarray(fit.expansion.apply(error)) + fit.factors.pull(known) - fit.factors.pull(known + error)
    return _judged(float(error @ told), len(error))


def _judged(value: float, rank: int) -> tuple[float, int, float, float]:
    lower, upper = special.chdtri(rank, [1 - RATE / 2, RATE / 2]) if rank else (0.0, 0.0)
    return value, rank, float(lower), float(upper)
