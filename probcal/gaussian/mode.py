"""The joint mode of trajectories and biases: an arrowhead Gauss-Newton system, each trajectory eliminated first.

With every trajectory marginalised, the biases have information G - B' W^-1 B, W the precision of the
trajectories: Paper B (17) with the covariance of whole trajectories in the place of R-bar.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal import linalg
from probcal.gaussian import recursion as rec
from probcal.gaussian.room import check_room
from probcal.gaussian.search import DAMPING, ROUNDING, between, branch, damped_on, halved, looped, quiet, zeros_from
from probcal.gaussian.solves import Dense
from probcal.linalg import library
from probcal.model.model import At, Model, Recursion, Tail, Where
from probcal.model.rows import Linearised, LinearRows, level_factors
from probcal.model.trajectories import States, Trajectories
from probcal.priors import Precision

CHORD = 0.1  # share of the last gain up to which what was eliminated serves on
TRACK_STEPS = 30  # of tracks at held biases
SETTLED = 1e-10  # nats at which they end: log det W moves with the trajectories to first order
apart = jax.lax.optimization_barrier  # keeps XLA from weaving two computations together, or doing one of them twice


class _Point(NamedTuple):
    trajectories: Trajectories
    z: jax.Array  # (M,) biases in units of their scales
    levels: jax.Array  # (H,) log factors of the unknown noise levels


class Point(_Point):
    """The trajectories, biases and log levels where the joint density is evaluated; a pytree.

    It is also made of states, noises, biases and levels.
    """

    def __new__(cls, *fields: Any) -> "Point":
        """The point of three fields, or of four: states and noises apart."""
        return super().__new__(cls, *(fields if len(fields) == 3 else (Trajectories(*fields[:2]), *fields[2:])))

    @property
    def states(self) -> tuple[Any, ...]:
        """States (E, n) of each state layout."""
        return self.trajectories.states

    @property
    def noises(self) -> tuple[Any, ...]:
        """Whitened noises (E, n) of each state layout."""
        return self.trajectories.noises

    def _replace(self, **fields: Any) -> "Point":
        """The point with other fields; states and noises may be named too."""
        own = {name: fields.pop(name) for name in Trajectories._fields if name in fields}
        whole = {"trajectories": self.trajectories._replace(**own), "z": self.z, "levels": self.levels}
        return Point(*(whole | fields).values())


class Compressed(NamedTuple):
    """Rows compressed by epoch; linear in the rows, so that compressed systems can be added and averaged."""

    information: jax.Array  # (M, M) of the biases at fixed trajectories
    score: jax.Array  # (M,)
    states: tuple[tuple[jax.Array, jax.Array], ...]  # of each recursion: J (E, n, n), score (E, n)
    crosses: States  # (E, n, M) cross information with the biases


class Eliminated(NamedTuple):
    """The system with all trajectories eliminated: what a step, a covariance or an evidence needs."""

    information: jax.Array  # (M, M) of the biases
    score: jax.Array  # (M,)
    pull: jax.Array  # (M,) the score at fixed trajectories
    logdet: jax.Array  # log det of the posterior precision of all whitened noises
    parts: tuple["Kept", ...]  # of each recursion, what a step of its states needs


class Kept(NamedTuple):
    """The quantities that elimination keeps for one recursion."""

    J: jax.Array  # (E, n, n) information of the rows about the states
    pull: jax.Array  # (E, n) their score
    cross: jax.Array  # (E, n, M) cross information with the biases
    gain: rec.Gains


@partial(jax.jit, inline=True)  # one kernel where it stands alone
def factors(part: Recursion, levels: jax.Array) -> jax.Array:
    """Noise factors with the estimated levels, and the precisions of noise that is not Gaussian, (E, n, n)."""
    scale = level_factors(levels)[part.level]
    scale = scale / jnp.sqrt(part.weight) if part.tails else scale
    return part.L * scale[:, None, :]


@partial(jax.jit, inline=True)
def inverse_factors(part: Recursion, levels: jax.Array) -> jax.Array:
    """Pseudo-inverse (E, n, n) of the noise factors at log levels (H,): 0 where no noise drives."""
    L = factors(part, levels)
    return jax.vmap(linalg.regress_rows, (None, 0))(jnp.eye(L.shape[1]), L)[0]


@partial(jax.jit, inline=True)
def noises_of(part: Recursion, levels: jax.Array, states: jax.Array) -> jax.Array:
    """The shortest whitened noises (E, n) that drive states (E, n) of one recursion without drift."""
    before = linalg.preceding(states)
    left = states - jnp.einsum("eij,ej->ei", part.F, before)
    return jnp.einsum("eij,ej->ei", inverse_factors(part, levels), left)


@partial(jax.jit, inline=True)
def driven_states(part: Recursion, levels: jax.Array, noises: jax.Array) -> jax.Array:
    """States (E, n) of one recursion that whitened noises (E, n) drive at log levels (H,)."""
    path = rec.trajectory(part.F, factors(part, levels), part.drift[:, :, None], noises[:, :, None])
    return path[:, :, 0]


def log_likelihood(model: Model, point: Where) -> jax.Array:
    """Log-likelihood of all data at a point, with the tilt of the model."""
    return sum((jnp.sum(part) for part in model.log_likelihood(point)), _tilt(model, point))


def log_density(model: Model, point: Point) -> jax.Array:
    """Log density of data and whitened noises given biases and levels, up to the constant of the noises.

    Noise that is not Gaussian has the precisions of the model here; `mixed_density` integrates them.
    The host adds the costs of tracks, a kernel that their search uses too.
    """
    if library(*jax.tree.leaves((model, point))) is np:
        costs, _ = part_way(model, point, point, np.zeros(sum(model.targets)))
        return _tilt(model, point) - np.asarray(costs).sum()
    return log_likelihood(model, point) - 0.5 * point.trajectories.square


def _tilt(model: Model, point: Where) -> Any:
    """The log density of integrated places at a point."""
    return np.zeros(()) if model.tilt is None else model.tilt.value(point.z)


def mixed_density(model: Model, point: Point) -> jax.Array:
    """`log_density` with the precisions of noise that is not Gaussian integrated, of noises whitened by those."""
    value = log_density(model, point)
    for part, u in model.each_layout(point.noises):
        for tail in part.tails:
            square = tail.squares(u)
            own = tail.family.mixing_density(square, tail.size) - 0.5 * square - 0.5 * tail.size * jnp.log(tail.weight)
            given = 0.5 * jnp.sum(u[:, slice(*tail.columns)] ** 2, 1)
            value = value + jnp.sum(jnp.where(tail.on, own + given, 0.0))
    return value


def mixing_gain(model: Model) -> Any:
    """The variational bound less the evidence at the mean precisions, for uncertain precisions.

    With q(trajectory) q(w), log p(data) is at least the evidence at E w and this sum (Ting, Theodorou, Schaal 2007).
    """
    return sum((_mixing_gain(tail) for part in model.recursions for tail in part.tails), np.zeros(()))


@jax.jit
def _mixing_gain(tail: Tail) -> jax.Array:
    return jnp.sum(jnp.where(tail.on, tail.family.mixing_gain(tail.weight, tail.size), 0.0))


def widening(model: Model, levels: jax.Array) -> Any:
    """Log determinant by which the levels widen the noises that they multiply."""
    xp = library(levels, *jax.tree.leaves(model.recursions))
    levels, parts = xp.concatenate([xp.asarray(levels), np.zeros(1)]), list[Any]()
    for part in model.recursions if model.driven else ():
        parts.append((xp.asarray(part.L) != 0).any(1) * levels[xp.asarray(part.level)])
    parts += [-0.5 * tail.size * xp.log(tail.weight) for part in model.recursions for tail in part.tails]
    return sum((xp.sum(part) for part in parts), np.zeros(()))


def level_square(model: Model, levels: jax.Array) -> jax.Array:
    """Sum of squares of log levels (H,) over their spreads."""
    xp = library(levels, model.level_spread)
    return ((xp.asarray(levels) / xp.asarray(model.level_spread)) ** 2).sum()


@quiet
def cost(model: Model, point: Point, prior: Precision) -> jax.Array:
    """Negative log joint density of data, trajectories, biases and unknown levels, up to constants."""
    return _known(model, point, prior) - log_density(model, point)


def _known(model: Model, point: Point, prior: Precision) -> jax.Array:
    """The part of the cost that no data tell."""
    known = prior.square(point.z) + level_square(model, point.levels)
    return 0.5 * known + widening(model, point.levels)


def eliminate(model: Model, point: Point, *, expected: bool, joint: bool = True) -> Eliminated:
    """Linearise at a point and eliminate every trajectory; without `joint` the biases are held."""
    return eliminate_rows(model, point, rows_at(model, point, expected), joint=joint)


@jax.jit
def rows_at(model: Model, point: Where, expected: Any) -> LinearRows:
    """All rows linearised at a point, a kernel for step weights and for the expected information."""
    return model.linearise(point, expected=expected)


def eliminate_rows(model: Model, point: Point, lins: Sequence[Linearised], *, joint: bool = True) -> Eliminated:
    """Eliminate every trajectory from rows linearised around a point by any rule."""
    compressed = compress_rows(model, point.z, tuple(lins), joint)
    return eliminate_compressed(model, point.noises, point.levels, compressed, joint=joint)


@partial(jax.jit, static_argnames="joint")
def compress_rows(model: Model, z: jax.Array, lins: LinearRows, joint: bool) -> Compressed:
    """Rows compressed onto states and biases, with the tilt of the model at z."""
    compressed = compress(model, lins, joint=joint)
    return tilted(model, z, compressed) if joint else compressed


def compress(model: Model, lins: Sequence[Linearised], *, joint: bool = True) -> Compressed:
    """Rows compressed onto states and biases; without `joint` the biases are held and have no columns."""
    if joint:
        check_room(model)
        # one after the other: woven into one loop over the rows they take three times as long
        lins, (information, score) = apart((tuple(lins), model.of_biases(tuple(lins))))
        lins, states = apart((lins, tuple(model.of_states(lins))))
        return Compressed(information, score, states, tuple(model.of_both(lins)))
    own = tuple(model.of_states(lins))
    crosses = tuple(jnp.zeros((*part.drift.shape, 0)) for part in model.recursions)
    return Compressed(jnp.zeros((0, 0)), jnp.zeros(0), own, crosses)


def tilted(model: Model, z: jax.Array, compressed: Compressed) -> Compressed:
    """Compressed rows with the tilt of the model at z."""
    if model.tilt is None:
        return compressed
    own = model.tilt.times(jnp.eye(model.biases))
    information, score = compressed.information + own, compressed.score + model.tilt.pull(z)
    return compressed._replace(information=information, score=score)


def eliminate_compressed(
    model: Model,
    noises: States,
    levels: jax.Array,
    compressed: Compressed,
    *,
    joint: bool = True,
) -> Eliminated:
    """Eliminate every trajectory of whitened noises (E, n) from compressed rows.

    The biases keep information G - B'W^-1 B: Paper B (17) with the covariance of whole trajectories for R-bar.
    """
    kept = kept_of(model, levels, compressed)
    information, score, logdet = _eliminated(model, noises, levels, compressed[:2], kept, joint)
    return Eliminated(information, score, compressed.score, logdet, kept)


def kept_of(model: Model, levels: jax.Array, compressed: Compressed) -> tuple[Kept, ...]:
    """The quantities that eliminating trajectories at log levels (H,) keeps for each recursion."""
    parts = model.each_layout(compressed.states, compressed.crosses)
    return tuple(
        Kept(J, pull, cross, gains_of(part, levels, J, model.entries(r)))
        for r, (part, (J, pull), cross) in enumerate(parts)
    )


@partial(jax.jit, static_argnames="used")
def gains_of(part: Recursion, levels: jax.Array, J: jax.Array, used: tuple[int, ...]) -> rec.Gains:
    """The covariance pass of a recursion, a kernel that models with other biases share."""
    return rec.gains(part.F, factors(part, levels), J, used)


@partial(jax.jit, static_argnames="joint")
def _eliminated(
    model: Model,
    noises: States,
    levels: jax.Array,
    told: tuple[jax.Array, jax.Array],
    parts: tuple[Kept, ...],
    joint: bool,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Information and score without the trajectories, and the log determinant of their precision."""
    (information, score), logdet = told, jnp.zeros(())
    for r, (part, kept, u) in enumerate(model.each_layout(parts, noises)):
        if joint and model.entries(r):
            alone, new = _stacked(rec.innovate(part.F, kept.gain, kept.cross))
            drift = -(factors(part, levels) @ u[:, :, None])
            y, innovation = _stacked(rec.innovate(part.F, kept.gain, kept.pull[:, :, None], drift))
            information = information + linalg.gram_less(new, alone)
            score = score + new.T @ innovation[:, 0] - alone.T @ y[:, 0]
        logdet = logdet + kept.gain.logdet
    return 0.5 * (information + information.T), score, logdet


def _stacked(columns: tuple[jax.Array, jax.Array]) -> list[jax.Array]:
    """Columns (E, u, m) of all epochs below each other (E u, m)."""
    return [own.reshape(own.shape[0] * own.shape[1], own.shape[2]) for own in columns]


@jax.jit
def _direction(solved: Eliminated, z: jax.Array, prior: Precision, damping: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Damped Newton step (M,) of the biases, and the slope of the cost along it at fixed trajectories."""
    matrix = solved.information + prior._replace(alpha=prior.alpha + damping).matrix()
    dz = Dense.of(matrix).solve(solved.score - prior.pull(z))
    return dz, (solved.pull - prior.pull(z)) @ dz


def _proposal(
    model: Model, point: Point, prior: Precision, damping: jax.Array, joint: bool, solved: Eliminated
) -> tuple[Point, Any]:
    """Full Gauss-Newton step from a point eliminated there, and the decrease of the cost that it promises."""
    xp, dz, slope = library(point.z, damping), np.zeros(model.biases), 0.0
    if joint and model.biases:  # an arrowhead: the tip first, then the trajectories follow
        dz, slope = map(xp.asarray, _direction(solved._replace(parts=()), point.z, prior, damping))
    proposal = follow(model, point, solved.parts, dz)
    pairs = (point.trajectories, proposal.trajectories)
    steps = jax.tree.map(lambda old, new: xp.asarray(new) - xp.asarray(old), *pairs)
    for _, kept, dx, u, du in model.each_layout(solved.parts, steps.states, point.noises, steps.noises):
        slope = slope + xp.vdot(kept.pull, dx) - xp.vdot(u, du)
    return proposal, 0.5 * slope


@partial(jax.jit, static_argnames="free")
def follow(model: Model, point: Point, parts: tuple[Kept, ...], dz: jax.Array, *, free: bool = False) -> Point:
    """Move the biases by dz (M,) and every trajectory to its smoothed response.

    Where scores are `free`, some data may have one without an information.
    """

    def smoothed(x: jax.Array, u: jax.Array, part: Recursion, kept: Kept) -> tuple[jax.Array, jax.Array]:
        column = kept.pull - kept.cross @ dz[: kept.cross.shape[2]]
        drift = -(factors(part, point.levels) @ u[:, :, None])
        smooth = rec.smooth(part.F, kept.gain, column[:, :, None], drift, free=free)
        return x + smooth.states[:, :, 0], smooth.noises[:, :, 0]

    tracks = point.trajectories.map(smoothed, model.recursions, parts)
    return Point(tracks, point.z + dz, point.levels)


@jax.jit
def part_way(model: Model, point: Point, full: Point, shares: jax.Array) -> tuple[jax.Array, Point]:
    """The costs of tracks (T,) where these have gone shares (T,) of the way to another point, and the point there.

    The biases go by the largest share.
    """
    own = jnp.split(shares, np.cumsum(model.targets)[:-1])
    by_epoch = model.each(lambda part, share: share[part.target][:, None], own)
    most = jnp.max(shares, initial=0.0)
    found = jax.tree.map(between, point, full, Point(by_epoch, by_epoch, most, most))
    # negative log density (T,) of the data and the whitened noises of each target
    sums = model.by_epoch(model.log_likelihood(found))
    costs = model.each(lambda _, own, u: 0.5 * jnp.sum(u**2, 1) - own, sums, found.noises)
    return jnp.concatenate(model.by_target(costs)), found


def shortened(
    model: Model, point: Point, proposal: Point, prior: Precision, bound: jax.Array
) -> tuple[Point, jax.Array, jax.Array]:
    """The part of a step whose cost does not exceed a bound, halved until then.

    Returns the point, its cost and the part, 0 where there is none. Consistent trajectories stay
    consistent.
    """

    def at(share: jax.Array) -> tuple[jax.Array, Point]:
        costs, found = part_way(model, point, proposal, share * np.ones(sum(model.targets)))
        return _known(model, found, prior) - _tilt(model, found) + library(costs).asarray(costs).sum(), found

    share, value, found = halved(at, bound)
    return found, value, share


class Mode(NamedTuple):
    """Outcome of a search for the mode."""

    point: Point
    cost: jax.Array
    iterations: jax.Array
    converged: jax.Array
    refused: jax.Array  # every step was refused though it promised a lower cost: the start is no mode
    gained: jax.Array  # by how much the cost fell
    volume: jax.Array  # 1/2 log det W of a marginal mode, which its cost counts; 0 of a joint one


class _Search(NamedTuple):
    mode: Mode  # so far
    begun: Any  # the cost at the start
    damping: jax.Array
    over: jax.Array


@quiet
def find_mode(
    model: Model, start: Point, prior: Precision, iterations: int, tolerance: Any, *, joint: bool = True,
    once: bool = False, known: Eliminated | None = None,
) -> Mode:  # fmt: skip
    """Damped Gauss-Newton (iterated EKS, with the biases if `joint`) until the cost changes by less than `tolerance`.

    The start must be a consistent trajectory (states made of its whitened noises). A step that does not
    lower the cost, or reaches a non-finite one, is halved, then damped. It has converged too where no step lowers
    the cost and the first promised less than `tolerance`, or than the rounding of the cost. `once` ends with the
    first step that lowers it; `known` is the system eliminated at the start with step weights, for who has it.
    """

    def at(point: Point) -> Eliminated:
        return eliminate(model, point, expected=False, joint=joint)

    def body(s: _Search) -> _Search:
        before = s.mode
        xp = library(before.cost)
        first = before.iterations == 0
        solved = at(before.point) if known is None else branch(first, lambda _: known, at, before.point)
        proposal, promised = _proposal(model, before.point, prior, s.damping, joint, solved)
        point, value, share = shortened(model, before.point, proposal, prior, before.cost)
        better, damping = share > 0, damped_on(s.damping, share)
        change = xp.where(better, before.cost - value, xp.inf)
        rounding = ROUNDING * abs(before.cost)
        small = abs(promised) <= xp.maximum(tolerance, rounding)
        # no step lowers the cost by more than its rounding, and none promised to
        still = (~better | (change <= rounding)) & (s.damping <= 1.0) & small & xp.isfinite(before.cost)
        done = (better & (change < tolerance) & (s.damping <= 1.0)) | (damping > DAMPING) | still
        moved = (before.gained > 0) | (better & (change > 0))
        converged, count = done & ((change < tolerance) | still), before.iterations + 1
        mode = Mode(point, value, count, converged, ~moved & ~converged, s.begun - value, before.volume)
        return _Search(mode, s.begun, damping, done | (count >= iterations) | (once & moved))

    value = cost(model, start, prior)
    zero, none, no = _nothing()
    mode = Mode(start, value, none, no, ~no, zero, zero)
    return looped(lambda s: ~s.over, body, _Search(mode, value, zero, no | (iterations <= 0))).mode


def _nothing() -> Any:
    """Zero, no iteration, False: with these a search begins on the host and where it is traced."""
    return np.zeros(()), np.zeros((), int), np.zeros((), bool)


class _Tracking(NamedTuple):
    point: Point
    costs: jax.Array  # (T,) of each target
    parts: tuple[Kept, ...] | None  # eliminated at some point on the way
    renew: jax.Array  # eliminate anew at the next step
    change: jax.Array
    moving: jax.Array  # (T,) tracks that are not yet at their mode
    iteration: jax.Array


@quiet
def find_tracks(model: Model, start: Point, iterations: int, tolerance: float) -> Point:
    """Trajectories at held biases until the cost of each changes by less than `tolerance`: iterated EKS by chords.

    What was eliminated serves the next steps too while each gains a tenth of the one before or less (Kelley 1995, 5.4):
    they need the score alone. Each track halves a step by itself, so that none waits for another, where that raises its
    cost by more than rounding; one that no part of a step improves stays where it is: on a cusp, grazing a sensor.
    """

    def at(point: Point) -> tuple[Kept, ...]:
        return kept_of(model, point.levels, compress_rows(model, point.z, rows_at(model, point, False), False))

    def body(s: _Tracking) -> _Tracking:
        xp = library(s.costs)
        parts = branch(s.renew, at, lambda _: s.parts, s.point)
        full = _tracked(model, s.point, parts)

        bound = xp.where(s.moving, s.costs + ROUNDING * abs(s.costs), xp.inf)
        shares, after, point = halved(
            lambda shares: part_way(model, s.point, full, xp.where(s.moving, shares, 0.0)), bound
        )
        stuck, gain = s.moving & (shares == 0), xp.where(s.moving, s.costs - after, 0.0)
        moving = s.moving & xp.where(stuck, ~s.renew, gain >= tolerance)
        waits, most = xp.any(stuck), xp.max(gain)
        return _Tracking(
            point, xp.where(s.moving, after, s.costs), parts, waits | (most > CHORD * s.change),
            xp.where(waits, s.change, most), moving, s.iteration + 1,
        )  # fmt: skip

    xp = library(*jax.tree.leaves((model, start)))
    parts, (zero, none, no) = None if xp is np else zeros_from(at, start), _nothing()
    begun = xp.asarray(part_way(model, start, start, np.zeros(sum(model.targets)))[0])
    first = _Tracking(start, begun, parts, ~no, zero + np.inf, xp.ones(begun.shape, bool), none)
    return looped(lambda s: s.moving.any() & (s.iteration < iterations), body, first).point


@jax.jit
def _tracked(model: Model, point: Point, parts: tuple[Kept, ...]) -> Point:
    """The point with every trajectory at the end of a step at held biases, by its score there."""
    pulls = jax.grad(lambda states: log_likelihood(model, At(states, point.z, point.levels)))(point.states)
    parts = model.each(lambda _, kept, pull: kept._replace(pull=pull), parts, pulls)
    return follow(model, point, parts, jnp.zeros_like(point.z), free=True)


def smooth_tracks(model: Model, point: Point, iterations: int = 20) -> Point:
    """Trajectories at the point's biases: iterated EKS."""
    return find_tracks(model, point, iterations, 1e-9)
