"""Directions that a declared sensor measures, found by trying its function.

A user declares a function, not a family. Tried at random places and poses, its channels are compared with azimuth and
elevation; what is neither is left to the grid.
"""

from collections.abc import Mapping
from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from probcal.geometry import bearing, elevation
from probcal.labels import AXES
from probcal.network import ANGLES, CLOCK, MOVING
from probcal.noise import guess_of
from probcal.problem import Problem
from probcal.sensor import SensorType
from probcal.types import PoseView, TargetView, float64

TRIALS = 24  # random configurations at which a function is tried
EXACT = 1e-6  # by how much a channel may miss the geometry of its family
STEP = 0.1  # by which a bias is moved to see whether it turns or shifts a channel


class Kind(NamedTuple):
    """The measurement of a channel: `sign` times the geometry plus `shift`; `by` is the effect per
    unit of each own bias.
    """

    family: str  # "azimuth", "elevation"
    sign: float
    shift: float
    by: Mapping[str, float]


@float64
def kinds(problem: Problem) -> dict[tuple[str, str], Kind]:
    """Kind of every channel that is recognised, by sensor type and channel."""
    d = problem.network.dimension
    return {
        (kind.name, name): found
        for kind in problem.network.types
        if d in kind.dimensions and kind.arity == 1
        for name, found in _tried(kind, d).items()
    }


@cache
def _tried(kind: SensorType, d: int) -> dict[str, Kind]:
    """Kinds of the channels of one sensor type, by name."""
    rng = np.random.default_rng(0)
    others = sorted(kind.target_components - {"position", "at"})
    extras = sorted(kind.pose_components - {"position", *ANGLES, *CLOCK, *MOVING})
    names = list(kind.biases)
    place = rng.normal(size=(TRIALS, d)) * 50.0
    nodes = rng.normal(size=(TRIALS, d)) * 50.0
    turned = rng.uniform(-0.4, 0.4, size=(TRIALS, len(ANGLES))) * [name in kind.pose_components for name in ANGLES]

    def width(name: str) -> tuple[int, ...]:
        return (d,) if name in kind.vectors else ()

    def one(p: jax.Array, s: jax.Array, angles: jax.Array, level: jax.Array, biases: jax.Array) -> tuple:
        own = {name: jnp.full(width(name), 1.0 + 0.1 * k) * level for k, name in enumerate(others)}
        target = TargetView("the target", {"position": p, "velocity": jnp.zeros(d), "acceleration": jnp.zeros(d)} | own)
        parts = {"position": s, "velocity": jnp.zeros(d), "clock": jnp.zeros(())}
        parts |= dict.fromkeys((*CLOCK, *MOVING[2:]), jnp.zeros(()))
        parts |= {name: jnp.zeros(width(name)) for name in extras}
        pose = PoseView("the node", parts | dict(zip(ANGLES, angles, strict=True)))
        value = kind.evaluate(
            target, [pose], {n: kind.biases[n].nominal + b for n, b in zip(names, biases, strict=True)}
        )
        local = pose.local(p)
        return value, jnp.stack([bearing(local), elevation(local) if d == 3 else jnp.zeros(())])

    look = jax.jit(jax.vmap(one, (0, 0, 0, None, None)))

    def at(level: float, biases: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        value, shape = look(*(np.asarray(x, float) for x in (place, nodes, turned, level, biases)))
        return np.asarray(value), np.asarray(shape)

    rest = np.zeros(len(names))
    (value, shape), (other, _) = at(1.0, rest), at(2.0, rest)
    moved = {name: at(1.0, rest + STEP * np.eye(len(names))[k])[0] for k, name in enumerate(names)}
    found = {}
    for c, (name, channel) in enumerate(kind.expand(d)):
        unit = np.pi / 180 if channel.unit == "deg" else 1.0
        own = {n: (v[:, c] - value[:, c]) / STEP for n, v in moved.items()}
        by = {n: float(v[0]) for n, v in own.items() if np.ptp(v) < EXACT * max(1.0, abs(v[0])) and abs(v[0]) > EXACT}
        kind_of = _family(value[:, c] * unit, other[:, c] * unit, shape, channel.period is not None)
        if kind_of is not None:
            found[name] = Kind(*kind_of, by)
    return found


def _family(value: np.ndarray, other: np.ndarray, shape: np.ndarray, wraps: bool) -> tuple[str, float, float] | None:
    """Family, sign and shift of a channel: its values with the target's other components at one level and another."""
    azimuth, height = shape.T
    for sign in (1.0, -1.0):
        turn = np.exp(1j * (value - sign * azimuth)).mean()
        if (wraps or np.ptp(azimuth) == 0) and abs(turn) > 1 - EXACT**2 and np.allclose(value, other):
            return "azimuth", sign, float(np.angle(turn))
    for sign in (1.0, -1.0) if np.ptp(height) > 0 else ():
        left = value - sign * height
        if np.ptp(left) < EXACT * max(1.0, np.abs(value).max()):
            return "elevation", sign, float(left.mean())
    return None


class Directions(NamedTuple):
    """The directions of one target from one static node: times (N,), azimuths (N,) or azimuths and
    elevations (N, 2), stds.
    """

    node: str
    target: str
    time: np.ndarray
    angles: np.ndarray
    std: np.ndarray


def seen_directions(problem: Problem) -> list[Directions]:
    """Rows of all recognised direction channels of resting nodes, as mathematical angles in the node's own axes.

    Several rows of one target at one time are averaged on the circle. In 3-D only rows with azimuth and elevation.
    """
    known, data, found = kinds(problem), problem.measurements, []
    d = problem.network.dimension
    families = ("azimuth", "elevation")[: d - 1]
    for k, sensor in enumerate(problem.network.sensors):
        if len(sensor.nodes) != 1 or sensor.nodes[0].path is not None:
            continue
        own: dict[str, tuple[int, float, float, float, float]] = {}  # column, sign, shift, radians of its unit, std
        for name, channel in sensor.type.expand(d):
            kind = known.get((sensor.type.name, name))
            if kind is not None and name in data.channels:
                turn = np.pi / 180 if channel.unit == "deg" else 1.0
                own[kind.family] = data.channels.index(name), kind.sign, kind.shift, turn, guess_of(channel.std)
        if not own.keys() >= set(families):
            continue
        column, sign, shift, unit, guess = (np.array(each) for each in zip(*map(own.get, families), strict=True))
        there = (data.sensor == k) & data.measured[:, column].all(1) & (data.weight > 0)
        for t, target in enumerate(data.target_names):
            mine = np.flatnonzero(there & (data.target == t))
            if not len(mine):
                continue
            cells = np.ix_(mine, column)
            time, group = np.unique(data.time[mine], return_inverse=True)
            total, spread = np.zeros((len(time), len(column)), complex), np.zeros((len(time), len(column)))
            np.add.at(total, group, np.exp(1j * (data.value[cells] * unit - shift) * sign))
            np.add.at(spread, group, np.where(data.has_std[cells], data.std[cells], guess) * unit)
            spread /= np.bincount(group)[:, None]
            found.append(Directions(sensor.nodes[0].name, target, time, np.angle(total), spread))
    return found


def members(problem: Problem) -> dict[str, dict[str, int]]:
    """Number of the free constant bias of each component of each node: `heading`, `position_x`, ..."""
    found: dict[str, dict[str, int]] = {node.name: {} for node in problem.network.nodes}
    for m, bias in enumerate(problem.biases):
        if bias.owner in found and bias.since is None:
            name = f"position_{AXES[bias.axis]}" if bias.component == "position" else bias.component
            found[bias.owner][name] = m
    return found
