"""A Gaussian frame of the posterior: coordinates in which biases and trajectories are nearly independent normals.

At a point the trajectories given the biases are Gaussian with a block-tridiagonal precision. They are written as a
response to theta = (biases z, log levels) plus a closed loop driven by independent unit normals `eps`:
u_k = -K_k x_{k-1} + C_k eps_k, the factor of the posterior that a backward information pass gives (the control form
of the Kalman smoother). K and C follow the levels: a track that the data hardly hold widens with its process noise,
one that they hold does not, and neither leaves a funnel. With the trajectories marginalised the data have a Gaussian
log-likelihood of theta. Both are exact where the problem is linear and Gaussian; elsewhere `log_weight` says by how
much they are wrong at a point.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal import linalg, rows
from probcal.linalg import inverse_cholesky, multiply
from probcal.problem import Recursion, Spec, System
from probcal.rows import Linearised
from probcal.smoothing import recursion as rec
from probcal.smoothing.information import at_levels
from probcal.smoothing.mode import (
    Point,
    compress,
    eliminate_compressed,
    factors,
    follow,
    linearise,
    log_density,
    track,
    widening,
)

STEP = 0.05  # of a log level, for differences


class Loop(NamedTuple):
    """Trajectories of one recursion given theta: response, and the closed loop of the rest."""

    states: jax.Array  # (E, n, Q) response of the states to theta
    noises: jax.Array  # (E, n, Q) response of the whitened noises, those at the levels of the frame's point
    feedback: jax.Array  # (E, n, n) K
    factor: jax.Array  # (E, n, n) C with columns of unit diagonal
    size: jax.Array  # (E, n) log of that diagonal
    slopes: tuple[jax.Array, ...]  # of feedback, factor and size by the log levels, each with H leading

    def at(self, step: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Feedback, factor and log size where the log levels are `step` (H,) from those of the point."""
        base = self.feedback, self.factor, self.size
        if step.shape[0] == 0:
            return base
        moved = (b + jnp.tensordot(step, slope, 1) for b, slope in zip(base, self.slopes, strict=True))
        feedback, factor, size = moved
        return feedback, factor, size


class Frame(NamedTuple):
    """Gaussian approximation around a point; Q = M + H entries of theta, biases before levels."""

    point: Point
    information: jax.Array  # (Q, Q) of the data about theta, trajectories marginalised
    score: jax.Array  # (Q,) slope of the marginal log-likelihood at the point
    height: jax.Array  # () its value there
    loops: tuple[Loop, ...]

    @property
    def theta(self) -> jax.Array:
        """Biases and log levels of the point, (Q,)."""
        return jnp.concatenate([self.point.z, self.point.levels])

    @property
    def pull(self) -> jax.Array:
        """Linear term of the marginal log-likelihood about zero, (Q,)."""
        return self.information @ self.theta + self.score

    def log_likelihood(self, theta: jax.Array) -> jax.Array:
        """Gaussian marginal log-likelihood of theta (Q,)."""
        step = theta - self.theta
        return self.height + self.score @ step - 0.5 * step @ (self.information @ step)


def closed_loop(part: Recursion, L: jax.Array, J: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Feedback (E, n, n), factor (E, n, n) of unit diagonal and its log size (E, n) with data information J.

    The information S about x_k from its own and all later data runs backwards in the symmetric (Joseph) form.
    """
    n = part.F.shape[-1]
    eye = jnp.eye(n, dtype=part.F.dtype)

    def step(ahead: jax.Array, epoch: tuple[jax.Array, ...]) -> tuple[jax.Array, tuple[jax.Array, ...]]:
        F_k, L_k, J_k = epoch
        S = J_k + ahead
        inverse = inverse_cholesky(eye + multiply(L_k.T, multiply(S, L_k)))
        gain = multiply(inverse.T, multiply(inverse, multiply(L_k.T, S)))
        keep = eye - multiply(L_k, gain)
        behind = multiply(keep.T, multiply(S, keep)) + multiply(gain.T, gain)
        behind = multiply(F_k.T, multiply(0.5 * (behind + behind.T), F_k))
        return behind, (multiply(gain, F_k), inverse.T)

    _, (feedback, factor) = jax.lax.scan(step, jnp.zeros_like(eye), (part.F, L, J), reverse=True)
    size = jnp.diagonal(factor, axis1=1, axis2=2)
    return feedback, factor / size[:, None, :], jnp.log(size)


def averaged(
    spec: Spec, system: System, frame: Frame, theta: jax.Array, eps: tuple[jax.Array, ...]
) -> list[Linearised]:
    """Every block linearised at the frame's point, with score and curvature averaged over draws.

    These are the moments of the best Gaussian approximation of the joint posterior (Opper, Archambeau 2009). Draws
    theta (D, Q), eps (D, E, n) are taken with their mirror images, so that what is linear stays exact.
    """

    def at(theta: jax.Array, eps: tuple[jax.Array, ...]) -> list[tuple[jax.Array, jax.Array]]:
        point = place(system, frame, theta, eps)
        found = []
        for block, data, r in zip(spec.blocks, system.rows, spec.recursion, strict=True):
            predicted = rows.predict(block, data, point.states[r], point.z)
            found.append(rows.slopes(block, data, predicted, point.levels))
        return found

    def pair(draw: tuple[jax.Array, tuple[jax.Array, ...]]) -> list[tuple[jax.Array, jax.Array]]:
        theta, eps = draw
        mirrored = at(2 * frame.theta - theta, tuple(-e for e in eps))
        return jax.tree.map(lambda a, b: 0.5 * (a + b), at(theta, eps), mirrored)

    means = jax.tree.map(lambda leaf: jnp.mean(leaf, 0), jax.lax.map(pair, (theta, eps)))
    lins = linearise(spec, system, frame.point, expected=True)
    return [
        lin._replace(score=score, weight=jnp.maximum(curvature, 0.0))
        for lin, (score, curvature) in zip(lins, means, strict=True)
    ]


class _AtLevels(NamedTuple):
    """Marginal log-likelihood, its slope by z, trajectories and closed loops at other levels, leading dim (levels,)."""

    value: jax.Array
    score: jax.Array  # (M,)
    states: tuple[jax.Array, ...]
    noises: tuple[jax.Array, ...]  # at the levels of the frame
    loops: tuple[tuple[jax.Array, ...], ...]  # of each recursion: feedback, factor and size of the latter


@partial(jax.jit, static_argnames="spec")
def _at(spec: Spec, system: System, point: Point, levels: jax.Array) -> _AtLevels:
    """At levels (D, H), one after the other."""

    def one(levels: jax.Array) -> _AtLevels:
        moved = track(spec, system, at_levels(system, point, levels))
        lins = linearise(spec, system, moved, expected=True)
        compressed = compress(spec, system, lins, moved.states)
        solved = eliminate_compressed(spec, system, moved.noises, levels, compressed)
        value = log_density(spec, system, moved) - 0.5 * solved.logdet
        change = jnp.concatenate([levels - point.levels, jnp.zeros(1)])
        loops = []
        for part, (J, _) in zip(system.recursions, compressed.states, strict=True):
            feedback, factor, size = closed_loop(part, factors(part, levels), J)
            wider = change[part.level]
            ratio = jnp.exp(wider)[:, :, None]
            loops.append((ratio * feedback, factor * ratio / ratio.mT, size + wider))
        noises = at_levels(system, moved, point.levels).noises
        return _AtLevels(value, solved.score, moved.states, noises, tuple(loops))

    return jax.lax.map(one, levels)


@partial(jax.jit, static_argnames="spec")
def frame_at(spec: Spec, system: System, point: Point) -> Frame:
    """The frame at a point whose trajectories are at their mode for its biases and levels."""
    return _frame(spec, system, point, linearise(spec, system, point, expected=True))


@partial(jax.jit, static_argnames="spec")
def refined(spec: Spec, system: System, frame: Frame, theta: jax.Array, eps: tuple[jax.Array, ...]) -> Frame:
    """The frame with trajectories and curvature fitted to draws theta (D, Q), eps (D, E, n) of it (see `averaged`)."""
    lins = averaged(spec, system, frame, theta, eps)
    compressed = compress(spec, system, lins, frame.point.states)
    solved = eliminate_compressed(spec, system, frame.point.noises, frame.point.levels, compressed)
    point = follow(system, frame.point, solved, jnp.zeros_like(frame.point.z))
    return _frame(spec, system, point, averaged(spec, system, frame._replace(point=point), theta, eps))


def _frame(spec: Spec, system: System, point: Point, lins: list[Linearised]) -> Frame:
    """The frame of rows linearised at a point. By the log levels, differences of the marginal log-likelihood."""
    compressed = compress(spec, system, lins, point.states)
    solved = eliminate_compressed(spec, system, point.noises, point.levels, compressed)
    H = point.levels.shape[0]
    sides = _at(spec, system, point, point.levels[None] + _moves(H)) if H else None
    information, score = solved.information, solved.score
    if sides is not None:
        information, score = _with_levels(information, score, sides, H)
    loops = []
    parts = zip(system.recursions, compressed.states, compressed.crosses, strict=True)
    for r, (part, (J, _), cross) in enumerate(parts):
        L = factors(part, point.levels)
        smooth = rec.smooth(part.F, L, J, rec.gains(part.F, L, J), cross)
        states, noises = -smooth.states, -smooth.noises
        slopes: list[jax.Array] = []
        if sides is not None:
            paths = (sides.states[r], sides.noises[r], *sides.loops[r])
            by_x, by_u, *slopes = ((side[:H] - side[H : 2 * H]) / (2 * STEP) for side in paths)
            states = jnp.concatenate([states, jnp.moveaxis(by_x, 0, 2)], 2)
            noises = jnp.concatenate([noises, jnp.moveaxis(by_u, 0, 2)], 2)
        loops.append(Loop(states, noises, *closed_loop(part, L, J), tuple(slopes)))
    height = log_density(spec, system, point) - 0.5 * solved.logdet
    return Frame(point, information, score, height, tuple(loops))


def _moves(H: int) -> np.ndarray:
    """Steps of the log levels (2 H + 1 + H (H - 1), H): each up, each down, none, each pair up and down."""
    one = np.eye(H)
    both = [s * (one[a] + one[b]) for a in range(H) for b in range(a) for s in (1.0, -1.0)]
    return STEP * np.array([*one, *-one, np.zeros(H), *both])


def _with_levels(G: jax.Array, g: jax.Array, sides: _AtLevels, H: int) -> tuple[jax.Array, jax.Array]:
    """Information and score of theta: those of z, bordered by the levels."""
    up, down, middle = sides.value[:H], sides.value[H : 2 * H], sides.value[2 * H]
    slope = (up - down) / (2 * STEP)
    cross = -(sides.score[:H] - sides.score[H : 2 * H]) / (2 * STEP)  # (H, M)
    own = [[jnp.zeros(())] * H for _ in range(H)]
    pairs = iter(range(2 * H + 1, sides.value.shape[0], 2))
    for a in range(H):
        own[a][a] = -(up[a] - 2 * middle + down[a]) / STEP**2
        for b in range(a):
            k = next(pairs)
            straight = up[a] + down[a] + up[b] + down[b]
            own[a][b] = own[b][a] = -(sides.value[k] + sides.value[k + 1] - straight + 2 * middle) / (2 * STEP**2)
    corner = jnp.stack([jnp.stack(row) for row in own])
    # what the levels tell once the biases are found is kept positive: differences are no proof of it
    explained = cross @ linalg.solve_positive(G + 1e-6 * jnp.eye(G.shape[0]), cross.T)
    values, vectors = linalg.spectrum(corner - explained)
    corner = explained + (vectors * jnp.maximum(values, 1.0)[None]) @ vectors.T
    return jnp.block([[G, cross.T], [cross, 0.5 * (corner + corner.T)]]), jnp.concatenate([g, slope])


def place(system: System, frame: Frame, theta: jax.Array, eps: tuple[jax.Array, ...]) -> Point:
    """The point of theta (Q,) and unit normals eps (E, n) of each recursion."""
    M = frame.point.z.shape[0]
    step = theta - frame.theta
    states, noises = [], []
    for part, loop, x, u, e in zip(
        system.recursions, frame.loops, frame.point.states, frame.point.noises, eps, strict=True
    ):
        L = factors(part, frame.point.levels)
        feedback, factor, size = loop.at(step[M:])
        own = jnp.einsum("eij,ej->ei", factor, jnp.exp(size) * e)
        closed, driven = part.F - L @ feedback, jnp.einsum("eij,ej->ei", L, own)

        def forward(deviation: jax.Array, epoch: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array]:
            T_k, s_k = epoch
            following = jnp.sum(T_k * deviation[None, :], 1) + s_k
            return following, deviation

        last, before = jax.lax.scan(forward, jnp.zeros_like(x[0]), (closed, driven))
        deviations = jnp.concatenate([before[1:], last[None]])
        states.append(x + loop.states @ step + deviations)
        noises.append(u + loop.noises @ step + own - jnp.einsum("eij,ej->ei", feedback, before))
    at = Point(tuple(states), tuple(noises), theta[:M], frame.point.levels)
    return at_levels(system, at, theta[M:]) if theta.shape[0] > M else at


def driving(system: System, frame: Frame, point: Point) -> tuple[jax.Array, ...]:
    """The unit normals eps (E, n) of each recursion that `place` makes a consistent point of."""
    step = jnp.concatenate([point.z, point.levels]) - frame.theta
    noises = at_levels(system, point, frame.point.levels).noises
    found = []
    parts = zip(frame.loops, frame.point.states, frame.point.noises, point.states, noises, strict=True)
    for loop, x0, u0, x, u in parts:
        deviations = x - x0 - loop.states @ step
        before = jnp.concatenate([jnp.zeros_like(x[:1]), deviations[:-1]])
        feedback, factor, size = loop.at(step[point.z.shape[0] :])
        own = u - u0 - loop.noises @ step + jnp.einsum("eij,ej->ei", feedback, before)
        solved = linalg.solve_batched(factor @ factor.mT, own)
        found.append(jnp.exp(-size) * jnp.einsum("eji,ej->ei", factor, solved))
    return tuple(found)


def volume(system: System, frame: Frame, theta: jax.Array) -> jax.Array:
    """Log determinant by which `place` spreads eps over the whitened noises at theta (Q,)."""
    levels = theta[frame.point.z.shape[0] :]
    sizes = [jnp.sum(loop.at(levels - frame.point.levels)[2]) for loop in frame.loops]
    return sum(sizes, widening(system, frame.point.levels) - widening(system, levels))


def log_joint(spec: Spec, system: System, frame: Frame, theta: jax.Array, eps: tuple[jax.Array, ...]) -> jax.Array:
    """Log density of data and eps given theta, less that of independent unit normals' constant; -inf if not finite."""
    point = place(system, frame, theta, eps)
    value = log_density(spec, system, point) + volume(system, frame, theta)
    return jnp.where(jnp.isfinite(value), value, -jnp.inf)


def log_weight(spec: Spec, system: System, frame: Frame, theta: jax.Array, eps: tuple[jax.Array, ...]) -> jax.Array:
    """Log of the joint density of data and trajectories over the frame's: zero where the frame is exact."""
    squares = sum(jnp.sum(e**2) for e in eps)
    return log_joint(spec, system, frame, theta, eps) + 0.5 * squares - frame.log_likelihood(theta)
