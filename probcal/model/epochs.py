"""The model epoch by epoch, as filters read it: the epochs of all targets merged in time order, each a pytree.

The state x of all targets is a tuple with an array (T, n) of the T targets of each recursion, or, of a motion without
linear form, with its pytree, T leading. An epoch belongs to one target: `step` moves that one, and only its rows are
seen. Nothing here looks into the arrays of whole trajectories, so that epochs of rows that came later, of the same
form, serve a kernel that was compiled before.
"""

from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal import linalg
from probcal.errors import InputError
from probcal.model import rows as waist
from probcal.model.rows import Block, LinearRows, Rows
from probcal.model.sampled import SampledMotion, check_densities
from probcal.model.trajectories import Loops, States

State = tuple[Any, ...]  # (T, n) of each recursion, or a pytree with T leading


class Move(NamedTuple):
    """The step of one target's state to an epoch: x = F x + drift + L u, u ~ N(0, I) times unknown
    levels.
    """

    F: jax.Array  # (n, n), 0 at the first epoch of a target
    L: jax.Array  # (n, n)
    level: jax.Array  # (n,) which unknown level multiplies a column of L, H where known
    drift: jax.Array  # (n,)
    mixed: tuple[jax.Array, ...] = ()  # () of each tail of the recursion whether it drives this epoch


class Seen(NamedTuple):
    """The rows of one block at an epoch, padded to P of them."""

    sensor: jax.Array  # (P,)
    pose: jax.Array  # (P, nodes, entries)
    y: jax.Array  # (P, C)
    mask: jax.Array  # (P, C) 0 where nothing was measured, and in padded rows
    std: jax.Array  # (P, C)
    level: jax.Array  # (P, C)

    def rows_of(self, data: Rows) -> Rows:
        """The rows of a block at this epoch alone, from all its rows."""
        return data._replace(epoch=jnp.zeros_like(self.sensor), **self._asdict())


class Epoch(NamedTuple):
    """One epoch of one target, or a stack of K of them along the leading axis of every array."""

    time: jax.Array  # () in seconds
    dt: jax.Array  # () since the epoch before of the same target, 0 at its first
    first: jax.Array  # () whether the target begins here: `step` then ignores x
    recursion: jax.Array  # () the recursion of the target
    target: States  # () of each recursion which target moves; in the others a move that changes nothing
    move: tuple[Move, ...]  # of each recursion
    rows: tuple[Seen, ...]  # of each block


class Stepwise(Loops):
    """The computations of a `Model` at one epoch."""

    blocks: tuple[Block, ...]
    recursion: tuple[int, ...]
    targets: tuple[int, ...]
    full_rank: bool
    sampled: tuple[SampledMotion | None, ...]
    recursions: tuple[Any, ...]
    rows: tuple[Rows, ...]
    level_spread: jax.Array

    def initial(self) -> State:
        """State before any epoch, all 0: each target is drawn at its first epoch, where `step` ignores what was."""
        found: list[Any] = []
        for part, count, form in self.each_layout(self.targets, self.sampled):
            vector = jnp.zeros((count, part.drift.shape[1]))
            found.append(vector if form is None else form.whole(vector, form.resting(count)))
        return tuple(found)

    def step(self, key: jax.Array, x: State, epoch: Epoch, levels: jax.Array) -> State:
        """State at an epoch drawn from that before it, at log levels (H,)."""
        found: list[Any] = []
        for r, (states, move, target, form) in enumerate(zip(x, epoch.move, epoch.target, self.sampled, strict=True)):
            own = jax.random.fold_in(key, r)
            vector, others = (states, None) if form is None else form.part(states)
            if vector is not None:
                noise = jax.random.normal(own, move.drift.shape)
                for k, (tail, on) in enumerate(zip(self.recursions[r].tails, move.mixed, strict=True)):
                    drawn = tail.family.mixing_draw(jax.random.fold_in(own, 1 + k), ())
                    noise = noise.at[slice(*tail.columns)].divide(jnp.sqrt(jnp.where(on, drawn, 1.0)))
                vector = vector.at[target].set(_mean(vector, move, target) + _root(move, levels) @ noise)
            if form is not None:
                moved = self._moved(form, jax.random.fold_in(own, 1 + len(move.mixed)), others, r, epoch, levels)
                vector = form.whole(vector, moved)
            found.append(vector)
        return tuple(found)

    def _moved(
        self, form: SampledMotion, key: jax.Array, states: Any, r: int, epoch: Epoch, levels: jax.Array
    ) -> tuple[Any, ...]:
        """States (T leading) of what has no linear form in recursion r, after an epoch."""
        target = epoch.target[r]
        old = jax.tree.map(lambda leaf: leaf[target], states)
        new = jax.lax.switch(
            jnp.where(epoch.recursion == r, jnp.where(epoch.first, 1, 2), 0),
            [lambda: old, lambda: form.begin(key), lambda: form.go(key, old, epoch.dt, levels)],
        )
        return jax.tree.map(lambda leaf, one: leaf.at[target].set(one), states, new)

    def log_step(self, x: State, after: State, epoch: Epoch, levels: jax.Array) -> jax.Array:
        """Log density of the state at an epoch given that before it.

        Raises `InputError` for a motion whose noise leaves out a direction, which has no density, and for one that
        states none.
        """
        self.check_density()

        def of(r: int) -> jax.Array:
            move, target, form = epoch.move[r], epoch.target[r], self.sampled[r]
            (old, before), (new, later) = ((s, ()) if form is None else form.part(s) for s in (x[r], after[r]))
            total = jnp.zeros(())
            if old is not None and new is not None:
                away, root = new[target] - _mean(old, move, target), _root(move, levels)
                total = linalg.log_normal(away, root)
                noise = linalg.shortest_drive(away, root) if move.mixed else away
                for tail, on in zip(self.recursions[r].tails, move.mixed, strict=True):
                    square = jnp.sum(noise[slice(*tail.columns)] ** 2)
                    total = total + jnp.where(on, tail.family.mixing_density(square, tail.size), 0.0)
            if form is not None:
                before, later = jax.tree.map(lambda leaf: leaf[target], (before, later))
                total = total + jax.lax.cond(
                    epoch.first, lambda: form.log_begin(later), lambda: form.log_go(before, later, epoch.dt, levels)
                )
            return total

        return jax.lax.switch(epoch.recursion, [lambda r=r: of(r) for r in range(len(self.recursions))])

    def log_steps(self, x: State, after: State, epoch: Epoch, levels: jax.Array) -> jax.Array:
        """Log densities (I, J) of the J states after an epoch given each of the I before it, of a model of one target.

        What is linear and Gaussian is whitened once, so that a pair costs a product; the rest is `log_step`, pair by
        pair. Raises `InputError` as `log_step`.
        """
        (part,), (form,), move = self.recursions, self.sampled, epoch.move[0]
        if form is not None or part.tails:
            return jax.vmap(lambda a: jax.vmap(lambda b: self.log_step(a, b, epoch, levels))(after))(x)
        self.check_density()
        lower, inverse = linalg.factor_and_inverse(_root(move, levels) @ _root(move, levels).T)
        (old,), (new,) = x, after
        middle = jnp.mean(new[:, 0], 0)  # about which nothing cancels
        ahead = (old[:, 0] @ move.F.T + (move.drift - middle)[None, :]) @ inverse.T
        there = (new[:, 0] - middle[None, :]) @ inverse.T
        square = jnp.sum(ahead**2, 1)[:, None] + jnp.sum(there**2, 1)[None, :] - 2.0 * ahead @ there.T
        n = inverse.shape[0]
        volume = jnp.sum(jnp.log(jnp.diagonal(lower))) + 0.5 * n * float(np.log(2 * np.pi))
        return -0.5 * jnp.maximum(square, 0.0) - volume

    def check_density(self) -> None:
        """Raise `InputError` where steps have no density."""
        check_densities(self.sampled)
        if not self.full_rank:
            raise InputError(
                "the motion has no density: its noise does not reach every component of the state (singular=True,"
                " Static(), or rows of free clocks at one time); take a motion with noise in all of them, and hold the"
                " clocks (fix=)"
            )

    def predict_at(self, epoch: Epoch, x: State, z: jax.Array) -> tuple[jax.Array, ...]:
        """Predicted value (P, C) of every row of an epoch, for each block."""
        return tuple(waist.predict(block, data, states, z) for block, data, states in self._seen(epoch, x))

    def log_likelihood_at(self, epoch: Epoch, x: State, z: jax.Array, levels: jax.Array) -> tuple[jax.Array, ...]:
        """Log density (P, C) of every row of an epoch, zero where nothing was measured, for each block."""
        found = []
        for block, data, states in self._seen(epoch, x):
            part = waist.log_likelihood(block, data, waist.predict(block, data, states, z), levels)
            found.append(jnp.where(data.mask > 0, part, 0.0))  # a padded row may have no value
        return tuple(found)

    def linearise_at(
        self, epoch: Epoch, x: State, z: jax.Array, levels: jax.Array, *, expected: bool = True
    ) -> LinearRows:
        """The rows of an epoch linearised, Jacobians by the state of its target whole: (P, C, n) for each block.

        Raises `InputError` where a motion has no linear form.
        """
        self.check_linear()
        found = []
        for block, data, states in self._seen(epoch, x):
            lin = waist.linearise(block, data, states, z, levels, expected=expected)
            there = data.mask > 0  # a padded row may have no value
            lin = jax.tree.map(lambda leaf, t=there: jnp.where(t if leaf.ndim == 2 else t[:, :, None], leaf, 0.0), lin)
            whole = jnp.zeros((*lin.state.shape[:2], states.shape[1]))
            found.append(lin._replace(state=whole.at[:, :, np.asarray(block.used, int)].set(lin.state)))
        return tuple(found)

    def innovations_at(
        self, epoch: Epoch, predicted: tuple[jax.Array, ...], levels: jax.Array
    ) -> tuple[tuple[jax.Array, jax.Array], ...]:
        """Innovation (P, C) of every row of an epoch from predicted values (P, C) or (1, C), and their information.

        That is the expected information of a datum about its predicted value, 0 where nothing was measured.
        """
        found = []
        for block, data, _, seen, value in self.each_block(epoch.rows, predicted):
            here = seen.rows_of(data)
            whole = jnp.broadcast_to(value, here.y.shape)
            there = here.mask > 0
            off = jnp.where(there, waist.difference(block, here.y, whole), 0.0)
            found.append((off, jnp.where(there, waist.information(block, here, whole, levels), 0.0)))
        return tuple(found)

    def look_at(self, epoch: Epoch, x: State, z: jax.Array, seen: Any) -> tuple[jax.Array, ...]:
        """A function of target and pose(s), such as a field of view, at every row (P, ...) of an epoch by block."""
        return tuple(waist.look(block, data, states, z, seen) for block, data, states in self._seen(epoch, x))

    def _seen(self, epoch: Epoch, x: State) -> list[tuple[Block, Rows, jax.Array]]:
        """Blocks, their rows at an epoch, and the state (1, n) of the target that they see."""
        found = []
        for block, data, r, seen in self.each_block(epoch.rows):
            here = seen.rows_of(data)
            mine = jax.tree.map(lambda leaf, k=epoch.target[r]: leaf[k][None], x[r])
            found.append((block, here, self.vectors(r, mine)))
        return found

    def vectors(self, r: int, states: Any) -> jax.Array:
        """The vectors (E, n) that rows read in recursion r: the states if the motion is linear."""
        form = self.sampled[r]
        return states if form is None else jax.vmap(form.vector)(states)

    def vectors_of(self, states: tuple[Any, ...]) -> States:
        """The vectors (E, n) that rows read from the states of each recursion."""
        return tuple(map(self.vectors, range(len(states)), states))

    def check_linear(self) -> None:
        """Raise `InputError` where a motion has no linear form, so that there are no Jacobians by its state."""
        for form in self.sampled:
            if form is not None:
                raise InputError(
                    f"{type(form.others[0]).__name__} has no linear form, so that nothing is linearised by its state;"
                    " use predict and log_likelihood, which jax differentiates by biases and levels"
                )


def _mean(states: jax.Array, move: Move, target: jax.Array) -> jax.Array:
    return move.F @ states[target] + move.drift


def _root(move: Move, levels: jax.Array) -> jax.Array:
    return move.L * waist.level_factors(levels)[move.level][None, :]


def merged(model: Any, fill: tuple[Rows, ...], sizes: tuple[int, ...]) -> Epoch:
    """All epochs of a model in time order, stacked (K leading), as NumPy; rows of each block padded to `sizes`.

    What is left over repeats the first row of `fill`, masked. At one time the targets follow in their order. Raises
    `InputError` where an epoch has more rows than its size.
    """
    time = np.concatenate([np.asarray(part.time) for part in model.recursions])
    place = np.empty(len(time), int)
    place[np.argsort(time, kind="stable")] = np.arange(len(time))
    starts = np.cumsum([0, *(part.drift.shape[0] for part in model.recursions)])
    of = [place[a:b] for a, b in pairwise(starts)]  # of each recursion
    K, H = len(time), model.level_spread.shape[0]
    shared: Any = {
        "time": np.zeros(K), "dt": np.zeros(K), "first": np.zeros(K, bool), "recursion": np.zeros(K, int),
    }  # fmt: skip
    targets: list[Any] = []
    moves, rows = [], []
    for r, (part, mine) in enumerate(model.each_layout(of)):
        n = part.drift.shape[1]
        for name, value in (("time", part.time), ("dt", part.dt), ("first", part.first), ("recursion", r)):
            shared[name][mine] = np.asarray(value)
        target = np.zeros(K, int)
        target[mine] = np.asarray(part.target)
        targets.append(target)
        nothing: Any = (np.tile(np.eye(n), (K, 1, 1)), np.zeros((K, n, n)), np.full((K, n), H), np.zeros((K, n)))
        for whole, own in zip(nothing, (part.F, part.L, part.level, part.drift), strict=True):
            whole[mine] = np.asarray(own)
        mixed = [np.zeros(K, bool) for _ in part.tails]
        for whole, tail in zip(mixed, part.tails, strict=True):
            whole[mine] = np.asarray(tail.on)
        driving: Any = tuple(mixed)
        moves.append(Move(*nothing)._replace(mixed=driving))
    for block, data, r, size, own in model.each_block(sizes, fill):
        rows.append(padded_rows(data, of[r][np.asarray(data.epoch)], K, size, own, block))
    return Epoch(**shared, target=tuple(targets), move=tuple(moves), rows=tuple(rows))


def slots(epoch: np.ndarray, count: int) -> np.ndarray:
    """Place (N,) of each row among those of its epoch (N,), of `count` epochs."""
    taken = np.bincount(epoch, minlength=count)
    order = np.argsort(epoch, kind="stable")
    found = np.empty(len(epoch), int)
    found[order] = np.arange(len(epoch)) - np.repeat(np.cumsum(taken) - taken, taken)
    return found


def padded_rows(data: Rows, epoch: np.ndarray, count: int, size: int, fill: Rows, block: Block) -> Seen:
    """Rows of a block by epoch (N,), `size` to each of `count`."""
    taken = np.bincount(epoch, minlength=count)
    most = int(taken.max(initial=0))
    if most > size:
        raise InputError(f"an epoch has {most} rows of sensor {block.type.name}, but its size is {size}; give more")
    slot = slots(epoch, count)

    def put(name: str) -> np.ndarray:
        values, first = np.asarray(getattr(data, name)), np.asarray(getattr(fill, name))[0]
        filled = np.broadcast_to(first, (count, size, *first.shape)).copy()
        filled[epoch, slot] = values
        return filled

    mask = np.zeros((count, size, data.mask.shape[1]))
    mask[epoch, slot] = np.asarray(data.mask)
    found: Any = [mask if name == "mask" else put(name) for name in Seen._fields]
    return Seen(*found)
