"""A network as Stone Soup sensors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import datetime
from functools import partial
from typing import Any

import numpy as np

from probcal.adapters.stone_soup.detections import ALSO, NATIVE
from probcal.adapters.stone_soup.function import Calibration, Mapped, SensorFunction
from probcal.adapters.stone_soup.measurement import ModelMaker, angle_factor, stonesoup
from probcal.network import Network
from probcal.sensor import Sensor

ANGULAR = ("bearing", "elevation")


def to_sensors(
    network: Network,
    tree: Calibration = None,
    *,
    mapping: Mapped = None,
    ndim_state: int | None = None,
    start: datetime | None = None,
) -> dict[str, Any]:
    """A network as Stone Soup sensors by name, nodes and biases put right by a calibration.

    Where a type of Stone Soup (RadarBearingRange, RadarBearing, RadarElevationBearingRange, PassiveElevationBearing)
    computes the same, which is tried at some places, it is that type, at the calibrated position and orientation; else,
    as with a range offset that is not zero, a sensor with the measurement model of `measurement_model`, whose arguments
    these are. They see every target: fields of view and detection probabilities are yours to add. Raises `InputError`.

    >>> import probcal.adapters as adapters
    >>> sensors = adapters.to_sensors(network, tree)  # doctest: +SKIP
    """
    maker = ModelMaker(network, tree, mapping, ndim_state, start)
    return {placed.name: _native_sensor(placed, maker) or _declared_sensor(placed, maker) for placed in network.sensors}


def _pose(placed: Sensor, maker: ModelMaker) -> dict[str, Any]:
    """Position and orientation (roll, pitch, yaw) of the first node of a sensor."""
    vector = stonesoup("types.array").StateVector
    poses, _ = maker.reading(placed).at()
    pose = poses[0]
    angles = [float(pose[name]) for name in ("roll", "pitch", "heading")]
    return {"position": vector(pose["position"].tolist()), "orientation": vector(angles)}


def _declared_sensor(placed: Sensor, maker: ModelMaker) -> Any:
    return maker.types.DeclaredSensor(model=maker.model(placed), **_pose(placed, maker))


def _native_sensor(placed: Sensor, maker: ModelMaker) -> Any:
    """The sensor as a type of Stone Soup, None where none computes the same."""
    reading = maker.reading(placed)
    if reading.varies or len(placed.nodes) > 1:
        return None
    names = [name for name, _ in reading.channels]
    std = np.sqrt(np.diag(np.asarray(maker.model(placed).noise_covar, float)))
    for measured, make in _makers(maker, placed):
        order = [next((names.index(n) for n in ALSO.get(what, (what,)) if n in names), -1) for what in measured]
        if -1 in order or len(order) != len(names):
            continue
        made = make(np.diag(std[order] ** 2))
        if _same(made.measurement_model, measured, reading, order, maker):
            return made
    return None


def _makers(maker: ModelMaker, placed: Sensor) -> list[tuple[tuple[str, ...], Callable[[np.ndarray], Any]]]:
    """The channels of each Stone Soup sensor type, and its maker from a noise covariance."""
    radar = stonesoup("sensor.radar.radar")
    place = _pose(placed, maker) | {"ndim_state": maker.mapping.size}
    mapped = place | {"position_mapping": maker.mapping.position}
    if maker.network.dimension == 2:
        return [
            (NATIVE["CartesianToBearingRange"], partial(_made, radar.RadarBearingRange, mapped)),
            (NATIVE["Cartesian2DToBearing"], partial(_made, radar.RadarBearing, mapped)),
        ]
    passive = stonesoup("sensor.passive").PassiveElevationBearing
    return [
        (NATIVE["CartesianToElevationBearingRange"], partial(_made, radar.RadarElevationBearingRange, mapped)),
        (
            NATIVE["CartesianToElevationBearing"],
            partial(_made, passive, place | {"mapping": np.array(maker.mapping.position)}),
        ),
    ]


def _made(kind: Any, arguments: dict[str, Any], covar: np.ndarray) -> Any:
    return kind(noise_covar=covar, **arguments)


def _same(model: Any, measured: Sequence[str], reading: SensorFunction, order: list[int], maker: ModelMaker) -> bool:
    """True if a model of Stone Soup computes what the declared sensor does, at places around it."""
    factor = np.array([angle_factor(channel) for _, channel in reading.channels])
    random, mapping = np.random.default_rng(0), maker.mapping
    state = random.normal(0.0, 300.0, (mapping.size, 8))
    state[list(mapping.position)] += reading.at()[0][0]["position"][:, None]
    types = maker.types
    with np.errstate(all="ignore"):
        other = model.function(stonesoup("types.state").State(types.StateVectors(state)), noise=False)
    away = np.asarray(other, float) - (factor[:, None] * reading.values(state))[order]
    turns = np.array([what in ANGULAR for what in measured])
    away[turns] = (away[turns] + np.pi) % (2 * np.pi) - np.pi
    return bool(np.abs(away).max() < 1e-8)
