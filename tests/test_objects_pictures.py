"""Objects that nobody named, in trees, on maps and in the report: small trees written by hand, nothing is fitted."""

import re

import committed
import jax
import numpy as np
import pandas as pd
import pytest
import xarray as xr

pytest.importorskip("matplotlib")
pytest.importorskip("jinja2")
pytest.importorskip("bokeh")

from bokeh.models.annotations.legends import ColorBar
from matplotlib.collections import LineCollection
from matplotlib.patches import Polygon

import probcal as pc
from probcal import plots
from probcal.gaussian.mode import Point
from probcal.geometry import bearing, norm
from probcal.plots import interactive, scene
from probcal.report import tables, write_report
from probcal.results.read import bias_values
from probcal.results.views import view_variables

EXISTENCE = {"track_0": [0.3, 0.8, 1.0, 0.9], "track_1": [0.1, 0.95, 0.4]}
WIDTH, TOWARDS = np.pi / 2, 0.25


def tree():
    """A committed fit, as if its rows had named no target: two objects, two sectors and a view that is a function."""
    found = committed.tree("ea")
    lines = [
        {"time": float(k), "track": name, "existence": value, "position_x": 10.0 * k, "position_y": 5.0 * j + k}
        for j, (name, own) in enumerate(EXISTENCE.items())
        for k, value in enumerate(own)
    ]
    lines.insert(2, lines[1] | {"existence": 0.5, "position_x": 11.0})  # another sensor at the same time
    rows = pd.DataFrame({"row": [0, 1, 2, 3], "track": ["track_0", "track_0", "track_1", "track_1"]})
    found["object"] = xr.DataTree(pd.DataFrame(lines).rename_axis("line").to_xarray())
    found["association"] = xr.DataTree(rows.assign(weight=[1.0, 0.5, 1.0, 1.0]).rename_axis("pair").to_xarray())
    counts = {"scans": [4, 4, 4], "detections": [5, 2, 0], "of_objects": [2.0, 1.5, 0.0], "looks": [4.0, 2.0, 0.0]}
    sensors = {"sensor": ["a", "b", "c"]}
    found["detection"] = xr.DataTree(xr.Dataset({k: ("sensor", np.array(v)) for k, v in counts.items()}, sensors))
    views = {
        "view_range": [30.0, 20.0, np.nan], "view_width": [2 * np.pi, WIDTH, np.nan],
        "view_towards": [0.0, TOWARDS, np.nan], "detection_probability": [0.9, 0.8, 0.7], "clutter": [0.5, 0.25, 0.1],
    }  # fmt: skip
    x, y = np.linspace(-20.0, 60.0, 81), np.linspace(-10.0, 70.0, 81)
    seen = (x[None, :] > 20.0) * np.ones((81, 1)) * 0.9  # a wall along x = 20
    known = found["constant_data"].to_dataset().assign({k: ("sensor", np.array(v)) for k, v in views.items()})
    known = known.assign(view=(("viewing", "view_y", "view_x"), seen[None]))
    found["constant_data"] = xr.DataTree(known.assign_coords(sensors | {"viewing": ["c"], "view_x": x, "view_y": y}))
    return found


def words(page):
    """What a reader sees, without pictures, style and scripts."""
    page = re.sub(r"<(style|script).*?</\1>", " ", page.replace("<wbr>", ""), flags=re.DOTALL)
    return re.sub(r"\s+", " ", re.sub(r"<[^>]*>", " ", page))


# The map


def test_the_scene_has_objects_and_views_of_calibrated_sensors():
    shown = scene.scene(tree())
    first, second = shown.objects
    assert (first.name, second.name) == ("track_0", "track_1")
    np.testing.assert_array_equal(first.existence, [0.3, 0.5, 1.0, 0.9])  # what the last sensor left
    np.testing.assert_array_equal(first.position[:, 0], [0.0, 11.0, 20.0, 30.0])
    around, sector, other = shown.views
    assert [own.sensor for own in shown.views] == ["a", "b", "c"]
    np.testing.assert_allclose(np.hypot(*around.lines[0].T), 30.0)
    moved = bias_values(tree())
    corner = np.array([50.0 + moved["b.position_x"], moved["b.position_y"]])
    np.testing.assert_allclose(sector.lines[0][[0, -1]], [corner, corner])
    line = sector.lines[0][1:-1] - corner
    np.testing.assert_allclose(np.hypot(*line.T), 20.0)
    turned = np.arctan2(*line.mean(0)[::-1])
    assert turned == pytest.approx(0.5 + moved["b.heading"] + TOWARDS)
    assert np.arccos(line[0] @ line[-1] / 400.0) == pytest.approx(WIDTH)
    np.testing.assert_allclose(np.concatenate(other.lines)[:, 0], 20.0, atol=1.0)


def test_a_tree_without_objects_is_drawn_as_before():
    plain = committed.tree("ea")
    shown = scene.scene(plain)
    assert (shown.objects, shown.views) == ([], [])
    assert not {"objects", "views"} & set(interactive.layers(shown))
    ax = plots.plot_map(plain)
    assert not [part for part in ax.collections if isinstance(part, LineCollection)]
    assert not {"object", "detection"} & set(plain.children)
    assert not [t for t in tables.tables(plain) if t["title"].startswith(("Objects", "Detections"))]


def test_limits_hold_what_surely_is_and_a_part_of_far_views():
    before, after = scene.scene(committed.tree("ea")), scene.scene(tree())
    assert (after.low <= before.low).all()
    assert (after.high >= before.high).all()
    far = tree()
    far["constant_data"]["view_range"][0] = 1e6
    shown, reach = scene.scene(far), float((before.high - before.low).max())
    np.testing.assert_allclose(before.low - shown.low, scene.ASIDE * reach)
    ghost, group = tree(), tree()["object"].to_dataset()
    known = ghost["constant_data"].to_dataset().drop_vars(["view_range", "view"])
    ghost["constant_data"] = xr.DataTree(known)
    without = scene.scene(ghost).high
    ghost["object"] = xr.DataTree(
        group.assign(existence=0.1 * group["existence"], position_x=group["position_x"] + 500)
    )
    np.testing.assert_allclose(scene.scene(ghost).high, without)
    ghost["object"] = xr.DataTree(group.assign(position_x=group["position_x"] + 500))
    assert scene.scene(ghost).high[0] > without[0]


def test_the_printed_map_colours_objects_by_existence():
    ax = plots.plot_map(tree())
    one, _ = [part for part in ax.collections if isinstance(part, LineCollection)]
    bright = one.get_colors()[:, 1]  # green falls from pale to sure
    assert bright[0] > bright[2] > bright[1]
    assert len([part for part in ax.patches if isinstance(part, Polygon)]) == 2
    entries = [text.get_text() for text in ax.get_legend().get_texts()]
    assert {"2 objects, by existence", "view of a sensor"} <= set(entries)
    (bar,) = ax.child_axes
    assert bar.get_ylabel() == "existence"


def test_the_interactive_map_has_layers_of_objects_and_views():
    drawn = plots.interactive_map(tree())
    assert [tag for tag in interactive.layers(scene.scene(tree())) if tag in ("objects", "views")] == [
        "objects",
        "views",
    ]
    (band,) = [part for part in drawn.renderers if "objects" in part.tags]
    np.testing.assert_allclose(band.data_source.data["existence"], [0.5, 1.0, 0.9, 0.95, 0.4])
    faint, sure = band.data_source.data["opacity"][[4, 1]]
    assert 0.1 < faint < 0.6 < sure
    assert len([part for part in drawn.renderers if "views" in part.tags]) == 2
    assert len(drawn.select({"type": ColorBar})) == 1


def test_a_view_without_an_end_is_a_wedge_and_one_that_sees_all_is_not_drawn():
    found = tree()
    found["constant_data"]["view_range"][:] = np.inf
    (wedge,) = [own for own in scene.scene(found).views if own.sensor != "c"]
    assert wedge.sensor == "b"
    assert np.isfinite(wedge.lines[0]).all()
    found["constant_data"]["moving"][:] = True  # on a way whose heading the tree does not have
    assert [own.sensor for own in scene.scene(found).views] == ["c"]


def test_nodes_that_are_stated_at_one_place_are_named_where_they_were_found():
    found = tree()
    known = found["constant_data"].to_dataset()
    known["node_position"][:] = 7.0
    found["constant_data"] = xr.DataTree(known)
    nodes = scene.scene(found).nodes
    np.testing.assert_array_equal(nodes.named, nodes.calibrated)
    named = {text.get_text(): text.xy for text in plots.plot_map(found).texts}
    np.testing.assert_allclose(named["b"], nodes.calibrated[1])
    plain = scene.scene(tree()).nodes
    np.testing.assert_array_equal(plain.named, plain.stated)


def test_in_space_the_heights_show_objects_and_the_plane_shows_views():
    found = tree()
    known = found["constant_data"].to_dataset()
    place = np.pad(known["node_position"].values, ((0, 0), (0, 1)), constant_values=2.0)
    known = known.drop_vars(["node_position", "axis"]).assign(node_position=(("node", "axis"), place))
    found["constant_data"] = xr.DataTree(known.assign_coords(axis=list("xyz")))
    group = found["object"].to_dataset()
    found["object"] = xr.DataTree(group.assign(position_z=group["position_x"] + 100.0))
    del found["track"]
    assert scene.scene(found).objects[0].position.shape == (4, 3)
    plan, heights = plots.interactive_map(found).children
    tags = [[tag for part in sheet.renderers for tag in part.tags] for sheet in (plan, heights)]
    assert [own.count("objects") for own in tags] == [1, 1]
    assert [own.count("views") for own in tags] == [2, 0]
    (band,) = [part for part in heights.renderers if "objects" in part.tags]
    assert band.data_source.data["y1"].min() >= 100.0


# Pictures and tables


def test_existence_and_numbers_over_time():
    above, below = plots.plot_objects(tree())
    assert [line.get_label() for line in above.lines] == ["track_0", "track_1"]
    np.testing.assert_array_equal(above.lines[0].get_ydata(), [0.3, 0.5, 1.0, 0.9])
    mean, count = below.lines
    np.testing.assert_allclose(mean.get_ydata(), [0.4, 1.45, 1.4, 0.9])
    np.testing.assert_array_equal(count.get_ydata(), [0, 1, 1, 1])
    pair = above.figure.subplots(2)
    assert plots.plot_objects(tree(), pair)[0] is pair[0]
    with pytest.raises(pc.InputError, match="plot_objects: the tree has no group object"):
        plots.plot_objects(committed.tree("ea"))


def test_the_report_says_when_objects_were_there_and_what_sensors_detected(tmp_path):
    text = words(write_report(tree(), tmp_path / "report.html", static=True).read_text())
    assert "Objects: 2 in the detections" in text
    assert "track_0 0 3 1.00 1.5" in text
    assert "track_1 0 2 0.95 2.0" in text
    assert "a 4 5 0.40 0.75 0.5 4 0.50 0.9" in text
    assert "b 4 2 0.75 0.125 0.25 2 0.75 0.8" in text
    assert "c 4 0 – 0 0.1 0 – 0.7" in text
    assert "Existence of every object" in (tmp_path / "report.html").read_text()
    whole = write_report(tree(), tmp_path / "whole.html").read_text()
    assert '["objects", "objects by existence"], ["views", "views"]' in whole


# What a fit writes


@pc.sensor(range=pc.Channel("m", std=5.0), azimuth=pc.Channel("rad", std=0.01, wrap=True))
def radar(target, pose):
    """Range and azimuth in the node's own axes."""
    line = pose.local(target.position)
    return dict(range=norm(line), azimuth=bearing(line))


def ahead(target, pose):
    """Nine in ten of what is up to 40 m ahead, and nothing behind."""
    line = pose.local(target.position)
    return 0.9 * ((line[0] > 0) & (line[0] < 40.0))


def recorded():
    """Two radars, one of which turns north and sees what is ahead only; one object walks east, away from the second."""
    half = pc.Detection(0.8, clutter=1.0, view=ahead, limits={"range": (0.0, 100.0)})
    whole = pc.Detection(0.9, clutter=1.0, view=pc.Sector(range=100.0))
    nodes = [pc.Node("west", (0.0, 0.0)), pc.Node("east", (50.0, 0.0), scale={"position": 5.0, "heading": 0.1})]
    network = pc.Network([radar.on(nodes[0], detection=whole), radar.on(nodes[1], detection=half)])
    table = pd.DataFrame(
        [(float(k), name, 10.0 + k, 0.1) for k in range(4) for name in ("west", "west", "east")],
        columns=["time", "sensor", "range", "azimuth"],
    )
    start = {"position": ((50.0, 0.0), 100.0), "velocity": ((0.0, 0.0), 5.0)}
    return pc.Problem(network, pc.Target(pc.ConstantVelocity(0.5), start), table)


@pytest.mark.needs("tracking")
def test_what_each_sensor_detected_is_counted_and_views_are_saved():
    """The object is ahead of the turned radar at two times of four."""
    from probcal.tracking.groups import object_groups

    problem = recorded()
    path = pd.DataFrame({"time": np.arange(4.0), "track": "track_0", "existence": [0.5, 1.0, 1.0, 1.0]})
    path = path.assign(position_x=50.0, position_y=[-9.0, -3.0, 3.0, 9.0], velocity_x=0.0, velocity_y=6.0)
    path = pd.concat([path.head(1).assign(existence=0.2), path])  # after the first of two sensors at one time
    rows = pd.DataFrame({"row": [0, 3, 6, 8, 11], "track": "track_0", "weight": [1.0, 0.5, 1.0, 1.0, 0.75]})
    turned = np.array([0.0, 0.0, np.pi / 2 / 0.1])[: len(problem.labels)]
    with jax.enable_x64(True):
        groups = object_groups(problem, pc.Objects(rows, path), turned)
        labelled = problem.assigned(rows)
        states = np.zeros((len(labelled.epochs[0].time), 4))
        point = Point((states,), (states,), turned, np.zeros(0))
        values, coords = view_variables(labelled, point)
    found = groups["detection"]
    assert found["sensor"].values.tolist() == ["west", "east"]
    assert found["scans"].values.tolist() == [4, 4]
    assert found["detections"].values.tolist() == [8, 4]
    np.testing.assert_allclose(found["of_objects"], [2.5, 1.75])
    np.testing.assert_allclose(found["looks"], [3.5, 0.9 * 2])
    np.testing.assert_array_equal(values["view_range"][1], [100.0, np.nan])
    np.testing.assert_array_equal(values["detection_probability"][1], [0.9, 0.8])
    assert coords["viewing"] == ["east"]
    seen = xr.DataArray(values["view"][1][0], {"y": coords["view_y"], "x": coords["view_x"]}, ("y", "x"))
    assert float(seen.sel(x=50.0, y=20.0, method="nearest")) == 0.9
    assert float(seen.sel(x=50.0, y=-5.0, method="nearest")) == 0.0


@pytest.mark.slow
def test_equal_views_of_two_sensors_both_hide_what_is_outside():
    """Two `Sector` that are equal and not the same: what is 5 m from one sensor is not seen by the other."""
    near = [pc.Detection(1.0, clutter=0.0, view=pc.Sector(range=10.0)) for _ in range(2)]
    nodes = [pc.Node("west", (0.0, 0.0)), pc.Node("east", (100.0, 0.0), scale=1.0)]
    network = pc.Network([radar.on(node, detection=own) for node, own in zip(nodes, near, strict=True)])
    paths = {"target": np.tile([5.0, 0.0], (3, 1))}
    table = pc.simulate(network, pc.ConstantVelocity(0.5), np.arange(3.0), biases={}, tracks=paths).table
    assert table["range"].notna().groupby(table["sensor"]).sum().to_dict() == {"east": 0, "west": 3}
