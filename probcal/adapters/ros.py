"""Bags of ROS 1 and ROS 2 through rosbags, without ROS (`probcal[ros]`)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from probcal.adapters.shared import SECOND, check_frame, extra, since
from probcal.errors import InputError, nearest
from probcal.files import AnyPath
from probcal.geodesy import LocalFrame
from probcal.lazy import pd
from probcal.table import UNITS, split_header

LOCAL = ("local_x", "local_y", "local_z")  # of a NavSatFix, in the frame
TURNS = ("yaw", "pitch", "roll")  # of a quaternion
STANDARD = {  # units of the fields of common messages, by type and the beginning of a path
    "sensor_msgs/msg/Range": {"": "m", "field_of_view": "rad"},
    "sensor_msgs/msg/NavSatFix": {"latitude": "deg", "longitude": "deg", "altitude": "m", "local_": "m"},
    "geometry_msgs/msg/PointStamped": {"point": "m"},
    "geometry_msgs/msg/PoseStamped": {"pose.position": "m", "pose.orientation": "rad"},
    "geometry_msgs/msg/PoseWithCovarianceStamped": {"pose.pose.position": "m", "pose.pose.orientation": "rad"},
    "geometry_msgs/msg/TwistStamped": {"twist.linear": "m/s"},
    "nav_msgs/msg/Odometry": {
        "pose.pose.position": "m", "pose.pose.orientation": "rad", "twist.twist.linear": "m/s",
    },
    "sensor_msgs/msg/MagneticField": {"magnetic_field": "T"},
}  # fmt: skip


@dataclass(frozen=True)
class FromField:
    """The path of a field of a message that names the sensor or target of its row: `FromField("anchor_id")`."""

    path: str


@dataclass(frozen=True)
class Topic:
    """The contents of a topic: each message is a row of a sensor, perhaps a target, and channels.

    `channels` maps the columns of the table to fields of the message, `{"range": "range"}`, with dots and indices
    (`pose.pose.position.x`, `ranges[0]`). A column may state the unit of its field, `"azimuth [deg]"`; those of common
    messages are known, and converted to the unit of the column. A quaternion has yaw, pitch (nose up) and roll in rad
    besides; a NavSatFix `local_x`, `local_y` and `local_z` in m of the frame. `sensor` and `target` are names, or a
    `FromField` of the message. With a `frame_id` every header must have it. `time` is "header", or "received" for when
    the bag got the message.

    >>> Topic("anchor_0", {"range": "range"}, target="rover").time
    'header'
    """

    sensor: str | FromField
    channels: Mapping[str, str]
    target: str | FromField | None = None
    frame_id: str | None = None
    time: str = "header"

    def __post_init__(self):
        if not isinstance(self.channels, Mapping) or not self.channels:
            raise InputError(f'Topic: channels is {self.channels!r}; map columns to fields, as in {{"range": "range"}}')
        if self.time not in ("header", "received"):
            raise InputError(f'Topic: time is {self.time!r}; give "header" or "received"')


def read_bag(
    path: AnyPath,
    topics: Mapping[str, Topic],
    *,
    frame: LocalFrame | None = None,
    types: Mapping[str, str] | None = None,
    distribution: str | None = None,
    start: Any = None,
) -> pd.DataFrame:
    """Messages of a ROS bag as a table: time (s), sensor, target where stated, and a column a channel.

    `path` is a bag of ROS 1 (.bag) or the folder of one of ROS 2 (sqlite3 or mcap). `topics` maps the name of each to
    its `Topic`. `frame` takes latitude and longitude (`local_x`, ...) to metres. Custom messages are known
    where the bag defines them; else give `types`, the text of their .msg files by name (`{"uwb_msgs/msg/Range":
    "float64 range"}`), and where it does not define even the standard ones the `distribution` ("humble"). Values that
    are not finite, fixes without a solution, and ranges beyond what their message says the sensor measures are blank;
    rows without a value are left out and counted in `.attrs["left_out"]`. `.attrs["start"]` is the instant of time 0,
    the first message or `start`. Raises `InputError` naming topic and the nearest right name.

    >>> import probcal.adapters as adapters
    >>> adapters.read_bag("none.bag", {"/range": adapters.Topic("anchor_0", {"range": "range"})})
    Traceback (most recent call last):
    ...
    probcal.errors.InputError: none.bag: no such file
    """
    path = Path(path)
    if frame is not None:
        check_frame("read_bag", frame)
    if not topics or not all(isinstance(topic, Topic) for topic in topics.values()):
        raise InputError("read_bag: topics maps each topic to read to what it holds, Topic(sensor, channels)")
    if not path.exists():
        raise InputError(f"{path}: no such file")
    rows: list[dict[str, Any]] = []
    reading = _Reading(topics, frame)
    with _opened(path, types, distribution) as bag:
        there = {connection.topic: str(connection.msgtype) for connection in bag.connections}
        for name in topics:
            if name not in there:
                raise InputError(f'{path.name} has no topic "{name}"{nearest(name, there)}')
        wanted = [connection for connection in bag.connections if connection.topic in topics]
        for connection, received, raw in _messages(bag, wanted, path):
            message = _deserialised(bag, raw, connection, path)
            rows += reading.row(connection.topic, str(connection.msgtype), message, received)
    if not rows:
        raise InputError(f"{path.name}: its topics {', '.join(topics)} hold no value that can be read")
    table = pd.DataFrame(rows)
    time, zero = since(table.pop("stamp").to_numpy(np.int64), start)
    first = [name for name in ("sensor", "target") if name in table]
    table = table.reindex(columns=[*first, *reading.columns])
    table.insert(0, "time", time)
    table = table.sort_values("time", kind="stable").reset_index(drop=True)
    table.attrs = {"start": zero, "left_out": reading.left}
    return table


@contextmanager
def _opened(path: Path, types: Mapping[str, str] | None, distribution: str | None) -> Iterator[Any]:
    """An open bag."""
    highlevel = extra("rosbags.highlevel", "reading ROS bags", "ros")
    typesys = extra("rosbags.typesys", "reading ROS bags", "ros")
    names = {store.value: store for store in typesys.Stores if store.value != "empty"}
    short = {name.rpartition("_")[2]: store for name, store in names.items()}
    chosen = "humble" if distribution is None else distribution.lower().rpartition("_")[2]
    if chosen not in short:
        raise InputError(f'read_bag: distribution is "{distribution}"{nearest(chosen, short)}')
    store = typesys.get_typestore(short[chosen])
    try:
        for name, text in (types or {}).items():
            store.register(typesys.get_types_from_msg(text, _full(name)))
    except Exception as error:  # a parser of grammars says what it likes
        raise InputError(f"read_bag: types of {name} is no text of a .msg file: {_said(error)}") from None
    try:
        bag = highlevel.AnyReader([path], default_typestore=store)
        bag.open()
    except Exception as error:  # rosbags, sqlite3, yaml and struct on foreign bytes
        raise InputError(f"{path.name} is no ROS bag that can be read: {_said(error)}") from None
    try:
        yield bag
    finally:
        bag.close()


def _said(error: Exception) -> str:
    """The message of an error, or the name of its type where the message is empty."""
    return str(error) or type(error).__name__


def _full(name: str) -> str:
    """The name of a message type with /msg/ in it."""
    return name if "/msg/" in name else name.replace("/", "/msg/", 1)


def _messages(bag: Any, connections: list[Any], path: Path) -> Iterator[tuple[Any, int, bytes]]:
    try:
        yield from bag.messages(connections=connections)
    except InputError:
        raise
    except Exception as error:  # as above, in the middle of a file
        raise InputError(f"{path.name} is damaged: {_said(error)}") from None


def _deserialised(bag: Any, raw: bytes, connection: Any, path: Path) -> Any:
    try:
        return bag.deserialize(raw, connection.msgtype)
    except Exception as error:
        raise InputError(
            f'{path.name} topic "{connection.topic}": {connection.msgtype} cannot be decoded ({_said(error)}); give'
            " types= with the text of its .msg file"
        ) from None


class _Reading:
    """Turns messages into rows, and checks the first of each topic."""

    def __init__(self, topics: Mapping[str, Topic], frame: LocalFrame | None):
        self.topics, self.frame = topics, frame
        self.units: dict[str, str | None] = {}  # of each column, by its name
        self.factors: dict[tuple[str, str], float] = {}  # to the unit of the column, by topic and column
        self.left = {"without a value": 0}
        self._checked: set[str] = set()
        self._count: dict[str, int] = {}

    @property
    def columns(self) -> list[str]:
        """Columns of the channels, with their units."""
        named = [split_header(column)[0] for topic in self.topics.values() for column in topic.channels]
        return [self._header(name) for name in dict.fromkeys(named) if name in self.units]

    def _header(self, name: str) -> str:
        unit = self.units[name]
        return name if unit is None else f"{name} [{unit}]"

    def row(self, name: str, kind: str, message: Any, received: int) -> list[dict[str, Any]]:
        """The row of a message, none where it holds no value."""
        topic = self.topics[name]
        if name not in self._checked:
            self._units(name, topic, kind)
            self._checked.add(name)
        n = self._count[name] = self._count.get(name, -1) + 1
        stamp = self._stamp(name, topic, message, received, n)
        found: dict[str, Any] = {"stamp": stamp, "sensor": self._name(name, topic.sensor, message)}
        if topic.target is not None:
            found["target"] = self._name(name, topic.target, message)
        values = {}
        for column, path in topic.channels.items():
            value = self._value(name, kind, message, path)
            label, _ = split_header(column)
            if np.isfinite(value):
                values[self._header(label)] = value * self.factors[name, column]
        if not values:
            self.left["without a value"] += 1
            return []
        return [found | values]

    def _units(self, name: str, topic: Topic, kind: str) -> None:
        """Check the units that a topic states, and what takes each field to the unit of its column."""
        for column, path in topic.channels.items():
            label, stated = split_header(column)
            if not label:
                raise InputError(f'topic "{name}": write the column "{column}" as name or name [unit]')
            if stated is not None and stated not in UNITS:
                raise InputError(f'topic "{name}": the unit "{stated}" of {label} is not known{nearest(stated, UNITS)}')
            known = _standard(kind, path)
            if stated is not None and known is not None and UNITS[stated][0] != UNITS[known][0]:
                raise InputError(
                    f'topic "{name}": {path} of {kind} is in {known}, which is no {stated}; write [{known}]'
                )
            unit = known if known is not None else stated  # what a common message says of itself counts
            wanted = self.units.setdefault(label, stated or unit)
            if wanted is not None and unit is not None and UNITS[wanted][0] != UNITS[unit][0]:
                raise InputError(
                    f'topic "{name}": {label} is in {unit} here and in {wanted} in another topic; call them differently'
                )
            if (wanted is None) != (unit is None):
                raise InputError(
                    f'topic "{name}": the unit of {label} is stated in one topic only; write "{label} [unit]" in each'
                )
            self.factors[name, column] = 1.0 if wanted is None or unit is None else UNITS[unit][1] / UNITS[wanted][1]

    def _stamp(self, name: str, topic: Topic, message: Any, received: int, n: int) -> int:
        """Instant of a message in ns."""
        header = getattr(message, "header", None)
        if topic.frame_id is not None:
            found = getattr(header, "frame_id", None)
            if found != topic.frame_id:
                shown = "no header" if found is None else f'frame_id "{found}"'
                raise InputError(f'topic "{name}" message {n}: it has {shown}, not "{topic.frame_id}"')
        if topic.time == "received" or header is None:
            return int(received)
        stamp = int(header.stamp.sec) * SECOND + int(header.stamp.nanosec)
        if stamp == 0:
            raise InputError(f'topic "{name}" message {n}: its header has no time; give Topic(..., time="received")')
        return stamp

    def _name(self, name: str, given: str | FromField, message: Any) -> str:
        if not isinstance(given, FromField):
            return str(given)
        found = _follow(name, message, given.path)
        if isinstance(found, np.ndarray) or hasattr(found, "__msgtype__"):
            raise InputError(f'topic "{name}": the field "{given.path}" is no name')
        return str(found)

    def _value(self, name: str, kind: str, message: Any, path: str) -> float:
        if path in LOCAL and kind.endswith("/NavSatFix"):
            return self._local(name, message)[LOCAL.index(path)]
        if kind.endswith("/NavSatFix") and message.status.status < 0:
            return np.nan
        found = _follow(name, message, path)
        if not isinstance(found, (int, float, np.number)) or isinstance(found, bool):
            inner = _inside(found)
            hint = f"; take one of {', '.join(f'{path}.{part}' for part in inner)}" if inner else ""
            raise InputError(f'topic "{name}": the field "{path}" is no number{hint}')
        value = float(found)
        if kind.endswith("/Range") and path == "range" and hasattr(message, "max_range"):
            low, high = float(message.min_range), float(message.max_range)
            if low < high and not low <= value <= high:
                return np.nan
        return value

    def _local(self, name: str, message: Any) -> list[float]:
        """Position in the frame of a fix, NaN where it has none."""
        if self.frame is None:
            raise InputError(f'topic "{name}": local_x, local_y and local_z need frame=LocalFrame(latitude, longitude)')
        flat = "local_z" not in self.topics[name].channels.values()
        place = [float(message.latitude), float(message.longitude), *([] if flat else [float(message.altitude)])]
        if message.status.status < 0 or not np.isfinite(place).all():
            return [np.nan] * 3
        try:
            return [*self.frame.to_local(*place).tolist(), np.nan][:3]
        except InputError as error:
            raise InputError(f'topic "{name}": {error}') from None


def _standard(kind: str, path: str) -> str | None:
    """Unit of a field of a common message."""
    fields = STANDARD.get(kind, {})
    hits = [begin for begin in fields if path.startswith(begin)]
    return fields[max(hits, key=len)] if hits else None


def _inside(message: Any) -> list[str]:
    """Names of the fields of a message."""
    return [name for name in getattr(message, "__dataclass_fields__", {}) if not name.startswith("__")]


def _follow(topic: str, message: Any, path: str) -> Any:
    """The value at a path of a message, `pose.position.x` or `ranges[0]`."""
    found, parts = message, _parts(path)
    for k, part in enumerate(parts):
        if isinstance(part, int):
            if not hasattr(found, "__len__") or not -len(found) <= part < len(found):
                size = len(found) if hasattr(found, "__len__") else 0
                raise InputError(f'topic "{topic}": "{path}" asks for element {part} of {size}')
            found = found[part]
        elif part in TURNS and not hasattr(found, part) and {"x", "y", "z", "w"} <= set(_inside(found)):
            found = _turns(found)[TURNS.index(part)]
        elif part in _inside(found):
            found = getattr(found, part)
        else:
            known = [*_inside(found), *(TURNS if "w" in _inside(found) else ()), *(LOCAL if _is_fix(found) else ())]
            owner = ".".join(str(p) for p in parts[:k]) or "its messages"
            raise InputError(f'topic "{topic}": {owner} has no field "{part}"{nearest(part, known)}')
    return found


def _is_fix(message: Any) -> bool:
    return str(getattr(message, "__msgtype__", "")).endswith("/NavSatFix")


def _parts(path: str) -> list[Any]:
    """Names and indices of a path."""
    found: list[Any] = []
    for piece in path.split("."):
        name, *indices = piece.split("[")
        found += [name] if name else []
        for index in indices:
            number = index.rstrip("]")
            if not number.lstrip("-").isdigit():
                raise InputError(f'the field "{path}" has no index that is a number; write ranges[0]')
            found.append(int(number))
    return found


def _turns(q: Any) -> tuple[float, float, float]:
    """Heading, pitch (nose up) and roll of a quaternion, as a node has them."""
    x, y, z, w = (float(part) for part in (q.x, q.y, q.z, q.w))
    size = x * x + y * y + z * z + w * w
    if not size > 0:
        return np.nan, np.nan, np.nan
    yaw = np.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)
    nose = np.arcsin(np.clip(2 * (x * z - w * y) / size, -1.0, 1.0))  # the third component of the x axis
    roll = np.arctan2(2 * (w * x + y * z), w * w - x * x - y * y + z * z)
    return float(yaw), float(nose), float(roll)
