"""Do residuals follow the geometry: direction, distance, elevation, the reading, its rate?

Every channel of a sensor gets coefficients of such shapes, all zero, and all trajectories are eliminated together
at the fit: a score test of each shape, all else following. The strongest is let free, the others are judged anew, and
what is found is confirmed by tracks settled on the data without it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import jax
import numpy as np

from probcal.analysis import levels, pieces
from probcal.analysis.check import Case, Checked, check
from probcal.analysis.findings import Finding
from probcal.analysis.pieces import COPIES, HELD, SUSPECT, TOGETHER, Contrast, grid_for
from probcal.analysis.regressors import farthest, regressors
from probcal.analysis.ridges import CLOSE
from probcal.analysis.verdict import limit_of
from probcal.gaussian.climb import climb_to_mode
from probcal.gaussian.engine import Expansion, Factors, told_alone
from probcal.inference import residuals
from probcal.inference.fitted import Judged
from probcal.labels import listed
from probcal.linalg import invert
from probcal.modes.explore import CLIMB

TOLD = 1e-2  # share of the information about a shape, all else known, that must be left with all else free
CONFIRMED = 0.5  # share of the expected gain in log density that must be seen where the data are without the shape
SIGNS = ("levels", "process", "channels", "sensors", "rows")  # of what else speaks of it where it explains the misfit
MOST = 5.0  # times the largest part that a shape has, to which coefficients that are nearly alike are declared
LOOSE = 1e-6  # times the information about a shape, by which one that is free is held

SAID = {  # what the residuals of a channel follow
    "time": "the rate of the reading, as if it came late or early",
    "direction": "the direction of the target",
    "distance": "the distance of the target",
    "elevation": "the elevation of the target",
    "reading": "the reading itself",
}


class Shape(NamedTuple):
    """A part that predictions of some channels have too much, by their numbers."""

    name: str
    channels: tuple[int, ...]


@check("explained", "factor", causes=["other"])
def check_slopes(case: Case) -> Checked:
    """Channels whose residuals follow the geometry, and biases that would move without it."""
    return case.once(told_slopes)[0]


def told_slopes(case: Case) -> tuple[Checked, float]:
    """The findings, if tracks settled on the data without the shapes confirm them; and the chi-square of the strongest
    over its limit."""
    with suppress(MemoryError, np.linalg.LinAlgError):
        found = _Looked(case).found()
        if found is not None and found.without is not None:
            sd, limit = next(iter(found.free.values()))
            return _said(found), (sd / limit) ** 2
    return Checked(), 0.0


class _Wider(NamedTuple):
    """The expansion in which some shapes have coefficients, after the biases."""

    at: Expansion
    shapes: list[Shape]
    members: np.ndarray  # (shapes, 2) the places of their coefficients, that of none where there is one only
    alone: np.ndarray  # (M' + 1,) information of the rows about each parameter, all else known; 0 of none


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
    def columns(self) -> dict[str, np.ndarray]:
        """Columns (D, k) of each shape."""
        placed = self.fit.problem.network.sensors
        still = [all(node.path is None for node in placed[s].nodes) for s, *_ in self.kinds]
        after = self.case.tree["residual"].to_dataset()["after"].values
        return regressors(self.fit, self.case.channels.group, [own[1:] for own in self.kinds], still, after)

    @cached_property
    def shapes(self) -> dict[Shape, bool]:
        """The shapes of every channel (times: sensor), and of all of a type (True)."""
        found, channel = dict[Shape, bool](), self.case.channels.labels["channel"]
        for name, values in self.columns.items():
            told = np.bincount(self.case.channels.group, np.abs(values).sum(1)) > 1e-9
            for shared in (True, False):
                own = dict[Any, list[int]]()
                for c in np.flatnonzero(told).tolist():
                    owner = self.kinds[c][shared]
                    own.setdefault(owner if name == "time" else (owner, channel[c]), []).append(c)
                found |= {Shape(name, tuple(members)): shared for members in own.values()}
        return found

    def slots(self, shapes: list[Shape]) -> tuple[list[int], int]:
        """The first slot of each shape in the rows of its sensors, and the columns needed."""
        model, used = self.fit.problem.model, np.zeros(len(self.fit.problem.network.sensors), int)
        first, sizes = list[int](), [self.columns[shape.name].shape[1] for shape in shapes]
        for shape, size in zip(shapes, sizes, strict=True):
            own = [self.kinds[c][0] for c in shape.channels]
            first.append(int(used[own].max()))
            used[own] = first[-1] + size
        fewest = min((data.bias.shape[1] for data in model.rows if data.bias.shape[1]), default=1)
        return first, max(-(-sum(sizes) // model.biases), -(-int(used.max()) // fewest))

    def widened(self, shapes: list[Shape]) -> _Wider:
        """The expansion with the coefficients of some shapes.

        They take the places of the differences of `check_segments`, whose kernels are there, or as many as they need.
        """
        problem, model, group = self.fit.problem, self.fit.problem.model, self.case.channels.group
        sensor = np.array([s for s, *_ in self.kinds])
        owner = [np.zeros(len(data.bias), int) for data in model.rows]
        for _, data, _, place, index in model.each_block(owner, problem.row_index):
            place[np.asarray(data.sensor)] = problem.measurements.sensor[index]
        first, q = self.slots(shapes)
        along = grid_for(self.fit).along + 1.0
        along = along if along.shape[1] >= q else np.ones((len(along), q))
        none, widths = model.biases * (1 + along.shape[1]), [along.shape[1] * d.bias.shape[1] for d in model.rows]
        tables = [np.full((len(place), width), none) for place, width in zip(owner, widths, strict=True)]
        columns, members, taken = np.zeros((len(group), max(widths))), np.full((len(shapes), 2), none), model.biases
        for k, (name, channels) in enumerate(shapes):
            size, mine = self.columns[name].shape[1], np.isin(group, channels)
            here = slice(first[k], first[k] + size)
            members[k, :size] = own = taken + np.arange(size)
            columns[mine, here], taken = self.columns[name][mine], taken + size
            for place, table in zip(owner, tables, strict=True):
                if table.shape[1]:
                    table[np.isin(place, sensor[list(channels)]), here] = own
        parts = [np.asarray(own)[..., :width] for own, width in zip(self.fit.in_blocks(columns), widths, strict=True)]
        at = pieces.with_parameters(self.fit, along, tables, parts)
        return _Wider(at, shapes, members, np.append(told_alone(at), 0.0))

    def mean(self, wider: _Wider, free: Sequence[int], most: float) -> tuple[Factors, np.ndarray, np.ndarray]:
        """The prior with all coefficients held at zero but those of the shapes in `free`, how strongly they are, and
        the step to the mean of all parameters (M' + 1,).

        Precisions of biases are those of the fit, `most` at most: what a prior holds at zero may move at its declared
        scale before a shape is blamed.
        """
        M, held = self.fit.problem.model.biases, HELD * (1.0 + wider.alone)
        own = wider.members[list(free)]
        held[own] = LOOSE * (1.0 + wider.alone[own])
        held[:M] = 0.0
        prior = np.where(np.arange(len(held)) < M, np.minimum(self.fit.factors.diagonal(len(held)), most), held)
        factors = Factors.alone(prior[:-1])
        pull = np.asarray(wider.at.slope()) + factors.pull(wider.at.point.z)
        return factors, held, np.append(np.asarray(wider.at.solve(factors, pull)), 0.0)

    def tests(self, wider: _Wider, free: Sequence[int] = ()) -> dict[int, Contrast]:
        """The test of each shape by its number, those in `free` left free."""
        factors, held, step = self.mean(wider, free, 1.0)
        inverse, found = invert(np.asarray(wider.at.marginals(factors, wider.members))), dict[int, Contrast]()
        score = np.einsum("bij,bj->bi", inverse, step[wider.members])
        for k, members in enumerate(wider.members):
            mine = members < len(held) - 1
            size = np.sqrt(wider.alone[members[mine]])
            if k not in free and size.all():
                information = (inverse[k] - np.diag(held[members]))[np.ix_(mine, mine)] / np.outer(size, size)
                if (one := pieces.contrast(information, score[k, mine] / size, TOLD)) is not None:
                    found[k] = one
        return found

    def moves(self, wider: _Wider, step: np.ndarray) -> list[np.ndarray]:
        """By how much a step (M' + 1,) moves the predictions (N, C) of each block."""
        parts = wider.at.model.each_block(wider.at.model.read, wider.at.rows)
        return [np.einsum("ncp,np->nc", lin.bias, step[read]) for *_, read, lin in parts]

    def wide(self, wider: _Wider, tested: Mapping[int, Contrast]) -> np.ndarray:
        """Inflation of the squares of each channel, its likeliest shape taken out: overdispersion times memory of the
        innovations, not less than in the mean."""
        case, best = self.case, dict[tuple[int, ...], tuple[float, int]]()
        for k, own in tested.items():
            mine = wider.shapes[k].channels
            best[mine] = max(best.get(mine, (0.0, k)), (own.square / limit_of(1, own.freedom), k))
        step = self.mean(wider, [k for _, k in best.values()], 1.0)[2]
        shift = [jax.device_put(own) for own in self.moves(wider, step)]
        freed = case.innovations._replace(value=residuals.moved_innovations(self.fit, case.filtered, shift))
        found = residuals.scatter_of(self.fit.data, freed, case.channels.members)
        each: np.ndarray = np.maximum(found.size * found.memory, 1.0)
        return np.maximum(each, np.mean(each[case.channels.group]))

    def found(self) -> Slopes | None:
        """The shapes that the data have too much: all are looked at, then suspects together."""
        wide, count = np.full(len(self.kinds), np.inf), len(self.shapes)
        over, parts = dict[Shape, Contrast](), dict[tuple[str, bool], list[Shape]]()
        for shape, shared in self.shapes.items():
            parts.setdefault((shape.name, shared), []).append(shape)

        def ratio(shape: Shape, own: Contrast) -> float:
            return own.square / float(np.mean(wide[list(shape.channels)])) / limit_of(count, own.freedom)

        for shapes in parts.values():
            wider = self.widened(shapes)
            tested = self.tests(wider)
            np.minimum(wide, self.wide(wider, tested), out=wide)
            over |= {shapes[k]: own for k, own in tested.items()}
        order = sorted(over, key=lambda shape: -ratio(shape, over[shape]))
        order = [shape for shape in order if ratio(shape, over[shape]) > SUSPECT][: TOGETHER // 2]
        if not order or ratio(order[0], over[order[0]]) <= 1.0:
            return None
        M = self.fit.problem.model.biases
        while self.fit.engine.cheap and len(order) > 1 and (1 + self.slots(order)[1]) * M > COPIES:
            order = order[: len(order) // 2]
        wider, free = self.widened(order), dict[int, tuple[float, float]]()
        while len(free) < len(order) and (tested := self.tests(wider, list(free))):
            np.minimum(wide, self.wide(wider, tested), out=wide)
            k = max(tested, key=lambda k: ratio(order[k], tested[k]))
            if (most := ratio(order[k], tested[k])) <= 1.0:
                break
            limit = float(np.sqrt(limit_of(count, tested[k].freedom)))
            free[k] = limit * float(np.sqrt(most)), limit
        return Slopes(self, wider, free) if free else None


@dataclass(frozen=True, eq=False)
class Slopes:
    """Shapes that the data have too much."""

    looked: _Looked
    wider: _Wider
    free: dict[int, tuple[float, float]]  # which of the shapes, the strongest first, and how many sd, and their limit

    @cached_property
    def solved(self) -> tuple[Factors, np.ndarray]:
        """The prior of the fit with them free, and the step (M' + 1,) of all parameters."""
        factors, _, step = self.looked.mean(self.wider, list(self.free), np.inf)
        return factors, step

    @property
    def moved(self) -> np.ndarray:
        """By how much the biases (M,) move for them, in z."""
        rest = self.looked.mean(self.wider, (), np.inf)[2]
        return (self.solved[1] - rest)[: self.looked.fit.problem.model.biases]

    @cached_property
    def without(self) -> residuals.Innovations | None:
        """The innovations without them, tracks settled anew; None where the fit gains too little."""
        fit, prior, (factors, step), at = self.looked.fit, self.looked.fit.factors, self.solved, self.wider.at
        M, z = fit.problem.model.biases, np.asarray(fit.point.z)
        shift = self.looked.moves(self.wider, np.where(np.arange(len(step)) < M, 0.0, step))
        model = fit.problem.model.with_rows(
            lambda data, own: {"y": np.where(np.asarray(data.mask) > 0, np.asarray(data.y) - own, 0.0)}, shift
        )
        expected = 0.5 * float((np.asarray(at.slope()) + factors.pull(at.point.z)) @ step[:-1])
        start = fit.point._replace(z=jax.device_put(z + step[:M]))
        at = fit.engine.settled(model, start)
        if fit.engine.cheap:  # a step is not all where the answer lies far off
            expand = partial(fit.engine.settled, model)
            at = climb_to_mode(expand, at.point, prior, CLIMB, CLOSE).at
        gain = at.density() + prior.value(at.point.z) - fit.expansion.density() - prior.value(z)
        if not gain > CONFIRMED * expected:
            return None
        return residuals.innovations(replace(fit, expansion=at), self.looked.case.innovations.kurtosis).innovations

    def size(self, k: int) -> tuple[float, float]:
        """The largest part of a prediction that a shape has, and the largest of its coefficients."""
        name, channels = self.wider.shapes[k]
        columns = self.looked.columns[name][np.isin(self.looked.case.channels.group, channels)]
        own = self.solved[1][self.wider.members[k][: columns.shape[1]]]
        most = float(np.abs(columns @ own).max())
        return most, min(float(np.abs(own).max()), np.inf if len(own) == 1 else MOST * most)


def _advice(name: str, what: str, unit: str, scale: str, far: str) -> str:
    """The line that declares a shape of a channel."""
    if name == "time":
        advice = 'correct their times, or give the first node of each sensor scale={"time_offset": '
        return f"{advice}{scale}}}"
    if name == "reading":
        return f'multiply {what} by 1 + gain, with a bias gain=Bias("1", {scale})'
    if name == "elevation":
        line = "probcal.geometry.elevation(target.position - pose.position)"
        return f'add slope * {line} to {what}, with a bias slope=Bias("{unit}", {scale})'
    if name == "direction":
        line = "a = probcal.geometry.bearing(target.position - pose.position)"
        biases = f'biases east and north=Bias("{unit}", {scale})'
        return f"add east * jnp.cos(a) + north * jnp.sin(a) to {what}, {line}, with {biases}"
    line = f"r = probcal.geometry.norm(target.position - pose.position) / {far}"
    return f'add slope * r + bend * r**2 to {what}, {line}, with biases slope and bend=Bias("{unit}", {scale})'


def _said(found: Slopes) -> Checked:
    """The findings: one sentence for a shape of a channel of a type."""
    looked, shapes, case = found.looked, found.wider.shapes, found.looked.case
    names, findings, after = case.channels.names, list[Finding](), found.without
    assert after is not None
    alike = dict[tuple[str, str, str], list[int]]()
    for k in found.free:
        name, (c, *_) = shapes[k]
        channel = "" if name == "time" else names[c].rpartition(".")[2]
        alike.setdefault((looked.kinds[c][1].name, channel, name), []).append(k)
    for (kind, channel, name), own in alike.items():
        channels = tuple(dict.fromkeys(c for k in own for c in shapes[k].channels))
        mine = np.isin(case.channels.group, channels)
        if after.spread(mine) > case.innovations.spread(mine):  # it bends what something else has wrong
            continue
        unit = "s" if name == "time" else looked.kinds[channels[0]][2].unit
        largest, size = np.max([found.size(k) for k in own], 0)
        shared = ', shared="type"' if name != "time" and all(looked.shapes[shapes[k]] for k in own) else ""
        sd, limit = found.free[own[0]]
        most = size if name == "time" else largest
        text = (
            f"{listed([names[c] for c in channels])}: the residuals follow {SAID[name]}, by up to"
            f" {most:.2g}{f' {unit}' if unit != '1' else ''} ({sd:.1f} sd, limit {limit:.1f}; without"
            f" that their mean square is {after.spread(mine):.2g} and not {case.innovations.spread(mine):.2g}): "
        )
        text += _advice(name, f"{channel} of {kind}", unit, f"{size:.2g}{shared}", f"{farthest(looked.fit):.3g}")
        findings.append(Finding("slope", names[channels[0]], text))
    if not findings:
        return Checked()
    moved = np.abs(found.moved / np.maximum(looked.fit.sd, 1e-150))
    name, channels = shapes[next(iter(found.free))]
    reason = f"if {listed([names[c] for c in channels], 1)} may follow {SAID[name]}"
    weak = {m: f"it would move by {moved[m]:.1f} sd {reason}" for m in np.flatnonzero(moved > levels.HANGS).tolist()}
    whole = after.spread(slice(None)) < residuals.PRACTICAL
    return Checked({}, findings, {"weak": weak}, SIGNS if whole else SIGNS[:2])
