"""Whether chains have mixed: rank-normalised r_hat, effective draws, and the weights of the sides of a mirror."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from probcal.lazy import Later

if TYPE_CHECKING:
    from arviz_stats.base import array_stats
else:
    array_stats = Later("arviz_stats.base.array_stats")

R_HAT = 1.01  # above which chains have not mixed
ESS = 100  # effective draws a chain below which its quantiles are not to be trusted
UNSURE = 0.1  # standard error of the weight of a side above which it is not known

FEW = 0.25  # share of few draws that must be effective
NOISE = 4.0  # over the draws of a chain: by how much r_hat is above 1 without a reason


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
    """Whether some, but not all, draws lie beyond each of the quantiles that a tail ess looks at."""
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


def settled(draws: np.ndarray, side: np.ndarray, count: int) -> bool:
    """Whether draws (chain, draw, P) on these sides (chain, draw) have mixed as well as so many can show."""
    found, (chains, number) = mixing(within_sides(draws, side)), draws.shape[:2]
    enough = found["ess"].min() >= min(ESS, FEW * number) * chains
    alike = "r_hat" not in found or found["r_hat"].max() <= max(R_HAT, 1 + NOISE / number)
    return bool(enough and alike and weights_of_sides(side, count)[1].max() <= UNSURE)
