"""Does what a fit leaves of the data follow the geometry: direction, distance, elevation, the reading, its rate?

Every channel of a sensor gets coefficients of such shapes beside the biases, all zero, and all trajectories are
eliminated together at the fit: a score test of each shape, all else following. The strongest is let free, the others
are judged anew beside it, and what is found is confirmed by tracks settled on the data without it.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import jax
import numpy as np

from probcal.analysis import levels, pieces
from probcal.analysis.check import Case, Checked, check
from probcal.analysis.findings import Finding
from probcal.analysis.pieces import HELD, SUSPECT, TOGETHER, Contrast, grid_for
from probcal.analysis.verdict import limit_of
from probcal.gaussian.engine import Expansion, Factors, told_alone
from probcal.geometry import slopes as rates
from probcal.inference import residuals
from probcal.inference.fitted import Judged
from probcal.inference.widen import in_blocks
from probcal.labels import listed
from probcal.linalg import invert
from probcal.noise import Bernoulli

FEWEST = 20  # data of a channel below which it is not looked at
TURNS = 10  # shapes that are let free, at most
TOLD = 1e-2  # share of the information about a shape, all else known, that must be left with all else free
CONFIRMED = 0.5  # share of the expected gain in log density that must be seen where the data are without the shape
SIGNS = ("levels", "process", "channels", "sensors", "rows")  # of what else speaks of it where it explains the misfit
LOOSE = 1e-6  # times the information about a shape, by which one that is free is held

# what the residuals of a channel follow, how many columns that has, and what to declare
SHAPES: Mapping[str, tuple[str, int, str]] = {
    "time": ("the rate of the reading", 1, 'they are late: give the node scale={{"time_offset": {size}}}'),
    "direction": (
        "the direction of the target", 2,
        "add east * jnp.cos(a) + north * jnp.sin(a) to {kind}, a = bearing(target.position - pose.position), with"
        ' biases east and north=Bias("{unit}", {size}{shared})',
    ),
    "distance": (
        "the distance of the target", 2,
        "add slope * r + bend * r**2 to {kind}, r = (norm(target.position - pose.position) - {middle}) / {spread}, with"
        ' biases slope and bend=Bias("{unit}", {size}{shared})',
    ),
    "elevation": (
        "the elevation of the target", 1,
        "add slope * elevation(target.position - pose.position) to {kind}, with a bias"
        ' slope=Bias("{unit}", {size}{shared})',
    ),
    "reading": ("the reading itself", 1, 'multiply {kind} by 1 + gain, with a bias gain=Bias("1", {size}{shared})'),
}  # fmt: skip


class Shape(NamedTuple):
    """What the predictions of some channels have too much, by their numbers among those of the innovations."""

    name: str
    channels: tuple[int, ...]


@check("explained", "factor")
def check_slopes(case: Case) -> Checked:
    """Channels whose residuals follow the geometry, and biases that move by more than `levels.HANGS` sd without it."""
    found = case.once(found_slopes)
    return Checked() if found is None else _said(found)


def found_slopes(case: Case) -> Found | None:
    """The shapes that the data have too much, if tracks settled on the data without them confirm it."""
    with suppress(MemoryError, np.linalg.LinAlgError):
        found = _Looked(case).found()
        if found is not None and found.without is not None:
            return found
    return None


class _Beside(NamedTuple):
    """The expansion in which some shapes have coefficients beside the biases."""

    at: Expansion
    shapes: list[Shape]
    members: np.ndarray  # (shapes, 2) the places of their coefficients, that of none where there is one only
    alone: np.ndarray  # (M',) information of the rows about each parameter, all else known


@dataclass(frozen=True, eq=False)
class _Looked:
    """The shapes of a fit."""

    case: Case

    @property
    def fit(self) -> Judged:
        """The fit."""
        return self.case.fit

    @cached_property
    def kinds(self) -> list[tuple[int, Any, Any]]:
        """Sensor, its type and the declaration of every channel."""
        network = self.fit.problem.network
        number = {placed.name: (s, placed.type) for s, placed in enumerate(network.sensors)}
        labels = self.case.channels.labels.itertuples(index=False)
        return [(*number[name], dict(number[name][1].expand(network.dimension))[channel]) for name, channel in labels]

    @cached_property
    def alike(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Number of the sensor, of the type and of the channel of the type of every channel."""
        channel = self.case.channels.labels["channel"].to_numpy(str)
        kind = [own.name for _, own, _ in self.kinds]
        of_type = [".".join(pair) for pair in zip(kind, channel, strict=True)]
        sensor = np.array([s for s, *_ in self.kinds])
        return sensor, np.unique(kind, return_inverse=True)[1], np.unique(of_type, return_inverse=True)[1]

    @cached_property
    def distances(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean and sd of the distances of targets, by type."""
        size, kind = np.linalg.norm(self.line, axis=1), self.alike[1][self.case.channels.group]
        middle = _means(size[:, None], kind)
        return middle[:, 0], np.sqrt(np.maximum(_means((size[:, None] - middle[kind]) ** 2, kind), 1e-18))[:, 0]

    @cached_property
    def line(self) -> np.ndarray:
        """Lines (D, d) from the first node of every datum to its target."""
        places = self.fit.problem.positions(self.fit.point.states)
        found = []
        for _, data, r in self.fit.problem.model.each_block():
            line = places[r][np.asarray(data.epoch)] - np.asarray(data.pose)[:, 0, : places[r].shape[1]]
            found.append(np.broadcast_to(line.T[:, :, None], (line.shape[1], *np.shape(data.y))))
        return self.fit.flat(found).T

    @cached_property
    def standard(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Columns (D, k) of each shape, in std of the noise of size one over all sensors of a type, and these sizes by
        channel.

        The constant part of a channel is taken out, but of times and gains, and all where its data are too few.
        """
        fit, group, line = self.fit, self.case.channels.group, self.line
        _, kind, of_type = self.alike
        counts = np.bincount(group)
        far = ((np.linalg.norm(line, axis=1) - self.distances[0][kind[group]]) / self.distances[1][kind[group]])[
            :, None
        ]
        flat = np.maximum(np.hypot(line[:, 0], line[:, 1]), 1e-9)[:, None]
        weight = np.maximum(fit.flat([lin.weight for lin in fit.lins]), 1e-300)[:, None]
        score = fit.flat([lin.score for lin in fit.lins])[:, None]
        raw = {"time": _rates(fit)[:, None], "direction": line[:, :2] / flat, "distance": np.hstack([far, far**2])}
        if line.shape[1] == 3:
            raw["elevation"] = np.arctan2(line[:, 2:], flat)
        raw["reading"] = fit.flat([data.y for data in fit.problem.model.rows])[:, None] - score / weight
        found = {}
        for name, values in raw.items():
            needs = {"time": lambda own: own.reads_target, "reading": lambda own: True}
            has = needs.get(name, lambda own: own.reads_target and own.arity == 1)
            there = [
                has(own) and not (isinstance(c.noise, Bernoulli) or (name == "reading" and c.wrap))
                for _, own, c in self.kinds
            ]
            values = np.where((np.array(there) & (counts >= FEWEST))[group, None], values, 0.0)
            if name not in needs:
                values = values - _means(values, group)[group]
            over = (kind if name == "time" else of_type)[group]
            size = np.sqrt(_means(values**2 * weight, over))[over]
            found[name] = np.divide(values, size, out=np.zeros_like(values), where=size > 1e-9), size
        return found

    @cached_property
    def shapes(self) -> list[Shape]:
        """The shapes of every channel, and of all of a type; of times of every sensor, and of a type."""
        group, (sensor, kind, of_type) = self.case.channels.group, self.alike
        found = dict[Shape, None]()
        for name, (values, _) in self.standard.items():
            told = np.bincount(group, np.abs(values).sum(1)) > 0
            for key in (sensor, kind) if name == "time" else (np.arange(len(told)), of_type):
                for number in np.unique(key[told]):
                    found[Shape(name, tuple(np.flatnonzero(told & (key == number)).tolist()))] = None
        return list(found)

    @cached_property
    def along(self) -> np.ndarray:
        """Columns (rows, q) of the differences of `check_segments`, whose kernels are there, none of them zero; of ones
        where these have no room for two coefficients."""
        own = grid_for(self.fit).along
        least = -(-2 // max(int(self.read.min()), 1))
        return own + 1.0 if own.shape[1] >= least else np.ones((len(own), least))

    @cached_property
    def read(self) -> np.ndarray:
        """How many biases the rows of each sensor read, (sensors,)."""
        found, problem = np.full(len(self.fit.problem.network.sensors), np.iinfo(int).max), self.fit.problem
        for index, data in zip(problem.row_index, problem.model.rows, strict=True):
            own = problem.measurements.sensor[index]
            found[own] = np.minimum(found[own], data.bias.shape[1])
        return found

    def packed(self, shapes: Sequence[Shape], q: int) -> list[tuple[list[Shape], list[int]]]:
        """The shapes, and their first slots, in as many expansions of q columns as their coefficients need."""
        M, room, found = self.fit.problem.model.biases, q * self.read, list[tuple[list[Shape], list[int]]]()
        used = list[np.ndarray]()
        for shape in shapes:
            size, own = SHAPES[shape.name][1], np.unique(self.alike[0][list(shape.channels)])
            if room[own].min() < size:
                continue
            for k in range(len(found) + 1):
                if k == len(found):
                    found.append(([], []))
                    used.append(np.zeros(len(room) + 1, int))
                first = int(used[k][own].max())
                if first + size <= room[own].min() and used[k][-1] + size <= q * M:
                    break
            found[k][0].append(shape)
            found[k][1].append(first)
            used[k][own] = first + size
            used[k][-1] += size
        return found

    def beside(self, shapes: list[Shape], slots: list[int], along: np.ndarray) -> _Beside:
        """The expansion with the coefficients of some shapes from these slots on, `along` the differences of biases."""
        problem, group, q = self.fit.problem, self.case.channels.group, along.shape[1]
        model = problem.model
        none = model.biases * (1 + q)
        members, taken = np.full((len(shapes), 2), none), model.biases
        owner = [np.zeros(len(data.bias), int) for data in model.rows]
        for place, data, index in zip(owner, model.rows, problem.row_index, strict=True):
            place[np.asarray(data.sensor)] = problem.measurements.sensor[index]
        tables = [np.full((len(data.bias), q * data.bias.shape[1]), none) for data in model.rows]
        columns = np.zeros((len(group), max(table.shape[1] for table in tables)))
        for k, (shape, first) in enumerate(zip(shapes, slots, strict=True)):
            size = SHAPES[shape.name][1]
            members[k, :size] = own = taken + np.arange(size)
            taken += size
            here, mine = slice(first, first + size), np.isin(group, shape.channels)
            columns[mine, here] = self.standard[shape.name][0][mine]
            for place, table in zip(owner, tables, strict=True):
                table[np.isin(place, self.alike[0][list(shape.channels)]), here] = own
        parts = zip(in_blocks(self.fit, columns), tables, strict=True)
        at = pieces.with_parameters(self.fit, along, tables, [np.asarray(c)[..., : t.shape[1]] for c, t in parts])
        return _Beside(at, shapes, members, told_alone(at))

    def factors(self, beside: _Beside, free: Sequence[int], most: float = 1.0) -> tuple[Factors, np.ndarray]:
        """The prior of the fit, all coefficients held at zero but those of the shapes in `free`; and how strongly these
        are (M' + 1,).

        Precisions are one at most, the declared scale: what a sparse prior holds at zero may move before a shape is
        blamed.
        """
        M, alone = self.fit.problem.model.biases, np.append(beside.alone, 0.0)
        held, own = HELD * (1.0 + alone), beside.members[list(free)]
        held[own] = LOOSE * (1.0 + alone[own])
        held[:M] = 0.0
        prior = np.where(np.arange(len(held)) < M, np.minimum(self.fit.factors.diagonal(len(held)), most), held)
        return Factors.alone(prior[:-1]), held

    def mean(self, beside: _Beside, factors: Factors) -> np.ndarray:
        """The step (M' + 1,) of all parameters from the fit to their mean."""
        pull = np.asarray(beside.at.slope()) + factors.pull(beside.at.point.z)
        return np.append(np.asarray(beside.at.solve(factors, pull)), 0.0)

    def tests(self, beside: _Beside, free: Sequence[int] = ()) -> dict[int, Contrast]:
        """Each shape by itself, beside those in `free`, by its number."""
        factors, held = self.factors(beside, free)
        step, own = self.mean(beside, factors)[beside.members], held[beside.members]
        inverse = invert(np.asarray(beside.at.marginals(factors, beside.members)))
        score = np.einsum("bij,bj->bi", inverse, step)
        there, found = beside.members < len(held) - 1, dict[int, Contrast]()
        least = TOLD * np.append(beside.alone, 0.0)[beside.members[:, 0]]
        for k, mine in enumerate(there):
            if k not in free:
                information = (inverse[k] - np.diag(own[k]))[np.ix_(mine, mine)]
                one = pieces.contrast(information, score[k, mine], max(least[k], pieces.LEAST))
                if one is not None:
                    found[k] = one
        return found

    def moves(self, beside: _Beside, step: np.ndarray) -> list[np.ndarray]:
        """By how much a step (M' + 1,) moves the predictions (N, C) of each block."""
        parts = beside.at.model.each_block(beside.at.model.read, beside.at.rows)
        return [np.einsum("ncp,np->nc", lin.bias, step[read]) for *_, read, lin in parts]

    def wide(self, beside: _Beside, tested: Mapping[int, Contrast]) -> np.ndarray:
        """Inflation of the squares of each channel, its likeliest shape taken out: overdispersion times memory of the
        innovations, not less than in the mean."""
        case, best = self.case, dict[tuple[int, ...], tuple[float, int]]()
        for k, own in tested.items():
            mine = beside.shapes[k].channels
            best[mine] = max(best.get(mine, (0.0, k)), (own.square / limit_of(1, own.freedom), k))
        factors, _ = self.factors(beside, [k for _, k in best.values()])
        shift = [jax.device_put(own) for own in self.moves(beside, self.mean(beside, factors))]
        freed = case.innovations._replace(value=residuals.moved_innovations(self.fit, case.filtered, shift))
        found = residuals.scatter_of(self.fit.data, freed, case.channels.members)
        each: np.ndarray = np.maximum(found.size * found.memory, 1.0)
        return np.maximum(each, np.mean(each[case.channels.group]))

    def found(self) -> Found | None:
        """The shapes that the data have too much, the strongest first."""
        q, wide = self.along.shape[1], np.full(len(self.kinds), np.inf)
        over = dict[Shape, Contrast]()

        def ratio(shape: Shape, own: Contrast) -> float:
            return own.square / float(np.mean(wide[list(shape.channels)])) / limit_of(len(self.shapes), own.freedom)

        def looked(packed: Any, along: np.ndarray) -> tuple[_Beside, dict[int, Contrast]]:
            beside = self.beside(packed[0], packed[1], along)
            tested = self.tests(beside)
            np.minimum(wide, self.wide(beside, tested), out=wide)
            return beside, tested

        for packed in (parts := self.packed(self.shapes, q)):
            beside, tested = looked(packed, self.along)
            over |= {beside.shapes[k]: own for k, own in tested.items()}
        order = sorted(over, key=lambda shape: -ratio(shape, over[shape]))
        order = [shape for shape in order if ratio(shape, over[shape]) > SUSPECT][: TOGETHER // 2]
        if not order or ratio(order[0], over[order[0]]) <= 1.0:
            return None
        if len(parts) > 1:  # together, in kernels of their own
            needed = next(n for n in itertools.count(q) if len(self.packed(order, n)) == 1)
            beside, tested = looked(self.packed(order, needed)[0], np.ones((len(self.along), needed)))
        free = dict[int, tuple[float, float]]()
        while len(free) < TURNS and tested:
            k = max(tested, key=lambda k: ratio(beside.shapes[k], tested[k]))
            own = tested[k]
            if (most := ratio(beside.shapes[k], own)) <= 1.0:
                break
            limit = float(np.sqrt(limit_of(len(self.shapes), own.freedom)))
            free[k] = limit * float(np.sqrt(most)), limit
            tested = self.tests(beside, list(free))
        return Found(self, beside, free) if free else None


@dataclass(frozen=True, eq=False)
class Found:
    """Shapes that the data have too much."""

    looked: _Looked
    beside: _Beside
    free: dict[int, tuple[float, float]]  # which of the shapes, the strongest first, and how many sd, and their limit

    @property
    def ratio(self) -> float:
        """The chi-square of the strongest over its limit."""
        sd, limit = next(iter(self.free.values()))
        return (sd / limit) ** 2

    @cached_property
    def factors(self) -> Factors:
        """The factors under which they are free."""
        return self.looked.factors(self.beside, list(self.free), np.inf)[0]

    @cached_property
    def step(self) -> np.ndarray:
        """The step (M' + 1,) of all parameters."""
        return self.looked.mean(self.beside, self.factors)

    @cached_property
    def moved(self) -> np.ndarray:
        """By how much the biases (M,) move for them, in z."""
        rest = self.looked.mean(self.beside, self.looked.factors(self.beside, (), np.inf)[0])
        return (self.step - rest)[: self.looked.fit.problem.model.biases]

    @cached_property
    def without(self) -> residuals.Innovations | None:
        """The innovations of the data without them, tracks settled anew; None where the fit gains too little."""
        fit, prior = self.looked.fit, self.looked.fit.factors
        M, z = fit.problem.model.biases, np.asarray(fit.point.z)
        shift = self.looked.moves(self.beside, np.where(np.arange(len(self.step)) < M, 0.0, self.step))
        model = fit.problem.model.with_rows(
            lambda data, own: {"y": np.where(np.asarray(data.mask) > 0, np.asarray(data.y) - own, 0.0)}, shift
        )
        at = fit.engine.settled(model, fit.point._replace(z=jax.device_put(z + self.step[:M])))
        expected = 0.5 * float(
            (np.asarray(self.beside.at.slope()) + self.factors.pull(self.beside.at.point.z)) @ self.step[:-1]
        )
        gain = at.density() + prior.value(at.point.z) - fit.expansion.density() - prior.value(z)
        if not gain > CONFIRMED * expected:
            return None
        return residuals.innovations(replace(fit, expansion=at), self.looked.case.innovations.kurtosis).innovations

    def largest(self, k: int) -> float:
        """The largest part of a prediction that a shape has."""
        name, channels = self.beside.shapes[k]
        mine = np.isin(self.looked.case.channels.group, channels)
        own = self.step[self.beside.members[k][: SHAPES[name][1]]]
        return float(np.abs(self.looked.standard[name][0][mine] @ own).max())

    def coefficient(self, k: int) -> float:
        """The coefficient of a shape of one column, as it is declared; the largest part of a prediction of others."""
        name, channels = self.beside.shapes[k]
        if SHAPES[name][1] > 1:
            return self.largest(k)
        size = self.looked.standard[name][1][np.isin(self.looked.case.channels.group, channels)]
        return abs(float(self.step[self.beside.members[k, 0]] / size[0, 0]))


def _has(name: str, kind: Any, channel: Any) -> bool:
    """Whether a channel of a type has a shape."""
    if isinstance(channel.noise, Bernoulli):
        return False
    if name == "reading":
        return not channel.wrap
    return kind.reads_target and (name == "time" or kind.arity == 1)


def _means(values: np.ndarray, code: np.ndarray) -> np.ndarray:
    """Means (groups, k) of values (D, k) by group (D,)."""
    sums = np.stack([np.bincount(code, own) for own in values.T], 1)
    return sums / np.maximum(np.bincount(code), 1)[:, None]


def _rates(fit: Judged) -> np.ndarray:
    """Derivative (D,) of every prediction by time, along the track of its target."""
    moving = []
    for _, epochs, states in fit.problem.model.each_layout(fit.problem.epochs, fit.point.states):
        rate = np.zeros(np.shape(states))
        own = [name.rpartition("_")[0] in ("position", "velocity", "acceleration") for name in epochs.components]
        for mine in epochs.members.values():
            some = np.ix_(np.flatnonzero(mine), own)
            rate[some] = rates(epochs.time[mine], np.asarray(states)[some])
        moving.append(rate)
    parts = fit.problem.model.each_block(fit.lins)
    return fit.flat(
        np.einsum("ncj,nj->nc", lin.state, moving[r][np.asarray(data.epoch)][:, list(block.used)])
        for block, data, r, lin in parts
    )


def _said(found: Found) -> Checked:
    """The findings: one sentence for all channels of a type that have a shape in common."""
    looked, shapes, case = found.looked, found.beside.shapes, found.looked.case
    names, findings, after = case.channels.names, list[Finding](), found.without
    assert after is not None
    alike = dict[tuple[str, str], list[int]]()
    for k in found.free:
        name, channels = shapes[k]
        alike.setdefault((looked.kinds[channels[0]][1].name, name), []).append(k)
    for (kind, name), own in alike.items():
        channels = tuple(dict.fromkeys(c for k in own for c in shapes[k].channels))
        mine = np.isin(case.channels.group, channels)
        if after.spread(mine) > case.innovations.spread(mine):  # it bends what something else has wrong
            continue
        (what, _, advice), unit = SHAPES[name], looked.kinds[channels[0]][2].unit
        distances = (f"{own[looked.alike[1][channels[0]]]:.2g}" for own in looked.distances)
        values = dict(zip(("middle", "spread"), distances, strict=True), kind=kind, unit=unit)
        values["size"] = f"{found.coefficient(own[0]):.2g}"
        values["shared"] = ', shared="type"' if all(len(shapes[k].channels) > 1 for k in own) else ""
        sd, limit = found.free[own[0]]
        text = (
            f"{listed([names[c] for c in channels])}: the residuals follow {what}, by up to"
            f" {found.largest(own[0]):.2g}{f' {unit}' if unit != '1' else ''} ({sd:.1f} sd, limit {limit:.1f}; mean"
            f" square {case.innovations.spread(mine):.2g}, {after.spread(mine):.2g} without): {advice.format(**values)}"
        )
        findings.append(Finding("slope", names[channels[0]], text))
    if not findings:
        return Checked()
    moved = np.abs(found.moved / np.maximum(looked.fit.sd, 1e-150))
    name, channels = shapes[next(iter(found.free))]
    reason = f"if {listed([names[c] for c in channels], 1)} may follow {SHAPES[name][0]}"
    weak = {m: f"it would move by {moved[m]:.1f} sd {reason}" for m in np.flatnonzero(moved > levels.HANGS).tolist()}
    whole = after.spread(slice(None)) < residuals.PRACTICAL
    return Checked({}, findings, {"weak": weak}, SIGNS if whole else SIGNS[:2])
