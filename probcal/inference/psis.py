"""Pareto smoothed importance sampling of many rows at once (Vehtari, Simpson, Gelman, Yao and Gabry 2024).

What `arviz_stats` does row after row, a millisecond each, is done for all rows in arrays: the same numbers.
"""

import numpy as np

ROWS = 2000  # smoothed at once
PRIOR_DRAWS, PRIOR_K = 10, 0.5  # weight and place of the weak prior of the shape


def smoothed(log_ratios: np.ndarray, efficiency: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Normalised smoothed log weights (rows, draws) and Pareto k (rows,) of log importance ratios (rows, draws).

    `efficiency` is the number of effective draws over that of all.
    k is infinite where the tail is no generalised Pareto distribution; rows whose ratios are all the same have k 0.
    """
    parts = [_smoothed(log_ratios[start : start + ROWS], efficiency) for start in range(0, len(log_ratios), ROWS)]
    return np.concatenate([weights for weights, _ in parts]), np.concatenate([k for _, k in parts])


def _smoothed(log_ratios: np.ndarray, efficiency: float) -> tuple[np.ndarray, np.ndarray]:
    rows, draws = log_ratios.shape
    values = log_ratios - log_ratios.max(1, keepdims=True)
    tail = min(int(3 * (draws / efficiency) ** 0.5 if draws * efficiency > 225 else draws / 5), draws - 1)
    if tail < 5:
        return values - _log_sum(values), np.full(rows, np.inf)
    order = np.argsort(values, axis=1)[:, draws - tail - 1 :]
    last = np.take_along_axis(values, order, 1)
    k, sigma = _pareto_fit(np.exp(last[:, 1:]) - np.exp(last[:, :1]))
    same = last[:, -1] - last[:, 1] < np.finfo(float).tiny
    good = np.isfinite(k) & (sigma > 0) & ~same
    probability = (np.arange(0.5, tail) / tail)[None]
    shape, scale = np.where(good, k, 1.0)[:, None], np.where(good, sigma, 1.0)[:, None]
    # in logarithms: quantiles of a very heavy tail overflow before they are cut to the largest
    # ratio
    flat = np.where(shape == 0, 1.0, shape)
    power = -flat * np.log1p(-probability)
    curved = np.maximum(power, 0.0) + np.log(-np.expm1(-np.abs(power))) - np.log(np.abs(flat))
    curve = np.log(scale) + np.where(shape == 0, np.log(-np.log1p(-probability)), curved)
    fitted = np.minimum(np.logaddexp(last[:, :1], curve), last[:, -1:])
    np.put_along_axis(values, order[:, 1:], np.where(good[:, None], fitted, last[:, 1:]), 1)
    values -= _log_sum(values)
    return values, np.where(same, 0.0, np.where(np.isfinite(k), k, np.inf))


def _pareto_fit(excess: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Shape and scale (rows,) of a generalised Pareto distribution from sorted excesses (rows, tail).

    The empirical Bayes estimate of Zhang and Stephens (2009); NaN where the first quartile is the minimum.
    """
    rows, tail = excess.shape
    count = 30 + int(tail**0.5)
    quartile = excess[:, int((tail / 4 + 0.5) - 1)]
    told = quartile > excess[:, 0]
    grid = 1 - np.sqrt(count / (np.arange(1, count + 1) - 0.5))
    k, sigma = np.full(rows, np.nan), np.full(rows, np.nan)
    x = excess[told]
    with np.errstate(all="ignore"):  # what is not finite is told by its k
        b = grid[None] / (3 * quartile[told][:, None]) + 1 / x[:, -1:]
        means = np.stack([np.log1p(-b[:, j, None] * x).mean(1) for j in range(count)], 1)
        score = tail * (np.log(-b / means) - means - 1)
        weights = np.exp(score - _log_sum(score))
        weights = np.where(weights >= 10 * np.finfo(float).eps, weights, 0.0)
        weights /= weights.sum(1, keepdims=True)
        place = (b * weights).sum(1)
        shape = np.log1p(-place[:, None] * x).mean(1)
        sigma[told] = -shape / place
        k[told] = (tail * shape + PRIOR_DRAWS * PRIOR_K) / (tail + PRIOR_DRAWS)
    return k, sigma


def _log_sum(values: np.ndarray) -> np.ndarray:
    """Log of the summed exponentials of every row, (rows, 1)."""
    most = values.max(1, keepdims=True)
    return most + np.log(np.exp(values - most).sum(1, keepdims=True))
