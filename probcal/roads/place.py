"""A Gaussian around a point, restricted to the roads: its mass on each straight piece, its density and draws."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import log_ndtr, ndtr, ndtri

from probcal.roads.network import RoadNetwork

LOST = -1e30  # log mass of a piece without any
DEEP = -30.0  # sd beyond which the normal integral is lost


def segments_of(network: RoadNetwork) -> tuple[jax.Array, ...]:
    """Edge (S,), first arc length (S,), length (S,), origin (S, d) and tangent (S, d) of the straight pieces."""
    return tuple(jnp.asarray(part) for part in network.segments)


def place_on(network: RoadNetwork, edge: Any, along: Any) -> tuple[jax.Array, jax.Array]:
    """Position (d,) and unit tangent (d,) at an arc length in m on an edge; their piece is found by bisection."""
    _, begin, _, origin, tangent = segments_of(network)
    spans, whole = jnp.asarray(network.spans)[edge], jax.lax.stop_gradient(jnp.asarray(network.offsets)[edge] + along)
    own = jnp.clip(jnp.searchsorted(jnp.asarray(network.marks), whole, side="right") - 1, spans[0], spans[1])
    return origin[own] + (along - begin[own]) * tangent[own], tangent[own]


def log_masses(network: RoadNetwork, mean: Any, std: Any) -> jax.Array:
    """Log of the integral of N(mean, std^2 I) over each straight piece (S,), in m^(1 - d), by the error function."""
    _, _, length, origin, tangent = segments_of(network)
    away = mean[None] - origin
    foot = jnp.sum(away * tangent, 1)
    aside = jnp.sum((away - foot[:, None] * tangent) ** 2, 1)
    low, high, _ = _turned(foot, length, std)
    upper, lower = log_ndtr(high), log_ndtr(low)
    less = lower - upper
    there = less < 0
    between = upper + jnp.log(-jnp.expm1(jnp.where(there, less, -1.0)))
    scale = (network.dimension - 1) * (jnp.log(std) + 0.5 * math.log(2 * math.pi))
    return jnp.where(there, between, LOST) - aside / (2 * std**2) - scale


def log_total(masses: jax.Array) -> jax.Array:
    """Log of the sum of masses (S,) given as logs."""
    largest = jax.lax.stop_gradient(jnp.max(masses))
    return largest + jnp.log(jnp.sum(jnp.exp(masses - largest)))


def log_isotropic(away: Any, std: Any) -> jax.Array:
    """Log density () of N(0, std^2 I) at a vector or a number."""
    return -0.5 * jnp.sum((away / std) ** 2) - np.size(away) * (jnp.log(std) + 0.5 * math.log(2 * math.pi))


def draw_place(key: jax.Array, network: RoadNetwork, mean: Any, std: Any, masses: Any) -> tuple[jax.Array, jax.Array]:
    """Edge and arc length drawn with density in proportion to N(mean, std^2 I), given the log masses (S,)."""
    edge, begin, length, origin, tangent = segments_of(network)
    pick, where = jax.random.uniform(key, (2,))
    total = jnp.cumsum(jnp.exp(masses - jnp.max(masses)))
    own = jnp.minimum(jnp.searchsorted(total, pick * total[-1], side="right"), len(masses) - 1)
    foot = jnp.sum((mean - origin[own]) * tangent[own])
    low, high, turned = _turned(foot, length[own], std)
    inside = ndtri(ndtr(low) + where * (ndtr(high) - ndtr(low)))
    tail = -jnp.sqrt(high**2 - 2 * jnp.log1p(-where))  # of the Gaussian tail, to 1 / high^2
    unit = jnp.maximum(jnp.where(high < DEEP, tail, inside), low)
    gone = jnp.clip(foot + std * jnp.where(turned, -unit, unit), 0.0, length[own])
    return edge[own], begin[own] + gone


def _turned(foot: jax.Array, length: jax.Array, std: Any) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Ends of a piece from the foot of the mean in std, mirrored to where the normal integral keeps its digits."""
    low, high = -foot / std, (length - foot) / std
    turned = low + high > 0
    return jnp.where(turned, -high, low), jnp.where(turned, -low, high), turned
