"""Split HMC about an expansion of any engine (Shahbaba and others 2014).

The model is the Gaussian of its linearised rows and the rest. A quarter turn about the mean of the
Gaussian is an independent draw of that; the rest kicks it on the way, and the Metropolis rule makes
it exact. Variables are all states, then the biases; noise levels and latent scales are given.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from probcal.gaussian.engine import Expansion, Factors
from probcal.gaussian.jointly import Variables, covariance_times, times_weights
from probcal.gaussian.mode import Point, mixed_density, noises_of
from probcal.model.model import At, Model, Recursion
from probcal.model.rows import LinearRows
from probcal.simulate import chance_of

SHORTER = 0.1  # share by which a turn may be shorter than a quarter


def variables_of(states: Iterable[Any], z: Any) -> np.ndarray:
    """States (E, n) of each recursion and biases (M,) as one vector (n,)."""
    return np.concatenate([*(np.ravel(x) for x in states), np.asarray(z)])


def split_variables(model: Model, variables: Any) -> tuple[tuple[Any, ...], Any]:
    """States (E, n) of each recursion and biases (M,) of one vector (n,)."""
    ends = np.cumsum([part.drift.size for part in model.recursions])
    shapes = [(end, part.drift.shape) for part, end in model.each_layout(ends)]
    states = tuple(variables[end - E * n : end].reshape(E, n) for end, (E, n) in shapes)
    return states, variables[model.state_size :]


@dataclass(frozen=True, eq=False)
class Reference:
    """The expansion whose Gaussian is split off, and the log-likelihood beyond it."""

    at: Expansion

    @cached_property
    def variables(self) -> np.ndarray:
        """Those of the point (n,)."""
        return variables_of(self.at.point.states, self.at.point.z)

    @cached_property
    def precision(self) -> np.ndarray:
        """Precision (M,) of each bias given all else, without its prior."""
        return np.asarray(_own_precisions(self.at.model, self.at.rows))

    def rest(self, variables: np.ndarray) -> tuple[float, np.ndarray]:
        """Log density less that of the Gaussian, up to a constant, and its slope (n,)."""
        value, slope = _rest(self.at.model, self.at.point, self.at.rows, jnp.asarray(variables))
        return float(value), np.asarray(slope)

    def log_density(self, variables: np.ndarray) -> float:
        """Log density of data and whitened noises given the biases, latent scales integrated."""
        return float(_log_density(self.at.model, self.at.point, jnp.asarray(variables)))


@dataclass(frozen=True, eq=False)
class SplitGaussian:
    """States and biases given the precisions of a prior: a Gaussian, and the rest of the model."""

    reference: Reference
    alpha: np.ndarray  # (M,)
    factors: Factors
    mean: np.ndarray  # (n,)

    @classmethod
    def of(cls, reference: Reference, alpha: np.ndarray, coupled: Factors | None = None) -> SplitGaussian:
        """The Gaussian that precisions alpha (M,) leave, and the factors of what is correlated.

        Raises `numpy.linalg.LinAlgError` where a bias has neither data nor prior.
        """
        if not (reference.precision + alpha > 0).all():
            raise np.linalg.LinAlgError("a bias has neither data nor prior")
        at, factors = reference.at, Factors.alone(alpha) + (coupled or Factors())
        z = np.asarray(at.point.z)
        mean = at.moved(at.solve(factors, np.asarray(at.slope()) + factors.pull(z)))
        return cls(reference, alpha, factors, variables_of(mean.states, mean.z))

    def deviation(self, key: jax.Array) -> np.ndarray:
        """A draw (n,) of the Gaussian about zero."""
        drawn = self.reference.at.deviations(self.factors, key, 1)
        return variables_of(drawn.states, drawn.z[0])

    def covariance_times(self, slope: np.ndarray) -> np.ndarray:
        """The covariance of the Gaussian times a slope (n,)."""
        states, z = split_variables(self.reference.at.model, slope)
        columns = Variables(tuple(x[:, :, None] for x in states), z[:, None])
        found = covariance_times(self.reference.at, self.factors, columns)
        return variables_of(found.states, found.z[:, 0])

    def turned(
        self, at: np.ndarray, rest: float, kicks: int, key: jax.Array
    ) -> tuple[np.ndarray, float, float, np.ndarray]:
        """Variables (n,) after a turn, the rest there, its acceptance, and the speed it began with.

        A turn keeps the energy of the Gaussian; a kick p of slope g adds v'g + p'g / 2 to it at speed v.
        """
        rng = chance_of(key)
        speed = self.deviation(jax.random.fold_in(key, 0))
        begun, angle = speed, 0.5 * np.pi * (1.0 - SHORTER * rng.random()) / kicks
        step, gained = at - self.mean, 0.0
        whole, half = (np.cos(angle), np.sin(angle)), (np.cos(0.5 * angle), np.sin(0.5 * angle))
        for k in range(kicks + 1):
            c, s = whole if 0 < k < kicks else half
            step, speed = c * step + s * speed, c * speed - s * step
            if k < kicks:
                value, slope = self.reference.rest(self.mean + step)
                if not abs(value) < 1e100:  # nats: it diverges, and so does the turn back
                    return at, rest, 0.0, begun
                kick = angle * self.covariance_times(slope)
                gained += angle * float((speed + 0.5 * kick) @ slope)
                speed = speed + kick
        there, _ = self.reference.rest(self.mean + step)
        gain = there - rest - gained
        rate = float(np.exp(min(gain, 0.0))) if np.isfinite(gain) else float(np.isfinite(there) > np.isfinite(rest))
        return (self.mean + step, there, rate, begun) if rng.random() < rate else (at, rest, rate, begun)

    def variances(self, drawn: np.ndarray) -> np.ndarray:
        """Unbiased estimates of the variances (M,) of the biases from a draw (n,) about zero, the rest of each
        given."""
        reference, z = self.reference, drawn[self.reference.at.model.state_size :]
        own = reference.precision + self.factors.diagonal(len(z))
        pulled = np.asarray(_precision_times(reference.at.model, reference.at.rows, jnp.asarray(drawn)))
        return 1.0 / own + (z - (pulled - self.factors.pull(z)) / own) ** 2


@jax.jit
def _rest(model: Model, point: Point, rows: LinearRows, variables: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Log-likelihood less what is linear and quadratic about a point, and its slope (n,).

    Process noise, prior and integrated places are quadratic and leave no rest.
    """

    def rest(variables: jax.Array) -> jax.Array:
        states, z = split_variables(model, variables)
        moved = [(x - before)[:, :, None] for _, x, before in model.each_layout(states, point.states)]
        along = model.responses(rows, moved, (z - point.z)[:, None])
        found = model.log_likelihood(At(states, z, point.levels))
        parts = model.each_block(rows, found, [own[:, :, 0] for own in along])
        left = [jnp.sum(value - by * (lin.score - 0.5 * lin.weight * by)) for *_, lin, value, by in parts]
        return sum(left, jnp.zeros(()))

    return jax.value_and_grad(rest)(variables)


def _placed(model: Model, point: Point, variables: jax.Array) -> Point:
    states, z = split_variables(model, variables)

    def noises(part: Recursion, x: jax.Array, before: jax.Array, u: jax.Array) -> jax.Array:
        return u + noises_of(part, point.levels, x - before)

    return Point(states, model.each(noises, states, point.states, point.noises), z, point.levels)


placed = jax.jit(_placed)


@jax.jit
def _log_density(model: Model, point: Point, variables: jax.Array) -> jax.Array:
    return mixed_density(model, _placed(model, point, variables))


@jax.jit
def _own_precisions(model: Model, rows: LinearRows) -> jax.Array:
    """Diagonal (M,) of the information of the rows about the biases at held states."""
    found = jnp.zeros(model.biases + 1)
    for _, data, _, lin in model.each_block(rows):
        own = jnp.einsum("ncp,nc,ncq->npq", lin.bias, lin.weight, lin.bias)
        same = data.bias[:, :, None] == data.bias[:, None, :]  # one bias may stand twice in a row
        summed = jax.ops.segment_sum(own, data.sensor, data.bias.shape[0])
        found = found.at[data.bias].add(jnp.sum(jnp.where(same, summed, 0.0), 2))
    found = found[: model.biases]
    every = np.arange(model.biases)
    return found if model.tilt is None else found + model.tilt.between(every, every)


@jax.jit
def _precision_times(model: Model, rows: LinearRows, variables: jax.Array) -> jax.Array:
    """The rows (M,) of the biases of the joint precision, without prior, times variables (n,)."""
    states, z = split_variables(model, variables)
    along = model.responses(rows, [x[:, :, None] for x in states], z[:, None])
    found = model.onto_biases(rows, times_weights(model, rows, along))[:, 0]
    return found if model.tilt is None else found + model.tilt.times(z)
