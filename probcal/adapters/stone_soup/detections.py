"""Rows of a table as Stone Soup detections, and the other way."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from datetime import datetime, timedelta
from itertools import groupby
from typing import Any

import numpy as np

from probcal.adapters.stone_soup.function import Calibration, Mapped, SensorFunction
from probcal.adapters.stone_soup.measurement import (
    EPOCH,
    ModelMaker,
    angle_factor,
    as_start,
    placed_sensor,
    seconds_since,
    stonesoup,
    timestamp_of,
)
from probcal.errors import InputError, nearest
from probcal.labels import AXES
from probcal.lazy import pd
from probcal.network import Network
from probcal.noise import Heard, Unknown
from probcal.sensor import Channel, Sensor
from probcal.table import header, measure, read_table

NATIVE = {  # what the measurement models of Stone Soup measure, in their order
    "Cartesian2DToBearing": ("bearing",),
    "CartesianToBearingRange": ("bearing", "range"),
    "CartesianToBearingRangeRate2D": ("bearing", "range", "range_rate"),
    "CartesianToElevationBearing": ("elevation", "bearing"),
    "CartesianToElevationBearingRange": ("elevation", "bearing", "range"),
    "CartesianToBearingRangeRate": ("bearing", "range", "range_rate"),
    "CartesianToElevationBearingRangeRate": ("elevation", "bearing", "range", "range_rate"),
}
ALSO = {"bearing": ("azimuth", "bearing")}  # what channels that measure such a thing are called

POSITION = tuple(f"position_{axis}" for axis in AXES)


def to_detections(
    data: Any,
    network: Network,
    tree: Calibration = None,
    *,
    start: datetime | None = None,
    mapping: Mapped = None,
    ndim_state: int | None = None,
) -> list[Any]:
    """Rows of a table as Stone Soup detections in order of time, each with the measurement model of its sensor.

    `data` is what `Problem` takes; a row is one detection of the channels that it holds, with the noise that it states.
    Models, `mapping` and `tree` are those of `measurement_model`. Timestamps count from `start` (by default the start
    that a reader of `probcal.adapters` noted, or 1970), to the microsecond. Metadata hold `sensor` and, where the table
    names targets, `target`. What a receiver did not hear (its floor, or less) is left out. Raises `InputError` as
    `Problem` and `measurement_model` do.

    >>> import probcal.adapters as adapters
    >>> detections = adapters.to_detections(run.table, network)  # doctest: +SKIP
    """
    table = read_table(data)
    rows = measure(table, network)
    network = network.with_floors(rows.floors)
    start = as_start(start, table.frame.attrs.get("start")) or EPOCH
    maker = ModelMaker(network, tree, mapping, ndim_state, start)
    named = "target" in header(table)[0]
    number = {name: j for j, name in enumerate(rows.channels)}
    detection = stonesoup("types.detection").Detection
    found = []
    for n in np.argsort(rows.time, kind="stable"):
        placed = network.sensors[rows.sensor[n]]
        reading = maker.reading(placed)
        held = [(c, number[name], channel) for c, (name, channel) in enumerate(reading.channels)]
        held = [
            (c, j, channel)
            for c, j, channel in held
            if rows.measured[n, j] and not (isinstance(channel.noise, Heard) and rows.value[n, j] <= _floor(channel))
        ]
        if not held:
            continue
        model = maker.model(
            placed,
            tuple(c for c, _, _ in held),
            {c: rows.std[n, j] for c, j, _ in held if rows.has_std[n, j]},
            float(rows.time[n]),
        )
        values = [rows.value[n, j] * angle_factor(channel) for _, j, channel in held]
        metadata = {"sensor": placed.name}
        if named and not rows.detection[n]:
            metadata["target"] = rows.target_names[rows.target[n]]
        found.append(
            detection(
                maker.types.as_vector(values, [channel.wrap for _, _, channel in held]),
                timestamp=start + timedelta(seconds=float(rows.time[n])), measurement_model=model, metadata=metadata,
            )
        )  # fmt: skip
    return found


def _floor(channel: Channel) -> float:
    floor = getattr(channel.noise, "floor", None)
    return -np.inf if floor is None else float(floor)


def by_time(detections: Iterable[Any]) -> Iterator[tuple[datetime, set[Any]]]:
    """Detections as the trackers of Stone Soup read them: (time, set of detections), times in order.

    >>> import probcal.adapters as adapters
    >>> list(adapters.by_time([]))
    []
    """
    ordered = sorted(detections, key=lambda detection: detection.timestamp)
    for time, group in groupby(ordered, key=lambda detection: detection.timestamp):
        yield time, set(group)


def from_detections(
    detections: Iterable[Any],
    network: Network,
    *,
    start: datetime | None = None,
    sensor: str | Callable[[Any], str] | None = None,
    target: Callable[[Any], str | None] | None = None,
    channels: Mapping[str, Sequence[str]] | None = None,
) -> pd.DataFrame:
    """Stone Soup detections as a table: time (s), sensor, target where known, and a column a channel.

    `detections` is a series of them, or what a detector yields, (time, set). `sensor` names the sensor of all, or is a
    function of a detection; by default their metadata hold `sensor`, or their model was made here. Targets are those
    of the metadata (`target`), of the true path's `id`, or of a function; none leaves the column blank, for sensors
    placed with `Detection`. What a measurement holds is known of Stone Soup's own models (bearing, range, elevation,
    range rate) and of those made here; for others `channels` names it by sensor. Angles come in radians and leave in
    the unit of the channel; a std that differs from the declared one has its column. Time counts in s from `start`, by
    default the first detection. Raises `InputError` naming detection and sensor.

    >>> import probcal.adapters as adapters
    >>> adapters.from_detections([], network)
    Traceback (most recent call last):
    ...
    probcal.errors.InputError: there are no detections; give those of Stone Soup, or what a detector yields
    """
    given: list[Any] = []
    for item in detections:
        given += list(item[1]) if isinstance(item, tuple) else [item]
    if not given:
        raise InputError("there are no detections; give those of Stone Soup, or what a detector yields")
    given.sort(key=lambda detection: timestamp_of(detection, "detection"))
    start = as_start(start, None) or given[0].timestamp
    rows = []
    for n, one in enumerate(given):
        placed = placed_sensor(_sensor_of(one, sensor, n), network)
        row: dict[str, Any] = {"time": seconds_since(one.timestamp, start), "sensor": placed.name}
        row["target"] = target(one) if target is not None else _target_of(one)
        rows.append(row | _cells(one, placed, network, channels or {}, n))
    frame = pd.DataFrame(rows)
    names = [name for name in network.channel_names if name in frame]
    columns = ["time", "sensor", "target", *names, *(f"{c}_std" for c in names if f"{c}_std" in frame)]
    frame = frame[columns if frame["target"].notna().any() else [c for c in columns if c != "target"]]
    frame.attrs["start"] = start.isoformat()
    return frame


def _sensor_of(one: Any, sensor: Any, n: int) -> str:
    if sensor is not None:
        return str(sensor(one) if callable(sensor) else sensor)
    name = (one.metadata or {}).get("sensor")
    reading = getattr(one.measurement_model, "reading", None)
    if name is None and isinstance(reading, SensorFunction):
        name = reading.placed.name
    if name is None:
        raise InputError(
            f"detection {n} does not say which sensor made it: put sensor into its metadata, or give sensor= a name or"
            " a function of a detection"
        )
    return str(name)


def _target_of(one: Any) -> str | None:
    name = (one.metadata or {}).get("target")
    path = getattr(one, "groundtruth_path", None)
    if name is None and path is not None:
        name = getattr(path, "id", None)
    return None if name is None else str(name)


def _cells(
    one: Any, placed: Sensor, network: Network, channels: Mapping[str, Sequence[str]], n: int
) -> dict[str, float]:
    """Channels of a detection in their units, and stds that are not the declared ones."""
    declared = dict(placed.type.expand(network.dimension))
    model = one.measurement_model
    values = np.asarray(one.state_vector, float)[:, 0]
    if placed.name in channels:
        names = list(channels[placed.name])
    elif isinstance(getattr(model, "reading", None), SensorFunction):
        names = list(model.channels)
    else:
        names = _native_names(model, declared, placed, n)
    if len(names) != len(values):
        raise InputError(
            f'detection {n} of sensor "{placed.name}" holds {len(values)} numbers, but {len(names)} channels are named:'
            f" {', '.join(names)}"
        )
    covar = None if model is None else getattr(model, "noise_covar", None)
    stds = None if covar is None else np.sqrt(np.diag(np.asarray(covar, float)))
    found: dict[str, float] = {}
    for k, (name, value) in enumerate(zip(names, values, strict=True)):
        if name not in declared:
            raise InputError(f'detection {n}: sensor "{placed.name}" has no channel "{name}"{nearest(name, declared)}')
        channel = declared[name]
        found[name] = float(channel.turned(value / angle_factor(channel)))
        if stds is not None and not isinstance(channel.std, Unknown):
            own = float(stds[k] / angle_factor(channel))
            if abs(own - channel.std) > 1e-9 * channel.std and own > 0:
                found[f"{name}_std"] = own
    return found


def _native_names(model: Any, declared: Mapping[str, Channel], placed: Sensor, n: int) -> list[str]:
    """Channels that a measurement model of Stone Soup itself measures, as the sensor calls them."""
    if type(model).__name__ == "LinearGaussian":
        return list(POSITION[: len(model.mapping)])
    measured = NATIVE.get(type(model).__name__)
    if measured is None:
        raise InputError(
            f'detection {n} of sensor "{placed.name}" has the model {type(model).__name__}, of which it is not known'
            f' what it measures: give channels={{"{placed.name}": {list(declared)}}}, in its order'
        )
    return [next((name for name in ALSO.get(what, ()) if name in declared), what) for what in measured]
