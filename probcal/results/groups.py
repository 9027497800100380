"""Labelled groups of a tree: data, states by epoch, directions, and what the network states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from probcal.lazy import Later

if TYPE_CHECKING:
    import xarray as xr

    from probcal.problem import Problem
else:
    xr = Later("xarray")


class Band(NamedTuple):
    """Mean and sd of the states of one recursion, and their mean without calibration, (E, n) each."""

    mean: np.ndarray
    sd: np.ndarray
    before: np.ndarray


def suffix(problem: Problem, r: int) -> str:
    """What the names of recursion r end with: nothing where there is one only."""
    return "" if len(problem.epochs) == 1 else f"_{r}"


def datum_of(problem: Problem) -> tuple[dict[str, Any], list[Any]]:
    """Coordinates of the measured data, and where each block keeps them (rows, channels)."""
    data, network = problem.measurements, problem.network
    picks: list[Any] = []
    columns = []
    parts = zip(problem.columns, problem.row_index, problem.model.measured, problem.model.values, strict=True)
    for names_, index, there, values in parts:
        where = np.nonzero(np.asarray(there))
        picks.append(where)
        columns.append((index[where[0]], np.array(names_)[where[1]], np.asarray(values)[where]))
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


def gather(parts: Sequence[np.ndarray], picks: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Measured data of all blocks, last axis datum, from arrays (..., N, C)."""
    found = [np.asarray(p)[..., rows, channels] for p, (rows, channels) in zip(parts, picks, strict=True)]
    return np.concatenate(found, -1) if len(found) > 1 else found[0]


def direction_group(labels: Sequence[str], directions: Sequence[Any]) -> xr.Dataset:
    """Directions that the data do not fix: what moves, how weakly it is known, and the remedy."""
    texts = {name: [getattr(d, name) for d in directions] for name in ("sentence", "words", "kind", "remedy")}
    columns = texts | {
        "information": [d.information for d in directions],
        "share": [d.share for d in directions],
        "fix": [" ".join(d.fix) for d in directions],
    }
    group = xr.Dataset({name: ("direction", values) for name, values in columns.items()})
    vectors = (("direction", "bias_label"), np.stack([d.vector for d in directions]))
    return group.assign(vector=vectors).assign_coords(direction=[d.name for d in directions], bias_label=list(labels))


def track_group(problem: Problem, tracks: Sequence[Band]) -> xr.Dataset:
    """Mean, sd and uncalibrated mean of every state, with times and targets of the epochs."""
    found = by_epoch(problem, {name: [getattr(t, name) for t in tracks] for name in ("mean", "sd", "before")})
    for r, part in enumerate(problem.model.recursions):
        for k, tail in enumerate(part.tails):
            found[weight_name(problem, r, k)] = ((f"epoch{suffix(problem, r)}",), np.asarray(tail.weight))
    return found


def weight_name(problem: Problem, r: int, k: int) -> str:
    """What the precisions of tail k of recursion r are called: what it drives, and a number where several families do.

    1 is what is declared; an epoch of 0.1 has noise of three times the std.
    """
    tails = problem.model.recursions[r].tails
    twin = [tail.name for tail in tails[:k]].count(tails[k].name)
    return f"weight_{tails[k].name}{f'_{1 + twin}' if twin else ''}{suffix(problem, r)}"


def by_epoch(problem: Problem, variables: Mapping[str, Sequence[np.ndarray]]) -> xr.Dataset:
    """Variables of each recursion, (E, n) by state component or (E,), with times and targets of the epochs.

    Their names and dimensions carry a suffix where a problem has several recursions.
    """
    values: dict[str, Any] = {}
    coords: dict[str, Any] = {}
    for r, epochs in enumerate(problem.epochs):
        s = suffix(problem, r)
        coords |= {
            f"component{s}": list(epochs.components),
            f"epoch_time{s}": (f"epoch{s}", epochs.time),
            f"epoch_target{s}": (f"epoch{s}", np.asarray(epochs.target, str)),
        }
        for name, parts in variables.items():
            values[f"{name}{s}"] = ((f"epoch{s}", f"component{s}")[: parts[r].ndim], parts[r])
    return xr.Dataset(values, coords=coords)


def constant_group(problem: Problem) -> xr.Dataset:
    """Stated values of the nodes (positions, headings, every component), which of them move, and the fixed biases."""
    d, nodes = problem.network.dimension, problem.network.nodes
    stated = [(n.name, component, float(value)) for n in nodes for component, value in n.numbers.items()]
    owners, components, numbers = zip(*stated, strict=True)
    values = {
        "node_position": (("node", "axis"), np.stack([n.position for n in nodes])),
        "node_heading": ("node", np.array([float(n.components["heading"]) for n in nodes])),
        "moving": ("node", np.array([n.path is not None for n in nodes])),
        "stated": ("value", np.array(numbers)),
    }
    coords: dict[str, Any] = {
        "node": [n.name for n in nodes], "axis": ["x", "y", "z"][:d],
        "stated_node": ("value", np.array(owners)), "stated_component": ("value", np.array(components)),
    }  # fmt: skip
    if problem.fixed:
        values["fixed"] = ("fixed_label", np.array(list(problem.fixed.values())))
        coords["fixed_label"] = list(problem.fixed)
    return xr.Dataset(values, coords=coords)
