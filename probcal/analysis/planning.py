"""The choice of the next measurement: the expected information gain of another pass, a survey or a
further sensor.

A gain is 1/2 log det of the information of all biases with the addition over that without it, in nats, under a
prior of one scale (or the survey), trajectories marginalised (Lindley 1956).
"""

from typing import Any

import numpy as np
import xarray as xr

from probcal.analysis.additions import Informed, gains_of_sensors, informations_of_passes
from probcal.errors import InputError
from probcal.gaussian.mode import Point
from probcal.geometry import lattice
from probcal.identifiability.remedies import WEAK
from probcal.labels import AXES, NOBODY
from probcal.linalg import eigenvalues, invert, log_determinant, outer
from probcal.problem import Epochs, Problem
from probcal.simulate import Truth
from probcal.types import float64

LONGEST = 300  # epochs of the pass that stands as a pattern
HEADINGS, LANES = 8, (-0.5, 0.0, 0.5)  # candidate lines: directions, and distances from the centre in radii
GRID = 5  # candidate places an axis
SURVEY = 0.1  # std of a survey over the scale of its bias
LOOKED, AT_ONCE, LISTED = 1024, 64, 40  # anchors of more: at most so many, at once, and so many with all above
MARGIN = 0.2  # of the area around nodes and tracks


@float64
def next_passes(
    problem: Problem, *, point: Point | None = None, truth: Truth | None = None, passes: Any = None
) -> xr.Dataset:
    """The gain (nats) of each further pass of a target, and weak directions left, the best first.

    It passes at the instants of the target with most rows (its first 300), attribute `pattern`, and is seen by the
    sensors that it comes as near to as any of their type was to a target (attribute `reach`, m, the largest of all
    types), in every channel, with the declared noise or the middle of the stds in the table. Candidates are `passes`
    (P, 2 or more, d), polylines in m travelled evenly, by default straight lines through the area in eight directions;
    places on a grid for static targets. All is taken at the automatic start, a `truth` or a `point`. A large network
    of more than 600 biases has no count of weak directions. Raises `InputError` for the shape, and for a pass that
    meets more biases than a matrix can be made of.
    """
    told = Informed.of(problem, point, truth)
    name, instants, epochs, like = _pattern(problem, told.point)
    time = instants[: len(like)]
    paths = _candidates(problem, told.point, len(time)) if passes is None else _travelled(passes, time)
    if paths.ndim != 3 or paths.shape[2] != problem.network.dimension or not np.isfinite(paths).all():
        shape = f"(passes, points, {problem.network.dimension})"
        raise InputError(f"passes has shape {np.shape(passes)}; give {shape} of finite numbers")
    known, found = told.information, {"gain": np.zeros(len(paths))}
    attrs = {"pattern": name, "reach": max(told.reach.values(), default=0.0)}
    if known is not None:
        attrs["weak_before"] = _weak(problem, known)
        found["weak"] = np.full(len(paths), attrs["weak_before"])
    states = np.stack([_state(epochs, like, time, path) for path in paths])
    for k, met, added in informations_of_passes(told, name, instants, states):
        found["gain"][k] = 0.5 * log_determinant(np.eye(len(met)) + added @ told.covariance(met))
        if known is not None:
            with_it = known.copy()
            with_it[np.ix_(met, met)] += added
            found["weak"][k] = _weak(problem, with_it)
    ends = np.linspace(0, paths.shape[1] - 1, min(paths.shape[1], 20)).round().astype(int)
    found["path"] = paths[:, ends]
    axes = {"pass": np.arange(len(paths)), "axis": list(AXES[: paths.shape[2]])}
    return _ranked(("pass", "point", "axis"), found, axes, attrs)


@float64
def next_anchors(
    problem: Problem, *, point: Point | None = None, truth: Truth | None = None, survey: float = SURVEY
) -> xr.Dataset:
    """The gain (nats) from a survey of a bias or of a node's position; weak directions left.

    `survey` is its std over the scale of the bias, `std` the same in the unit of the bias. `gain` is what it tells of
    all other biases, `own` that and what it says of itself. Biases that have a survey are left out where others have
    none. Best first. Of more than 1,024 anchors it looks at those whose `own` is largest, at most so many (attribute
    `looked`). A large network of more than 600 biases has no count of weak directions.
    Raises `InputError` unless `survey` is positive.

    >>> bool(next_anchors(problem)["gain"][0] > 0)
    True
    """
    if not (np.isfinite(survey) and survey > 0):
        raise InputError(f"next_anchors: survey={survey} must be positive, a std over the scale of a bias")
    told = Informed.of(problem, point, truth)
    anchors = _anchors(problem)
    M, width = len(problem.labels), max(map(len, anchors.values()))
    members = np.array([[*group, *[M] * (width - len(group))] for group in anchors.values()])
    there, eye = members < M, np.eye(width)
    pairs = outer(there)
    covariance = np.where(pairs, told.at.marginals(told.scales, members), 0.0)
    own = 0.5 * log_determinant(eye + covariance / survey**2)
    gain = np.full(len(own), -np.inf)
    looked = np.argsort(-own, kind="stable")[:LOOKED]
    for mine in np.split(looked, np.arange(AT_ONCE, len(looked), AT_ONCE)):
        if len(own) > LOOKED and np.sort(gain)[-LISTED:][0] >= own[mine[0]]:  # no other can have more
            break
        alone = np.where(pairs[mine], invert(_others_known(told, members[mine])), 0.0)
        gain[mine] = own[mine] - 0.5 * log_determinant(eye + alone / survey**2)
    kept = np.flatnonzero(np.isfinite(gain))
    columns = {"gain": gain[kept], "own": own[kept], "std": survey * problem.scales[members[kept, 0]]}
    attrs = {"survey": survey, "looked": len(kept)}
    if told.information is not None:
        attrs["weak_before"] = _weak(problem, told.information)
        columns["weak"] = _weak_after(problem, told.information, members[kept], survey)
    columns["unit"] = np.array([problem.biases[m].unit for m in members[kept, 0]], str)
    columns["anchor"] = np.array(list(anchors))[kept]
    return _ranked(("anchor",), columns, {}, attrs)


def _weak_after(problem: Problem, information: np.ndarray, members: np.ndarray, survey: float) -> np.ndarray:
    """Numbers (B,) of weak directions that a survey of biases (B, p) each would leave."""
    eye, apart = np.eye(members.shape[1]), np.pad(invert(_less_one(problem, information)), (0, 1))
    inner = -eye - apart[members[:, :, None], members[:, None, :]] / survey**2
    gone = len(eye) - (eigenvalues(inner) < 0).sum(1)  # inertia of the sum (Haynsworth 1968)
    return _weak(problem, information) - gone


def _others_known(told: Informed, members: np.ndarray) -> np.ndarray:
    """Precisions (B, p, p) of biases (B, p) with all others known, of none: 1 on the diagonal."""
    M = len(told.problem.labels)
    index = np.unique(members[members < M])
    unit = np.zeros((M, AT_ONCE * members.shape[1]))
    unit[index, np.arange(len(index))] = 1.0
    known = np.pad(np.asarray(told.at.apply(unit))[index, : len(index)], (0, 1))
    place = np.where(members < M, np.searchsorted(index, members), len(index))
    return known[place[:, :, None], place[:, None, :]] + np.eye(members.shape[1])


def _ranked(
    dims: tuple[str, ...], columns: dict[str, np.ndarray], coords: dict[str, Any], attrs: dict[str, Any]
) -> xr.Dataset:
    """Candidates, the first dimension, with what is known of each, the largest gain first."""
    order = np.lexsort((-columns.get("own", columns["gain"]), -columns["gain"]))
    found = {name: (dims[: column.ndim], column[order]) for name, column in columns.items()}
    return xr.Dataset(found, coords, attrs)


def _anchors(problem: Problem) -> dict[str, list[int]]:
    """Biases, and positions of nodes, that may be surveyed: those without a survey, or all where all have one."""
    groups: dict[str, list[int]] = {}
    constant = [m for m, bias in enumerate(problem.biases) if bias.since is None]  # nobody goes out to survey a step
    constant = constant or list(range(len(problem.biases)))
    for m in constant:
        bias = problem.biases[m]
        if problem.surveyed[m] and not problem.surveyed[constant].all():
            continue
        groups[bias.label] = [m]
        if bias.component == "position":
            groups.setdefault(f"{bias.owner}.position_*", []).append(m)
    return groups


@float64
def next_sensors(
    problem: Problem, *, point: Point | None = None, truth: Truth | None = None, places: Any = None
) -> xr.Dataset:
    """The gain (nats) about the present biases from one more sensor of each type, its pose known.

    It sees every target at every epoch at which that is as near as any sensor of its type saw one; its own biases are
    free. `places` (P, d) in m are by default a grid over the area; the second node of a two-node type is that of its
    first sensor. Best first. Raises `InputError` for the shape.

    >>> bool(next_sensors(problem, places=[(100.0, -50.0), (300.0, 80.0)])["gain"][0] > 0)
    True
    """
    told = Informed.of(problem, point, truth)
    d = problem.network.dimension
    places = _grid(problem, told.point) if places is None else np.asarray(places, float)
    if places.ndim != 2 or places.shape[1] != d or not np.isfinite(places).all():
        raise InputError(f"places has shape {places.shape}; give (places, {d}) of finite numbers")
    kinds = problem.network.types
    columns = {"gain": np.concatenate([gains_of_sensors(told, kind, places) for kind in kinds])}
    columns["type"] = np.repeat([kind.name for kind in kinds], len(places))
    columns["place"] = np.tile(places, (len(kinds), 1))
    return _ranked(("candidate", "axis"), columns, {"axis": list(AXES[:d])}, {})


def _weak(problem: Problem, information: np.ndarray) -> int:
    """Number of weak directions of an information (M, M), surveyed biases marginalised."""
    return int((eigenvalues(_less_one(problem, information)) < 0).sum())


def _less_one(problem: Problem, information: np.ndarray) -> np.ndarray:
    """A matrix (M, M) with a negative eigenvalue for each weak direction, those of its Schur complement."""
    return information + np.diag(np.where(problem.surveyed, 1.0, -WEAK))


# Candidates


def _pattern(problem: Problem, point: Point) -> tuple[str, np.ndarray, Epochs, np.ndarray]:
    """The target with most rows: its name, first instants, epochs of its layout, and states (E, n) at these instants.

    A target at rest has one state.
    """
    data = problem.measurements
    seen = data.target[np.array(data.target_names)[data.target] != NOBODY]
    if not len(seen):
        raise InputError("next_passes: no row has a target; next_anchors and next_sensors tell what else would help")
    number = int(np.bincount(seen, minlength=len(data.target_names)).argmax())
    name, instants = data.target_names[number], np.unique(data.time[data.target == number])[:LONGEST]
    own = next(epochs for epochs in problem.epochs if name in epochs.members)
    states = next(states for track, _, states in problem.tracks(point.states) if track == name)
    return name, instants, own, states[: len(instants)]


def _state(epochs: Epochs, like: np.ndarray, time: np.ndarray, path: np.ndarray) -> np.ndarray:
    """States (E, n) along a path (E, d); what is neither position nor its derivatives has the mean of a recording."""
    state = np.broadcast_to(like.mean(0), like.shape).copy()
    for name, first, stop, _ in epochs.layout:
        if name == "position":
            state[:, first:stop] = path
        elif name == "velocity":
            state[:, first:stop] = np.gradient(path, time, axis=0) if len(path) > 1 else 0.0
        elif name == "acceleration":
            state[:, first:stop] = 0.0
    return state


def _area(problem: Problem, point: Point) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner (d,) of nodes and tracks with a margin; in 3-D the height is that of the tracks."""
    d = problem.network.dimension
    places = [problem.node_positions, *problem.positions(point.states)]
    low, high = (np.concatenate(places).min(0), np.concatenate(places).max(0))
    margin = MARGIN * max(float((high - low)[:2].max()), 1.0)
    low, high = low - margin, high + margin
    if d == 3:
        low[2] = high[2] = np.concatenate(places[1:])[:, 2].mean()
    return low, high


def _grid(problem: Problem, point: Point) -> np.ndarray:
    """Places (P, d) on a grid over the area."""
    low, high = _area(problem, point)
    axes = [np.linspace(a, b, GRID) for a, b in zip(low[:2], high[:2], strict=True)]
    flat = lattice(axes)
    return np.concatenate([flat, np.broadcast_to(low[2:], (len(flat), len(low) - 2))], 1)


def _candidates(problem: Problem, point: Point, epochs: int) -> np.ndarray:
    """Paths (P, E, d): straight lines through the area, or places of a static target."""
    if epochs == 1:
        return _grid(problem, point)[:, None]
    low, high = _area(problem, point)
    centre, radius = (low + high) / 2, float(np.linalg.norm((high - low)[:2])) / 2
    angle = np.pi * np.arange(HEADINGS) / HEADINGS
    cos, sin, level = np.cos(angle), np.sin(angle), np.zeros((HEADINGS, len(low) - 2))
    ahead, left = (np.column_stack([*own, level])[:, None, None] for own in ((cos, sin), (-sin, cos)))
    lanes, along = (np.array(LANES) * radius)[:, None, None], np.linspace(-radius, radius, epochs)[:, None]
    return (centre + lanes * left + along * ahead).reshape(-1, epochs, len(low))


def _travelled(passes: Any, time: np.ndarray) -> np.ndarray:
    """Polylines (P, points, d) as paths (P, E, d) travelled at an even pace."""
    lines = np.asarray(passes, float)
    if lines.ndim != 3:
        return lines
    share = (time - time[0]) / max(float(np.ptp(time)), 1e-9)
    paths = []
    for line in lines:
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
        paths.append(np.stack([np.interp(share * length[-1], length, axis) for axis in line.T], -1))
    return np.stack(paths)
