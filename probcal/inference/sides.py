"""Sides of a mirror, or of a piece of track that fits on both: what a chain needs to cross from one to another.

There are two ways. By coordinates: what the frame of a side whitens is kept, so that all of a scene may turn over. By
shift: tracks and biases are moved by what lies between the two answers, so that what they share stays as it is.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from probcal.gaussian.frame import log_weight, place, unit_normals
from probcal.gaussian.information import at_levels
from probcal.gaussian.mode import Point, mixed_density
from probcal.inference.leaps import Place
from probcal.inference.posed import Form, Posed, log_prior
from probcal.modes.explore import new, reach
from probcal.modes.grid import track_mode
from probcal.problem import Problem


class Sided(NamedTuple):
    """The state of a chain that visits several modes of a reflection."""

    chain: Any
    side: jax.Array  # () which frame it moves in
    key: jax.Array


def side_of(sides: Posed, side: Any) -> Posed:
    """The posterior posed on one side, of frames and places with a leading dim."""
    frame, away = jax.tree.map(lambda leaf: leaf[side], (sides.frame, sides.away))
    return sides._replace(frame=frame, away=away)


def distances(problem: Problem, points: Sequence[Point]) -> list[Point]:
    """By how much tracks, noises and biases of each answer differ from the first; levels are those of the first.

    Biases are left as they are where a track stays on its side without them: a piece of a track moves by itself.
    """
    first = points[0]
    found = [jax.tree.map(jnp.zeros_like, first)._replace(levels=first.levels)]
    for other in points[1:]:
        other = at_levels(problem.model, other, first.levels)
        alone = track_mode(problem, other._replace(z=first.z))
        chosen = alone if new(problem, alone, [first], reach(problem, other, first)) else other
        found.append(jax.tree.map(jnp.subtract, chosen, first)._replace(levels=first.levels))
    return found


def shifted(form: Form, here: Posed, there: Posed, at: Place) -> tuple[Place, jax.Array]:
    """A place moved by what lies between two sides, and by how much the joint density is larger there.

    The way back is the same shift with its sign turned, and nothing is spread: any two sides are an involution.
    """
    model = here.model
    point = place(model, here.frame, at.theta, at.eps)
    way = jax.tree.map(jnp.subtract, there.away, here.away)
    way = at_levels(model, way._replace(levels=here.away.levels), point.levels)
    moved = jax.tree.map(jnp.add, point, way)._replace(levels=point.levels)
    theta, eps = jnp.concatenate([moved.z, moved.levels]), unit_normals(model, there.frame, moved)
    gain = mixed_density(model, moved) - mixed_density(model, point)
    if form.hierarchy.spiked:  # what is out must stay at zero
        gain = jnp.where(jnp.any(way.z != 0), -jnp.inf, gain)
    else:
        gain = gain + log_prior(form, here, theta, at.phi) - log_prior(form, here, at.theta, at.phi)
    return at._replace(theta=theta, eps=eps, weight=log_weight(model, there.frame, theta, eps)), gain


def side_by_side(poses: Sequence[Posed]) -> Posed:
    """The sides of one problem as one: frames and distances with a leading dim."""
    frame, away = jax.tree.map(lambda *leaves: jnp.stack(leaves), *((one.frame, one.away) for one in poses))
    return poses[0]._replace(frame=frame, away=away)
