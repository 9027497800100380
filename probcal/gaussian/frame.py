"""A Gaussian frame of the posterior: coordinates in which biases and trajectories are nearly independent normals.

At a point the trajectories given the biases are Gaussian with a block-tridiagonal precision. They
are written as a response to the biases plus a closed loop driven by independent unit normals `eps`:
u_k = -K_k x_{k-1} + C_k eps_k, the factor of the posterior that a backward information pass gives
(the control form of the Kalman smoother). Where a process noise is unknown the pass is made at some
values of each level, and interpolated: a track that the data hardly hold widens with its process
noise, one that they hold does not, and neither leaves a funnel. theta is the biases z and the log
levels. With the trajectories marginalised the data have a Gaussian log-likelihood of theta. Both
are exact where the problem is linear and Gaussian and no level is unknown; elsewhere `log_weight` says
by how much they are wrong at a point.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal import linalg
from probcal.gaussian import recursion as rec
from probcal.gaussian.information import at_levels
from probcal.gaussian.linearised import linearise_rows
from probcal.gaussian.mode import (
    Eliminated,
    Point,
    eliminate_rows,
    factors,
    follow,
    log_density,
    mixed_density,
    smooth_tracks,
    widening,
)
from probcal.linalg import inverse_cholesky, multiply
from probcal.model.model import Model, Recursion, scaled
from probcal.model.rows import LinearRows
from probcal.model.trajectories import States

STEP = 0.05  # of a log level, for differences
# steps of a log level at which closed loops are known; between them a weight errs by some 0.05 nats
# (`test_a_frame_follows_its_levels`)
LEVELS = np.linspace(-3.5, 3.5, 15)


class Closed(NamedTuple):
    """A closed loop u = shift - feedback x + factor exp(size) eps, u at the levels of the point."""

    feedback: jax.Array  # (E, n, n) K
    factor: jax.Array  # (E, n, n) C with columns of unit diagonal
    size: jax.Array  # (E, n) log of that diagonal
    shift: jax.Array  # (E, n) where the mean of the noises moves with the levels


class Loop(NamedTuple):
    """Trajectories of one recursion given theta: response to the biases, and the closed loop."""

    states: jax.Array  # (E, n, M) response of the states to the biases
    noises: jax.Array  # (E, n, M) response of the whitened noises
    closed: Closed  # at the levels of the point
    by_level: Closed  # at one level moved by each of `LEVELS` (H, L, E, ...); none where the process
    # noise is known: data tell their own noise so well that one loop serves


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

    def normals(self, keys: Any) -> States:
        """Unit normals eps (E, n) of each state layout, each drawn from its own key."""
        return tuple(map(jax.random.normal, keys, [x.shape for x in self.point.states]))

    def log_likelihood(self, theta: jax.Array) -> jax.Array:
        """Gaussian marginal log-likelihood of theta (Q,)."""
        step = theta - self.theta
        return self.height + self.score @ step - 0.5 * step @ (self.information @ step)


def closed_loop(part: Recursion, L: jax.Array, J: jax.Array, score: jax.Array, u: jax.Array) -> Closed:
    """The loop of one recursion with data information J (E, n, n) and score (E, n) at a path of noises u (E, n).

    The information S about x_k from its own and all later data, and its score m, run backwards in the symmetric
    (Joseph) form.
    """
    n = part.F.shape[-1]
    eye = jnp.eye(n, dtype=part.F.dtype)

    def step(ahead: tuple[jax.Array, jax.Array], epoch: tuple[jax.Array, ...]) -> tuple[Any, tuple[jax.Array, ...]]:
        F_k, L_k, J_k, score_k, u_k = epoch
        S, m = J_k + ahead[0], score_k + ahead[1]
        inverse = inverse_cholesky(eye + multiply(L_k.T, multiply(S, L_k)))
        gain = multiply(inverse.T, multiply(inverse, multiply(L_k.T, S)))
        keep = eye - multiply(L_k, gain)
        behind = multiply(keep.T, multiply(S, keep)) + multiply(gain.T, gain)
        behind = multiply(F_k.T, multiply(0.5 * (behind + behind.T), F_k))
        shift = inverse.T @ (inverse @ (L_k.T @ m - u_k))
        return (behind, F_k.T @ (m - S @ (L_k @ shift))), (multiply(gain, F_k), inverse.T, shift)

    last = jnp.zeros_like(eye), jnp.zeros(n, part.F.dtype)
    _, (feedback, factor, shift) = jax.lax.scan(step, last, (part.F, L, J, score, u), reverse=True)
    size = jnp.diagonal(factor, axis1=1, axis2=2)
    return Closed(feedback, factor / size[:, None, :], jnp.log(size), shift)


@jax.jit
def averaged(model: Model, frame: Frame, theta: jax.Array, eps: States) -> LinearRows:
    """Every block linearised at the frame's point, with score and curvature averaged over draws.

    These are the moments of the best Gaussian approximation of the joint posterior (Opper, Archambeau 2009). Draws
    theta (D, Q), eps (D, E, n) are taken with their mirror images, so that what is linear stays exact.
    """

    def at(theta: jax.Array, eps: States) -> tuple[tuple[jax.Array, jax.Array], ...]:
        return model.slopes(place(model, frame, theta, eps))

    def pair(draw: tuple[jax.Array, States]) -> list[tuple[jax.Array, jax.Array]]:
        theta, eps = draw
        mirrored = at(2 * frame.theta - theta, tuple(-e for e in eps))
        return jax.tree.map(lambda a, b: 0.5 * (a + b), at(theta, eps), mirrored)

    means = jax.tree.map(lambda leaf: jnp.mean(leaf, 0), jax.lax.map(pair, (theta, eps)))
    lins = model.linearise(frame.point, expected=True)
    return tuple(
        lin._replace(score=score, weight=jnp.maximum(curvature, 0.0))
        for lin, (score, curvature) in zip(lins, means, strict=True)
    )


def _at(model: Model, point: Point, levels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Marginal log-likelihood (D,) and slope by z (D, M) at levels (D, H), tracks at their mode."""

    def one(levels: np.ndarray) -> tuple[Any, Any]:
        moved = smooth_tracks(model, at_levels(model, point, jax.device_put(levels)))
        solved = eliminate_rows(model, moved, linearise_rows(model, moved))
        return log_density(model, moved) - 0.5 * solved.logdet, solved.score

    values, slopes = zip(*map(one, levels), strict=True)
    return np.array(values), np.array(slopes)


def frame_at(model: Model, point: Point) -> Frame:
    """The frame at a point whose trajectories are at their mode for its biases and levels."""
    return _frame(model, point, linearise_rows(model, point))


def refined(model: Model, frame: Frame, theta: jax.Array, eps: States) -> Frame:
    """The frame with tracks and curvature fitted to draws theta (D, Q), eps (D, E, n) of it."""
    solved = eliminate_rows(model, frame.point, averaged(model, frame, theta, eps))
    point = follow(model, frame.point, solved.parts, jnp.zeros_like(frame.point.z), free=True)
    return _frame(model, point, averaged(model, frame._replace(point=point), theta, eps))


def _frame(model: Model, point: Point, lins: LinearRows) -> Frame:
    """The frame of rows linearised at a point. By the log levels, differences of the marginal log-likelihood."""
    levels = np.asarray(point.levels)
    told = _at(model, point, levels + _moves(len(levels))) if len(levels) else (None, None)
    return _framed(model, point, lins, eliminate_rows(model, point, lins), *told)


@jax.jit
def _framed(model: Model, point: Point, lins: LinearRows, solved: Eliminated, values: Any, slopes: Any) -> Frame:
    H = point.levels.shape[0]
    information, score = solved.information, solved.score
    if H:
        information, score = _with_levels(information, score, values, slopes, H)
    shares = [
        model.of_states(scaled(lins, [data.level == h for data in model.rows])) for h in range(H if model.driven else 0)
    ]
    loops = []
    for r, (part, kept) in enumerate(model.each_layout(solved.parts)):
        smooth = rec.smooth(part.F, kept.gain, kept.cross)
        closed = closed_loop(part, factors(part, point.levels), kept.J, kept.pull, point.noises[r])
        closed = closed._replace(shift=jnp.zeros_like(kept.pull))  # the point is the mean, by definition
        own = jax.tree.map(lambda *each: jnp.stack(each), *[share[r] for share in shares]) if shares else None
        by_level = _at_levels(part, point.levels, kept.J, kept.pull, own, point.noises[r])
        loops.append(Loop(-smooth.states, -smooth.noises, closed, by_level))
    height = log_density(model, point) - 0.5 * solved.logdet
    return Frame(point, information, score, height, tuple(loops))


def _at_levels(part: Recursion, levels: jax.Array, J: jax.Array, score: jax.Array, shares: Any, u: jax.Array) -> Closed:
    """The loops of one recursion where a level is moved; `shares` of J and score have its noise."""
    H = 0 if shares is None else levels.shape[0]

    def at(step: jax.Array) -> Closed:
        less = jnp.expm1(-2 * step)
        data, pull = (whole + jnp.tensordot(less, own, 1) for whole, own in zip((J, score), shares, strict=True))
        return closed_loop(part, factors(part, levels + step), data, pull, u / jnp.exp(_wider(part, step)))

    if H == 0:
        none = jnp.zeros((0, len(LEVELS), *u.shape), u.dtype)
        return Closed(none, none, none, none)
    steps = jnp.asarray(np.eye(H)[:, None, :] * LEVELS[None, :, None]).reshape(-1, H)
    return jax.tree.map(lambda leaf: leaf.reshape(H, len(LEVELS), *leaf.shape[1:]), jax.lax.map(at, steps))


def _wider(part: Recursion, step: jax.Array) -> jax.Array:
    """The growth of the log of each noise (E, n) of a recursion where log levels (H,) move."""
    return jnp.concatenate([step, jnp.zeros(1)])[part.level]


def _moves(H: int) -> np.ndarray:
    """Steps of the log levels (2 H + 1 + H (H - 1), H): each up, each down, none, each pair up and down."""
    one = np.eye(H)
    both = [s * (one[a] + one[b]) for a in range(H) for b in range(a) for s in (1.0, -1.0)]
    return STEP * np.array([*one, *-one, np.zeros(H), *both])


def _with_levels(
    G: jax.Array, g: jax.Array, values: jax.Array, slopes: jax.Array, H: int
) -> tuple[jax.Array, jax.Array]:
    """Information and score of theta: those of z, bordered by the levels, from log-likelihoods at `_moves`."""
    up, down, middle = values[:H], values[H : 2 * H], values[2 * H]
    slope = (up - down) / (2 * STEP)
    cross = -(slopes[:H] - slopes[H : 2 * H]) / (2 * STEP)  # (H, M)
    own = [[jnp.zeros(())] * H for _ in range(H)]
    pairs = iter(range(2 * H + 1, values.shape[0], 2))
    for a in range(H):
        own[a][a] = -(up[a] - 2 * middle + down[a]) / STEP**2
        for b in range(a):
            k = next(pairs)
            straight = up[a] + down[a] + up[b] + down[b]
            own[a][b] = own[b][a] = -(values[k] + values[k + 1] - straight + 2 * middle) / (2 * STEP**2)
    corner = jnp.stack([jnp.stack(row) for row in own])
    # what the levels tell once the biases are found is kept positive: differences are no proof of it
    explained = cross @ linalg.solve_positive(G + 1e-6 * jnp.eye(G.shape[0]), cross.T)
    corner = explained + linalg.without_negative(corner - explained, 1.0)
    return jnp.block([[G, cross.T], [cross, 0.5 * (corner + corner.T)]]), jnp.concatenate([g, slope])


def _closed(model: Model, frame: Frame, theta: jax.Array) -> list[Closed]:
    """The closed loops of all recursions at the levels of theta (Q,), cubic between known ones."""
    step = theta[frame.point.z.shape[0] :] - frame.point.levels
    if frame.loops[0].by_level.size.shape[0] == 0:
        return [loop.closed for loop in frame.loops]
    last = len(LEVELS) - 2
    place = jnp.clip((step - LEVELS[0]) / (LEVELS[1] - LEVELS[0]), 1, last)
    first = jnp.minimum(place.astype(int), last - 1) - 1
    t = place - first - 1
    cubic = jnp.array([[0.0, -0.5, 1.0, -0.5], [1.0, 0.0, -2.5, 1.5], [0.0, 0.5, 2.0, -1.5], [0.0, 0.0, -0.5, 0.5]])
    weight = jnp.stack([t**0, t, t**2, t**3], 1) @ cubic.T  # (H, 4), by Catmull and Rom

    def closed(part: Recursion, loop: Loop) -> Closed:
        def at(leaf: jax.Array) -> jax.Array:
            near = [jax.lax.dynamic_slice_in_dim(own, k, 4) for own, k in zip(leaf, first, strict=True)]
            moved = sum(jnp.tensordot(w, own, 1) for w, own in zip(weight, near, strict=True))
            return moved - (len(near) - 1) * leaf[0, len(LEVELS) // 2]

        own = Closed(*map(at, loop.by_level))
        wider = _wider(part, step)
        ratio = jnp.exp(wider)
        column = ratio[:, :, None]
        return Closed(column * own.feedback, own.factor * column / column.mT, own.size + wider, ratio * own.shift)

    return list(model.each(closed, frame.loops))


def place(model: Model, frame: Frame, theta: jax.Array, eps: States) -> Point:
    """The point of theta (Q,) and unit normals eps (E, n) of each recursion."""
    return _placed(model, frame, theta, eps, _closed(model, frame, theta))


def _placed(model: Model, frame: Frame, theta: jax.Array, eps: States, loops: list[Closed]) -> Point:
    M = frame.point.z.shape[0]
    step = theta[:M] - frame.point.z

    def placed(
        x: jax.Array, u: jax.Array, part: Recursion, loop: Loop, at: Closed, e: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        L = factors(part, frame.point.levels)
        own = at.shift + jnp.einsum("eij,ej->ei", at.factor, jnp.exp(at.size) * e)

        def forward(deviation: jax.Array, epoch: tuple[jax.Array, ...]) -> tuple[jax.Array, Any]:
            F_k, L_k, K_k, own_k = epoch
            driven = own_k - jnp.sum(K_k * deviation[None, :], 1)
            deviation = jnp.sum(F_k * deviation[None, :], 1) + jnp.sum(L_k * driven[None, :], 1)
            return deviation, (deviation, driven)

        _, (deviations, driven) = jax.lax.scan(forward, jnp.zeros_like(x[0]), (part.F, L, at.feedback, own))
        return x + loop.states @ step + deviations, u + loop.noises @ step + driven

    tracks = frame.point.trajectories.map(placed, model.recursions, frame.loops, loops, eps)
    point = Point(tracks, theta[:M], frame.point.levels)
    return at_levels(model, point, theta[M:]) if theta.shape[0] > M else point


def unit_normals(model: Model, frame: Frame, point: Point) -> States:
    """The unit normals eps (E, n) of each recursion that `place` makes a consistent point of."""
    step = point.z - frame.point.z
    away = jax.tree.map(
        jnp.subtract, at_levels(model, point, frame.point.levels).trajectories, frame.point.trajectories
    )

    def normals(_: Recursion, loop: Loop, at: Closed, dx: jax.Array, du: jax.Array) -> jax.Array:
        deviations = dx - loop.states @ step
        fed = jnp.einsum("eij,ej->ei", at.feedback, linalg.preceding(deviations))
        own = du - loop.noises @ step - at.shift + fed
        solved = linalg.solve_batched(at.factor @ at.factor.mT, own)
        return jnp.exp(-at.size) * jnp.einsum("eji,ej->ei", at.factor, solved)

    return model.each(normals, frame.loops, _closed(model, frame, jnp.concatenate([point.z, point.levels])), *away)


def volume(model: Model, frame: Frame, theta: jax.Array) -> jax.Array:
    """Log determinant by which `place` spreads eps over the whitened noises at theta (Q,)."""
    return _volume(model, frame, theta, _closed(model, frame, theta))


def _volume(model: Model, frame: Frame, theta: jax.Array, loops: list[Closed]) -> jax.Array:
    change = widening(model, frame.point.levels) - widening(model, theta[frame.point.z.shape[0] :])
    return sum((jnp.sum(at.size) for at in loops), change)


def log_joint(model: Model, frame: Frame, theta: jax.Array, eps: States) -> jax.Array:
    """Log density of data and eps given theta, up to the constant of eps; -inf if not finite."""
    loops = _closed(model, frame, theta)
    point = _placed(model, frame, theta, eps, loops)
    value = mixed_density(model, point) + _volume(model, frame, theta, loops)
    return jnp.where(jnp.isfinite(value), value, -jnp.inf)


def log_weight(model: Model, frame: Frame, theta: jax.Array, eps: States) -> jax.Array:
    """Log of the joint density of data and trajectories over the frame's: zero where the frame is exact."""
    squares = sum(jnp.sum(e**2) for e in eps)
    return log_joint(model, frame, theta, eps) + 0.5 * squares - frame.log_likelihood(theta)
