"""What further rows would tell of a network too large for matrices of all biases: a pass, or a sensor.

Another pass is a target of its own: eliminated, it leaves an information of the few biases that it meets. A sensor adds
rows to tracks that there are. Either gain is one of log determinants that solves by a factor of the whole make small.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import jax.numpy as jnp
import numpy as np
import pandas as pd

from probcal.model.model import Model
from probcal.model.rows import Linearised, pose_vector
from probcal.network import Network, Node
from probcal.problem import Problem
from probcal.sensor import SensorType
from probcal.smoothing.cholesky import Factor
from probcal.smoothing.joint import JointPrecision
from probcal.smoothing.linearised import linearise_rows
from probcal.smoothing.mode import Point

COLUMNS = 256  # of the inverse at once
REACHED = 1 + 1e-9  # of the reach of a type


@dataclass(frozen=True, eq=False)
class Known:
    """What the data at a point tell, as the joint precision of states and biases under a prior of one scale."""

    problem: Problem
    model: Model
    point: Point

    @classmethod
    def of(cls, problem: Problem, point: Point) -> Known:
        """That of a problem at a point."""
        return cls(problem, problem.model.by_information(), point)

    @cached_property
    def joint(self) -> JointPrecision:
        """Where its entries are."""
        return JointPrecision.of(self.model)

    @cached_property
    def entries(self) -> np.ndarray:
        """Those of data and motion."""
        return self.joint.values(self.model, linearise_rows(self.model, self.point), self.point.levels)

    def whole(self) -> Factor:
        """The factor of states and biases, of use until another is made."""
        return self.joint.factor(self.entries, np.ones(self.model.biases))

    def held(self) -> Factor:
        """The factor of the states at held biases, of use until another is made."""
        return self.joint.states_alone(self.entries)

    @property
    def size(self) -> int:
        """Number of variables."""
        return self.joint.places.size

    @cached_property
    def reach(self) -> dict[SensorType, float]:
        """The largest distance in m between target and nodes at which each type of sensor has a row."""
        found, d = dict.fromkeys(self.problem.network.types, 0.0), self.problem.network.dimension
        for block, data, r in zip(self.model.blocks, self.model.rows, self.model.recursion, strict=True):
            places = np.asarray(self.point.states[r])[np.asarray(data.epoch), slice(*self.problem.epochs[r].position)]
            away = np.linalg.norm(np.asarray(data.pose)[:, :, :d] - places[:, None], axis=2).max(1)
            there = np.asarray(data.mask).any(1)
            found[block.type] = max(found[block.type], float(away[there].max(initial=0.0)) * REACHED)
        return found


def block_of(factor: Factor, index: np.ndarray, size: int) -> np.ndarray:
    """Entries (k, k) of the inverse of a factorised matrix (size, size) between some variables (k,)."""
    found = np.empty((len(index), len(index)))
    for start in range(0, len(index), COLUMNS):
        mine = index[start : start + COLUMNS]
        eye = np.zeros((size, len(mine)))
        eye[mine, np.arange(len(mine))] = 1.0
        found[:, start : start + COLUMNS] = factor.solve(eye)[index]
    return 0.5 * (found + found.T)


def _gain(added: np.ndarray, covariance: np.ndarray) -> float:
    """1/2 log det of what an information (k, k) makes of a covariance."""
    return 0.5 * float(np.linalg.slogdet(np.eye(len(added)) + added @ covariance)[1])


# Passes


def gains_of_passes(known: Known, name: str, instants: np.ndarray, states: np.ndarray) -> np.ndarray:
    """Gains (P,) in nats of further passes like that of a target, along states (P, E, n) at instants (E,).

    Each is seen, with the noise that is declared, by the sensors that it comes as near to as their type sees; by none
    it tells nothing. A target at rest has one state, seen at all instants.
    """
    problem, M = known.problem, known.model.biases
    table = _rows_of_passes(known, instants, states, name)
    if not len(table):
        return np.zeros(len(states))
    names = list(dict.fromkeys(table["target"]))
    motion = dict.fromkeys(names, problem.target(name))
    passes = Problem(problem.network, motion, table, fix=problem.fixed)
    along = _states_along(passes, names, instants, states)
    point = Point(along, tuple(jnp.zeros_like(x) for x in along), known.point.z, jnp.zeros(0))
    model = passes.model.by_information()
    joint, lins = JointPrecision.of(model), linearise_rows(model, point)
    entries = joint.values(model, lins, point.levels)
    held, across = joint.states_alone(entries), joint.across(entries)
    added = {}  # of all passes first: one factor is kept at a time
    for label, own, states_of_it in _of_each(passes, joint):
        met = np.unique(np.concatenate([_biases(model, b)[rows].ravel() for b, rows in own]))
        met = met[met < M]
        columns = np.zeros((joint.states, len(met)))
        columns[states_of_it] = across[states_of_it][:, met].toarray()  # other passes have none of these states
        information = _own_information(model, lins, own, met) - columns.T @ held.solve(columns)
        added[int(label.partition(" ")[2])] = information, known.joint.states + met
    found, whole = np.zeros(len(states)), known.whole()
    for k, (information, index) in added.items():
        found[k] = _gain(information, block_of(whole, index, known.size))
    return found


def _rows_of_passes(known: Known, instants: np.ndarray, states: np.ndarray, name: str) -> pd.DataFrame:
    """Rows (time, sensor, target, channels) of all passes, whose values say nothing."""
    problem = known.problem
    network, d = problem.network, problem.network.dimension
    epochs = next(own for own in problem.epochs if (own.target == name).any())
    span = slice(*epochs.position)
    paths = np.broadcast_to(states[:, :, span], (len(states), len(instants), d))
    pieces = []
    for placed in network.sensors:
        away = np.zeros(paths.shape[:2])
        for node in placed.nodes:
            stands = pose_vector(node, (), np.clip(instants, *_times(node)))
            away = np.maximum(away, np.linalg.norm(paths - stands[None], axis=2))
        which, k = np.nonzero((away <= known.reach[placed.type]) & _there(placed.nodes, instants)[None])
        values = {channel: 0.0 for channel, _ in placed.type.expand(d)}
        if len(which):
            pieces.append(pd.DataFrame({"time": instants[k], "sensor": placed.name, "target": which} | values))
    if not pieces:
        return pd.DataFrame({"target": []})
    table = pd.concat(pieces, ignore_index=True).sort_values(["target", "time"], kind="stable", ignore_index=True)
    return table.assign(target=[f"pass {k}" for k in table["target"]])


def _times(node: Node) -> tuple[float, float]:
    """From when to when it is known where a node is."""
    return (-np.inf, np.inf) if node.path is None else (float(node.path.time[0]), float(node.path.time[-1]))


def _there(nodes: tuple[Node, ...], instants: np.ndarray) -> np.ndarray:
    """At which instants (E,) it is known where all nodes are."""
    ends = [_times(node) for node in nodes]
    return (instants >= max(first for first, _ in ends)) & (instants <= min(last for _, last in ends))


def _states_along(
    passes: Problem, names: list[str], instants: np.ndarray, states: np.ndarray
) -> tuple[jnp.ndarray, ...]:
    """States (E, n) of each recursion of the problem of all passes."""
    number = {label: int(label.partition(" ")[2]) for label in names}
    found = []
    for epochs in passes.epochs:
        which = np.array([number[label] for label in epochs.target])
        k = np.searchsorted(instants, epochs.time) if states.shape[1] > 1 else np.zeros(len(which), int)
        found.append(jnp.asarray(states[which, k]))
    return tuple(found)


def _of_each(passes: Problem, joint: JointPrecision) -> Iterator[tuple[str, list[tuple[int, np.ndarray]], np.ndarray]]:
    """Each pass: its name, its rows in every block, and its variables among the states."""
    for r, epochs in enumerate(passes.epochs):
        for label in dict.fromkeys(epochs.target.tolist()):
            mine = epochs.target == label
            own = [
                (b, np.flatnonzero(mine[np.asarray(data.epoch)]))
                for b, data in enumerate(passes.model.rows) if passes.model.recursion[b] == r
            ]  # fmt: skip
            slots = np.unique(joint.slots[r][mine])
            yield label, own, slots[slots >= 0]


def _biases(model: Model, b: int) -> np.ndarray:
    """Biases (N, p) of each row of a block, M where there is none."""
    data = model.rows[b]
    return np.asarray(data.bias)[np.asarray(data.sensor)]


def _own_information(
    model: Model, lins: tuple[Linearised, ...], own: list[tuple[int, np.ndarray]], met: np.ndarray
) -> np.ndarray:
    """Information (k, k) about some biases (k,) of some rows of every block, their target known."""
    found = np.zeros((len(met) + 1, len(met) + 1))
    for b, rows in own:
        bias = _biases(model, b)[rows]
        at = np.where(bias < model.biases, np.searchsorted(met, bias), len(met))
        H, weight = np.asarray(lins[b].bias)[rows], np.asarray(lins[b].weight)[rows]
        np.add.at(found, (at[:, :, None], at[:, None, :]), np.einsum("ncp,nc,ncq->npq", H, weight, H))
    return found[:-1, :-1]


# Sensors


def gains_of_sensors(known: Known, kind: SensorType, places: np.ndarray) -> np.ndarray:
    """Gains (P,) in nats of one more sensor of a type at places (P, d), its pose known and its own biases free.

    It sees every target at every instant at which that is as near as sensors of its type see. Its rows add to the
    precision of states and biases, and to that of the states at held biases: the log determinant of the biases'
    information is that of the first less that of the second.
    """
    problem, joint = known.problem, known.joint
    like = next(placed for placed in problem.network.sensors if placed.type == kind)
    pairs = _epochs_seen(known)
    d, pieces, placed = problem.network.dimension, [], []
    taken = {own.name for own in problem.network.sensors} | {node.name for node in problem.network.nodes}
    names = [f"new {k}" if f"new {k}" not in taken else f"new {k} {len(taken)}" for k in range(len(places))]
    stated = {name: value for name, value in like.nodes[0].components.items() if name != "heading"}
    for name, place in zip(names, places, strict=True):
        node = Node(name, tuple(place), like.nodes[0].components["heading"], **stated)
        away = np.linalg.norm(pairs.place - place, axis=1)
        near = np.flatnonzero(away <= known.reach[kind])
        if len(near):
            placed.append(kind.on(node, *like.nodes[1:], name=name))
            values = {channel: 0.0 for channel, _ in kind.expand(d)}
            columns = {"time": pairs.time[near], "sensor": name, "target": pairs.target[near]}
            pieces.append(pd.DataFrame(columns | values))
    found = np.zeros(len(places))
    if not pieces:
        return found
    network = Network(placed, frame=problem.network.frame)
    fixed = {label: value for label, value in problem.fixed.items() if label in network.labels}
    wider = Problem(network, problem.motion, pd.concat(pieces, ignore_index=True), fix=fixed)
    at = [_located(problem, epochs.target, epochs.time) for epochs in wider.epochs]
    states = tuple(jnp.asarray(np.stack([np.asarray(known.point.states[r])[e] for r, e in own])) for own in at)
    old = {label: m for m, label in enumerate(problem.labels)}
    number = np.array([old.get(label, -1) for label in wider.labels] + [-1])
    z = np.append(np.asarray(known.point.z), 0.0)[number[:-1]]
    point = Point(states, tuple(jnp.zeros_like(x) for x in states), jnp.asarray(z), jnp.zeros(0))
    model = wider.model.by_information()
    lins = linearise_rows(model, point)
    added = {}
    variables = [np.stack([joint.slots[r][e] for r, e in own]) for own in at]  # of every epoch
    for name in (own.name for own in placed):
        rows, slots = _rows_of_sensor(wider, name), []
        for b, own in rows:
            of_epochs = variables[model.recursion[b]][:, list(model.blocks[b].used)]
            slots.append(of_epochs[np.asarray(model.rows[b].epoch)[own]])
        added[names.index(name)] = _added_by_rows(known, model, lins, rows, slots, number)
    whole = known.whole()
    for k, (information, index) in added.items():
        found[k] = _gain(information, block_of(whole, index, known.size))
    held = known.held()
    for k, (information, index) in added.items():
        on = index < joint.states
        found[k] -= _gain(information[on][:, on], block_of(held, index[on], joint.states))
    return found


@dataclass(frozen=True, eq=False)
class Seen:
    """Instants at which targets were seen: times (N,), names (N,) and places (N, d)."""

    time: np.ndarray
    target: np.ndarray
    place: np.ndarray


def _epochs_seen(known: Known) -> Seen:
    """Every instant of every target, once."""
    problem, data = known.problem, known.problem.measurements
    _, first = np.unique(np.stack([data.target.astype(float), data.time]), axis=1, return_index=True)
    names, time = np.array(data.target_names, object)[data.target[first]], data.time[first]
    places = [
        np.asarray(known.point.states[r])[e, slice(*problem.epochs[r].position)]
        for r, e in _located(problem, names, time)
    ]
    return Seen(time, names, np.stack(places))


def _located(problem: Problem, target: np.ndarray, time: np.ndarray) -> list[tuple[int, int]]:
    """Recursion and epoch of instants (N,) of targets (N,); a target at rest has one epoch."""
    found = np.zeros((len(time), 2), int)
    for r, epochs in enumerate(problem.epochs):
        for name in dict.fromkeys(epochs.target.tolist()):
            mine, own = np.flatnonzero(target == name), np.flatnonzero(epochs.target == name)
            k = np.minimum(np.searchsorted(epochs.time[own], time[mine]), len(own) - 1)
            found[mine] = np.stack([np.full(len(mine), r), own[k]], 1)
    return [(int(r), int(e)) for r, e in found]


def _rows_of_sensor(problem: Problem, name: str) -> list[tuple[int, np.ndarray]]:
    """Rows of a sensor in every block that has some."""
    number = [own.name for own in problem.network.sensors].index(name)
    found = [
        (b, np.flatnonzero(problem.measurements.sensor[index] == number)) for b, index in enumerate(problem.row_index)
    ]
    return [(b, own) for b, own in found if len(own)]


def _added_by_rows(
    known: Known, model: Model, lins: tuple[Linearised, ...], rows: list[tuple[int, np.ndarray]],
    slots: list[np.ndarray], number: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """What rows add to the precision (k, k) of some variables (k,): those of their states, and biases that there are.

    `slots` (N, u) are the variables of the states of each row, `number` (biases + 1,) those of its biases, -1 of new
    ones, which are integrated.
    """
    places = []
    for (b, own), slot in zip(rows, slots, strict=True):
        bias = _biases(model, b)[own]
        fresh = known.size + bias  # after all variables that there are
        at = np.where(number[bias] >= 0, known.joint.states + number[bias], fresh)
        places.append(np.concatenate([slot, np.where(bias == model.biases, -1, at)], 1))
    index = np.unique(np.concatenate([at.ravel() for at in places]))
    index = index[index >= 0]
    matrix = np.zeros((len(index) + 1, len(index) + 1))
    for (b, own), at in zip(rows, places, strict=True):
        k = np.where(at >= 0, np.searchsorted(index, at), len(index))
        H = np.concatenate([np.asarray(lins[b].state), np.asarray(lins[b].bias)], 2)[own]
        weight = np.asarray(lins[b].weight)[own]
        np.add.at(matrix, (k[:, :, None], k[:, None, :]), np.einsum("ncp,nc,ncq->npq", H, weight, H))
    old, new = index < known.size, np.append(index >= known.size, False)
    inner = matrix[new][:, new] + np.eye(new.sum())
    cross = matrix[new][:, np.append(old, False)]
    added = matrix[:-1, :-1][old][:, old] - cross.T @ np.linalg.solve(inner, cross)
    return added, index[old]
