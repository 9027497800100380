"""Parts of a recording and groups of targets between which biases may differ, and which of them do.

The biases have differences by part and by group beside them, trajectories eliminated. Where the engine holds matrices
of all biases these are compared by them. Elsewhere factors hold the differences at zero, whose marginals and means tell
the score test of each bias alone; those that it suspects are then compared together, all others eliminated.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import cached_property
from typing import Any, NamedTuple

import jax
import numpy as np
import xarray as xr

from probcal.analysis import levels, pieces
from probcal.analysis.check import Case, Checked, check
from probcal.analysis.findings import Finding
from probcal.analysis.pieces import HELD, SUSPECT, TOGETHER, Change, Contrast, Grid, Patterns, Pieces, grid_for
from probcal.analysis.slopes import told_slopes
from probcal.analysis.verdict import RATE, limit_of
from probcal.gaussian.engine import Factors, Group, told_alone
from probcal.inference import residuals
from probcal.inference.fitted import Judged
from probcal.labels import listed
from probcal.linalg import invert
from probcal.problem import Problem
from probcal.results.groups import along, bias_coords

CLEARLY = 2.0  # times as large a chi-square, over limits, from which one of two causes is said alone


class Compared(NamedTuple):
    """Differences of biases between the halves of a recording and between its targets."""

    alone: dict[int, Contrast]  # each bias alone, between the halves
    inflation: np.ndarray  # (M,) of the variances behind these
    changes: list[Change]  # those beyond their limit beside each other, the strongest first
    moved: np.ndarray  # (M,) by how much what all have in common changes where these may differ, in z
    shapes: dict[int, Contrast]  # between the quarters, where something changes
    unsolved: int  # biases that may differ and were not compared with others


@check("explained", "factor", causes=["other"])
def check_segments(case: Case) -> Checked:
    """Tests the change of each bias from the first half of the recording to the second.

    Biases drift, targets disagree on them, or they would move by more than `levels.HANGS` sd if others may change.
    """
    grid = grid_for(case.fit)
    compared = compare_segments(case.fit, case.filtered, case.channels, grid) if grid.columns else None
    if compared is None:
        return Checked()
    problem, inflation, changes = case.fit.problem, compared.inflation, compared.changes
    M = problem.model.biases
    changes, explains = _weighed(case, changes)
    limit, groups, findings = limit_of(M), {}, []
    if compared.alone:
        groups["halves"] = group_of(problem, compared, grid)
    drifts, disagreements, remarks, weak = dict[int, str](), dict[int, str](), dict[int, str](), dict[int, str]()
    for bias, name, square, contrast in changes:
        if name == "halves":
            sd = float(np.sqrt(inflation[bias] / contrast.information[0, 0]))
            text = changed(problem, bias, float(contrast.estimate[0]), sd, limit)
            size = abs(float(contrast.estimate[0])) * problem.scales[bias]
            drifts[bias] = text + _shape(compared.shapes.get(bias), grid.edges, size)
        else:
            disagreements[bias] = _disagreement(problem, contrast, square, limit_of(M, contrast.freedom))
    if changes:
        labels = [problem.labels[change.bias] for change in changes]
        moved = np.abs(compared.moved / np.maximum(case.fit.sd, 1e-150))
        others = listed(labels, 1)
        for m in np.flatnonzero(moved > levels.HANGS).tolist():
            weak[m] = f"it would move by {moved[m]:.1f} sd if {others} may change"
        for m, one in compared.alone.items():
            if one.square / inflation[m] > limit and m not in (changes[0].bias, *drifts):
                size = np.sqrt(one.square / inflation[m])
                remarks[m] = f"; its halves differ by {size:.1f} sd, which {labels[0]} explains"
    if compared.unsolved:
        text = "more biases may have changed and were not compared: so many are rarely drifts of single biases"
        findings.append(Finding("halves", "fit", f"{compared.unsolved} {text}"))
    doubts = {"drifting": drifts, "conflicting": disagreements, "weak": weak}
    return Checked(groups, findings, doubts, explains, inflation, remarks)


def _weighed(case: Case, changes: list[Change]) -> tuple[list[Change], list[str]]:
    """The changes, none where shapes of the residuals are clearly stronger, and the checks that they explain."""
    slopes, strength = case.once(told_slopes)
    first = changes[0] if changes else None
    ratio = first.square / limit_of(case.fit.problem.model.biases, first.contrast.freedom) if first else 0.0
    if slopes.findings and strength > CLEARLY * ratio:
        return [], []
    return changes, ["levels", "slopes"][: 1 + bool(ratio > CLEARLY * strength)] if changes else []


def compare_segments(
    fit: Judged, found: residuals.Filtered, channels: residuals.Channels, grid: Grid
) -> Compared | None:
    """The biases that differ between the pieces of a grid; None where there is no room for it.

    The variance of a change is wider than the model says by overdispersion and correlation in time:
    the mean square of a sensor's channel (at least 1) times how many of its innovations count as
    one. Both are measured on innovations from which the own biases of each part, or of each target,
    are taken, so that a change does not hide itself. A bias has the mean of the channels that tell
    of it, by their information, and not less than the mean of all.
    """

    def inflation(shift: list[jax.Array]) -> np.ndarray:
        freed = found.innovations._replace(value=residuals.moved_innovations(fit, found, shift))
        wide = residuals.scatter_of(fit.data, freed, channels.members)
        return residuals.inflation(fit, wide.size * wide.memory, channels.group)

    with suppress(MemoryError, np.linalg.LinAlgError):
        by = _Differences(fit, grid)
        return by.compared({name: inflation(by.own_shift(name)) for name in grid.columns})
    return None


class _Differences:
    """The expansion in which every bias may differ by q more: M biases, then the differences."""

    def __init__(self, fit: Judged, grid: Grid):
        M, along = fit.problem.model.biases, grid.along
        self.fit, self.grid, self.q, self.at = fit, grid, along.shape[1], pieces.with_differences(fit, along)
        self.alpha, self.z = fit.factors.diagonal(M), np.asarray(self.at.point.z)
        self.held = HELD * (1.0 + told_alone(fit.expansion))
        self.prior = np.concatenate([self.alpha, np.tile(self.held, self.q)])
        self.pinned = Factors.alone(self.prior)

    @cached_property
    def step(self) -> np.ndarray:
        """The step of all parameters to their mean, the differences held at zero."""
        return self._mean(self.pinned)

    def _mean(self, factors: Factors) -> np.ndarray:
        """The step of all parameters from the fit to their mean."""
        return np.asarray(self.at.solve(factors, np.asarray(self.at.slope()) + factors.pull(self.z)))

    def _places(self, biases: np.ndarray, columns: Sequence[int] | np.ndarray) -> np.ndarray:
        """Places (biases, columns) of biases and differences; column 0 is the bias itself."""
        return biases[:, None] + len(self.alpha) * np.asarray(columns)

    def _told(self, factors: Factors, step: np.ndarray, members: np.ndarray, own: Any) -> tuple[np.ndarray, np.ndarray]:
        """Information (B, p, p) and score (B, p) of members (B, p), all else integrated.

        Without their own factors (B, p).
        """
        inverse = invert(np.asarray(self.at.marginals(factors, members)))
        score = np.einsum("bij,bj->bi", inverse, step[members]) + own * self.z[members]
        return inverse - np.asarray(own)[..., None] * np.eye(members.shape[1]), score

    def own_shift(self, name: str) -> list[jax.Array]:
        """By how much the predictions (N, C) of each block move, each member of a pattern with a bias of its own."""
        M, columns = len(self.alpha), [0, *self.grid.columns[name]]
        copies = np.eye(len(columns))
        copies[:, 0] = 1.0  # each is the bias and its difference
        members = self._places(np.arange(M), columns)
        precision = np.broadcast_to(copies.T @ copies, (M, *copies.shape))
        pinned = np.where(np.isin(np.arange(len(self.prior)), members), 0.0, HELD * self.prior)
        factors = Factors((Group(members, precision, np.zeros(members.shape)),)) + Factors.alone(pinned)
        step = np.pad(np.reshape(self.at.solve(factors, self.at.slope()), (-1, M)), ((0, 0), (0, 1)))
        times = np.pad(self.grid.along, ((0, 0), (1, 0)), constant_values=1.0)[:, columns]
        model = self.fit.problem.model
        parts = model.each_block(self.fit.problem.row_index, model.read, self.fit.lins)
        return [
            jax.device_put(np.einsum("ncp,nk,knp->nc", lin.bias, times[own], step[columns][:, read], optimize=True))
            for *_, own, read, lin in parts
        ]

    def _alone(self, name: str) -> Iterator[tuple[int, Contrast]]:
        """The difference of each bias alone, all others common."""
        members = self._places(np.arange(len(self.alpha)), [*self.grid.columns[name], 0])
        information, score = self._told(self.pinned, self.step, members, self.prior[members])
        for m, own in enumerate(zip(information, score, self.held * 1e-9, strict=True)):
            found = pieces.beside_level(*own)  # from a thousandth of what is told with all else known
            if found is not None:
                yield m, found

    def compared(self, wide: Patterns) -> Compared:
        """The differences, with the inflation (M,) of each pattern."""
        M, patterns, changes, shapes = len(self.alpha), self.grid.patterns, list[Change](), dict[int, Contrast]()
        moved, unsolved = np.zeros(M), 0
        if self.fit.engine.cheap:
            divided = pieces.of_expansion(self.fit, self.at)
            alone = pieces.contrasts(divided, patterns["halves"]) if "halves" in wide else {}
            changes = pieces.changing(divided, patterns, wide, M)
            quarters = self.grid.columns.get("halves", np.zeros(0, int))
            if changes and len(quarters) > 1:
                shapes = pieces.contrasts(divided, np.eye(1 + self.q)[:, quarters])
            moved = pieces.freed(divided, [(own.bias, patterns[own.name]) for own in changes]) if changes else moved
        else:
            each = {name: dict(self._alone(name)) for name in wide}
            over, alone = np.zeros(M), each.get("halves", {})  # share of the limit
            for name, found in each.items():
                for m, one in found.items():
                    over[m] = max(over[m], one.square / wide[name][m] / limit_of(M, one.freedom))
            suspects = np.argsort(-over)[: np.count_nonzero(over > SUSPECT)]
            chosen = np.sort(suspects[: TOGETHER // (1 + self.q)])
            if (over > 1.0).any():
                here = {name: own[chosen] for name, own in wide.items()}
                among = pieces.changing(self._of(chosen), patterns, here, M)
                changes = [change._replace(bias=int(chosen[change.bias])) for change in among]
                moved = self._moved(changes)
            unsolved = len(suspects) - len(chosen)
        return Compared(alone, wide.get("halves", np.ones(M)), changes, moved, shapes, unsolved)

    def _of(self, biases: np.ndarray) -> Pieces:
        """Some biases and their differences, all others eliminated."""
        members = self._places(biases, range(1 + self.q)).T.reshape(1, -1)
        alone = self.prior.copy()
        alone[members] = 1.0
        factors = Factors.alone(alone)
        information, score = self._told(factors, self._mean(factors), members, alone[members])
        level = np.eye(1 + self.q)[0]
        return Pieces(information[0], score[0], np.diag(self.alpha[biases]), self.z[biases], level)

    def _moved(self, changes: list[Change]) -> np.ndarray:
        """By how much what all have in common moves where biases may change."""
        freed = self.prior.copy()
        for change in changes:
            freed[self._places(np.array([change.bias]), [0, *self.grid.columns[change.name]])] = 0.0
        return (self._mean(Factors.alone(freed)) - self.step)[: len(self.alpha)]


def group_of(problem: Problem, compared: Compared, grid: Grid) -> xr.Dataset:
    """Group `halves`: second half less first of each bias alone, in its unit, corrected sd, and their ratio."""
    index = list(compared.alone)
    scale = problem.scales[index]
    change = np.array([compared.alone[m].estimate[0] for m in index]) * scale
    sd = np.sqrt(compared.inflation[index] / np.array([compared.alone[m].information[0, 0] for m in index])) * scale
    columns = {"change": change, "sd": sd, "t": change / sd}
    group = xr.Dataset(along("bias_label", columns), bias_coords(problem, index))
    group.attrs |= {"time": float(grid.edges[len(grid.edges) // 2]), "rate": RATE}
    group.attrs["limit"] = float(np.sqrt(limit_of(problem.model.biases)))
    return group


def changed(problem: Problem, m: int, estimate: float, sd: float, limit: float) -> str:
    """By how much the halves of a bias differ, from estimate and sd in z, as the reason of a verdict."""
    bias = problem.biases[m]
    unit = f" {bias.unit}" if bias.unit != "1" else ""
    return (
        f"from the first half to the second it changes by {estimate * bias.scale:.3g}"
        f" \N{PLUS-MINUS SIGN} {sd * bias.scale:.2g}{unit} ({abs(estimate) / sd:.1f} sd, limit {np.sqrt(limit):.1f})"
    )


def _shape(shape: Contrast | None, edges: np.ndarray, size: float) -> str:
    """A jump between quarters, with its place, or a drift, and the declaration of it."""
    if shape is None:
        return ""
    later = np.arange(1, len(edges))
    k = int(max(later, key=lambda k: shape.along(1.0 * (later >= k))))
    at = [f"{time:.13g}" for time in np.round(edges, 3)]  # seconds since 1970 too
    said, times = f"it jumps at about {at[k]} s", [at[0], at[k]]
    if shape.along(1.0 * later) > shape.along(1.0 * (later >= k)):
        said, times = "it drifts", at
    return f"; {said}: declare its Bias(..., drift=Drift(({', '.join(times)}), scale={size:.2g}))"


def _disagreement(problem: Problem, contrast: Contrast, square: float, limit: float) -> str:
    """Reason of a bias on which the targets disagree, with the one that is most out of line."""
    names, groups = problem.measurements.target_names, len(contrast.estimate) + 1
    alone = [contrast.along(unit[1:] - unit[0]) for unit in np.eye(groups)]
    odd = [name for k, name in enumerate(names) if k % groups == int(np.argmax(alone))]
    most = f"{names[0]} and {names[1]}" if len(names) == 2 else f"{listed(odd, 1)} most"
    return f"the targets disagree, {most} (chi-square {square:.1f} on {contrast.freedom}, limit {limit:.1f})"
