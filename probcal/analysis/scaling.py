"""Power scaling: how prior and likelihood move the posterior of every bias (Kallioinen et al. 2024), by ArviZ."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from probcal.analysis.check import Case, Checked, check
from probcal.analysis.leave import weighable
from probcal.lazy import Later
from probcal.results.read import summed_log_likelihood

if TYPE_CHECKING:
    import arviz_stats
else:
    arviz_stats = Later("arviz_stats")

THRESHOLD = 0.05  # of the distance a power, ArviZ's own


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
    by_datum = summed["draw"]  # of large data some of the draws only
    kept = {name: tree[name].to_dataset()[["bias"]].sel(draw=by_datum) for name in ("posterior", "log_prior")}
    kept["log_likelihood"] = xr.Dataset({"y": summed.expand_dims(datum=1, axis=-1)})
    shuffled = dict(kept)
    order = np.random.default_rng(0).permutation(summed.size)
    for name in ("log_prior", "log_likelihood"):
        values = kept[name]
        var = "bias" if name == "log_prior" else "y"
        flat = values[var].values.reshape(len(order), -1)[order]
        shuffled[name] = values.assign({var: (values[var].dims, flat.reshape(values[var].shape))})
    try:
        found, chance = (
            {way: _distance(groups, way) for way in ("prior", "likelihood")} for groups in (kept, shuffled)
        )
    except ValueError:
        return Checked()
    finite = np.isfinite(found["prior"]) & np.isfinite(found["likelihood"])
    noise = max(float(np.nanmax(c, initial=0.0)) for c in chance.values())
    labels = kept["posterior"]["bias_label"].values
    group = xr.Dataset(
        {way: ("bias_label", value[finite]) for way, value in found.items()}, coords={"bias_label": labels[finite]}
    )
    group.attrs |= {"noise": noise, "threshold": max(THRESHOLD, noise)}
    return Checked({"sensitivity": group})


def _distance(groups: dict[str, xr.Dataset], way: str) -> np.ndarray:
    """Sensitivity (M,) of every bias to the prior or the likelihood."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return arviz_stats.psense(xr.DataTree.from_dict(groups), var_names=["bias"], group=way)["bias"].values
