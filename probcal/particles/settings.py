"""How particles are drawn, weighed and smoothed: a value that methods take."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np

from probcal.errors import InputError, nearest

PROPOSALS = ("auto", "bootstrap", "extended", "laplace")
SMOOTHERS = ("backward", "exact", "marginal", "genealogy")
M_STEPS = ("averaged", "mean", "paths")


@dataclass(frozen=True)
class Particles:
    """A particle filter of `count` particles and a smoother behind it, for `track`, and for `EM` as its E-step.

    `proposal`: "bootstrap" draws from the motion; "extended" and "laplace" from a Gaussian that has seen the rows of
    the epoch (one Gauss-Newton step, or several), for motions with a linear form; "auto" is extended for these,
    bootstrap for others. Resampled, systematically, where the
    effective number falls below `threshold` of them.

    `smoother`: "backward" draws paths backward in time at a cost linear in `count`, by `moves` independent Metropolis
    steps that begin at the ancestor (Bunch, Godsill 2013; Dau, Chopin 2023); "exact" draws them from all particles and
    "marginal" weighs these (Paper A 38-39), both at a quadratic cost; "genealogy" keeps the ancestors: all that is
    left for a motion without density.

    `m_step`, where it is an E-step: "averaged" is stochastic approximation, each step one pass of a filter that holds
    the last path, so that few particles will do and none is lost, averaged over the passes (Lindsten 2013; Delyon,
    Lavielle, Moulines 1999); "mean" linearises at the smoothed mean, or on the road that is nearest to it (Paper A
    20-21, 43); "paths" takes a Gauss-Newton step of the expectation over all smoothed particles. Over its first
    `tempered` iterations from biases of zero the log-likelihood counts less, at first by 1/50, so that particles that
    do not know the biases yet are not thrown off by rows that contradict each other (Ueda, Nakano 1998).

    Raises `InputError` for settings outside their ranges; what runs it, where cuthbert is not installed.

    >>> Particles(500).smoother
    'backward'
    """

    count: int = 1000
    proposal: str = "auto"
    smoother: str = "backward"
    m_step: str = "averaged"
    threshold: float = 0.5
    moves: int = 2
    tempered: int = 10

    def __post_init__(self):
        if self.count < 2:
            raise InputError(f"Particles(count={self.count}): take at least 2, some hundred as a rule")
        for name, known in (("proposal", PROPOSALS), ("smoother", SMOOTHERS), ("m_step", M_STEPS)):
            value = getattr(self, name)
            if value not in known:
                raise InputError(f'Particles({name}="{value}"): unknown {name}{nearest(value, known)}')
        if not (np.isfinite(self.threshold) and 0 <= self.threshold <= 1):
            raise InputError(f"Particles(threshold={self.threshold}): give a share of the particles, 0 to 1")
        if self.tempered < 0:
            raise InputError(f"Particles(tempered={self.tempered}): give a number of iterations, 0 for none")
        if self.moves < 1:
            raise InputError(f"Particles(moves={self.moves}): at least one step is needed")


def check_installed() -> None:
    """Raise `InputError` where cuthbert is not installed."""
    if find_spec("cuthbert") is None:
        raise InputError('particles need cuthbert: pip install "probcal[particles]"')
