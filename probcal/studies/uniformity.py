"""Are ranks uniform? Randomised ranks, simultaneous bands of their distribution, coverage of intervals.

Posterior draws and the truth that made the data are exchangeable if the method is right: the rank of the truth among L
draws is uniform on 0..L (Cook, Gelman, Rubin 2006; Talts et al. 2018). Ties are broken at random, so that an atom, such
as a bias that is exactly zero, leaves the randomised rank (rank + u) / (L + 1) exactly uniform on (0, 1).
"""

from functools import lru_cache

import numpy as np
from scipy import special

NOMINAL = (0.5, 0.8, 0.89, 0.9, 0.95)
POINTS = 100  # at most so many points of a distribution function are looked at
TIE = 1e-9  # relative difference below which a draw counts as equal to the truth


def randomised_rank(truth: float, draws: np.ndarray, rng: np.random.Generator) -> tuple[int, float]:
    """Rank of the truth among draws (L,), ties broken at random, and its place in (0, 1)."""
    same = np.abs(draws - truth) <= TIE * abs(truth)
    below = int(((draws < truth) & ~same).sum())
    rank = below + int(rng.integers(0, int(same.sum()) + 1))
    return rank, (rank + rng.uniform()) / (len(draws) + 1)


@lru_cache(maxsize=16)
def _table(runs: int, points: int) -> np.ndarray:
    """Two-sided probability of every count 0..runs of values below k / points, (points - 1, runs + 1)."""
    z = np.arange(1, points)[:, None] / points
    count = np.arange(runs + 1)[None, :]
    above = np.concatenate([np.ones((points - 1, 1)), special.bdtrc(count[:, :-1], runs, z)], 1)
    return np.minimum(1.0, 2.0 * np.minimum(special.bdtr(count, runs, z), above))


def _poisson(count: np.ndarray, rate: float) -> np.ndarray:
    """Probability of a count."""
    return np.exp(special.xlogy(count, rate) - special.gammaln(count + 1.0) - rate)


def _escape(runs: int, points: int, level: float) -> float:
    """Probability that a uniform sample's counts leave the band of pointwise probability `level` somewhere.

    The count as k grows is a Poisson walk held to `runs` at the end, so that its paths are summed exactly.
    """
    inside = _table(runs, points) > level
    steps = _poisson(np.arange(runs + 1), runs / points)
    steps = steps[: int(np.flatnonzero(steps > 1e-300)[-1]) + 1]
    walk = np.zeros(runs + 1)
    walk[0] = 1.0
    for k in range(points - 1):
        walk = np.convolve(walk, steps)[: runs + 1] * inside[k]
    last = float(np.convolve(walk, steps)[runs])
    return float(np.clip(1.0 - last / _poisson(np.array(runs), runs), 0.0, 1.0))


def p_value(places: np.ndarray) -> float:
    """Probability of so uneven a sample (R,) if it is uniform: simultaneous band (Sailynoja, Burkner, Vehtari 2022)."""
    runs, points = len(places), min(len(places), POINTS)
    counts = np.searchsorted(np.sort(places), np.arange(1, points) / points, side="right")
    least = _table(runs, points)[np.arange(points - 1), counts].min(initial=1.0)
    return _escape(runs, points, least * (1 + 1e-9))


@lru_cache(maxsize=16)
def band(runs: int, alarm: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places, lower and upper share of a simultaneous band that a uniform sample leaves with probability `alarm`."""
    points = min(runs, POINTS)
    low, high = 1e-12, alarm
    for _ in range(40):
        middle = np.sqrt(low * high)
        low, high = (middle, high) if _escape(runs, points, middle) <= alarm else (low, middle)
    inside = _table(runs, points) > low
    lower, upper = inside.argmax(1), runs - inside[:, ::-1].argmax(1)
    places = np.arange(points + 1) / points
    return places, np.r_[0, lower, runs] / runs, np.r_[0, upper, runs] / runs


def spread_p_value(places: np.ndarray) -> float:
    """Probability of so wide or narrow a spread of places (R, Q), all quantities together, by a t test over runs.

    The mean of |place - 1/2| of a run is 1/4 if all its quantities are uniform, however they depend on each other.
    """
    found = np.abs(places - 0.5).mean(1) - 0.25
    error = found.std(ddof=1) / np.sqrt(len(found))
    return float(2 * special.stdtr(len(found) - 1, -abs(found.mean()) / max(error, 1e-12)))


def shape(places: np.ndarray) -> str:
    """Describes the fault of a posterior whose places (R, ...) are uneven, in words."""
    runs = len(places)
    centre = (places.mean() - 0.5) * np.sqrt(12 * runs)
    spread = (np.abs(places - 0.5).mean() - 0.25) * np.sqrt(48 * runs)
    if abs(centre) > abs(spread):
        return "the posterior lies too low" if centre > 0 else "the posterior lies too high"
    return "the posterior is too narrow" if spread > 0 else "the posterior is too wide"


def share(inside: np.ndarray, counted: np.ndarray, nominal: float) -> tuple[float, float]:
    """Share of what is inside (R, Q) among what is counted (R, Q), and its standard error by runs.

    Biases of one run depend on each other: the error is that of a ratio over runs, and not less than independent
    biases at the nominal share would have.
    """
    total, runs = counted.sum(), len(inside)
    found = (inside & counted).sum() / total
    rest = ((inside - found) * counted).sum(1)
    by_runs = np.sqrt((rest**2).sum() * runs / max(runs - 1, 1)) / total
    return float(found), float(max(by_runs, np.sqrt(nominal * (1 - nominal) / total)))
