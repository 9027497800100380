"""A target: its motion and what is known of its start."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from probcal.errors import InputError, nearest
from probcal.motion.base import as_motion


@dataclass(frozen=True)
class Target:
    """A target with a motion of its own and, where known, its start: component -> (mean, std).

    A motion without linear form draws its own start.

    >>> from probcal.motion import ConstantVelocity
    >>> Target(ConstantVelocity(0.5), {"position": ((0.0, 0.0), 10.0), "velocity": ((5.0, 0.0), 1.0)}).start["velocity"]
    ((5.0, 0.0), 1.0)
    """

    motion: Any
    start: Mapping[str, tuple[Any, float]] = field(default_factory=dict)

    def __post_init__(self):
        vector, others = as_motion(self.motion).split
        components = () if vector is None else vector.components
        known = [name for component in components for name, _ in component.names()]
        anew = {name for component in components if component.memoryless for name, _ in component.names()}
        for name, pair in self.start.items():
            if name not in known:
                if others:
                    raise InputError(
                        f'Target start: "{name}" is not of a linear part; {type(others[0]).__name__} draws its own,'
                        " write it in initial(key)"
                    )
                raise InputError(f'Target start: the motion has no component "{name}"{nearest(name, known)}')
            if name in anew:
                raise InputError(f'Target start: "{name}" is drawn anew at every epoch; state it in the motion')
            check_pair(pair, f'Target start "{name}"')


def check_pair(pair: Any, what: str) -> None:
    """Raise `InputError` unless a pair is a finite mean and a positive standard deviation."""
    try:
        mean, std = pair
        fine = bool(np.all(np.isfinite(mean)) and np.isfinite(std) and std > 0)
    except (TypeError, ValueError):
        fine = False
    if not fine:
        raise InputError(f"{what} is {pair!r}: give (mean, std) with finite values and a positive std")
