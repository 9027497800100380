"""Is the motion right? Tails and whiteness of the smoothed process noises, against those of the model itself.

A target that goes straight and then turns has few large noises, one that keeps turning has noises that go together.
Smoothing shrinks noises and mixes neighbours, so both are compared with what the smoother makes of data that the
linearised model draws: neither depends on the level of the noise.
"""

from typing import Any

import numpy as np

from probcal.analysis.check import Case, Checked, check
from probcal.analysis.findings import Finding
from probcal.gaussian.draws import simulated
from probcal.inference.residuals import LAGS
from probcal.motion.base import GAUSSIAN, Component, level_name
from probcal.noise import Normal, guess_of

REPLICAS, MOST = 200, 2e7  # drawn, and entries of all of them together
FEWEST = 30  # epochs, and replicas, below which nothing is said
LIMIT = 4.5  # sd of the replicas
HEAVIER, TOGETHER = 1.3, 0.2  # times the kurtosis, and correlation, from which it matters
HELD = 0.05  # sd of a smoothed noise, 1 before the data, below which these say nothing of it


@check("explained", "factor")
def check_process(case: Case) -> Checked:
    """Findings on the process noises of every target whose motion declares Gaussian ones."""
    problem, found = case.fit.problem, list[Finding]()
    count = int(min(REPLICAS, MOST / max(sum(part.drift.size for part in problem.model.recursions), 1)))
    if count < FEWEST:
        return Checked()
    still = [np.zeros((*part.drift.shape, count)) for part in problem.model.recursions]
    drawn = [noises for _, noises in simulated(case.fit.expansion, still, case.keys[2])]
    for name, _, part, smoothed, columns in problem.tracks(problem.model.recursions, case.fit.point.noises, drawn):
        mine, active = ~part.first, part.L.any(1)
        for component, own in problem.noise_columns(name):
            gaussian = isinstance(getattr(component, "noise", GAUSSIAN), Normal)
            if not gaussian or guess_of(component.std) == 0 or mine.sum() < FEWEST:
                continue
            sd = columns[mine, own].std(2)
            told = active[mine, own] & (sd > HELD)  # what the data say something of, no start
            if told.any(1).sum() < FEWEST:
                continue
            scale = np.where(told, 1.0 / np.where(told, sd, 1.0), 0.0)
            if text := _unlike(component, smoothed[mine, own] * scale, columns[mine, own] * scale[:, :, None]):
                drives = level_name(component).removesuffix("_std")
                found.append(Finding("motion", name, f'target "{name}": the noise of its {drives} {text}'))
    return Checked(findings=found)


def _unlike(component: Any, noises: np.ndarray, replicas: np.ndarray) -> str:
    """The difference between noises (epochs, entries) and their replicas (epochs, entries, D).

    Both are over the sd of the replicas; the text says what to declare.
    """
    heavy, expected, away = _compared(_kurtosis(noises), _kurtosis(replicas))
    if away > LIMIT and heavy > HEAVIER * expected:
        declared = f"{type(component).__name__}(..., noise=StudentT(4))"
        return f"has heavy tails (kurtosis {heavy:.1f}, {expected:.1f} expected): declare {declared}"
    lags = range(1, min(LAGS, len(noises) // 3) + 1)
    tried = [(lag, *_compared(_correlation(noises, lag), _correlation(replicas, lag))) for lag in lags]
    lag, value, usual, far = max(tried, key=lambda one: one[3])
    if far > LIMIT and value - usual > TOGETHER:
        order = getattr(component, "next_order", Component.next_order)
        return f"is correlated in time ({value:.2f} at lag {lag}, {usual:.2f} expected): declare {order}"
    return ""


def _kurtosis(noises: np.ndarray) -> np.ndarray:
    """Mean fourth power over the squared mean square, of (epochs, entries, ...)."""
    there = np.maximum((noises != 0).sum((0, 1)), 1)
    return (noises**4).sum((0, 1)) / there / np.maximum((noises**2).sum((0, 1)) / there, 1e-300) ** 2


def _correlation(noises: np.ndarray, lag: int) -> np.ndarray:
    """Correlation of noises (epochs, entries, ...) some epochs apart."""
    return (noises[lag:] * noises[:-lag]).sum((0, 1)) / np.maximum((noises**2).sum((0, 1)), 1e-300)


def _compared(value: np.ndarray, replicas: np.ndarray) -> tuple[float, float, float]:
    """A statistic, its mean over replicas (D,), and how many of their sd it lies away."""
    mean, sd = float(replicas.mean()), float(replicas.std())
    return float(value), mean, (float(value) - mean) / max(sd, 1e-9)
