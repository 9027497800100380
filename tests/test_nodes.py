"""Node files and the local frame: against closed forms, against each other, and there and back."""

import json

import committed
import jax
import numpy as np
import pandas as pd
import pyproj
import pytest
import worlds
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st

from probcal import (
    MAP,
    Bias,
    Gaussian,
    InputError,
    LocalFrame,
    Network,
    Node,
    Path,
    Problem,
    Static,
    Target,
    fit,
    read_nodes,
    with_calibration,
    write_network,
    write_nodes,
)
from probcal.sensors import radar
from probcal.types import PoseView

A, F = 6378137.0, 1 / 298.257223563
LATITUDES, LONGITUDES = st.floats(-89, 89), st.floats(-180, 180)


def earth(latitude, longitude, height):
    """Earth-centred coordinates (..., 3) of WGS84 by the closed form."""
    phi, lam = np.deg2rad(latitude), np.deg2rad(longitude)
    n = A / np.sqrt(1 - F * (2 - F) * np.sin(phi) ** 2)
    across = (n + height) * np.cos(phi)
    return np.stack([across * np.cos(lam), across * np.sin(lam), (n * (1 - F) ** 2 + height) * np.sin(phi)], -1)


@given(LATITUDES, LONGITUDES, st.floats(-100, 3000))
def test_a_frame_with_heights_is_the_earth_turned_and_shifted(latitude, longitude, height):
    frame = LocalFrame(latitude, longitude, height)
    places = latitude + np.array([0.0, 0.5, -0.3]), longitude + np.array([0.0, 0.4, -1.0]), np.array([height, 9e3, 0.0])
    found = frame.to_local(*places)
    line = earth(*places) - earth(latitude, longitude, height)
    phi, lam = np.deg2rad(latitude), np.deg2rad(longitude)
    up = np.array([np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)])
    east = np.array([-np.sin(lam), np.cos(lam), 0.0])
    np.testing.assert_allclose(found, line @ np.stack([east, np.cross(up, east), up], 1), atol=1e-6)
    back = frame.to_geodetic(found)
    np.testing.assert_allclose(earth(*back), earth(*places), atol=1e-6)


@given(LATITUDES, LONGITUDES, st.floats(0, 360), st.floats(1.0, 1e5))
def test_a_frame_without_heights_keeps_distance_and_azimuth_from_its_origin(latitude, longitude, azimuth, distance):
    frame = LocalFrame(latitude, longitude)
    lam, phi, _ = pyproj.Geod(ellps="WGS84").fwd(longitude, latitude, azimuth, distance)
    toward = np.array([np.sin(np.deg2rad(azimuth)), np.cos(np.deg2rad(azimuth))])
    place = frame.to_local(phi, lam)
    np.testing.assert_allclose(place, distance * toward, atol=1e-5)
    np.testing.assert_allclose(frame.to_local(*frame.to_geodetic(place)), place, atol=1e-5)


def test_distortion_across_the_plane_is_what_the_docstring_says():
    geod, frame = pyproj.Geod(ellps="WGS84"), LocalFrame(47.0, 8.0)
    lam, phi, _ = geod.fwd([8.0] * 2, [47.0] * 2, [89.7, 90.3], [1e5] * 2)
    true = geod.inv(lam[0], phi[0], lam[1], phi[1])[2]
    growth = np.linalg.norm(np.diff(frame.to_local(phi, lam), axis=0)) / true - 1
    assert growth == pytest.approx((1e5 / 6.378e6) ** 2 / 6, rel=0.02)
    assert 1000 * growth == pytest.approx(0.04, abs=0.002)


def test_the_plane_lies_at_the_height_of_the_origin():
    frame = LocalFrame(47.0, 8.0, 2000.0)
    flat = frame.to_local([47.0, 47.01], [8.01, 8.0])
    space = frame.to_local([47.0, 47.01], [8.01, 8.0], 2000.0)
    np.testing.assert_allclose(np.linalg.norm(flat, axis=1), np.linalg.norm(space, axis=1), rtol=2e-6)
    assert np.linalg.norm(flat[0]) / np.linalg.norm(LocalFrame(47.0, 8.0).to_local(47.0, 8.01)) > 1 + 3e-4


def csv(tmp_path, text, name="masts.csv"):
    path = tmp_path / name
    path.write_text(text)
    return path


def components(**stated):
    return Node("n", (0, 0), **stated).components


def test_columns_in_metres_make_the_nodes_that_a_person_would_write(tmp_path):
    header = "node,x [km],y,heading [deg],clock [us],survey_position,scale_heading [deg],scale_clock [us],gain"
    text = f"{header},time_offset [ms]\n01,0.5,20,90,3,0.05,5,2,1.5,2\nNA,1,-4,,,,2,,-2,\n"
    first, second = read_nodes(csv(tmp_path, text)).values()
    assert (first.name, second.name) == ("01", "NA")
    np.testing.assert_array_equal([first.position, second.position], [[500.0, 20.0], [1000.0, -4.0]])
    assert first.components == components(heading=np.pi / 2, clock=3.0, gain=1.5, time_offset=0.002)
    assert first.spread == {
        "position": ("survey", Bias("m", 0.05)),
        "heading": ("scale", Bias("rad", np.deg2rad(5))),
        "clock": ("scale", Bias("us", 2.0)),
    }
    assert second.components == components(gain=-2.0)
    assert second.spread == {"heading": ("scale", Bias("rad", np.deg2rad(2)))}


@pytest.mark.parametrize("header", ["name,x,y,z", "name,x,y"])
def test_a_node_without_height_is_2d(header, tmp_path):
    cells = "a,1,2,3\nb,4,5,6\n" if header.endswith("z") else "a,1,2\nb,4,5\n"
    nodes = read_nodes(csv(tmp_path, f"{header}\n{cells}"))
    assert nodes["a"].dimension == nodes["b"].dimension == len(header.split(",")) - 1
    assert nodes.frame is None
    assert read_nodes(csv(tmp_path, "name,x,y,z\na,1,2,\nb,4,5,\n"))["b"].dimension == 2


def test_the_frame_of_a_file_stands_at_the_mean_of_its_nodes_across_the_date_line():
    cells = pd.DataFrame({"node": ["a", "b"], "latitude": [10.0, 10.0], "longitude": [179.9, -179.9]})
    nodes = read_nodes(cells)
    assert nodes.frame.latitude == pytest.approx(10.0, abs=1e-4)
    assert abs(nodes.frame.longitude) == pytest.approx(180.0)
    assert nodes["b"].position[0] - nodes["a"].position[0] == pytest.approx(21927.0, abs=2.0)  # 0.2 deg at 10 deg N
    space = read_nodes(cells.assign(height=[100.0, 300.0]))
    assert space.frame.height == 200.0
    there = read_nodes(cells, origin=(10.0, 179.9))
    np.testing.assert_allclose(there["a"].position, 0.0, atol=1e-9)
    assert read_nodes(cells, origin=there.frame).frame == there.frame == LocalFrame(10.0, 179.9)


def pose(node):
    return PoseView("the node", {"position": node.position} | node.components)


@given(st.floats(-3, 3), st.floats(-1.4, 1.4), st.floats(-3, 3), st.floats(-170, 170))
def test_what_a_sensor_sees_does_not_depend_on_the_origin_of_the_frame(heading, pitch, roll, longitude):
    cells = pd.DataFrame({"node": ["a"], "latitude": [55.0], "longitude": [longitude], "height": [80.0],
                          "heading": [heading], "pitch": [pitch], "roll": [roll]})  # fmt: skip
    here = read_nodes(cells)
    away = read_nodes(cells, origin=(54.0, longitude - 2.0, 0.0))
    target = here.frame.to_geodetic(np.array([800.0, -300.0, 500.0]))
    seen = [pose(nodes["a"]).local(nodes.frame.to_local(*target)) for nodes in (here, away)]
    np.testing.assert_allclose(seen[0], seen[1], atol=0.02)  # single precision of jax at 170 km
    for name in ("heading", "pitch", "roll"):
        assert here["a"].components[name] == pytest.approx(cells[name][0], abs=1e-9)
    assert away["a"].components["heading"] != pytest.approx(heading, abs=1e-3)


def test_in_the_plane_a_heading_counts_from_the_nodes_own_east():
    cells = pd.DataFrame({"node": ["a"], "latitude": [55.0], "longitude": [12.0], "heading [deg]": [30.0]})
    node = (nodes := read_nodes(cells, origin=(54.5, 11.0)))["a"]
    lam, phi, _ = pyproj.Geod(ellps="WGS84").fwd(12.0, 55.0, 60.0, 100.0)  # 30 deg from east
    line = nodes.frame.to_local(phi, lam) - node.position
    assert node.components["heading"] == pytest.approx(np.arctan2(line[1], line[0]), abs=5e-5)
    convergence = np.deg2rad(1.0) * np.sin(np.deg2rad(54.75))
    assert node.components["heading"] - np.deg2rad(30.0) == pytest.approx(convergence, rel=1e-2)


def test_velocities_turn_with_the_axes_of_a_place():
    frame = LocalFrame(54.0, 11.0, 0.0)
    moved = frame.to_local([55.0, 55.0], [12.0, 12.0 + 1e-6], 100.0)
    east = np.diff(moved, axis=0)[0]
    np.testing.assert_allclose(frame.axes(55.0, 12.0)[0], east / np.linalg.norm(east), atol=1e-6)


def stated():
    everything = {"position": 3.0, "heading": 0.1, "clock": Bias("us", 2.0), "gain": Bias("dB", 1.5)}
    return [
        Node("a", (1.0, 2.0, 3.0), 0.3, scale=everything, clock=4.0, gain=2.0),
        Node("b b", (-700.0, 2.5, 3.0), -2.0, pitch=0.2, roll=-0.1, survey={"pitch": 0.01}, gain=0.0),
        Node("7", (0.0, 2e3, -3.0), survey=0.02, gain=-1.0),
    ]


@pytest.mark.parametrize(
    ("name", "frame"), [("n.csv", None), ("n.csv", (60.0, 20.0, 5.0)), ("n.geojson", (60.0, 20.0, 5.0))]
)
@pytest.mark.parametrize("dimension", [2, 3])
def test_nodes_come_back_as_they_were_written(name, frame, dimension, tmp_path):
    nodes = stated()
    if dimension == 2:
        nodes = [Node("a", (1.0, 2.0), 0.3, scale=4.0), Node("b", (50.0, 2.0), -3.0, survey={"clock": Bias("s", 1e-6)})]
    frame = None if frame is None else LocalFrame(*frame)
    moving = Node("m", path=Path([0, 1], np.zeros((2, dimension))))
    path = write_nodes(tmp_path / name, [*nodes, moving], frame=frame)
    again = read_nodes(path, origin=frame)
    assert list(again) == [node.name for node in nodes]
    for node in nodes:
        found = again[node.name]
        np.testing.assert_allclose(found.position, node.position, atol=2e-6)
        assert found.components == pytest.approx(node.components, abs=1e-9)
        assert found.spread.keys() == node.spread.keys()
        for component, (kind, bias) in node.spread.items():
            assert (kind, bias.unit) == (found.spread[component][0], found.spread[component][1].unit)
            assert found.spread[component][1].scale == pytest.approx(bias.scale)
    if frame is not None:
        assert write_nodes(tmp_path / f"again-{name}", again).read_text() == path.read_text()
    assert not list(tmp_path.glob(".*"))


def test_geojson_is_what_other_programs_read(tmp_path):
    frame = LocalFrame(60.0, 20.0)
    path = write_nodes(tmp_path / "n.json", {"a": Node("a", (100.0, 0.0), np.pi / 2)}, frame=frame)
    (feature,) = json.loads(path.read_text())["features"]
    assert feature["geometry"]["type"] == "Point"
    assert feature["geometry"]["coordinates"] == pytest.approx([20.0017916, 60.0], abs=1e-6)
    assert feature["properties"] == {"node": "a", "heading [deg]": pytest.approx(90.0, abs=0.01)}


NOTE = "a map, without biases of sensors (2), nodes that move or drift (1); write_network keeps them"
HEADING = -0.7  # stated for `c` in tests/data/small.py


def test_the_nodes_of_a_fit_are_written_with_bias_and_sd(tmp_path):
    """The heading of `b` drifts, so that no one node could be written for it; of `c` all is written."""
    frame, tree = LocalFrame(60.0, 20.0), committed.tree("ea")
    cells = pd.read_csv(write_nodes(tmp_path / "fit.csv", tree)).set_index("node")
    mean, sd = (tree["calibration"][name].to_series() for name in ("mean", "sd"))
    assert cells.columns.tolist() == [
        "x", "y", "heading [deg]", "sd_position_x", "sd_position_y", "sd_heading [deg]", "note",
    ]  # fmt: skip
    assert set(cells.pop("note")) == {NOTE}
    assert cells.index.tolist() == ["a", "c"]
    assert cells.loc["c", "x"] == pytest.approx(mean["c.position_x"], abs=1e-6)
    assert cells.loc["c", "y"] == pytest.approx(50 + mean["c.position_y"], abs=1e-6)
    assert cells.loc["c", "heading [deg]"] == pytest.approx(np.rad2deg(HEADING + mean["c.heading"]))
    assert cells.loc["c", "sd_position_y"] == pytest.approx(sd["c.position_y"])
    assert cells.loc["c", "sd_heading [deg]"] == pytest.approx(np.rad2deg(sd["c.heading"]))
    assert cells.loc["a"].drop("heading [deg]").isna().tolist() == [False, False, True, True, True]
    assert (cells.loc["a", ["x", "y"]] == 0).all()
    placed = read_nodes(write_nodes(tmp_path / "fit.geojson", tree, frame=frame), origin=frame)
    np.testing.assert_allclose(placed["c"].position, cells.loc["c", ["x", "y"]].to_numpy(float), atol=2e-6)
    assert not placed["c"].spread
    constant = tree["constant_data"].to_dataset()  # a heading that was fixed and not estimated counts as well
    held = constant.drop_vars(["fixed", "fixed_label"]).assign(fixed=("fixed_label", [0.25]))
    tree["constant_data"] = xr.DataTree(held.assign_coords(fixed_label=["a.heading"]))
    cells = pd.read_csv(write_nodes(tmp_path / "held.csv", tree)).set_index("node")
    assert cells.loc["a", "heading [deg]"] == pytest.approx(np.rad2deg(0.25))


def test_the_frame_of_a_network_is_a_local_frame():
    placed = radar.on(Node("mast", (0.0, 40.0)))
    assert Network([placed], frame=LocalFrame(48.0, 11.0)).frame == LocalFrame(48.0, 11.0)
    with pytest.raises(InputError, match=r"give a LocalFrame\(latitude, longitude"):
        Network([placed], frame=(48.0, 11.0))


@pytest.mark.ci
@pytest.mark.parametrize("name", ["extras", "mixed"])
def test_a_calibrated_network_states_what_the_fit_found_and_its_file_loads_back(name, tmp_path):
    """Nodes, one on a path, clocks, gains, and a bias shared by its type: `extras` and `mixed` have them."""
    (problem, _), tree = worlds.linear(name), worlds.fitted(name)
    group = tree["calibration"].to_dataset()
    found = with_calibration(problem.network, tree)
    kept = {bias.label: bias for bias in found.biases if bias.label in problem.labels}
    assert {bias.kind for bias in kept.values()} == {"survey"}
    assert [kept[label].scale for label in problem.labels] == group["sd"].values.tolist()
    before, after = (
        {f"{n.name}.{c}": v for n in network.nodes for c, v in n.numbers.items()}
        | {f"{n.name}.position_{axis}": v for n in network.nodes for axis, v in zip("xyz", n.position, strict=False)}
        | {bias.label: bias.nominal for bias in network.biases if bias.sensor_type}
        for network in (problem.network, found)
    )
    mean = group["mean"].to_series()
    assert after == {label: value + mean.get(label, 0.0) for label, value in before.items()}
    moved = Problem(found, problem.motion, problem.measurements.table, fix=problem.fixed)
    point = worlds.resting(problem)
    with jax.enable_x64(True):
        old = problem.model.predict(point._replace(z=mean.to_numpy() / problem.scales))
        for one, other in zip(old, moved.model.predict(point), strict=True):
            np.testing.assert_allclose(other, one, rtol=1e-12, atol=1e-12)
    path = write_network(tmp_path / "network.csv", found)
    again = with_calibration(problem.network, path)
    assert again.biases == found.biases
    for one, other in zip(found.nodes, again.nodes, strict=True):
        assert (one.position == other.position).all()
        assert one.components == other.components
    assert write_network(tmp_path / "again.csv", again).read_text() == path.read_text()
    cells = pd.read_csv(path).set_index("name")
    assert cells.columns.tolist() == ["of", "unit", "value", "sd"]
    assert cells["sd"].notna().sum() == len(problem.labels)
    sensors = cells.loc[[label for label in problem.labels if label.startswith(("meter", "pair"))]]
    assert set(sensors["of"]) <= {"sensor", "sensor type"}
    assert set(write_nodes(tmp_path / "map.csv", tree).read_text().splitlines()[0].split(",")) >= {"note"}


@pytest.mark.slow
def test_a_second_fit_from_a_calibrated_network_is_the_fit_of_both_recordings(tmp_path):
    """One bias, two targets of which each recording sees one: nothing is correlated, so that the two agree exactly."""
    declared = Network([worlds.ruler.on(Node("n", (0.0, 3.0)))])
    start = Target(Static(), {"position": ((1.0, 5.0), 0.4)})
    rows = pd.DataFrame({"time": [0.0, 1.0] * 2, "sensor": "n", "target": ["a"] * 2 + ["b"] * 2,
                         "height": [3.1, 2.6, 4.0, 3.3]})  # fmt: skip

    def fitted(network, rows):
        problem = Problem(network, {"a": start, "b": start}, rows)
        return fit(problem, MAP(), prior=Gaussian(), start=worlds.resting(problem))

    first = fitted(declared, rows[:2])
    monday = with_calibration(declared, write_network(tmp_path / "n.csv", with_calibration(declared, first)))
    second, both = (
        with_calibration(monday, fitted(monday, rows[2:])),
        with_calibration(declared, fitted(declared, rows)),
    )
    (one,), (other,) = second.biases, both.biases
    assert one.nominal == pytest.approx(other.nominal, abs=1e-6)
    assert one.scale == pytest.approx(other.scale, rel=1e-6)
    assert one.scale < monday.biases[0].scale < declared.biases[0].scale


def test_a_file_of_another_network_is_refused(tmp_path):
    declared = Network([radar.on(Node("mast", (0.0, 40.0), heading=0.3, scale=2.0))])
    text = write_network(tmp_path / "n.csv", declared.surveyed({"mast.position_x": (1.0, 0.5)})).read_text()
    assert "mast.position_x,node,m,1.0,0.5" in text

    def read(old, new):
        (tmp_path / "n.csv").write_text(text.replace(old, new))
        return with_calibration(declared, tmp_path / "n.csv")

    assert len(read("mast.position_x", "gone.position_x").biases) == len(declared.biases)
    for old, new, message in [
        ("mast.position_x", "mast.gain", r"mast\.gain in m is no bias of the network; declare it, or leave"),
        ("m,1.0,0.5", "km,1.0,0.5", r"mast\.position_x in km is no bias of the network"),
        ("1.0,0.5", "1.0,-0.5", "give finite numbers, an sd above 0 or none"),
        ("rad,0.3", "rad,0.4", r"mast\.heading is 0\.4, the network states 0\.3; state the same"),
        ("mast.", "gone.", r"n\.csv: the network has none of its nodes and sensors; give the file"),
        ("value", "number", r"is no file of write_network \(KeyError"),
    ]:
        with pytest.raises(InputError, match=message):
            read(old, new)
    with pytest.raises(InputError, match=r"n\.csv: no such file"):
        with_calibration(declared, tmp_path / "none" / "n.csv")
    with pytest.raises(InputError, match="has a survey of position per axis, which a file of nodes does not hold"):
        write_nodes(tmp_path / "m.csv", declared.surveyed({"mast.position_x": (1.0, 0.5)}).nodes)
    tree = committed.tree("ea")
    with pytest.raises(InputError, match="with_calibration: the fit and the network have no bias in common"):
        with_calibration(declared, tree)
    tree.attrs["status"] = "diverged"
    with pytest.raises(InputError, match="with_calibration: the fit ended diverged, its estimate is invalid"):
        with_calibration(declared, tree)
