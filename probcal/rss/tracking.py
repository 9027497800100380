"""An extended Kalman filter on the virtual measurements: a source tracked with power and exponent eliminated."""

from typing import NamedTuple

import numpy as np

from probcal.errors import InputError
from probcal.linalg import invert, least_squares, solve_square
from probcal.rss.localise import CLOSE, Snapshot, localise, losses

ITERATIONS = 10  # of the update at one epoch


class SnapshotTrack(NamedTuple):
    """Filtered places (T, d) and velocities (T, d) at times (T,), and the covariances (T, 2 d, 2 d) of both."""

    time: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    covariance: np.ndarray


def track_snapshots(
    time: np.ndarray,
    position: np.ndarray,
    level: np.ndarray,
    *,
    kind: np.ndarray | None = None,
    std: float | np.ndarray = 3.0,
    noise: float = 1.0,
    start: tuple[np.ndarray, float] | None = None,
    speed: float = 10.0,
) -> SnapshotTrack:
    """Filter of a source of nearly constant velocity on the virtual measurement (RSS paper 8 and 12).

    Times (T,) in s, node places (M, d) in m, levels (T, M) in dB (NaN: not heard), gains removed; `noise` is that of
    the acceleration in m s^-3/2. What is left of the levels at a place after power and exponent is a measurement of 0
    whose noise has the variance sigma^2 (1 - h) and the rank M - 2 a kind: it is whitened by projection, not by the
    diagonal alone as (8) prints it. The update is iterated. The `start` is (place (d,), std in m) at the first time,
    else `localise` at the time that tells the place best, from which the filter runs on and back; the velocity there is
    0 with std `speed` in m/s. Raises `InputError` where no time tells a place.
    """
    time, position, level = np.asarray(time, float), np.asarray(position, float), np.asarray(level, float)
    T, d = len(time), position.shape[1]
    if level.shape != (T, len(position)) or not (np.diff(time) > 0).all():
        raise InputError("track_snapshots: times (T,) must increase, levels are (T, M) at node places (M, d)")
    kinds = np.zeros(len(position), int) if kind is None else np.asarray(kind, int)
    stds = np.broadcast_to(np.asarray(std, float), len(position))
    first, x0, P0 = _begin(position, level, kinds, stds, start, speed)
    states, covariances = np.full((T, 2 * d), np.nan), np.full((T, 2 * d, 2 * d), np.nan)
    states[first], covariances[first] = x0, P0
    for order in (range(first + 1, T), range(first - 1, -1, -1)):
        x, P = x0, P0
        for k in order:
            dt = time[k] - time[k - order.step]
            F = np.kron(np.array([[1.0, dt], [0.0, 1.0]]), np.eye(d))
            drive = np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]) * np.sign(dt) * noise**2
            x, P = F @ x, F @ P @ F.T + np.kron(drive, np.eye(d))
            there = np.isfinite(level[k])
            x, P = _updated(Snapshot(position[there], level[k, there], kinds[there], stds[there]), x, P, d)
            states[k], covariances[k] = x, P
    return SnapshotTrack(time, states[:, :d], states[:, d:], covariances)


def _begin(
    position: np.ndarray,
    level: np.ndarray,
    kinds: np.ndarray,
    stds: np.ndarray,
    start: tuple[np.ndarray, float] | None,
    speed: float,
) -> tuple[int, np.ndarray, np.ndarray]:
    """Epoch, state and covariance with which the filter begins."""
    d = position.shape[1]
    moving = speed**2 * np.eye(d)
    if start is not None:
        place, spread = start
        where = np.zeros((2 * d, 2 * d))
        where[:d, :d], where[d:, d:] = spread**2 * np.eye(d), moving
        return 0, np.concatenate([np.asarray(place, float), np.zeros(d)]), where
    reason, best = "no epoch has levels", None
    for k, row in enumerate(level):
        try:
            found = localise(position, row, kind=kinds, std=stds)
        except InputError as error:
            reason = str(error)
            continue
        spread = float(np.trace(found.covariance))
        if not found.determined:
            reason = found.message
        elif best is None or spread < best[0]:
            best = spread, k, found
    if best is None:
        raise InputError(f"track_snapshots: no epoch tells a place to start at ({reason}); give start=(place, std)")
    _, k, found = best
    where = np.zeros((2 * d, 2 * d))
    where[:d, :d], where[d:, d:] = found.covariance, moving
    return k, np.concatenate([found.position, np.zeros(d)]), where


def _updated(at: Snapshot, x: np.ndarray, P: np.ndarray, d: int) -> tuple[np.ndarray, np.ndarray]:
    """State and covariance after the levels of one epoch, linearised about the updated place again."""
    prior, mean = invert(P), x

    def worth(trial: np.ndarray) -> float:
        return float(0.5 * (trial - mean) @ prior @ (trial - mean) + losses(at, trial[None, :d])[0])

    cost = worth(x)
    for _ in range(ITERATIONS):
        J, score = _projected(at, x[:d])
        information = prior.copy()
        information[:d, :d] += J
        right = prior @ (mean - x)
        right[:d] += score
        step, t = solve_square(information, right), 1.0
        while (trial := worth(x + t * step)) > cost and t > 1e-3:
            t *= 0.5
        if trial > cost:
            break
        x, cost = x + t * step, trial
    J, _ = _projected(at, x[:d])
    information = prior.copy()
    information[:d, :d] += J
    return x, invert(information)


def _projected(at: Snapshot, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Information (d, d) and score (d,) of a place from what is left of the levels after power and exponent."""
    d = len(place)
    J, score = np.zeros((d, d)), np.zeros(d)
    line = place - at.position
    squared = np.maximum((line**2).sum(1), CLOSE**2)
    c = 5 * np.log10(squared)
    for kind in np.unique(at.kind):
        mine = at.kind == kind
        if mine.sum() < 3:
            continue
        X = np.stack([np.ones(mine.sum()), c[mine]], 1) / at.std[mine, None]
        y = at.level[mine] / at.std[mine]
        theta = least_squares(X, y)
        if theta[1] > 0:  # levels that grow with the distance say nothing here
            continue
        H = theta[1] * 10 / np.log(10) * (line / squared[:, None])[mine] / at.std[mine, None]
        H = H - X @ least_squares(X, H)
        J += H.T @ H
        score += H.T @ (y - X @ theta)
    return J, score
