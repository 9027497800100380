"""Does a bias hold still? A fit of pieces: halves and quarters of the recording, or its targets.

Every piece gets its own copy of the biases and all trajectories are eliminated together, once, at the fit. From
this one information matrix follows, for each bias alone, the generalised least-squares estimate of how it differs
between the pieces while all others stay common: exact on a linear problem.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from probcal.inference.fitted import Judged
from probcal.linalg import invert, pseudo_inverse, solve_square, spectrum
from probcal.model import variants
from probcal.problem import Problem

Limit = Callable[[int], float]  # chi-square by degrees of freedom
Patterns = dict[str, np.ndarray]
LEAST = 1e-6  # information in z about a difference below which there is none to tell


class Pieces(NamedTuple):
    """The biases of P pieces at a fit, trajectories eliminated, in z: piece by piece, M each."""

    information: np.ndarray  # (P M, P M)
    score: np.ndarray  # (P M,) of the log-likelihood
    prior: np.ndarray  # (M, M) precision of what the pieces share
    z: np.ndarray  # (M,) the fit
    level: Any = 1.0  # (P,) what all pieces have in common: each once, or the first where the others are differences


class Contrast(NamedTuple):
    """How one bias differs between pieces, in z: the coefficients of a pattern (P, q) beside a common level."""

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


def divide(fit: Judged, piece: np.ndarray, count: int) -> Pieces:
    """Give every piece its own biases; `piece` (rows,) is that of each row of the table, below `count`."""
    model = variants.split(fit.problem.model, [piece[index] for index in fit.problem.row_index], count)
    at = fit.engine.at(model, fit.point._replace(z=jnp.asarray(np.tile(fit.point.z, count))), tuple(fit.lins))
    information, prior = at.information(), fit.factors.matrix(fit.problem.model.biases)
    assert information is not None
    return Pieces(information, np.asarray(at.slope()), prior, np.asarray(fit.point.z))


def contrasts(pieces: Pieces, pattern: np.ndarray, free: Sequence[tuple[int, np.ndarray]] = ()) -> dict[int, Contrast]:
    """How each bias alone differs between the pieces along a pattern (P, q), all others common to all pieces.

    The biases in `free` differ too, each along its own pattern. What is common has the prior of the fit, the level of
    a bias that differs none. A bias about whose difference the data say nothing is left out.
    """
    M = len(pieces.z)
    P, held = len(pieces.score) // M, [m for m, _ in free]
    level = np.broadcast_to(pieces.level, P)[:, None]
    G, g = pieces.information.reshape(P, M, P, M), pieces.score.reshape(P, M)
    prior = pieces.prior.copy()
    prior[held, :], prior[:, held] = 0.0, 0.0
    # parameters: the M common values, then the coefficients of what differs already
    to = np.concatenate([np.kron(level, np.eye(M)), *(np.kron(own, np.eye(M)[:, [m]]) for m, own in free)], 1)
    crosses = (pieces.information @ to).reshape(P, M, -1)
    K, slope = to.T @ pieces.information @ to, to.T @ pieces.score
    K[:M, :M] += prior
    slope[:M] -= prior @ pieces.z
    inverse = pseudo_inverse(K, symmetric=True)
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
        one = _contrast(information, score) if m in held else beside_level(information, score, LEAST)
        if one is not None:
            found[m] = one
    return found


def beside_level(information: np.ndarray, score: np.ndarray, least: float) -> Contrast | None:
    """A contrast of information and score with those of a common level last; None where that is not told."""
    level = information[-1]
    if level[-1] <= least:
        return None
    score = score[:-1] - level[:-1] * score[-1] / level[-1]
    return _contrast(information[:-1, :-1] - np.outer(level[:-1], level[:-1]) / level[-1], score, least)


def _contrast(information: np.ndarray, score: np.ndarray, least: float = LEAST) -> Contrast | None:
    information = 0.5 * (information + information.T)
    values, vectors = spectrum(information)
    seen = values > least
    if not seen.any():
        return None
    return Contrast(vectors[:, seen] @ ((vectors[:, seen].T @ score) / values[seen]), information, int(seen.sum()))


def freed(pieces: Pieces, free: Sequence[tuple[int, np.ndarray]]) -> np.ndarray:
    """Change (M,) of what all pieces have in common, in z, where the biases in `free` differ along their patterns."""
    M, held = len(pieces.z), [m for m, _ in free]
    same = np.kron(np.broadcast_to(pieces.level, len(pieces.score) // M)[:, None], np.eye(M))
    steps = []
    for columns in (same, np.concatenate([same, *(np.kron(own, np.eye(M)[:, [m]]) for m, own in free)], 1)):
        prior = pieces.prior.copy()
        if columns is not same:
            prior[held, :], prior[:, held] = 0.0, 0.0
        K, slope = columns.T @ pieces.information @ columns, columns.T @ pieces.score
        K[:M, :M] += prior
        slope[:M] = slope[:M] - prior @ pieces.z
        steps.append((pseudo_inverse(K, symmetric=True) @ slope)[:M])
    change: np.ndarray = steps[1] - steps[0]
    return change


def own_biases(pieces: Pieces, member: np.ndarray) -> np.ndarray:
    """Change (P, M) from the fit where groups of pieces, `member` (P,), have own biases, held by their scales."""
    M = len(pieces.z)
    to = np.kron(np.eye(int(member.max()) + 1)[member], np.eye(M))
    step = solve_square(to.T @ pieces.information @ to + np.eye(to.shape[1]), to.T @ pieces.score)
    return step.reshape(-1, M)[member]


def changed(problem: Problem, m: int, estimate: float, sd: float, limit: float) -> str:
    """By how much the halves of a bias differ, from estimate and sd in z, as the reason of a verdict."""
    bias = problem.biases[m]
    unit = f" {bias.unit}" if bias.unit != "1" else ""
    return (
        f"second half less first {estimate * bias.scale:.3g} \N{PLUS-MINUS SIGN} {sd * bias.scale:.2g}{unit} "
        f"({abs(estimate) / sd:.1f} sd, limit {np.sqrt(limit):.1f})"
    )


class Change(NamedTuple):
    """A bias that differs between pieces along a pattern of some name, and its chi-square, corrected."""

    bias: int
    name: str
    square: float
    contrast: Contrast


def changing(pieces: Pieces, patterns: Patterns, inflation: Patterns, limit: Limit, most: int = 20) -> list[Change]:
    """Biases whose chi-square along a pattern, over its `inflation` (M,), passes the limit for its freedom.

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
            if (m, name) not in taken and contrast.square / inflation[name][m] > limit(contrast.freedom)
        ]
        if not rest:
            break
        found.append(max(rest, key=lambda change: change.contrast.plausible / inflation[change.name][change.bias]))
    return found
