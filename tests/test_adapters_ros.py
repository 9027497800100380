"""ROS bags written here, of ROS 1 and ROS 2, and read into the table."""

import shutil
import sqlite3

import numpy as np
import pytest

import probcal
from probcal import Bias, Channel, InputError, LocalFrame, Network, Node, adapters, sensor, sensors
from probcal.adapters import FromField, Topic
from probcal.geometry import norm
from probcal.table import measure

pytest.importorskip("rosbags")
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

UWB = "uwb_msgs/msg/Ranging"
TEXT = "std_msgs/Header header\nuint8 anchor\nstring tag\nfloat64 range_mm\nfloat64[] powers\n"
BEGIN = 1_714_564_800  # s
HOME = LocalFrame(48.1, 11.6, 500.0)
KINDS = ["ros1", "sqlite3", "mcap"]
HALF = np.sqrt(0.5)


def store_of(kind):
    store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(TEXT, UWB))
    return store


class Made:
    """Messages of a store by type name, with a header."""

    def __init__(self, kind):
        self.kind, self.store = kind, store_of(kind)

    def __call__(self, name, **fields):
        return self.store.types[name](**fields)

    def header(self, time, frame_id):
        sec, nanosec = divmod(BEGIN * 10**9 + round(time * 1e9), 10**9)
        stamp = self("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        return self(
            "std_msgs/msg/Header", stamp=stamp, frame_id=frame_id, **({"seq": 0} if self.kind == "ros1" else {})
        )

    def point(self, x, y, z):
        return self("geometry_msgs/msg/Point", x=x, y=y, z=z)

    def pose(self, place, turn):
        quaternion = self("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", turn, strict=True)))
        return self("geometry_msgs/msg/Pose", position=self.point(*place), orientation=quaternion)

    def range(self, time, value, frame_id="anchor_0"):
        return "sensor_msgs/msg/Range", self(
            "sensor_msgs/msg/Range", header=self.header(time, frame_id), radiation_type=0, field_of_view=0.1,
            min_range=0.2, max_range=50.0, range=value,
        )  # fmt: skip

    def fix(self, time, latitude, longitude, altitude, status=0):
        return "sensor_msgs/msg/NavSatFix", self(
            "sensor_msgs/msg/NavSatFix", header=self.header(time, "gps"),
            status=self("sensor_msgs/msg/NavSatStatus", status=status, service=1), latitude=latitude,
            longitude=longitude, altitude=altitude, position_covariance=np.zeros(9), position_covariance_type=0,
        )  # fmt: skip

    def stamped(self, time, place, turn):
        return "geometry_msgs/msg/PoseStamped", self(
            "geometry_msgs/msg/PoseStamped", header=self.header(time, "map"), pose=self.pose(place, turn)
        )

    def odometry(self, time, place, speed):
        zero = self("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
        linear = self("geometry_msgs/msg/Vector3", x=speed, y=0.0, z=0.0)
        pose = self(
            "geometry_msgs/msg/PoseWithCovariance", pose=self.pose(place, (0, 0, 0, 1)), covariance=np.zeros(36)
        )
        twist = self("geometry_msgs/msg/Twist", linear=linear, angular=zero)
        return "nav_msgs/msg/Odometry", self(
            "nav_msgs/msg/Odometry", header=self.header(time, "odom"), child_frame_id="base", pose=pose,
            twist=self("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
        )  # fmt: skip

    def uwb(self, time, anchor, value):
        return UWB, self(
            UWB, header=self.header(time, "tag"), anchor=anchor, tag="rover", range_mm=value,
            powers=np.array([-80.0, -90.0]),
        )  # fmt: skip

    def number(self, value):
        return "std_msgs/msg/Float64", self("std_msgs/msg/Float64", data=value)


def write(folder, kind, messages):
    """A bag of (topic, seconds of reception, (type, message)) with the time of BEGIN."""
    made = Made(kind)
    path = folder / ("bag.bag" if kind == "ros1" else kind)
    plugin = {} if kind == "ros1" else {"version": 9, "storage_plugin": StoragePlugin[kind.upper()]}
    with (Writer1 if kind == "ros1" else Writer2)(path, **plugin) as writer:
        connections = {}
        for topic, received, (name, message) in messages(made):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=made.store)
            serialise = made.store.serialize_ros1 if kind == "ros1" else made.store.serialize_cdr
            writer.write(connections[topic], BEGIN * 10**9 + round(received * 1e9), serialise(message, name))
    return path


def drive(made):
    """What a rover heard: ranges of an anchor and its UWB, fixes, poses, odometry, and levels without a header."""
    yield from (("/range", k + 0.05, made.range(k, value)) for k, value in enumerate([12.5, np.inf, 0.1, 49.0]))
    yield from (("/uwb", k + 0.55, made.uwb(k + 0.5, k % 2, 10000.0 + k)) for k in range(3))
    yield "/fix", 0.3, made.fix(0.25, 48.1, 11.6, 500.0)
    yield "/fix", 1.3, made.fix(1.25, 48.101, 11.6, 510.0)
    yield "/fix", 2.3, made.fix(2.25, np.nan, np.nan, np.nan, status=-1)
    yield "/pose", 0.2, made.stamped(0.125, (1.0, 2.0, 3.0), (0.0, 0.0, HALF, HALF))
    yield "/pose", 1.2, made.stamped(1.125, (1.5, 2.0, 3.0), (0.0, -HALF, 0.0, HALF))
    yield "/pose", 2.2, made.stamped(2.125, (2.0, 2.0, 3.0), (0.5, 0.0, 0.0, np.sqrt(0.75)))
    yield "/odom", 0.7, made.odometry(0.6, (7.0, 8.0, 0.0), 1.5)
    yield "/level", 0.75, made.number(-77.0)


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bags")
    return {kind: write(folder, kind, drive) for kind in KINDS}


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_is_read_into_the_table(bags, kind):
    topics = {
        "/range": Topic("anchor_9", {"range": "range"}, target="rover", frame_id="anchor_0"),
        "/uwb": Topic(FromField("anchor"), {"range [mm]": "range_mm", "level": "powers[-1]"}, target=FromField("tag")),
        "/level": Topic("mic", {"level": "data"}, target="rover"),
    }
    frame = adapters.read_bag(bags[kind], topics)
    assert frame.columns.tolist() == ["time", "sensor", "target", "range [m]", "level"]
    assert frame["time"].tolist() == [0.0, 0.5, 0.75, 1.5, 2.5, 3.0]
    assert frame["sensor"].tolist() == ["anchor_9", "0", "mic", "1", "0", "anchor_9"]
    assert set(frame["target"]) == {"rover"}
    np.testing.assert_allclose(frame["range [m]"], [12.5, 10.0, np.nan, 10.001, 10.002, 49.0], atol=1e-6)
    assert frame["level"].tolist()[1:3] == [-90.0, -77.0]
    assert frame.attrs == {"start": "2024-05-01T12:00:00+00:00", "left_out": {"without a value": 2}}  # inf, too near

    @sensor(range=Channel("cm", std=5.0))
    def uwb(target, pose, *, offset=Bias("cm", 5.0)):
        return dict(range=100 * norm(target.position - pose.position) + offset)

    network = Network([uwb.on(Node(name, (0.0, 0.0))) for name in ("anchor_9", "0", "1")])
    rows = measure(probcal.read_table(frame.dropna(subset="range [m]").drop(columns="level")), network)
    np.testing.assert_allclose(rows.value[:, 0], [1250.0, 1000.0, 1000.1, 1000.2, 4900.0], atol=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_places_and_attitudes(bags, kind):
    place = {f"position_{axis}": f"pose.position.{axis}" for axis in "xyz"}
    turns = {
        name: f"pose.orientation.{part}" for name, part in (("heading", "yaw"), ("nose", "pitch"), ("side", "roll"))
    }
    frame = adapters.read_bag(bags[kind], {"/pose": Topic("slam", place | turns)}, start=BEGIN)
    assert frame["time"].tolist() == [0.125, 1.125, 2.125]
    assert frame["position_x [m]"].tolist() == [1.0, 1.5, 2.0]
    assert "target" not in frame
    np.testing.assert_allclose(frame["heading [rad]"].iloc[[0, 2]], [np.pi / 2, 0.0], atol=1e-7)
    np.testing.assert_allclose(
        frame["nose [rad]"], [0.0, np.pi / 2, 0.0], atol=1e-7
    )  # -90 degrees about y lift the nose
    np.testing.assert_allclose(frame["side [rad]"].iloc[[0, 2]], [0.0, np.pi / 3], atol=1e-7)
    fixes = {f"position_{axis}": f"local_{axis}" for axis in "xyz"}
    found = adapters.read_bag(bags[kind], {"/fix": Topic("gps", fixes, target="rover")}, frame=HOME)
    np.testing.assert_allclose(
        found[["position_x [m]", "position_y [m]", "position_z [m]"]], [[0, 0, 0], HOME.to_local(48.101, 11.6, 510.0)],
        atol=1e-6,
    )  # fmt: skip
    network = Network([sensors.position.on(Node("gps", (0.0, 0.0, 0.0)))])
    assert len(measure(probcal.read_table(found), network).time) == 2
    flat = adapters.read_bag(bags[kind], {"/fix": Topic("gps", {"east": "local_x"}, time="received")}, frame=HOME)
    assert flat["time"].tolist() == [0.0, 1.0]
    assert flat["east [m]"].tolist() == pytest.approx([0.0, 0.0], abs=1e-6)
    odom = {"position_x [cm]": "pose.pose.position.x", "speed [km/h]": "twist.twist.linear.x"}
    found = adapters.read_bag(bags[kind], {"/odom": Topic("wheels", odom)})
    assert found.loc[0, ["position_x [cm]", "speed [km/h]"]].tolist() == pytest.approx([700.0, 5.4])


def test_types_that_a_bag_does_not_define_are_given(bags, tmp_path):
    """Bags of sqlite3 before Iron hold no definitions: they are taken from `types` and the distribution."""
    path = tmp_path / "old"
    shutil.copytree(bags["sqlite3"], path)
    with sqlite3.connect(next(path.glob("*.db3"))) as base:
        base.execute("DELETE FROM message_definitions")
    base.close()
    topics = {"/uwb": Topic("anchor", {"range [mm]": "range_mm"})}
    frame = adapters.read_bag(path, topics, types={"uwb_msgs/Ranging": TEXT})
    assert frame["range [mm]"].tolist() == [10000.0, 10001.0, 10002.0]
    with pytest.raises(
        InputError, match=r'topic "/uwb": uwb_msgs/msg/Ranging cannot be decoded .* give types= with the'
    ):
        adapters.read_bag(path, topics)


ERRORS = [
    ({"/rnage": Topic("a", {"range": "range"})}, {}, 'has no topic "/rnage"; did you mean "/range"?'),
    ({}, {}, "read_bag: topics maps each topic to read to what it holds, Topic(sensor, channels)"),
    (
        {"/range": Topic("a", {"range": "range"}, frame_id="anchor_1")}, {},
        'topic "/range" message 0: it has frame_id "anchor_0", not "anchor_1"',
    ),
    ({"/level": Topic("a", {"level": "data"}, frame_id="map")}, {}, 'message 0: it has no header, not "map"'),
    (
        {"/range": Topic("a", {"range": "rnge"})}, {},
        'topic "/range": its messages has no field "rnge"; did you mean "range"?',
    ),
    (
        {"/pose": Topic("a", {"x": "pose.positon.x"})}, {},
        'topic "/pose": pose has no field "positon"; did you mean "position"?',
    ),
    ({"/pose": Topic("a", {"x": "pose.position"})}, {}, '"pose.position" is no number; take one of pose.position.x,'),
    ({"/uwb": Topic("a", {"x": "powers[2]"})}, {}, 'topic "/uwb": "powers[2]" asks for element 2 of 2'),
    ({"/uwb": Topic("a", {"x": "powers[last]"})}, {}, 'the field "powers[last]" has no index that is a number; write'),
    ({"/uwb": Topic(FromField("powers"), {"x": "range_mm"})}, {}, 'topic "/uwb": the field "powers" is no name'),
    (
        {"/range": Topic("a", {"angle [rads]": "range"})}, {},
        'topic "/range": the unit "rads" of angle is not known; did you mean "rad"',
    ),
    (
        {"/range": Topic("a", {"range [deg]": "range"})}, {},
        'topic "/range": range of sensor_msgs/msg/Range is in m, which is no deg; write [m]',
    ),
    ({"/range": Topic("a", {"[m]": "range"})}, {}, 'topic "/range": write the column "[m]" as name or name [unit]'),
    (
        {"/range": Topic("a", {"range": "range"}), "/uwb": Topic("b", {"range [ms]": "range_mm"})}, {},
        'topic "/uwb": range is in ms here and in m in another topic; call them differently',
    ),
    (
        {"/range": Topic("a", {"range": "range"}), "/uwb": Topic("b", {"range": "range_mm"})}, {},
        'topic "/uwb": the unit of range is stated in one topic only; write "range [unit]" in each',
    ),
    ({"/fix": Topic("a", {"x": "local_x"})}, {}, 'topic "/fix": local_x, local_y and local_z need frame=LocalFrame'),
    ({"/fix": Topic("a", {"x": "local_x"})}, {"frame": 3}, "read_bag: frame is int; give LocalFrame("),
    ({"/fix": Topic("a", {"x": "latitud"})}, {}, 'its messages has no field "latitud"; did you mean "latitude"?'),
    ({"/range": Topic("a", {"x": "range"})}, {"distribution": "hmble"}, 'is "hmble"; did you mean "humble"?'),
    ({"/range": Topic("a", {"x": "range"})}, {"types": {"a/B": "flot x y z\n="}}, "types of a/B is no text of a .msg"),
]  # fmt: skip


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
@pytest.mark.parametrize(("topics", "more", "text"), ERRORS, ids=[text[:40] for *_, text in ERRORS])
def test_wrong_topics_frames_fields_and_units_are_one_sentence(bags, kind, topics, more, text):
    with pytest.raises(InputError) as caught:
        adapters.read_bag(bags[kind], topics, **more)
    assert text in str(caught.value)


def test_what_is_no_bag_is_refused(bags, tmp_path):
    topics = {"/range": Topic("a", {"range": "range"})}
    with pytest.raises(InputError, match=r"none\.bag: no such file"):
        adapters.read_bag(tmp_path / "none.bag", topics)
    whole = bags["ros1"].read_bytes()
    for name, content in (("a.bag", b""), ("b.bag", b"#ROSBAG V2.0\n" + bytes(50)), ("c.bag", whole[:-200])):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=f"{name} is no ROS bag that can be read"):
            adapters.read_bag(tmp_path / name, topics)
    with pytest.raises(InputError, match="is no ROS bag that can be read"):
        adapters.read_bag(tmp_path, topics)
    at = whole.index(b"radiation_type") if b"op=\x02" not in whole else whole.index(b"op=\x02")
    (tmp_path / "d.bag").write_bytes(whole[: at + 4] + b"\xff" * 8 + whole[at + 12 :])
    with pytest.raises(InputError, match=r"d\.bag (is damaged|is no ROS bag)"):
        adapters.read_bag(tmp_path / "d.bag", topics)


def test_headers_without_time_and_topics_without_values(tmp_path):
    def unset(made):
        name, message = made.range(-BEGIN, 1.0)
        yield "/range", 0.0, (name, message)
        yield "/far", 0.0, made.range(0.0, np.inf)
        yield "/lost", 0.0, made.fix(0.0, 148.1, 11.6, 500.0)

    path = write(tmp_path, "sqlite3", unset)
    topics = {"/range": Topic("a", {"range": "range"})}
    with pytest.raises(InputError, match="its header has no time; give Topic"):
        adapters.read_bag(path, topics)
    received = adapters.read_bag(path, {"/range": Topic("a", {"range": "range"}, time="received")})
    assert received["time"].tolist() == [0.0]
    both = {"/far": Topic("b", {"far": "range"}), "/range": Topic("a", {"near": "range"}, time="received")}
    assert adapters.read_bag(path, both).columns.tolist() == ["time", "sensor", "far [m]", "near [m]"]
    with pytest.raises(InputError, match="sqlite3: its topics /far hold no value that can be read"):
        adapters.read_bag(path, {"/far": Topic("a", {"range": "range"})})
    with pytest.raises(InputError, match=r'topic "/lost": LocalFrame\.to_local: latitude must lie between'):
        adapters.read_bag(path, {"/lost": Topic("a", {"x": "local_x"})}, frame=HOME)
    with pytest.raises(InputError, match=r"Topic: channels is \{\}; map columns to fields"):
        Topic("a", {})
    with pytest.raises(InputError, match='Topic: time is \'stamp\'; give "header" or "received"'):
        Topic("a", {"range": "range"}, time="stamp")
