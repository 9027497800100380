"""Localises a source heard by several nodes, power and exponent unknown: separable least squares.

Per kind of sensor i the level is theta_1,i + theta_3,i c_m(x), c_m = 10 log10 |x - p_m|, gains removed. For a place x
the two parameters have a closed form (RSS paper 7), and what is left is a function of x alone.
"""

from typing import NamedTuple

import numpy as np
from scipy import stats
from scipy.special import log_ndtr, logsumexp

from probcal.errors import InputError, nearest
from probcal.linalg import least_squares, singular, spectrum
from probcal.sensors import CLOSE

CRITERIA = ("snls", "predicted", "residual", "virtual", "gml", "huber", "student", "nls")
"""How residuals at a place are weighed: `snls` equally (the profile likelihood, and the default); by their variance
`predicted` sigma^2 (1 + h), `residual` sigma^2 (1 - h), or `virtual` as printed in (8), sigma^2 h; `gml` with unknown
noise (14); `huber` and `student` (4 degrees of freedom) for outliers; `nls` with the exponent known."""
HUBER = 1.345  # stds beyond which a residual counts linearly
FREEDOM = 4.0  # of the Student-t
REWEIGHED = 8  # rounds of reweighting of a robust criterion
EDGE = 1e-9  # leverage that counts as none, or as all
CELLS = 41  # points an axis of the grid
LOCAL = 2  # steps of the small grid around the best point to which the quadratic is fitted
RISE, NARROWED = 3.0, 20  # nats over the small grid, and how often it is halved to get there
STEPS = 60  # of Levenberg and Marquardt
ROUNDS, FINE = 6, {2: 101, 3: 41}  # grids of a posterior, each around what the last one left, and their points an axis
FAR = 14.0  # nats below the best point of a grid beyond which the next one does not go
WITHIN = 16.0  # square of the diagonal of the area over the variance, below which a place counts as open


class Snapshot(NamedTuple):
    """Levels of one instant: node places (M, d) in m, levels (M,) in dB with gains removed, kind and std of each.

    `kind` (M,) counts the kinds of sensor from 0 (a microphone and a geophone on one node are two rows); `std` (M,) in
    dB, of which `gml` uses no more than the ratios within a kind.
    """

    position: np.ndarray
    level: np.ndarray
    kind: np.ndarray
    std: np.ndarray


class Location(NamedTuple):
    """A place (d,) in m with covariance (d, d), interval (d, 2) of each coordinate, power and exponent of each kind.

    `determined` is False where the levels tell no place: the information is singular, the exponent came out at 0, or
    the best point lies on the edge of the area; then the covariance is not to be used.
    """

    position: np.ndarray
    covariance: np.ndarray
    interval: np.ndarray
    power: np.ndarray
    exponent: np.ndarray
    cost: float
    determined: bool
    message: str


def _checked(
    position: np.ndarray, level: np.ndarray, kind: np.ndarray | None = None, std: np.ndarray | float = 3.0
) -> Snapshot:
    """A checked snapshot; rows without a level (NaN) are dropped. Raises `InputError` naming what is wrong."""
    position, level = np.asarray(position, float), np.asarray(level, float)
    if position.ndim != 2 or position.shape[1] not in (2, 3) or level.shape != position.shape[:1]:
        raise InputError(f"localise: positions are (M, 2 or 3) and levels (M,), got {position.shape} and {level.shape}")
    kinds = np.zeros(len(level), int) if kind is None else np.asarray(kind, int)
    stds = np.broadcast_to(np.asarray(std, float), level.shape)
    kept = np.isfinite(level)
    if not (np.isfinite(position).all() and (stds > 0).all()):
        raise InputError("localise: positions must be finite and stds positive")
    at = Snapshot(position[kept], level[kept], kinds[kept], stds[kept])
    if (at.level > 0).all() and len(at.level) > 1 and at.level.max() < 1e-1 and np.ptp(np.log10(at.level)) > 1.5:
        raise InputError(
            f"localise: levels between {at.level.min():.3g} and {at.level.max():.3g} look like power in W; give dB,"
            " 10 log10 of it"
        )
    d = position.shape[1]
    free = sum(max(int((at.kind == k).sum()) - 2, 0) for k in np.unique(at.kind))
    if free < d:
        raise InputError(
            f"localise: {len(at.level)} levels leave {free} after power and exponent, a place in {d}-D needs {d}; give"
            " more nodes"
        )
    return at


def _regressors(at: Snapshot, places: np.ndarray) -> np.ndarray:
    """c = 10 log10 of the distances, (L, M)."""
    distance = np.linalg.norm(places[:, None] - at.position, axis=2)
    return 10 * np.log10(np.maximum(distance, CLOSE))


class _Fit(NamedTuple):
    """Of one kind at places (L,): intercept, slope (minus the exponent), residuals and leverages (L, m).

    `rising` is the slope where it came out positive and was put to zero, else what it is; `about` its information.
    """

    power: np.ndarray
    slope: np.ndarray
    left: np.ndarray
    leverage: np.ndarray
    rising: np.ndarray
    about: np.ndarray


def _line(c: np.ndarray, y: np.ndarray, w: np.ndarray, exponent: float | None) -> _Fit:
    """Weighted line y = power + slope c at every place: c (L, m), y (m,), weights (L, m); never a positive slope (7a).

    A level that grew with the distance would put the source on the far side of the nodes.
    """
    total = w.sum(1)
    cm, ym = (w * c).sum(1) / total, (w * y).sum(1) / total
    dc = c - cm[:, None]
    about = np.maximum((w * dc**2).sum(1), 1e-300)
    slope = (w * dc * y).sum(1) / about if exponent is None else np.full(len(c), -exponent)
    rising, slope = slope, np.minimum(slope, 0.0)
    power = ym - slope * cm
    left = y - power[:, None] - slope[:, None] * c
    own = w * dc**2 / about[:, None] if exponent is None else 0.0
    return _Fit(power, slope, left, np.clip(w / total[:, None] + own, EDGE, 1 - EDGE), rising, about)


def _fits(at: Snapshot, places: np.ndarray, criterion: str, exponent: float | None) -> list[tuple[np.ndarray, _Fit]]:
    """The rows (m,) of each kind and their line at every place."""
    found = []
    c = _regressors(at, places)
    for kind in np.unique(at.kind):
        mine = np.flatnonzero(at.kind == kind)
        base = np.broadcast_to(at.std[mine] ** -2.0, (len(places), len(mine)))
        fit = _line(c[:, mine], at.level[mine], base, exponent if criterion == "nls" else None)
        if criterion in ("huber", "student"):
            for _ in range(REWEIGHED):
                size = np.abs(fit.left) / at.std[mine]
                w = (
                    (FREEDOM + 1) / (FREEDOM + size**2)
                    if criterion == "student"
                    else np.minimum(1.0, HUBER / np.maximum(size, 1e-12))
                )
                fit = _line(c[:, mine], at.level[mine], base * w, None)
        found.append((mine, fit))
    return found


def losses(at: Snapshot, places: np.ndarray, criterion: str = "snls", *, exponent: float | None = None) -> np.ndarray:
    """Criterion (L,) at places (L, d), power and exponent profiled: half the weighted squares, or minus log p (9, 14).

    Weights by leverage h are those of the list `CRITERIA`. Raises `InputError` for an unknown criterion, and for `nls`
    without its `exponent`.
    """
    if criterion not in CRITERIA:
        raise InputError(f'localise: criterion is "{criterion}"{nearest(criterion, CRITERIA)}')
    if criterion == "nls" and exponent is None:
        raise InputError('localise: criterion "nls" takes the exponent as known; give exponent=2.0')
    total = np.zeros(len(places))
    for mine, fit in _fits(at, np.asarray(places, float), criterion, exponent):
        size = fit.left / at.std[mine]
        h = fit.leverage
        if criterion == "gml":
            total = total + 0.5 * len(mine) * np.log(np.maximum((size**2).sum(1), 1e-12))
        elif criterion == "huber":
            big = np.abs(size) > HUBER
            total = total + np.where(big, HUBER * (np.abs(size) - 0.5 * HUBER), 0.5 * size**2).sum(1)
        elif criterion == "student":
            total = total + 0.5 * (FREEDOM + 1) * np.log1p(size**2 / FREEDOM).sum(1)
        else:
            by = {"virtual": h, "residual": 1 - h, "predicted": 1 + h}.get(criterion, np.ones_like(h))
            total = total + 0.5 * (size**2 / by).sum(1)
    return total


def position_information(
    at: Snapshot, place: np.ndarray, slope: np.ndarray, *, exponent: float | None = None
) -> np.ndarray:
    """Fisher information (d, d) in 1/m^2 of a place, power and exponent of each kind unknown (RSS paper 20).

    `slope` (kinds,) are theta_3; with an `exponent` this is known. It is J' (I - H) J / sigma^2, J the gradients of the
    levels and H the projection on the regressors: that of the separable problem. Levels of the nodes are not read.
    """
    d = at.position.shape[1]
    total = np.zeros((d, d))
    line = place - at.position
    c = _regressors(at, place[None])[0]
    gradient = 10 / np.log(10) * line / np.maximum((line**2).sum(1), CLOSE**2)[:, None]
    for i, kind in enumerate(np.unique(at.kind)):
        mine = at.kind == kind
        columns = [np.ones(mine.sum())] + ([c[mine]] if exponent is None else [])
        X = np.stack(columns, 1) / at.std[mine, None]
        J = slope[i] * gradient[mine] / at.std[mine, None]
        J = J - X @ least_squares(X, J)
        total += J.T @ J
    return total


def localise(
    position: np.ndarray,
    level: np.ndarray,
    *,
    kind: np.ndarray | None = None,
    std: np.ndarray | float = 3.0,
    criterion: str = "snls",
    exponent: float | None = None,
    area: np.ndarray | None = None,
    cells: int = CELLS,
    refine: str = "marquardt",
    probability: float = 0.9,
) -> Location:
    """Place of a source from the levels of one instant, its power and exponent unknown (RSS paper, sections 4 and 5).

    Node places (M, d) in m, levels (M,) in dB with known gains removed (NaN: not heard), `kind` (M,) of sensor, their
    `std` in dB. The criterion (`CRITERIA`) is evaluated on a grid of `cells` an axis over the `area` ((low, high) an
    axis; the nodes and a half of their extent around) and refined from its best point: `refine` is "quadratic" (15-17:
    the place and the covariance of a quadratic fitted to the grid around it), "gauss-newton", "marquardt" or "none".
    The covariance is otherwise the inverse Fisher information there, with the noise estimated by (10) under `gml`.
    "posterior" integrates power, exponent and place (all flat, the exponent positive, the place in the area) instead:
    its mean, covariance and quantiles, which hold where a quadratic does not: at strong noise, and next to a node.
    `interval` holds each coordinate with the `probability`. Raises `InputError` for levels that cannot tell a place.

    >>> nodes = np.array([(0, 0), (50, 0), (50, 40), (0, 40), (25, 55.0), (20, -20)])
    >>> heard = 80 - 25 * np.log10(np.linalg.norm(nodes - [18.0, 22.0], axis=1))
    >>> np.round(localise(nodes, heard).position, 3).tolist()
    [18.0, 22.0]
    """
    at = _checked(position, level, kind, std)
    ways = ("quadratic", "gauss-newton", "marquardt", "none", "posterior")
    if refine not in ways:
        raise InputError(f'localise: refine is "{refine}"{nearest(refine, ways)}')
    if refine == "posterior" and criterion in ("predicted", "residual", "virtual"):
        raise InputError(f'localise: criterion "{criterion}" is no likelihood and has no posterior; take "snls"')
    if not 0 < probability < 1:
        raise InputError(f"localise: probability is {probability:g}; give one between 0 and 1")
    d = at.position.shape[1]
    low, high = at.position.min(0), at.position.max(0)
    margin = 0.5 * float(np.linalg.norm(high - low))
    box = np.stack([low - margin, high + margin], 1) if area is None else np.asarray(area, float)
    if box.shape != (d, 2) or not (box[:, 0] < box[:, 1]).all():
        raise InputError(f"localise: area is {box.tolist()}; give (low, high) in m for each of {d} axes")
    axes = [np.linspace(a, b, cells) for a, b in box]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, d)
    value = losses(at, grid, criterion, exponent=exponent)
    k = int(value.argmin())
    x, cost = grid[k], float(value[k])
    step = np.array([axis[1] - axis[0] for axis in axes])
    known = exponent if criterion == "nls" else None
    covariance = interval = None
    if refine == "quadratic":
        x, covariance = _quadratic(at, x, step, criterion, known)
    elif refine != "none":
        x = _climbed(at, x, criterion, known, damped=refine != "gauss-newton", reach=4 * step)
    cost = float(losses(at, x[None], criterion, exponent=exponent)[0])
    fits = _fits(at, x[None], criterion, known)
    power, slope = (np.array([getattr(f, name)[0] for _, f in fits]) for name in ("power", "slope"))
    widened = at if criterion != "gml" else _learnt(at, fits, d)
    J = position_information(widened, x, slope, exponent=known)
    values, vectors = spectrum(J)
    message = ""
    if (x <= box[:, 0] + 0.5 * step).any() or (x >= box[:, 1] - 0.5 * step).any():
        message = "the best point lies on the edge of the area: the levels tell a direction, or nothing"
    elif (slope > -EDGE).all():
        message = "the levels do not fall with the distance from any place: they tell no place"
    elif values[0] <= 1e-12 * max(values[-1], 1e-300):
        message = "the levels tell no place: the information is singular"
    elif values[0] * float(((box[:, 1] - box[:, 0]) ** 2).sum()) < WITHIN:
        message = "the levels tell the place no better than the area does"
    elif (reflected := _mirrored(at, x, criterion, exponent, cost)) is not None:
        message = f"the nodes lie on a line or plane: {np.round(reflected, 1).tolist()} on its other side fits as well"
    if refine == "posterior":
        x, covariance, interval = _integrated(at, box, grid, criterion, known, probability)
    if covariance is None:
        covariance = (vectors / np.maximum(values, 1e-300)) @ vectors.T
    if interval is None:
        half = stats.norm.isf(0.5 - 0.5 * probability) * np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
        interval = np.stack([x - half, x + half], 1)
    return Location(x, covariance, interval, power, -slope, cost, not message, message)


def _log_posterior(at: Snapshot, places: np.ndarray, criterion: str, exponent: float | None) -> np.ndarray:
    """Log density (L,) of places under flat priors, power, exponent (positive) and, under `gml`, the noise integrated.

    Of a robust criterion the profile takes the place of the integral.
    """
    total = np.zeros(len(places))
    for mine, fit in _fits(at, places, criterion, exponent):
        squares = ((fit.left / at.std[mine]) ** 2).sum(1)
        if exponent is not None and criterion == "nls":
            total = total - 0.5 * squares
            continue
        wide = np.sqrt(fit.about)
        squares = np.maximum(squares - fit.about * np.maximum(fit.rising, 0.0) ** 2, 1e-12)
        total = total - np.log(wide)
        if criterion == "gml":
            free = len(mine) - 2
            falls = stats.t.logcdf(-fit.rising * wide * np.sqrt(free / squares), free)
            total = total - 0.5 * free * np.log(squares) + falls
        else:
            total = total - 0.5 * squares + log_ndtr(-fit.rising * wide)
    if criterion in ("huber", "student"):
        flat = sum(0.5 * np.log(fit.about) for _, fit in _fits(at, places, criterion, exponent))
        return -losses(at, places, criterion) - flat
    return total


def _integrated(
    at: Snapshot, box: np.ndarray, grid: np.ndarray, criterion: str, exponent: float | None, probability: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean, covariance and quantiles of a place, on grids that narrow to where the posterior is."""
    d = len(box)
    low, high = box[:, 0], box[:, 1]
    told = _log_posterior(at, grid, criterion, exponent)
    step = (high - low) / (round(len(grid) ** (1 / d)) - 1)
    for _ in range(ROUNDS):
        kept = grid[told > told.max() - FAR]
        low, high, before = np.maximum(kept.min(0) - step, low), np.minimum(kept.max(0) + step, high), high - low
        axes = [np.linspace(a, b, FINE[d]) for a, b in zip(low, high, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, d)
        told = _log_posterior(at, grid, criterion, exponent)
        step = (high - low) / (FINE[d] - 1)
        if (high - low > 0.8 * before).all():
            break
    p = np.exp(told - logsumexp(told))
    mean = p @ grid
    covariance = (grid - mean).T @ ((grid - mean) * p[:, None]) + np.diag(step**2 / 12)
    tails = 0.5 - 0.5 * probability, 0.5 + 0.5 * probability
    shape = p.reshape([FINE[d]] * d)
    interval = np.empty((d, 2))
    for k, axis in enumerate(axes):
        along = np.cumsum(shape.sum(axis=tuple(j for j in range(d) if j != k)))
        edges = np.concatenate([[axis[0] - step[k] / 2], axis + step[k] / 2])
        interval[k] = np.interp(tails, np.concatenate([[0.0], along]), edges)
    return mean, covariance, interval


def _mirrored(at: Snapshot, x: np.ndarray, criterion: str, exponent: float | None, cost: float) -> np.ndarray | None:
    """The place on the other side of the line (plane) of the nodes, where that fits as well."""
    centre = at.position.mean(0)
    normal = singular(at.position - centre, whole=True)[2][-1]
    away = float((x - centre) @ normal)
    other = x - 2 * away * normal
    same = float(losses(at, other[None], criterion, exponent=exponent)[0]) - cost < 0.5
    return other if same and abs(away) > np.abs((at.position - centre) @ normal).max() else None


def _learnt(at: Snapshot, fits: list[tuple[np.ndarray, _Fit]], d: int) -> Snapshot:
    """The snapshot with the noise of each kind as (10) finds it, widened by what the place takes and for its own error.

    The place takes d degrees of freedom, shared by the kinds; a variance of nu degrees leaves a Student-t, of variance
    nu / (nu - 2).
    """
    std = at.std.copy()
    total = max(sum(len(mine) - 2 for mine, _ in fits) - d, 1)
    for mine, fit in fits:
        free = max(len(mine) - 2 - d / len(fits), 1.0)
        ratio = float(((fit.left[0] / at.std[mine]) ** 2).sum()) / free
        std[mine] *= max(np.sqrt(ratio * (total / (total - 2) if total > 2 else 3.0)), 1e-9)
    return at._replace(std=std)


def _quadratic(
    at: Snapshot, x: np.ndarray, step: np.ndarray, criterion: str, exponent: float | None
) -> tuple[np.ndarray, np.ndarray]:
    """Minimum and covariance of the quadratic that fits a small grid around a point (15-17, duplicates added).

    The small grid is narrowed until the criterion changes by no more than `RISE` nats over it.
    """
    d = len(x)
    u = np.stack(np.meshgrid(*[np.arange(-LOCAL, LOCAL + 1.0)] * d, indexing="ij"), -1).reshape(-1, d)
    for _ in range(NARROWED):
        value = losses(at, x + u * step, criterion, exponent=exponent)
        if value.max() - value.min() < RISE:
            break
        x, step = x + u[value.argmin()] * step, step / 2
    value = losses(at, x + u * step, criterion, exponent=exponent)
    pairs = [(i, j) for i in range(d) for j in range(i, d)]
    X = np.column_stack([np.ones(len(u)), u, *(u[:, i] * u[:, j] * (0.5 if i == j else 1.0) for i, j in pairs)])
    eta = least_squares(X, value)
    P = np.zeros((d, d))
    for (i, j), v in zip(pairs, eta[1 + d :], strict=True):
        P[i, j] = P[j, i] = v
    values, vectors = spectrum(P)
    if values[0] <= 0:  # no minimum here
        return x, np.diag(step**2)
    inverse = (vectors / values) @ vectors.T
    move = np.clip(-inverse @ eta[1 : 1 + d], -LOCAL, LOCAL)
    return x + move * step, inverse * np.outer(step, step)


def _climbed(
    at: Snapshot, x: np.ndarray, criterion: str, exponent: float | None, *, damped: bool, reach: np.ndarray
) -> np.ndarray:
    """Place of least cost next to a point of the grid: Gauss-Newton, or Levenberg and Marquardt (RSS paper, Table 4).

    The Jacobian is that of the separable problem; steps are no longer than `reach` (d,).
    """
    damping = 1e-3 if damped else 0.0
    cost = float(losses(at, x[None], criterion, exponent=exponent)[0])
    for _ in range(STEPS):
        fits = _fits(at, x[None], criterion, exponent)
        slope = np.array([f.slope[0] for _, f in fits])
        J = position_information(at, x, slope, exponent=exponent)
        score = _descent(at, x, criterion, exponent)
        move = least_squares(J + damping * np.diag(np.diagonal(J)) + 1e-15 * np.eye(len(x)), score)
        move = move / max(1.0, float(np.max(np.abs(move) / reach)))
        t = 1.0
        while t > 1e-4:
            trial = float(losses(at, (x + t * move)[None], criterion, exponent=exponent)[0])
            if trial <= cost:
                break
            t *= 0.5
        else:
            if not damped or damping > 1e8:
                return x
            damping *= 10
            continue
        gain, x, cost, damping = cost - trial, x + t * move, trial, damping / 5
        if gain < 1e-12 * (1 + abs(cost)):
            return x
    return x


def _descent(at: Snapshot, x: np.ndarray, criterion: str, exponent: float | None) -> np.ndarray:
    """Minus the gradient (d,) of a criterion, by central differences of a millimetre."""
    h, d = 1e-3, len(x)
    places = np.concatenate([x + h * np.eye(d), x - h * np.eye(d)])
    value = losses(at, places, criterion, exponent=exponent)
    return -(value[:d] - value[d:]) / (2 * h)
