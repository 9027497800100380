"""Mixing of chains: rank-normalised r_hat, effective draws, and the weights of the modes of a mirror."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from probcal.inference.chains import Draw
from probcal.lazy import Later

if TYPE_CHECKING:
    from arviz_stats.base import array_stats
    from scipy import stats
else:
    array_stats, stats = Later("arviz_stats.base.array_stats"), Later("scipy.stats")

R_HAT = 1.01  # above which chains have not mixed
ESS = 100  # effective draws a chain below which its quantiles are not to be trusted
UNSURE = 0.1  # standard error of the weight of a side above which it is not known

FEW = 0.25  # share of few draws that must be effective


def mixing(draws: np.ndarray) -> dict[str, np.ndarray]:
    """Rank-normalised r_hat, bulk and tail ess of draws (chain, draw, P), each (P,).

    A quantity that is the same in every draw counts as mixed: r_hat 1, as many effective draws as there are.
    """
    still = np.ptp(draws, axis=(0, 1)) == 0
    names = ["ess", "ess_tail", *(["r_hat"] if draws.shape[0] > 1 else [])]
    whole = {"ess": float(draws[..., 0].size), "ess_tail": float(draws[..., 0].size), "r_hat": 1.0}
    found = {name: np.full(draws.shape[2], whole[name]) for name in names}
    for m in np.flatnonzero(~still):
        found["ess"][m] = array_stats.ess(draws[..., m], method="bulk")
        # in the tails of a spike every draw may be the same: there the bulk is all there is
        tail = (
            array_stats.ess(draws[..., m], method="tail", prob=(0.05, 0.95)) if _both_tails(draws[..., m]) else np.nan
        )
        found["ess_tail"][m] = tail if np.isfinite(tail) else found["ess"][m]
        if "r_hat" in found:
            moves = draws.shape[1] < 4 or np.ptp(draws[..., m], axis=1).any()  # else each chain stands still
            found["r_hat"][m] = array_stats.rhat(draws[..., m]) if moves else np.inf
    return {name: np.nan_to_num(values, nan=whole[name], posinf=np.inf) for name, values in found.items()}


def _both_tails(draws: np.ndarray) -> bool:
    """True if some, but not all, draws lie beyond each of the quantiles that a tail ess looks at."""
    return all(0 < (draws <= q).mean() < 1 for q in np.quantile(draws, (0.05, 0.95)))


def within_sides(draws: np.ndarray, side: np.ndarray) -> np.ndarray:
    """Draws (chain, draw, P) less the mean of their side of a mirror (chain, draw): what must mix on each."""
    found = np.array(draws)
    for k in np.unique(side):
        found[side == k] -= draws[side == k].mean(0)
    return found


def weights_of_sides(side: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Weight (count,) of each side of a mirror by the draws (chain, draw) on it, and its standard error by chains."""
    shares = [np.bincount(own, minlength=count) / len(own) for own in side]
    return np.mean(shares, 0), np.std(shares, 0) / np.sqrt(max(len(shares) - 1, 1))


class Effective(NamedTuple):
    """Effective draws of the quantity that has fewest, and whether they and r_hat are as asked."""

    least: float
    settled: bool


def effective_draws(draws: Draw, count: int, wanted: int = 0) -> Effective:
    """True if draws on so many sides of a mirror have mixed as well as so many can show.

    Of biases and levels; where so many effective draws are `wanted`, of hyper-parameters too.
    """
    theta, side = np.asarray(draws.theta), side_of_draws(draws)
    names = [f"{k}" for k in range(theta.shape[2])]
    found = mixing(within_sides(quantities(draws, names, hyper=wanted > 0)[1], side))
    chains, number = theta.shape[:2]
    enough = found["ess"].min() >= (wanted or min(ESS, FEW * number) * chains)
    alike = "r_hat" not in found or np.all(found["r_hat"] <= r_hat_limit(found["ess"], chains))
    weighed = weights_of_sides(side, count)[1].max() <= UNSURE
    return Effective(float(found["ess"].min()), bool(enough and alike and weighed))


def quantities(draws: Draw, names: Sequence[str], *, hyper: bool) -> tuple[list[str], np.ndarray]:
    """Names, and values (chain, draw, P), of biases and levels, and logarithms of hyper-parameters."""
    theta = np.asarray(draws.theta)
    labels, values = list(names), [theta]
    for name, own in draws.phi.items() if hyper else ():
        flat = np.asarray(own).reshape(*theta.shape[:2], -1)
        if flat.dtype != bool:
            labels += [name] if flat.shape[2] == 1 else [f"{name} {k}" for k in range(flat.shape[2])]
            values.append(np.log(flat) if np.all(flat > 0) else flat)
    return labels, np.concatenate(values, 2)


def side_of_draws(draws: Draw) -> np.ndarray:
    """The index of the mode of each draw (chain, draw), 0 where there is no reflection."""
    return np.asarray(draws.stats.get("side", np.zeros(np.shape(draws.theta)[:2], int)))


def r_hat_limit(ess: np.ndarray, chains: int) -> np.ndarray:
    """The r_hat (P,) above which chains have not mixed: 1.01, or if larger what chance exceeds in
    1 % of the runs of so many quantities, of so many effective draws (P,).

    Halves of `chains` have means whose variance over its expectation is chi-square over its degrees
    of freedom.
    """
    free = 2 * chains - 1
    chance = stats.chi2.ppf(0.99 ** (1.0 / len(ess)), free) / free
    return np.maximum(R_HAT, np.sqrt(1.0 + (chance - 1.0) * 2 * chains / np.maximum(ess, 1.0)))
