"""The narrow waist where sensors meet numbers: predict, innovation, log_likelihood and linearise a block of rows.

A block holds the rows of one sensor type seeing targets of one state layout, gathered and vmapped.
Labels stay above; here are a static `Block` (what to compute) and a pytree `Rows` (the numbers).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal.errors import InputError, nearest
from probcal.geometry import wrap
from probcal.motion import Layout, view
from probcal.network import ANGLES, MOVING, Network, Node
from probcal.noise import AdditiveNoise, Bernoulli, Growing, GrowingWithMeasured, level_at, with_values
from probcal.sensor import Channel, Sensor, SensorType
from probcal.types import PoseView


class Parameter(NamedTuple):
    """An unknown parameter of the noise family of a channel: which level it is, of all sensors or of each.

    The name "" is the std of a channel, where its family does not grow in proportion to it.
    """

    channel: int
    name: str  # as `noise.unknowns` has it
    guess: float
    odds: bool  # whether it lies between 0 and 1
    number: tuple[int, ...]  # one, or one of each sensor (of each of its pieces)

    def of(self, rows: "Rows") -> jax.Array:
        """Level number of each row, (N,)."""
        if not self.name:
            return rows.level[:, self.channel]
        return jnp.asarray(self.number)[rows.sensor % len(self.number)]


@dataclass(frozen=True)
class Block:
    """The computation of a block of rows; hashable: one kernel serves all data of its form."""

    type: SensorType
    layout: Layout  # state components (name, start, stop, per axis)
    dimension: int
    used: tuple[int, ...]  # state entries that the function reads
    extras: tuple[str, ...]  # pose components beyond the position, in the order of a pose vector
    free: tuple[tuple[int, int], ...]  # (node, entry of its pose vector) of the biased pose entries
    steps: tuple[int, ...]  # which bias each further column steps: the biased pose entries, then those of the sensor
    flow: tuple[Any, ...] = ()  # components of the motion that `target.at` does not know, as in `motion.flow_of`
    unknown: tuple[Parameter, ...] = ()  # of the noise families of its channels
    # channels whose noise is remembered, and the state entry of each sensor (of each of its pieces)
    memory: tuple[tuple[int, tuple[int, ...]], ...] = ()
    at_measured: bool = False  # whether a std that grows is that at the measured value

    @property
    def growing(self) -> tuple[int, ...]:
        """Channels whose std grows with the predicted value."""
        return tuple(c for c, channel in enumerate(self.channels) if isinstance(channel.noise, Growing))

    @property
    def seen(self) -> tuple[int, ...]:
        """State entries that the function reads, without the noise that is remembered."""
        held = {entry for _, entries in self.memory for entry in entries}
        return tuple(i for i in self.used if i not in held)

    @property
    def channels(self) -> tuple[Channel, ...]:
        """Scalar channels in order."""
        return tuple(channel for _, channel in self.type.expand(self.dimension))

    @property
    def noises(self) -> tuple[Any, ...]:
        """Noise family of each channel."""
        return tuple(channel.noise for channel in self.channels)


class Rows(NamedTuple):
    """Numbers of a block: N rows of C channels by S sensors with p biases and nodes of P pose entries each.

    A sensor with a drifting bias counts once for each of its pieces.
    """

    epoch: jax.Array  # (N,) epoch of the recursion
    sensor: jax.Array  # (N,) sensor within the block
    pose: jax.Array  # (N, nodes, P) stated poses
    bias: jax.Array  # (S, p) which bias, M where fixed
    scale: jax.Array  # (S, p) scale of z, 0 where fixed
    base: jax.Array  # (S, p) fixed part: nominal value of a sensor bias, value of a fixed bias
    y: jax.Array  # (N, C) measured, 0 where missing
    mask: jax.Array  # (N, C) 1 where measured
    std: jax.Array  # (N, C) noise level, or its guess
    level: jax.Array  # (N, C) which unknown level multiplies std, H where known


BY_ROW = ("epoch", "sensor", "pose", "y", "mask", "std", "level")  # arrays of `Rows` that have an entry a row
AT_ONCE = 100_000  # rows that are looked at together: what lies between two results of a row takes no room for others


class Linearised(NamedTuple):
    """Derivatives of a block at one point; masked data have weight, score and information zero."""

    score: jax.Array  # (N, C) of the log-likelihood by the predicted value
    weight: jax.Array  # (N, C) step weight or expected information
    state: jax.Array  # (N, C, used) Jacobian by the state entries in `used`
    bias: jax.Array  # (N, C, p) Jacobian by z


LinearRows = tuple[Linearised, ...]  # of each block


def make_block(network: Network, kind: SensorType, layout: Layout, flow: tuple[Any, ...] = ()) -> Block:
    """Static part for the sensors of one type; raises `InputError` for a component nobody states."""
    known = {name: (start, stop) for name, start, stop, _ in layout}
    asked = set(kind.target_components) & set(known)
    if "at" in kind.target_components:  # extrapolates along what there is
        asked |= {"velocity", "acceleration"} & set(known)
        asked |= {name for part in flow for name, _ in part.names()}
    missing = sorted(kind.target_components - set(known) - {"at"})
    if missing:
        name, vector = missing[0], ", per_axis=True" if missing[0] in kind.vectors else ""
        remedy = {"velocity": "use ConstantVelocity(std)", "acceleration": "use ConstantAcceleration(std)"}
        raise InputError(
            f"sensor {kind.name} reads target.{name}, which the motion does not have{nearest(name, known)};"
            f" {remedy.get(name, f'add it, as in motion + White("{name}", unit, std{vector})')}"
        )
    for name, _, _, per_axis in layout:
        if name in asked and name in kind.vectors and not per_axis:
            raise InputError(f"sensor {kind.name} reads target.{name} as a vector; declare it with per_axis=True")
        if name in asked and name not in kind.vectors and per_axis:
            raise InputError(
                f"sensor {kind.name} reads target.{name} as a number, but the motion has one value an axis;"
                f' declare it, as in @sensor(..., vectors=("{name}",))'
            )
    placed = [s for s in network.sensors if s.type == kind]
    memory = tuple(
        (c, tuple(known[f"{own.name}.{name}_memory"][0] for own in placed))
        for c, (name, channel) in enumerate(kind.expand(network.dimension))
        if channel.memory is not None
    )
    held = [entry for _, entries in memory for entry in entries]
    used = tuple(sorted([*(i for name in asked for i in range(*known[name])), *held]))
    extras = tuple(sorted(kind.pose_components - {"position"}))
    for sensor in placed:
        for node in sensor.nodes:
            for name in extras:
                if name not in MOVING and name not in node.components:
                    value = (0.0,) * network.dimension if name in kind.vectors else 0.0
                    raise InputError(
                        f'sensor {kind.name} reads pose.{name}, which node "{node.name}" does not have'
                        f"{nearest(name, node.components)}; state it, as in Node(..., {name}={value})"
                    )
                if name in MOVING or (np.ndim(node.components[name]) > 0) == (name in kind.vectors):
                    continue
                if name in kind.vectors:
                    raise InputError(
                        f'sensor {kind.name} reads pose.{name} as a vector, but node "{node.name}" states one number;'
                        f" state one an axis, {network.dimension} of them"
                    )
                raise InputError(
                    f'sensor {kind.name} reads pose.{name}, of which node "{node.name}" states one an axis, as a single'
                    f' number; declare it, as in @sensor(..., vectors=("{name}",))'
                )
    entries = pose_entries(kind, network.dimension)
    free = tuple(
        (a, e)
        for a in range(kind.arity)
        for e, (component, _) in enumerate(entries)
        if any(component in s.nodes[a].spread for s in placed)
    )
    columns = zip(*(addresses(kind, sensor, free, entries) for sensor in placed), strict=True)
    steps = [(k, max(len(network.steps(*address)) for address in column)) for k, column in enumerate(columns)]
    stepped = tuple(k for k, n in steps for _ in range(n))
    return Block(kind, layout, network.dimension, used, extras, free, stepped, flow, memory=memory)


def addresses(
    kind: SensorType, placed: Sensor, free: Sequence[tuple[int, int]], entries: Sequence[tuple[str, int]]
) -> list[tuple[str, str, int]]:
    """Owner, component and axis of each bias that a sensor reads: the biased pose entries, then its own."""
    own = [(kind.name if bias.shared else placed.name, name, 0) for name, bias in kind.biases.items()]
    return [(placed.nodes[a].name, *entries[e]) for a, e in free] + own


def pose_entries(kind: SensorType, dimension: int) -> list[tuple[str, int]]:
    """Entries of a pose vector as (component, axis): the position, then what else the type reads."""
    parts = ("position", *sorted(kind.pose_components - {"position"}))
    return [(name, axis) for name in parts for axis in range(dimension if name in kind.vectors else 1)]


def pose_vector(
    node: Node, extras: tuple[str, ...], time: np.ndarray, moved: np.ndarray | float = 0.0, begin: float = 0.0
) -> np.ndarray:
    """Stated pose of a node at times (N,), shape (N, P); angles of a path add to those of the node.

    Rows were `moved` (N,) by what is known of their clock, and count `pose.time` from `begin` on.
    """
    zero = {"velocity": np.zeros(node.dimension), **dict.fromkeys(MOVING[1:], 0.0)}
    still = {"position": node.position, **zero} | node.components
    stated = {name: np.broadcast_to(value, (len(time), *np.shape(value))) for name, value in still.items()}
    stated |= {"time": time - begin, "time_offset": stated["time_offset"] - moved}
    if node.path is not None:
        moving = node.path.at(time)
        stated |= {name: value + stated[name] if name in ANGLES else value for name, value in moving.items()}
    columns = [values[:, None] if (values := stated[name]).ndim == 1 else values for name in ("position", *extras)]
    return np.concatenate(columns, 1).astype(float)


def by_parts(look: Callable[..., Any], rows: Rows, *more: jax.Array) -> Any:
    """`look(rows, *more)`, what it gives of each row (N, ...), some rows at a time where there are many.

    `more` has an entry a row as well. Going backwards through it makes each part again, and keeps nothing of it.
    """
    whole = {name: getattr(rows, name) for name in BY_ROW}, more
    count = rows.y.shape[0]
    if count <= 2 * AT_ONCE:
        return look(rows, *more)
    parts = -(-count // AT_ONCE)
    size = -(-count // parts)
    starts = np.minimum(np.arange(parts) * size, count - size)  # the last one begins within the one before it
    joined = (parts - 1) * size

    @jax.checkpoint
    def one(start: jax.Array) -> Any:
        own, others = jax.tree.map(lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, start, size), whole)
        return look(rows._replace(**own), *others)

    def together(leaf: jax.Array) -> jax.Array:
        first = leaf[:-1].reshape(joined, *leaf.shape[2:])
        return jnp.concatenate([first, leaf[-1, joined - count :]])

    return jax.tree.map(together, jax.lax.map(one, jnp.asarray(starts)))


def read_biases(block: Block, rows: Rows, z: jax.Array) -> jax.Array:
    """Biases of each row, in their units, shape (N, p)."""
    padded = jnp.concatenate([z, jnp.zeros(1, z.dtype)])
    return (rows.base + rows.scale * padded[rows.bias])[rows.sensor]


def _view(block: Block, pose: jax.Array) -> PoseView:
    """Read a pose vector (P,) by component name."""
    parts: dict[str, Any] = dict.fromkeys(ANGLES, 0.0)
    entries = [name for name, _ in pose_entries(block.type, block.dimension)]
    for name in dict.fromkeys(entries):
        start = entries.index(name)
        parts[name] = pose[start : start + block.dimension] if name in block.type.vectors else pose[start]
    return PoseView("the node", parts)


def _added(vector: jax.Array, places: Sequence[int], values: jax.Array) -> jax.Array:
    """A vector (n,) with values (k,) added at places known when it compiles.

    Entry by entry, which XLA weaves into what reads them: a scatter is a loop over the rows by itself.
    """
    entries = [vector[i] for i in range(len(vector))]
    for k, i in enumerate(places):
        entries[i] = entries[i] + values[k]
    return jnp.stack(entries)


def _one(block: Block, state: jax.Array, pose: jax.Array, local: jax.Array) -> jax.Array:
    """Predicted channels (C,) of one row from its state (n,), poses (nodes, P) and biases (p,)."""
    poses, biases = _scene(block, pose, local)
    return block.type.evaluate(view(block.layout, state, block.flow), poses, biases)


def _scene(block: Block, pose: jax.Array, local: jax.Array) -> tuple[list[PoseView], dict[str, jax.Array]]:
    """Poses of one row, put right by their biases, and the biases that its sensor reads beside."""
    if block.steps:
        constant = len(local) - len(block.steps)
        local = _added(local[:constant], block.steps, local[constant:])
    if block.free:
        places = [a * pose.shape[1] + e for a, e in block.free]
        pose = _added(pose.ravel(), places, local[: len(places)]).reshape(pose.shape)
    poses = [_view(block, pose[a]) for a in range(block.type.arity)]
    return poses, dict(zip(block.type.biases, local[len(block.free) :], strict=True))


def late_by(block: Block, rows: Rows, z: np.ndarray) -> np.ndarray:
    """Seconds (N,) from the epoch of each row to where its clock puts it at biases z (M,)."""
    entries = [name for name, _ in pose_entries(block.type, block.dimension)]
    padded = np.append(np.asarray(z, float), 0.0)
    local = np.asarray(rows.base) + np.asarray(rows.scale) * padded[np.asarray(rows.bias)]
    constant = local.shape[1] - len(block.steps)
    for k, column in enumerate(block.steps):
        local[:, column] += local[:, constant + k]
    pose = np.asarray(rows.pose)[:, 0].copy()
    for k, (a, e) in enumerate(block.free):
        if a == 0:
            pose[:, e] += local[np.asarray(rows.sensor), k]
    offset, rate, time = (pose[:, entries.index(name)] for name in ("time_offset", "time_rate", "time"))
    return offset + rate * time


@partial(jax.jit, static_argnames=("block", "seen"))
def look(block: Block, rows: Rows, states: jax.Array, z: jax.Array, seen: Callable[..., Any]) -> jax.Array:
    """A function of target and pose(s), such as a field of view, at every row: (N, ...)."""
    local = read_biases(block, rows, z)

    def one(state: jax.Array, pose: jax.Array, b: jax.Array) -> jax.Array:
        poses, _ = _scene(block, pose, b)
        return jnp.asarray(seen(view(block.layout, state, block.flow), *poses))

    return jax.vmap(one)(states[rows.epoch], rows.pose, local)


@partial(jax.jit, static_argnames="block")
def predict(block: Block, rows: Rows, states: jax.Array, z: jax.Array) -> jax.Array:
    """Predicted values (N, C) from the states of all epochs (E, n) and the biases z (M,)."""
    return by_parts(lambda own: predict_local(block, own, states[own.epoch], read_biases(block, own, z)), rows)


def predict_local(block: Block, rows: Rows, states: jax.Array, biases: jax.Array) -> jax.Array:
    """Predicted values (N, C) from the state (N, n) and the biases (N, p), in their units, of every row."""
    predicted = jax.vmap(lambda x, pose, b: _one(block, x, pose, b))(states, rows.pose, biases)
    return _with_memory(block, rows, states, predicted)


def _with_memory(block: Block, rows: Rows, states: jax.Array, predicted: jax.Array) -> jax.Array:
    """Predicted values (N, C) with the noise that each sensor remembers, at the states (N, n) of the rows."""
    for c, entries in block.memory:
        entry = jnp.asarray(entries)[rows.sensor % len(entries)]
        predicted = predicted.at[:, c].add(jnp.take_along_axis(states, entry[:, None], 1)[:, 0])
    return predicted


def noise_std(rows: Rows, levels: jax.Array) -> jax.Array:
    """Noise levels (N, C), with the estimated log factors of the unknown ones."""
    return rows.std * level_factors(levels)[rows.level]


def level_factors(levels: jax.Array) -> jax.Array:
    """Factors (H + 1,) of log levels (H,), 1 of known ones last."""
    return jnp.concatenate([jnp.exp(levels), jnp.ones(1, levels.dtype)])


def std_at(block: Block, rows: Rows, predicted: jax.Array, levels: jax.Array) -> jax.Array:
    """Std of the noise (N, C) at the predicted values, with which it may grow."""
    std, families = noise_std(rows, levels), _families(block, rows, levels)
    for c in block.growing:
        std = std.at[:, c].set(families[c].spread(predicted[:, c], std[:, c]))
    return std


def _families(
    block: Block, rows: Rows, levels: jax.Array, offset: jax.Array | None = None, *, each: bool = False
) -> list[Any]:
    """Noise family of each channel at log levels (H,), for each row `offset` (N, unknown) away.

    Parameters by sensor are those of each row; with `each`, of each sensor.
    """
    values: dict[int, dict[str, jax.Array]] = {}
    for k, own in enumerate(block.unknown):
        if not own.name:
            continue
        one = len(own.number) == 1 and offset is None
        places = own.number[0] if one else jnp.asarray(own.number) if each else own.of(rows)
        log = jnp.asarray(levels)[places]
        log = log if offset is None else log + offset[:, k]
        values.setdefault(own.channel, {})[own.name] = level_at(own.guess, own.odds, log)
    families = list(block.noises)
    for c, own_values in values.items():
        families[c] = with_values(families[c], own_values)
    for c in block.growing if block.at_measured else ():
        families[c] = GrowingWithMeasured(families[c].noise, families[c].slope)
    return families


def families_at(block: Block, levels: np.ndarray) -> list[Any]:
    """Noise family of each channel with numbers for its unknown parameters, in the middle of those of its sensors."""
    families = list(block.noises)
    for own in (own for own in block.unknown if own.name):
        value = level_at(own.guess, own.odds, float(levels[list(own.number)].mean()))
        families[own.channel] = with_values(families[own.channel], {own.name: float(value)})
    return families


def _by_channel(
    block: Block, families: Sequence[Any], method: str, *columns: jax.Array, period: bool = True
) -> jax.Array:
    """Apply a method of each channel's noise family to the columns of (N, C) arrays."""
    parts = []
    for c, (channel, family) in enumerate(zip(block.channels, families, strict=True)):
        arguments = [column[:, c] for column in columns]
        call = getattr(family, method)
        parts.append(call(*arguments, channel.period) if period else call(*arguments))
    return jnp.stack(parts, 1)


def innovation(block: Block, rows: Rows, predicted: jax.Array) -> jax.Array:
    """Measured minus predicted, wrapped, zero where missing, shape (N, C)."""
    return rows.mask * _by_channel(block, block.noises, "innovation", rows.y, predicted)


def _measured(block: Block, rows: Rows, method: str, predicted: jax.Array, levels: jax.Array) -> jax.Array:
    """A method of each channel's noise family at the measured values, zero where missing, (N, C)."""
    families = _families(block, rows, levels)
    return rows.mask * _by_channel(block, families, method, rows.y, predicted, noise_std(rows, levels))


@partial(jax.jit, static_argnames="block")
def log_likelihood(block: Block, rows: Rows, predicted: jax.Array, levels: jax.Array) -> jax.Array:
    """Log density of every datum, zero where missing, shape (N, C)."""
    return by_parts(lambda own, values: _measured(block, own, "log_likelihood", values, levels), rows, predicted)


def level_score(block: Block, rows: Rows, predicted: jax.Array, levels: jax.Array) -> jax.Array:
    """One plus the derivative of each log density by log std, zero where missing, shape (N, C)."""
    return _measured(block, rows, "level_score", predicted, levels)


def information(block: Block, rows: Rows, predicted: jax.Array, levels: jax.Array) -> jax.Array:
    """Expected information of every datum about its predicted value, zero where missing, shape (N, C)."""
    return rows.mask * _information(block, rows, predicted, noise_std(rows, levels), levels)


def _information(block: Block, rows: Rows, predicted: jax.Array, std: jax.Array, levels: jax.Array) -> jax.Array:
    """Expected information of every datum about its predicted value, (N, C).

    With parameters by sensor it is a quadrature, made once for each sensor and not for each row.
    """
    parts, families, each = [], _families(block, rows, levels), _families(block, rows, levels, each=True)
    for c, family in enumerate(families):
        S = max((len(own.number) for own in block.unknown if own.channel == c), default=1)
        if S > 1 and isinstance(family, AdditiveNoise):
            unit = each[c].information(jnp.zeros(S), jnp.ones(S))
            parts.append(unit[rows.sensor % S] / std[:, c] ** 2)
        else:
            parts.append(family.information(predicted[:, c], std[:, c]))
    return jnp.stack(parts, 1)


def parameter_score(
    block: Block, rows: Rows, predicted: jax.Array, levels: jax.Array, spread: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Of the levels of unknown parameters: slope (H,), information (H + 1, H + 1), and which they are (H + 1,).

    Slope of the sum of log p(y | predicted) - spread I / 2, I the expected information and `spread` (N, C) the variance
    of the predicted values: the slope of the log evidence, trajectories and biases integrated. The information is the
    sum of the squared scores of single data (Berndt, Hall, Hall, Hausman 1974).
    """
    N, H, K = rows.y.shape[0], levels.shape[0], len(block.unknown)
    number = jnp.stack([own.of(rows) for own in block.unknown], 1)

    def density(offset: jax.Array) -> jax.Array:
        families, std = _families(block, rows, levels, offset), noise_std(rows, levels)
        for k, own in enumerate(block.unknown):
            if not own.name:
                std = std.at[:, own.channel].multiply(jnp.exp(offset[:, k]))
        return _by_channel(block, families, "log_likelihood", rows.y, predicted, std)

    def whole(levels: jax.Array) -> jax.Array:
        std = noise_std(rows, levels)
        told = _by_channel(block, _families(block, rows, levels), "log_likelihood", rows.y, predicted, std)
        return jnp.sum(rows.mask * (told - 0.5 * spread * _information(block, rows, predicted, std, levels)))

    scores = []
    for k, own in enumerate(block.unknown):
        along = jnp.zeros((N, K)).at[:, k].set(1.0)
        slope = jax.jvp(density, (jnp.zeros((N, K)),), (along,))[1]
        scores.append(jnp.sqrt(rows.mask[:, own.channel]) * slope[:, own.channel])
    score = jnp.stack(scores, 1)
    outer = jnp.zeros((H + 1, H + 1)).at[number[:, :, None], number[:, None, :]].add(score[:, :, None] * score[:, None])
    return jax.grad(whole)(levels), outer, jnp.zeros(H + 1).at[number].set(1.0)


def sample(
    block: Block, rows: Rows, predicted: jax.Array, levels: jax.Array, key: jax.Array, how: str = "sample"
) -> jax.Array:
    """Draw measured values (N, C) around the predicted ones; angles are wrapped.

    `how` is the method of the noise families: "sample", or "emit" for what sensors need not hear.
    """
    std, drawn = noise_std(rows, levels), []
    for c, (channel, family) in enumerate(zip(block.channels, _families(block, rows, levels), strict=True)):
        value = getattr(family, how)(jax.random.fold_in(key, c), predicted[:, c], std[:, c])
        if channel.period is not None:
            value = jnp.mod(value + channel.period / 2, channel.period) - channel.period / 2
        drawn.append(value)
    return jnp.stack(drawn, 1)


def linearise(
    block: Block, rows: Rows, states: jax.Array, z: jax.Array, levels: jax.Array, *, expected: Any
) -> Linearised:
    """Score, weight and Jacobians at one point; `expected` takes the information instead of the step weight."""
    return by_parts(lambda own: _linearised(block, own, states, z, levels, expected=expected), rows)


def _linearised(
    block: Block, rows: Rows, states: jax.Array, z: jax.Array, levels: jax.Array, *, expected: Any
) -> Linearised:
    """The result of `linearise` for some rows."""
    local = read_biases(block, rows, z)
    reached = states[rows.epoch]

    def one(entries: jax.Array, state: jax.Array, pose: jax.Array, b: jax.Array) -> tuple[jax.Array, jax.Array]:
        whole = [state[i] for i in range(len(state))]
        for k, i in enumerate(block.seen):
            whole[i] = entries[k]
        found = _one(block, jnp.stack(whole), pose, b)
        return found, found

    entries = jnp.stack([reached[:, i] for i in block.seen], 1) if block.seen else reached[:, :0]
    both = jax.jacfwd(one, argnums=(0, 3), has_aux=True)  # forward: half the time of backward in 3-D, and to compile
    (by_state, by_bias), predicted = jax.vmap(both)(entries, reached, rows.pose, local)
    if block.memory:
        predicted = _with_memory(block, rows, reached, predicted)
        # jacobian (N, C, used) by the state entries in `used` from that by the entries in `seen`
        N, C, _ = by_state.shape
        places = np.searchsorted(block.used, block.seen)
        found = jnp.zeros((N, C, len(block.used))).at[:, :, places].set(by_state)
        for c, own in block.memory:
            place = jnp.asarray(np.searchsorted(block.used, own))[rows.sensor % len(own)]
            found = found.at[jnp.arange(N), c, place].set(1.0)
        by_state = found
    score, weight = weigh(block, rows, predicted, levels, expected=expected)
    return Linearised(score, weight, by_state, by_bias * rows.scale[rows.sensor][:, None, :])


@partial(jax.jit, static_argnames=("block", "expected"))
def linearise_biases(
    block: Block, rows: Rows, states: jax.Array, z: jax.Array, levels: jax.Array, *, expected: bool
) -> Linearised:
    """Score, weight and the Jacobian by the biases alone: what needs no derivative by the states."""
    local, reached = read_biases(block, rows, z), states[rows.epoch]

    def one(state: jax.Array, pose: jax.Array, b: jax.Array) -> tuple[jax.Array, jax.Array]:
        found = _one(block, state, pose, b)
        return found, found

    by_bias, predicted = jax.vmap(jax.jacfwd(one, argnums=2, has_aux=True))(reached, rows.pose, local)
    score, weight = weigh(block, rows, _with_memory(block, rows, reached, predicted), levels, expected=expected)
    none = jnp.zeros((*score.shape, 0))
    return Linearised(score, weight, none, by_bias * rows.scale[rows.sensor][:, None, :])


def curvature(block: Block, rows: Rows, states: jax.Array, z: jax.Array, levels: jax.Array) -> jax.Array:
    """Minus the second derivative (N, p, p) of each row's log density by the biases z that it reads."""
    local, scale = read_biases(block, rows, z), rows.scale[rows.sensor]

    def density(b: jax.Array, state: jax.Array, row: Rows) -> Any:
        one = jax.tree.map(lambda leaf: leaf[None], row)
        predicted = _with_memory(block, one, state[None], _one(block, state, row.pose, b)[None])
        return jnp.sum(log_likelihood(block, one, predicted, levels))

    whole = Rows(*(0 if name in BY_ROW else None for name in Rows._fields))  # type: ignore[arg-type]
    second = jax.vmap(jax.jacfwd(jax.grad(density)), (0, 0, whole))(local, states[rows.epoch], rows)
    return -second * scale[:, :, None] * scale[:, None, :]


def standardised(score: jax.Array, information: jax.Array) -> jax.Array:
    """Scores over the root of their information, of mean 0 and variance 1 under the model; zero where missing."""
    there = information > 0
    return jnp.where(there, score / jnp.sqrt(jnp.where(there, information, 1.0)), 0.0)


def square(block: Block, rows: Rows, predicted: jax.Array, levels: jax.Array) -> jax.Array:
    """Square of each standardised score, 1 expected, zero where missing, shape (N, C).

    A yes-or-no channel has twice the negative log probability where that is smaller: nothing to do with a scale.
    """
    score, information = weigh(block, rows, predicted, levels, expected=True)
    found = standardised(score, information) ** 2
    std, families = noise_std(rows, levels), _families(block, rows, levels)
    for c in block.growing:
        own = families[c].square(rows.y[:, c], predicted[:, c], std[:, c])
        found = found.at[:, c].set(jnp.where(rows.mask[:, c] > 0, own, 0.0))
    events = np.array([isinstance(noise, Bernoulli) for noise in block.noises])
    if not events.any():
        return found
    return jnp.where(events, jnp.minimum(found, -2.0 * log_likelihood(block, rows, predicted, levels)), found)


def weigh(
    block: Block, rows: Rows, predicted: jax.Array, levels: jax.Array, *, expected: Any, extra: Any = None
) -> tuple[jax.Array, jax.Array]:
    """Score and step weight (or expected information) of every datum, zero where missing, both (N, C).

    A variance `extra` (N, C) adds to that of the noise.
    """
    std, families = noise_std(rows, levels), _families(block, rows, levels)
    if extra is not None:
        std = jnp.sqrt(std**2 + extra)
    score = rows.mask * _by_channel(block, families, "score", rows.y, predicted, std)
    ways = (
        partial(_information, block, rows, predicted, std, levels),
        partial(_by_channel, block, families, "weight", rows.y, predicted, std),
    )
    weight = jax.lax.cond(expected, *ways) if isinstance(expected, jax.core.Tracer) else ways[not expected]()
    return score, rows.mask * weight


def slopes(block: Block, rows: Rows, predicted: jax.Array, levels: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Score of every datum by its predicted value and the observed information, zero where missing, both (N, C)."""
    std, families = noise_std(rows, levels), _families(block, rows, levels)
    score, slope = jax.jvp(
        lambda p: _by_channel(block, families, "score", rows.y, p, std), (predicted,), (jnp.ones_like(predicted),)
    )
    return rows.mask * score, -rows.mask * slope


def reliance(block: Block, rows: Rows, predicted: jax.Array, levels: jax.Array) -> jax.Array:
    """The weight (N, C) of each datum relative to one that fits: 1 inlying, towards 0 outlying."""
    return _measured(block, rows, "reliance", predicted, levels)


def difference(block: Block, value: jax.Array, other: jax.Array) -> jax.Array:
    """Value minus other of the channels on the last axis, wrapped."""
    parts = [
        value[..., c] - other[..., c] if channel.period is None else wrap(value[..., c] - other[..., c], channel.period)
        for c, channel in enumerate(block.channels)
    ]
    return jnp.stack(parts, -1)
