"""Places of targets that stand still, integrated by quadrature where Laplace's formula is wrong.

A tag that one receiver hears stands anywhere on a ring, one that two hear on either side of their line. What such an
integral adds to that of the Gaussian at the mode changes slowly with the biases: near a point it is a linear term of
their log-likelihood, the tilt, which a model carries like one more datum.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import logsumexp

from probcal.model.model import At, Model
from probcal.smoothing.linearised import compress_and_eliminate, linearise_rows
from probcal.smoothing.marginal import volume_slope
from probcal.smoothing.mode import Point, factors

MOST = 3  # entries of a state that is integrated
FEW = 2  # poses above the dimension up to which a place may be a ring or one of two
OFF = 0.02  # nats by which Gauss-Hermite quadrature and Laplace's formula may differ elsewhere
REACH, FIRST = 5.0, {1: 64, 2: 16, 3: 10}  # sds of the prior, and cells an axis of the first grid
FINE = 0.8  # sds of what is left that a cell may be wide
FAR = 22.0  # nats below the best within which cells are kept
LEVELS, CELLS = 14, 2048  # most halvings, and cells of a target that are halved at once
WORK = 4e7  # cells times rows of a look: more rows have fewer cells
BATCH, ROWS = 256, 2_000_000  # cells evaluated by one call, and rows times cells of it that are in memory at once


class Still(NamedTuple):
    """Targets of one recursion that are integrated: which (T,), start means (T, n) and factors (T, n, n)."""

    on: jax.Array
    mean: jax.Array
    root: jax.Array


def tilt_of(model: Model, point: Point) -> tuple[jax.Array, jax.Array] | None:
    """Constant and slope (M,) of what exact integrals over places add to Laplace's formula near a consistent point.

    None where no target stands still, or where the formula is right for all that do.
    """
    still = _still(model, point)
    if still is None or not model.biases:
        return None
    still = _curved(model, point, still)
    if not any(np.any(s.on) for s in still):
        return None
    height, slope = _gain(model, point, still, *_cells(model, point, still))
    _, solved = compress_and_eliminate(model, point, linearise_rows(model, point))
    epochs = tuple(s.on[part.target] for s, part in zip(still, model.recursions, strict=True))
    volume, sound = volume_slope(model, point, solved, epochs)
    slope = slope + 0.5 * np.asarray(volume)
    if not (bool(sound) and np.isfinite(height) and np.isfinite(slope).all()):
        return None
    return jnp.asarray(height - slope @ np.asarray(point.z)), jnp.asarray(slope)


def _still(model: Model, point: Point) -> tuple[Still, ...] | None:
    """The targets that stand still at a place that is not known; None without any."""
    found, some = [], False
    for r, part in enumerate(model.recursions):
        E, n = part.drift.shape
        T = model.targets[r]
        on = np.zeros(T, bool)
        L, drift = np.asarray(factors(part, point.levels)), np.asarray(part.drift)
        mean, root = np.zeros((T, n)), np.zeros((T, n, n))
        if n <= MOST and E and not part.tails:
            first, target = np.asarray(part.first), np.asarray(part.target)
            rests = np.all(np.asarray(part.F) == np.eye(n), (1, 2)) & np.all(L == 0, (1, 2)) & np.all(drift == 0, 1)
            moves = np.bincount(target, ~(first | rests), T) > 0
            mean[target[first]], root[target[first]] = drift[first], L[first]
            on = ~moves & np.any(root != 0, (1, 2)) & (np.bincount(target, first, T) == 1)
        some = some or bool(on.any())
        found.append(Still(jnp.asarray(on), jnp.asarray(mean), jnp.asarray(root)))
    return tuple(found) if some else None


def _by_target(model: Model, values: list[jax.Array]) -> list[jax.Array]:
    """Sums over the epochs of each target."""
    parts = zip(model.recursions, model.targets, values, strict=True)
    return [jax.ops.segment_sum(v, part.target, T) for part, T, v in parts]


def _placed(model: Model, point: Point, still: tuple[Still, ...], u: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
    """States with the chosen targets at whitened places (T, n) of each recursion."""
    states = []
    for part, s, own, x in zip(model.recursions, still, u, point.states, strict=True):
        place = s.mean + jnp.einsum("tij,tj->ti", s.root, own)
        states.append(jnp.where(s.on[part.target][:, None], place[part.target], x))
    return tuple(states)


def _densities(
    model: Model, point: Point, still: tuple[Still, ...], z: jax.Array, u: tuple[jax.Array, ...]
) -> list[jax.Array]:
    """Log-likelihood (T,) of the rows of each target with the chosen ones at whitened places."""
    at = At(_placed(model, point, still, u), z, point.levels)
    return _by_target(model, model.by_epoch(model.log_likelihood(at)))


Look = list[tuple[np.ndarray, np.ndarray, np.ndarray]]


def _together(model: Model) -> int:
    """Cells evaluated side by side."""
    return max(1, min(BATCH, ROWS // max(sum(data.y.shape[0] for data in model.rows), 1)))


@jax.jit
def _look(model: Model, point: Point, still: tuple[Still, ...], u: tuple[jax.Array, ...]) -> Any:
    """At `BATCH` whitened places of every target: log density (K, T), its slope (K, T, n) and expected precision."""

    def one(u: tuple[jax.Array, ...]) -> Any:
        told = _densities(model, point, still, point.z, u)
        at = At(_placed(model, point, still, u), point.z, point.levels)
        own = model.of_states(model.linearise(at, expected=True))
        J, score = (_by_target(model, [pair[k] for pair in own]) for k in (0, 1))
        found = []
        for s, f, j, g, v in zip(still, told, J, score, u, strict=True):
            W = jnp.eye(v.shape[1])[None] + jnp.einsum("tji,tjk,tkl->til", s.root, j, s.root)
            found.append((f - 0.5 * jnp.sum(v**2, 1), jnp.einsum("tji,tj->ti", s.root, g) - v, W))
        return tuple(found)

    return jax.lax.map(one, u, batch_size=_together(model))


@jax.jit
def _pulled(
    model: Model, point: Point, still: tuple[Still, ...], u: tuple[jax.Array, ...], shares: tuple[jax.Array, ...]
) -> jax.Array:
    """Slope (M,) by z of the log-likelihoods at `BATCH` places of every target, each with its share (K, T)."""

    def weighted(z: jax.Array, u: tuple[jax.Array, ...], p: tuple[jax.Array, ...]) -> jax.Array:
        pairs = zip(_densities(model, point, still, z, u), p, strict=True)
        return sum((jnp.sum(jnp.where(w > 0, f, 0.0) * w) for f, w in pairs), jnp.zeros(()))

    pulls = jax.lax.map(lambda at: jax.grad(weighted)(point.z, *at), (u, shares), batch_size=_together(model))
    return jnp.sum(pulls, 0)


def _looked(model: Model, point: Point, still: tuple[Still, ...], u: list[np.ndarray]) -> Look:
    """`_look` at any number of places (K, T, n) of each recursion."""
    K = len(u[0])
    parts = [_look(model, point, still, own) for own in _batches(u)]

    def whole(r: int, k: int) -> np.ndarray:
        return np.concatenate([np.asarray(part[r][k]) for part in parts])[:K]

    return [(whole(r, 0), whole(r, 1), whole(r, 2)) for r in range(len(u))]


def _batches(arrays: list[np.ndarray]) -> Iterator[tuple[jax.Array, ...]]:
    """Arrays with the same number of rows in parts of `BATCH`, the last one filled up with zeros."""
    for k in range(0, len(arrays[0]), BATCH):
        own = [a[k : k + BATCH] for a in arrays]
        yield tuple(jnp.asarray(np.concatenate([a, np.zeros((BATCH - len(a), *a.shape[1:]))])) for a in own)


def _first(model: Model, point: Point) -> list[np.ndarray]:
    """Whitened places (T, n) at a point: the noises of first epochs."""
    found = []
    for part, T, u in zip(model.recursions, model.targets, point.noises, strict=True):
        own = np.zeros((T, u.shape[1]))
        first = np.asarray(part.first)
        own[np.asarray(part.target)[first]] = np.asarray(u)[first]
        found.append(own)
    return found


def _poses(model: Model) -> list[np.ndarray]:
    """Number (T,) of different stated poses from which each target is seen."""
    seen: list[list[set[bytes]]] = [[set() for _ in range(T)] for T in model.targets]
    for b, (data, r) in enumerate(zip(model.rows, model.recursion, strict=True)):
        target = np.asarray(model.recursions[r].target)[np.asarray(data.epoch)]
        pose, there = np.asarray(data.pose), np.asarray(data.mask).any(1)
        for t, own in zip(target[there], pose[there], strict=True):
            seen[r][t].add(bytes([b]) + own.tobytes())
    return [np.array([len(own) for own in part], int) for part in seen]


def _curved(model: Model, point: Point, still: tuple[Still, ...]) -> tuple[Still, ...]:
    """Of targets that stand still those seen from few poses, and those where a quadrature is not Laplace's formula."""
    middle = _first(model, point)
    here = _looked(model, point, still, [m[None] for m in middle])
    x, w = np.polynomial.hermite_e.hermegauss(3)
    rules = []
    for m, (_, _, W) in zip(middle, here, strict=True):
        n = m.shape[1]
        nodes = np.stack(np.meshgrid(*[x] * n, indexing="ij"), -1).reshape(-1, n)
        with np.errstate(all="ignore"):
            spread = np.linalg.inv(np.linalg.cholesky(np.nan_to_num(W[0]) + 1e-12 * np.eye(n)))
        log_w = np.log(np.stack(np.meshgrid(*[w] * n, indexing="ij"), -1).reshape(-1, n) / w.sum()).sum(1)
        rules.append((m + np.einsum("tji,kj->kti", spread, nodes), log_w + 0.5 * (nodes**2).sum(1)))
    most = max(len(log_w) for _, log_w in rules)
    looked = _looked(model, point, still, [np.concatenate([u, np.repeat(u[:1], most - len(u), 0)]) for u, _ in rules])
    chosen = []
    parts = zip(still, rules, looked, here, _poses(model), strict=True)
    for s, (_, log_w), (f, _, _), (top, _, _), poses in parts:
        off = np.abs(logsumexp(f[: len(log_w)] - top + log_w[:, None], axis=0))
        few = poses <= s.mean.shape[1] + FEW
        chosen.append(s._replace(on=jnp.asarray(np.asarray(s.on) & (poses > 0) & (few | (off > OFF)))))
    return tuple(chosen)


def _halved(cells: np.ndarray, width: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Each cell (m, n) cut in two along every axis."""
    n = cells.shape[1]
    corner = np.stack(np.meshgrid(*[[-0.25, 0.25]] * n, indexing="ij"), -1).reshape(-1, n)
    return (cells[:, None] + width[:, None, None] * corner).reshape(-1, n), np.repeat(0.5 * width, len(corner))


class _Target:
    """Cells of one target: those that are fine enough, and those still to be halved."""

    def __init__(self, n: int, rows: int):
        axis = REACH * (2 * np.arange(FIRST[n]) + 1 - FIRST[n]) / FIRST[n]
        self.cells = np.stack(np.meshgrid(*[axis] * n, indexing="ij"), -1).reshape(-1, n)
        self.width = np.full(len(self.cells), 2 * REACH / FIRST[n])
        self.best, self.most = -np.inf, max(min(CELLS, int(WORK / max(rows, 1) / 2**n)), 32)
        self.kept: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def seen(self, f: np.ndarray, g: np.ndarray, W: np.ndarray, last: bool) -> None:
        """Sort the cells by their density, its slope and its precision, and halve those that are too wide."""
        f = np.where(np.isfinite(f), f, -np.inf)
        g, W = np.nan_to_num(g), np.nan_to_num(W) + 1e-12 * np.eye(g.shape[1])
        rise = 0.5 * np.einsum("ki,ki->k", g, np.linalg.solve(W, g[:, :, None])[:, :, 0])
        rise = np.minimum(np.abs(rise), 0.5 * np.abs(g).sum(1) * self.width)
        self.best = max(self.best, float(f.max(initial=-np.inf)))
        near = f + rise >= self.best - FAR
        wide = (self.width * np.sqrt(np.linalg.eigvalsh(W)[:, -1]) > FINE) & (not last)
        ready = near & ~wide
        self.kept.append((self.cells[ready], self.width[ready], f[ready]))
        again = np.flatnonzero(near & wide)
        again = again[np.argsort(-(f + rise)[again], kind="stable")[: self.most]]
        self.cells, self.width = _halved(self.cells[again], self.width[again])

    def nodes(self) -> tuple[np.ndarray, np.ndarray]:
        """Places (m, n) and log weights (m,)."""
        cells, width, f = (np.concatenate(parts) for parts in zip(*self.kept, strict=True))
        near = f >= self.best - FAR
        n = cells.shape[1]
        return cells[near], n * np.log(width[near]) - 0.5 * n * np.log(2 * np.pi)


def _cells(model: Model, point: Point, still: tuple[Still, ...]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Nodes of the chosen targets, whitened places (K, T, n) and log weights (K, T) of each recursion.

    They are cells as fine as the density asks for, found by halving those that may matter.
    """
    rows = sum(data.y.shape[0] for data in model.rows)
    chosen = {(r, int(t)): _Target(s.mean.shape[1], rows) for r, s in enumerate(still) for t in np.flatnonzero(s.on)}
    for level in range(LEVELS):
        if not any(len(own.cells) for own in chosen.values()):
            break
        u = _padded(model, {key: own.cells for key, own in chosen.items()})
        looked = _looked(model, point, still, u)
        for (r, t), own in chosen.items():
            if m := len(own.cells):
                f, g, W = (leaf[:m, t] for leaf in looked[r])
                own.seen(f, g, W, level == LEVELS - 1)
    found = {key: own.nodes() for key, own in chosen.items()}
    u = _padded(model, {key: cells for key, (cells, _) in found.items()})
    weights = [np.full(part.shape[:2], -np.inf) for part in u]
    for (r, t), (_, log_weight) in found.items():
        weights[r][: len(log_weight), t] = log_weight
    return u, weights


def _padded(model: Model, cells: dict[tuple[int, int], np.ndarray]) -> list[np.ndarray]:
    """Cells of all targets as arrays (K, T, n) of each recursion, zeros where a target has fewer."""
    most = max(len(own) for own in cells.values())
    u = [np.zeros((most, T, part.drift.shape[1])) for part, T in zip(model.recursions, model.targets, strict=True)]
    for (r, t), own in cells.items():
        u[r][: len(own), t] = own
    return u


def _gain(
    model: Model, point: Point, still: tuple[Still, ...], u: list[np.ndarray], log_weights: list[np.ndarray]
) -> tuple[float, np.ndarray]:
    """Sum over the chosen targets of the log integral less Laplace's, and its slope (M,) but for the determinants."""
    looked = _looked(model, point, still, u)
    here = _first(model, point)
    tops = _looked(model, point, still, [m[None] for m in here])
    height, shares, ones = 0.0, [], []
    for s, (f, _, _), (top, _, W), log_weight in zip(still, looked, tops, log_weights, strict=True):
        on = np.asarray(s.on)
        with np.errstate(invalid="ignore"):
            total = logsumexp(f + log_weight, axis=0)
            shares.append(np.where(on, np.exp(f + log_weight - total), 0.0))
        ones.append(np.where(on, 1.0, 0.0)[None])
        height += float(np.sum((total - top[0] + 0.5 * np.linalg.slogdet(W[0])[1])[on]))
    slope = -np.asarray(
        sum(_pulled(model, point, still, *_halves(b, len(u))) for b in _batches([m[None] for m in here] + ones))
    )
    for both in _batches(u + shares):
        slope = slope + np.asarray(_pulled(model, point, still, *_halves(both, len(u))))
    return height, slope


def _halves(both: tuple[jax.Array, ...], count: int) -> tuple[tuple[jax.Array, ...], tuple[jax.Array, ...]]:
    return both[:count], both[count:]
