"""Filter and smoother of one sensor's bearings in modified polar or spherical coordinates, up to scale."""

from typing import NamedTuple

import numpy as np

from probcal.doa.modified import Bearings, SensorTrack, all_six, back, bearings_of, step, track_of, velocity_of
from probcal.linalg import pseudo_inverse, solve_square
from probcal.modes.straight import GAMMA, wrapped


def bearing_track(
    time: np.ndarray,
    angles: np.ndarray,
    std: np.ndarray | float,
    *,
    gamma: float = GAMMA,
    distance: float | None = None,
    noise: float = 0.0,
    remove_bias: bool = True,
    smooth: bool = True,
    iterations: int = 10,
) -> SensorTrack:
    """Extended Kalman filter and smoother in modified polar or spherical coordinates (DOA paper, section 2 and 4).

    Times (T,) in s, increasing; angles (T,) azimuths, or (T, 2) azimuths and elevations, in rad in the sensor's own
    axes, NaN where missing; their standard deviation. The first two times with a bearing start the filter (4): rates
    from their difference, rho 0 with standard deviation `gamma` in 1/s, range `distance` in m (1: the unit of what
    follows). `noise` is that of the acceleration, in m s^-3/2 (of `distance`; in units of the range where there is
    none).

    With `smooth` the answer is that of an iterated smoother (Gauss-Newton), which starts at the straight path of all
    bearings; without process noise that path is the answer. Without `smooth` it is the printed filter, `remove_bias`
    adding the second-order term to its predicted 1/r. Raises `InputError` for times that do not increase and fewer than
    two bearings.

    >>> t = np.arange(20.0)
    >>> found = bearing_track(t, np.arctan2(10.0, t - 5.0), 1e-4)  # a target at 1 m/s, 10 m to the north
    >>> bool(np.allclose(found.place[:, 0] / found.place[:, 1], (t - 5.0) / 10.0, atol=1e-3))
    True
    """
    run = _Filter(bearings_of(time, angles, std, gamma, distance), noise, remove_bias)
    if not smooth:
        return track_of(run.bearings, *run.forward(None))
    state, covariance = run.bearings.straight()
    for _ in range(iterations if noise else 0):
        reference = state
        state, covariance = run.backward(*run.forward(reference), reference)
        if np.abs(state - reference).max() < 1e-9:
            break
    return track_of(run.bearings, state, covariance)


class _Filter(NamedTuple):
    """The filter of some bearings: process noise, and whether the second-order bias of 1/r is removed."""

    bearings: Bearings
    noise: float
    remove_bias: bool

    def _step(self, x: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Predicted state, its Jacobian, and the process noise there."""
        data = self.bearings
        whole, slope = step(all_six(x, data.kept), dt)
        Q = _driven(whole, dt, self.noise)
        own = np.ix_(data.kept, data.kept)
        return whole[data.kept], slope[own], Q[own]

    def forward(self, reference: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """Filtered states (T, n) and covariances; linearised at `reference` (T, n) where there is one.

        Samples before the start are those of its own path.
        """
        data = self.bearings
        k0, x, P = data.start()
        n, T = len(x), len(data.time)
        states, covariances = np.full((T, n), np.nan), np.zeros((T, n, n))
        states[k0], covariances[k0] = x, P
        H = np.eye(n)[data.seen]
        for k in range(k0 + 1, T):
            dt = data.time[k] - data.time[k - 1]
            at = states[k - 1] if reference is None else reference[k - 1]
            moved, F, Q = self._step(at, dt)
            x = moved + F @ (states[k - 1] - at)
            P = F @ covariances[k - 1] @ F.T + Q
            if reference is None and self.remove_bias:
                whole = np.zeros((6, 6))
                whole[np.ix_(data.kept, data.kept)] = covariances[k - 1]
                x[-1] += _curved(all_six(at, data.kept), whole, dt)
            if data.there[k]:
                R = np.diag(data.sigma[k, : len(data.seen)] ** 2)
                K = solve_square(H @ P @ H.T + R, H @ P).T
                x = x + K @ wrapped(data.angles[k, : len(data.seen)] - x[data.seen])
                P = (np.eye(n) - K @ H) @ P @ (np.eye(n) - K @ H).T + K @ R @ K.T
            states[k], covariances[k] = x, P
        for k in range(k0 - 1, -1, -1):
            states[k], F, _ = self._step(states[k + 1], data.time[k] - data.time[k + 1])
            covariances[k] = F @ covariances[k + 1] @ F.T
        return states, covariances

    def backward(
        self, filtered: np.ndarray, covariances: np.ndarray, reference: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Smoothed states (T, n) and covariances, from filtered ones (Rauch, Tung, Striebel)."""
        data = self.bearings
        k0, _, _ = data.start()
        states, spreads = filtered.copy(), covariances.copy()
        for k in range(len(data.time) - 2, -1, -1):
            dt = data.time[k + 1] - data.time[k]
            if k < k0:
                states[k], F, _ = self._step(states[k + 1], -dt)
                spreads[k] = F @ spreads[k + 1] @ F.T
                continue
            at = filtered[k] if reference is None else reference[k]
            moved, F, Q = self._step(at, dt)
            mean, P = moved + F @ (filtered[k] - at), F @ covariances[k] @ F.T + Q
            size = np.sqrt(np.maximum(np.diagonal(P), 1e-300))
            G = (pseudo_inverse(P / np.outer(size, size), symmetric=True) / np.outer(size, size) @ F @ covariances[k]).T
            states[k] = filtered[k] + G @ (states[k + 1] - mean)
            spreads[k] = covariances[k] + G @ (spreads[k + 1] - P) @ G.T
        return states, spreads


def _driven(state: np.ndarray, dt: float, noise: float) -> np.ndarray:
    """Covariance (6, 6) that white acceleration of density `noise` has put into a state after `dt` s."""
    if noise == 0.0:
        return np.zeros((6, 6))
    axes, velocity, _, _ = velocity_of(state)
    by = np.concatenate([np.eye(3), np.zeros((3, 3))], 1), np.concatenate([np.zeros((3, 3)), np.eye(3)], 1)
    _, slope = back(axes.u, velocity, state[5], *by, np.zeros(6))
    drive = np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]) * (noise * state[5]) ** 2
    return slope @ np.kron(drive, np.eye(3)) @ slope.T


def _curved(state: np.ndarray, covariance: np.ndarray, dt: float) -> float:
    """The second-order term of the predicted 1/r: the bias of a first-order filter."""
    c = dt * state[:3] + np.array([0.0, 0.0, 1.0])
    squared = c @ c
    slope = -dt * c * squared**-1.5
    bend = dt**2 * (3 * np.outer(c, c) * squared**-2.5 - np.eye(3) * squared**-1.5)
    return float(0.5 * state[5] * np.trace(bend @ covariance[:3, :3]) + slope @ covariance[:3, 5])
