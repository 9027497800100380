"""Moves along a gauge: the scene turned, shifted, or made larger, with tracks and process noise, in one jump.

Where only priors and the motion hold the frame, biases and all trajectories go together, and steps that move one of
them at a time creep. A similarity of places and tracks leaves what the sensors see nearly as it is: it is proposed by
a random angle, shift or factor, -r as likely as r, and accepted by the joint density and the volume that it spreads
(Green 1995; Liu, Sabatti 2000).
"""

from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from probcal import linalg
from probcal.gaussian.frame import log_weight, place, unit_normals, volume
from probcal.gaussian.mode import Point, driven_states
from probcal.gaussian.search import chosen
from probcal.inference.draws import accepted
from probcal.inference.leaps import Place
from probcal.inference.posed import Form, Posed, log_prior
from probcal.linalg import least_squares
from probcal.model.model import Recursion
from probcal.model.rows import level_factors
from probcal.model.trajectories import States, Trajectories
from probcal.modes.reflections import place_biases
from probcal.problem import Problem

SIZES = (2.0, 0.5, 0.1)  # of a proposal, in sd along the direction by the frame: one of them by lot
CLOSE = 1e-6  # share by which a moved track may miss the motion
TURNING = 1.0  # largest angle in rad and log factor that a proposal is drawn from


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["base", "scale", "centre", "pinned", "size"],
    meta_fields=["kind", "axes", "places", "headings", "spans", "levels", "volume"],
)
@dataclass(frozen=True)
class Orbit:
    """One family of similarities of a problem, r = 0 the identity."""

    kind: str  # "turn", "shift", "size"
    axes: tuple[int, int]  # the plane of a turn, the axis of a shift (twice)
    places: tuple[tuple[int, ...], ...]  # biases of the places of nodes, one an axis
    headings: tuple[int, ...]  # biases of headings
    spans: tuple[tuple[tuple[int, int, bool], ...], ...]  # of each recursion: vectors in the state, whether a place
    levels: tuple[int, ...]  # noise levels that grow with the scene
    volume: float  # log volume that a factor exp(1) spreads
    base: jax.Array  # (nodes, d) stated places
    scale: jax.Array  # (M,)
    centre: jax.Array  # (d,)
    pinned: States  # pseudo-inverses (E, n, n) of the noise factors of each recursion
    size: jax.Array  # () sd of r by the frame

    def vector(self, r: jax.Array, value: jax.Array, *, place: bool) -> jax.Array:
        """Vectors (..., d), places or not, moved by r."""
        if self.kind == "shift":
            return value.at[..., self.axes[0]].add(r) if place else value
        centre = jnp.broadcast_to(self.centre if place else jnp.zeros_like(self.centre), value.shape)
        away = value - centre
        if self.kind == "size":
            return centre + jnp.exp(r) * away
        a, b = self.axes
        c, s = jnp.cos(r), jnp.sin(r)
        turned = away.at[..., a].set(c * away[..., a] - s * away[..., b])
        return centre + turned.at[..., b].set(s * away[..., a] + c * away[..., b])

    def biases(self, r: jax.Array, z: jax.Array) -> jax.Array:
        """Biases (M,) moved by r."""
        if self.places:
            index = jnp.asarray(self.places)
            place = self.base + z[index] * self.scale[index]
            z = z.at[index].set((self.vector(r, place, place=True) - self.base) / self.scale[index])
        if self.kind == "turn" and self.headings:
            index = jnp.asarray(self.headings)
            z = z.at[index].add(r / self.scale[index])
        return z

    def states(self, r: jax.Array, states: States) -> States:
        """Trajectories (E, n) moved by r."""
        found = []
        for x, spans in zip(states, self.spans, strict=True):
            for start, stop, located in spans:
                x = x.at[:, start:stop].set(self.vector(r, x[:, start:stop], place=located))
            found.append(x)
        return tuple(found)

    def moved(self, posed: Posed, r: jax.Array, point: Point) -> Point:
        """The point moved by r, its noises those of the moved trajectories at the moved levels."""
        levels = point.levels.at[jnp.asarray(self.levels, int)].add(r) if self.levels else point.levels

        def moved(x: jax.Array, u: jax.Array, part: Recursion, inverse: jax.Array) -> tuple[jax.Array, jax.Array]:
            old, new = (level_factors(own)[part.level] / jnp.sqrt(part.weight) for own in (point.levels, levels))
            source = x - part.drift - jnp.einsum("eij,ej->ei", part.F, linalg.preceding(x))
            idle = jnp.einsum("eij,ej->ei", part.L, old * u)  # columns that reach no state stay as they are
            return x, (old * u + jnp.einsum("eij,ej->ei", inverse, source - idle)) / new

        tracks = Trajectories(self.states(r, point.states), point.noises)
        return Point(tracks.map(moved, posed.model.recursions, self.pinned), self.biases(r, point.z), levels)


def roam(form: Form, posed: Posed, at: Place, key: jax.Array) -> tuple[Place, jax.Array]:
    """One proposal along each orbit of a posed problem: the place, and the share that was taken.

    The log density of a place is that of the joint posterior in the frame's coordinates. Scales that each bias has of
    its own are proposed along, by their conditional at the moved biases: small ones would hold the scene.
    """
    learnt = jnp.asarray(form.hierarchy.learnt, int)

    def density(place: Place) -> jax.Array:
        own = posed.frame.log_likelihood(place.theta) - 0.5 * sum(jnp.sum(e**2) for e in place.eps)
        return place.weight + own + log_prior(form, posed, place.theta, place.phi)

    if not posed.orbits:
        return at, jnp.zeros(())
    most = jnp.asarray([jnp.inf if orbit.kind == "shift" else TURNING for orbit in posed.orbits])
    sizes, volumes = (jnp.stack([jnp.asarray(getattr(o, name)) for o in posed.orbits]) for name in ("size", "volume"))
    moves = [partial(orbit.moved, posed) for orbit in posed.orbits]

    def one(at: Place, k: jax.Array) -> tuple[Place, jax.Array]:
        pick, draw, renew, lot = jax.random.split(jax.random.fold_in(key, k), 4)
        size = jax.random.choice(pick, jnp.asarray(SIZES)) * sizes[k]
        r = jnp.minimum(size, most[k]) * jax.random.normal(draw)
        point = place(posed.model, posed.frame, at.theta, at.eps)
        point = jax.tree.map(partial(jax.lax.select_n, k), *(move(r, point) for move in moves))
        theta, eps = jnp.concatenate([point.z, point.levels]), unit_normals(posed.model, posed.frame, point)
        phi, ratio = form.hierarchy.renewed(at.phi, at.theta[learnt], theta[learnt], renew)
        tried = Place(theta, eps, phi, log_weight(posed.model, posed.frame, theta, eps))
        gain = density(tried) - density(at) + volumes[k] * r + ratio
        if any(orbit.levels for orbit in posed.orbits):  # the frame spreads eps otherwise at other levels
            there, here = (volume(posed.model, posed.frame, one.theta) for one in (tried, at))
            gain = gain - there + here
        taken = accepted(lot, gain)
        return chosen(taken, tried, at), taken.astype(float)

    at, taken = jax.lax.scan(one, at, jnp.arange(len(moves)))
    return at, jnp.mean(taken)


def orbits_of(problem: Problem, posed: Posed, covariance: np.ndarray) -> tuple[Orbit, ...]:
    """The similarities that can be tried on a problem, for a covariance (M, M) of z by the frame."""
    d, point = problem.network.dimension, posed.frame.point
    headings = [m for m, bias in enumerate(problem.biases) if bias.component == "heading" and bias.since is None]
    by_name = {node.name: node for node in problem.network.nodes}
    whole = {name: own for name, own in place_biases(problem).items() if len(own) == d}
    if not whole or any(form is not None for form in problem.model.sampled):
        return ()
    base = np.stack([by_name[name].position for name in whole])
    spans = tuple(
        tuple((a, b, name == "position") for name, a, b, axis in epochs.layout if name in VECTORS and axis)
        for epochs in problem.epochs
    )
    pinned = tuple(linalg.pseudo_inverse(np.asarray(part.L)) for part in problem.model.recursions)
    places = tuple(tuple(own) for own in whole.values())
    driven, found = _levels(problem, spans), list[Orbit]()
    kinds = [("turn", pair, ()) for pair in combinations(range(d), 2)] + [("shift", (a, a), ()) for a in range(d)]
    for kind, axes, levels in [*kinds, *(("size", (0, 0), own) for own in dict.fromkeys([(), driven]))]:
        turning = tuple(headings) if kind == "turn" and axes == (0, 1) else ()
        volume = float(d * len(places) + _entries(problem, spans, levels)) if kind == "size" else 0.0
        arrays: Any = (base, problem.scales, base.mean(0), pinned, np.array(1.0))
        found.append(Orbit(kind, axes, places, turning, spans, levels, volume, *arrays))
    tried = jax.device_put(tuple(found))
    kept = []
    for orbit, (miss, slope) in zip(tried, _tried(tried, posed, point), strict=True):
        if float(miss) < CLOSE:
            wide = np.asarray(slope) @ least_squares(covariance, np.asarray(slope))
            kept.append(replace(orbit, size=jnp.asarray(1.0 / np.sqrt(max(wide, 1e-12)))))
    return tuple(kept)


VECTORS = ("position", "velocity", "acceleration")


def _entries_of(problem: Problem, spans: tuple[Any, ...]) -> tuple[np.ndarray, ...]:
    """Mask (n,) of the state entries of vectors, for each recursion."""

    def of(part: Recursion, own: Any) -> np.ndarray:
        mine = np.zeros(part.drift.shape[1], bool)
        for start, stop, _ in own:
            mine[start:stop] = True
        return mine

    return problem.model.each(of, spans)


def _levels(problem: Problem, spans: tuple[Any, ...]) -> tuple[int, ...]:
    """Unknown levels of the process noise of places, which belong to nothing else."""
    found = set()
    other = set()
    H = len(problem.levels)
    for part, mine in problem.model.each_layout(_entries_of(problem, spans)):
        L, level = np.asarray(part.L) != 0, np.asarray(part.level)
        inside, outside = L[:, mine].any(1), L[:, ~mine].any(1)
        found |= set(level[inside & ~np.asarray(part.first)[:, None]].tolist())
        other |= set(level[outside].tolist())
    for rows in problem.model.rows:
        other |= set(np.asarray(rows.level).ravel().tolist())
    return tuple(sorted(found - other - {H}))


def _entries(problem: Problem, spans: tuple[Any, ...], levels: tuple[int, ...]) -> int:
    """Whitened noises that grow with the scene: those of vectors, without those whose level grows along."""
    count = 0
    for part, mine in problem.model.each_layout(_entries_of(problem, spans)):
        active = (np.asarray(part.L)[:, mine] != 0).any(1)
        count += int((active & ~np.isin(np.asarray(part.level), levels)).sum())
    return count


@jax.jit
def _tried(orbits: tuple[Orbit, ...], posed: Posed, point: Point) -> list[tuple[jax.Array, jax.Array]]:
    """By how much, relative to their size, moved tracks miss the motion, and the slope (M,) of the biases by r."""
    found = []
    for orbit in orbits:
        moved, miss = orbit.moved(posed, jnp.asarray(0.1), point), jnp.zeros(())
        for part, x, u in posed.model.each_layout(*moved.trajectories):
            off = driven_states(part, moved.levels, u) - x
            own = jnp.max(jnp.abs(off)) / (1.0 + jnp.max(jnp.abs(x)))
            miss = jnp.maximum(miss, jnp.where(jnp.isfinite(own), own, jnp.inf))
        turn = jax.jvp(lambda r, o=orbit: o.biases(r, point.z), (jnp.zeros(()),), (jnp.ones(()),))[1]
        found.append((miss, turn))
    return found
