"""The detection model for unnamed objects: field of view, probability, false detections."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from probcal.errors import InputError
from probcal.geometry import bearing, norm, wrap
from probcal.noise import Level, Unknown, guess_of
from probcal.types import PoseView, TargetView


@dataclass(frozen=True)
class Sector:
    """A field of view: up to `range` m away, `width` rad wide, its middle `towards` rad from the node's own x axis.

    It reads the heading of the pose where the sensor type reads it. Raises `InputError` where nothing would be seen.

    >>> Sector(range=25.0, width=4.2).towards
    0.0
    """

    range: float = np.inf
    width: float = 2 * np.pi
    towards: float = 0.0

    def __post_init__(self):
        if not (self.range > 0 and 0 < self.width <= 2 * np.pi + 1e-9 and np.isfinite(self.towards)):
            raise InputError(f"{self}: range is positive in m, width in rad up to 2 pi, towards a finite angle")

    def __call__(self, target: TargetView, pose: PoseView) -> jax.Array:
        """1 if a target is seen, else 0."""
        line = pose.local(target.position)
        near = norm(line) <= self.range
        return (near & (jnp.abs(wrap(bearing(line) - self.towards)) <= 0.5 * self.width)).astype(float)


@dataclass(frozen=True)
class Detection:
    """The detection model of a sensor for unnamed objects: `radar.on(node, detection=Detection(0.9,
    clutter=2.0))`.

    `probability` is that of detecting an object in `view` (a function of target and pose with values from 0 to 1, such
    as `Sector`; None sees all) in one scan: the rows of one sensor at one time. `clutter` is the mean number of false
    detections a scan, uniform within `limits`: low and high by channel, in its unit. A channel without limits has those
    of its period, or of the range of a `Sector`, or what the table spans. Either may be `Unknown(guess, factor)`, of
    the odds of a probability: `SelfConfiguration` then estimates it. Raises `InputError` naming what is wrong.

    >>> Detection(0.9, clutter=2.0, view=Sector(range=5000.0)).within("range", "m", None)
    (0.0, 5000.0)
    """

    probability: Level = 0.9
    clutter: Level = 1.0
    view: Callable[[Any, Any], Any] | None = None
    limits: Any = ()

    def __post_init__(self):
        sure = 1.0 if isinstance(self.probability, Unknown) else np.inf  # which cannot be learnt from
        if not (isinstance(self.probability, Level) and 0 < self.chance <= 1 and self.chance < sure):
            raise InputError(f"Detection(probability={self.probability!r}): it lies above 0, up to 1")
        if not (isinstance(self.clutter, Level) and 0 <= self.rate < np.inf):
            raise InputError(
                f"Detection(clutter={self.clutter!r}): a mean number of false detections a scan, 0 or more"
            )
        if self.view is not None and not callable(self.view):
            raise InputError("Detection: view is a function of target and pose, such as Sector(range, width)")
        pairs = self.limits.items() if isinstance(self.limits, Mapping) else self.limits
        try:
            limits = tuple((str(name), (float(low), float(high))) for name, (low, high) in pairs)
        except (TypeError, ValueError):
            raise InputError('Detection: limits are low and high by channel, as in {"range": (0.0, 5000.0)}') from None
        for name, (low, high) in limits:
            if not (np.isfinite([low, high]).all() and low < high):
                raise InputError(f'Detection: the limits of "{name}" are {low:g} and {high:g}; low lies below high')
        object.__setattr__(self, "limits", limits)

    @property
    def chance(self) -> float:
        """Probability of detection in view, or its guess."""
        return guess_of(self.probability)

    @property
    def rate(self) -> float:
        """Mean number of false detections a scan, or its guess."""
        return guess_of(self.clutter)

    def within(self, channel: str, unit: str, period: float | None) -> tuple[float, float] | None:
        """The limits of the false detections of a channel; None where only the table gives them."""
        stated = dict(self.limits)
        if channel in stated:
            return stated[channel]
        if period is not None:
            return -0.5 * period, 0.5 * period
        if isinstance(self.view, Sector) and np.isfinite(self.view.range) and unit == "m":
            return 0.0, self.view.range
        return None
