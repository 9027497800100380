"""Labelled groups of a tree: data, states by epoch, directions, and what the network states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from probcal.geodesy import GEODETIC
from probcal.labels import AXES
from probcal.lazy import xr
from probcal.model.model import Recursion
from probcal.results.views import view_variables

if TYPE_CHECKING:
    from probcal.gaussian.mode import Point
    from probcal.problem import Problem
    from probcal.results.answer import Tracks


def bias_coords(problem: Problem, chosen: Any = None) -> dict[str, Any]:
    """Coordinates of all biases, or of those `chosen` (boolean or numbers): label, and what xarray can select by.

    `owner` (node, sensor, or sensor type where it is shared), `component` and `axis` (empty for a number),
    `sensor_type` (empty for a node's bias), `unit`, and `since`, the time in s of a step, the first of the table for
    what is constant.
    """
    biases = list(problem.biases)
    if chosen is not None:
        index = np.asarray(chosen)
        biases = [biases[m] for m in (np.flatnonzero(index) if index.dtype == bool else index)]
    columns = {name: [getattr(b, name) for b in biases] for name in ("owner", "component", "sensor_type", "unit")}
    columns["axis"] = [AXES[b.axis] if b.vector else "" for b in biases]
    found = along("bias_label", {name: np.array(values, str) for name, values in columns.items()})
    first = float(problem.measurements.time.min())
    since = np.array([first if b.since is None else b.since for b in biases], float)
    return {"bias_label": [b.label for b in biases], **found, "since": ("bias_label", since)}


def datum_of(problem: Problem) -> tuple[dict[str, Any], list[Any]]:
    """Coordinates of the measured data, and where each block keeps them (rows, channels)."""
    data, network = problem.measurements, problem.network
    picks: list[Any] = []
    columns = []
    for _, rows, _, names_, index in problem.model.each_block(problem.columns, problem.row_index):
        where = np.nonzero(np.asarray(rows.mask))
        picks.append(where)
        columns.append((index[where[0]], np.array(names_)[where[1]], np.asarray(rows.y)[where]))
    row = np.concatenate([c[0] for c in columns])
    names = np.array([s.name for s in network.sensors])
    coords = {
        "sensor": ("datum", names[data.sensor[row]]),
        "channel": ("datum", np.concatenate([c[1] for c in columns])),
        "target": ("datum", np.array(data.target_names)[data.target[row]]),
        "time": ("datum", data.time[row]),
        "row": ("datum", data.table.lines[row]),
    }
    return {"coords": coords, "y": np.concatenate([c[2] for c in columns])}, picks


def data_columns(datum: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """The coordinates of every datum from `datum_of`, one column per name."""
    return {name: values for name, (_, values) in datum["coords"].items()}


def gather(parts: Sequence[np.ndarray], picks: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Measured data of all blocks, last axis datum, from arrays (..., N, C)."""
    found = [np.asarray(p)[..., rows, channels] for p, (rows, channels) in zip(parts, picks, strict=True)]
    return np.concatenate(found, -1) if len(found) > 1 else found[0]


def along(dim: Any, values: Mapping[str, Any]) -> dict[str, Any]:
    """Variables of one dimension, or several, by name."""
    return {name: (dim, own) for name, own in values.items()}


def direction_group(labels: Sequence[str], directions: Sequence[Any]) -> xr.Dataset:
    """Directions that the data do not fix: what moves, how weakly it is known, and the remedy."""
    names = ("sentence", "words", "kind", "remedy", "information", "share")
    columns = {name: [getattr(d, name) for d in directions] for name in names}
    columns["fix"] = [" ".join(d.fix) for d in directions]
    group = xr.Dataset(along("direction", columns))
    vectors = (("direction", "bias_label"), np.stack([d.vector for d in directions]))
    return group.assign(vector=vectors).assign_coords(direction=[d.name for d in directions], bias_label=list(labels))


def track_groups(
    problem: Problem,
    tracks: Sequence[Tracks],
    before: Sequence[Any],
    states: Sequence[np.ndarray] = (),
    chains: Mapping[str, Any] | None = None,
) -> dict[str, xr.Dataset]:
    """Mean, sd and uncalibrated mean of every state, a group `track/<target>` each; draws of the states if given."""
    columns: dict[str, tuple[tuple[str, ...], Sequence[Any]]] = {
        name: (("time", "component"), own)
        for name, own in {"mean": [t.mean for t in tracks], "sd": [t.sd for t in tracks], "before": before}.items()
    }
    if len(states):
        columns["state"] = (("chain", "draw", "time", "component"), states)
    found = by_target(problem, columns, chains or {})
    for name, _, weights in problem.tracks(map(weights_of_tails, problem.model.recursions)):
        for variable, weight in weights.items():
            found[node_of(name)][variable] = ("time", weight)
    return {f"track/{name}": group for name, group in found.items()}


def weights_of_tails(part: Recursion) -> dict[str, jax.Array]:
    """Precisions (E,) of the noise of each tail, named by what it drives, with a number where several families do.

    1 is what is declared; an epoch of 0.1 has noise of three times the std.
    """
    found: dict[str, jax.Array] = {}
    for k, tail in enumerate(part.tails):
        twin = [other.name for other in part.tails[:k]].count(tail.name)
        found[f"weight_{tail.name}{f'_{1 + twin}' if twin else ''}"] = tail.weight
    return found


def node_of(target: str) -> str:
    """The name of a target's node: its own, with a sign that may stand in a path; its attribute `target` has it."""
    name = str(target).replace("/", "\N{DIVISION SLASH}")
    return f"{name}_" if set(name) <= {"."} else name


def by_target(
    problem: Problem,
    variables: Mapping[str, tuple[tuple[str, ...], Sequence[Any]]],
    coords: Mapping[str, Any] | None = None,
    kept: Sequence[np.ndarray] | None = None,
) -> dict[str, xr.Dataset]:
    """Variables of each recursion as one dataset a target, by node name: times of its epochs, components of its state.

    A variable is its dimensions and its values by recursion; the dimension `time` of these counts the epochs of the
    recursion, or those `kept` of it (E,).
    """
    found = dict[str, xr.Dataset]()
    for r, epochs in enumerate(problem.epochs):
        there = np.ones(len(epochs.time), bool) if kept is None else kept[r]
        times = epochs.time[there]
        for name, member in epochs.members.items():
            mine = np.flatnonzero(member[there])
            values = {
                key: (dims, np.take(np.asarray(parts[r]), mine, dims.index("time")))
                for key, (dims, parts) in variables.items()
            }
            own = {"time": times[mine], **(coords or {})}
            if any("component" in dims for dims, _ in variables.values()):
                own["component"] = list(epochs.components)
            found[node_of(name)] = xr.Dataset(values, coords=own, attrs={"target": name})
    return found


def constant_group(problem: Problem, point: Point | None = None) -> xr.Dataset:
    """Stated values of the nodes, which of them move, what is placed on them, the fixed biases, and what sensors see.

    A view that is no sector is evaluated at a `point`.
    """
    d, nodes = problem.network.dimension, problem.network.nodes
    stated = [(n.name, component, float(value)) for n in nodes for component, value in n.numbers.items()]
    owners, components, numbers = zip(*stated, strict=True)
    placed = [(sensor, node) for sensor in problem.network.sensors for node in sensor.nodes]
    values = {
        "node_position": (("node", "axis"), np.stack([n.position for n in nodes])),
        "node_heading": ("node", np.array([float(n.components["heading"]) for n in nodes])),
        "moving": ("node", np.array([n.path is not None for n in nodes])),
        "stated": ("value", np.array(numbers)),
    }
    coords = {
        "node": [n.name for n in nodes], "axis": list(AXES[:d]),
        "stated_node": ("value", np.array(owners)), "stated_component": ("value", np.array(components)),
        "placed_sensor": ("placement", np.array([s.name for s, _ in placed])),
        "placed_node": ("placement", np.array([n.name for _, n in placed])),
    }  # fmt: skip
    seen, where = view_variables(problem, point)
    values, coords = values | seen, coords | where
    if problem.fixed:
        values["fixed"] = ("fixed_label", np.array(list(problem.fixed.values())))
        coords["fixed_label"] = list(problem.fixed)
    frame = problem.network.frame
    origin = {} if frame is None else {name: getattr(frame, name) for name in GEODETIC}
    return xr.Dataset(values, coords=coords, attrs=origin)
