"""Power scaling: how prior and likelihood move each posterior (Kallioinen et al. 2024).

The numbers of `arviz_stats.psense`, in arrays for all biases, without the seconds that ArviZ takes
to load.
"""

from __future__ import annotations

import numpy as np
import xarray as xr

from probcal.analysis.check import Case, Checked, check
from probcal.analysis.leave import weighable
from probcal.inference.psis import smoothed
from probcal.results.read import summed_log_likelihood


@check()
def check_scaling(case: Case) -> Checked:
    """Sensitivity (bias_label) of each bias to prior and likelihood, where the tree holds both.

    Empty where the draws' densities have no tail to weigh by: those of an answer far from Gaussian, whose worst
    draws lie so deep that all others are alike.
    `noise` is the largest sensitivity found after the draws of the densities were shuffled against those of the
    biases: with the log-likelihood of thousands of data it may exceed ArviZ's threshold of 0.05, and what stays
    below it tells nothing.
    """
    tree, summed = case.tree, summed_log_likelihood(case.tree)
    if summed is None or "log_prior" not in tree.children or not weighable(tree):
        return Checked()
    draws = tree["posterior"].to_dataset()["bias"].sel(draw=summed["draw"])  # of large data some of the draws only
    density = tree["log_prior"].to_dataset()["bias"].sel(draw=summed["draw"]).sum("bias_label")
    densities = {"prior": density.values.ravel(), "likelihood": summed.values.ravel()}
    order = np.random.default_rng(0).permutation(summed.size)
    biases = draws.values.reshape(summed.size, -1)
    found, chance = (
        {way: _distance(biases, values[rows]) for way, values in densities.items()} for rows in (slice(None), order)
    )
    finite = np.isfinite(found["prior"]) & np.isfinite(found["likelihood"])
    noise = max(float(np.nanmax(c, initial=0.0)) for c in chance.values())
    group = xr.Dataset(
        {way: ("bias_label", value[finite]) for way, value in found.items()},
        coords={"bias_label": draws["bias_label"].values[finite]},
    )
    group.attrs |= {"noise": noise, "threshold": max(0.05, noise)}
    return Checked({"sensitivity": group})


def _distance(draws: np.ndarray, log_density: np.ndarray) -> np.ndarray:
    """Sensitivity (M,) of draws (draw, M) to powers of a density (draw,): distance a doubling.

    Distances are those of the draws as they are and as weighted by the power, the larger one of either direction.
    """
    powers = np.array([0.99, 1.01])
    weights = np.exp(smoothed((powers - 1)[:, None] * log_density)[0])
    far = [np.maximum(_apart(draws, own), _apart(-draws, own)) for own in weights]
    return np.mean(np.stack(far) / np.abs(np.log2(powers))[:, None], 0)


def _apart(draws: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Cumulative Jensen-Shannon distances (M,) of draws (draw, M) from the same with weights (draw,)."""
    order = np.argsort(draws, axis=0)
    width = np.diff(np.take_along_axis(draws, order, 0), axis=0)
    even = np.linspace(1 / len(draws), 1 - 1 / len(draws), len(draws) - 1)[:, None]
    weighted = np.cumsum(weights[order], 0)[:-1]
    apart = ((weighted - even) * width).sum(0) / (2 * np.log(2))
    one, other = (
        np.maximum((width * p * np.log2(2 * p / (even + weighted))).sum(0) + sign * apart, 0.0)
        for p, sign in ((even, 1), (np.maximum(weighted, np.finfo(float).tiny), -1))
    )
    bound = ((even + weighted) * width).sum(0)
    return np.sqrt(np.divide(one + other, bound, out=np.full(len(bound), np.nan), where=bound > 0))
