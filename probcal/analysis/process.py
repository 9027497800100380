"""Is the motion right? Tails and whiteness of the smoothed process noises, against those of the model itself.

A target that goes straight and then turns has few large noises, one that keeps turning has noises that go together.
Smoothing shrinks noises and mixes neighbours, so both are compared with what the smoother makes of data that the
linearised model draws: neither depends on the level of the noise.
"""

from collections.abc import Iterator
from typing import NamedTuple

import jax
import numpy as np

from probcal.analysis.findings import Finding
from probcal.gaussian.draws import simulated
from probcal.inference.fitted import Judged
from probcal.motion.base import GAUSSIAN, Component, level_name
from probcal.noise import Normal, guess_of

REPLICAS, MOST = 200, 2e7  # drawn, and entries of all of them together
FEWEST = 30  # epochs, and replicas, below which nothing is said
LAGS = 10
LIMIT = 4.5  # sd of the replicas
HEAVIER, TOGETHER = 1.3, 0.2  # times the kurtosis, and correlation, from which it matters
HELD = 0.05  # sd of a smoothed noise, 1 before the data, below which these say nothing of it


class Driven(NamedTuple):
    """The noises of one component of one target."""

    name: str  # of the target
    component: str  # what they drive
    family: str  # its class, for the remedy
    next_order: str  # what to declare instead where the noise has a memory
    noises: np.ndarray  # (epochs, entries) over the sd of the replicas
    replicas: np.ndarray  # (epochs, entries, D) likewise


def check_process_noise(fit: Judged, key: jax.Array) -> list[Finding]:
    """Findings on the process noises of every target whose motion declares Gaussian ones."""
    size = max(sum(part.drift.size for part in fit.problem.model.recursions), 1)
    count = int(min(REPLICAS, MOST / size))
    found = []
    for own in _driven(fit, key, count) if count >= FEWEST else ():
        heavy, expected, away = _compared(_kurtosis(own.noises), _kurtosis(own.replicas))
        where = f'target "{own.name}": the noise of its {own.component}'
        if away > LIMIT and heavy > HEAVIER * expected:
            text = (
                f"{where} has heavy tails (kurtosis {heavy:.1f}, {expected:.1f} expected): declare"
                f" {own.family}(..., noise=StudentT(4))"
            )
            found.append(Finding("motion", own.name, text))
            continue
        lags = range(1, min(LAGS, len(own.noises) // 3) + 1)
        tried = [(lag, *_compared(_correlation(own.noises, lag), _correlation(own.replicas, lag))) for lag in lags]
        lag, value, usual, far = max(tried, key=lambda one: one[3])
        if far > LIMIT and value - usual > TOGETHER:
            text = (
                f"{where} is correlated in time ({value:.2f} at lag {lag}, {usual:.2f} expected): declare"
                f" {own.next_order}"
            )
            found.append(Finding("motion", own.name, text))
    return found


def _driven(fit: Judged, key: jax.Array, count: int) -> Iterator[Driven]:
    """The noises that the data say something of, those of a start left out."""
    problem = fit.problem
    still = [np.zeros((*part.drift.shape, count)) for part in problem.model.recursions]
    drawn = [smooth.noises for _, smooth in simulated(fit.expansion, still, key)]
    for name, _, part, smoothed, columns in problem.tracks(problem.model.recursions, fit.point.noises, drawn):
        mine, active = ~part.first, part.L.any(1)
        for component, own in problem.noise_columns(name):
            gaussian = isinstance(getattr(component, "noise", GAUSSIAN), Normal)
            if not gaussian or guess_of(component.std) == 0 or mine.sum() < FEWEST:
                continue
            sd = columns[mine, own].std(2)
            told = active[mine, own] & (sd > HELD)
            if told.any(1).sum() < FEWEST:
                continue
            scale = np.where(told, 1.0 / np.where(told, sd, 1.0), 0.0)
            drives = level_name(component).removesuffix("_std")
            own_noises = smoothed[mine, own] * scale, columns[mine, own] * scale[:, :, None]
            order = getattr(component, "next_order", Component.next_order)
            yield Driven(name, drives, type(component).__name__, order, *own_noises)


def _kurtosis(noises: np.ndarray) -> np.ndarray:
    """Mean fourth power over the squared mean square, of (epochs, entries, ...)."""
    there = np.maximum((noises != 0).sum((0, 1)), 1)
    value: np.ndarray = (noises**4).sum((0, 1)) / there / np.maximum((noises**2).sum((0, 1)) / there, 1e-300) ** 2
    return value


def _correlation(noises: np.ndarray, lag: int) -> np.ndarray:
    """Correlation of noises (epochs, entries, ...) some epochs apart."""
    value: np.ndarray = (noises[lag:] * noises[:-lag]).sum((0, 1)) / np.maximum((noises**2).sum((0, 1)), 1e-300)
    return value


def _compared(value: np.ndarray, replicas: np.ndarray) -> tuple[float, float, float]:
    """A statistic, its mean over replicas (D,), and how many of their sd it lies away."""
    mean, sd = float(replicas.mean()), float(replicas.std())
    return float(value), mean, (float(value) - mean) / max(sd, 1e-9)
