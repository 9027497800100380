"""AIS, ADS-B and GeoJSON: read into the table, and GeoJSON written from a fit and read back."""

import json
import subprocess
import sys
import warnings
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import probcal
from probcal import ConstantVelocity, InputError, LocalFrame, Network, Node, Problem, adapters, sensors
from probcal.adapters import shared
from probcal.motion import Known
from probcal.table import measure

DATA = Path(__file__).parent / "data"
KIEL = LocalFrame(54.3, 10.1)
KNOT = 1852 / 3600
GPS = Network([sensors.position.on(Node(name, (0.0, 0.0))) for name in ("ais", "adsb", "geojson")])
SPACE = Network([sensors.position.on(Node("adsb", (0.0, 0.0, 0.0)))])


@pytest.fixture(scope="module")
def tree():
    return probcal.load(DATA / "ea.nc")


def sentences(**fields):
    """NMEA sentences of a message, as the pyais package encodes it."""
    return pytest.importorskip("pyais").encode_dict({"mmsi": 211234560} | fields)


def position_report(**fields):
    return sentences(**({"type": 1, "lat": 54.31, "lon": 10.12, "speed": 10.0, "course": 90.0} | fields))


def signed(body):
    """A sentence with its checksum."""
    total = 0
    for character in body:
        total ^= ord(character)
    return f"!{body}*{total:02X}"


def halves(line, sequence=3):
    """A sentence of one part as a message of two."""
    talker, _, _, _, channel, payload, rest = line[1:].partition("*")[0].split(",")
    cut = len(payload) // 2
    parts = (payload[:cut], payload[cut:])
    ends = ("0", rest)
    return [
        signed(f"{talker},2,{k + 1},{sequence},{channel},{part},{end}")
        for k, (part, end) in enumerate(zip(parts, ends, strict=True))
    ]


def test_ais_positions_come_with_speed_and_course_in_the_frame(tmp_path):
    lines = [
        f"1700000000 {position_report()[0]}",
        f"2023-11-14T22:13:30Z,{position_report(lat=54.312, course=0.0, speed=5.0)[0]}",
        f"{position_report(lat=54.313, course=225.0, mmsi=9876543)[0]},1700000020",
        rf"\s:station,c:1700000030*00\{position_report(lat=54.314, course=360.0, speed=102.3)[0]}",
        rf"\c:1700000040500*00\{sentences(type=18, lat=54.2, lon=10.0, speed=1.0, course=45.0)[0]}",
        "a note beside the log", "",
    ]  # fmt: skip
    path = tmp_path / "kiel.nmea"
    path.write_text("\n".join(lines))
    frame = adapters.read_ais(path, KIEL, columns=("position", "velocity", "speed", "course"))
    assert frame["time"].tolist() == [0.0, 10.0, 20.0, 30.0, 40.5]
    assert frame["target"].tolist() == ["211234560", "211234560", "009876543", "211234560", "211234560"]
    assert frame.attrs["start"] == "2023-11-14T22:13:20+00:00"
    east, north = KIEL.to_local(54.31, 10.12)
    np.testing.assert_allclose(frame.loc[0, ["position_x", "position_y"]].to_list(), [east, north], atol=0.2)
    np.testing.assert_allclose(frame["speed"], np.array([10.0, 5.0, 10.0, np.nan, 1.0]) * KNOT)
    latitude, longitude = np.array([54.31, 54.312, 54.313, 54.2]), np.array([10.12, 10.12, 10.12, 10.0])
    nautical = np.deg2rad([90.0, 0.0, 225.0, 45.0])
    step = 1e-5  # degrees along the course: meridians lean in the frame, by 0.08 degrees at the last place
    there = KIEL.to_local(
        latitude + step * np.cos(nautical), longitude + step * np.sin(nautical) / np.cos(np.deg2rad(latitude))
    )
    dx, dy = (there - KIEL.to_local(latitude, longitude)).T
    assert np.isnan(frame.loc[3, "course"])
    np.testing.assert_allclose(frame["course"].drop(3), np.arctan2(dy, dx), rtol=0, atol=5e-3)
    lean = np.deg2rad([0.02, 0.02, 0.02, -0.1]) * np.sin(np.deg2rad(latitude))
    away = frame["course"].drop(3) - (np.pi / 2 - nautical) - lean
    np.testing.assert_allclose((away + np.pi) % (2 * np.pi) - np.pi, 0.0, atol=2e-5)
    np.testing.assert_allclose(frame.loc[0, ["velocity_x", "velocity_y"]].to_list(), [10 * KNOT, 0.0], atol=3e-3)


def test_ais_counts_what_it_leaves_out():
    good, away = position_report(), [position_report(**none)[0] for none in ({"lat": 91.0}, {"lon": 181.0})]
    bad = good[0][:-2] + ("00" if good[0][-2:] != "00" else "11")
    whole = halves(sentences(type=19, lat=54.32, lon=10.13, speed=3.0, course=180.0)[0])
    name = sentences(type=5, shipname="KATHARINA")
    assert len(name) == 2  # static data come in two parts
    lone = halves(good[0], sequence=7)[1:]
    lines = [*good, *good, bad, *away, *whole, *name, *lone, "!AIVDM,garbage"]
    times = [datetime(2024, 5, 1, 12, 0, k, tzinfo=UTC) for k in (0, 0, *range(1, len(lines) - 1))]
    frame = adapters.read_ais([*map(str, lines)], KIEL, times=times)
    assert frame["time"].tolist() == [0.0, 4.0]  # the time of a message is that of its first part
    assert frame["target"].tolist() == ["211234560", "211234560"]
    np.testing.assert_allclose(
        frame.loc[1, ["position_x", "position_y"]].to_list(), KIEL.to_local(54.32, 10.13), atol=0.2
    )
    assert frame.loc[1, "speed"] == pytest.approx(3 * KNOT)
    counts = {"bad checksum": 1, "incomplete": 1, "unreadable": 1, "without a position": 2, "other messages": 1}
    assert frame.attrs["left_out"] == counts | {"without a time": 0, "repeated": 1}


def test_ships_report_at_one_time():
    lines = [f"1700000000 {position_report(mmsi=mmsi)[0]}" for mmsi in (211234560, 211234561, 211234560)]
    frame = adapters.read_ais(lines, KIEL)
    assert frame["target"].tolist() == ["211234560", "211234561"]
    assert frame.attrs["left_out"]["repeated"] == 1


def test_reports_are_rows_of_a_problem_and_known_paths():
    lines = [f"{1700000000 + 10 * k} {position_report(lat=54.31 + 0.001 * k)[0]}" for k in range(3)]
    frame = adapters.read_ais(lines, KIEL, columns="position", start=1700000000 - 5)
    assert frame["time"].tolist() == [5.0, 15.0, 25.0]
    rows = measure(probcal.read_table(frame), GPS)
    assert rows.target_names == ("211234560",)
    problem = Problem(GPS, ConstantVelocity(1.0), frame)
    assert problem.measurements.value.shape == (3, 2)
    moving = adapters.read_ais(lines, KIEL, columns=("position", "velocity"))
    path = Known(moving)
    assert path.state.shape == (3, 4)
    assert path.state[0, 2] == pytest.approx(10 * KNOT, abs=0.01)


def log(**columns):
    first = {
        "time": [1700000000, 1700000010, 1700000020], "icao24": "3c6444", "lat": [48.10, 48.11, np.nan],
        "lon": [11.5, 11.5, 11.5], "velocity": [200.0, 210.0, 220.0], "heading": [0.0, 90.0, 90.0],
        "vertrate": [0.0, -5.0, 0.0], "baroaltitude": [1000.0, 1010.0, 1020.0], "geoaltitude": [1100.0, 1110.0, 1120.0],
    }  # fmt: skip
    return pd.DataFrame(first | columns)


def test_adsb_state_logs(tmp_path):
    munich = LocalFrame(48.1, 11.5, 500.0)
    path = tmp_path / "states.csv"
    log().to_csv(path, index=False)
    frame = adapters.read_adsb(path, munich, columns=("position", "velocity", "speed", "course"))
    assert frame["target"].tolist() == ["3c6444"] * 2
    assert frame["time"].tolist() == [0.0, 10.0]
    np.testing.assert_allclose(
        frame.loc[0, ["position_x", "position_y", "position_z"]].to_list(), [0, 0, 600], atol=1e-6
    )
    np.testing.assert_allclose(
        frame.filter(like="velocity").to_numpy(), [[0, 200, 0], [210, 0, -5]], rtol=0, atol=0.05
    )  # up turns by 1.1 km over the radius of the Earth
    np.testing.assert_allclose(frame["course"], [np.pi / 2, 0.0], atol=1e-4)
    assert frame["speed"].tolist() == [200.0, 210.0]
    assert frame.attrs["left_out"] == {"without a position": 1, "without a time": 0, "without a name": 0, "repeated": 0}
    assert measure(probcal.read_table(frame[["time", "sensor", "target", *frame.filter(like="position_")]]), SPACE)
    pressure = adapters.read_adsb(path, munich, altitude="baroaltitude", columns="position")
    assert pressure.loc[0, "position_z"] == pytest.approx(500.0)


def test_adsb_takes_other_columns_and_the_time_of_the_position():
    frame = log(lastposupdate=[1699999999.5, 1699999999.5, 1700000019.0], lat=[48.1, 48.1, 48.2])
    frame = frame.rename(columns={"velocity": "velocity [km/h]", "heading": "true_track"}).drop(columns="vertrate")
    found = adapters.read_adsb(frame, LocalFrame(48.1, 11.5), dimension=2, columns="speed")
    assert found["time"].tolist() == [0.0, 19.5]  # the log repeats a position until the next
    assert found["speed"].tolist() == pytest.approx([200 / 3.6, 220 / 3.6])
    assert found.attrs["left_out"]["repeated"] == 1
    level = adapters.read_adsb(frame, LocalFrame(48.1, 11.5), columns="velocity")
    assert abs(level.loc[0, "velocity_z"]) < 0.1  # without a climb rate: level
    dated = log(time=["2024-05-01T12:00:00Z", "2024-05-01T12:00:01+00:00", None], icao24=["3C6444", None, "a"])
    found = adapters.read_adsb(dated, LocalFrame(48.1, 11.5), dimension=2)
    assert found["target"].tolist() == ["3c6444"]
    assert found.attrs["left_out"] == {"without a position": 1, "without a time": 0, "without a name": 1, "repeated": 0}


def collection(*features):
    return json.dumps({"type": "FeatureCollection", "features": list(features)})


def feature(kind, coordinates, **properties):
    return {"type": "Feature", "geometry": {"type": kind, "coordinates": coordinates}, "properties": properties}


def test_points_and_lines_are_read(tmp_path):
    path = tmp_path / "walks.geojson"
    path.write_text(
        collection(
            feature("Point", [10.1, 54.3, 7.0], time="2024-05-01T12:00:00Z", name="fox"),
            feature("LineString", [[10.1, 54.3], [10.101, 54.301]], coordTimes=[1714564801, 1714564802.5], id="hare"),
            feature(
                "MultiLineString", [[[10.1, 54.3]], [[10.1, 54.302]]],
                coordinateProperties={"times": [["2024-05-01T12:00:03"], ["2024-05-01T14:00:04+02:00"]]},
            ),
            feature("LineString", [[10.1, 54.3], [10.1, 54.3]]),
            feature("Polygon", [[[10.1, 54.3]]]), None,
        )
    )  # fmt: skip
    frame = adapters.read_geojson(path, KIEL)
    assert frame["time"].tolist() == [0.0, 1.0, 2.5, 3.0, 4.0]
    assert frame["target"].tolist() == ["fox", "hare", "hare", "target", "target"]
    np.testing.assert_allclose(frame.loc[2, ["position_x", "position_y"]].to_list(), KIEL.to_local(54.301, 10.101))
    assert frame.attrs == {
        "start": "2024-05-01T12:00:00+00:00",
        "left_out": {"without a time": 1, "other geometries": 2},
    }
    assert len(measure(probcal.read_table(frame), GPS).time) == 5
    path.write_text(json.dumps(feature("Point", [10.1, 54.3, 7.0], time=0)))
    high = adapters.read_geojson(path, KIEL, sensor="gps")
    assert high.loc[0, ["sensor", "position_z"]].tolist() == ["gps", pytest.approx(7.0)]
    assert "position_z" not in adapters.read_geojson(path, KIEL, dimension=2)


def test_a_fit_is_written_as_geojson_and_its_tracks_read_back(tree, tmp_path):
    start = datetime(2024, 5, 1, 12, tzinfo=UTC)
    path = adapters.write_geojson(tmp_path / "fit.geojson", tree, KIEL, start=start, deviations=2.0)
    frame = adapters.read_geojson(path, KIEL, start=start)
    wanted = probcal.tracks(tree).sort_values("time", kind="stable").reset_index(drop=True)
    assert frame[["time", "target"]].equals(wanted[["time", "target"]])
    axes = ["position_x", "position_y"]
    np.testing.assert_allclose(frame[axes], wanted[axes], rtol=0, atol=2e-5)
    features = json.loads(path.read_text())["features"]
    kinds = [one["properties"]["kind"] for one in features]
    assert [kinds.count(kind) for kind in ("stated", "calibrated", "ellipse", "track")] == [3, 3, 2, 2]
    table = tree["calibration"].to_dataset()
    mean, sd = (table[name].to_series() for name in ("mean", "sd"))
    node = next(f for f in features if f["properties"]["kind"] == "calibrated" and f["properties"]["node"] == "b")
    longitude, latitude = node["geometry"]["coordinates"]
    labels = ["b.position_x", "b.position_y"]
    np.testing.assert_allclose(KIEL.to_local(latitude, longitude), [50.0 + mean[labels[0]], mean[labels[1]]], atol=2e-5)
    assert node["properties"]["sd_position_x"] == pytest.approx(sd["b.position_x"])
    assert node["properties"]["heading"] == pytest.approx(mean["b.heading"])
    outline = next(f for f in features if f["properties"]["kind"] == "ellipse" and f["properties"]["node"] == "b")
    ring = np.array(outline["geometry"]["coordinates"][0])
    assert (ring[0] == ring[-1]).all()
    away = KIEL.to_local(ring[:, 1], ring[:, 0]) - KIEL.to_local(latitude, longitude)
    covariance = table["covariance"].sel(bias_label=labels, bias_label_other=labels).values
    np.testing.assert_allclose(np.einsum("ni,ij,nj->n", away, np.linalg.inv(covariance), away), 4.0, rtol=1e-3)
    x, y = away[:-1].T
    assert np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) > 0  # counter-clockwise, as RFC 7946 has it


def test_an_extra_that_is_missing_is_named():
    with pytest.raises(
        InputError, match=r'reading ghosts needs the package no_such_thing: pip install "probcal\[ghosts\]"'
    ):
        shared.extra("no_such_thing.part", "reading ghosts", "ghosts")


@pytest.mark.parametrize(
    ("package", "extra", "call"),
    [
        ("pyais", "ais", lambda path: adapters.read_ais([], KIEL)),
        ("rosbags", "ros", lambda path: adapters.read_bag(path, {"/a": adapters.Topic("a", {"range": "range"})})),
        ("stonesoup", "stonesoup", lambda path: adapters.to_sensors(GPS)),
    ],
)
def test_each_adapter_names_its_extra(package, extra, call, monkeypatch, tmp_path):
    for name in [name for name in sys.modules if name.split(".")[0] == package]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(InputError, match=rf'needs the package {package}: pip install "probcal\[{extra}\]"$'):
        call(tmp_path)


def test_adapters_load_nothing_before_they_are_used():
    code = (
        "import sys, probcal.adapters as adapters\n"
        "print([dir(adapters) and name for name in adapters.__all__ if getattr(adapters, name).__module__])\n"
        "print([name for name in ('stonesoup', 'rosbags', 'pyais', 'pandas', 'pyproj') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=True)
    names, loaded = done.stdout.splitlines()
    assert names == str(sorted(adapters.__all__))
    assert loaded == "[]"


def lines_of(count):
    return [f"{1700000000 + k} {position_report()[0]}" for k in range(count)]


def write(folder, content):
    path = folder / "some.geojson"
    path.write_text(content if isinstance(content, str) else collection(*content))
    return path


POINT = feature("Point", [10.1, 54.3], time=0)
ERRORS = [
    (
        lambda f, t: adapters.read_ais([], (54.3, 10.1)),
        "read_ais: frame is tuple; give LocalFrame(latitude, longitude)",
    ),
    (lambda f, t: adapters.read_ais(3, KIEL), "read_ais: give a path or lines of NMEA sentences, got int"),
    (lambda f, t: adapters.read_ais(f / "no.nmea", KIEL), "no.nmea: no such file"),
    (lambda f, t: adapters.read_ais(f, KIEL), "cannot be read: Is a directory"),
    (lambda f, t: adapters.read_ais([], KIEL), "AIS holds no position with a time: nothing was read"),
    (lambda f, t: adapters.read_ais(position_report(), KIEL), "holds no position with a time: 1 without a time"),
    (
        lambda f, t: adapters.read_ais(lines_of(2), KIEL, times=[0]),
        "AIS has 2 lines, but 1 times are given; give one a",
    ),
    (
        lambda f, t: adapters.read_ais(lines_of(1), KIEL, columns="sped"),
        'AIS: columns names "sped"; did you mean "speed"?',
    ),
    (
        lambda f, t: adapters.read_ais(lines_of(1), KIEL, start="noon"),
        "start is 'noon'; give a datetime, ISO text or Unix",
    ),
    (lambda f, t: adapters.read_ais(["noon " + position_report()[0]], KIEL), "line 1: what stands beside the sentence"),
    (lambda f, t: adapters.read_adsb(log(), KIEL, dimension=4), "read_adsb: dimension is 4; give 2 or 3"),
    (lambda f, t: adapters.read_adsb(log(), KIEL, altitude="geoalt"), 'read_adsb: altitude is "geoalt"; did you mean'),
    (
        lambda f, t: adapters.read_adsb(log().rename(columns={"icao24": "icao2"}), KIEL),
        'data is no state log of aircraft: it has no column "icao24"; did you mean "icao2"?',
    ),
    (
        lambda f, t: adapters.read_adsb(log().drop(columns="geoaltitude"), KIEL),
        'it has no column "geoaltitude"; did you mean "baroaltitude"?; give dimension=2 for positions without heights',
    ),
    (
        lambda f, t: adapters.read_adsb(log().drop(columns="time"), KIEL),
        'data: a state log needs a column "time", in Unix',
    ),
    (lambda f, t: adapters.read_adsb(log(time="noon"), KIEL), "data row 0 column \"time\" is 'noon'; give a datetime"),
    (
        lambda f, t: adapters.read_adsb(log().rename(columns={"lat": "lat [m]"}), KIEL),
        'unit "m" is no angle; give it in deg',
    ),
    (lambda f, t: adapters.read_geojson(f / "no.geojson", KIEL), "no.geojson: no such file"),
    (lambda f, t: adapters.read_geojson(write(f, "{"), KIEL), "some.geojson cannot be read as GeoJSON"),
    (
        lambda f, t: adapters.read_geojson(write(f, "[]"), KIEL),
        "some.geojson holds no features; a table is read from a",
    ),
    (
        lambda f, t: adapters.read_geojson(write(f, []), KIEL),
        "some.geojson holds no point with a time; write a property",
    ),
    (
        lambda f, t: adapters.read_geojson(write(f, [POINT]), KIEL, dimension=3),
        "some.geojson: a point has no height; give",
    ),
    (
        lambda f, t: adapters.read_geojson(write(f, [POINT]), KIEL, dimension=4),
        "read_geojson: dimension is 4; give 2 or 3,",
    ),
    (
        lambda f, t: adapters.read_geojson(write(f, [feature("LineString", [[1, 2], [3, 4]], coordTimes=[0])]), KIEL),
        "some.geojson feature 1 has 2 points and 1 times; coordTimes holds one time a point",
    ),
    (
        lambda f, t: adapters.read_geojson(write(f, [feature("Point", [54.3], time=0)]), KIEL),
        "some.geojson feature 1: [54.3] is no place; write [longitude, latitude]",
    ),
    (
        lambda f, t: adapters.read_geojson(write(f, [feature("Point", [10.1, 154.3], time=0)]), KIEL),
        "some.geojson: latitude must lie between -90 and 90 degrees",
    ),
    (
        lambda f, t: adapters.read_geojson(write(f, [feature("MultiLineString", [3], coordTimes=[0])]), KIEL),
        "the coordinates of a MultiLineString are a list of lines",
    ),
    (
        lambda f, t: adapters.read_geojson(write(f, [feature("Point", [10.1, 54.3], time="noon")]), KIEL),
        "some.geojson feature 1: a time is 'noon'; give a datetime",
    ),
    (
        lambda f, t: adapters.write_geojson(f / "a.geojson", t),
        "a.geojson: the network has no frame; give that of its nodes",
    ),
    (
        lambda f, t: adapters.write_geojson(f / "a.geojson", t["track"], KIEL),
        "a.geojson: the tree states no nodes; give what fit() returned",
    ),
    (lambda f, t: adapters.write_geojson(f / "no" / "a.geojson", t, KIEL), "a.geojson cannot be written: No such file"),
]


@pytest.mark.parametrize(("call", "text"), ERRORS, ids=[text[:40] for _, text in ERRORS])
def test_what_cannot_be_read_is_refused_in_one_sentence(call, text, tree, tmp_path):
    with pytest.raises(InputError) as caught:
        call(tmp_path, tree)
    assert text in str(caught.value)


LINES = st.sampled_from([
    "1700000000 !AIVDM,1,1,,B,15M67FC000G?ufbE`FepT@3n00Sa,0*5C", "!AIVDM,2,1,3,B,15M67FC,0*44", "!AIVDM,1,1,,A,,0*26",
    "x !AIVDM,1,1,,B,15M67FC000G?ufbE`FepT@3n00Sa,0*5C", "\\c:1700000000*00\\!AIVDM,1,1,,A,~~~~,0*26", "\\", "!", "$",
    "1e400,!AIVDM,1,1,,B,15M67FC000G?ufbE`FepT@3n00Sa,0*5C", "\0", "é!AIVDM,1,1,,B,é,0*5C", "!AIVDM,,,,,,*57",
    "\\c:99999999999999999999*00\\!AIVDM,1,1,,B,15M67FC000G?ufbE`FepT@3n00Sa,0*5C",
])  # fmt: skip
JSON = st.recursive(
    st.sampled_from([
        None, True, 0, 1, -7.5, 54.3, 10.1, 1e308, 1e400, float("nan"), "", "a", "Point", "FeatureCollection",
        "2024-05-01T12:00:00Z", "0001-01-01", "9999-12-31", [10.1, 54.3], [10.1, 54.3, 5], [[10.1, 54.3], [10.2, 54.4]],
    ]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(
        st.sampled_from(["type", "features", "geometry", "properties", "coordinates", "time", "coordTimes"]), inner,
        max_size=5,
    ),
    max_leaves=25,
)  # fmt: skip
MADE = st.builds(
    lambda kind, places, **own: feature(kind, places, **own),
    st.sampled_from(["Point", "LineString", "MultiLineString"]), JSON, time=JSON, coordTimes=JSON, name=JSON,
)  # fmt: skip
fuzz = settings(max_examples=60, suppress_health_check=list(HealthCheck))


def taken(call):
    """A call returns a finite table or refuses in one sentence; every other exception is a failure."""
    with warnings.catch_warnings(), suppress(InputError):
        warnings.simplefilter("error")
        frame = call()
        assert np.isfinite(frame[["time", "position_x", "position_y"]].to_numpy()).all()


@fuzz
@given(st.lists(LINES, max_size=6))
def test_whatever_a_log_of_ais_holds(lines):
    pytest.importorskip("pyais")
    taken(lambda: adapters.read_ais(lines, KIEL))


@fuzz
@given(JSON | st.lists(MADE | JSON, max_size=3).map(lambda found: {"type": "FeatureCollection", "features": found}))
def test_whatever_a_geojson_file_holds(tmp_path_factory, content):
    path = tmp_path_factory.getbasetemp() / "fuzz.geojson"
    path.write_text(json.dumps(content))
    taken(lambda: adapters.read_geojson(path, KIEL))


CELLS = st.sampled_from(
    ["", "a", "0", "48.1", "91", "1e308", "nan", "1700000000", "2024-05-01", "9999-12-31", "-1e999"]
)
COLUMNS = st.sampled_from(
    ["time", "icao24", "lat", "lon", "velocity", "heading", "geoaltitude", "lat [m]", "[", "time [s]"]
)


@fuzz
@given(
    st.lists(COLUMNS, min_size=3, max_size=8, unique=True),
    st.lists(st.lists(CELLS, min_size=8, max_size=8), max_size=3),
)
def test_whatever_a_state_log_holds(tmp_path_factory, columns, cells):
    path = tmp_path_factory.getbasetemp() / "fuzz.csv"
    rows = [",".join(row[: len(columns)]) for row in cells]
    path.write_text("\n".join([",".join(columns), *rows]))
    taken(lambda: adapters.read_adsb(path, KIEL, dimension=2))
