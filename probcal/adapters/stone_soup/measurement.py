"""Stone Soup measurement models of the sensors of a network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np

from probcal.adapters.shared import extra
from probcal.adapters.stone_soup.function import (
    Calibration,
    Mapped,
    SensorFunction,
    StateMapping,
    calibrated_biases,
    channel_stds,
)
from probcal.errors import InputError, nearest
from probcal.lazy import pd
from probcal.network import Network
from probcal.sensor import Channel, Sensor
from probcal.table import name_as_text

EPOCH = datetime(1970, 1, 1)  # of detections and tracks whose start nobody states


def stonesoup(module: str) -> Any:
    """A module of Stone Soup."""
    return extra(f"stonesoup.{module}", "what comes from or goes to Stone Soup", "stonesoup")


def _models() -> Any:
    """The classes made of those of Stone Soup."""
    stonesoup("base")
    from probcal.adapters.stone_soup import models

    return models


def measurement_model(
    sensor: str | Sensor,
    network: Network,
    tree: Calibration = None,
    *,
    mapping: Mapped = None,
    ndim_state: int | None = None,
    start: datetime | None = None,
    channels: Sequence[str] | None = None,
) -> Any:
    """A Stone Soup measurement model of any sensor of a network, its pose and biases those of a calibration.

    `tree` is a fit (its means are taken), biases by label, or None for what is stated. `mapping` says where the
    components of a target stand in the state vector: positions (the default is that of Stone Soup, `(0, 2)` or `(0, 2,
    4)` with velocities in between), or `{"position": (0, 2), "velocity": (1, 3), "power": 4}`. Measurements are the
    `channels` (all by default) in their units, those that wrap in radians; the derivative is exact, angles wrap, and
    noise counts as Gaussian of its std. `start` is the datetime of time 0 where a node moves or a bias drifts.
    Raises `InputError` naming sensor, channel or component.

    >>> import probcal.adapters as adapters
    >>> adapters.measurement_model("sonar", network)
    Traceback (most recent call last):
    ...
    probcal.errors.InputError: no sensor of the network is called "sonar"; did you mean "sonar_2"?
    """
    placed = placed_sensor(sensor, network)
    maker = ModelMaker(network, tree, mapping, ndim_state, start)
    named = [name for name, _ in placed.type.expand(network.dimension)]
    for name in channels or ():
        if name not in named:
            raise InputError(f'sensor "{placed.name}" measures no "{name}"{nearest(name, named)}')
    return maker.model(placed, None if channels is None else tuple(named.index(name) for name in channels))


def placed_sensor(sensor: str | Sensor, network: Network) -> Sensor:
    """A sensor of a network by name; raises `InputError` with the nearest name."""
    by_name = {name_as_text(placed.name): placed for placed in network.sensors}
    name = name_as_text(sensor.name if isinstance(sensor, Sensor) else sensor)
    if name not in by_name:
        raise InputError(f'no sensor of the network is called "{name}"{nearest(name, by_name)}')
    return by_name[name]


class ModelMaker:
    """Makes the measurement models of a network, each once."""

    def __init__(self, network: Network, tree: Calibration, mapping: Mapped, size: int | None, start: Any):
        self.types = _models()
        self.network, self.tree, self.start = network, tree, start
        self.mapping = StateMapping(mapping, network.dimension, size)
        self.biases = calibrated_biases(tree, network)
        self._readings: dict[str, SensorFunction] = {}
        self._stds: dict[str, np.ndarray] = {}
        self._made: dict[Any, Any] = {}

    def reading(self, placed: Sensor) -> SensorFunction:
        """The sensor as a function of a state vector."""
        if placed.name not in self._readings:
            self._stds[placed.name] = channel_stds(placed, self.network, self.tree)
            self._readings[placed.name] = SensorFunction(placed, self.network, self.biases, self.mapping)
        return self._readings[placed.name]

    def model(
        self,
        placed: Sensor,
        chosen: tuple[int, ...] | None = None,
        stds: Mapping[int, float] | None = None,
        time: float | None = None,
    ) -> Any:
        """The model of some channels by number, with other `stds` by channel, taken at a time in s."""
        reading = self.reading(placed)
        chosen = tuple(range(len(reading.channels))) if chosen is None else chosen
        time = time if reading.varies else None
        key = (placed.name, chosen, tuple(sorted((stds or {}).items())), time)
        if key not in self._made:
            std = self._stds[placed.name].copy()
            for channel, own in (stds or {}).items():
                std[channel] = own
            angle = [angle_factor(channel) for _, channel in reading.channels]
            self._made[key] = self.types.DeclaredModel(
                ndim_state=self.mapping.size, mapping=self.mapping.position, reading=reading, chosen=list(chosen),
                noise_covar=np.diag([(std[c] * angle[c]) ** 2 for c in chosen]), start=self.start, time=time,
            )  # fmt: skip
        return self._made[key]


def angle_factor(channel: Channel) -> float:
    """The factor that converts a channel to the unit of Stone Soup: radians where it wraps."""
    return 2 * np.pi / channel.period if channel.period else 1.0


def timestamp_of(item: Any, what: str) -> datetime:
    """Timestamp of a detection or state; raises `InputError` where it has none."""
    stamp = getattr(item, "timestamp", None)
    if not isinstance(stamp, datetime):
        raise InputError(f"a {what} has the timestamp {stamp!r}; every {what} needs a datetime")
    return stamp


def seconds_since(stamp: datetime, start: datetime) -> float:
    """Seconds of a timestamp since a start; raises `InputError` where one of them alone has a time zone."""
    if (stamp.tzinfo is None) != (start.tzinfo is None):
        raise InputError(f"start is {start} and a timestamp {stamp}; give both a time zone, or neither")
    return (stamp - start).total_seconds()


def as_start(start: Any, noted: Any) -> datetime | None:
    """A start as given, or as a reader noted it (without its zone, UTC, as Stone Soup has it)."""
    if start is None and noted is not None:
        start = pd.Timestamp(noted).to_pydatetime()
        return start.astimezone(UTC).replace(tzinfo=None) if start.tzinfo else start
    if start is not None and not isinstance(start, datetime):
        raise InputError(f"start is {start!r}; give the datetime of time 0")
    return start
