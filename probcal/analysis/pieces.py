"""Does a bias hold still? A fit of pieces: halves and quarters of the recording, or its targets.

Every piece gets its own copy of the biases and all trajectories are eliminated together, once, at the fit. From
this one information matrix follows, for each bias alone, the generalised least-squares estimate of how it differs
between the pieces while all others stay common: exact on a linear problem.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from probcal.analysis.fitted import Fitted, eliminate_rows
from probcal.problem import Spec, System

LEAST = 1e-6  # information in z about a difference below which there is none to tell


class Pieces(NamedTuple):
    """The biases of P pieces at a fit, trajectories eliminated, in z: piece by piece, M each."""

    information: np.ndarray  # (P M, P M)
    score: np.ndarray  # (P M,) of the log-likelihood
    prior: np.ndarray  # (M, M) precision of what the pieces share
    z: np.ndarray  # (M,) the fit


class Contrast(NamedTuple):
    """How one bias differs between pieces: pieces 2, 3, ... less piece 1, in z."""

    estimate: np.ndarray  # (P - 1,)
    information: np.ndarray  # (P - 1, P - 1)

    @property
    def square(self) -> float:
        """Chi-square of no difference, P - 1 degrees of freedom."""
        return float(self.estimate @ self.information @ self.estimate)

    def along(self, pattern: np.ndarray) -> float:
        """The part of the chi-square that a pattern (P,) of change explains."""
        step = pattern[1:] - pattern[0]
        return float((step @ self.information @ self.estimate) ** 2 / (step @ self.information @ step))


def divide(fit: Fitted, piece: np.ndarray, count: int) -> Pieces:
    """Give every piece its own biases; `piece` (rows,) is that of each row of the table, below `count`."""
    spec, system = copied(fit, piece, count)
    point = fit.point._replace(z=jnp.asarray(np.tile(fit.point.z, count)))
    solved = eliminate_rows(spec, system, point, fit.lins)
    return Pieces(
        np.asarray(solved.information),
        np.asarray(solved.score),
        np.asarray(fit.prior.matrix()),
        np.asarray(fit.point.z),
    )


def copied(fit: Fitted, piece: np.ndarray, count: int) -> tuple[Spec, System]:
    """The problem with a table of sensors for every piece, each pointing to its own biases."""
    spec, system = fit.problem.spec, fit.problem.system
    M, parts = spec.biases, []
    for index, data in zip(fit.problem.row_index, system.rows, strict=True):
        S, bias = data.bias.shape[0], np.asarray(data.bias)
        copies = [np.where(bias < M, bias + p * M, count * M) for p in range(count)]
        parts.append(
            data._replace(
                sensor=jnp.asarray(np.asarray(data.sensor) + S * piece[index]),
                bias=jnp.asarray(np.concatenate(copies)),
                scale=jnp.asarray(np.tile(data.scale, (count, 1))),
                base=jnp.asarray(np.tile(data.base, (count, 1))),
            )
        )
    return replace(spec, biases=count * M), system._replace(rows=tuple(parts))


def contrasts(pieces: Pieces, free: Sequence[int] = ()) -> dict[int, Contrast]:
    """The difference of each bias alone between the pieces; biases in `free` differ too, all others are common.

    What is common has the prior of the fit, a bias that differs none. A bias about whose difference the data say
    nothing is left out.
    """
    M = len(pieces.z)
    P, free = len(pieces.score) // M, list(free)
    G, g = pieces.information.reshape(P, M, P, M), pieces.score.reshape(P, M)
    prior = pieces.prior.copy()
    prior[free, :], prior[:, free] = 0.0, 0.0
    # parameters: the M common values, then what pieces 2, 3, ... of the free biases add to them
    to = np.concatenate(
        [np.tile(np.eye(M), (P, 1)), np.eye(P * M)[:, [p * M + m for m in free for p in range(1, P)]]], 1
    )
    crosses = (pieces.information @ to).reshape(P, M, -1)
    K, slope = to.T @ pieces.information @ to, to.T @ pieces.score
    K[:M, :M] += prior
    slope[:M] -= prior @ pieces.z
    inverse = np.linalg.pinv(K, hermitian=True)
    found = {}
    for m in sorted(set(range(M)) - set(free)):
        column = inverse[:, m]
        if column[m] <= 0:
            continue
        others = inverse - np.outer(column, column) / column[m]  # inverse of K without its row and column m
        pull = slope.copy()
        pull[:M] += prior[:, m] * pieces.z[m]
        own = G[:, m, :, m] - crosses[:, m] @ others @ crosses[:, m].T  # of the P values of bias m
        score = g[:, m] - crosses[:, m] @ others @ pull
        level, total = own.sum(0), own.sum()
        if total <= LEAST:
            continue
        information = own[1:, 1:] - np.outer(level[1:], level[1:]) / total
        information = 0.5 * (information + information.T)
        if np.linalg.eigvalsh(information)[0] > LEAST:
            rest = score[1:] - level[1:] * score.sum() / total
            found[m] = Contrast(np.linalg.solve(information, rest), information)
    return found


def merged(pieces: Pieces, into: Sequence[int]) -> Pieces:
    """The same with pieces put together: piece p goes into number into[p]."""
    M, P, Q = len(pieces.z), len(into), max(into) + 1
    to = np.zeros((Q, P))
    to[list(into), range(P)] = 1.0
    G = np.einsum("ap,pmqn,bq->ambn", to, pieces.information.reshape(P, M, P, M), to)
    return pieces._replace(information=G.reshape(Q * M, Q * M), score=(to @ pieces.score.reshape(P, M)).ravel())


def own_biases(pieces: Pieces) -> np.ndarray:
    """Change of every piece's own biases (P, M) from the fit, held by their declared scales."""
    M = len(pieces.z)
    step = np.linalg.solve(pieces.information + np.eye(len(pieces.score)), pieces.score)
    return step.reshape(-1, M)


class Change(NamedTuple):
    """A bias that differs between pieces: which, its chi-square (corrected), and what it explains of others."""

    bias: int
    square: float
    contrast: Contrast


def changing(pieces: Pieces, inflation: np.ndarray, limit: float, most: int = 20) -> list[Change]:
    """Biases whose chi-square over `inflation` (M,) passes the limit, the strongest first.

    Changes of several biases may look alike: one is let free at a time, and the others are judged anew beside it.
    """
    found: list[Change] = []
    while len(found) < most:
        rest = contrasts(pieces, [change.bias for change in found])
        score = {m: c.square / inflation[m] for m, c in rest.items()}
        if not score or max(score.values()) <= limit:
            break
        m = max(score, key=lambda k: score[k])
        found.append(Change(m, score[m], rest[m]))
    return found
