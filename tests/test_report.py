"""The report and its pictures, from trees written by hand: nothing but names in a tree is needed."""

import base64
import html
import json
import os
import re

import numpy as np
import pytest
import xarray as xr

pytest.importorskip("matplotlib")
pytest.importorskip("jinja2")
pytest.importorskip("bokeh")

from bokeh.models import ColumnDataSource
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from probcal import InputError, LocalFrame, plots
from probcal.plots import base, interactive, scene
from probcal.report import page as sheet
from probcal.report import tables, write_report
from probcal.report import words as said
from probcal.status import INVALID

AXES = ("x", "y", "z")
EPOCHS = 5_000


def calibration(labels, scale, status):
    count = len(labels)
    sd = scale * np.linspace(0.1, 0.9, count)
    mean = scale * np.linspace(-1.0, 1.0, count)
    columns = {
        "mean": mean,
        "sd": sd,
        "lower": mean - 1.6 * sd,
        "upper": mean + 1.6 * sd,
        "gamma": 1 - (sd / scale) ** 2,
        "precision": np.ones(count),
        "scale": scale,
        "status": status,
        "unit": np.full(count, "m"),
        "kind": np.full(count, "scale"),
        "owner": [str(label).rpartition(".")[0] for label in labels],
    }
    return xr.Dataset(
        {name: ("bias_label", value) for name, value in columns.items()}
        | {"covariance": (("bias_label", "bias_label_other"), np.diag(sd**2))},
        coords={"bias_label": labels, "bias_label_other": labels},
    )


def tracked(dimension, owners, start=1):
    """Tracks by target of epochs that have these owners, a group each."""
    mean = np.cumsum(np.random.default_rng(start).normal(size=(len(owners), dimension)), 0)
    axes, found = [f"position_{axis}" for axis in AXES[:dimension]], {}
    for name in dict.fromkeys(owners.tolist()):
        own = mean[owners == name]
        values = {"mean": own, "sd": np.ones_like(own), "before": own + 3.0}
        found[f"track/{name}"] = xr.Dataset(
            {key: (("time", "component"), value) for key, value in values.items()},
            coords={"component": axes, "time": np.flatnonzero(owners == name) * 1.0},
            attrs={"target": name},
        )
    return found


def residuals(count=300):
    rng = np.random.default_rng(2)
    before, after = rng.normal(2.0, 3.0, count), rng.normal(size=count)
    before[0] = 1e3
    return xr.Dataset(
        {
            "before": ("datum", before),
            "after": ("datum", after),
            "std": ("datum", np.ones(count)),
            "weight": ("datum", np.ones(count)),
        },
        coords={"channel": ("datum", np.where(np.arange(count) % 3 == 0, "azimuth", "range"))},
    )


def make(dimension=2, nodes=("north", "south"), status="converged", recursions=1):
    """A fit of radars with free positions, headings and range offsets."""
    names = [*(f"position_{axis}" for axis in AXES[:dimension]), "heading", "range_offset"]
    labels = [f"{node}.{name}" for node in nodes for name in names]
    states = np.full(len(labels), "estimated", dtype="U16")
    states[1] = "pruned"
    if status in INVALID:
        states[0] = status
    tracks = tracked(dimension, np.where(np.arange(EPOCHS) % 2, "car", "lorry"))
    tracks |= tracked(dimension, np.array(["tree_a", "tree_b"])) if recursions == 2 else {}
    position = 40.0 * np.random.default_rng(3).normal(size=(len(nodes), dimension))
    groups = {
        "calibration": calibration(labels, np.full(len(labels), 10.0), states),
        **tracks,
        "residual": residuals(),
        "optimisation": xr.Dataset({"objective": ("iteration", [-300.0, -250.0, -249.0])}),
        "constant_data": xr.Dataset(
            {
                "node_position": (("node", "axis"), position),
                "node_heading": ("node", np.zeros(len(nodes))),
                "moving": ("node", np.zeros(len(nodes), bool)),
            },
            coords={
                "node": list(nodes),
                "axis": list(AXES[:dimension]),
                "placed_sensor": ("placement", [f"radar_{node}" for node in nodes]),
                "placed_node": ("placement", list(nodes)),
            },
        ),
    }
    tree = xr.DataTree.from_dict(groups)
    tree.attrs.update(
        method="EA", prior="ARD", status=status, message="What the fit has to say.", seed=7, data="rows.csv",
        intervals="plug-in", interval_probability=0.89, versions='{"probcal": "0.1.0"}', log_evidence=-249.0,
    )  # fmt: skip
    return tree


def add_extras(tree):
    """Truth of some biases, a weak direction, a noise level, a fixed bias, scores."""
    labels = tree["calibration"]["bias_label"].values
    tree["truth"] = xr.DataTree(xr.Dataset({"bias": ("bias_label", [4.321, -1.0])}, coords={"bias_label": labels[:2]}))
    tree["direction"] = xr.DataTree(
        xr.Dataset(
            {
                "information": ("direction", [0.5, 0.1]),
                "sentence": (
                    "direction",
                    ["turn of all: anchor a heading", "shift of all: anchor a position"],
                ),
                "vector": (("direction", "bias_label"), np.ones((2, len(labels)))),
            }
        )
    )
    tree["level"] = xr.DataTree(
        xr.Dataset({"std": ("level", [1.25]), "guess": ("level", [1.0])}, coords={"level": ["radar.range_std"]})
    )
    nodes = tree["constant_data"].to_dataset()
    nodes["fixed"] = ("fixed_label", [0.25])
    tree["constant_data"] = xr.DataTree(nodes.assign_coords(fixed_label=["mast.heading"]))
    tree.attrs.update(position_rmse_before=12.34567, position_rmse_after=1.5, model="radars.py")
    return tree


def pictures(page):
    """The embedded pictures as text."""
    found = re.findall(r'src="data:image/svg\+xml;base64,([^"]*)"', page)
    return [base64.b64decode(text, validate=True).decode() for text in found]


def words(page):
    """What a reader sees, without pictures, style and scripts."""
    page = re.sub(r"<(style|script).*?</\1>", " ", page.replace("<wbr>", ""), flags=re.DOTALL)
    return html.unescape(re.sub(r"<[^>]*>", " ", page))


def page_of(tree, folder, static=True):
    return write_report(tree, folder / "report.html", static=static).read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("dimension", "recursions", "status"),
    [(2, 1, "converged"), (2, 2, "not converged"), (3, 2, "at bound"), (2, 1, "diverged")],
)
def test_report_is_complete_and_self_contained(tmp_path, dimension, recursions, status):
    tree = make(dimension, status=status, recursions=recursions)
    page = page_of(tree, tmp_path)
    text = words(page)
    for label in tree["calibration"]["bias_label"].values:
        assert f">{label}<" in page.replace("<wbr>", "")
    assert "What the fit has to say." in text
    assert "EA" in text and "ARD" in text and "rows.csv" in text and "plug-in" in text  # noqa: PT018
    assert "Seed 7. Versions: probcal 0.1.0." in text
    assert not re.search(r"\bnan\b|\binf\b|\bNone\b", text, re.IGNORECASE)
    drawn = pictures(page)
    assert len(drawn) == 4
    for part in (page, *drawn):
        assert not re.search(r"""(src|href)\s*=\s*["']?\s*(https?:|//|file:)""", part, re.IGNORECASE)
        assert "<script" not in part
        assert not re.search(r"@import|url\(\s*['\"]?(https?:|//)", part)


@pytest.mark.parametrize("static", [True, False])
def test_the_same_tree_gives_the_same_page(tmp_path, static):
    assert page_of(make(), tmp_path, static) == page_of(make(), tmp_path, static)


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_interactive_page_loads_nothing_and_stays_small(tmp_path, dimension):
    tree = make(dimension, recursions=2)
    paths = np.random.default_rng(0).normal(size=(40_000, 2)).cumsum(0)  # more than is drawn
    for name in ("car", "lorry"):
        values = dict.fromkeys(("mean", "sd", "before", "true"), (("time", "component"), paths))
        coords = {"component": ["position_x", "position_y"], "time": np.arange(40_000.0)}
        if dimension == 2:
            tree[f"track/{name}"] = xr.DataTree(xr.Dataset(values, coords, attrs={"target": name}))
    page = page_of(tree, tmp_path, static=False)
    assert len(page) < 3_000_000
    assert not re.search(r"""<(script|link|img|iframe)[^>]*(src|href)\s*=\s*["']?\s*(https?:|//|file:)""", page)
    data = json.loads(re.search(r'id="map-data">(.*?)</script>', page, re.DOTALL)[1])
    assert data["root_id"] == "m1"
    layers = json.loads(re.search(r'id="map-layers">(.*?)</script>', page, re.DOTALL)[1])
    assert [tag for tag, _ in layers if tag != "truth"] == ["before", "after", "ellipses", "names"]
    assert page.index("<noscript>") < page.index("The biases that matter") < page.index("<details")


def test_the_verdict_is_one_sentence_and_what_matters_comes_first():
    tree = make()
    group = tree["calibration"].to_dataset()
    verdicts = ["determined"] * 8
    verdicts[3], verdicts[4], verdicts[5] = "conflicting", "weak", "prior only"
    group = group.assign(mean=("bias_label", [0.0] * 7 + [9.0])).assign(
        lower=("bias_label", [-1.0] * 7 + [8.0]), upper=("bias_label", [1.0] * 7 + [10.0])
    )
    tree["calibration"] = xr.DataTree(group)
    tree["verdict"] = xr.DataTree(
        xr.Dataset(dict.fromkeys(("verdict", "reason"), ("bias_label", verdicts))).assign_coords(
            bias_label=group["bias_label"]
        )
    )
    line = said.headline(tree)
    assert line.startswith(
        "The fit converged: 1 of 8 biases differs from zero, most clearly south.range_offset at 9.0 ±"
    )
    assert line.endswith("; 5 determined, 1 conflicting, 1 weak, 1 prior only.")
    assert said.left_open(tree) == "The data alone do not tell 2 of 8 biases: south.position_x, south.position_y."
    assert said.next_step(tree) == "No check asks for a change of the model."
    open_one = {"direction": ["all along x"], "remedy": ["survey south"], "information": [0.1]}
    tree["direction"] = xr.DataTree(xr.Dataset({name: ("direction", own) for name, own in open_one.items()}))
    assert said.left_open(tree).endswith("; left open: all along x.")
    assert said.next_step(tree) == "To tell all along x: survey south."
    columns = {"kind": ["loo", "slope"], "sentence": ["rows are badly predicted", "south.range bends"]}
    tree["finding"] = xr.DataTree(xr.Dataset({name: ("finding", own) for name, own in columns.items()}))
    assert said.next_step(tree) == "To look at first: south.range bends."
    rows, left = said.that_matter(tree)
    assert [row.label for row in rows] == ["north.range_offset", "south.range_offset", "south.position_x"]
    assert left == 0
    assert said.in_conflict(tree)


@pytest.mark.parametrize(
    ("status", "text"),
    [
        ("not converged", "The fit did not converge: its numbers are no answer."),
        ("at bound", "The fit ended at bound: its numbers are no estimate."),
    ],
)
def test_the_verdict_on_no_answer(status, text):
    assert said.headline(make(status=status)) == text


def test_labels_go_on_behind_a_point_or_underscore_only():
    assert str(said.breakable("mast_12.range_offset")) == "mast_<wbr>12.<wbr>range_<wbr>offset"
    assert str(said.breakable("<b>.x")) == "&lt;b&gt;.<wbr>x"


def test_meridians_lie_where_the_frame_puts_them():
    frame = LocalFrame(48.0, 11.0, 500.0)
    for dimension in (2, 3):
        lines = dict(interactive.graticule(frame, np.array([-3e3, -2e3]), np.array([3e3, 2e3]), dimension))
        assert {"48° N", "11° E"} <= set(lines)
        assert 6 < len(lines) < 40
        np.testing.assert_allclose(lines["11° E"][:, 0], 0.0, atol=1e-6)
        nearest = np.abs(lines["48° N"]).min(0)
        assert nearest[1] < 1.0
        for text, line in lines.items():
            latitude, longitude = frame.to_geodetic(line if dimension == 2 else np.c_[line, np.zeros(len(line))])[:2]
            stated, side = text.split("° ")
            found = latitude if side in "NS" else longitude
            np.testing.assert_allclose(found, float(stated), atol=1e-4)


def test_the_truth_and_the_frame_are_on_the_map():
    tree = make()
    tree["track/car"]["true"] = tree["track/car"]["mean"] + 1.0
    tree["constant_data"].attrs.update(latitude=48.0, longitude=11.0, height=0.0)
    shown = scene.scene(tree)
    assert shown.frame == LocalFrame(48.0, 11.0)
    assert interactive.layers(shown)["truth"] == "truth"
    ax = plots.plot_map(tree)
    assert "truth" in [text.get_text() for text in ax.get_legend().get_texts()]
    drawn = plots.interactive_map(tree)
    assert any("° N" in str(source.data.get("text", "")) for source in drawn.select({"type": ColumnDataSource}))


def test_extras_are_shown_where_the_tree_has_them(tmp_path):
    text = words(page_of(add_extras(make()), tmp_path))
    for shown in (
        "radars.py",
        "4.3",
        "12.3 m",
        "1.5 m",
        "radar.range_std",
        "1.25",
        "mast.heading",
        "true value",
    ):
        assert shown in text
    assert text.index("shift of all") < text.index("turn of all")
    plain = words(page_of(make(), tmp_path))
    for absent in ("true value", "Weak directions", "Unknown noise", "Fixed biases", "RMSE"):
        assert absent not in plain


@pytest.mark.parametrize("status", INVALID)
def test_a_fit_that_is_no_answer_is_marked_invalid(tmp_path, status):
    page = page_of(make(status=status), tmp_path)
    assert '<table class="cards biases invalid">' in page
    assert "Estimate invalid" in words(page)
    assert page.count('<tr class="bad">') == 1


@pytest.mark.parametrize("status", ["converged", "not converged"])
def test_other_fits_are_not_marked_invalid(tmp_path, status):
    assert "estimate invalid" not in words(page_of(make(status=status), tmp_path)).lower()


def test_labels_and_attributes_are_escaped(tmp_path):
    nodes = ("<b>north</b>", "a & $b$")
    tree = make(nodes=nodes)
    tree.attrs["message"] = '<script>alert("x")</script>'
    page = page_of(tree, tmp_path)
    assert "<script" not in page
    assert "<b>" not in page
    assert "&lt;b&gt;north&lt;/b&gt;.position_x" in page.replace("<wbr>", "")
    whole = page_of(tree, tmp_path, static=False)
    assert "<b>north" not in whole
    assert whole.count("<script") == 4  # Bokeh, two data, one of the page
    for label in tree["calibration"]["bias_label"].values:
        assert label in words(page)


def test_numbers_that_do_not_exist_are_dashes(tmp_path):
    tree = make(status="diverged")
    for name in ("mean", "sd", "lower", "upper", "gamma"):
        tree["calibration"][name][0] = np.nan
    tree["calibration"]["covariance"][0] = np.nan
    tree["track/car"]["mean"][:10] = np.nan
    for node in tree["track"].children.values():
        node["before"][:] = np.nan
    tree["residual"]["before"][:] = np.nan
    text = words(page_of(tree, tmp_path))
    assert said.NONE in text
    assert not re.search(r"\bnan\b", text, re.IGNORECASE)


def test_a_tree_without_tracks_and_trace_has_fewer_pictures(tmp_path):
    tree = make()
    del tree["optimisation"], tree["track"]
    assert len(pictures(page_of(tree, tmp_path))) == 2


@pytest.mark.parametrize("broken", ["render", "replace"])
def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch, broken):
    path = tmp_path / "report.html"
    path.write_text("old")

    def fail(*_):
        raise OSError("no")

    if broken == "render":
        monkeypatch.setattr(sheet.plots, "plot_residuals", fail)
    else:
        monkeypatch.setattr(os, "replace", fail)
    with pytest.raises((OSError, InputError), match="no"):
        write_report(make(), path)
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["report.html"]


@pytest.mark.parametrize(
    ("value", "sd", "text"),
    [
        (0.0728123, 0.0027, "0.0728"),
        (-0.00001, 0.003, "0.0000"),
        (1234.567, 25.0, "1235"),
        (123456.0, 2500.0, "123500"),
        (1e-12, 1e-13, "1e-12"),
        (2.5, 0.0, "2.5"),
        (np.nan, 1.0, "–"),
        (np.inf, 1.0, "–"),
    ],
)
def test_numbers_are_rounded_to_their_sd(value, sd, text):
    assert said.rounded(value, sd) == text


def test_map_thins_tracks_and_names_nodes():
    ax = plots.plot_map(make(3, recursions=2))
    assert max(len(line.get_xdata()) for line in ax.lines) <= base.POINTS
    assert {"north", "south"} <= {text.get_text() for text in ax.texts}
    assert "z not shown" in ax.get_title(loc="left")
    assert ax.get_aspect() == 1.0
    entries = [text.get_text() for text in ax.get_legend().get_texts()]
    assert [f"{name}, after" in entries for name in ("car", "lorry", "tree_a", "tree_b")] == [True] * 4


def test_map_ellipse_holds_the_stated_probability():
    tree = make(nodes=("north",))
    (ellipse,) = [patch for patch in plots.plot_map(tree).patches if isinstance(patch, Ellipse)]
    group = tree["calibration"].to_dataset()
    sides = sorted(float(group["sd"].sel(bias_label=f"north.position_{axis}")) for axis in "xy")
    radius = np.sqrt(-2 * np.log(0.11))
    np.testing.assert_allclose(sorted([ellipse.width, ellipse.height]), 2 * radius * np.array(sides))
    stated = tree["constant_data"]["node_position"].values[0]
    shift = [float(group["mean"].sel(bias_label=f"north.position_{axis}")) for axis in "xy"]
    np.testing.assert_allclose(ellipse.center, stated + shift)


def test_small_displacements_are_drawn_at_a_scale_that_the_legend_names():
    tree = make(nodes=("north",))
    group = tree["calibration"].to_dataset()
    shift = np.array([0.4, 0.0])  # of some kilometres
    group["mean"][:2], group["covariance"][:2, :2] = shift, 0.01 * np.eye(2)
    tree["calibration"] = xr.DataTree(group)
    ax = plots.plot_map(tree)
    (label,) = [text.get_text() for text in ax.get_legend().get_texts() if "ellipse" in text.get_text()]
    times = float(re.search(r"ellipse \N{MULTIPLICATION SIGN} (\d+)", label)[1])
    (ellipse,) = [patch for patch in ax.patches if isinstance(patch, Ellipse)]
    np.testing.assert_allclose(ellipse.center, tree["constant_data"]["node_position"].values[0] + times * shift)
    assert 0.04 < times * 0.4 / np.ptp(ax.get_xlim()) <= 0.12
    (left, right), reach = ax.get_xlim(), 0.5 * ellipse.width
    assert left < ellipse.center[0] - reach < ellipse.center[0] + reach < right
    tree["calibration"]["covariance"][:2, :2] = np.eye(2)
    assert not any("shift and" in text.get_text() for text in plots.plot_map(tree).get_legend().get_texts())


def test_map_ellipse_leans_with_the_correlation():
    tree = make(nodes=("north",))
    covariance = np.diag([1.0, 1.0, 1.0, 1.0])
    covariance[0, 1] = covariance[1, 0] = 0.9
    tree["calibration"]["covariance"][:] = covariance
    (ellipse,) = [patch for patch in plots.plot_map(tree).patches if isinstance(patch, Ellipse)]
    long = ellipse.angle if ellipse.width > ellipse.height else ellipse.angle + 90
    assert long % 180 == pytest.approx(45)


def test_map_draws_calibrated_headings():
    tree = make()
    nodes = tree["constant_data"].to_dataset().assign(node_heading=("node", [np.pi / 2, 0.0]))
    tree["constant_data"] = xr.DataTree(nodes)
    (arrows,) = plots.plot_map(tree).collections
    turn = tree["calibration"].to_dataset()["mean"].sel(bias_label=["north.heading", "south.heading"]).values
    np.testing.assert_allclose(
        np.arctan2(arrows.V, arrows.U), np.angle(np.exp(1j * (np.array([np.pi / 2, 0.0]) + turn)))
    )


def test_forest_shows_scales_status_and_truth():
    ax = plots.plot_biases(add_extras(make(status="at bound")))
    dots = next(c for c in ax.collections if len(c.get_offsets()) == 8)
    np.testing.assert_allclose(np.asarray(dots.get_offsets())[:, 0], np.linspace(-1, 1, 8))
    assert [text.get_text() for text in ax.texts] == ["at bound", "pruned"]
    crosses = next(line for line in ax.lines if line.get_marker() == "x")
    np.testing.assert_allclose(crosses.get_xdata()[:2], [0.4321, -0.1])


def test_forest_of_many_biases_says_what_it_leaves_out():
    tree = make(nodes=[f"mast_{k}" for k in range(60)], status="at bound")
    tree["calibration"]["status"][120] = "diverged"  # of a small mean
    ax = plots.plot_biases(tree)
    assert len(ax.get_yticks()) == base.ROWS
    assert ax.get_title(loc="left").startswith("120 of 240 biases")
    assert "diverged" in [text.get_text() for text in ax.texts]


def test_residuals_have_one_axes_a_channel_and_count_what_is_outside():
    axes = plots.plot_residuals(make())
    assert [ax.get_title(loc="left") for ax in axes] == ["azimuth (100 data)", "range (200 data)"]
    entries = [text.get_text() for text in axes[0].get_legend().get_texts()]
    outside = next(int(re.findall(r"\d+", entry)[0]) for entry in entries if entry.startswith("before ("))
    group = make()["residual"].to_dataset()
    azimuth = group["before"].values[group["channel"].values == "azimuth"]
    assert outside == (np.abs(azimuth) > axes[0].get_xlim()[1]).sum() > 0


def test_gamma_is_sorted_and_readable_for_many():
    few, many = plots.plot_gamma(make()), plots.plot_gamma(make(nodes=[f"mast_{k}" for k in range(60)]))
    assert few.get_xticklabels()[0].get_text() == "south.range_offset"
    assert many.get_xlabel() == "bias, sorted by gamma"


def test_objective_names_the_evidence():
    tree = make()
    assert plots.plot_objective(tree).get_ylabel() == "log evidence"
    del tree.attrs["log_evidence"]
    assert plots.plot_objective(tree).get_ylabel() == "objective"


def test_pictures_draw_into_given_axes():
    for draw in (plots.plot_map, plots.plot_biases, plots.plot_objective, plots.plot_gamma):
        ax = Figure().subplots()
        assert draw(make(), ax) is ax


def test_what_is_no_fit_is_refused(tmp_path):
    tracks = make()
    del tracks["calibration"]
    with pytest.raises(InputError, match="write_report: the tree has no group calibration; give a result of fit"):
        write_report(tracks, tmp_path / "report.html")
    with pytest.raises(InputError, match="the map needs a result of fit"):
        plots.plot_map(tracks)
    assert not list(tmp_path.iterdir())


def test_nothing_found_is_no_praise(tmp_path):
    tree = make()
    group = tree["calibration"].to_dataset()
    wide = {"lower": group["lower"] - 99.0, "upper": group["upper"] + 99.0}
    tree["calibration"] = xr.DataTree(group.assign(wide))
    assert "None differs from zero; the fit was not assessed." in words(page_of(tree, tmp_path))


def test_a_long_table_is_cut_and_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(tables, "BIASES", 3)
    assert "3 of 8 biases, those furthest from zero" in words(page_of(make(), tmp_path))


def test_targets_of_one_epoch_are_marks_on_the_map():
    tree = make(recursions=2)
    tree["track"] = tree["track"].drop_nodes(["car", "lorry"])
    drawn = plots.interactive_map(tree)
    marks = [r for r in drawn.renderers if "before" in r.tags and type(r.glyph).__name__ == "Scatter"]
    assert len(marks) == 1
