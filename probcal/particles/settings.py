"""The settings by which particles are drawn, weighed and smoothed."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np

from probcal.errors import InputError, nearest

PROPOSALS = ("auto", "bootstrap", "extended", "laplace")
SMOOTHERS = ("backward", "exact", "marginal", "genealogy")
M_STEPS = ("averaged", "mean", "paths")


@dataclass(frozen=True)
class ParticleSettings:
    """The settings of `Particles`, which says what they mean."""

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
