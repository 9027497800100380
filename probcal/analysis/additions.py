"""The information from further rows: another pass of a target, or one more sensor.

Another pass is a target of its own: eliminated, it leaves an information of the few biases that it meets. A sensor adds
rows to tracks that there are. Either sees what is as near as any sensor of its type saw a target.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

from probcal.analysis.standpoint import check_free, standpoint
from probcal.errors import InputError
from probcal.gaussian.choose import choose
from probcal.gaussian.engine import Expansion, Factors
from probcal.gaussian.held import hold, inform
from probcal.gaussian.linearised import linearise_rows
from probcal.gaussian.mode import Point
from probcal.labels import NOBODY
from probcal.linalg import log_determinant
from probcal.model import variants
from probcal.model.model import Model, scaled
from probcal.model.rows import Linearised, pose_vector
from probcal.network import Network, Node
from probcal.problem import Problem
from probcal.sensor import SensorType
from probcal.simulate import Truth
from probcal.table import Table, header, unit_factor

TOUCHED = 8_000  # biases of which a matrix is made
ROWS = 300_000  # of the passes that are linearised together
REACHED = 1 + 1e-9  # of the reach of a type


@dataclass(frozen=True, eq=False)
class Informed:
    """The information of the data at a point, under a prior of one scale (or the survey) per
    bias."""

    problem: Problem
    at: Expansion
    scales: Factors

    @classmethod
    def of(cls, problem: Problem, point: Point | None, truth: Truth | None) -> Informed:
        """The data of a problem at a point, at a truth, or at its start; raises `InputError` where there is none."""
        check_free(problem)
        model = problem.model.by_information()
        at = choose(model).at(model, standpoint(problem, point, truth))
        if not all(own.all() for own in _finite(at.rows)):
            raise InputError(
                "the rows have no finite derivatives at the point where they are looked at; is a target at the place of"
                " a sensor?"
            )
        return cls(problem, at, Factors.alone(np.ones(model.biases)))

    @property
    def point(self) -> Point:
        """The point."""
        return self.at.point

    @cached_property
    def information(self) -> np.ndarray | None:
        """The information (M, M) of the data; None where the biases are too many for it."""
        return self.at.information()

    @cached_property
    def volume(self) -> float:
        """Log determinant of the precision of the biases."""
        return self.at.log_det(self.scales).value

    def covariance(self, members: np.ndarray) -> np.ndarray:
        """Covariance (k, k) of some biases (k,)."""
        return np.asarray(self.at.marginals(self.scales, members[None]))[0]

    @cached_property
    def reach(self) -> dict[SensorType, float]:
        """The largest distance in m between target and nodes at which each type of sensor that reads one has a row."""
        model, found = self.at.model, {kind: 0.0 for kind in self.problem.network.types if kind.reads_target}
        for block, data, _, away in model.each_block(_away(self.problem, model, self.point)):
            if block.type in found:
                there = np.asarray(data.mask).any(1)
                found[block.type] = max(found[block.type], float(away[there].max(initial=0.0)) * REACHED)
        return found

    def levels(self, other: Problem) -> jax.Array:
        """The log levels in the order of another problem of the same types; those it lacks at their guess."""
        known = dict(zip([own.label for own in self.problem.levels], np.asarray(self.point.levels), strict=True))
        return jnp.asarray([float(known.get(own.label, 0.0)) for own in other.levels])


def _finite(rows: Sequence[Linearised]) -> list[np.ndarray]:
    """True for rows (N,) of each block whose derivatives are finite."""
    return [np.all([np.isfinite(own).reshape(len(own), -1).all(1) for own in lin], 0) for lin in rows]


def _away(problem: Problem, model: Model, point: Point) -> list[np.ndarray]:
    """Distance (N,) of each row of each block between its target and the node that is farthest from it."""
    places, d = problem.positions(point.states), problem.network.dimension
    return [
        np.linalg.norm(np.asarray(data.pose)[:, :, :d] - places[r][np.asarray(data.epoch)][:, None], axis=2).max(1)
        for _, data, r in model.each_block()
    ]


def _typical(problem: Problem, kind: SensorType) -> dict[str, float]:
    """A row of a type: of each channel a value among the largest that were measured, NaN where none was; and stds,
    those in the middle of what the table states."""
    data, found = problem.measurements, dict[str, float]()
    ours = np.array([placed.type == kind for placed in problem.network.sensors])[data.sensor]
    for name, channel in kind.expand(problem.network.dimension):
        j = data.channels.index(name)
        values = data.value[ours & data.measured[:, j], j]
        at = np.argsort(np.abs(values), kind="stable")
        found[name] = float(channel.turned(values[at[int(0.99 * (len(at) - 1))]])) if len(at) else np.nan
        stated = ours & data.has_std[:, j]
        if stated.any():
            found[f"{name}_std"] = float(np.median(data.std[stated, j]))
    return found


# Passes


def informations_of_passes(
    told: Informed, name: str, instants: np.ndarray, states: np.ndarray
) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Further passes of a target along states (P, E, n) at instants (E,) that any sensor sees: number, biases (k,) met,
    and what it tells of these (k, k).

    A target at rest has one state, seen at all instants. Raises `InputError` for a pass that meets too many biases, or
    runs over the place of a sensor.
    """
    (span,) = {epochs.position for epochs in told.problem.epochs if (epochs.target == name).any()}
    paths = np.broadcast_to(states[:, :, slice(*span)], (len(states), len(instants), span[1] - span[0]))
    seen = [_seen(told, instants, path) for path in paths]
    values = {kind: _typical(told.problem, kind) for kind in told.reach}
    counts = np.array([sum(map(len, own)) for own in seen], int)
    for some in np.split(np.arange(len(states)), np.flatnonzero(np.diff(np.cumsum(counts) // ROWS)) + 1):
        some = some[counts[some] > 0]
        if len(some):
            table = pd.concat([_rows_of_pass(told, instants, seen[k], int(k), values) for k in some.tolist()])
            yield from _of_some(told, name, instants, states, some, table)


def _seen(told: Informed, instants: np.ndarray, path: np.ndarray) -> list[np.ndarray]:
    """At which of the instants (E,) each sensor sees what is on a path (E, d)."""
    found = []
    for placed in told.problem.network.sensors:
        near = _farthest(placed.nodes, instants, path) <= told.reach.get(placed.type, -np.inf)
        found.append(np.flatnonzero(near & _there(placed.nodes, instants)))
    return found


def _farthest(nodes: Sequence[Node], instants: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Distance (E,) at instants (E,) between places (E, d) and the node that is farthest from them."""
    stands = [pose_vector(node, (), np.clip(instants, *_times(node))) for node in nodes]
    found: np.ndarray = np.max([np.zeros(len(instants)), *(np.linalg.norm(places - own, axis=1) for own in stands)], 0)
    return found


def _times(node: Node) -> tuple[float, float]:
    """From when to when it is known where a node is."""
    return (-np.inf, np.inf) if node.path is None else (float(node.path.time[0]), float(node.path.time[-1]))


def _there(nodes: Sequence[Node], instants: np.ndarray) -> np.ndarray:
    """At which instants (E,) it is known where all nodes are."""
    there = ((instants >= first) & (instants <= last) for first, last in map(_times, nodes))
    return np.all([np.ones(len(instants), bool), *there], 0)


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


def _of_some(
    told: Informed, name: str, instants: np.ndarray, states: np.ndarray, some: np.ndarray, table: pd.DataFrame
) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """The same of some of the passes, whose rows are in one table: one problem, so that kernels are made once.

    Each pass has biases of its own there, so that one column asks every pass about one bias that it meets.
    """
    problem, M = told.problem, told.at.model.biases
    passes = Problem(problem.network, {f"pass {k}": problem.target(name) for k in some}, table, fix=problem.fixed)
    (epochs,) = passes.epochs  # all are alike
    which = np.searchsorted(some, [int(label.partition(" ")[2]) for label in epochs.target])
    k = np.searchsorted(instants, epochs.time) if states.shape[1] > 1 else np.zeros(len(which), int)
    along = jax.device_put(states[some[which], k])
    pieces = [which[np.asarray(epoch)] for epoch in passes.model.epoch]
    model, read = variants.of_read(variants.split(passes.model.by_information(), pieces, len(some)))
    owner, bias = np.divmod(read, M)
    ends = np.searchsorted(owner, np.arange(len(some) + 1))
    z, levels = np.asarray(told.point.z)[bias], told.levels(passes)
    point = Point((along,), (jnp.zeros_like(along),), z, levels)
    rows = linearise_rows(model, point)
    for *_, own, finite in model.each_block(pieces, _finite(rows)):
        if not finite.all():
            number = some[own[~finite].min()]
            raise InputError(f"pass {number} runs over the place of a sensor that has no derivative there; move it")
    most = int(np.diff(ends).max())
    if most > TOUCHED:
        raise InputError(
            f"pass {some[np.diff(ends).argmax()]} would meet {most} biases, of which a matrix is made: more than"
            f" {TOUCHED} take too much memory; look at fewer sensors or a shorter time"
        )
    columns = np.zeros((len(read), most))
    columns[np.arange(len(read)), np.arange(len(read)) - ends[owner]] = 1.0
    found = inform(model, rows, hold(model, point, rows), columns)
    for number, first, last in zip(some.tolist(), ends[:-1], ends[1:], strict=True):
        own = found[first:last, : last - first]
        yield number, bias[first:last], 0.5 * (own + own.T)


# Sensors


def gains_of_sensors(told: Informed, kind: SensorType, places: np.ndarray) -> np.ndarray:
    """Gains (P,) in nats of one more sensor of a type at places (P, d), its pose known and its own biases free.

    It sees every target at every instant at which that is as near as sensors of its type see; by none it tells nothing.
    Raises `InputError` for a sensor that stands where a target was.
    """
    wider, new = _with_sensor(told.problem, kind)
    number = {label: m for m, label in enumerate(told.problem.labels)}
    old = np.array([number.get(label, -1) for label in wider.labels], int)
    z = np.where(old >= 0, np.append(told.point.z, 0.0)[old], 0.0)
    states = _states_at(told, wider)
    point = Point(states, tuple(jnp.zeros_like(x) for x in states), z, told.levels(wider))
    model, gains = wider.model.by_information(), np.zeros(len(places))
    engine, scales, own = choose(model), Factors.alone(np.ones(len(old))), np.flatnonzero(old < 0)
    for k, place in enumerate(places):
        moved = variants.placed(model, [jax.device_put(mine) for mine in new], jax.device_put(place))
        near = [away <= told.reach.get(kind, np.inf) for away in _away(wider, moved, point)]
        pairs = list(zip(new, near, strict=True))
        if not any(bool((mine & there).any()) for mine, there in pairs):
            continue
        counted = [(~mine | there).astype(float)[:, None] for mine, there in pairs]
        at = engine.at(model, point, scaled(linearise_rows(moved, point), counted))
        if not all(finite.all() for finite in _finite(at.rows)):
            where = ", ".join(f"{v:.4g}" for v in place)
            raise InputError(
                f"a further {kind.name} at ({where}) m would stand where a target was seen, and has no derivative"
                " there; move it aside"
            )
        inner = np.eye(len(own)) + np.asarray(at.apply(np.eye(len(old))[:, own]))[own]
        gains[k] = 0.5 * (at.log_det(scales).value - log_determinant(inner) - told.volume)
    return gains


def _states_at(told: Informed, wider: Problem) -> tuple[jax.Array, ...]:
    """States (E, n) of the targets at the epochs of another problem, those of the nearest epoch not before."""
    known = {name: (time, own) for name, time, own in told.problem.tracks(told.point.states)}
    found = []
    for epochs in wider.epochs:
        states = np.zeros((len(epochs.time), len(epochs.components)))
        for name, mine in epochs.members.items():
            time, own = known[name]
            states[mine] = own[np.minimum(np.searchsorted(time, epochs.time[mine]), len(time) - 1)]
        found.append(jax.device_put(states))
    return tuple(found)


def _with_sensor(problem: Problem, kind: SensorType) -> tuple[Problem, list[np.ndarray]]:
    """The problem with one more sensor of a type that sees every epoch; which rows (N,) of each block are its own."""
    network, data = problem.network, problem.measurements
    like = next(placed for placed in network.sensors if placed.type == kind)
    taken = {placed.name for placed in network.sensors} | {node.name for node in network.nodes}
    name = next(f"new_{k}" for k in range(len(taken) + 1) if f"new_{k}" not in taken)
    stated = {k: v for k, v in like.nodes[0].components.items() if k != "heading"}
    node = Node(name, like.nodes[0].position, like.nodes[0].components["heading"], **stated)
    placed = kind.on(node, *like.nodes[1:], name=name)
    frame = data.table.frame
    columns = dict(zip(header(data.table)[0], frame.columns, strict=True))
    there = kind.reads_target & (np.array(data.target_names)[data.target] == NOBODY)
    seen = frame[~there & _there(placed.nodes, data.time)]
    seen = seen.drop_duplicates([columns[c] for c in ("time", "target") if c in columns])
    units, channels = header(data.table)[1], dict(kind.expand(network.dimension))
    own = {
        columns[c]: value / unit_factor(data.table, c, units[c], channels[c.removesuffix("_std")].unit)
        for c, value in _typical(problem, kind).items() if c in columns
    }  # fmt: skip
    blank = {column: np.nan for c, column in columns.items() if c not in ("time", "target", "sensor")}
    rows = seen.assign(**blank).assign(**own, **{columns["sensor"]: name})
    table = Table(pd.concat([frame, rows], ignore_index=True), data.table.source, np.arange(len(frame) + len(rows)))
    wider = Problem(
        Network([*network.sensors, placed], frame=network.frame), problem.motion, table, fix=problem.fixed,
        epoch=problem.epoch,
    )  # fmt: skip
    number, read = len(wider.network.sensors) - 1, wider.measurements.sensor
    return wider, [read[index] == number for index in wider.row_index]
