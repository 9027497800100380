"""What to measure next: the expected information gain of another pass, a survey or a further sensor.

A gain is 1/2 log det of the information of all biases with the addition over that without it, in nats, under a
prior of one scale (or the survey), trajectories marginalised (Lindley 1956).
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import xarray as xr

from probcal.analysis.additions import Informed, gains_of_passes, gains_of_sensors, typical_values
from probcal.analysis.standpoint import check_free, standpoint
from probcal.errors import InputError
from probcal.gaussian.choose import choose, direct_engine
from probcal.gaussian.engine import Factors
from probcal.gaussian.linearised import marginal_information
from probcal.gaussian.mode import Point
from probcal.gaussian.room import check_room
from probcal.identifiability.remedies import WEAK
from probcal.labels import AXES, NOBODY
from probcal.model import variants
from probcal.model.model import Model
from probcal.network import Network, Node
from probcal.problem import Epochs, Problem
from probcal.sensor import SensorType
from probcal.simulate import Truth
from probcal.table import Table, header, unit_factor
from probcal.types import float64

LONGEST = 300  # epochs of the pass that stands as a pattern
HEADINGS, LANES = 8, (-0.5, 0.0, 0.5)  # candidate lines: directions, and distances from the centre in radii
GRID = 5  # candidate places an axis
SURVEY = 0.1  # std of a survey over the scale of its bias
LOOKED, AT_ONCE, LISTED = 1024, 64, 40  # anchors of very many: at most so many, at once, and so many with all above
MARGIN = 0.2  # of the area around nodes and tracks


@float64
def next_passes(
    problem: Problem, *, point: Point | None = None, truth: Truth | None = None, passes: Any = None
) -> xr.Dataset:
    """What one more pass of a target would tell, and where: gain (nats) and weak directions left, the best first.

    A pass is seen by the sensors, at the instants and with the noise that saw the target with most rows (its first
    300 epochs). Candidates are `passes` (P, 2 or more, d), polylines in m travelled evenly, by default straight
    lines through the area in eight directions; places on a grid for static targets. All is taken at the automatic
    start, a `truth` or a `point`. On a network too large for matrices of all biases a pass is seen by the sensors that
    it comes as near to as any of their type was to a target (attribute `reach`, m, the largest of all types), in every
    channel and with the declared noise, and weak directions are not counted. Raises `InputError` for the shape, and for
    a pass that meets more biases than matrices can be made of.
    """
    check_free(problem)
    large = not choose(problem.model).cheap
    if not large:
        check_room(problem.model)
    point = standpoint(problem, point, truth)
    name, part = _pattern(problem)
    epochs, start = part.epochs[0], np.asarray(_states_of(problem, point, name))[: len(part.epochs[0].time)]
    paths = _candidates(problem, point, start, len(epochs.time)) if passes is None else _travelled(passes, epochs.time)
    if paths.ndim != 3 or paths.shape[2] != problem.network.dimension or not np.isfinite(paths).all():
        shape = f"(passes, points, {problem.network.dimension})"
        raise InputError(f"passes has shape {np.shape(passes)}; give {shape} of finite numbers")
    states = np.stack([_state(epochs, start, path) for path in paths])
    told: dict[str, Any] = {}
    if large:
        of_many = Informed.of(problem, point)
        gains = gains_of_passes(of_many, name, np.unique(part.measurements.time), states)
        attrs: dict[str, Any] = {"pattern": name, "reach": max(of_many.reach.values())}
    else:
        added = np.asarray(_of_states(part.model, jnp.asarray(states), point.z, _levels(problem, part, point)))
        known = _information(problem, point)
        gains, left = _gains(problem, known, known + added)
        attrs = {"pattern": name, "weak_before": _weak(problem, known)}
        told["weak"] = left
    order = np.argsort(-gains, kind="stable")
    ends = np.linspace(0, paths.shape[1] - 1, min(paths.shape[1], 20)).round().astype(int)
    return xr.Dataset(
        {"gain": ("pass", gains[order])} | {name: ("pass", column[order]) for name, column in told.items()}
        | {"path": (("pass", "point", "axis"), paths[order][:, ends])},
        coords={"pass": np.arange(len(order)), "axis": list(AXES[: paths.shape[2]])},
        attrs=attrs,
    )  # fmt: skip


@float64
def next_anchors(
    problem: Problem, *, point: Point | None = None, truth: Truth | None = None, survey: float = SURVEY
) -> xr.Dataset:
    """What a survey of a bias, or of a node's position, would tell of the others: gain (nats), weak directions left.

    `survey` is its std over the scale of the bias, `std` the same in the unit of the bias. `gain` is what it tells of
    all other biases, `own` that and what it says of itself. Biases that have a survey are left out where others have
    none. Best first. On a network too large for matrices of all biases it looks at those whose `own` is largest, some
    1,000 of them at most (attribute `looked`), and counts no weak directions.
    Raises `InputError` unless `survey` is positive.

    >>> bool(next_anchors(problem)["gain"][0] > 0)
    True
    """
    if not (np.isfinite(survey) and survey > 0):
        raise InputError(f"next_anchors: survey={survey} must be positive, a std over the scale of a bias")
    check_free(problem)
    point = standpoint(problem, point, truth)
    if not choose(problem.model).cheap:
        return _anchors_of_many(problem, point, survey)
    known = _information(problem, point)
    whole = known + np.eye(len(known))
    covariance, apart = np.linalg.inv(whole), np.linalg.inv(_less_one(problem, known))
    before = _weak(problem, known)
    groups = _anchors(problem)
    found = []
    for g in groups.values():
        eye = np.eye(len(g))
        own = 0.5 * np.linalg.slogdet(eye + covariance[np.ix_(g, g)] / survey**2)[1]
        alone = 0.5 * np.linalg.slogdet(eye + np.linalg.inv(whole[np.ix_(g, g)]) / survey**2)[1]  # the others known
        inner = np.linalg.eigvalsh(-eye - apart[np.ix_(g, g)] / survey**2)  # inertia of the sum (Haynsworth 1968)
        found.append((own - alone, own, before + int((inner < 0).sum()) - len(g), survey * problem.scales[g[0]]))
    gain, own, left, std = (np.array(column) for column in zip(*found, strict=True))
    columns = {"gain": gain, "own": own, "weak": left, "std": std}
    return _ranked(problem, groups, columns, {"survey": survey, "weak_before": before})


def _ranked(
    problem: Problem, groups: dict[str, list[int]], columns: dict[str, np.ndarray], attrs: dict[str, Any]
) -> xr.Dataset:
    """Anchors with what is known of each, the largest gain first."""
    order = np.lexsort((-columns["own"], -columns["gain"]))
    return xr.Dataset(
        {name: ("anchor", column[order]) for name, column in columns.items()}
        | {"unit": ("anchor", np.array([problem.biases[g[0]].unit for g in groups.values()], str)[order])},
        coords={"anchor": np.array(list(groups))[order]},
        attrs=attrs,
    )


def _anchors_of_many(problem: Problem, point: Point, survey: float) -> xr.Dataset:
    """The same where no matrix of all biases is made: `own` of all anchors by the selected inverse, the gain of those
    that can have the largest, since none has more than its `own`, by solves with the trajectories.
    """
    model, M = problem.model.by_information(), problem.model.biases
    at = direct_engine().at(model, point)
    anchors = _anchors(problem)
    names, members = list(anchors), _padded(list(anchors.values()), M)
    there = (members < M)[:, :, None] & (members < M)[:, None, :]
    covariance = np.where(there, at.marginals(Factors.alone(np.ones(M)), members), 0.0)
    eye = np.eye(members.shape[1])
    own = 0.5 * np.linalg.slogdet(eye + covariance / survey**2)[1]
    held, (across, inner) = at.library(*at.joint.of_states(at.entries)), at.joint.with_biases(at.entries)
    gain, looked = np.full(len(own), -np.inf), np.argsort(-own, kind="stable")[:LOOKED]
    for mine in np.split(looked, np.arange(AT_ONCE, len(looked), AT_ONCE)):
        if np.sort(gain)[-LISTED:][0] >= own[mine[0]]:  # no other can have more
            break
        index = np.unique(members[mine][members[mine] < M])
        columns = across[:, index].toarray()
        known = inner[index][:, index].toarray() + np.eye(len(index)) - columns.T @ held.solve(columns)
        place = np.minimum(np.searchsorted(index, members[mine]), len(index) - 1)
        known = np.where(there[mine], known[place[:, :, None], place[:, None, :]], eye)
        alone = np.where(there[mine], np.linalg.inv(known), 0.0)  # the others known
        gain[mine] = own[mine] - 0.5 * np.linalg.slogdet(eye + alone / survey**2)[1]
    kept = np.flatnonzero(np.isfinite(gain))
    columns = {"gain": gain[kept], "own": own[kept], "std": survey * problem.scales[members[kept, 0]]}
    groups = {names[k]: members[k].tolist() for k in kept}
    return _ranked(problem, groups, columns, {"survey": survey, "looked": len(kept)})


def _padded(groups: list[list[int]], blank: int) -> np.ndarray:
    """Groups (B, p) of numbers, filled up behind."""
    width = max(map(len, groups))
    return np.array([[*group, *[blank] * (width - len(group))] for group in groups])


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
    """What one more sensor of each type, its pose known, would tell about the biases that there are: gain (nats).

    It sees every target at every epoch; its own biases are free. `places` (P, d) in m are by default a grid over the
    area; the second node of a two-node type is that of its first sensor. Best first. On a network too large for
    matrices of all biases it sees targets that are as near as any of its type saw one. Raises `InputError` for the
    shape.

    >>> bool(next_sensors(problem, places=[(100.0, -50.0), (300.0, 80.0)])["gain"][0] > 0)
    True
    """
    check_free(problem)
    large = not choose(problem.model).cheap
    if not large:
        check_room(problem.model)
    point = standpoint(problem, point, truth)
    d = problem.network.dimension
    places = _grid(problem, point) if places is None else np.asarray(places, float)
    if places.ndim != 2 or places.shape[1] != d or not np.isfinite(places).all():
        raise InputError(f"places has shape {places.shape}; give (places, {d}) of finite numbers")
    told = Informed.of(problem, point) if large else None
    known = np.zeros((0, 0)) if large else _information(problem, point)
    found = []
    for kind in problem.network.types:
        gains = _gains_at(problem, point, known, kind, places) if told is None else gains_of_sensors(told, kind, places)
        found += [(kind.name, gain, place) for gain, place in zip(gains, places, strict=True)]
    found.sort(key=lambda row: -row[1])
    return xr.Dataset(
        {"gain": ("candidate", [gain for _, gain, _ in found]), "type": ("candidate", [name for name, *_ in found]),
         "place": (("candidate", "axis"), np.stack([place for *_, place in found]))},
        coords={"axis": list(AXES[:d])},
    )  # fmt: skip


def _gains_at(problem: Problem, point: Point, known: np.ndarray, kind: SensorType, places: np.ndarray) -> np.ndarray:
    """Gains (P,) of one more sensor of a type at places (P, d)."""
    wider, mine = _with_sensor(problem, kind)
    M = len(known)
    z = jnp.concatenate([point.z, jnp.zeros(len(wider.labels) - M)])
    moved = point._replace(z=z, levels=_levels(problem, wider, point))
    matrices = np.asarray(_of_places(wider.model, moved, jnp.asarray(places), mine))
    inner, cross = matrices[:, M:, M:] + np.eye(matrices.shape[1] - M), matrices[:, M:, :M]
    return _gains(problem, known, matrices[:, :M, :M] - cross.mT @ np.linalg.solve(inner, cross))[0]


# Information


@jax.jit
def _of_states(model: Model, states: jax.Array, z: jax.Array, levels: jax.Array) -> jax.Array:
    """Information (C, M, M) of one target along each of the states (C, E, n)."""
    return jax.lax.map(lambda x: marginal_information(model, Point((x,), (jnp.zeros_like(x),), z, levels)), states)


@jax.jit
def _of_places(model: Model, point: Point, places: jax.Array, mine: tuple[jax.Array, ...]) -> jax.Array:
    """Information (C, M, M) with the first node of the rows `mine` (N,) of each block at each of the places (C, d)."""
    return jax.lax.map(lambda place: marginal_information(variants.placed(model, mine, place), point), places)


def _information(problem: Problem, point: Point) -> np.ndarray:
    return np.asarray(marginal_information(problem.model.by_information(), point))


def _gains(problem: Problem, known: np.ndarray, with_it: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gains (C,) of information matrices (C, M, M) over a known one, and the weak directions that each leaves."""
    eye = np.eye(len(known))
    gains = 0.5 * (np.linalg.slogdet(with_it + eye)[1] - np.linalg.slogdet(known + eye)[1])
    return gains, np.array([_weak(problem, matrix) for matrix in with_it])


def _weak(problem: Problem, information: np.ndarray) -> int:
    """Number of weak directions of an information (M, M), surveyed biases marginalised."""
    return int((np.linalg.eigvalsh(_less_one(problem, information)) < 0).sum())


def _less_one(problem: Problem, information: np.ndarray) -> np.ndarray:
    """A matrix (M, M) with a negative eigenvalue for each weak direction, those of its Schur complement."""
    return information + np.diag(np.where(problem.surveyed, 1.0, -WEAK))


def _levels(problem: Problem, other: Problem, point: Point) -> jax.Array:
    """The point's log levels in the order of another problem of the same network; those it lacks at their guess."""
    known = dict(zip([level.label for level in problem.levels], np.asarray(point.levels), strict=True))
    return jnp.asarray([float(known.get(level.label, 0.0)) for level in other.levels])


# Candidates


def _pattern(problem: Problem) -> tuple[str, Problem]:
    """The target with most rows, and the problem of its first epochs alone."""
    data = problem.measurements
    seen = data.target[np.array(data.target_names)[data.target] != NOBODY]
    if not len(seen):
        raise InputError("next_passes: no row has a target; next_anchors and next_sensors tell what else would help")
    counts = np.bincount(seen, minlength=len(data.target_names))
    mine = data.target == int(counts.argmax())
    times = np.unique(data.time[mine])
    kept = np.flatnonzero(mine & (data.time <= times[min(LONGEST, len(times)) - 1]))
    return data.target_names[int(counts.argmax())], problem.select(kept)


def _states_of(problem: Problem, point: Point, name: str) -> np.ndarray:
    """States (E, n) of one target at a point."""
    for own, _, states in problem.tracks(point.states):
        if own == name:
            return states
    raise KeyError(name)


def _state(epochs: Epochs, like: np.ndarray, path: np.ndarray) -> np.ndarray:
    """States (E, n) along a path (E, d); what is neither position nor its derivatives has the mean of a recording."""
    state = np.broadcast_to(like.mean(0), like.shape).copy()
    for name, first, stop, _ in epochs.layout:
        if name == "position":
            state[:, first:stop] = path
        elif name == "velocity":
            state[:, first:stop] = np.gradient(path, epochs.time, axis=0) if len(path) > 1 else 0.0
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
    flat = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
    return np.concatenate([flat, np.broadcast_to(low[2:], (len(flat), len(low) - 2))], 1)


def _candidates(problem: Problem, point: Point, like: np.ndarray, epochs: int) -> np.ndarray:
    """Paths (P, E, d): straight lines through the area, or places of a static target."""
    if epochs == 1:
        return _grid(problem, point)[:, None]
    low, high = _area(problem, point)
    centre, radius = (low + high) / 2, float(np.linalg.norm((high - low)[:2])) / 2
    along = np.linspace(-radius, radius, epochs)
    paths = []
    for angle in np.pi * np.arange(HEADINGS) / HEADINGS:
        ahead, left = np.zeros(len(low)), np.zeros(len(low))
        ahead[:2], left[:2] = (np.cos(angle), np.sin(angle)), (-np.sin(angle), np.cos(angle))
        paths += [centre + lane * radius * left + along[:, None] * ahead for lane in LANES]
    return np.stack(paths)


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


def _with_sensor(problem: Problem, kind: SensorType) -> tuple[Problem, tuple[jax.Array, ...]]:
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
    seen = frame[~there].drop_duplicates([columns[c] for c in ("time", "target") if c in columns])
    units, typical = header(data.table)[1], typical_values(problem, kind)
    own = {
        columns[c]: typical[c] / unit_factor(data.table, c, units[c], channel.unit)
        for c, channel in kind.expand(network.dimension) if c in columns
    }  # fmt: skip
    blank = {column: np.nan for c, column in columns.items() if c not in ("time", "target", "sensor")}
    rows = seen.assign(**blank).assign(**own, **{columns["sensor"]: name})
    table = Table(pd.concat([frame, rows], ignore_index=True), data.table.source, np.arange(len(frame) + len(rows)))
    wider = Problem(
        Network([*network.sensors, placed], frame=network.frame), problem.motion, table, fix=problem.fixed,
        epoch=problem.epoch,
    )  # fmt: skip
    number, read = len(wider.network.sensors) - 1, wider.measurements.sensor
    return wider, tuple(jnp.asarray(read[index] == number) for index in wider.row_index)
