"""The joint mode of trajectories and biases: an arrowhead Gauss-Newton system, each trajectory eliminated first.

With every trajectory marginalised, the biases have information G - B' W^-1 B, W the precision of the
trajectories: Paper B (17) with the covariance of whole trajectories in the place of R-bar.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from probcal import linalg, rows
from probcal.priors import Precision
from probcal.problem import Recursion, Spec, System
from probcal.rows import Linearised
from probcal.smoothing import recursion as rec

HALVINGS = 12  # step lengths tried before the damping grows
DAMPING = 1e10  # damping at which the iteration gives up
ROUNDING = 1e-12  # of the cost: what a step that promises less cannot show


class Point(NamedTuple):
    """Where the joint density is evaluated: states and whitened noises of each recursion, biases, log levels."""

    states: tuple[jax.Array, ...]  # (E, n) each
    noises: tuple[jax.Array, ...]  # (E, n) each
    z: jax.Array  # (M,)
    levels: jax.Array  # (H,)


class Compressed(NamedTuple):
    """Rows compressed by epoch; linear in the rows, so that compressed systems can be added and averaged."""

    information: jax.Array  # (M, M) of the biases at fixed trajectories
    score: jax.Array  # (M,)
    states: tuple[tuple[jax.Array, jax.Array], ...]  # of each recursion: J (E, n, n), score (E, n)
    crosses: tuple[jax.Array, ...]  # (E, n, M) cross information with the biases


class Eliminated(NamedTuple):
    """The system with all trajectories eliminated: what a step, a covariance or an evidence needs."""

    information: jax.Array  # (M, M) of the biases
    score: jax.Array  # (M,)
    pull: jax.Array  # (M,) the score at fixed trajectories
    logdet: jax.Array  # log det of the posterior precision of all whitened noises
    parts: tuple["Kept", ...]  # of each recursion, what a step of its states needs


class Kept(NamedTuple):
    """What elimination keeps of one recursion."""

    J: jax.Array  # (E, n, n) information of the rows about the states
    pull: jax.Array  # (E, n) their score
    cross: jax.Array  # (E, n, M) cross information with the biases
    gain: rec.Gains


def factors(part: Recursion, levels: jax.Array) -> jax.Array:
    """Noise factors with the estimated levels, (E, n, n)."""
    scale = jnp.concatenate([jnp.exp(levels), jnp.ones(1, levels.dtype)])[part.level]
    return part.L * scale[:, None, :]


def log_likelihood(spec: Spec, system: System, point: Point) -> jax.Array:
    """Log-likelihood of all data at a point."""
    total = jnp.zeros(())
    for block, data, r in zip(spec.blocks, system.rows, spec.recursion, strict=True):
        predicted = rows.predict(block, data, point.states[r], point.z)
        total = total + jnp.sum(rows.log_likelihood(block, data, predicted, point.levels))
    return total


def log_density(spec: Spec, system: System, point: Point) -> jax.Array:
    """Log density of data and whitened noises given biases and levels, up to the constant of the noises."""
    return log_likelihood(spec, system, point) - 0.5 * sum(jnp.sum(u**2) for u in point.noises)


def widening(system: System, levels: jax.Array) -> jax.Array:
    """Log determinant by which the levels widen the noises that they multiply."""
    levels = jnp.concatenate([levels, jnp.zeros(1, levels.dtype)])
    parts = [jnp.sum(jnp.any(part.L != 0, 1) * levels[part.level]) for part in system.recursions]
    return sum(parts, jnp.zeros(()))


def cost(spec: Spec, system: System, point: Point, prior: Precision) -> jax.Array:
    """Negative log joint density of data, trajectories, biases and unknown levels, up to constants."""
    known = prior.square(point.z) + jnp.sum((point.levels / system.level_spread) ** 2)
    return 0.5 * known + widening(system, point.levels) - log_density(spec, system, point)


def linearise(spec: Spec, system: System, point: Point, *, expected: bool) -> list[Linearised]:
    """Every block linearised at a point, with step weights or the expected information."""
    return [
        rows.linearise(block, data, point.states[r], point.z, point.levels, expected=expected)
        for block, data, r in zip(spec.blocks, system.rows, spec.recursion, strict=True)
    ]


def of_states(
    spec: Spec, system: System, lins: list[Linearised], states: tuple[jax.Array, ...]
) -> list[tuple[jax.Array, jax.Array]]:
    """Rows compressed onto the states: information J (E, n, n) and score (E, n) of each recursion."""
    parts = [(jnp.zeros((*x.shape, x.shape[1])), jnp.zeros(x.shape)) for x in states]
    for block, data, lin, r in zip(spec.blocks, system.rows, lins, spec.recursion, strict=True):
        used, E = jnp.asarray(block.used, int), states[r].shape[0]
        J = jax.ops.segment_sum(jnp.einsum("ncu,nc,ncv->nuv", lin.state, lin.weight, lin.state), data.epoch, E)
        score = jax.ops.segment_sum(jnp.einsum("ncu,nc->nu", lin.state, lin.score), data.epoch, E)
        before = parts[r]
        parts[r] = (before[0].at[:, used[:, None], used[None, :]].add(J), before[1].at[:, used].add(score))
    return parts


def of_biases(spec: Spec, system: System, lins: list[Linearised]) -> tuple[jax.Array, jax.Array]:
    """Rows compressed onto the biases at fixed trajectories: information (M, M) and score (M,) (Paper C 35-36)."""
    M = spec.biases
    G, g = jnp.zeros((M + 1, M + 1)), jnp.zeros(M + 1)
    for data, lin in zip(system.rows, lins, strict=True):
        S = data.bias.shape[0]
        own = jax.ops.segment_sum(jnp.einsum("ncp,nc,ncq->npq", lin.bias, lin.weight, lin.bias), data.sensor, S)
        pull = jax.ops.segment_sum(jnp.einsum("ncp,nc->np", lin.bias, lin.score), data.sensor, S)
        G = G.at[data.bias[:, :, None], data.bias[:, None, :]].add(own)
        g = g.at[data.bias].add(pull)
    return G[:M, :M], g[:M]


def of_both(spec: Spec, system: System, lins: list[Linearised], states: tuple[jax.Array, ...]) -> list[jax.Array]:
    """Cross information of states and biases, (E, n, M) of each recursion."""
    M = spec.biases
    parts = [jnp.zeros((*x.shape, M)) for x in states]
    for block, data, lin, r in zip(spec.blocks, system.rows, lins, spec.recursion, strict=True):
        weighted = jnp.einsum("ncp,nc,ncu->npu", lin.bias, lin.weight, lin.state)
        summed = jnp.zeros((states[r].shape[0], M + 1, len(block.used)))
        summed = summed.at[data.epoch[:, None], data.bias[data.sensor]].add(weighted)
        parts[r] = parts[r].at[:, jnp.asarray(block.used, int)].add(summed[:, :M].mT)
    return parts


def eliminate(spec: Spec, system: System, point: Point, *, expected: bool, joint: bool = True) -> Eliminated:
    """Linearise at a point and eliminate every trajectory; without `joint` the biases are held."""
    return eliminate_rows(spec, system, point, linearise(spec, system, point, expected=expected), joint=joint)


def eliminate_rows(
    spec: Spec, system: System, point: Point, lins: list[Linearised], *, joint: bool = True
) -> Eliminated:
    """Eliminate every trajectory from rows linearised around a point by any rule."""
    compressed = compress(spec, system, lins, point.states, joint=joint)
    return eliminate_compressed(spec, system, point.noises, point.levels, compressed, joint=joint)


def compress(
    spec: Spec, system: System, lins: list[Linearised], states: tuple[jax.Array, ...], *, joint: bool = True
) -> Compressed:
    """Rows compressed onto states and biases; without `joint` the biases are held and have no columns."""
    own = tuple(of_states(spec, system, lins, states))
    if joint:
        return Compressed(*of_biases(spec, system, lins), own, tuple(of_both(spec, system, lins, states)))
    crosses = tuple(jnp.zeros((*x.shape, 0)) for x in states)
    return Compressed(jnp.zeros((0, 0)), jnp.zeros(0), own, crosses)


def eliminate_compressed(
    spec: Spec,
    system: System,
    noises: tuple[jax.Array, ...],
    levels: jax.Array,
    compressed: Compressed,
    *,
    joint: bool = True,
) -> Eliminated:
    """Eliminate every trajectory of whitened noises (E, n) from compressed rows.

    The biases keep information G - B'W^-1 B: Paper B (17) with the covariance of whole trajectories for R-bar.
    """
    information, score = compressed.information, compressed.score
    kept, logdet = [], jnp.zeros(())
    parts = zip(system.recursions, compressed.states, compressed.crosses, noises, strict=True)
    for r, (part, (J, pull), cross, u) in enumerate(parts):
        L = factors(part, levels)
        gain = rec.gains(part.F, L, J)
        used = tuple(
            sorted({i for b, own in zip(spec.blocks, spec.recursion, strict=True) if own == r for i in b.used})
        )
        if joint and used:
            columns = jnp.concatenate([pull[:, :, None], cross], 2)
            drift = jnp.zeros_like(columns).at[:, :, 0].set(-(L @ u[:, :, None])[:, :, 0])
            alone, new = (c.reshape(-1, c.shape[2]) for c in rec.innovate(part.F, J, gain, columns, drift, used))
            rows_ = jnp.concatenate([alone, new])
            signed = jnp.concatenate([-alone, new])
            information = information + linalg.gram(rows_[:, 1:], signed[:, 1:])
            score = score + signed[:, 1:].T @ rows_[:, 0]
        kept.append(Kept(J, pull, cross, gain))
        logdet = logdet + gain.logdet
    information = 0.5 * (information + information.T)
    return Eliminated(information, score, compressed.score, logdet, tuple(kept))


def _proposal(
    spec: Spec, system: System, point: Point, prior: Precision, damping: jax.Array, joint: bool
) -> tuple[Point, jax.Array]:
    """Full Gauss-Newton step from a point, and the decrease of the cost that it promises."""
    solved = eliminate(spec, system, point, expected=False, joint=joint)
    dz = jnp.zeros_like(point.z)
    if joint and spec.biases:  # an arrowhead: the tip first, then the trajectories follow
        matrix = solved.information + prior.matrix() + damping * jnp.eye(spec.biases)
        dz = linalg.solve_positive(matrix, solved.score - prior.pull(point.z))
    proposal = follow(system, point, solved, dz)
    slope = -prior.pull(point.z) @ dz
    slope = slope + (solved.pull @ dz if joint and spec.biases else 0.0)
    for kept, x, new, u, moved in zip(
        solved.parts, point.states, proposal.states, point.noises, proposal.noises, strict=True
    ):
        slope = slope + jnp.sum(kept.pull * (new - x)) - jnp.sum(u * (moved - u))
    return proposal, 0.5 * slope


def follow(system: System, point: Point, solved: Eliminated, dz: jax.Array) -> Point:
    """Move the biases by dz (M,) and every trajectory to its smoothed response."""
    states, noises = [], []
    for part, kept, x, u in zip(system.recursions, solved.parts, point.states, point.noises, strict=True):
        L = factors(part, point.levels)
        column = kept.pull - kept.cross @ dz[: kept.cross.shape[2]]
        smooth = rec.smooth(part.F, L, kept.J, kept.gain, column[:, :, None], -(L @ u[:, :, None]))
        states.append(x + smooth.states[:, :, 0])
        noises.append(smooth.noises[:, :, 0])
    return point._replace(states=tuple(states), noises=tuple(noises), z=point.z + dz)


def between(a: Point, b: Point, t: jax.Array) -> Point:
    """Point a + t (b - a); consistent trajectories stay consistent."""
    return jax.tree.map(lambda p, q: p + t * (q - p), a, b)


class _Search(NamedTuple):
    point: Point
    cost: jax.Array
    damping: jax.Array
    change: jax.Array
    still: jax.Array  # no step lowers the cost, and none promised to
    moved: jax.Array  # some step lowered the cost
    iteration: jax.Array
    done: jax.Array


class Mode(NamedTuple):
    """Outcome of a search for the mode."""

    point: Point
    cost: jax.Array
    iterations: jax.Array
    converged: jax.Array
    refused: jax.Array  # every step was refused though it promised a lower cost: the start is no mode


@partial(jax.jit, static_argnames=("spec", "joint"))
def find_mode(
    spec: Spec, system: System, start: Point, prior: Precision, iterations: int, tolerance: float, *, joint: bool = True
) -> Mode:
    """Damped Gauss-Newton (iterated EKS, with the biases if `joint`) until the cost changes by less than `tolerance`.

    The start must be a consistent trajectory (states made of its whitened noises). A step that does not
    lower the cost, or reaches a non-finite one, is halved, then damped. It has converged too where no step lowers
    the cost and the first promised less than `tolerance`, or than the rounding of the cost.
    """

    def body(s: _Search) -> _Search:
        proposal, promised = _proposal(spec, system, s.point, prior, s.damping, joint)

        def shorter(state):
            t, _, tries = state
            t = jnp.where(tries == 0, 1.0, 0.5 * t)
            return t, cost(spec, system, between(s.point, proposal, t), prior), tries + 1

        def worse(state):
            _, value, tries = state
            return (tries == 0) | (~(value <= s.cost) & (tries < HALVINGS))

        t, value, tries = jax.lax.while_loop(worse, shorter, (jnp.ones(()), s.cost, 0))
        better = value <= s.cost
        point = jax.tree.map(lambda new, old: jnp.where(better, new, old), between(s.point, proposal, t), s.point)
        damping = jnp.where(better & (tries <= 2), s.damping * 0.1, jnp.maximum(s.damping * 10.0, 1e-3))
        damping = jnp.where(damping < 1e-6, 0.0, damping)
        change = jnp.where(better, s.cost - value, jnp.inf)
        small = jnp.abs(promised) <= jnp.maximum(tolerance, ROUNDING * jnp.abs(s.cost))
        still = ~better & (s.damping <= 1.0) & small & jnp.isfinite(s.cost)
        done = (better & (change < tolerance) & (s.damping <= 1.0)) | (damping > DAMPING) | still
        moved = s.moved | (better & (change > 0))
        return _Search(point, jnp.where(better, value, s.cost), damping, change, still, moved, s.iteration + 1, done)

    first = _Search(
        start,
        cost(spec, system, start, prior),
        jnp.zeros(()),
        jnp.full((), jnp.inf, float),
        jnp.zeros((), bool),
        jnp.zeros((), bool),
        jnp.zeros((), int),
        jnp.zeros((), bool),
    )
    last = jax.lax.while_loop(lambda s: ~s.done & (s.iteration < iterations), body, first)
    converged = last.done & ((last.change < tolerance) | last.still)
    return Mode(last.point, last.cost, last.iteration, converged, ~last.moved & ~converged)


def track(spec: Spec, system: System, point: Point, iterations: int = 20) -> Point:
    """Trajectories at the point's biases: iterated EKS."""
    flat = Precision.single(jnp.zeros_like(point.z))
    return find_mode(spec, system, point, flat, iterations, 1e-6, joint=False).point
