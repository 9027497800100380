"""Modified polar and spherical coordinates: a target seen by one sensor at rest, in direction only, up to scale.

The state is (w, rho, b, s) in the plane, (w, q, rho, b, e, s) in space: b azimuth, e elevation, q = e', w = b' cos e,
rho = r'/r, s = 1/r (Aidala, Hammel 1983; Stallard 1987). A straight path at constant speed moves it exactly: the unit
vector plus T v / r, renormalised. The first of these never see s, so that the range is scale only.
"""

from typing import NamedTuple

import numpy as np

from probcal.errors import InputError
from probcal.modes.straight import STEEP, straight_track, wrapped

PLANE = [0, 2, 3, 5]  # of the six in space, with q = e = 0


class SensorTrack(NamedTuple):
    """A target in the axes of one sensor, in units of the first range where that was not given.

    `state` (T, 4 or 6) and `covariance` (T, 4, 4 or 6, 6) in modified coordinates; `place` (T, d) relative to the
    sensor with `spread` (T, d, d), given the first range; `cost` is half the weighted sum of squares of the bearings.
    """

    time: np.ndarray
    state: np.ndarray
    covariance: np.ndarray
    place: np.ndarray
    spread: np.ndarray
    cost: float

    @property
    def velocity(self) -> np.ndarray:
        """Velocity (T, d) at each time, in units of the range per s."""
        found = [
            velocity_of(x)[1] / x[5] for x in all_six(self.state, PLANE if self.state.shape[1] == 4 else list(range(6)))
        ]
        return np.array(found)[:, : self.place.shape[1]]


class Axes(NamedTuple):
    """Line of sight u and its tangents along azimuth and elevation, each (..., 3), and the cosine of the elevation."""

    u: np.ndarray
    b: np.ndarray
    e: np.ndarray
    level: np.ndarray


def axes_of(azimuth: np.ndarray, elevation: np.ndarray) -> Axes:
    """The axes at angles (...) in rad."""
    cb, sb, ce, se = np.cos(azimuth), np.sin(azimuth), np.cos(elevation), np.sin(elevation)
    zero = np.zeros_like(cb)
    ce = np.where(np.abs(ce) < STEEP, STEEP, ce)
    return Axes(
        np.stack([ce * cb, ce * sb, se], -1),
        np.stack([-sb, cb, zero], -1),
        np.stack([-se * cb, -se * sb, ce], -1),
        ce,
    )


def all_six(state: np.ndarray, kept: list[int]) -> np.ndarray:
    """All six coordinates (..., 6) of a state (..., n)."""
    found = np.zeros((*state.shape[:-1], 6))
    found[..., kept] = state
    return found


def velocity_of(x: np.ndarray) -> tuple[Axes, np.ndarray, np.ndarray, np.ndarray]:
    """Axes, velocity over range (3,), and the derivatives (3, 6) of line of sight and velocity by the state (6,)."""
    w, q, rho, b, e, _ = x
    axes = axes_of(b, e)
    velocity = rho * axes.u + w * axes.b + q * axes.e
    inward = np.array([-axes.b[1], axes.b[0], 0.0])  # derivative of the tangent along azimuth, by azimuth
    se = np.sin(e)
    sight, moved = np.zeros((3, 6)), np.zeros((3, 6))
    sight[:, 3], sight[:, 4] = axes.level * axes.b, axes.e
    moved[:, 0], moved[:, 1], moved[:, 2] = axes.b, axes.e, axes.u
    moved[:, 3] = rho * axes.level * axes.b + w * inward - q * se * axes.b
    moved[:, 4] = rho * axes.e - q * axes.u
    return axes, velocity, sight, moved


def back(
    p: np.ndarray, velocity: np.ndarray, inverse: float, dp: np.ndarray, dv: np.ndarray, ds: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """State (6,) of a place p (3,) in units of 1 / `inverse`, and its derivatives, from those of p, velocity and s."""
    size = np.sqrt(p @ p)
    u = p / size
    e = np.arcsin(np.clip(u[2], -1.0, 1.0))
    b = np.arctan2(u[1], u[0])
    axes = axes_of(b, e)
    turned = velocity / size
    along = u @ dp / size  # relative change of the size
    du = (dp - np.outer(u, u @ dp)) / size
    db, de = axes.b @ du / axes.level, axes.e @ du
    dw = dv / size - np.outer(turned, along)
    inward = np.array([-axes.b[1], axes.b[0], 0.0])
    state = np.array([turned @ axes.b, turned @ axes.e, turned @ axes.u, b, e, inverse / size])
    slope = np.stack([
        axes.b @ dw + (turned @ inward) * db,
        axes.e @ dw - np.sin(e) * (turned @ axes.b) * db - (turned @ u) * de,
        axes.u @ dw + turned @ du,
        db,
        de,
        ds / size - inverse / size * along,
    ])  # fmt: skip
    return state, slope


def step(state: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Modified spherical state (6,) after `dt` s of a straight path, and its Jacobian (6, 6); exact."""
    axes, velocity, sight, moved = velocity_of(state)
    unit = np.zeros(6)
    unit[5] = 1.0
    found, slope = back(axes.u + dt * velocity, velocity, state[5], sight + dt * moved, moved, unit)
    found[3] = state[3] + wrapped(found[3] - state[3])
    return found, slope


def places_of_states(state: np.ndarray, kept: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Places (T, d) and their Jacobians (T, d, n) by the state, in the unit of the range."""
    whole = all_six(state, kept)
    axes = axes_of(whole[:, 3], whole[:, 4])
    distance = 1.0 / whole[:, 5]
    place = distance[:, None] * axes.u
    slope = np.zeros((len(state), 3, 6))
    slope[:, :, 3] = (distance * axes.level)[:, None] * axes.b
    slope[:, :, 4] = distance[:, None] * axes.e
    slope[:, :, 5] = -(distance**2)[:, None] * axes.u
    d = 2 if len(kept) == 4 else 3
    return place[:, :d], slope[:, :d][:, :, kept]


class Bearings(NamedTuple):
    """Bearings of one target by one sensor, and the assumptions about range and radial speed at the start."""

    time: np.ndarray
    angles: np.ndarray
    there: np.ndarray
    sigma: np.ndarray
    kept: list[int]
    gamma: float
    distance: float

    @property
    def seen(self) -> list[int]:
        """Entries of the state that are measured."""
        return [2] if len(self.kept) == 4 else [3, 4]

    def cost(self, state: np.ndarray) -> float:
        """Half the weighted sum of squares of the bearings."""
        left = wrapped(self.angles[:, : len(self.seen)] - state[:, self.seen])
        return float(0.5 * np.sum((left / self.sigma[:, : len(self.seen)])[self.there] ** 2))

    def start(self) -> tuple[int, np.ndarray, np.ndarray]:
        """Sample of the second bearing, and the state and covariance there (4)."""
        a, k = np.flatnonzero(self.there)[:2]
        dt = self.time[k] - self.time[a]
        turned = wrapped(self.angles[k] - self.angles[a]) / dt
        x = np.array([turned[0], turned[1], 0.0, self.angles[k, 0], self.angles[k, 1], 1.0 / self.distance])
        P = np.zeros((6, 6))
        level = max(np.cos(self.angles[k, 1]), STEEP)
        x[0] *= level
        for rate, angle, axis, by in ((0, 3, 0, level), (1, 4, 1, 1.0)):
            one, two = self.sigma[a, axis] ** 2, self.sigma[k, axis] ** 2
            P[rate, rate] = by**2 * (one + two) / dt**2
            P[rate, angle] = P[angle, rate] = by * two / dt
            P[angle, angle] = two
        P[2, 2] = self.gamma**2
        return int(k), x[self.kept], P[np.ix_(self.kept, self.kept)]

    def straight(self) -> tuple[np.ndarray, np.ndarray]:
        """States (T, n) and covariances of the straight path of all bearings."""
        seen = range(len(self.seen))
        found = straight_track(
            self.time[self.there], self.angles[self.there][:, seen], self.sigma[self.there][:, seen], self.gamma
        )
        d = len(seen) + 1
        there = np.concatenate([np.arange(d), 3 + np.arange(d)])
        first, by = np.zeros(6), np.eye(6)[:, there]
        first[there] = found.state
        states, slopes = np.zeros((len(self.time), 6)), np.zeros((len(self.time), 6, 2 * d))
        for k, t in enumerate(self.time - self.time[0]):
            place, moved = first[:3] + t * first[3:], by[:3] + t * by[3:]
            states[k], slopes[k] = back(place, first[3:], 1.0 / self.distance, moved, by[3:], np.zeros(2 * d))
        states[:, 3] = np.unwrap(states[:, 3])
        spread = slopes @ found.covariance @ slopes.mT
        return states[:, self.kept], spread[:, self.kept][:, :, self.kept]


def bearings_of(
    time: np.ndarray, angles: np.ndarray, std: np.ndarray | float, gamma: float, distance: float | None
) -> Bearings:
    """The arguments of `bearing_track`, checked; raises `InputError` for times that do not increase, or one bearing."""
    time, angles = np.asarray(time, float), np.asarray(angles, float)
    if time.ndim != 1 or angles.shape[:1] != time.shape or not (np.diff(time) > 0).all():
        raise InputError("bearing_track: times (T,) must increase, angles are (T,) or (T, 2)")
    if angles.ndim == 2 and angles.shape[1] != 2:
        raise InputError(
            f"bearing_track: angles are (T,) azimuths or (T, 2) azimuths and elevations, got {angles.shape}"
        )
    flat = angles.ndim == 1
    wide = np.stack([angles, np.zeros_like(angles)], 1) if flat else angles
    there = np.isfinite(wide).all(1)
    if there.sum() < 2:
        raise InputError(f"bearing_track: {int(there.sum())} bearing(s) give no track; give two or more")
    first = int(np.flatnonzero(there)[0])
    given = np.asarray(std, float)
    sigma = np.broadcast_to(given[:, None] if given.ndim == 1 else given, (len(angles), 2))[first:]
    kept = PLANE if flat else list(range(6))
    return Bearings(
        time[first:], wide[first:], there[first:], sigma, kept, gamma, 1.0 if distance is None else distance
    )


def track_of(bearings: Bearings, state: np.ndarray, covariance: np.ndarray) -> SensorTrack:
    """The track of states (T, n) in modified coordinates and their covariances (T, n, n)."""
    place, jacobian = places_of_states(state, bearings.kept)
    spread = jacobian @ covariance @ jacobian.mT
    return SensorTrack(bearings.time, state, covariance, place, spread, bearings.cost(state))
