"""Priors of the biases, as data chosen at the fit; every bias is taken as z = bias / scale.

A bias with a `survey` keeps its Gaussian of known standard deviation under every prior.
"""

from dataclasses import dataclass

import numpy as np

from probcal.types import InputError

PRECISION_BOUNDS = (1e-2, 1e8)  # of z; a fit with a bias at the lower bound is not an answer


@dataclass(frozen=True)
class Flat:
    """No prior: maximum likelihood."""


@dataclass(frozen=True)
class Gaussian:
    """Zero-mean Gaussian with the declared scale of each bias as its standard deviation."""


@dataclass(frozen=True)
class ARD:
    """Automatic relevance determination: one precision a bias, with a Gamma(shape, rate) hyper-prior.

    The default, shape 1 and rate 0, is the flat hyper-prior of the papers (Paper B 11, Paper C 18).
    """

    shape: float = 1.0
    rate: float = 0.0

    def __post_init__(self):
        if not (np.isfinite(self.shape) and self.shape > 0 and np.isfinite(self.rate) and self.rate >= 0):
            raise InputError(f"ARD(shape={self.shape}, rate={self.rate}): shape must be positive, rate not negative")

    def mackay(self, gamma, z):
        """Precision that solves the evidence equation for a given gamma (Paper B 25)."""
        return (gamma + 2 * (self.shape - 1)) / (z**2 + 2 * self.rate + 1e-300)

    def expectation(self, variance, z):
        """Precision that maximises the expected log prior (Paper C 40)."""
        return (1 + 2 * (self.shape - 1)) / (z**2 + variance + 2 * self.rate)


Prior = Flat | Gaussian | ARD
PRIORS: dict[str, type[Prior]] = {"flat": Flat, "gaussian": Gaussian, "ard": ARD}
