"""Parts of a recording and groups of targets between which biases may differ, and which of them do.

Where the engine holds matrices of all biases every part has its own copy of each (`pieces`).
Elsewhere the biases have differences beside them which factors hold at zero: their marginals and
means tell the score test of each bias alone. Those that it suspects are then compared together, all
others eliminated.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from probcal.analysis import pieces
from probcal.analysis.pieces import Change, Contrast, Patterns, Pieces
from probcal.analysis.verdict import RATE, limit_of
from probcal.gaussian.engine import Expansion, Factors, Group
from probcal.inference import residuals
from probcal.inference.fitted import Judged
from probcal.linalg import invert
from probcal.model import variants
from probcal.problem import Problem
from probcal.results.groups import bias_coords

QUARTERS = 4
COPIES = 2000  # most biases of all pieces together
PARAMETERS = 4000  # most biases and differences together, where there are no matrices of all
SUSPECT = 0.4  # share of the limit from which a bias is compared with others
TOGETHER = 200  # parameters of these, at most
HELD = 1e6  # times the information about a bias, all else known, by which a difference is held at zero


class Grid(NamedTuple):
    """The pieces of a recording: parts of its time by groups of targets."""

    part: np.ndarray  # (rows,) of the table: part of the time of each
    group: np.ndarray  # (rows,) group of targets
    edges: np.ndarray  # times at which the parts begin
    groups: int

    @property
    def piece(self) -> np.ndarray:
        """Piece (rows,) of each row."""
        return self.part * self.groups + self.group

    @property
    def pieces(self) -> int:
        """Their number."""
        return len(self.edges) * self.groups

    @property
    def quarters(self) -> np.ndarray:
        """The part that each piece is, (pieces, parts - 1)."""
        return np.kron(np.eye(len(self.edges))[:, 1:], np.ones((self.groups, 1)))

    @property
    def patterns(self) -> Patterns:
        """Differences: of halves (pieces, 1), of targets (pieces, groups - 1)."""
        found, parts = {}, len(self.edges)
        if parts > 1:
            found["halves"] = np.repeat(2 * np.arange(parts) // parts, self.groups)[:, None].astype(float)
        if self.groups > 1:
            found["targets"] = np.kron(np.ones((parts, 1)), np.eye(self.groups)[:, 1:])
        return found

    @property
    def members(self) -> Patterns:
        """Members (pieces,) with biases of their own while the noise behind a pattern is measured."""
        parts = len(self.edges)
        every = {
            "halves": np.repeat(np.arange(parts), self.groups),
            "targets": np.tile(np.arange(self.groups), parts),
        }
        return {name: every[name] for name in self.patterns}


class Compared(NamedTuple):
    """Differences of biases between the halves of a recording and between its targets."""

    alone: dict[int, Contrast]  # each bias alone, between the halves
    inflation: np.ndarray  # (M,) of the variances behind these
    changes: list[Change]  # those beyond their limit beside each other, the strongest first
    moved: np.ndarray  # (M,) by how much what all have in common changes where these may differ, in z
    shapes: dict[int, Contrast]  # between the quarters, where something changes
    unsolved: int  # biases that may differ and were not compared with others


def grid_for(fit: Judged) -> Grid:
    """Quarters of equal numbers of rows by targets; halves, and groups, where biases are many."""
    data, M = fit.problem.measurements, fit.problem.model.biases
    edges = _edges(data.time[data.measured.any(1)], QUARTERS if QUARTERS * M <= COPIES else 2)
    most = COPIES // (len(edges) * M) if fit.engine.cheap else PARAMETERS // M - 1
    groups = max(1, min(len(data.target_names), most))
    return Grid(np.searchsorted(edges[1:], data.time, side="right"), data.target % groups, edges, groups)


def _edges(time: np.ndarray, count: int) -> np.ndarray:
    """Times at which pieces of equal numbers of rows begin; fewer where there are hardly any times."""
    edges = np.quantile(time, np.arange(count) / count, method="inverted_cdf")
    if len(np.unique(edges)) == count and len(np.unique(time)) >= 2 * count:
        return edges
    return _edges(time, 2) if count > 2 else edges[:1]


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
        by = _ByPieces(fit, grid) if fit.engine.cheap else _ByDifferences(fit, grid)
        return by.compared({name: inflation(by.own_shift(name)) for name in grid.patterns})
    return None


class _ByPieces:
    """By matrices of the biases of all pieces."""

    def __init__(self, fit: Judged, grid: Grid):
        self.fit, self.grid, self.divided = fit, grid, pieces.divide(fit, grid.piece, grid.pieces)

    def own_shift(self, name: str) -> list[jax.Array]:
        """Shift of the biases (N, p) of each row where each member of a pattern has its own."""
        own, model = pieces.own_biases(self.divided, self.grid.members[name]), self.fit.problem.model
        step = np.concatenate([own, np.zeros((len(own), 1))], 1)
        rows = model.each_block(self.fit.problem.row_index, model.read)
        return [jnp.asarray(step[self.grid.piece[index][:, None], bias]) for *_, index, bias in rows]

    def compared(self, wide: Patterns) -> Compared:
        """The differences, with the inflation (M,) of each pattern."""
        divided, grid, M = self.divided, self.grid, self.fit.problem.model.biases
        alone = pieces.contrasts(divided, grid.patterns["halves"]) if "halves" in wide else {}
        changes = pieces.changing(divided, grid.patterns, wide, partial(limit_of, M))
        shapes = pieces.contrasts(divided, grid.quarters) if changes and grid.quarters.shape[1] > 1 else {}
        free = [(change.bias, grid.patterns[change.name]) for change in changes]
        moved = pieces.freed(divided, free) if changes else np.zeros(M)
        return Compared(alone, wide.get("halves", np.ones(M)), changes, moved, shapes, 0)


class _ByDifferences:
    """By an expansion in which every bias may differ by q more, held at zero by factors.

    The parameters are the M biases, then their differences, those of halves first.
    """

    def __init__(self, fit: Judged, grid: Grid):
        model, M = fit.problem.model, fit.problem.model.biases
        self.fit, self.columns = fit, dict[str, list[int]]()
        along = list[np.ndarray]()
        for name, pattern in grid.patterns.items():
            self.columns[name] = [1 + len(along) + j for j in range(pattern.shape[1])]
            along += list(pattern[grid.piece].T)
        self.along = [np.stack([own[index] for own in along], 1) for index in fit.problem.row_index]
        rows = tuple(
            lin._replace(bias=jnp.concatenate([lin.bias, *(lin.bias * by[:, None, None] for by in own.T)], 2))
            for *_, lin, own in model.each_block(fit.lins, self.along)
        )
        point = fit.point._replace(z=jnp.concatenate([fit.point.z, jnp.zeros(self.q * M)]))
        self.at: Expansion = fit.engine.at(variants.differing(model, self.along), point, rows)
        self.alpha, self.z = fit.factors.diagonal(M), np.asarray(point.z)
        self.held = HELD * (1.0 + residuals.told_alone(fit))
        self.prior = np.concatenate([self.alpha, np.tile(self.held, self.q)])
        self.pinned = Factors.alone(self.prior)
        self.step = self._mean(self.pinned)

    @property
    def q(self) -> int:
        """Differences of each bias."""
        return self.along[0].shape[1]

    def _mean(self, factors: Factors) -> np.ndarray:
        """The step of all parameters from the fit to their mean."""
        return np.asarray(self.at.solve(factors, np.asarray(self.at.slope()) + factors.pull(self.z)))

    def _places(self, biases: np.ndarray, columns: Sequence[int]) -> np.ndarray:
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
        """Shift of the biases (N, p) of each row where each member of a pattern has its own."""
        M, columns = len(self.alpha), [0, *self.columns[name]]
        copies = np.eye(len(columns))
        copies[:, 0] = 1.0  # each is the bias and its difference
        members = self._places(np.arange(M), columns)
        precision = np.broadcast_to(copies.T @ copies, (M, *copies.shape))
        pinned = np.where(np.isin(np.arange(len(self.prior)), members), 0.0, self.prior)
        factors = Factors((Group(members, precision, np.zeros(members.shape)),)) + Factors.alone(pinned)
        step = np.append(self.at.solve(factors, self.at.slope()), 0.0).reshape(-1)
        every = np.concatenate([step[:-1].reshape(1 + self.q, M), np.zeros((1 + self.q, 1))], 1)
        model = self.fit.problem.model
        return [
            jnp.asarray(every[0][read] + sum(own[:, [j - 1]] * every[j][read] for j in columns[1:]))
            for *_, own, read in model.each_block(self.along, model.read)
        ]

    def _alone(self, name: str) -> dict[int, Contrast]:
        """The difference of each bias alone, all others common."""
        M, columns = len(self.alpha), [*self.columns[name], 0]
        members = self._places(np.arange(M), columns)
        information, score = self._told(self.pinned, self.step, members, self.prior[members])
        least = self.held * 1e-9  # a thousandth of what is told with all else known
        found = (pieces.beside_level(a, b, floor) for a, b, floor in zip(information, score, least, strict=True))
        return {m: one for m, one in enumerate(found) if one is not None}

    def compared(self, wide: Patterns) -> Compared:
        """The differences, with the inflation (M,) of each pattern."""
        M = len(self.alpha)
        each = {name: self._alone(name) for name in self.columns}
        over = np.zeros(M)  # share of the limit
        for name, found in each.items():
            for m, one in found.items():
                over[m] = max(over[m], one.square / wide[name][m] / limit_of(M, one.freedom))
        suspects = np.argsort(-over)[: np.count_nonzero(over > SUSPECT)]
        chosen = np.sort(suspects[: TOGETHER // (1 + self.q)])
        changes, moved = list[Change](), np.zeros(M)
        if (over > 1.0).any():
            patterns = {name: np.eye(1 + self.q)[:, own] for name, own in self.columns.items()}
            here = {name: own[chosen] for name, own in wide.items()}
            among = pieces.changing(self._of(chosen), patterns, here, partial(limit_of, M))
            changes = [change._replace(bias=int(chosen[change.bias])) for change in among]
            moved = self._moved(changes)
        return Compared(
            each.get("halves", {}), wide.get("halves", np.ones(M)), changes, moved, {}, len(suspects) - len(chosen)
        )

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
            freed[self._places(np.array([change.bias]), [0, *self.columns[change.name]])] = 0.0
        M = len(self.alpha)
        return (self._mean(Factors.alone(freed)) - self.step)[:M]


def group_of(problem: Problem, compared: Compared, grid: Grid) -> xr.Dataset:
    """Group `halves`: second half less first of each bias alone, in its unit, corrected sd, and their ratio."""
    index = list(compared.alone)
    scale = problem.scales[index]
    change = np.array([compared.alone[m].estimate[0] for m in index]) * scale
    sd = np.sqrt(compared.inflation[index] / np.array([compared.alone[m].information[0, 0] for m in index])) * scale
    columns = {"change": change, "sd": sd, "t": change / sd}
    group = xr.Dataset({name: ("bias_label", own) for name, own in columns.items()}, bias_coords(problem, index))
    group.attrs |= {"time": float(grid.edges[len(grid.edges) // 2]), "rate": RATE}
    group.attrs["limit"] = float(np.sqrt(limit_of(problem.model.biases)))
    return group
