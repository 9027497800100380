"""Nodes and placed sensors, and the table of biases that follows from them."""

from collections import Counter
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from probcal.clocks import CLOCK, by_clock
from probcal.detection import Detection
from probcal.errors import InputError, check_known
from probcal.geodesy import LocalFrame
from probcal.geometry import slopes
from probcal.labels import AXES, check_name
from probcal.noise import Heard
from probcal.sensor import Bias, Drift, Sensor, SensorType

POSE_UNITS = {
    "position": "m", "heading": "rad", "pitch": "rad", "roll": "rad", "clock": "m", "time_offset": "s",
    "time_rate": "1",
}  # fmt: skip
ANGLES = ("heading", "pitch", "roll")
MOVING = ("velocity", "acceleration", "heading_rate", "pitch_rate", "roll_rate", "time")  # of a path and its rows
TURN = 2 * np.pi  # rad of a heading, pitch or roll above which degrees were meant
Spread = float | Bias


@dataclass(frozen=True)
class Path:
    """Known path of a moving node, interpolated: times (T,) in s, positions (T, d) in m, angles (T,) in rad.

    >>> Path([0.0, 10.0], position=[(0.0, 0.0), (50.0, 0.0)]).time.tolist()
    [0.0, 10.0]
    """

    time: Any
    position: Any
    heading: Any = None
    pitch: Any = None
    roll: Any = None

    def __post_init__(self):
        time = np.asarray(self.time, float)
        position = np.asarray(self.position, float)
        given = {name: getattr(self, name) for name in ANGLES}
        angles = {
            name: np.zeros(len(time)) if value is None else np.unwrap(np.asarray(value, float))
            for name, value in given.items()
        }
        fits = [value.shape == time.shape for value in angles.values()]
        if time.ndim != 1 or position.shape[:1] != time.shape or position.ndim != 2 or not all(fits):
            raise InputError("Path: time has shape (T,), position (T, 2 or 3), heading, pitch and roll (T,)")
        if not all(np.isfinite(value).all() for value in (time, position, *angles.values())):
            raise InputError("Path: time, position and heading must be finite; drop the gaps")
        if not (np.diff(time) > 0).all():
            raise InputError("Path: time must increase")
        for name, value in {"time": time, "position": position, **angles}.items():
            object.__setattr__(self, name, value)

    def at(self, time: np.ndarray) -> dict[str, np.ndarray]:
        """Position and velocity (N, d), heading, pitch and roll and their rates (N,) at times (N,)."""

        def between(values: np.ndarray) -> np.ndarray:
            return np.stack([np.interp(time, self.time, column) for column in values.T], -1)

        moving = {"position": between(self.position), "velocity": between(slopes(self.time, self.position))}
        for name in ANGLES:
            angle = getattr(self, name)[:, None]
            moving |= {name: between(angle)[:, 0], f"{name}_rate": between(slopes(self.time, angle))[:, 0]}
        return moving


class Node:
    """A mast, a box in the grass, a robot: a stated pose and further components (`clock`, ...), some biased.

    position (d,) in m, heading (pitch, roll) in rad, or a known `path`; extras such as `gain=0.0` are numbers, or
    vectors (d,) where a sensor type declares them so (`vectors=("boresight",)`), with a bias an axis. `clock`
    is in m (time times speed). A row was measured at its stated time plus `time_offset` (s) plus `time_rate` (s per s)
    times the seconds since the first row of the table, or of the calibration that is applied to it. Targets and moving
    nodes are taken there, whatever the sensor's function reads; a sensor of several nodes has the clock of the first.
    `survey` and `scale` give standard deviations by component (a bare number means the position; a `Bias` may
    carry the unit of a clock or an extra, a drift or `zeros`): `survey` is how well the stated value is known,
    `scale` is governed by the prior chosen at the fit, neither means known. Raises `InputError` naming node and
    component.

    >>> node = Node("mast", (0.0, 40.0), survey={"position": 0.1}, scale={"heading": 0.05})
    >>> node.name
    'mast'
    """

    def __init__(
        self,
        name: str,
        position: Sequence[float] | np.ndarray | None = None,
        heading: float = 0.0,
        *,
        survey: Spread | Mapping[str, Spread] | None = None,
        scale: Spread | Mapping[str, Spread] | None = None,
        path: Path | None = None,
        **components: Any,
    ):
        self.name = str(name)
        check_name("a node", self.name)
        self.path = path
        if (position is None) == (path is None):
            raise InputError(f'node "{name}": give either position or path')
        stated = path.position[0] if path is not None else np.asarray(position, float)
        if stated.shape not in ((2,), (3,)) or not np.isfinite(stated).all():
            raise InputError(f'node "{name}": position must be 2 or 3 finite numbers, got {position!r}')
        self.position = stated
        own = dict.fromkeys(("heading", "pitch", "roll", "clock", *CLOCK), 0.0)
        self.components: dict[str, Any] = own | components
        self.components["heading"] = heading
        for vector in set(MOVING) & set(components):
            raise InputError(
                f'node "{name}": {vector} cannot be stated; it follows from path=Path(...) and the times of the rows'
            )
        for component, value in self.components.items():
            check_name(f'node "{name}": a component', component)
            if np.shape(value) == stated.shape and component not in own:
                self.components[component] = np.asarray(value, float)
            if np.shape(value) not in ((), () if component in own else stated.shape) or not np.isfinite(value).all():
                raise InputError(
                    f'node "{name}": {component} must be a finite number, got {value!r}'
                    + ("" if component in own else f", or {len(stated)} of them, one an axis")
                )
            if component in ANGLES and abs(value) > TURN:
                raise InputError(
                    f'node "{name}": {component} is {value:g} rad, more than a turn; give radians, as in'
                    f" np.deg2rad({value:g})"
                )
        self.spread: dict[str, tuple[str, Bias]] = {}
        # standard deviations by axis, where these differ
        self.sizes: dict[str, tuple[float, ...]] = {}
        for kind, given in (("survey", survey), ("scale", scale)):
            entries = given if isinstance(given, Mapping) else {} if given is None else {"position": given}
            for component, value in entries.items():
                self._add(kind, component, value)

    def _add(self, kind: str, component: str, value: Spread) -> None:
        known = ["position", *self.components]
        check_known(component, known, f'node "{self.name}": {kind} names "{component}"')
        if component in ("pitch", "roll") and self.dimension == 2:
            raise InputError(f'node "{self.name}": {component} has no meaning in 2-D')
        if component in self.spread:
            raise InputError(f'node "{self.name}": {component} has both survey and scale; give one')
        if not isinstance(value, Bias):
            number = float(value)
            if not (np.isfinite(number) and number > 0):
                raise InputError(
                    f'node "{self.name}": {kind} of {component} is {number:g}: it must be positive;'
                    f" leave it out where the stated value is known"
                )
            value = Bias(POSE_UNITS.get(component, "1"), number)
        unit = POSE_UNITS.get(component)
        if component != "clock" and unit is not None and value.unit != unit:
            raise InputError(f'node "{self.name}": {kind} of {component} is in "{value.unit}"; give it in {unit}')
        if component in ANGLES and value.scale > TURN / 2:
            raise InputError(
                f'node "{self.name}": {kind} of {component} is {value.scale:g} rad, more than half a turn;'
                f" give radians, as in np.deg2rad({value.scale:g})"
            )
        if kind == "survey" and value.zeros != "expected":
            raise InputError(
                f'node "{self.name}": a survey of {component} takes no zeros, it is Gaussian under every prior;'
                " give the Bias as scale"
            )
        if value.nominal or value.shared:
            raise InputError(f'node "{self.name}": {component} takes no nominal or shared; state the value instead')
        self.spread[component] = (kind, value)

    @property
    def dimension(self) -> int:
        """Number of coordinates."""
        return len(self.position)

    @property
    def clocked(self) -> bool:
        """True where its rows may have been measured at another time than the stated one."""
        return any(name in self.spread or self.components[name] for name in CLOCK)

    def labels(self, component: str) -> list[str]:
        """Labels of the biases of a component, one per axis where it has axes."""
        value = self.position if component == "position" else self.components[component]
        axes = [f"_{axis}" for axis in AXES[: self.dimension]] if np.ndim(value) else [""]
        return [f"{self.name}.{component}{axis}" for axis in axes]

    def spreads(self, component: str) -> tuple[float, ...]:
        """Standard deviations of the biases of a component, one per axis where it has axes."""
        return self.sizes.get(component, (self.spread[component][1].scale,) * len(self.labels(component)))

    def surveyed(self, values: Mapping[str, tuple[float, float]]) -> "Node":
        """This node with other stated values, as (value, sd) by the label of a bias; each sd is a
        survey."""
        node = copy(self)
        node.components, node.spread, node.sizes = dict(self.components), dict(self.spread), dict(self.sizes)
        for component, (_, bias) in self.spread.items():
            labels = self.labels(component)
            if not any(label in values for label in labels):
                continue
            own = self.position if component == "position" else np.atleast_1d(self.components[component])
            stated = np.array([values[k][0] if k in values else v for k, v in zip(labels, own, strict=True)])
            sds = [values[k][1] if k in values else s for k, s in zip(labels, self.spreads(component), strict=True)]
            node.spread[component] = ("survey", replace(bias, scale=max(sds)))
            node.sizes[component] = tuple(sds)
            if component != "position":
                node.components[component] = stated if len(labels) > 1 else float(stated[0])
                continue
            node.position = stated
            if self.path is not None:
                node.path = replace(self.path, position=self.path.position + (stated - self.position))
        return node

    @property
    def numbers(self) -> dict[str, float]:
        """The components as numbers, a vector once for each axis (`boresight_x`)."""
        found: dict[str, float] = {}
        for name, value in self.components.items():
            axes = [name] if np.ndim(value) == 0 else [f"{name}_{axis}" for axis in AXES[: len(value)]]
            found |= dict(zip(axes, np.atleast_1d(value).tolist(), strict=True))
        return found


@dataclass(frozen=True)
class BiasRecord:
    """One bias of the network: label, unit, scale, what governs it (`survey`, `scale`, `drift`) and where it lives.

    A step of a drifting bias has the time at which it happens, and the component `<component>_step`.
    """

    label: str
    unit: str
    scale: float
    nominal: float
    kind: str
    owner: str
    component: str
    axis: int = 0
    since: float | None = None  # time of a step
    vector: bool = False  # whether the component has one value an axis
    sensor_type: str = ""  # none where it is a bias of a node
    zeros: str = "expected"  # how a sparse prior treats its kind: `Bias.zeros`

    def steps(self, drift: Drift | None) -> list["BiasRecord"]:
        """The steps of this bias in order of time."""
        return [
            replace(
                self,
                label=f"{self.label}@{np.format_float_positional(time, precision=3, trim='-')}",
                scale=size, nominal=0.0, kind="drift" if drift.scale is None else "scale",
                component=f"{self.component}_step", since=time, zeros="expected",
            )
            for time, size in drift.steps
        ] if drift else []  # fmt: skip


class Network:
    """Placed sensors with their nodes; the biases follow, in the order of nodes, then sensors.

    `frame` is the `LocalFrame` of the coordinates where they come from latitude and longitude (that of `read_nodes`):
    maps then show meridians and parallels. Raises `InputError` for names used twice, mixed dimensions, or a biased
    component that no sensor reads.

    >>> from probcal.sensors import radar
    >>> Network([radar.on(Node("mast", (0.0, 40.0), scale={"heading": 0.05}))]).labels[0]
    'mast.heading'
    """

    def __init__(self, sensors: Sequence[Sensor], *, frame: LocalFrame | None = None):
        self.sensors, self.frame = tuple(sensors), frame
        if not isinstance(frame, LocalFrame | None):
            raise InputError(f"Network: frame is {frame!r}; give a LocalFrame(latitude, longitude)")
        if not self.sensors:
            raise InputError("the network has no sensor; place some with sensor_type.on(node)")
        for placed in self.sensors:
            if not isinstance(placed, Sensor):
                raise InputError(f"the network holds {placed!r}; place a sensor with sensor_type.on(node)")
        self.nodes = self._collect_nodes()
        late = {placed.type for placed in self.sensors if placed.nodes[0].clocked}
        if late:
            moving = any(node.path is not None for node in self.nodes)
            kinds = {kind: by_clock(kind, moving=moving) for kind in late}
            self.sensors = tuple(replace(s, type=kinds.get(s.type, s.type)) for s in self.sensors)
        self.types: tuple[SensorType, ...] = tuple(dict.fromkeys(s.type for s in self.sensors))
        self._check_names()
        self.dimension = self.nodes[0].dimension
        for node in self.nodes:
            if node.dimension != self.dimension:
                raise InputError(
                    f'node "{node.name}" is {node.dimension}-D, node "{self.nodes[0].name}" {self.dimension}-D'
                )
        for kind in self.types:
            if self.dimension not in kind.dimensions:
                raise InputError(
                    f"sensor {kind.name} works in {kind.dimensions[0]}-D only, the network is {self.dimension}-D"
                )
        self.biases = tuple(self._node_biases() + self._sensor_biases())
        for label, count in Counter(bias.label for bias in self.biases).items():
            if count > 1:
                raise InputError(f'two biases are called "{label}"; give node, sensor and bias names that differ')
        self._steps: dict[tuple[str, str, int], tuple[BiasRecord, ...]] = {}
        for bias in self.biases:
            if bias.since is not None:
                key = (bias.owner, bias.component, bias.axis)
                self._steps[key] = (*self._steps.get(key, ()), bias)

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of all biases."""
        return tuple(bias.label for bias in self.biases)

    def steps(self, owner: str, component: str, axis: int = 0) -> tuple[BiasRecord, ...]:
        """Steps of a drifting bias in order of time, none where it is constant."""
        return self._steps.get((owner, f"{component}_step", axis), ())

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Scalar channels of all sensor types, each once."""
        return tuple(dict.fromkeys(name for t in self.types for name, _ in t.expand(self.dimension)))

    def with_detections(self, detections: Mapping[str, Detection]) -> "Network":
        """The same network, some sensors by name with other detection."""
        sensors = [replace(s, detection=detections.get(s.name, s.detection)) for s in self.sensors]
        return Network(sensors, frame=self.frame)

    def surveyed(self, values: Mapping[str, tuple[float, float]]) -> "Network":
        """The same network with other stated values, as (value, sd) by the label of a bias; each sd
        is a survey.

        A bias that is not among them stays as it is declared, and so do the steps of a drifting
        one.
        """
        nodes = {node.name: node.surveyed(values) for node in self.nodes}
        sensors = []
        for placed in self.sensors:
            known = dict(placed.known)
            for name, bias in placed.type.biases.items():
                label = f"{placed.type.name if bias.shared else placed.name}.{name}"
                if label in values:
                    known[name] = replace(bias, nominal=values[label][0], scale=values[label][1])
            sensors.append(replace(placed, nodes=tuple(nodes[node.name] for node in placed.nodes), known=known))
        return Network(sensors, frame=self.frame)

    @property
    def stated(self) -> dict[str, float]:
        """The value from which a bias counts, by its label: the nominal one of a sensor, the stated one of a node."""
        found = {bias.label: bias.nominal for bias in self.biases if bias.sensor_type and bias.since is None}
        for node in self.nodes:
            for name, value in {"position": node.position, **node.components}.items():
                found |= dict(zip(node.labels(name), np.atleast_1d(value).tolist(), strict=True))
        return found

    def with_floors(self, floors: Mapping[tuple[int, str], float]) -> "Network":
        """This network with floors of what is heard, by number of the sensor type and channel; itself without any."""
        if not floors:
            return self
        types = {}
        for k, kind in enumerate(self.types):
            channels = dict(kind.channels)
            for name, channel in kind.channels.items():
                axes = [f"{name}_{axis}" for axis in AXES] if channel.per_axis else [name]
                own = [floors[k, axis] for axis in axes if (k, axis) in floors]
                if own and isinstance(channel.noise, Heard):
                    channels[name] = replace(channel, noise=channel.noise.at(min(own)))
            types[kind] = replace(kind, channels=channels)
        return Network([replace(placed, type=types[placed.type]) for placed in self.sensors], frame=self.frame)

    def _collect_nodes(self) -> tuple[Node, ...]:
        nodes: dict[str, Node] = {}
        for placed in self.sensors:
            for node in placed.nodes:
                if not isinstance(node, Node):
                    raise InputError(f'sensor "{placed.name}" is placed on {node!r}; place it on a Node')
                if nodes.setdefault(node.name, node) is not node:
                    raise InputError(f'two nodes are called "{node.name}"')
        return tuple(nodes.values())

    def _check_names(self) -> None:
        seen: dict[str, Sensor] = {}
        for placed in self.sensors:
            if placed.name in seen:
                raise InputError(f'two sensors are called "{placed.name}"; place one with .on(node, name="...")')
            seen[placed.name] = placed
        for node in self.nodes:
            if node.name in seen and node not in seen[node.name].nodes:
                raise InputError(f'"{node.name}" is the name of a node and of a sensor elsewhere; rename one')
        for kind in self.types:
            if [other.name for other in self.types].count(kind.name) > 1:
                raise InputError(f'two sensor types are called "{kind.name}"; rename one of the functions')
            if kind.name in seen or kind.name in {node.name for node in self.nodes}:
                raise InputError(f'"{kind.name}" is the name of a sensor type; rename the node or sensor')

    def _node_biases(self) -> list[BiasRecord]:
        records: list[BiasRecord] = []
        users: dict[str, set[str]] = {}
        for placed in self.sensors:
            for k, node in enumerate(placed.nodes):
                other = {*CLOCK} if placed.type.clocked and k else set[str]()
                users.setdefault(node.name, set()).update(placed.type.pose_components - other)
        for node in self.nodes:
            read = users[node.name]
            for component, (kind, bias) in node.spread.items():
                if component not in read:
                    raise InputError(f'node "{node.name}": {component} has a {kind}, but none of its sensors reads it')
                labels, vector = node.labels(component), component == "position"
                vector = vector or np.ndim(node.components[component]) > 0
                for axis, (label, scale) in enumerate(zip(labels, node.spreads(component), strict=True)):
                    record = BiasRecord(
                        label, bias.unit, scale, 0.0, kind, node.name, component, axis, vector=vector, zeros=bias.zeros
                    )
                    records += [record, *record.steps(bias.drift)]
        return records

    def _sensor_biases(self) -> list[BiasRecord]:
        records: dict[str, BiasRecord] = {}
        for placed in self.sensors:
            for name, declared in placed.type.biases.items():
                owner = placed.type.name if declared.shared else placed.name
                bias, kind = placed.known.get(name, declared), "survey" if name in placed.known else "scale"
                record = BiasRecord(
                    f"{owner}.{name}", bias.unit, bias.scale, bias.nominal, kind, owner, name,
                    sensor_type=placed.type.name, zeros=bias.zeros,
                )  # fmt: skip
                records |= {r.label: r for r in (record, *record.steps(bias.drift))}
        return list(records.values())
