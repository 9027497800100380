"""The joint density of all states and biases as a function of the variables of the sparse form.

Around a reference it is a Gaussian of sparse precision, what the rows and the motion tell linearised there, and the
rest: what a sampler weighs its steps by.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from probcal import linalg
from probcal.gaussian.cholesky import mirrored
from probcal.gaussian.joint import JointPrecision
from probcal.gaussian.linearised import linearise_rows
from probcal.gaussian.mode import Point, factors, log_density
from probcal.model.model import Model


@dataclass(frozen=True, eq=False)
class JointDensity:
    """The log density of data and trajectories given the biases, at variables (n,), and its Gaussian at a reference."""

    model: Model
    joint: JointPrecision
    point: Point  # whose known states and levels are those of every other point
    roots: tuple[jax.Array, ...]  # (E, n, n) inverse of those of the process noise of each recursion, 0 where none
    at: np.ndarray  # (n,) variables of the reference
    value: float  # log density there
    slope: np.ndarray  # (n,) of it
    entries: np.ndarray  # of the precision, the biases without prior
    matrix: Any  # (n, n) the same, sparse

    @classmethod
    def of(cls, model: Model, joint: JointPrecision, point: Point, at: np.ndarray) -> JointDensity:
        """Linearised at variables (n,), with the known states and the levels of a point."""
        entries = joint.values(model, linearise_rows(model, point_of_variables(model, joint, point, at)), point.levels)
        blank = cls(
            model,
            joint,
            point,
            _roots(model, joint, point),
            at,
            0.0,
            np.zeros_like(at),
            entries,
            mirrored(joint.places, entries).tocsr(),
        )
        value, slope = blank.looked(at)
        return replace(blank, value=value, slope=slope)

    def looked(self, at: np.ndarray) -> tuple[float, np.ndarray]:
        """Log density at variables (n,), and its slope (n,)."""
        value, slope = _value_and_slope(self.model, self.point, _slots(self.joint), self.roots, jnp.asarray(at))
        return float(value), np.asarray(slope)

    def rest(self, at: np.ndarray) -> tuple[float, np.ndarray]:
        """Log density less that of the Gaussian at variables (n,), and the slope (n,) of the rest."""
        value, slope = self.looked(at)
        step = at - self.at
        bent = self.matrix @ step
        return value - self.value - float(step @ (self.slope - 0.5 * bent)), slope - self.slope + bent


def variables_of(model: Model, joint: JointPrecision, point: Point) -> np.ndarray:
    """The variables (n,) of a point: states, then biases."""
    found = np.zeros(joint.places.size)
    for _, own, x in model.each_layout(joint.slots, point.states):
        there = own >= 0
        found[own[there]] = np.asarray(x)[there]
    found[joint.states :] = np.asarray(point.z)
    return found


def point_of_variables(model: Model, joint: JointPrecision, point: Point, at: np.ndarray) -> Point:
    """The point of variables (n,), with the known states and the levels of another."""
    return _point(model, point, _slots(joint), _roots(model, joint, point), jnp.asarray(at))


def _slots(joint: JointPrecision) -> tuple[jax.Array, ...]:
    return tuple(jnp.asarray(own) for own in joint.slots)


def _roots(model: Model, joint: JointPrecision, point: Point) -> tuple[jax.Array, ...]:
    """Inverse roots (E, n, n) of the process noise of each recursion, 0 where there is none."""
    found = []
    for part, drives in model.each_layout(joint.driven):
        root = jnp.where(drives[:, None, None], factors(part, point.levels), jnp.eye(part.F.shape[1])[None])
        found.append(jnp.where(drives[:, None, None], linalg.inverses(root), 0.0))
    return tuple(found)


def _placed(
    model: Model, point: Point, slots: tuple[jax.Array, ...], roots: tuple[jax.Array, ...], at: jax.Array
) -> Point:
    states, noises = [], []
    for part, own, root, known in model.each_layout(slots, roots, point.states):
        x = jnp.where(own >= 0, at[own], known)
        before = jnp.concatenate([jnp.zeros_like(x[:1]), x[:-1]])
        left = x - jnp.einsum("eij,ej->ei", part.F, before) - part.drift
        states.append(x)
        noises.append(jnp.einsum("eij,ej->ei", root, left))
    return point._replace(states=tuple(states), noises=tuple(noises), z=at[at.shape[0] - model.biases :])


_point = jax.jit(_placed)


@jax.jit
def _value_and_slope(
    model: Model, point: Point, slots: tuple[jax.Array, ...], roots: tuple[jax.Array, ...], at: jax.Array
) -> tuple[jax.Array, jax.Array]:
    def value(at: jax.Array) -> jax.Array:
        return log_density(model, _placed(model, point, slots, roots, at))

    return jax.value_and_grad(value)(at)
