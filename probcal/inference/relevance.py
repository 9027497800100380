"""Precisions of largest evidence on a Gaussian likelihood: exact single updates, and whole groups out or in together.

With s and q the information and the score of one bias, the others at their precisions, the evidence as a function of
its precision alone has one maximum: s^2 / (q^2 - s) where q^2 > s, else infinite (Tipping, Faul 2003). Such a climb
stops where no single change helps; biases that explain the same data can keep each other in, so that groups of them
are taken out, and put back, together.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from probcal.linalg import invert, log_determinant
from probcal.priors import PRECISION_BOUNDS

SWEEPS, STILL = 200, 1e-6  # of single updates at most, and nats by which the last may have gained


@dataclass
class Relevance:
    """Precisions alpha (M,) and the Gaussian posterior that they leave; those at the upper bound are out."""

    information: np.ndarray  # (M, M) of the data, and what correlations of a prior add
    pull: np.ndarray  # (M,)
    alpha: np.ndarray  # (M,)

    def __post_init__(self):
        self.alpha = np.clip(self.alpha, *PRECISION_BOUNDS)
        self.solve()

    @property
    def inside(self) -> np.ndarray:
        """A mask (M,) of the biases that are not pruned."""
        return self.alpha < PRECISION_BOUNDS[1]

    def solve(self) -> None:
        """Posterior covariance (M, M) and mean (M,), zero where pruned."""
        own = np.flatnonzero(self.inside)
        matrix = self.information[np.ix_(own, own)] + np.diag(self.alpha[own])
        self.covariance = np.zeros_like(self.information)
        self.covariance[np.ix_(own, own)] = invert(matrix) if len(own) else 0.0
        self.mean = self.covariance @ self.pull

    @property
    def evidence(self) -> float:
        """Log evidence in nats, up to what the precisions do not change."""
        own = np.flatnonzero(self.inside)
        if not len(own):
            return 0.0
        matrix = self.information[np.ix_(own, own)] + np.diag(self.alpha[own])
        volume = np.log(self.alpha[own]).sum() - log_determinant(matrix)
        return float(0.5 * (volume + self.pull[own] @ self.mean[own]))

    def alone(self, m: int) -> tuple[float, float]:
        """Information and score of bias m, the others at their precisions."""
        if self.inside[m]:
            precision = 1.0 / self.covariance[m, m]
            return precision - self.alpha[m], self.mean[m] * precision
        cross = self.information[m]
        return float(self.information[m, m] - cross @ self.covariance @ cross), float(self.pull[m] - cross @ self.mean)

    def update(self, m: int) -> None:
        """The precision of bias m that has the largest evidence."""
        low, high = PRECISION_BOUNDS
        s, q = self.alone(m)
        wanted = high if q**2 <= s or s <= 0 else float(np.clip(s**2 / (q**2 - s), low, high))
        row = self.covariance[m]
        if self.inside[m]:
            change = np.inf if wanted == high else wanted - self.alpha[m]
            factor = 1.0 / row[m] if np.isinf(change) else change / (1.0 + change * row[m])
            self.mean = self.mean - factor * self.mean[m] * row
            self.covariance = self.covariance - factor * np.outer(row, row)
            if wanted == high:
                self.covariance[m], self.covariance[:, m], self.mean[m] = 0.0, 0.0, 0.0
        elif wanted < high:
            column = -self.covariance @ self.information[m]
            column[m] = 1.0
            variance = 1.0 / (s + wanted)
            self.covariance = self.covariance + variance * np.outer(column, column)
            self.mean = self.mean + variance * q * column
        self.alpha[m] = wanted

    def climb(self, learnt: Sequence[int]) -> float:
        """Update the learnt precisions, one after the other, until nothing gains; the evidence reached."""
        before = -np.inf
        for _ in range(SWEEPS):
            for m in learnt:
                self.update(m)
            self.solve()
            now = self.evidence
            if now - before < STILL:
                break
            before = now
        return now


def best_precisions(
    information: np.ndarray, pull: np.ndarray, alpha: np.ndarray, learnt: Sequence[int], groups: Sequence[Sequence[int]]
) -> tuple[np.ndarray, float]:
    """Precisions (M,) of largest evidence from given ones, and by how many nats they are better.

    The precisions of `learnt` are climbed one by one; then each of the `groups` is taken out as a whole, or put in at
    the declared scales, and what is better after another climb is kept, until no group gains.
    """
    found = Relevance(information, pull, np.array(alpha, float))
    first, best = found.evidence, found.climb(learnt)
    gained = True
    while gained:
        gained = False
        for group in groups:
            for value in (PRECISION_BOUNDS[1], 1.0):
                moved = found.alpha.copy()
                moved[list(group)] = value
                tried = Relevance(information, pull, moved)
                others = [m for m in learnt if m not in set(group)]
                tried.climb(others)  # the others make room before the group may come back
                worth = tried.climb(learnt)
                if worth > best + STILL:
                    found, best, gained = tried, worth, True
    return found.alpha, best - first
