"""The straight path at constant speed that fits one sensor's directions best, up to scale."""

from typing import Any, NamedTuple

import numpy as np

from probcal.gaussian.search import climb_on_host
from probcal.linalg import outer, pseudo_inverse, singular

GAMMA = 0.1  # 1/s, prior sd of the radial speed over the range
STEEP = 1e-6  # cosine of the elevation below which the azimuth has no meaning


class StraightTrack(NamedTuple):
    """First place and velocity (2 d,) with their covariance (2 d, 2 d), in units of the first range."""

    time: np.ndarray
    state: np.ndarray
    covariance: np.ndarray
    cost: float

    @property
    def place(self) -> np.ndarray:
        """Places (T, d) relative to the sensor."""
        return (_along(self.time - self.time[0], len(self.state)) @ self.state[:, None])[..., 0]

    @property
    def spread(self) -> np.ndarray:
        """Covariances (T, d, d) of the places."""
        slope = _along(self.time - self.time[0], len(self.state))
        return slope @ self.covariance @ slope.mT


def wrapped(angle: Any) -> Any:
    """Angles in rad from -pi to pi."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def straight_track(time: np.ndarray, angles: np.ndarray, std: np.ndarray, gamma: float = GAMMA) -> StraightTrack:
    """The path whose directions are (T, 1) or (T, 2) angles in rad, with their stds; the best of two starts.

    One start is the path that the lines of sight miss least, which is linear; the other has the rates of the first two.
    """
    span = max(float(np.ptp(time)), 1e-300)
    # unit vectors (T, d) of azimuths (T, 1), or of azimuths and elevations (T, 2)
    b, e = angles[:, 0], angles[:, 1] if angles.shape[1] == 2 else np.zeros(len(angles))
    whole = np.stack([np.cos(e) * np.cos(b), np.cos(e) * np.sin(b), np.sin(e)], 1)
    t, u = (time - time[1]) / span, whole[:, : angles.shape[1] + 1]
    d = u.shape[1]
    across = np.eye(d) - outer(u)
    linear = singular((across @ _along(t, 2 * d)).reshape(-1, 2 * d))[2][-1]
    if np.sum(u * (_along(t, 2 * d) @ linear)) < 0:
        linear = -linear
    rates = np.append(u[1], (u[0] - u[1]) / t[0])
    found = [_Fit(t, angles, std, gamma * span, _basis(x)).best() for x in (linear, rates)]
    x, information, cost = min(found, key=lambda one: one[2])
    first = np.kron(np.array([[1.0, t[0]], [0.0, 1.0 / span]]), np.eye(d))  # place at the first time, and velocity
    state, basis = first @ x, _basis(x)[1:]
    size = np.linalg.norm(state[:d])
    scaled = np.eye(2 * d) - np.outer(state, np.append(state[:d], np.zeros(d))) / size**2
    slope = scaled @ first @ basis.T / size
    covariance = slope @ pseudo_inverse(basis @ information @ basis.T, symmetric=True) @ slope.T
    return StraightTrack(time, state / size, covariance, cost)


def _along(t: np.ndarray, n: int) -> np.ndarray:
    """Slopes (T, d, 2 d) of the places at times by first place and velocity."""
    return np.kron(np.stack([np.ones_like(t), t], 1)[:, None], np.eye(n // 2))


def _basis(x: np.ndarray) -> np.ndarray:
    """Orthogonal unit vectors (2 d, 2 d), the first along a path."""
    axes = singular(x[None], whole=True)[2]
    return axes * np.where(np.arange(len(x)) == 0, np.sign(axes[0] @ x), 1.0)[:, None]


class _At(NamedTuple):
    """Negative log density at a path, its slope (2 d,) and information (2 d, 2 d)."""

    point: "_Path"
    value: float
    pull: np.ndarray
    information: np.ndarray


class _Path(NamedTuple):
    z: np.ndarray  # (2 d - 1,) across the start


class _Fit(NamedTuple):
    """The search next to a path, the first row of `basis`, of which directions do not tell the size."""

    t: np.ndarray
    angles: np.ndarray
    std: np.ndarray
    gamma: float
    basis: np.ndarray

    def best(self) -> tuple[np.ndarray, np.ndarray, float]:
        """The path (2 d,) of least cost, its information and the cost."""
        found, _, _ = climb_on_host(self, _Path(np.zeros(len(self.basis) - 1)), len(self.basis) - 1, 60, 1e-8)
        return self.path(found.at.point), found.at.information, float(found.value)

    def path(self, point: _Path) -> np.ndarray:
        return self.basis[0] + point.z @ self.basis[1:]

    def expand(self, point: _Path) -> _At:
        x = self.path(point)
        slope = _along(self.t, len(x))
        p, d = (slope @ x), len(x) // 2
        flat = np.maximum(np.hypot(p[:, 0], p[:, 1]), STEEP * np.linalg.norm(p, axis=1))
        predicted, H = [np.arctan2(p[:, 1], p[:, 0])], np.zeros((len(p), d - 1, d))
        H[:, 0, :2] = np.stack([-p[:, 1], p[:, 0]], 1) / flat[:, None] ** 2
        if d == 3:
            predicted.append(np.arctan2(p[:, 2], flat))
            H[:, 1] = np.concatenate([-p[:, :2] * (p[:, 2] / flat)[:, None], flat[:, None]], 1)
            H[:, 1] /= np.sum(p**2, 1)[:, None]
        left = wrapped(self.angles - np.stack(predicted, 1)) / self.std
        J = (H @ slope / self.std[:, :, None]).reshape(-1, len(x))
        size = x[:d] @ x[:d]
        radial = x[:d] @ x[d:] / size
        by = np.concatenate([x[d:] - 2.0 * radial * x[:d], x[:d]]) / size / self.gamma
        radial /= self.gamma
        value = 0.5 * float(np.sum(left**2) + radial**2)
        return _At(point, value, J.T @ left.ravel() - by * radial, J.T @ J + np.outer(by, by))

    def moved(self, at: _At, dz: np.ndarray) -> _Path:
        return _Path(at.point.z + dz)

    def value(self, at: _At) -> float:
        return at.value

    def slope(self, at: _At) -> np.ndarray:
        return self.basis[1:] @ at.pull

    def solve(self, at: _At, right: np.ndarray, damping: Any) -> np.ndarray:
        own = self.basis[1:]
        return pseudo_inverse(own @ at.information @ own.T + damping * np.eye(len(own)), symmetric=True) @ right
