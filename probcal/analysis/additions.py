"""What further rows would tell of a network too large for matrices of all biases: a pass, or a sensor.

Another pass is a target of its own: eliminated, it leaves an information of the few biases that it meets. A sensor adds
rows to tracks that there are. Either gain is a difference of log determinants, taken on the few variables that the new
rows touch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax.numpy as jnp
import numpy as np
import pandas as pd

from probcal.errors import InputError
from probcal.gaussian.choose import direct_engine
from probcal.gaussian.engine import Factors
from probcal.gaussian.factor import Factor, leading
from probcal.gaussian.joint import JointPrecision
from probcal.gaussian.linearised import linearise_rows
from probcal.gaussian.mode import Point
from probcal.gaussian.superlu import SuperLU
from probcal.model.model import Model
from probcal.model.rows import Linearised, pose_vector
from probcal.network import Network, Node
from probcal.problem import Problem
from probcal.sensor import Sensor, SensorType

NUMBERS = 40_000_000  # of the right-hand sides of some columns of the inverse
TOUCHED = 8_000  # variables of which a matrix is made
ROWS = 1_000_000  # of the passes that are linearised together
REACHED = 1 + 1e-9  # of the reach of a type


@dataclass(frozen=True, eq=False)
class Informed:
    """What the data at a point tell, as the joint precision of states and biases under a prior of one scale."""

    problem: Problem
    model: Model
    point: Point

    @classmethod
    def of(cls, problem: Problem, point: Point) -> Informed:
        """That of a problem at a point."""
        return cls(problem, problem.model.by_information(), point)

    @cached_property
    def joint(self) -> JointPrecision:
        """Where its entries are."""
        return JointPrecision.of(self.model)

    @cached_property
    def entries(self) -> np.ndarray:
        """Those of data and motion."""
        found = self.joint.values(self.model, linearise_rows(self.model, self.point), self.point.levels)
        if not np.isfinite(found).all():
            raise InputError(
                "the rows have no finite derivatives at the point where they are looked at; is a target at the place of"
                " a sensor?"
            )
        return found

    @cached_property
    def whole(self) -> Factor:
        """The factor of states and biases; sparsax keeps one at a time, so no other is made by it here."""
        alone = Factors.alone(np.ones(self.model.biases))
        return direct_engine().library(self.joint.places, self.joint.under(self.entries, alone))

    @cached_property
    def held(self) -> Factor:
        """The factor of the states at held biases."""
        return SuperLU(*self.joint.of_states(self.entries))

    @property
    def size(self) -> int:
        """Number of variables."""
        return self.joint.places.size

    @cached_property
    def reach(self) -> dict[SensorType, float]:
        """The largest distance in m between target and nodes at which each type of sensor has a row."""
        found, d = dict.fromkeys(self.problem.network.types, 0.0), self.problem.network.dimension
        for block, data, r in self.model.each_block():
            places = np.asarray(self.point.states[r])[np.asarray(data.epoch), slice(*self.problem.epochs[r].position)]
            away = np.linalg.norm(np.asarray(data.pose)[:, :, :d] - places[:, None], axis=2).max(1)
            there = np.asarray(data.mask).any(1)
            found[block.type] = max(found[block.type], float(away[there].max(initial=0.0)) * REACHED)
        return found


def block_of(factor: Factor, index: np.ndarray, size: int) -> np.ndarray:
    """Entries (k, k) of the inverse of a factorised matrix (size, size) between some variables (k,)."""
    found, many = np.empty((len(index), len(index))), max(1, NUMBERS // max(size, 1))
    for start in range(0, len(index), many):
        mine = index[start : start + many]
        eye = np.zeros((size, len(mine)))
        eye[mine, np.arange(len(mine))] = 1.0
        found[:, start : start + many] = factor.solve(eye)[index]
    return 0.5 * (found + found.T)


def _check_touched(what: str, count: int) -> None:
    """Raise `InputError` where matrices of what rows touch do not fit."""
    if count > TOUCHED:
        raise InputError(
            f"{what} would touch {count} biases and state entries, of which matrices are made: more than {TOUCHED} take"
            " too much memory; look at fewer sensors or a shorter time"
        )


def typical_values(problem: Problem, kind: SensorType) -> dict[str, float]:
    """A value of each channel of a type in its unit, among the largest that were measured; NaN where none was."""
    data, found = problem.measurements, dict[str, float]()
    ours = np.array([placed.type == kind for placed in problem.network.sensors])[data.sensor]
    for name, channel in kind.expand(problem.network.dimension):
        j = data.channels.index(name)
        values = data.value[ours & data.measured[:, j], j]
        at = np.argsort(np.abs(values), kind="stable")
        found[name] = float(channel.turned(values[at[int(0.99 * (len(at) - 1))]])) if len(at) else np.nan
    return found


def _gain(added: np.ndarray, covariance: np.ndarray) -> float:
    """1/2 log det of what an information (k, k) makes of a covariance."""
    return 0.5 * float(np.linalg.slogdet(np.eye(len(added)) + added @ covariance)[1])


# Passes


def gains_of_passes(told: Informed, name: str, instants: np.ndarray, states: np.ndarray) -> np.ndarray:
    """Gains (P,) in nats of further passes like that of a target, along states (P, E, n) at instants (E,).

    Each is seen, with the noise that is declared, by the sensors that it comes as near to as their type sees; by none
    it tells nothing. A target at rest has one state, seen at all instants. Raises `InputError` for a pass that meets
    too many biases, or runs over the place of a sensor.
    """
    found = np.zeros(len(states))
    if not len(states):
        return found
    epochs = next(own for own in told.problem.epochs if (own.target == name).any())
    span = slice(*epochs.position)
    paths = np.broadcast_to(states[:, :, span], (len(states), len(instants), span.stop - span.start))
    seen = [_seen(told, instants, path) for path in paths]
    values = {kind: typical_values(told.problem, kind) for kind in told.problem.network.types}
    counts = np.array([sum(map(len, own)) for own in seen])
    for some in np.split(np.arange(len(states)), np.flatnonzero(np.diff(np.cumsum(counts) // ROWS)) + 1):
        some = some[counts[some] > 0]
        if len(some):
            table = pd.concat([_rows_of_pass(told, instants, seen[k], int(k), values) for k in some.tolist()])
            found[some] = _gains_of_some(told, name, instants, states, some, table)
    return found


def _seen(told: Informed, instants: np.ndarray, path: np.ndarray) -> list[np.ndarray]:
    """At which of the instants (E,) each sensor sees what is on a path (E, d)."""
    found = []
    for placed in told.problem.network.sensors:
        near = _farthest(placed.nodes, instants, path) <= told.reach[placed.type]
        found.append(np.flatnonzero(near & _there(placed.nodes, instants)))
    return found


def _farthest(nodes: Sequence[Node], instants: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Distance (E,) at instants (E,) between places (E, d) and the node that is farthest from them."""
    away = np.zeros(len(instants))
    for node in nodes:
        stands = pose_vector(node, (), np.clip(instants, *_times(node)))
        away = np.maximum(away, np.linalg.norm(places - stands, axis=1))
    return away


def _times(node: Node) -> tuple[float, float]:
    """From when to when it is known where a node is."""
    return (-np.inf, np.inf) if node.path is None else (float(node.path.time[0]), float(node.path.time[-1]))


def _there(nodes: Sequence[Node], instants: np.ndarray) -> np.ndarray:
    """At which instants (E,) it is known where all nodes are."""
    ends = [_times(node) for node in nodes]
    first, last = max((a for a, _ in ends), default=-np.inf), min((b for _, b in ends), default=np.inf)
    return (instants >= first) & (instants <= last)


def _rows_of_pass(
    told: Informed,
    instants: np.ndarray,
    seen: list[np.ndarray],
    number: int,
    values: dict[SensorType, dict[str, float]],
) -> pd.DataFrame:
    """Rows (time, sensor, target, channels) of a pass; what they measure does not matter."""
    pieces = list[Any]()
    for placed, k in zip(told.problem.network.sensors, seen, strict=True):
        if len(k):
            own = {"time": instants[k], "sensor": placed.name, "target": f"pass {number}"}
            pieces.append(pd.DataFrame(own | values[placed.type]))
    return pd.concat(pieces, ignore_index=True)


def _gains_of_some(
    told: Informed, name: str, instants: np.ndarray, states: np.ndarray, some: np.ndarray, table: pd.DataFrame
) -> list[float]:
    """Gains in nats of some of the passes, whose rows are in one table: one problem, so that kernels are made once."""
    problem, M = told.problem, told.model.biases
    motion = {f"pass {k}": problem.target(name) for k in some}
    passes = Problem(problem.network, motion, table, fix=problem.fixed)
    (epochs,) = passes.epochs  # all are alike
    which = np.array([int(label.partition(" ")[2]) for label in epochs.target])
    k = np.searchsorted(instants, epochs.time) if states.shape[1] > 1 else np.zeros(len(which), int)
    along = jnp.asarray(states[which, k])
    point = Point((along,), (jnp.zeros_like(along),), told.point.z, jnp.zeros(0))
    model = passes.model.by_information()
    joint, lins = JointPrecision.of(model), linearise_rows(model, point)
    entries = joint.values(model, lins, point.levels)
    (across, _), gains = joint.with_biases(entries), []
    for number in some:
        own = [np.flatnonzero((which == number)[np.asarray(data.epoch)]) for data in model.rows]
        met = np.unique(np.concatenate([_biases(model, b)[rows].ravel() for b, rows in enumerate(own)]))
        met = met[met < M]
        _check_touched(f"pass {number}", len(met))
        slots = joint.slots[0][which == number]
        first, stop = (int(slots.min()), int(slots.max()) + 1) if (slots >= 0).any() else (0, 0)
        information = _own_information(model, lins, own, met)
        if stop > first and np.isfinite(information).all():
            columns = across[first:stop][:, met].toarray()
            held = SuperLU(*leading(joint.places, entries, stop, first))
            information = information - columns.T @ held.solve(columns)
        if not np.isfinite(information).all():
            raise InputError(f"pass {number} runs over the place of a sensor that has no derivative there; move it")
        gains.append(_gain(information, block_of(told.whole, told.joint.states + met, told.size)))
    return gains


def _biases(model: Model, b: int) -> np.ndarray:
    """Biases (N, p) of each row of a block, M where there is none."""
    data = model.rows[b]
    return np.asarray(data.bias)[np.asarray(data.sensor)]


def _own_information(
    model: Model, lins: tuple[Linearised, ...], own: Sequence[np.ndarray], met: np.ndarray
) -> np.ndarray:
    """Information (k, k) about some biases (k,) of some rows of every block, their target known."""
    found = np.zeros((len(met) + 1, len(met) + 1))
    for b, rows in enumerate(own):
        bias = _biases(model, b)[rows]
        at = np.where(bias < model.biases, np.searchsorted(met, bias), len(met))
        H, weight = np.asarray(lins[b].bias)[rows], np.asarray(lins[b].weight)[rows]
        np.add.at(found, (at[:, :, None], at[:, None, :]), np.einsum("ncp,nc,ncq->npq", H, weight, H))
    return found[:-1, :-1]


# Sensors


def gains_of_sensors(told: Informed, kind: SensorType, places: np.ndarray) -> np.ndarray:
    """Gains (P,) in nats of one more sensor of a type at places (P, d), its pose known and its own biases free.

    It sees every target at every instant at which that is as near as sensors of its type see. Its rows add to the
    precision of states and biases, and to that of the states at held biases: the log determinant of the biases'
    information is that of the first less that of the second. Raises `InputError` for a sensor that sees too much.
    """
    problem, joint = told.problem, told.joint
    like = next(placed for placed in problem.network.sensors if placed.type == kind)
    time, target, seen = _instants(told)
    prefix = "new "
    taken = [own.name for own in problem.network.sensors] + [node.name for node in problem.network.nodes]
    while any(name.startswith(prefix) for name in taken):
        prefix = f"another {prefix}"
    stated = {name: value for name, value in like.nodes[0].components.items() if name != "heading"}
    values, placed, pieces = typical_values(problem, kind), dict[int, Sensor](), []
    for k, place in enumerate(places):
        node = Node(f"{prefix}{k}", tuple(place), like.nodes[0].components["heading"], **stated)
        nodes = (node, *like.nodes[1:])
        near = np.flatnonzero((_farthest(nodes, time, seen) <= told.reach[kind]) & _there(nodes, time))
        if len(near):
            placed[k] = kind.on(*nodes, name=node.name)
            pieces.append(pd.DataFrame({"time": time[near], "sensor": node.name, "target": target[near]} | values))
    found = np.zeros(len(places))
    if not pieces:
        return found
    network = Network([*problem.network.sensors, *placed.values()], frame=problem.network.frame)
    wider = Problem(network, problem.motion, pd.concat(pieces, ignore_index=True), fix=problem.fixed)
    at = [_located(problem, epochs.target, epochs.time) for epochs in wider.epochs]
    states = tuple(jnp.asarray(np.stack([np.asarray(told.point.states[r])[e] for r, e in own])) for own in at)
    variables = [np.stack([joint.slots[r][e] for r, e in own]) for own in at]  # of every epoch
    old = {label: m for m, label in enumerate(problem.labels)}
    number = np.array([old.get(label, -1) for label in wider.labels] + [-1])
    z = np.where(number >= 0, np.append(np.asarray(told.point.z), 0.0)[number], 0.0)[:-1]
    point = Point(states, tuple(jnp.zeros_like(x) for x in states), jnp.asarray(z), jnp.zeros(0))
    model = wider.model.by_information()
    lins, first = linearise_rows(model, point), len(problem.network.sensors)
    for s, k in enumerate(placed):
        rows, slots = [], []
        for b, index in enumerate(wider.row_index):
            own = np.flatnonzero(wider.measurements.sensor[index] == first + s)
            of_epochs = variables[model.recursion[b]][:, list(model.blocks[b].used)]
            rows.append(own)
            slots.append(of_epochs[np.asarray(model.rows[b].epoch)[own]])
        what = f"a further {kind.name} at ({', '.join(f'{v:.4g}' for v in places[k])}) m"
        information, index = _added_by_rows(what, told, model, lins, rows, slots, number)
        on = index < joint.states
        found[k] = _gain(information, block_of(told.whole, index, told.size))
        found[k] -= _gain(information[on][:, on], block_of(told.held, index[on], joint.states))
    return found


def _instants(told: Informed) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Every instant (N,) at which a target (N,) was seen, once, and where that was (N, d)."""
    problem, data = told.problem, told.problem.measurements
    _, first = np.unique(np.stack([data.target.astype(float), data.time]), axis=1, return_index=True)
    target, time = np.array(data.target_names, object)[data.target[first]], data.time[first]
    places = [
        np.asarray(told.point.states[r])[e, slice(*problem.epochs[r].position)]
        for r, e in _located(problem, target, time)
    ]
    return time, target, np.stack(places)


def _located(problem: Problem, target: np.ndarray, time: np.ndarray) -> list[tuple[int, int]]:
    """Recursion and epoch of instants (N,) of targets (N,); a target at rest has one epoch."""
    found = np.zeros((len(time), 2), int)
    for r, epochs in enumerate(problem.epochs):
        for name in dict.fromkeys(epochs.target.tolist()):
            mine, own = np.flatnonzero(target == name), np.flatnonzero(epochs.target == name)
            k = np.minimum(np.searchsorted(epochs.time[own], time[mine]), len(own) - 1)
            found[mine] = np.stack([np.full(len(mine), r), own[k]], 1)
    return [(int(r), int(e)) for r, e in found]


def _added_by_rows(
    what: str, told: Informed, model: Model, lins: tuple[Linearised, ...], rows: list[np.ndarray],
    slots: list[np.ndarray], number: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """What rows of every block add to the precision (k, k) of some variables (k,): their states, biases that there are.

    `slots` (N, u) are the variables of the states of each row, `number` (biases + 1,) those of its biases, -1 of new
    ones, which are integrated.
    """
    places = []
    for b, (own, slot) in enumerate(zip(rows, slots, strict=True)):
        bias = _biases(model, b)[own]
        fresh = told.size + bias  # after all variables that there are
        at = np.where(number[bias] >= 0, told.joint.states + number[bias], fresh)
        places.append(np.concatenate([slot, np.where(bias == model.biases, -1, at)], 1))
    index = np.unique(np.concatenate([at.ravel() for at in places]))
    index = index[index >= 0]
    _check_touched(what, len(index))
    matrix = np.zeros((len(index) + 1, len(index) + 1))
    for b, (own, at) in enumerate(zip(rows, places, strict=True)):
        k = np.where(at >= 0, np.searchsorted(index, at), len(index))
        H = np.concatenate([np.asarray(lins[b].state), np.asarray(lins[b].bias)], 2)[own]
        weight = np.asarray(lins[b].weight)[own]
        np.add.at(matrix, (k[:, :, None], k[:, None, :]), np.einsum("ncp,nc,ncq->npq", H, weight, H))
    if not np.isfinite(matrix).all():
        raise InputError(f"{what} would stand where a target was seen, and has no derivative there; move it aside")
    old, new = index < told.size, np.append(index >= told.size, False)
    inner = matrix[new][:, new] + np.eye(new.sum())
    cross = matrix[new][:, np.append(old, False)]
    return matrix[:-1, :-1][old][:, old] - cross.T @ np.linalg.solve(inner, cross), index[old]
