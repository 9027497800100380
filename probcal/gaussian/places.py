"""Places of targets that stand still, integrated by quadrature where Laplace's formula is wrong.

A tag that one receiver hears stands anywhere on a ring, one that two hear on either side of their line. What such an
integral adds to that of the Gaussian at the mode is near a point a quadratic term of the log-likelihood of the biases,
the tilt, which a model carries like one more datum.
"""

from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal import linalg
from probcal.gaussian.held import hold
from probcal.gaussian.linearised import linearise_rows
from probcal.gaussian.marginal import volume_slope
from probcal.gaussian.mode import Point, eliminate_rows, factors
from probcal.geometry import lattice
from probcal.model.model import TILTED, At, Model, Recursion, Tilt
from probcal.model.trajectories import States

MOST = 3  # entries of a state that is integrated
FEW = 2  # poses above the dimension up to which a place may be a ring or one of two
OFF = 0.02  # nats by which Gauss-Hermite quadrature and Laplace's formula may differ elsewhere
REACH, FIRST = 5.0, {1: 64, 2: 16, 3: 10}  # sds of the prior, and cells an axis of the first grid
FINE = 0.8  # sds of what is left that a cell may be wide
FAR = 22.0  # nats below the best within which cells are kept
LEVELS, CELLS = 22, 2048  # most halvings, and cells of a target that are halved at once
WORK = 4e7  # cells times rows of a look: more rows have fewer cells
LEAST = 0.1  # share of the information of Laplace's formula that is left along every direction
BATCH, ROWS = 256, 2_000_000  # cells evaluated by one call, and rows times cells of it that are in memory at once


class Still(NamedTuple):
    """Targets of one recursion that are integrated: which (T,), start means (T, n) and factors (T, n, n)."""

    on: jax.Array
    mean: jax.Array
    root: jax.Array


def places_of(model: Model, point: Point) -> tuple[Still, ...] | None:
    """Targets that stand still, and of these those that Laplace's formula is wrong for at a consistent point.

    None where no target stands still; where the formula is right for all that do, none of them is on.
    """
    still = _still(model, point)
    return None if still is None or not model.biases else _curved(model, point, still)


def tilt_of(model: Model, point: Point, still: tuple[Still, ...]) -> Tilt | None:
    """The Laplace correction from exact integrals over chosen places near a consistent point; None
    if not finite.

    Its curvature is what the information of the biases becomes: expected information less the variance of the score
    over the places (Louis 1982), in the place of the Schur complement.
    """
    M = model.biases
    if not any(np.any(s.on) for s in still):
        return Tilt.none(M)
    height, slope, information = _gain(model, point, still, *_cells(model, point, still))
    epochs, rows = model.each(lambda part, s: s.on[part.target], still), linearise_rows(model, point)
    solved = hold(model, point, rows) if information is None else eliminate_rows(model, point, rows)
    volume, sound = volume_slope(model, point, solved, epochs)
    slope, curvature = slope + 0.5 * np.asarray(volume), Tilt.none(M).curvature
    if information is not None:
        laplace, exact = np.asarray(solved.information), information + np.asarray(_schur(model, point, still))
        if not (np.isfinite(laplace).all() and np.isfinite(exact).all()):
            return None
        # A curvature (M, M) that leaves its share of the information (M, M) of Laplace's formula along every direction
        root = np.linalg.cholesky(laplace + (1e-9 * np.trace(laplace) + 1e-6) * np.eye(len(laplace)))
        half = np.linalg.solve(root, np.linalg.solve(root, 0.5 * (exact + exact.T)).T)
        values, vectors = np.linalg.eigh(0.5 * (half + half.T))
        back = root @ vectors
        curvature = (back * np.maximum(values, LEAST - 1.0)) @ back.T
    if not (bool(sound) and np.isfinite(height) and np.isfinite(slope).all() and np.isfinite(curvature).all()):
        return None
    return Tilt(np.asarray(point.z), np.asarray(height), slope, curvature)


def tilt_at(model: Model, point: Point) -> Tilt:
    """The Laplace correction from places near a consistent point, whatever the model has; else
    none."""
    none = Tilt.none(model.biases)
    plain = model.with_tilt(none)
    places = places_of(plain, point)
    found = None if places is None else tilt_of(plain, point, places)
    return none if found is None else found


def _still(model: Model, point: Point) -> tuple[Still, ...] | None:
    """The targets that stand still at a place that is not known; None without any."""
    resting = model.resting
    if not any(on.any() for on in resting):
        return None

    def of(part: Recursion, T: int, on: np.ndarray) -> Still:
        n = part.drift.shape[1]
        first, target, L = np.asarray(part.first), np.asarray(part.target), np.asarray(factors(part, point.levels))
        mean, root = np.zeros((T, n)), np.zeros((T, n, n))
        mean[target[first]], root[target[first]] = np.asarray(part.drift)[first], L[first]
        return Still(*jax.device_put((on & (n <= MOST), mean, root)))

    return model.each(of, model.targets, resting)


def _placed(model: Model, point: Point, still: tuple[Still, ...], u: States) -> States:
    """States with the chosen targets at whitened places (T, n) of each recursion."""

    def placed(part: Recursion, s: Still, own: jax.Array, x: jax.Array) -> jax.Array:
        place = s.mean + jnp.einsum("tij,tj->ti", s.root, own)
        return jnp.where(s.on[part.target][:, None], place[part.target], x)

    return model.each(placed, still, u, point.states)


Look = list[tuple[np.ndarray, np.ndarray, np.ndarray]]


def _together(model: Model) -> int:
    """Cells evaluated side by side, a power of two."""
    each = max(sum(data.y.shape[0] for data in model.rows), sum(model.targets) * model.biases, 1)
    return min(BATCH, 1 << (max(ROWS // each, 1).bit_length() - 1))


@jax.jit
def _look(model: Model, point: Point, still: tuple[Still, ...], u: States) -> Any:
    """At `BATCH` whitened places of every target: log density (K, T), its slope (K, T, n) and expected precision."""

    def one(u: States) -> Any:
        at = At(_placed(model, point, still, u), point.z, point.levels)
        told = model.by_target(model.by_epoch(model.log_likelihood(at)))
        own = model.of_states(model.linearise(at, expected=True))
        J, score = (model.by_target([pair[k] for pair in own]) for k in (0, 1))
        found = []
        for s, f, j, g, v in zip(still, told, J, score, u, strict=True):
            W = jnp.eye(v.shape[1])[None] + jnp.einsum("tji,tjk,tkl->til", s.root, j, s.root)
            found.append((f - 0.5 * jnp.sum(v**2, 1), jnp.einsum("tji,tj->ti", s.root, g) - v, W))
        return tuple(found)

    return jax.lax.map(one, u, batch_size=_together(model))


class PlaceScores(NamedTuple):
    """Of scores by the biases over shares of places: sums (T, M) of each recursion.

    Where they are asked for, squares and information (M, M) too.
    """

    first: States
    second: jax.Array
    information: jax.Array


@partial(jax.jit, static_argnames="curved")
def _moments(
    model: Model, point: Point, still: tuple[Still, ...], u: States, shares: States, *, curved: bool
) -> PlaceScores:
    """PlaceScores over `BATCH` whitened places (K, T, n) of every target, each with its share (K, T)."""
    M, together = model.biases, _together(model)
    square = jnp.zeros((M, M) if curved else ())

    def one(u: States, p: States) -> PlaceScores:
        lins = model.linearise(At(_placed(model, point, still, u), point.z, point.levels), expected=True)
        first = [jnp.zeros((T, M + 1)) for T in model.targets]
        weighed, second, information = [], square, square
        for _, data, r, lin in model.each_block(lins):
            target = model.recursions[r].target[data.epoch]
            w = p[r][target][:, None]
            bias, score = jnp.where((w > 0)[:, :, None], lin.bias, 0.0), jnp.where(w > 0, lin.score, 0.0)
            pull = jnp.einsum("ncp,nc->np", bias, score)
            first[r] = first[r].at[target[:, None], data.bias[data.sensor]].add(pull)
            weighed.append(lin._replace(bias=bias, score=score, weight=jnp.where(w > 0, lin.weight * w, 0.0)))
        g = [own[:, :M] for own in first]
        if curved:
            information, _ = model.of_biases(weighed)
            second = sum((jnp.einsum("tm,t,tn->mn", own, share, own) for own, share in zip(g, p, strict=True)), second)
        return PlaceScores(tuple(own * w[:, None] for own, w in zip(g, p, strict=True)), second, information)

    def add(total: PlaceScores, some: tuple[States, States]) -> tuple[PlaceScores, None]:
        found = jax.vmap(one)(*some)
        return jax.tree.map(lambda a, b: a + jnp.sum(b, 0), total, found), None

    parts = jax.tree.map(lambda x: x.reshape(-1, together, *x.shape[1:]), (u, shares))
    nothing = PlaceScores(tuple(jnp.zeros((T, M)) for T in model.targets), square, square)
    return jax.lax.scan(add, nothing, parts)[0]


@jax.jit
def _schur(model: Model, point: Point, still: tuple[Still, ...]) -> jax.Array:
    """The information that Laplace's formula loses to the chosen places: J_zx W^-1 J_xz (M, M)
    summed over targets."""
    lins = model.linearise(point, expected=True)
    J = model.by_target([own for own, _ in model.of_states(lins)])
    cross = model.by_target(model.of_both(lins))
    lost = jnp.zeros((model.biases, model.biases))
    for s, j, c in zip(still, J, cross, strict=True):
        W = jnp.eye(j.shape[1])[None] + jnp.einsum("tji,tjk,tkl->til", s.root, j, s.root)
        right = jnp.einsum("tji,tjm->tim", s.root, c)
        alone = linalg.forward(linalg.semi_cholesky(W), right)
        lost = lost + jnp.einsum("tim,tin,t->mn", alone, alone, s.on.astype(alone.dtype))
    return lost


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
        yield tuple(jax.device_put(np.concatenate([a, np.zeros((BATCH - len(a), *a.shape[1:]))])) for a in own)


def _first(model: Model, point: Point) -> tuple[np.ndarray, ...]:
    """Whitened places (T, n) at a point: the noises of first epochs."""

    def of(part: Recursion, T: int, u: jax.Array) -> np.ndarray:
        own = np.zeros((T, u.shape[1]))
        first = np.asarray(part.first)
        own[np.asarray(part.target)[first]] = np.asarray(u)[first]
        return own

    return model.each(of, model.targets, point.noises)


def _curved(model: Model, point: Point, still: tuple[Still, ...]) -> tuple[Still, ...]:
    """Of targets that stand still those seen from few poses, and those where a quadrature is not Laplace's formula."""
    middle = _first(model, point)
    here = _looked(model, point, still, [m[None] for m in middle])
    x, w = np.polynomial.hermite_e.hermegauss(3)
    rules = []
    for m, (_, _, W) in zip(middle, here, strict=True):
        n = m.shape[1]
        nodes = lattice([x] * n)
        with np.errstate(all="ignore"):
            spread = np.linalg.inv(np.linalg.cholesky(np.nan_to_num(W[0]) + 1e-12 * np.eye(n)))
        log_w = np.log(lattice([w / w.sum()] * n)).sum(1)
        rules.append((m + np.einsum("tji,kj->kti", spread, nodes), log_w + 0.5 * (nodes**2).sum(1)))
    most = max(len(log_w) for _, log_w in rules)
    looked = _looked(model, point, still, [np.concatenate([u, np.repeat(u[:1], most - len(u), 0)]) for u, _ in rules])
    chosen = []
    # number (T,) of different stated poses from which each target is seen
    seen: list[list[set[bytes]]] = [[set() for _ in range(T)] for T in model.targets]
    for b, (_, data, r) in enumerate(model.each_block()):
        target = np.asarray(model.recursions[r].target)[np.asarray(data.epoch)]
        pose, there = np.asarray(data.pose), np.asarray(data.mask).any(1)
        for t, own in zip(target[there], pose[there], strict=True):
            seen[r][t].add(bytes([b]) + own.tobytes())
    parts = zip(still, rules, looked, here, [np.array([len(own) for own in part], int) for part in seen], strict=True)
    for s, (_, log_w), (f, _, _), (top, _, _), poses in parts:
        off = np.abs(np.logaddexp.reduce(f[: len(log_w)] - top + log_w[:, None], axis=0))
        few = poses <= s.mean.shape[1] + FEW
        chosen.append(s._replace(on=jax.device_put(np.asarray(s.on) & (poses > 0) & (few | (off > OFF)))))
    return tuple(chosen)


class _Target:
    """Cells of one target: those that are fine enough, and those still to be halved.

    Those around the mode stay: from far off heavy-tailed noise hides how much better the data fit there.
    """

    def __init__(self, mode: np.ndarray, top: float, rows: int):
        n, self.mode = len(mode), mode
        top = top if np.abs(mode).max() <= REACH else -np.inf  # the grid does not reach it
        axis = REACH * (2 * np.arange(FIRST[n]) + 1 - FIRST[n]) / FIRST[n]
        self.cells = lattice([axis] * n)
        self.width = np.full(len(self.cells), 2 * REACH / FIRST[n])
        self.best, self.most = top, max(min(CELLS, int(WORK / max(rows, 1) / 2**n)), 32)
        self.kept: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def seen(self, f: np.ndarray, g: np.ndarray, W: np.ndarray, last: bool) -> None:
        """Sort the cells by their density, its slope and its precision, and halve those that are too wide."""
        f = np.where(np.isfinite(f), f, -np.inf)
        g, W = np.nan_to_num(g), np.nan_to_num(W) + 1e-12 * np.eye(g.shape[1])
        rise = 0.5 * np.einsum("ki,ki->k", g, np.linalg.solve(W, g[:, :, None])[:, :, 0])
        rise = np.minimum(np.abs(rise), 0.5 * np.abs(g).sum(1) * self.width)
        self.best = max(self.best, float(f.max(initial=-np.inf)))
        around = np.abs(self.cells - self.mode).max(1) <= self.width
        near = (f + rise >= self.best - FAR) | around
        wide = (self.width * np.sqrt(np.linalg.eigvalsh(W)[:, -1]) > FINE) & (not last)
        ready = near & ~wide
        self.kept.append((self.cells[ready], self.width[ready], f[ready]))
        again = np.flatnonzero(near & wide)
        again = again[np.argsort(-np.where(around, np.inf, f + rise)[again], kind="stable")[: self.most]]
        corner, width = lattice([[-0.25, 0.25]] * g.shape[1]), self.width[again]
        self.cells = (self.cells[again][:, None] + width[:, None, None] * corner).reshape(-1, g.shape[1])
        self.width = np.repeat(0.5 * width, len(corner))

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
    modes = _first(model, point)
    tops = [f[0] for f, _, _ in _looked(model, point, still, [m[None] for m in modes])]
    chosen = {
        (r, int(t)): _Target(modes[r][t], float(tops[r][t]), rows)
        for r, s in enumerate(still)
        for t in np.flatnonzero(s.on)
    }
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
    u = list(model.each(lambda part, T: np.zeros((most, T, part.drift.shape[1])), model.targets))
    for (r, t), own in cells.items():
        u[r][: len(own), t] = own
    return u


def _gain(
    model: Model, point: Point, still: tuple[Still, ...], u: list[np.ndarray], log_weights: list[np.ndarray]
) -> tuple[float, np.ndarray, np.ndarray | None]:
    """Sum over the chosen targets of the log integral less Laplace's, and its slope (M,) but for the determinants.

    Third, what they tell about the biases less what their rows tell at the places of the point, (M, M).
    """
    looked = _looked(model, point, still, u)
    here = _first(model, point)
    tops = _looked(model, point, still, [m[None] for m in here])
    height, shares, ones = 0.0, [], []
    for s, (f, _, _), (top, _, W), log_weight in zip(still, looked, tops, log_weights, strict=True):
        on = np.asarray(s.on)
        with np.errstate(invalid="ignore"):
            total = np.logaddexp.reduce(f + log_weight, axis=0)
            shares.append(np.where(on, np.exp(f + log_weight - total), 0.0))
        ones.append(np.where(on, 1.0, 0.0)[None])
        height += float(np.sum((total - top[0] + 0.5 * np.linalg.slogdet(W[0])[1])[on]))
    curved = model.biases <= TILTED

    def moments(u: list[np.ndarray], shares: list[np.ndarray]) -> PlaceScores:
        parts = [(both[: len(u)], both[len(u) :]) for both in _batches(u + shares)]
        found = [_moments(model, point, still, *part, curved=curved) for part in parts]
        return jax.tree.map(lambda *leaves: sum(np.asarray(leaf) for leaf in leaves), *found)

    over, top_ = moments(u, shares), moments([m[None] for m in here], ones)
    slope = np.concatenate(over.first).sum(0) - np.concatenate(top_.first).sum(0)
    if not curved:
        return height, slope, None
    first = np.concatenate(over.first)
    return height, slope, np.asarray(over.information - top_.information - over.second) + first.T @ first
