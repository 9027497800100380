"""A deliberately naive second implementation for linear networks: NumPy, loops, a dense joint Gaussian.

It reads declarations (network, motions, table) and calls the sensor functions on its own views; nothing of
probcal's table, rows, recursion or linear algebra is used. Everything is written for clarity at toy size.
"""

from dataclasses import dataclass
from itertools import pairwise
from types import SimpleNamespace

import jax
import numpy as np
import pandas as pd

from probcal.gaussian.engine import Estimate, Sampled, Spread
from probcal.gaussian.jointly import Variables
from probcal.gaussian.linearised import given_biases, linearise_rows
from probcal.gaussian.mode import eliminate_rows, factors, find_tracks, log_likelihood, mixing_gain
from probcal.motion import ConstantVelocity, Motion, RandomWalk, Static, White

AXES = "xyz"


class Pose(SimpleNamespace):
    """Position, heading, pitch, roll and what the node owns; `local` by explicit rotation matrices."""

    def local(self, point):
        c, s = np.cos(self.heading), np.sin(self.heading)
        if len(self.position) == 2:
            return np.array([[c, -s], [s, c]]).T @ (point - self.position)
        yaw = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        c, s = np.cos(self.pitch), np.sin(self.pitch)
        nose_up = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])  # x ahead rises towards z
        c, s = np.cos(self.roll), np.sin(self.roll)
        roll = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
        return (yaw @ nose_up @ roll).T @ (point - self.position)


def components(motion):
    return motion.components if isinstance(motion, Motion) else (motion,)


def names_of(motion, d):
    """Scalar state components in order."""
    found = []
    for part in components(motion):
        if isinstance(part, ConstantVelocity):
            found += [f"position_{a}" for a in AXES[:d]] + [f"velocity_{a}" for a in AXES[:d]]
        elif isinstance(part, Static):
            found += [f"position_{a}" for a in AXES[:d]]
        else:
            found.append(part.name)
    return found


def step_of(motion, dt, d):
    """Transition, drift and noise covariance over one time step."""
    names = names_of(motion, d)
    F, c, Q = np.zeros((len(names),) * 2), np.zeros(len(names)), np.zeros((len(names),) * 2)
    for part in components(motion):
        if isinstance(part, ConstantVelocity):
            for a in AXES[:d]:
                p, v = names.index(f"position_{a}"), names.index(f"velocity_{a}")
                F[p, p] = F[v, v] = 1.0
                F[p, v] = dt
                if part.singular:
                    g = np.array([dt**2 / 2, dt])
                    block = part.std**2 * np.outer(g, g)
                else:
                    block = part.std**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
                Q[np.ix_([p, v], [p, v])] = block
        elif isinstance(part, Static):
            for a in AXES[:d]:
                F[names.index(f"position_{a}"), names.index(f"position_{a}")] = 1.0
        elif isinstance(part, RandomWalk):
            k = names.index(part.name)
            F[k, k], Q[k, k] = 1.0, part.std**2 * dt
        elif isinstance(part, White):
            k = names.index(part.name)
            c[k], Q[k, k] = part.mean, part.std**2
        else:
            raise TypeError(part)
    return F, c, Q


def start_of(target, d):
    """Mean and covariance at the first epoch; positions and velocities must be declared."""
    names = names_of(target.motion, d)
    given = dict(target.start)
    for part in components(target.motion):
        if isinstance(part, RandomWalk):
            given.setdefault(part.name, part.initial)
        if isinstance(part, White):
            given[part.name] = (part.mean, part.std)
    mean, variance = np.zeros(len(names)), np.zeros(len(names))
    for name, (m, s) in given.items():
        mine = [k for k, n in enumerate(names) if n == name or n in [f"{name}_{a}" for a in AXES]]
        mean[mine], variance[mine] = m, s**2
    assert (variance > 0).all(), "the reference needs every start"
    return mean, np.diag(variance)


@dataclass
class Chain:
    """Epochs of one target: times and, for each, transition, drift and noise covariance."""

    target: str
    names: list
    times: list
    steps: list  # (F, c, Q); the first has F = 0 and the start


@dataclass
class Datum:
    """One measured value: which epoch of which target, and its affine form y = H x + G z + offset + noise."""

    chain: int
    epoch: int
    H: np.ndarray
    G: np.ndarray
    offset: float
    y: float
    std: float


class Linear:
    """A linear problem as lists: biases with labels and scales, chains of epochs, and data."""

    def __init__(self, network, motion, table, fix=()):
        self.d = len(network.sensors[0].nodes[0].position)
        fixed = dict(fix) if isinstance(fix, dict) else dict.fromkeys(fix, 0.0)
        self.scales, self.steps = {}, {}
        for placed in network.sensors:
            for node in placed.nodes:
                for component, (_, bias) in node.spread.items():
                    axes = [f"_{a}" for a in AXES[: self.d]] if component == "position" else [""]
                    for axis in axes:
                        self._declare(f"{node.name}.{component}{axis}", bias)
        for placed in network.sensors:
            for name, bias in placed.type.biases.items():
                self._declare(self.owner(placed, bias) + name, bias)
        self.fixed = fixed
        for label in fixed:
            del self.scales[label]
        self.labels = list(self.scales)
        targets = table["target"].astype(str) if "target" in table else pd.Series("target", table.index)
        self.chains = []
        for name in dict.fromkeys(targets):
            target = motion[name] if isinstance(motion, dict) else motion
            times = sorted(set(table["time"][targets == name]))
            if all(isinstance(part, Static) for part in components(target.motion)):
                times = times[:1]
            mean, covariance = start_of(target, self.d)
            steps = [(np.zeros_like(covariance), mean, covariance)]
            for before, after in pairwise(times):
                steps.append(step_of(target.motion, after - before, self.d))
            self.chains.append(Chain(name, names_of(target.motion, self.d), times, steps))
        by_name = {placed.name: placed for placed in network.sensors}
        self.data = []
        for i in range(len(table)):
            row = table.iloc[i]
            k = [chain.target for chain in self.chains].index(targets.iloc[i])
            chain = self.chains[k]
            epoch = chain.times.index(row["time"]) if len(chain.times) > 1 else 0
            self._add(by_name[row["sensor"]], row, k, epoch)

    def _declare(self, label, bias):
        """A bias, and where it drifts its steps with their times."""
        self.scales[label] = bias.scale
        if bias.drift is None:
            return
        self.steps[label] = []
        for before, time in pairwise(bias.drift.times):
            step = f"{label}@{float(time):g}"
            self.steps[label].append((time, step))
            walk = bias.drift.scale is None
            self.scales[step] = bias.drift.std * (time - before) ** 0.5 if walk else bias.drift.scale

    @staticmethod
    def owner(placed, bias):
        return f"{placed.type.name if bias.shared else placed.name}."

    def _evaluate(self, placed, row, chain, x, z):
        """Predicted channels by scalar name at one state and one z."""
        value = dict(zip(self.labels, z * np.array(list(self.scales.values())), strict=True)) | self.fixed
        for label, steps in self.steps.items():
            value[label] += sum(value[step] for time, step in steps if time <= row["time"])
        state = dict(zip(chain.names, x, strict=True))
        parts = {n: v for n, v in state.items() if n[:-2] not in ("position", "velocity")}
        for vector in ("position", "velocity"):
            if f"{vector}_x" in state:
                parts[vector] = np.array([state[f"{vector}_{a}"] for a in AXES[: self.d]])
        poses = []
        for node in placed.nodes:
            stated = dict(node.components)
            position = np.array(node.position, float)
            if node.path is not None:
                position = np.array([np.interp(row["time"], node.path.time, p) for p in node.path.position.T])
                stated["heading"] += np.interp(row["time"], node.path.time, node.path.heading)
            for axis in range(self.d):
                position[axis] += value.get(f"{node.name}.position_{AXES[axis]}", 0.0)
            own = {n: v + value.get(f"{node.name}.{n}", 0.0) for n, v in stated.items()}
            poses.append(Pose(position=position, **own))
        biases = {n: b.nominal + value[self.owner(placed, b) + n] for n, b in placed.type.biases.items()}
        predicted = {}
        for name, part in placed.type.function(SimpleNamespace(**parts), *poses, **biases).items():
            if placed.type.channels[name].per_axis:
                predicted |= {f"{name}_{AXES[axis]}": float(part[axis]) for axis in range(self.d)}
            else:
                predicted[name] = float(part)
        return predicted

    def _add(self, placed, row, k, epoch):
        chain, M = self.chains[k], len(self.labels)
        n = len(chain.names)
        offset = self._evaluate(placed, row, chain, np.zeros(n), np.zeros(M))
        by_x = [self._evaluate(placed, row, chain, unit, np.zeros(M)) for unit in np.eye(n)]
        by_z = [self._evaluate(placed, row, chain, np.zeros(n), unit) for unit in np.eye(M)]
        far = self._evaluate(placed, row, chain, np.full(n, 7.0), np.full(M, 3.0))
        for name in offset:
            if name not in row or np.isnan(row[name]):
                continue
            H = np.array([v[name] - offset[name] for v in by_x])
            G = np.array([v[name] - offset[name] for v in by_z])
            assert np.isclose(far[name], offset[name] + 7 * H.sum() + 3 * G.sum()), "the sensor is not linear"
            channel = placed.type.channels[name if name in placed.type.channels else name[:-2]]
            std = row.get(f"{name}_std", np.nan)
            std = channel.std if np.isnan(std) else std
            self.data.append(Datum(k, epoch, H, G, offset[name], row[name], std))


@dataclass
class Posterior:
    """Exact moments of z and of all states (chains one after the other, epoch by epoch)."""

    evidence: float
    mean: np.ndarray
    covariance: np.ndarray
    biases: int

    @property
    def z(self):
        return self.mean[: self.biases], self.covariance[: self.biases, : self.biases]

    @property
    def states(self):
        return self.mean[self.biases :], np.sqrt(np.diag(self.covariance)[self.biases :])


def log_normal(residual, S):
    sign, logdet = np.linalg.slogdet(S)
    assert sign > 0
    return -0.5 * (residual @ np.linalg.solve(S, residual) + logdet + len(residual) * np.log(2 * np.pi))


def dense(problem, alpha, hold=None):
    """Condition the joint Gaussian of z and all states on all data; `hold` keeps z at a value instead.

    `alpha` are precisions (M,), or a prior covariance (M, M).

    Covariances only (no inverse of a prior), so that a singular process noise does not matter.
    """
    M, sizes = len(problem.labels), [len(c.names) * len(c.times) for c in problem.chains]
    total = M + sum(sizes)
    mean, C = np.zeros(total), np.zeros((total, total))
    if hold is None:
        C[:M, :M] = np.diag(1.0 / np.asarray(alpha)) if np.ndim(alpha) == 1 else alpha
    else:
        mean[:M] = hold
    where, offset = [], M
    for chain, size in zip(problem.chains, sizes, strict=True):
        n = len(chain.names)
        where.append([slice(offset + n * e, offset + n * (e + 1)) for e in range(len(chain.times))])
        for e, (F, c, Q) in enumerate(chain.steps):
            here = where[-1][e]
            if e == 0:
                mean[here], C[here, here] = c, Q
                continue
            before = where[-1][e - 1]
            mean[here] = F @ mean[before] + c
            past = slice(offset, here.start)
            C[here, past] = F @ C[before, past]
            C[past, here] = C[here, past].T
            C[here, here] = F @ C[before, before] @ F.T + Q
        offset += size
    A, y, noise = np.zeros((len(problem.data), total)), [], []
    for row, datum in zip(A, problem.data, strict=True):
        row[:M] = datum.G
        row[where[datum.chain][datum.epoch]] = datum.H
        y.append(datum.y - datum.offset)
        noise.append(datum.std**2)
    R = np.diag(noise)
    S = A @ C @ A.T + R
    residual = np.array(y) - A @ mean
    K = np.linalg.solve(S, A @ C).T
    keep = np.eye(total) - K @ A
    return Posterior(log_normal(residual, S), mean + K @ residual, keep @ C @ keep.T + K @ R @ K.T, M)


def kalman(problem, alpha):
    """Loop Kalman filter and RTS smoother with the biases as constants of the state; missing rows drop out.

    Targets follow each other: a new target keeps the biases and draws its own start. Returns evidence, and
    the smoothed mean and covariance of (z, x) at every epoch in order.
    """
    M = len(problem.labels)
    m, P = np.zeros(M), np.diag(1.0 / np.asarray(alpha))
    evidence, filtered, predicted, transitions = 0.0, [], [], []
    for k, chain in enumerate(problem.chains):
        n = len(chain.names)
        for e, (F, c, Q) in enumerate(chain.steps):
            T = np.zeros((M + n, len(m)))
            T[:M, :M] = np.eye(M)
            if e > 0:
                T[M:, M:] = F
            m = T @ m + np.concatenate([np.zeros(M), c])
            P = T @ P @ T.T
            P[M:, M:] += Q
            predicted.append((m, P))
            transitions.append(T)
            for datum in problem.data:
                if (datum.chain, datum.epoch) == (k, e):
                    h = np.concatenate([datum.G, datum.H])
                    s = h @ P @ h + datum.std**2
                    r = datum.y - datum.offset - h @ m
                    evidence += log_normal(np.array([r]), np.array([[s]]))
                    gain = P @ h / s
                    m = m + gain * r
                    keep = np.eye(len(m)) - np.outer(gain, h)
                    P = keep @ P @ keep.T + datum.std**2 * np.outer(gain, gain)
            filtered.append((m, P))
    smoothed = [filtered[-1]]
    for k in range(len(filtered) - 2, -1, -1):
        (m, P), (ahead, P_ahead) = filtered[k], predicted[k + 1]
        gain = np.linalg.solve(P_ahead, transitions[k + 1] @ P).T
        later, P_later = smoothed[0]
        smoothed.insert(0, (m + gain @ (later - ahead), P + gain @ (P_later - P_ahead) @ gain.T))
    return evidence, smoothed


class NaiveEngine:
    """A third engine: rows of whitened noises and biases as one dense matrix in NumPy, everything by its inverse."""

    cheap, exact = False, True

    def at(self, model, point, rows=None):
        return Naive(model, point, linearise_rows(model, point) if rows is None else rows)

    def settled(self, model, point):
        return Naive(model, *_settled(model, point, point.z))


class Naive:
    """The posterior at a point, as `gaussian.engine.Expansion`: variables are all whitened noises, then the biases."""

    def __init__(self, model, point, rows):
        self.model, self.point, self.rows, self.M = model, point, rows, model.biases
        self.kept = None, None
        self.maps, start = [], 0  # states (E, n, U) of each recursion by all noises
        total = sum(part.drift.size for part in model.recursions)
        for part in model.recursions:
            E, n = part.drift.shape
            own, F, L = np.zeros((E, n, total)), np.asarray(part.F), np.asarray(factors(part, point.levels))
            for e in range(E):
                own[e] = F[e] @ own[e - 1]
                own[e, :, start + e * n : start + (e + 1) * n] += L[e]
            self.maps.append(own)
            start += E * n
        self.U, self.u = total, np.concatenate([np.asarray(u).ravel() for u in point.noises])
        H, w, s = self.H, self.w, self.s = [], [], []
        for block, data, r, lin in zip(model.blocks, *jax.device_get((model.rows, model.recursion, rows)), strict=True):
            for k in range(len(data.epoch)):
                for c in range(data.y.shape[1]):
                    row = np.zeros(total + self.M + 1)
                    row[:total] = np.asarray(lin.state[k, c]) @ self.maps[r][int(data.epoch[k])][list(block.used)]
                    np.add.at(row, total + np.asarray(data.bias[data.sensor[k]]), np.asarray(lin.bias[k, c]))
                    H.append(row[:-1]), w.append(float(lin.weight[k, c])), s.append(float(lin.score[k, c]))
        self.H, self.w, self.s = np.array(H), np.array(w), np.array(s)
        self.joint = self.H.T @ (self.w[:, None] * self.H)
        self.joint[: self.U, : self.U] += np.eye(self.U)
        self.pulled = self.H.T @ self.s
        self.pulled[: self.U] -= self.u
        if model.tilt is not None:
            self.joint[self.U :, self.U :] += np.asarray(model.tilt.curvature)
            self.pulled[self.U :] += np.asarray(model.tilt.pull(point.z))

    def whole(self, factors):
        found = self.joint.copy()
        found[self.U :, self.U :] += np.asarray(factors.matrix(self.M))
        return found

    def covariance(self, factors):
        if self.kept[0] is not factors:
            self.kept = factors, np.linalg.inv(self.whole(factors))
        return self.kept[1]

    def density(self):
        levels = np.sum((np.asarray(self.point.levels) / np.asarray(self.model.level_spread)) ** 2)
        told = float(_told(self.model, self.point))
        return told - 0.5 * (self.u @ self.u + levels + np.linalg.slogdet(self.joint[: self.U, : self.U])[1])

    def score(self):
        """By differences of the density, tracks at their mode."""

        def density(z):
            return Naive(self.model, *_settled(self.model, self.point, z)).density()

        z, h = np.asarray(self.point.z), 1e-4
        return np.array([(density(z + h * e) - density(z - h * e)) / (2 * h) for e in np.eye(self.M)])

    def slope(self):
        relaxed = np.linalg.solve(self.joint[: self.U, : self.U], self.pulled[: self.U])
        return self.pulled[self.U :] - self.joint[self.U :, : self.U] @ relaxed

    def log_det(self, factors):
        return Estimate(
            np.linalg.slogdet(self.whole(factors))[1] - np.linalg.slogdet(self.joint[: self.U, : self.U])[1]
        )

    def solve(self, factors, right):
        return self.covariance(factors)[self.U :, self.U :] @ np.asarray(right)

    def apply(self, columns):
        W, B = self.joint[: self.U, : self.U], self.joint[: self.U, self.U :]
        return (self.joint[self.U :, self.U :] - B.T @ np.linalg.solve(W, B)) @ np.asarray(columns)

    def information(self):
        return self.apply(np.eye(self.M))

    @property
    def eliminated(self):
        return eliminate_rows(self.model, self.point, self.rows, joint=False)

    def given_biases(self):
        return given_biases(self.model, self.point.levels, self.eliminated)

    def spread(self, factors):
        own = self.covariance(factors)
        states = tuple(np.diagonal(part, axis1=1, axis2=2) for part in self.states(factors))
        return Spread(np.diag(own)[self.U :], np.zeros(self.M), states)

    def moved(self, dz):
        W, B = self.joint[: self.U, : self.U], self.joint[: self.U, self.U :]
        return self._at(np.linalg.solve(W, self.pulled[: self.U] - B @ np.asarray(dz)), dz)

    def _at(self, du, dz):
        noises, states, start = [], [], 0
        for own, x, u in zip(self.maps, self.point.states, self.point.noises, strict=True):
            noises.append(np.asarray(u) + du[start : start + x.size].reshape(x.shape))
            states.append(np.asarray(x) + own @ du)
            start += x.size
        return self.point._replace(states=tuple(states), noises=tuple(noises), z=np.asarray(self.point.z) + dz)

    def marginals(self, factors, members):
        whole, M = np.zeros((self.M + 1,) * 2), self.M
        whole[:M, :M] = self.covariance(factors)[self.U :, self.U :]
        return whole[members[:, :, None], members[:, None, :]] + (members == M)[:, :, None] * np.eye(members.shape[1])

    def states(self, factors):
        own = self.covariance(factors)[: self.U, : self.U]
        return tuple(part @ own @ part.transpose(0, 2, 1) for part in self.maps)

    def noises(self, factors):
        own, start = np.diag(self.covariance(factors)), 0
        found = []
        for x in self.point.states:
            found.append(own[start : start + x.size].reshape(x.shape))
            start += x.size
        return tuple(found)

    def _by_row(self, values):
        cuts = np.cumsum([data.y.size for data in self.model.rows])[:-1]
        return tuple(v.reshape(d.y.shape) for v, d in zip(np.split(values, cuts), self.model.rows, strict=True))

    def predicted(self, factors):
        return self._by_row(np.sum((self.H @ self.covariance(factors)) * self.H, 1))

    def leverages(self, factors):
        W, B = self.joint[: self.U, : self.U], self.joint[: self.U, self.U :]
        follows = self.H[:, self.U :] - self.H[:, : self.U] @ np.linalg.solve(W, B)
        own = self.covariance(factors)[self.U :, self.U :]
        return self._by_row(self.w * np.sum((follows @ own) * follows, 1))

    def deviations(self, factors, key, count):
        rng, P = np.random.default_rng(np.asarray(jax.random.key_data(key))), self.covariance(factors)
        drawn = rng.multivariate_normal(np.zeros(len(P)), P, count)
        return Sampled(
            drawn[:, self.U :], tuple(np.einsum("enu,du->den", own, drawn[:, : self.U]) for own in self.maps)
        )

    @property
    def held_states(self):
        own = np.linalg.inv(self.joint[: self.U, : self.U])
        return tuple(part @ own @ part.transpose(0, 2, 1) for part in self.maps)

    def respond(self, factors, slopes):
        by_states = sum(np.einsum("enu,enk->uk", own, b) for own, b in zip(self.maps, slopes.states, strict=True))
        found = self.covariance(factors) @ np.concatenate([by_states, slopes.z])
        states = (np.einsum("enu,uk->enk", own, found[: self.U]) for own in self.maps)
        return Variables(tuple(states), found[self.U :])


@jax.jit
def _told(model, point):
    return log_likelihood(model, point) + mixing_gain(model)


def _settled(model, point, z):
    """Point at biases z with its tracks at their mode, and rows linearised there."""
    at = find_tracks(model, point._replace(z=jax.numpy.asarray(z)), 50, 1e-13)
    return at, linearise_rows(model, at)
