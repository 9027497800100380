"""Does a bias of a large network hold still? Halves of the recording, where a matrix of all biases has no room.

For each bias alone: how much it differs in the second half while all else stays common, as `pieces.contrasts` says it.
What the states and the other biases leave of the information about a difference is a variance of the joint Gaussian,
read off draws from its sparse factor; of the biases that these suspect it is solved for.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal.analysis.pieces import LEAST
from probcal.gaussian.engine import Factors
from probcal.gaussian.joint import JointPrecision
from probcal.gaussian.sparse import SparseExpansion
from probcal.model.model import Model
from probcal.model.rows import Linearised

SAMPLED, TOGETHER = 128, 16  # of the joint Gaussian, and of them at once
SUSPECT, MOST = 0.4, 100  # share of the limit from which a bias is suspected, and how many are solved for at most
COLUMNS = 25  # solved together
FREED = 20  # biases that may differ together
TOLD = 4.0  # errors above which draws tell how much is left of an information
STEPS = 30  # of conjugate gradients at most

Parts = tuple[tuple[Linearised, jax.Array, jax.Array], ...]  # rows, the biases that each reads, and its epoch
Form = tuple[tuple[tuple[int, ...], int], ...]  # of each block the state entries that it reads, and the recursion


class Halves(NamedTuple):
    """How each bias alone differs in the second half, in z; of those not in `solved` by draws."""

    estimate: np.ndarray  # (M,)
    information: np.ndarray  # (M,) about it, 0 where nothing is told, or less than draws can tell
    solved: np.ndarray  # (S,) biases
    unsolved: int  # more that were suspected
    exact: "Exact"

    @property
    def square(self) -> np.ndarray:
        """Chi-square (M,) of no difference."""
        return np.asarray(self.estimate**2 * self.information)


class Exact(NamedTuple):
    """Second moments of the joint Gaussian along the differences b and the levels e of S biases, all in z."""

    own: np.ndarray  # (S, S) information about the differences, all else known
    among: np.ndarray  # (2 S, 2 S) of b, then e
    score: np.ndarray  # (S,) of the differences
    step: np.ndarray  # (2 S,) the same along the step that the slope of the fit leaves
    z: np.ndarray  # (S,)
    alpha: np.ndarray  # (S,) prior precisions, which a level that may differ does not have

    def differences(self, chosen: list[int]) -> tuple[np.ndarray, np.ndarray]:
        """Information and score of the differences of chosen biases together, none of their levels held by a prior."""
        S, k = len(self.own), np.array(chosen)
        levels = S + k[self.alpha[k] > 0]
        root = np.linalg.pinv(
            np.diag(1.0 / self.alpha[levels - S]) - self.among[np.ix_(levels, levels)], hermitian=True
        )
        across = self.among[np.ix_(k, levels)]
        pulled = self.alpha[levels - S] * self.z[levels - S]
        along = self.step[k] + across @ pulled  # of the slope without the pull of these priors
        level = self.step[levels] + self.among[np.ix_(levels, levels)] @ pulled
        information = self.own[np.ix_(k, k)] - self.among[np.ix_(k, k)] - across @ root @ across.T
        return information, self.score[k] - along - across @ root @ level


class HalfChange(NamedTuple):
    """A bias that differs between the halves beside those before it."""

    bias: int
    estimate: float
    information: float


class Divided:
    """A fit in sparse form whose rows are divided in two halves; the differences are between these.

    Raises `MemoryError` where there is no room for a factor.
    """

    def __init__(self, system: SparseExpansion, alpha: np.ndarray, late: list[np.ndarray], seed: int = 0):
        self.factor, self.joint, self.alpha = system.solved(Factors.alone(alpha)).factor, system.joint, alpha
        model = system.model
        self.z, self.late = np.asarray(system.point.z), late
        self.half = _Half(model, system.rows, self.joint, late)
        whole = _Half(model, system.rows, self.joint, [np.ones(len(own)) for own in late])
        slope = whole.score() - alpha * self.z  # of the joint density; the states are at their mode
        self.step = self.factor.solve(self.joint.of_biases(slope))
        self.score, self.own = self.half.score(), self.half.own()
        M, rng = len(alpha), np.random.default_rng(seed)
        self.left, self.crossed, self.levels = np.zeros(M), np.zeros(M), np.zeros(M)  # second moments
        for _ in range(SAMPLED // TOGETHER):
            drawn = self.factor.draw(rng, TOGETHER)
            along, level = self.half.along(drawn), drawn[:, self.joint.states :]
            self.left += np.sum(along**2, 0) / SAMPLED
            self.crossed += np.sum(along * level, 0) / SAMPLED
            self.levels += np.sum(level**2, 0) / SAMPLED

    def own_shift(self) -> list[np.ndarray]:
        """By how much the biases (N, p) of each row are others where each half has its own, held by their scales.

        About: by a few conjugate gradients.
        """
        M = len(self.alpha)

        def product(difference: np.ndarray) -> np.ndarray:
            both = self.half.back(difference)
            seen = self.joint.of_biases(difference) - self.factor.solve(both)
            return np.asarray(self.half.along(seen[None])[0] + difference)

        from scipy.sparse.linalg import LinearOperator, cg  # loaded where it is used

        diagonal = np.maximum(self.own - self.left, 0.1 * self.own) + 1.0
        found, _ = cg(
            LinearOperator((M, M), matvec=product, dtype=float), self.score - self.half.along(self.step[None])[0],
            rtol=0.05, maxiter=STEPS, M=LinearOperator((M, M), matvec=lambda v: v / diagonal, dtype=float),
        )  # fmt: skip
        common = (self.step - self.factor.solve(self.half.back(found)))[self.joint.states :]
        first, second = (np.append(own, 0.0) for own in (common, common + found))
        return [
            np.where(on[:, None], second[read], first[read])
            for on, read in zip(self.late, self.half.reads, strict=True)
        ]  # fmt: skip

    def compare(self, inflation: np.ndarray, limit: float) -> Halves:
        """How each bias alone differs; suspected is what `limit` times its `inflation` (M,) might not hold."""
        alpha, z, step = self.alpha, self.z, self.step
        # without the prior of the level of the bias itself
        root = alpha / np.maximum(1.0 - alpha * self.levels, 1e-3)
        left = self.left + root * self.crossed**2
        score = self.score - self.half.along(step[None])[0] - alpha * z * self.crossed
        score = score - root * self.crossed * (step[self.joint.states :] + alpha * z * self.levels)
        share = np.minimum(alpha * self.levels, 1.0) / np.maximum(1.0 - alpha * self.levels, 1e-3)
        error = (left + root * self.crossed**2 * share) * np.sqrt(2.0 / SAMPLED)
        information = np.where(self.own - left > np.maximum(TOLD * error, LEAST), self.own - left, 0.0)
        least = np.maximum(self.own - left - 2.0 * error, 0.05 * self.own + 1e-300)
        may = score**2 / least / inflation * (self.own > LEAST)
        every = np.argsort(-may)[: np.count_nonzero(may > SUSPECT * limit)]
        suspects = np.sort(every[:MOST])
        exact = self._solved(suspects)
        estimate = np.where(information > 0, score / np.maximum(information, 1e-300), 0.0)
        for k, m in enumerate(suspects):
            (told,), (pull,) = (part.ravel() for part in exact.differences([k]))
            information[m] = told if told > LEAST else 0.0
            estimate[m] = pull / told if told > LEAST else 0.0
        return Halves(estimate, information, suspects, max(len(every) - MOST, 0), exact)

    def _solved(self, suspects: np.ndarray) -> Exact:
        """What is exact about suspected biases, by two solves of each."""
        S, start, n = len(suspects), self.joint.states, self.joint.places.size
        units = np.zeros((S, len(self.alpha)))
        units[np.arange(S), suspects] = 1.0
        sides = np.stack([self.half.back(unit) for unit in units], 1) if S else np.zeros((n, 0))

        def along(columns: np.ndarray) -> np.ndarray:  # of the differences, then of the levels
            return np.concatenate([sides.T @ columns, columns[start + suspects]])

        among = np.zeros((2 * S, 2 * S))
        for first in range(0, S, COLUMNS):
            mine = slice(first, min(first + COLUMNS, S))
            among[:, mine] = along(self.factor.solve(sides[:, mine]))
            levels = np.zeros((n, mine.stop - first))
            levels[start + suspects[mine], np.arange(mine.stop - first)] = 1.0
            among[:, S + first : S + mine.stop] = along(self.factor.solve(levels))
        return Exact(
            sides[start + suspects], 0.5 * (among + among.T), self.score[suspects], along(self.step), self.z[suspects],
            self.alpha[suspects],
        )  # fmt: skip


def drifts_of(halves: Halves, inflation: np.ndarray, limit: float) -> list[HalfChange]:
    """Biases whose halves differ beyond the limit, the strongest first, as `pieces.changing` lets them free.

    One is let free at a time, that whose change of the order of its scale explains most, and the others are judged
    anew beside it.
    """
    found, held = list[HalfChange](), list[int]()
    while len(held) < FREED:
        best, most = None, -np.inf
        for k, m in enumerate(halves.solved):
            if k in held:
                continue
            information, score = halves.exact.differences([*held, k])
            among, own = information[:-1, :-1], information[-1, :-1]
            told = information[-1, -1] - own @ np.linalg.pinv(among, hermitian=True) @ own
            pull = score[-1] - own @ np.linalg.pinv(among, hermitian=True) @ score[:-1]
            if told <= LEAST or pull**2 / told / inflation[m] <= limit:
                continue
            if (plausible := pull**2 / (told + 0.5) / inflation[m]) > most:
                best, most = (k, HalfChange(int(m), float(pull / told), float(told))), plausible
        if best is None:
            break
        held.append(best[0])
        found.append(best[1])
    return found


class _Half:
    """What rows in the second half say: each sum is over these alone."""

    def __init__(
        self, model: Model, rows: tuple[Linearised, ...], joint: JointPrecision, late: list[np.ndarray]
    ):  # fmt: skip
        self.joint, self.biases, self.reads = joint, model.biases, model.read
        self._form = tuple((tuple(block.used), r) for block, _, r in model.each_block())
        self._parts = tuple(
            (_only(lin, on), np.asarray(read), data.epoch)
            for _, data, _, lin, read, on in model.each_block(rows, model.read, late)
        )

    def score(self) -> np.ndarray:
        """Slope (M,) of the log-likelihood by each bias."""
        found = np.zeros(self.biases + 1)
        for lin, read, _ in self._parts:
            own = np.einsum("nc,ncp->np", np.asarray(lin.score), np.asarray(lin.bias))
            found += np.bincount(np.asarray(read).ravel(), own.ravel(), self.biases + 1)
        return found[:-1]

    def own(self) -> np.ndarray:
        """Information (M,) about each bias, all else known."""
        found = np.zeros(self.biases + 1)
        for lin, read, _ in self._parts:
            which, bias, weight = np.asarray(read), np.asarray(lin.bias), np.asarray(lin.weight)
            for a in range(which.shape[1]):
                for b in range(which.shape[1]):  # a bias may stand in two places of a sensor
                    same = which[:, a] == which[:, b]
                    own = np.einsum("nc,nc,nc->n", weight, bias[:, :, a], bias[:, :, b]) * same
                    found += np.bincount(which[:, a], own, self.biases + 1)
        return found[:-1]

    def along(self, values: np.ndarray) -> np.ndarray:
        """Products (K, M) of the information between differences and all variables with values (K, n)."""
        return np.asarray(_along(self._parts, self._form, self.joint.slots, self.biases, values))

    def back(self, difference: np.ndarray) -> np.ndarray:
        """The information (n,) between all variables and differences (M,)."""
        return np.asarray(_back(self._parts, self._form, self.joint.slots, self.joint.places.size, difference))


def _only(lin: Linearised, on: np.ndarray) -> Any:
    """Rows of which those that are not `on` say nothing."""
    kept = np.asarray(on, float)[:, None]
    return lin._replace(weight=np.asarray(lin.weight) * kept, score=np.asarray(lin.score) * kept)


@partial(jax.jit, static_argnames=("form", "biases"))
def _along(parts: Parts, form: Form, slots: tuple[jax.Array, ...], biases: int, values: jax.Array) -> jax.Array:
    """Of each of K directions (K, n) of all variables what rows see of it, along each bias (K, M)."""
    return jnp.asarray(jax.lax.map(partial(_seen, parts, form, slots, biases), values))


@partial(jax.jit, static_argnames=("form", "size"))
def _back(parts: Parts, form: Form, slots: tuple[jax.Array, ...], size: int, difference: jax.Array) -> jax.Array:
    """The transpose of what rows see: of a difference (M,), along each of all variables (n,)."""
    _, back = jax.vjp(partial(_seen, parts, form, slots, len(difference)), jnp.zeros(size))
    return jnp.asarray(back(difference)[0])


def _seen(parts: Parts, form: Form, slots: tuple[jax.Array, ...], biases: int, values: jax.Array) -> jax.Array:
    """What rows see of one direction (n,), along each bias (M,)."""
    padded, total = jnp.append(values, 0.0), jnp.zeros(biases + 1)
    z = jnp.append(values[len(values) - biases :], 0.0)
    for (lin, read, epoch), (used, r) in zip(parts, form, strict=True):
        at = padded[slots[r][epoch][:, jnp.asarray(used, int)]]
        seen = jnp.einsum("ncu,nu->nc", lin.state, at) + jnp.einsum("ncp,np->nc", lin.bias, z[read])
        total = total.at[read].add(jnp.einsum("nc,nc,ncp->np", lin.weight, seen, lin.bias))
    return total[:-1]
