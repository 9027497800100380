"""The predictive accuracy of fits of the same data: elpd by PSIS-LOO per datum, and the paired
difference to the best.

Vehtari, Gelman and Gabry 2017; they are what `arviz.loo` and `arviz.compare` give.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from probcal.analysis.leave import good_k, psis, standard_error, tailed
from probcal.errors import InputError
from probcal.lazy import Later

if TYPE_CHECKING:
    import arviz_stats
else:
    arviz_stats = Later("arviz_stats")

BAD = 0.01  # share of bad Pareto k from which an elpd is uncertain


def same_data(fits: Mapping[str, xr.DataTree]) -> dict[str, np.ndarray]:
    """The order in which the data of each fit are those of all, by row and channel; sensor models may order them anew.

    Raises `InputError` naming two fits where the data differ.
    """
    orders, kept = dict[str, np.ndarray](), dict[str, tuple[np.ndarray, ...]]()
    for name, tree in fits.items():
        data = tree["observed_data"].to_dataset()
        row, channel = data["row"].values, data["channel"].values.astype(str)
        orders[name] = np.lexsort((channel, row))
        kept[name] = tuple(values[orders[name]] for values in (row, channel, data["y"].values))
    (first, wanted), *others = kept.items()
    for name, found in others:
        if not all(np.array_equal(a, b) for a, b in zip(wanted, found, strict=True)):
            raise InputError(f'compare: "{first}" and "{name}" are fits of different data; fit them to one table')
    return orders


def elpd(fits: Mapping[str, xr.DataTree], orders: Mapping[str, np.ndarray]) -> dict[str, dict[str, Any]]:
    """By fit with a log-likelihood: elpd, its error, p_loo, share of bad Pareto k, and difference to the best.

    The best is one whose elpd is certain, if there is any.
    """
    found, pointwise = dict[str, dict[str, Any]](), dict[str, np.ndarray]()
    for name, tree in fits.items():
        if not tailed(tree):
            continue
        data = len(orders[name])
        own = psis(tree, np.arange(data), data, _efficiency(tree["posterior"].to_dataset()["bias"]))
        if not np.isfinite(own.elpd).all():
            continue
        pointwise[name], good = own.elpd[orders[name]], good_k(tree)
        found[name] = {
            "elpd": float(own.elpd.sum()), "elpd_se": standard_error(own.elpd),
            "p_loo": float((own.within - own.elpd).sum()), "bad_k": float(np.mean(~(own.pareto_k <= good))),
            "good_k": good,
        }  # fmt: skip
    if len(found) > 1:
        best = max(found, key=lambda name: (found[name]["bad_k"] <= BAD, found[name]["elpd"]))
        for name, values in found.items():
            apart = pointwise[name] - pointwise[best]
            values |= {
                "elpd_difference": float(apart.sum()),
                "elpd_difference_se": float(np.std(apart) * len(apart) ** 0.5),
            }
    return found


def _efficiency(draws: xr.DataArray) -> float:
    """Effective draws of the biases over all draws; a bias whose draws are all equal tells nothing of it."""
    varying = draws.isel(bias_label=(draws.std(("chain", "draw")) > 0).values)
    if draws.sizes["chain"] == 1 or not varying.sizes["bias_label"]:
        return 1.0
    ess = arviz_stats.ess(varying.to_dataset(), method="mean")["bias"].values
    return float(ess.mean()) / (draws.sizes["chain"] * draws.sizes["draw"])
