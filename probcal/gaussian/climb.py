"""To the mode of the marginal density of the biases, by what any engine gives; the host drives it.

The step is that of the posterior at the point under the factors of a prior, and what the secants of
the last steps say of log det W (L-BFGS around it); each track is settled by steps of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal.gaussian.engine import Engine, Expansion, Factors, evidence
from probcal.gaussian.marginal import ENOUGH, LEAST_CURVED, SETTLED, TRACK_STEPS
from probcal.gaussian.mode import Point, eliminate, follow
from probcal.gaussian.search import HALVINGS, between, halved
from probcal.gaussian.tails import Variances, renewed_noise
from probcal.model.model import Model
from probcal.priors import Precision

KEPT = 8  # secants
SMALL = 1e-9  # of the density: what a step that promises less cannot show


@jax.jit
def settle_each(model: Model, point: Point) -> Point:
    """Every track at its mode for the biases, each with a step length of its own: none waits for
    another.

    A track that no part of a step improves stays where it is: on a cusp, where it grazes a sensor.
    """

    def costs(at: Point) -> list[jax.Array]:
        """Negative log density (T,) of the tracks of each recursion."""
        sums = model.by_epoch(model.log_likelihood(at))
        return list(model.by_target(model.each(lambda _, own, u: 0.5 * jnp.sum(u**2, 1) - own, sums, at.noises)))

    def part_way(at: Point, full: Point, shares: list[jax.Array]) -> Point:
        def go(part: Any, old: jax.Array, new: jax.Array, share: jax.Array) -> jax.Array:
            return between(old, new, share[part.target][:, None])

        states, noises = (
            model.each(go, old, new, shares)
            for old, new in ((at.states, full.states), (at.noises, full.noises))
        )  # fmt: skip
        return at._replace(states=states, noises=noises)

    def body(carry: Any) -> Any:
        at, before, _, count = carry
        solved = eliminate(model, at, expected=False, joint=False)
        full = follow(model, at, solved, jnp.zeros_like(at.z))

        shares, after, _ = halved(lambda shares: costs(part_way(at, full, shares)), before)
        gain = jnp.max(jnp.stack([jnp.max(old - new) for new, old in zip(after, before, strict=True)]))
        return part_way(at, full, shares), after, gain, count + 1

    first = (point, costs(point), jnp.full((), jnp.inf), 0)
    return jax.lax.while_loop(lambda c: (c[2] > SETTLED) & (c[3] < TRACK_STEPS), body, first)[0]


class Climbed(NamedTuple):
    """The end of a climb: the posterior there, its negative log marginal density with the prior,
    and how it went."""

    at: Expansion
    value: float
    trace: np.ndarray  # minus that after every step
    converged: bool
    refused: bool  # no step raised the density, though one promised to


def climb_to_mode(
    expand: Callable[[Point], Expansion], start: Point, factors: Factors, iterations: int, tolerance: float,
    told: Callable[[int, float], bool] | None = None, *, marginal: bool = True,
) -> Climbed:  # fmt: skip
    """Climb to the mode of the marginal density times factors until a step promises less than
    tolerance.

    Without `marginal` it is the joint mode of biases and trajectories. `expand` gives the posterior
    at a point whose tracks it settles first. A step that does not bring its share of what it
    promises is halved. It ends where `told`, called with the number of steps and the density, says
    so. Raises `numpy.linalg.LinAlgError` where the precision is not
    positive definite: a flat prior on what no data tell.
    """

    def looked(point: Point) -> tuple[Expansion, float]:
        at = expand(point)
        volume = 0.0 if marginal else 0.5 * float(at.eliminated.logdet)
        return at, -at.density() - volume - factors.value(np.asarray(at.point.z))

    def slope_at(at: Expansion) -> np.ndarray:
        own = at.score() if marginal else at.slope()
        return np.asarray(own) + factors.pull(np.asarray(at.point.z))

    here, value = looked(start)
    secants: list[tuple[np.ndarray, np.ndarray]] = []
    trace, converged, ended = [-value], False, False
    slope = slope_at(here)
    while True:
        step = _direction(here, factors, slope, secants)
        promised = 0.5 * float(slope @ step)
        converged = promised <= max(tolerance, SMALL * 1e-3 * abs(value)) and np.isfinite(value)
        if converged or ended or len(trace) > iterations or not np.isfinite(value):
            break
        share, better = 1.0, False
        for _ in range(HALVINGS):
            there, after = looked(here.moved(share * step))
            better = bool(value - after >= ENOUGH * share * promised and after <= value)
            if better:
                break
            share *= 0.5
        if not better:
            converged = promised <= SMALL * abs(value)
            break
        moved, before = np.asarray(there.point.z) - np.asarray(here.point.z), slope
        slope = slope_at(there)
        if moved @ (before - slope) > LEAST_CURVED * share * (moved @ before):
            secants = [*secants, (moved, before - slope)][-KEPT:]
        here, value = there, after
        trace.append(-value)
        ended = told is not None and told(len(trace) - 1, -value)
    return Climbed(here, value, np.array(trace), converged, not converged and len(trace) == 1)


def climb_with_noise(
    engine: Engine,
    model: Model,
    start: Point,
    prior: Precision,
    factors: Factors,
    steps: int,
    turns: int,
    tolerance: float,
    told: Callable[[int, float], bool],
    *,
    marginal: bool = True,
) -> Climbed:
    """Climb in turn to the mode of the biases and, where noise is not known, to that of largest
    evidence.

    It ends where a turn moves the evidence by less than the tolerance; the trace is then the
    evidence after each. `factors` are those of the prior.
    """
    point, trace = start, [-np.inf]
    while True:
        expand = partial(engine.settled, model)
        mode = climb_to_mode(expand, point, factors, steps, 1e-2 * tolerance, told, marginal=marginal)
        if not model.learns_noise:
            return mode
        trace.append(evidence(mode.at, prior, factors).value)
        still = abs(trace[-1] - trace[-2]) < tolerance
        ended = told(len(trace) - 1, trace[-1]) or len(trace) > turns
        if still or ended or not np.isfinite(trace[-1]):
            return mode._replace(
                trace=np.array(trace[1:]),
                converged=mode.converged and still,
                refused=mode.refused and len(trace) == 2,
            )
        model, point = renewed_noise(model, mode.at.point, Variances.of(mode.at, factors))


def _direction(
    at: Expansion, factors: Factors, slope: np.ndarray, secants: list[tuple[np.ndarray, np.ndarray]]
) -> np.ndarray:
    """The step of L-BFGS around an inverse curvature (Nocedal, Wright 2006, algorithm 7.4)."""
    q, parts = slope.copy(), []
    for moved, change in reversed(secants):
        scale = 1.0 / (moved @ change)
        share = scale * (moved @ q)
        q = q - share * change
        parts.append((moved, change, scale, share))
    step = np.asarray(at.solve(factors, q))
    for moved, change, scale, share in reversed(parts):
        step = step + moved * (share - scale * (change @ step))
    return step
