"""Stone Soup: detections, tracks and sensors, and a measurement model of any declared sensor (`probcal[stonesoup]`)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from itertools import groupby
from typing import TYPE_CHECKING, Any

import numpy as np

from probcal.adapters.declared import (
    Calibration,
    Mapped,
    SensorFunction,
    StateMapping,
    calibrated_biases,
    channel_stds,
)
from probcal.adapters.shared import extra
from probcal.errors import InputError, nearest
from probcal.labels import AXES
from probcal.lazy import Later
from probcal.network import Network
from probcal.noise import Heard, Unknown
from probcal.sensor import Channel, Sensor
from probcal.table import header, measure, name_as_text, read_table

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
else:
    pd = Later("pandas")

EPOCH = datetime(1970, 1, 1)
ANGULAR = ("bearing", "elevation")
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


def _stonesoup(module: str) -> Any:
    return extra(f"stonesoup.{module}", "what comes from or goes to Stone Soup", "stonesoup")


def _models() -> Any:
    _stonesoup("base")
    from probcal.adapters import stone_soup_models

    return stone_soup_models


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
    placed = _placed(sensor, network)
    maker = _Maker(network, tree, mapping, ndim_state, start)
    named = [name for name, _ in placed.type.expand(network.dimension)]
    for name in channels or ():
        if name not in named:
            raise InputError(f'sensor "{placed.name}" measures no "{name}"{nearest(name, named)}')
    return maker.model(placed, None if channels is None else tuple(named.index(name) for name in channels))


def _placed(sensor: str | Sensor, network: Network) -> Sensor:
    by_name = {name_as_text(placed.name): placed for placed in network.sensors}
    name = name_as_text(sensor.name if isinstance(sensor, Sensor) else sensor)
    if name not in by_name:
        raise InputError(f'no sensor of the network is called "{name}"{nearest(name, by_name)}')
    return by_name[name]


class _Maker:
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
            angle = [_angle(channel) for _, channel in reading.channels]
            self._made[key] = self.types.DeclaredModel(
                ndim_state=self.mapping.size, mapping=self.mapping.position, reading=reading, chosen=list(chosen),
                noise_covar=np.diag([(std[c] * angle[c]) ** 2 for c in chosen]), start=self.start, time=time,
            )  # fmt: skip
        return self._made[key]


def _angle(channel: Channel) -> float:
    """What takes a channel to the unit of Stone Soup: radians where it wraps."""
    return 2 * np.pi / channel.period if channel.period else 1.0


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
    start = _datetime(start, table.frame.attrs.get("start")) or EPOCH
    maker = _Maker(network, tree, mapping, ndim_state, start)
    named = "target" in header(table)[0]
    number = {name: j for j, name in enumerate(rows.channels)}
    detection = _stonesoup("types.detection").Detection
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
        values = [rows.value[n, j] * _angle(channel) for _, j, channel in held]
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
    given.sort(key=lambda detection: _stamp(detection, "detection"))
    start = _datetime(start, None) or given[0].timestamp
    rows = []
    for n, one in enumerate(given):
        placed = _placed(_sensor_of(one, sensor, n), network)
        row: dict[str, Any] = {"time": _seconds(one.timestamp, start), "sensor": placed.name}
        row["target"] = target(one) if target is not None else _target_of(one)
        rows.append(row | _cells(one, placed, network, channels or {}, n))
    frame = pd.DataFrame(rows)
    names = [name for name in network.channel_names if name in frame]
    columns = ["time", "sensor", "target", *names, *(f"{c}_std" for c in names if f"{c}_std" in frame)]
    frame = frame[columns if frame["target"].notna().any() else [c for c in columns if c != "target"]]
    frame.attrs["start"] = start.isoformat()
    return frame


def _stamp(item: Any, what: str) -> datetime:
    stamp = getattr(item, "timestamp", None)
    if not isinstance(stamp, datetime):
        raise InputError(f"a {what} has the timestamp {stamp!r}; every {what} needs a datetime")
    return stamp


def _seconds(stamp: datetime, start: datetime) -> float:
    if (stamp.tzinfo is None) != (start.tzinfo is None):
        raise InputError(f"start is {start} and a timestamp {stamp}; give both a time zone, or neither")
    return (stamp - start).total_seconds()


def _datetime(start: Any, noted: Any) -> datetime | None:
    """A start as given, or as a reader noted it (without its zone, UTC, as Stone Soup has it)."""
    if start is None and noted is not None:
        start = pd.Timestamp(noted).to_pydatetime()
        return start.astimezone(UTC).replace(tzinfo=None) if start.tzinfo else start
    if start is not None and not isinstance(start, datetime):
        raise InputError(f"start is {start!r}; give the datetime of time 0")
    return start


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
        found[name] = float(channel.turned(value / _angle(channel)))
        if stds is not None and not isinstance(channel.std, Unknown):
            own = float(stds[k] / _angle(channel))
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
    maker = _Maker(network, tree, mapping, ndim_state, start)
    return {placed.name: _native_sensor(placed, maker) or _declared_sensor(placed, maker) for placed in network.sensors}


def _pose(placed: Sensor, maker: _Maker) -> dict[str, Any]:
    """Position and orientation (roll, pitch, yaw) of the first node of a sensor."""
    vector = _stonesoup("types.array").StateVector
    poses, _ = maker.reading(placed).at()
    pose = poses[0]
    angles = [float(pose[name]) for name in ("roll", "pitch", "heading")]
    return {"position": vector(pose["position"].tolist()), "orientation": vector(angles)}


def _declared_sensor(placed: Sensor, maker: _Maker) -> Any:
    return maker.types.DeclaredSensor(model=maker.model(placed), **_pose(placed, maker))


def _native_sensor(placed: Sensor, maker: _Maker) -> Any:
    """The sensor as a type of Stone Soup, None where none computes the same."""
    reading = maker.reading(placed)
    if reading.varies or len(placed.nodes) > 1:
        return None
    names = [name for name, _ in reading.channels]
    factor = np.array([_angle(channel) for _, channel in reading.channels])
    std = np.sqrt(np.diag(np.asarray(maker.model(placed).noise_covar, float)))
    for measured, make in _makers(maker, placed):
        order = [next((names.index(n) for n in ALSO.get(what, (what,)) if n in names), -1) for what in measured]
        if -1 in order or len(order) != len(names):
            continue
        made = make(np.diag(std[order] ** 2))
        if _same(made.measurement_model, measured, reading, factor, order, maker):
            return made
    return None


def _makers(maker: _Maker, placed: Sensor) -> list[tuple[tuple[str, ...], Callable[[np.ndarray], Any]]]:
    radar, passive = _stonesoup("sensor.radar.radar"), _stonesoup("sensor.passive")
    place = _pose(placed, maker) | {"ndim_state": maker.mapping.size}
    index = maker.mapping.position
    if maker.network.dimension == 2:
        kinds = {"CartesianToBearingRange": radar.RadarBearingRange, "Cartesian2DToBearing": radar.RadarBearing}
    else:
        kinds = {"CartesianToElevationBearingRange": radar.RadarElevationBearingRange}
    found: list[Any] = [
        (NATIVE[name], lambda covar, kind=kind: kind(position_mapping=index, noise_covar=covar, **place))
        for name, kind in kinds.items()
    ]
    if maker.network.dimension == 3:
        passive_kind = passive.PassiveElevationBearing
        found.append(
            (
                NATIVE["CartesianToElevationBearing"],
                lambda covar: passive_kind(mapping=np.array(index), noise_covar=covar, **place),
            )
        )
    return found


def _same(
    model: Any, measured: Sequence[str], reading: SensorFunction, factor: np.ndarray, order: list[int], maker: _Maker
) -> bool:
    """Whether a model of Stone Soup computes what the declared sensor does, at places around it."""
    random, mapping = np.random.default_rng(0), maker.mapping
    state = random.normal(0.0, 300.0, (mapping.size, 8))
    state[list(mapping.position)] += reading.at()[0][0]["position"][:, None]
    types = maker.types
    with np.errstate(all="ignore"):
        other = model.function(_stonesoup("types.state").State(types.StateVectors(state)), noise=False)
    away = np.asarray(other, float) - (factor[:, None] * reading.values(state))[order]
    turns = np.array([what in ANGULAR for what in measured])
    away[turns] = (away[turns] + np.pi) % (2 * np.pi) - np.pi
    return bool(np.abs(away).max() < 1e-8)


def to_tracks(tree: xr.DataTree, *, start: datetime | None = None, mapping: Mapped = None) -> list[Any]:
    """The tracks of a fit as Stone Soup tracks, one a target, whose id it is.

    States are Gaussian with the mean and sd of each component, without correlations, which a fit does not hold; their
    order is that of Stone Soup (position and velocity of each axis in turn, then what else there is), or `mapping`.
    Timestamps count from `start`, by default 1970. Raises `InputError` for a tree without tracks.

    >>> import probcal.adapters as adapters
    >>> tracks = adapters.to_tracks(tree)  # doctest: +SKIP
    """
    from probcal.results.read import each_track

    start = _datetime(start, None) or EPOCH
    types, arrays = _stonesoup("types.state"), _stonesoup("types.array")
    track = _stonesoup("types.track").Track
    found = []
    for name, group in each_track(tree):
        components = [str(c) for c in group["component"].values]
        order = _order(components, mapping)
        mean, sd = group["mean"].values, group["sd"].values
        states = [
            types.GaussianState(
                arrays.StateVector(mean[k, order].tolist()), np.diag(sd[k, order] ** 2),
                timestamp=start + timedelta(seconds=float(time)),
            )
            for k, time in enumerate(group["time"].values)
        ]  # fmt: skip
        found.append(track(states, id=name))
    if not found:
        raise InputError("the tree holds no tracks; give what fit() or track() returned")
    return found


def _order(components: list[str], mapping: Mapped) -> list[int]:
    """Where each entry of a Stone Soup state stands among the components of a fit."""
    dimension = sum(name in POSITION for name in components)
    if mapping is not None:
        entries = StateMapping(mapping, dimension).entries
        names = sorted(entries, key=lambda name: entries[name])
        for name in names:
            if name not in components:
                raise InputError(f'the tracks have no component "{name}"{nearest(name, components)}')
        return [components.index(name) for name in names]
    by_axis = [f"{part}_{axis}" for axis in AXES for part in ("position", "velocity", "acceleration")]
    first = [name for name in by_axis if name in components]
    return [components.index(name) for name in [*first, *(name for name in components if name not in first)]]


def from_tracks(tracks: Iterable[Any], *, start: datetime | None = None, mapping: Mapped = None) -> pd.DataFrame:
    """Stone Soup tracks, or true paths, as the table of `tracks`: time (s), target, a column a component and its sd.

    `Truth` and `Known` take it. Targets are called by the `target` of the track's metadata, or its id. `mapping` is
    that of `measurement_model`; by default a state of 2 or 3 numbers is a position, one of 4 or 6 position and velocity
    of each axis in turn. Time counts from `start`, by default the first state. Raises `InputError`.

    >>> import probcal.adapters as adapters
    >>> adapters.from_tracks([])
    Traceback (most recent call last):
    ...
    probcal.errors.InputError: there are no tracks with states; give those of a Stone Soup tracker
    """
    given = list(tracks)
    states = [state for own in given for state in own]
    if not states:
        raise InputError("there are no tracks with states; give those of a Stone Soup tracker")
    start = _datetime(start, None) or min(_stamp(state, "state") for state in states)
    rows = []
    for own in given:
        metadata = getattr(own, "metadata", None) or {}
        name = str(metadata.get("target") or own.id)
        for state in own:
            mean = state.mean if hasattr(state, "mean") else state.state_vector
            values = np.asarray(mean, float)[:, 0]
            entries = _entries(len(values), mapping)
            row: dict[str, Any] = {"time": _seconds(_stamp(state, "state"), start), "target": name}
            covar = getattr(state, "covar", None)
            sd = None if covar is None else np.sqrt(np.diag(np.asarray(covar, float)))
            for component, i in entries.items():
                row[component] = values[i]
                if sd is not None:
                    row[f"{component}_sd"] = sd[i]
            rows.append(row)
    frame = pd.DataFrame(rows).sort_values(["target", "time"], kind="stable").reset_index(drop=True)
    frame.attrs["start"] = start.isoformat()
    return frame


def _entries(size: int, mapping: Mapped) -> dict[str, int]:
    if mapping is None and size in (2, 3):
        mapping = tuple(range(size))
    elif mapping is None and size not in (4, 6):
        raise InputError(
            f'a state has {size} numbers; say what they are, as in mapping={{"position": (0, 2), "power": 4}}'
        )
    position = mapping["position"] if isinstance(mapping, Mapping) else mapping
    dimension = size // 2 if position is None else np.size(position)
    return StateMapping(mapping, int(dimension), size).entries
