"""Does a bias hold still? A fit of pieces: halves and quarters of the recording, or its targets.

Biases get differences by piece beside them and all trajectories are eliminated together, once, at the fit. From
this one information matrix follows, for each bias alone, the generalised least-squares estimate of how it differs
between the pieces while all others stay common: exact on a linear problem.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from probcal.analysis.verdict import limit_of
from probcal.gaussian.engine import Expansion
from probcal.inference.fitted import Judged
from probcal.linalg import invert, pseudo_inverse, solve_square, spectrum
from probcal.model import variants

Patterns = dict[str, np.ndarray]
QUARTERS = 4
COPIES = 2000  # most biases of all pieces together
PARAMETERS = 4000  # most biases and differences together, where there are no matrices of all
SUSPECT = 0.4  # share of the limit from which a bias is compared with others
TOGETHER = 200  # parameters of these, at most
HELD = 1e6  # times the information about a bias, all else known, by which a difference is held at zero
LEAST = 1e-6  # information in z about a difference below which there is none to tell


class Grid(NamedTuple):
    """The pieces of a recording: parts of its time by groups of targets."""

    part: np.ndarray  # (rows,) of the table: part of the time of each
    group: np.ndarray  # (rows,) group of targets
    edges: np.ndarray  # times at which the parts begin
    groups: int

    @property
    def along(self) -> np.ndarray:
        """The differences (rows, q) of each row: by the parts after the first, then by the groups after the first."""
        return np.concatenate([np.eye(len(self.edges))[self.part][:, 1:], np.eye(self.groups)[self.group][:, 1:]], 1)

    @property
    def columns(self) -> dict[str, np.ndarray]:
        """The numbers of the differences, from 1 on, between "halves" and between "targets"."""
        parts = len(self.edges)
        every = {"halves": np.arange(1, parts), "targets": np.arange(parts, parts + self.groups - 1)}
        return {name: own for name, own in every.items() if len(own)}

    @property
    def patterns(self) -> Patterns:
        """The bias and its differences (1 + q, k) for a unit change: of halves k = 1, of targets groups - 1."""
        parts, every = len(self.edges), np.eye(len(self.edges) + self.groups - 1)
        return {
            name: every[:, own] if name == "targets" else every[:, own[2 * own // parts > 0]].sum(1, keepdims=True)
            for name, own in self.columns.items()
        }


class Pieces(NamedTuple):
    """The biases of P pieces at a fit, trajectories eliminated, in z: piece by piece, M each."""

    information: np.ndarray  # (P M, P M)
    score: np.ndarray  # (P M,) of the log-likelihood
    prior: np.ndarray  # (M, M) precision of what the pieces share
    z: np.ndarray  # (M,) the fit
    level: Any = 1.0  # (P,) what all pieces have in common: each once, or the first where the others are differences


class Contrast(NamedTuple):
    """The difference of one bias between segments, in z: a pattern (P, q) about a common level."""

    estimate: np.ndarray  # (q,)
    information: np.ndarray  # (q, q)
    freedom: int  # its rank: pieces in which a bias is not seen tell nothing

    @property
    def square(self) -> float:
        """Chi-square of no difference, with its degrees of freedom."""
        return float(self.estimate @ self.information @ self.estimate)

    @property
    def plausible(self) -> float:
        """The part of the chi-square that changes of the order of the declared scale explain."""
        q = len(self.estimate)
        pull = self.information @ self.estimate
        held = invert(np.eye(q) + np.ones((q, q)))  # each piece its own draw: differences share the first
        return float(pull @ solve_square(self.information + held, pull))

    def along(self, direction: np.ndarray) -> float:
        """The part of the chi-square that coefficients in one direction (q,) explain."""
        known = float(direction @ self.information @ direction)
        return float((direction @ self.information @ self.estimate) ** 2) / known if known > LEAST else 0.0


def with_differences(fit: Judged, along: np.ndarray) -> Expansion:
    """The posterior at a fit with q differences of each bias, all zero, that come on top `along` (rows, q) of the rows
    of the table.

    After the biases come the differences of the first column, then of the next.
    """
    model, own = fit.problem.model, [along[index] for index in fit.problem.row_index]
    rows = tuple(
        lin._replace(bias=np.concatenate([lin.bias, *(np.multiply(lin.bias, by[:, None, None]) for by in times.T)], 2))
        for *_, lin, times in model.each_block(fit.lins, own)
    )
    point = fit.point._replace(z=np.pad(fit.point.z, (0, along.shape[1] * model.biases)))
    return fit.engine.at(variants.differing(model, own), point, rows)


def with_parameters(
    fit: Judged, along: np.ndarray, tables: Sequence[np.ndarray], columns: Sequence[np.ndarray]
) -> Expansion:
    """The posterior at a fit with parameters, all zero, by which `columns` (N, C, k) add to the predictions of a block.

    `tables` (S, k) say which each sensor of a block has, from M on; there are as many as `with_differences` has along
    columns (rows, q) of the table, and at most q a bias that a block reads.
    """
    model, own = fit.problem.model, [along[index] for index in fit.problem.row_index]
    rows = tuple(
        lin._replace(bias=np.concatenate([lin.bias, more], 2)) for *_, lin, more in model.each_block(fit.lins, columns)
    )
    point = fit.point._replace(z=np.pad(fit.point.z, (0, along.shape[1] * model.biases)))
    return fit.engine.at(variants.reading(variants.differing(model, own), tables), point, rows)


def divide(fit: Judged, along: np.ndarray) -> Pieces:
    """The biases and their differences along columns (rows, q) of the rows of the table."""
    return of_expansion(fit, with_differences(fit, along))


def of_expansion(fit: Judged, at: Expansion) -> Pieces:
    """The same from `with_differences`, where the engine holds matrices of all biases."""
    information, prior = at.information(), fit.factors.matrix(fit.problem.model.biases)
    assert information is not None
    level = np.eye(len(information) // len(prior))[0]
    return Pieces(information, np.asarray(at.slope()), prior, np.asarray(fit.point.z), level)


def contrasts(pieces: Pieces, pattern: np.ndarray, free: Sequence[tuple[int, np.ndarray]] = ()) -> dict[int, Contrast]:
    """The difference of each bias along a pattern (P, q) of the segments, all others common to all.

    The biases in `free` differ too, each along its own pattern. What is common has the prior of the fit, the level of
    a bias that differs none. A bias about whose difference the data say nothing is left out.
    """
    M, held = len(pieces.z), [m for m, _ in free]
    P = len(pieces.score) // M
    level = np.broadcast_to(pieces.level, P)[:, None]
    G, g = pieces.information.reshape(P, M, P, M), pieces.score.reshape(P, M)
    to, prior, inverse, slope = _together(pieces, free)
    crosses = (pieces.information @ to).reshape(P, M, -1)
    found = {}
    for m in range(M):
        others, pull, columns = inverse, slope, pattern
        if m not in held:  # its level is taken out of the common values, so that it has no prior
            column = inverse[:, m]
            if column[m] <= 0:
                continue
            others = inverse - np.outer(column, column) / column[m]  # inverse of K without its row and column m
            pull = slope.copy()
            pull[:M] += prior[:, m] * pieces.z[m]
            columns = np.concatenate([pattern, level], 1)
        cross = columns.T @ crosses[:, m]
        information = columns.T @ G[:, m, :, m] @ columns - cross @ others @ cross.T
        score = columns.T @ g[:, m] - cross @ others @ pull
        one = contrast(information, score) if m in held else beside_level(information, score, LEAST)
        if one is not None:
            found[m] = one
    return found


def beside_level(information: np.ndarray, score: np.ndarray, least: float) -> Contrast | None:
    """A contrast of information and score with those of a common level last; None where that is not told."""
    level = information[-1]
    if level[-1] <= least:
        return None
    score = score[:-1] - level[:-1] * score[-1] / level[-1]
    return contrast(information[:-1, :-1] - np.outer(level[:-1], level[:-1]) / level[-1], score, least)


def contrast(information: np.ndarray, score: np.ndarray, least: float = LEAST) -> Contrast | None:
    """A contrast of information (q, q) and score (q,) along what they tell more than `least` of; None of nothing."""
    information = 0.5 * (information + information.T)
    values, vectors = spectrum(information)
    seen = values > least
    if not seen.any():
        return None
    return Contrast(vectors[:, seen] @ ((vectors[:, seen].T @ score) / values[seen]), information, int(seen.sum()))


def _together(
    pieces: Pieces, free: Sequence[tuple[int, np.ndarray]]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Columns, prior (M, M), covariance and slope of the M common values and the coefficients of what is `free`."""
    M, held = len(pieces.z), [m for m, _ in free]
    same = np.broadcast_to(pieces.level, len(pieces.score) // M)[:, None]
    to = np.concatenate([np.kron(same, np.eye(M)), *(np.kron(own, np.eye(M)[:, [m]]) for m, own in free)], 1)
    prior = pieces.prior.copy()
    prior[held, :], prior[:, held] = 0.0, 0.0
    K, slope = to.T @ pieces.information @ to, to.T @ pieces.score
    K[:M, :M] += prior
    slope[:M] -= prior @ pieces.z
    return to, prior, pseudo_inverse(K, symmetric=True), slope


def freed(pieces: Pieces, free: Sequence[tuple[int, np.ndarray]]) -> np.ndarray:
    """Change (M,) of what all pieces have in common, in z, where the biases in `free` differ along their patterns."""
    steps = [inverse @ slope for _, _, inverse, slope in (_together(pieces, own) for own in ((), free))]
    return steps[1][: len(steps[0])] - steps[0]


class Change(NamedTuple):
    """A bias that differs between pieces along a pattern of some name, and its chi-square, corrected."""

    bias: int
    name: str
    square: float
    contrast: Contrast


def changing(pieces: Pieces, patterns: Patterns, inflation: Patterns, count: int, most: int = 20) -> list[Change]:
    """Biases whose chi-square along a pattern, over its `inflation` (M,), passes the limit of `count` for its freedom.

    The strongest comes first.

    Changes of several biases may look alike. One is let free at a time, that whose change of the order of its scale
    explains most, and the others are judged anew beside it.
    """
    found: list[Change] = []
    while len(found) < most:
        free = [(change.bias, patterns[change.name]) for change in found]
        taken = {(change.bias, change.name) for change in found}
        rest = [
            Change(m, name, contrast.square / inflation[name][m], contrast)
            for name, pattern in patterns.items()
            for m, contrast in contrasts(pieces, pattern, free).items()
            if (m, name) not in taken and contrast.square / inflation[name][m] > limit_of(count, contrast.freedom)
        ]
        if not rest:
            break
        found.append(max(rest, key=lambda change: change.contrast.plausible / inflation[change.name][change.bias]))
    return found


def grid_for(fit: Judged) -> Grid:
    """Quarters of equal numbers of rows by targets; halves, and groups, where biases are many."""
    data, M = fit.problem.measurements, fit.problem.model.biases
    whole = fit.engine.cheap and QUARTERS * M <= COPIES
    edges = _edges(data.time[data.measured.any(1)], QUARTERS if whole else 2)
    most = COPIES // (len(edges) * M) if fit.engine.cheap else PARAMETERS // M - 1
    groups = max(1, min(len(data.target_names), most))
    return Grid(np.searchsorted(edges[1:], data.time, side="right"), data.target % groups, edges, groups)


def _edges(time: np.ndarray, count: int) -> np.ndarray:
    """Times at which pieces of equal numbers of rows begin; fewer where there are hardly any times."""
    edges = np.quantile(time, np.arange(count) / count, method="inverted_cdf")
    if len(np.unique(edges)) == count and len(np.unique(time)) >= 2 * count:
        return edges
    return _edges(time, 2) if count > 2 else edges[:1]
