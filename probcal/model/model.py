"""The waist: a problem as one pytree of arrays, with its static form inside, equal by content.

What belongs to every datum is a tuple of arrays, (N, C) of N rows by C channels for each block (rows of one sensor
type that see targets of one state layout). Loops over blocks and state layouts are those of
`trajectories.Loops`.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from probcal.linalg import library
from probcal.model import rows as waist
from probcal.model.epochs import Epoch, Stepwise, merged
from probcal.model.rows import Block, Linearised, LinearRows, Rows
from probcal.model.sampled import SampledMotion
from probcal.noise import Normal

BATCH = 512  # rows whose responses to all biases are formed at once

Data = tuple[jax.Array, ...]  # of every datum: (N, C), or (N, C, ...), for each block
Mixing = tuple[tuple[jax.Array, ...], ...]  # weight (E,) of each tail of each recursion


class Where(Protocol):
    """The point at which a model is evaluated: a `Point`, or `At`."""

    @property
    def states(self) -> tuple[Any, ...]:
        """States (E, n) of each recursion, or a pytree (E leading) where a motion has no linear form."""

    @property
    def z(self) -> jax.Array:
        """Biases (M,) in units of their scales."""

    @property
    def levels(self) -> jax.Array:
        """Log factors (H,) of the unknown noise levels."""


class At(NamedTuple):
    """States, biases and noise levels where a model is evaluated."""

    states: tuple[Any, ...]  # (E, n) of each recursion, or a pytree (E leading) where a motion has no linear form
    z: jax.Array  # (M,)
    levels: jax.Array  # (H,)


@partial(jax.tree_util.register_dataclass, data_fields=["on", "weight"], meta_fields=["family", "name", "columns"])
@dataclass(frozen=True)
class Tail:
    """Noise columns of one recursion that are driven by a scale mixture: N(0, I / w) with a precision w an epoch.

    Everything Gaussian takes `weight` for w, one until a method sets it; samplers integrate w.
    """

    family: Any  # a `noise.ScaleMixture`
    name: str  # the state component that it drives
    columns: tuple[int, int]  # first and last (excluded) of the noise factor
    on: jax.Array  # (E,) whether it drives an epoch: not where a target begins, nor targets of another family
    weight: jax.Array  # (E,)

    @property
    def size(self) -> int:
        """Number of columns."""
        return self.columns[1] - self.columns[0]

    def squares(self, u: jax.Array) -> jax.Array:
        """Sums of squares (E,) over the columns of whitened noises (E, n), as they would be at weight 1."""
        return jnp.sum(u[:, slice(*self.columns)] ** 2, 1) / self.weight


Spot = tuple[int, int, int]  # a recursion, an epoch and an entry of the state
TILTED = 200  # biases up to which the curvature of a tilt is worked out, and memory for one is kept


class Tilt(NamedTuple):
    """A term of the log-likelihood of the biases beside that of the rows, quadratic about a point.

    Places that are integrated add it (see `gaussian.places`).
    """

    at: Any  # (M,) point z
    height: Any  # () value there
    slope: Any  # (M,) by z there
    curvature: Any  # (M, M) minus its second derivative; of more than `TILTED` biases its diagonal (M,)

    @classmethod
    def none(cls, biases: int) -> "Tilt":
        """Nothing, in the form of something: kernels compiled for it serve what is found later."""
        zero = np.zeros(biases)
        return cls(zero, np.zeros(()), zero, np.zeros((biases,) * (2 if biases <= TILTED else 1)))

    def value(self, z: Any) -> Any:
        """The value that is added at z."""
        moved = z - self.at
        return self.height + moved @ (self.slope - 0.5 * self.times(moved))

    def pull(self, z: Any) -> Any:
        """Slope (M,) at z."""
        return self.slope - self.times(z - self.at)

    def times(self, columns: Any) -> Any:
        """The curvature times columns, (M,) or (M, K)."""
        if self.curvature.ndim == 2:
            return self.curvature @ columns
        return self.curvature.reshape(-1, *(1,) * (columns.ndim - 1)) * columns

    @partial(jax.jit, inline=True)
    def between(self, first: Any, second: Any) -> Any:
        """Its entries at pairs of biases, two arrays of numbers."""
        if self.curvature.ndim == 2:
            return self.curvature[first, second]
        return (first == second) * self.curvature[first]


class Recursion(NamedTuple):
    """Arrays of one recursion: E epochs of targets that share a state layout, n entries of it with a linear form."""

    F: jax.Array  # (E, n, n) transitions, 0 at the first epoch of a target
    L: jax.Array  # (E, n, n) noise factors (start factors at a first epoch), unused columns 0
    level: jax.Array  # (E, n) which unknown level multiplies a column of L, H where known
    drift: jax.Array  # (E, n) known part: start means, means of white components
    time: jax.Array  # (E,) of each epoch, in seconds
    dt: jax.Array  # (E,) since the epoch before of the same target, 0 at its first
    first: jax.Array  # (E,) whether a target begins here
    target: jax.Array  # (E,) which of the targets of this recursion
    tails: tuple[Tail, ...] = ()  # of the noise that is not Gaussian

    @property
    def weight(self) -> jax.Array:
        """Precision (E, n) that every whitened noise is taken to have beside its level."""
        found = jnp.ones_like(self.drift)
        for tail in self.tails:
            found = found.at[:, slice(*tail.columns)].set(tail.weight[:, None])
        return found


def at_rest(part: Recursion, targets: int) -> np.ndarray:
    """The mask (T,) of this many targets of a recursion: True if static at an unknown place."""
    E, n = part.drift.shape
    if not E or part.tails:
        return np.zeros(targets, bool)
    first, target, L = np.asarray(part.first), np.asarray(part.target), np.asarray(part.L)
    held = np.all(L == 0, (1, 2))
    rests = np.all(np.asarray(part.F) == np.eye(n), (1, 2)) & held & np.all(np.asarray(part.drift) == 0, 1)
    moves = np.bincount(target, ~(first | rests), targets) > 0
    return ~moves & (np.bincount(target, first & ~held, targets) == 1)


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["recursions", "rows", "level_spread", "tilt"],
    meta_fields=["blocks", "recursion", "biases", "driven", "targets", "full_rank", "sampled"],
)
@dataclass(frozen=True)
class Model(Stepwise):
    """All numbers of a problem and what is computed from them: a kernel compiled for one serves all of its form."""

    blocks: tuple[Block, ...]
    recursion: tuple[int, ...]  # which recursion each block reads
    biases: int  # M, number of free biases
    driven: bool  # whether a process noise has an unknown level
    targets: tuple[int, ...]  # T, number of targets of each recursion
    full_rank: bool  # whether the noise reaches every direction of every state, so that steps have a density
    sampled: tuple[SampledMotion | None, ...]  # of each recursion, what its motion does that has no linear form
    recursions: tuple[Recursion, ...]
    rows: tuple[Rows, ...]  # of each block
    level_spread: jax.Array  # (H,) standard deviation of each log level
    tilt: Tilt | None = None  # where a target is at rest and the biases are not many

    # at a point

    def predict(self, at: Where) -> Data:
        """Predicted value of every datum."""
        return tuple(
            waist.predict(block, data, self.vectors(r, at.states[r]), at.z) for block, data, r in self.each_block()
        )

    def innovation(self, at: Where) -> Data:
        """Measured minus predicted, wrapped, zero where missing."""
        parts = self.each_block(self.predict(at))
        return tuple(waist.innovation(block, data, own) for block, data, _, own in parts)

    def log_likelihood(self, at: Where) -> Data:
        """Log density of every datum, zero where missing."""
        return self._at(waist.log_likelihood, at)

    def square(self, at: Where) -> Data:
        """Square of what a point leaves of every datum, 1 expected, zero where missing."""
        return self._at(waist.square, at)

    def reliance(self, at: Where) -> Data:
        """The weight of each datum relative to one that fits: 1 inlying, towards 0 outlying."""
        return self._at(waist.reliance, at)

    def information(self, at: Where) -> Data:
        """Expected information of every datum about its predicted value, zero where missing."""
        return self._at(waist.information, at)

    def level_score(self, at: Where) -> Data:
        """One plus the derivative of each log density by log std, zero where missing."""
        return self._at(waist.level_score, at)

    def parameter_score(
        self, predicted: Data, levels: jax.Array, spread: Data
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Sums over the blocks of `waist.parameter_score`."""
        each = [
            waist.parameter_score(block, data, own, levels, wide)
            for block, data, _, own, wide in self.each_block(predicted, spread)
            if block.unknown
        ]
        slope, information, chosen = (sum(column[1:], column[0]) for column in zip(*each, strict=True))
        return slope, information, chosen

    def slopes(self, at: Where) -> tuple[tuple[jax.Array, jax.Array], ...]:
        """Score of every datum by its predicted value and its observed information, a pair for each block."""
        return self._at(waist.slopes, at)

    def score(self, at: Where) -> tuple[tuple[jax.Array, jax.Array], ...]:
        """Score of every datum by its predicted value and the expected information, a pair for each block."""
        return self._at(partial(waist.weigh, expected=True), at)

    def spread_of_noise(self, at: Where) -> Data:
        """Noise std of every datum at a point."""
        return self._at(waist.std_at, at)

    def noise_std(self, levels: jax.Array) -> Data:
        """Noise std of every datum at log levels (H,)."""
        return tuple(waist.noise_std(data, levels) for data in self.rows)

    def sample(self, at: Where, key: jax.Array) -> Data:
        """Measured values drawn at a point, for missing ones too; angles are wrapped."""
        return tuple(
            waist.sample(block, data, predicted, at.levels, jax.random.fold_in(key, b))
            for b, (block, data, _, predicted) in enumerate(self.each_block(self.predict(at)))
        )

    def linearise(self, at: Where, *, expected: Any) -> LinearRows:
        """Every block linearised at a point, with step weights or the expected information.

        Raises `InputError` where a motion has no linear form.
        """
        self.check_linear()
        return tuple(
            waist.linearise(block, data, at.states[r], at.z, at.levels, expected=expected)
            for block, data, r in self.each_block()
        )

    def linearise_biases(self, at: Where, *, expected: bool) -> LinearRows:
        """Every block linearised by the biases alone, whatever the motion: `of_biases` reads it."""
        return tuple(
            waist.linearise_biases(block, data, self.vectors(r, at.states[r]), at.z, at.levels, expected=expected)
            for block, data, r in self.each_block()
        )

    # rows linearised at a point

    def of_states(self, lins: Sequence[Linearised]) -> list[tuple[jax.Array, jax.Array]]:
        """Rows compressed onto the states: information J (E, n, n) and score (E, n) of each recursion."""
        shapes = [part.drift.shape for part in self.recursions]
        parts = [(jnp.zeros((E, n, n)), jnp.zeros((E, n))) for E, n in shapes]
        for block, data, r, lin in self.each_block(lins):
            used, E = jnp.asarray(block.used, int), shapes[r][0]
            J = jax.ops.segment_sum(jnp.einsum("ncu,nc,ncv->nuv", lin.state, lin.weight, lin.state), data.epoch, E)
            score = jax.ops.segment_sum(jnp.einsum("ncu,nc->nu", lin.state, lin.score), data.epoch, E)
            before = parts[r]
            parts[r] = (before[0].at[:, used[:, None], used[None, :]].add(J), before[1].at[:, used].add(score))
        return parts

    def of_biases(self, lins: Sequence[Linearised]) -> tuple[jax.Array, jax.Array]:
        """Rows compressed onto the biases at fixed trajectories: information (M, M), score (M,) (Paper C 35-36)."""
        information, score = self.of_sensors(lins)
        return self.between_biases(information), score

    def of_sensors(self, lins: Sequence[Linearised]) -> tuple[Data, jax.Array]:
        """Rows compressed onto biases by sensor: information (S, p, p) of each block, score (M,)."""
        found, score = list[jax.Array](), jnp.zeros(self.biases + 1)
        for _, data, _, lin in self.each_block(lins):
            S = data.bias.shape[0]
            own = jnp.einsum("ncp,nc,ncq->npq", lin.bias, lin.weight, lin.bias)
            found.append(jax.ops.segment_sum(own, data.sensor, S))
            pull = jax.ops.segment_sum(jnp.einsum("ncp,nc->np", lin.bias, lin.score), data.sensor, S)
            score = score.at[data.bias].add(pull)
        return tuple(found), score[:-1]

    def between_biases(self, parts: Sequence[jax.Array]) -> jax.Array:
        """The sum (M, M) of matrices (S, p, p) by sensor of each block."""
        M = self.biases
        G = jnp.zeros((M + 1, M + 1))
        for _, data, _, own in self.each_block(parts):
            G = G.at[data.bias[:, :, None], data.bias[:, None, :]].add(own)
        return G[:M, :M]

    def curvature_by_biases(self, at: Where, weights: Sequence[jax.Array]) -> jax.Array:
        """Minus the second derivative (M, M) of the log-likelihood by the biases at given states, rows weighed (N,)."""
        found = list[jax.Array]()
        for block, data, r, w in self.each_block(weights):
            rows = waist.curvature(block, data, self.vectors(r, at.states[r]), at.z, at.levels)
            rows = rows * w[:, None, None]
            found.append(jax.ops.segment_sum(rows, data.sensor, data.bias.shape[0]))
        return self.between_biases(found)

    def of_both(self, lins: Sequence[Linearised]) -> list[jax.Array]:
        """Cross information of states and biases, (E, n, M) of each recursion."""
        M = self.biases
        parts = [jnp.zeros((*part.drift.shape, M)) for part in self.recursions]
        for block, data, r, lin in self.each_block(lins):
            weighted = jnp.einsum("ncp,nc,ncu->npu", lin.bias, lin.weight, lin.state)
            summed = jnp.zeros((parts[r].shape[0], M + 1, len(block.used)))
            summed = summed.at[data.epoch[:, None], data.bias[data.sensor]].add(weighted)
            parts[r] = parts[r].at[:, jnp.asarray(block.used, int)].add(summed[:, :M].mT)
        return parts

    def by_state(self, lins: Sequence[Linearised], states: Sequence[jax.Array]) -> Data:
        """Change (N, C, K) of every predicted value along K directions of the states (E, n, K)."""
        return tuple(
            jnp.einsum("ncu,nuk->nck", lin.state, states[r][:, jnp.asarray(block.used, int)][data.epoch])
            for block, data, r, lin in self.each_block(lins)
        )

    def by_bias(self, lins: Sequence[Linearised], biases: jax.Array) -> Data:
        """Change (N, C, K) of every predicted value along K directions of the biases (M, K)."""
        parts = self.each_block(lins, self.by_sensor(biases))
        return tuple(jnp.einsum("ncp,npk->nck", lin.bias, own[data.sensor]) for _, data, _, lin, own in parts)

    def responses(self, lins: Sequence[Linearised], states: Sequence[jax.Array], biases: jax.Array) -> Data:
        """Change (N, C, K) of every predicted value along K directions of states (E, n, K) and biases (M, K)."""
        return jax.tree.map(jnp.add, self.by_state(lins, states), self.by_bias(lins, biases))

    def spread(self, lins: Sequence[Linearised], states: Sequence[jax.Array], biases: jax.Array) -> Data:
        """Sum of squares (N, C) over the K directions of `responses`, some rows at a time."""
        found = []
        for block, data, r, lin, own in self.each_block(lins, self.by_sensor(biases)):
            moved = states[r][:, jnp.asarray(block.used, int)]

            def one(row: tuple[jax.Array, ...], moved: jax.Array = moved, own: jax.Array = own) -> jax.Array:
                by_state, by_bias, epoch, sensor = row
                return jnp.sum((by_state @ moved[epoch] + by_bias @ own[sensor]) ** 2, 1)

            found.append(jax.lax.map(one, (lin.state, lin.bias, data.epoch, data.sensor), batch_size=BATCH))
        return tuple(found)

    def state_variance(self, lins: Sequence[Linearised], covariances: Sequence[jax.Array]) -> Data:
        """Variance (N, C) of every predicted value by the covariances (E, n, n) of the states of each recursion."""
        found = []
        for block, data, r, lin in self.each_block(lins):
            used = jnp.asarray(block.used, int)
            P = covariances[r][:, used[:, None], used[None, :]][data.epoch]
            found.append(jnp.einsum("ncu,nuv,ncv->nc", lin.state, P, lin.state))
        return tuple(found)

    def onto_states(self, lins: Sequence[Linearised], columns: Sequence[jax.Array]) -> list[jax.Array]:
        """Columns (N, C, K) of data taken back to the states by their Jacobians, (E, n, K) of each recursion."""
        parts = [jnp.zeros((*part.drift.shape, columns[0].shape[2])) for part in self.recursions]
        for block, data, r, lin, column in self.each_block(lins, columns):
            summed = jax.ops.segment_sum(jnp.einsum("ncu,nck->nuk", lin.state, column), data.epoch, parts[r].shape[0])
            parts[r] = parts[r].at[:, jnp.asarray(block.used, int)].add(summed)
        return parts

    def onto_biases(self, lins: Sequence[Linearised], columns: Sequence[jax.Array]) -> jax.Array:
        """Columns (N, C, K) of data taken back to the biases by their Jacobians, (M, K)."""
        found = jnp.zeros((self.biases + 1, columns[0].shape[2]))
        for data, lin, column in zip(self.rows, lins, columns, strict=True):
            own = jax.ops.segment_sum(jnp.einsum("ncp,nck->npk", lin.bias, column), data.sensor, data.bias.shape[0])
            found = found.at[data.bias].add(own)
        return found[: self.biases]

    # sums and indices

    def by_epoch(self, values: Sequence[jax.Array]) -> list[jax.Array]:
        """Sums (E,) of values (N, C) over the data of each epoch, for each recursion."""
        parts = [jnp.zeros(part.drift.shape[0]) for part in self.recursions]
        for _, data, r, value in self.each_block(values):
            parts[r] = parts[r].at[data.epoch].add(jnp.sum(value, 1))
        return parts

    def by_level(self, values: Sequence[jax.Array]) -> jax.Array:
        """Sums (H + 1,) of values (N, C) over the data of each unknown level, those of known ones last."""
        total = jnp.zeros(self.level_spread.shape[0] + 1)
        for _, data, _, value in self.each_block(values):
            total = total.at[data.level].add(value)
        return total

    def by_sensor(self, biases: jax.Array) -> Data:
        """The entries (S, p, ...) of (M, ...) per block: the biases of each sensor; 0 if fixed."""
        padded = jnp.concatenate([biases, jnp.zeros((1, *biases.shape[1:]), biases.dtype)])
        return tuple(padded[data.bias] for data in self.rows)

    @property
    def measured(self) -> Data:
        """1 where there is a measured value, else 0."""
        return tuple(data.mask for data in self.rows)

    @property
    def values(self) -> Data:
        """Measured value of every datum, 0 where missing."""
        return tuple(data.y for data in self.rows)

    @property
    def read(self) -> tuple[np.ndarray, ...]:
        """The indices of the biases that each row reads, (N, p) per block; M if fixed or none."""
        return tuple(np.asarray(data.bias)[np.asarray(data.sensor)] for data in self.rows)

    @property
    def epoch(self) -> Data:
        """Epoch (N,) of each row in its recursion, for each block."""
        return tuple(data.epoch for data in self.rows)

    @property
    def noises(self) -> tuple[tuple[Any, ...], ...]:
        """Noise family of each channel of each block."""
        return tuple(block.noises for block in self.blocks)

    @property
    def weighs_as_expected(self) -> bool:
        """True if step weights are the expected information: all noise of the data is Gaussian."""
        return all(type(noise) is Normal for own in self.noises for noise in own)

    @property
    def linear(self) -> tuple[Recursion | None, ...]:
        """Linear form of the motion of each recursion, None where it has none."""
        return self.each(lambda part, form: part if form is None else None, self.sampled)

    @property
    def tailed(self) -> bool:
        """True if some process noise is not Gaussian."""
        return any(part.tails for part in self.recursions)

    @property
    def learns_noise(self) -> bool:
        """True if a fit finds some of the noise: unknown levels, or precisions of tails."""
        return self.tailed or self.level_spread.shape[0] > 0

    @property
    def mixing(self) -> Mixing:
        """Precisions (E,) that the noises of each tail of each recursion are taken to have."""
        return tuple(tuple(tail.weight for tail in part.tails) for part in self.recursions)

    @property
    def resting(self) -> tuple[np.ndarray, ...]:
        """Mask (T,) of the targets of each recursion that rest at a place that is not known."""
        return self.each(at_rest, self.targets)

    @property
    def rests(self) -> bool:
        """True if some target stands still at a place that is not known."""
        return any(own.any() for own in self.resting)

    def with_tilt(self, tilt: Tilt) -> "Model":
        """The model with a term of the log-likelihood of the biases beside that of the rows."""
        return replace(self, tilt=tilt)

    def with_start(self, where: Spot, value: float, sd: float) -> tuple["Model", float]:
        """The model with a measurement of a first state, and the log density of that.

        The factor of the start is updated as by Potter (1963).
        """
        r, epoch, entry = where
        part = self.recursions[r]
        L, drift = np.array(part.L), np.array(part.drift)
        own, away = L[epoch, entry].copy(), value - drift[epoch, entry]
        total = own @ own + sd**2
        spread = L[epoch] @ own
        drift[epoch] += spread * away / total
        L[epoch] -= np.outer(spread, own) / (total + sd * np.sqrt(total))
        known = part._replace(L=jnp.asarray(L), drift=jnp.asarray(drift))
        parts = (*self.recursions[:r], known, *self.recursions[r + 1 :])
        density = -0.5 * (away**2 / total + np.log(2 * np.pi * total))
        return replace(self, recursions=parts), float(density)

    def with_mixing(self, weights: Mixing) -> "Model":
        """The model with other precisions of its process noise, where this is not Gaussian."""
        if not self.tailed:
            return self

        def weighted(part: Recursion, own: tuple[jax.Array, ...]) -> Recursion:
            return part._replace(tails=tuple(replace(t, weight=w) for t, w in zip(part.tails, own, strict=True)))

        return replace(self, recursions=self.each(weighted, weights))

    def by_information(self) -> "Model":
        """The model with Gaussian process noises of the same Fisher information, which bounds see of their family."""
        weights = tuple(
            tuple(jnp.where(tail.on, tail.family.mixing_information(tail.size), 1.0) for tail in part.tails)
            for part in self.recursions
        )
        return self.with_mixing(weights)

    def draw_noises(self, key: jax.Array, r: int, count: int) -> jax.Array:
        """Process noises (E, n, count) of recursion r from the prior, of unit level."""
        part = self.recursions[r]
        own = jax.random.fold_in(key, r)
        noise = jax.random.normal(own, (*part.drift.shape, count))
        for k, tail in enumerate(part.tails):
            drawn = tail.family.mixing_draw(jax.random.fold_in(own, 1 + k), (len(tail.on), count))
            precision = jnp.where(tail.on[:, None], drawn, 1.0)
            noise = noise.at[:, slice(*tail.columns)].divide(jnp.sqrt(precision)[:, None, :])
        return noise

    @property
    def size(self) -> int:
        """Number of data, missing ones of a row included."""
        return sum(data.mask.size for data in self.rows)

    @property
    def state_size(self) -> int:
        """Number of all state entries of all epochs."""
        return sum(part.drift.size for part in self.recursions)

    def entries(self, r: int) -> tuple[int, ...]:
        """State entries of recursion r that any row reads."""
        return tuple(sorted({i for block, _, own in self.each_block() if own == r for i in block.used}))

    def epochs(self, sizes: tuple[int, ...] | None = None) -> Epoch:
        """The epochs of all targets in time order, stacked (K leading), for filters that scan over them.

        All rows of a target that never moves stand at its first epoch.
        The rows of each block are padded to `sizes`, by default to the most that an epoch has. Raises `InputError`
        where an epoch has more.
        """
        return jax.device_put(merged(self, self.rows, self.sizes if sizes is None else sizes))

    @property
    def sizes(self) -> tuple[int, ...]:
        """The most rows that an epoch has, of each block."""
        return tuple(int(np.bincount(np.asarray(data.epoch)).max(initial=0)) for data in self.rows)

    # other models of the same form

    def seen(self) -> "Model":
        """The model whose states are what rows see of them, (E, n) arrays whatever the motion: for what reads rows."""
        return replace(self, sampled=(None,) * len(self.sampled)) if any(self.sampled) else self

    def with_values(self, y: Sequence[Any]) -> "Model":
        """The same rows with other measured values y (N, C), read where a value is measured."""
        return self.with_rows(lambda data, new: {"y": jnp.where(data.mask > 0, jnp.asarray(new, data.y.dtype), 0.0)}, y)

    def weighted(self, weights: Sequence[Any]) -> "Model":
        """Every datum counted by a weight (N, C) or (N, 1): 0 leaves it out, a share is soft association."""
        return self.with_rows(lambda data, w: {"mask": library(data.mask, w).multiply(data.mask, w)}, weights)

    def with_rows(self, changes: Callable[..., dict[str, Any]], *of_each: Iterable[Any]) -> "Model":
        """The model whose rows of each block have the fields `changes(rows, *own)`.

        `own` is the entry of each sequence in `of_each` for the block.
        """
        changed = (data._replace(**changes(data, *own)) for _, data, _, *own in self.each_block(*of_each))
        return replace(self, rows=tuple(changed))

    def _at(self, function: Any, at: Where) -> tuple[Any, ...]:
        """A function of a block, its rows, its predicted values and the levels, for every block."""
        parts = self.each_block(self.predict(at))
        return tuple(function(block, data, own, at.levels) for block, data, _, own in parts)


def scaled(lins: Sequence[Linearised], weights: Sequence[Any]) -> LinearRows:
    """Rows linearised with every datum counted by a weight (N, C)."""
    pairs = zip(lins, weights, strict=True)
    return tuple(lin._replace(score=lin.score * w, weight=lin.weight * w) for lin, w in pairs)
