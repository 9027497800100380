"""E-steps as values: the trajectories given the biases, and what they make of the biases' information and score.

To add one, write a frozen dataclass that inherits `EStep`; `EM(YourStep())` takes it. What it keeps between two steps
(particles, a proposal) is its carry, a pytree of fixed form; what it draws comes from the key.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from probcal.gaussian.information import state_covariances
from probcal.gaussian.mode import Point, cost, eliminate_rows, find_mode, follow, shortened
from probcal.model import sigma
from probcal.model.model import Data, Model
from probcal.priors import Precision


class Expected(NamedTuple):
    """The results of an E-step for the M-step."""

    point: Point  # the same biases, trajectories at the mode or mean of their density given these
    # (S, p, p) of the biases of each sensor of each block at fixed trajectories, expected over them
    information: Data
    score: jax.Array  # (M,) likewise
    slack: float  # of the cost, by which a step of the biases may lie above: a mean is no mode
    refused: jax.Array  # () whether the step left its start for nothing better


class EStep(ABC):
    """The expectation over trajectories given the biases; a frozen dataclass, for a kernel is compiled for each."""

    def begin(self, model: Model, point: Point) -> Any:
        """The state carried into the first step, empty by default."""
        return ()

    @abstractmethod
    def __call__(
        self, model: Model, point: Point, prior: Precision, carry: Any, key: jax.Array
    ) -> tuple[Expected, Any]:
        """One step from a point, and the next carry."""


@dataclass(frozen=True)
class Extended(EStep):
    """One damped pass of the extended smoother, linearised at the last trajectory (Paper C 27-36)."""

    def __call__(
        self, model: Model, point: Point, prior: Precision, carry: Any, key: jax.Array
    ) -> tuple[Expected, Any]:
        """Trajectories at a step towards their mode, rows linearised there."""
        mode = find_mode(model, point, prior, 1, 0.0, joint=False)
        information, score = model.of_sensors(model.linearise(mode.point, expected=False))
        return Expected(mode.point, information, score, 0.0, mode.refused), carry


class SigmaPoints(EStep):
    """Rows regressed on sigma points of the smoothed density of each epoch (Paper A 15-21)."""

    centre: ClassVar[Callable[[int], float]]  # weight kappa of the centre, by the number of state entries

    def __call__(
        self, model: Model, point: Point, prior: Precision, carry: Any, key: jax.Array
    ) -> tuple[Expected, Any]:
        """Trajectories at the mean of their smoothed density, rows expected over it."""
        rule = type(self).centre
        lins = sigma.regress_blocks(model, point, state_covariances(model, point), rule)
        parts = eliminate_rows(model, point, lins, joint=False).parts
        smoothed = follow(model, point, parts, jnp.zeros_like(point.z))
        # the mean of a density lies off its mode, by half a unit of cost a dimension at most in the Gaussian case
        slack = 0.5 * sum(u.size for u in point.noises)
        point, refused = shorten(model, point, smoothed, prior, slack)
        information, score = sigma.expect_biases(model, point, state_covariances(model, point), rule)
        return Expected(point, information, score, slack, refused), carry


@dataclass(frozen=True)
class Unscented(SigmaPoints):
    """Sigma points of the unscented transform (Julier and Uhlmann 2004)."""

    centre: ClassVar[Callable[[int], float]] = staticmethod(sigma.unscented)


@dataclass(frozen=True)
class Cubature(SigmaPoints):
    """Sigma points of the cubature rule (Arasaratnam and Haykin 2009)."""

    centre: ClassVar[Callable[[int], float]] = staticmethod(sigma.cubature)


def shorten(model: Model, point: Point, proposal: Point, prior: Precision, slack: float) -> tuple[Point, jax.Array]:
    """The longest of the halved steps that leaves the cost finite and at most `slack` above the old one.

    Also whether there was none.
    """
    found, _, share = shortened(model, point, proposal, prior, cost(model, point, prior) + slack)
    return found, share == 0
