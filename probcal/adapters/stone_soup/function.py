"""A declared sensor as a function of a plain state vector, its pose and biases put right by a calibration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from probcal.errors import InputError, nearest
from probcal.labels import AXES
from probcal.lazy import xr
from probcal.model.rows import pose_entries, pose_vector
from probcal.network import ANGLES, BiasRecord, Network
from probcal.noise import Bernoulli, Unknown, guess_of
from probcal.sensor import Channel, Sensor, SensorType
from probcal.types import PoseView, TargetView

Places = tuple[tuple[str, int | tuple[int, ...]], ...]  # where the components of a state stand in its vector
Mapped = Sequence[int] | Mapping[str, int | Sequence[int]] | None
Calibration = Any  # a fit, biases by label, or None


@partial(jax.jit, static_argnums=(0, 1))
def _values(kind: SensorType, places: Places, states: jax.Array, poses: Any, biases: Any) -> jax.Array:
    """Channels (C, N) of states (n, N)."""
    return jax.vmap(lambda state: _one(kind, places, state, poses, biases), 1, 1)(states)


@partial(jax.jit, static_argnums=(0, 1))
def _derivative(kind: SensorType, places: Places, state: jax.Array, poses: Any, biases: Any) -> jax.Array:
    """Derivative (C, n) of the channels by a state (n,)."""
    return jax.jacfwd(lambda x: _one(kind, places, x, poses, biases))(state)


def _one(kind: SensorType, places: Places, state: jax.Array, poses: Any, biases: Any) -> jax.Array:
    parts = {name: state[i] if isinstance(i, int) else jnp.stack([state[k] for k in i]) for name, i in places}
    return kind.evaluate(TargetView("the target", parts), [PoseView("the node", pose) for pose in poses], biases)


class StateMapping:
    """The indices of position, velocity and further components in a state vector of `size` numbers.

    By default those of Stone Soup: position and velocity of each axis in turn. A sequence names the positions alone.
    """

    def __init__(self, mapping: Mapped, dimension: int, size: int | None = None):
        self.dimension = dimension
        even, odd = tuple(range(0, 2 * dimension, 2)), tuple(range(1, 2 * dimension, 2))
        if mapping is None or (not isinstance(mapping, Mapping) and tuple(mapping) == even):
            mapping = {"position": even, "velocity": odd}
        elif not isinstance(mapping, Mapping):
            mapping = {"position": tuple(mapping)}
        found: dict[str, int | tuple[int, ...]] = {}
        for name, index in mapping.items():
            found[name] = int(index) if isinstance(index, (int, np.integer)) else tuple(int(i) for i in index)
        position = found.get("position", ())
        if isinstance(position, int) or len(position) != dimension:
            raise InputError(
                f"mapping gives the position as {position!r}; a {dimension}-D network needs {dimension} entries of the"
                ' state vector, as in {"position": (0, 2), "velocity": (1, 3)}'
            )
        entries = [i for index in found.values() for i in ((index,) if isinstance(index, int) else index)]
        self.size = max(entries) + 1 if size is None else int(size)
        if min(entries) < 0 or max(entries) >= self.size or len(set(entries)) < len(entries):
            raise InputError(
                f"mapping {found} does not fit a state vector of {self.size} numbers: each entry once, from 0 to"
                f" {self.size - 1}"
            )
        self.places: Places = tuple(found.items())

    @property
    def position(self) -> tuple[int, ...]:
        """Entries of the position."""
        index = dict(self.places)["position"]
        return index if isinstance(index, tuple) else (index,)

    @property
    def entries(self) -> dict[str, int]:
        """Entries by scalar name (`position_x`, `power`)."""
        found: dict[str, int] = {}
        for name, index in self.places:
            if isinstance(index, int):
                found[name] = index
            else:
                found |= {f"{name}_{axis}": i for axis, i in zip(AXES, index, strict=False)}
        return found


def calibrated_biases(calibration: Calibration, network: Network) -> dict[str, float]:
    """Biases by label: the means of a fit and those that it held, or as given; none without a calibration."""
    if calibration is None:
        return {}
    if isinstance(calibration, xr.DataTree):
        if "calibration" not in calibration.children:
            raise InputError("the tree holds no calibration; give what fit() returned, or biases by label")
        group = calibration["calibration"].to_dataset()
        found = dict(zip(map(str, group["bias_label"].values), group["mean"].values.tolist(), strict=True))
        constant = calibration["constant_data"].to_dataset()
        if "fixed" in constant:
            found |= {str(label): float(value) for label, value in constant["fixed"].to_series().items()}
        for label in network.labels:
            if label not in found:
                raise InputError(f'the fit says nothing of the bias "{label}" of this network{nearest(label, found)}')
        return found
    if not isinstance(calibration, Mapping):
        raise InputError(f"the calibration is {type(calibration).__name__}; give a fit, or biases by label")
    for label in calibration:
        if label not in network.labels:
            raise InputError(f'the calibration names the bias "{label}"{nearest(str(label), network.labels)}')
    return {str(label): float(value) for label, value in calibration.items()}


def channel_stds(placed: Sensor, network: Network, calibration: Calibration) -> np.ndarray:
    """Noise std (C,) of the channels of a sensor in their units: declared, or where unknown that of a fit, or guess."""
    levels: dict[str, float] = {}
    if isinstance(calibration, xr.DataTree) and "level" in calibration.children:
        levels = {str(name): float(v) for name, v in calibration["level"].to_dataset()["std"].to_series().items()}
    found: list[float] = []
    for name, channel in placed.type.channels.items():
        if isinstance(channel.noise, Bernoulli):
            raise InputError(
                f'sensor "{placed.name}": channel "{name}" is yes or no, which no Gaussian measurement model holds;'
                " leave that sensor to probcal"
            )
        level = channel.std
        declared = guess_of(level)
        own = levels.get(f"{placed.type.name}.{name}_std", declared) if isinstance(level, Unknown) else declared
        found += [own] * (network.dimension if channel.per_axis else 1)
    return np.array(found)


class SensorFunction:
    """The measurement function of a placed sensor, with the poses and biases of a calibration.

    Values are in the units of the channels, as the function returns them. A sensor whose node moves, or whose bias
    drifts, has another pose at every time (`varies`).
    """

    def __init__(self, placed: Sensor, network: Network, biases: Mapping[str, float], mapping: StateMapping):
        self.placed, self.mapping, self.dimension = placed, mapping, network.dimension
        self.kind = placed.type
        self._check()
        self._biases = dict(biases)
        self._records: dict[tuple[str, str, int], BiasRecord] = {
            (b.owner, b.component, b.axis): b for b in network.biases if b.since is None
        }
        self._steps = {key: network.steps(*key) for key in self._records}
        entries = pose_entries(self.kind, self.dimension)
        addresses = [(node.name, *entry) for node in placed.nodes for entry in entries]
        addresses += [(self._owner(name), name, 0) for name in self.kind.biases]
        moving = any(node.path is not None for node in placed.nodes)
        self.varies = moving or any(self._steps.get(address) for address in addresses)

    @cached_property
    def channels(self) -> tuple[tuple[str, Channel], ...]:
        """Scalar channels by name."""
        return self.kind.expand(self.dimension)

    def _check(self) -> None:
        known = dict(self.mapping.places)
        for name in sorted(self.kind.target_components - set(known) - {"at"}):
            raise InputError(
                f'sensor "{self.placed.name}" reads target.{name}, for which the mapping has no entry'
                f'{nearest(name, known)}; say where it stands in the state, as in mapping={{"{name}": 4, ...}}'
            )

    def _owner(self, name: str) -> str:
        return self.kind.name if self.kind.biases[name].shared else self.placed.name

    def _bias(self, address: tuple[str, str, int], time: float) -> float:
        """A bias at a time in s, with the steps of a drift until then."""
        record = self._records.get(address)
        if record is None:
            return 0.0
        own = self._biases.get(record.label, 0.0)
        steps = (step for step in self._steps[address] if step.since is not None and step.since <= time)
        return own + sum(self._biases.get(step.label, 0.0) for step in steps)

    def at(self, time: float = 0.0) -> tuple[list[dict[str, np.ndarray]], dict[str, np.ndarray]]:
        """Poses of the nodes, and the biases of the sensor, at a time in s of the table."""
        entries = pose_entries(self.kind, self.dimension)
        extras = tuple(sorted(self.kind.pose_components - {"position"}))
        poses = []
        for node in self.placed.nodes:
            vector = pose_vector(node, extras, np.array([time]))[0]
            parts: dict[str, Any] = dict.fromkeys(ANGLES, np.zeros(()))
            for name in dict.fromkeys(name for name, _ in entries):
                own = [
                    value + self._bias((node.name, name, axis), time)
                    for value, (other, axis) in zip(vector, entries, strict=True)
                    if other == name
                ]
                parts[name] = np.array(own if name in self.kind.vectors else own[0])
            poses.append(parts)
        biases = {
            name: np.array(self.placed.known.get(name, bias).nominal + self._bias((self._owner(name), name, 0), time))
            for name, bias in self.kind.biases.items()
        }
        return poses, biases

    def values(self, states: np.ndarray, time: float = 0.0) -> np.ndarray:
        """Values (C, N) of states (n, N), without noise."""
        with jax.enable_x64(True):
            return np.array(_values(self.kind, self.mapping.places, np.asarray(states, float), *self._cached(time)))

    def derivative(self, state: np.ndarray, time: float = 0.0) -> np.ndarray:
        """Derivative (C, n) of the values by the state (n,)."""
        with jax.enable_x64(True):
            return np.array(_derivative(self.kind, self.mapping.places, np.asarray(state, float), *self._cached(time)))

    @cached_property
    def _still(self) -> tuple[list[dict[str, np.ndarray]], dict[str, np.ndarray]]:
        return self.at()

    def _cached(self, time: float) -> tuple[list[dict[str, np.ndarray]], dict[str, np.ndarray]]:
        return self.at(time) if self.varies else self._still
