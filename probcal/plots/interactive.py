"""The map of a fit in a browser: zoom, a word on every node and epoch, layers before and after calibration."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr
from bokeh.layouts import column
from bokeh.models import (
    BasicTickFormatter,
    ColumnDataSource,
    DataRange1d,
    HoverTool,
    LayoutDOM,
    LinearColorMapper,
    WheelZoomTool,
)
from bokeh.models.annotations.legends import ColorBar, Legend, LegendItem
from bokeh.plotting import figure
from matplotlib.colors import LinearSegmentedColormap, to_hex
from matplotlib.ticker import MaxNLocator

from probcal.geodesy import LocalFrame
from probcal.labels import AXES
from probcal.plots.base import BEFORE, FAINT, LISTED, NAMED, SURE, colour, probability
from probcal.plots.scene import Outline, Scene, Track, ellipse, scene, thinned
from probcal.results.read import frame_of

POINTS = 5_000  # epochs of all tracks together
CORNERS = 32  # of an ellipse
ENCIRCLED = 500  # nodes above which there are no ellipses
LINES = 6  # meridians, and parallels, across the map
MIDDLE = "#767676"  # readable on white and on black
TEXT: dict[str, Any] = {"text_color": MIDDLE, "text_font_size": "12px"}
HEIGHTS = (320, 620)  # px of the plan
LAYERS = {
    "before": "before calibration", "after": "after", "truth": "truth", "mirror": "fits as well",
    "objects": "objects by existence", "views": "views", "ellipses": "ellipses", "names": "names",
}  # fmt: skip


def interactive_map(tree: xr.DataTree) -> LayoutDOM:
    """Map of a fit for the browser, a Bokeh layout: `bokeh.io.show` shows it, also in a notebook.

    Nodes as stated and calibrated with their ellipses and headings, tracks before and after calibration, the truth
    where `add_scores` has met it, meridians and parallels where the network has a `frame`. Every node and epoch has a
    word. Of detections that nobody named also the objects, coloured by existence, and what each sensor sees. In 3-D a
    second panel shows the heights. Layers carry a tag: before, after, truth, mirror, objects, views, ellipses, names.

    >>> interactive_map(tree).select_one({"name": "map"}).x_range.name
    'x'
    """
    whole = scene(tree)
    most, of_object = (max(2, POINTS // max(len(own), 1)) for own in (whole.tracks, whole.objects))
    shown = replace(
        whole,
        tracks=[thinned(own, most) for own in whole.tracks],
        mirrored=[thinned(own, most) for own in whole.mirrored],
        objects=[thinned(own, of_object) for own in whole.objects],
    )
    sources = _sources(tree, shown)
    plan = _panel(shown, sources, (0, 1), probability(tree))
    if shown.dimension == 2:
        return plan
    heights = _panel(shown, sources, (0, 2), probability(tree))
    heights.x_range = plan.x_range
    return column(plan, heights, sizing_mode="stretch_width")


def layers(shown: Scene) -> dict[str, str]:
    """Tags of the layers that a map has, and what they are called."""
    has = {
        "before": bool(shown.tracks), "after": bool(shown.tracks),
        "mirror": bool(shown.mirrored) or len(shown.elsewhere) > 0,
        "truth": any(np.isfinite(track.true).any() for track in shown.tracks),
        "objects": bool(shown.objects), "views": bool(shown.views),
        "ellipses": _encircled(shown), "names": len(shown.nodes.name) <= NAMED,
    }  # fmt: skip
    return {tag: text for tag, text in LAYERS.items() if has[tag]}


def _encircled(shown: Scene) -> bool:
    return bool(shown.nodes.free.any()) and len(shown.nodes.name) <= ENCIRCLED


# Data


def _sources(tree: xr.DataTree, shown: Scene) -> dict[str, ColumnDataSource]:
    """Columns that all panels share: epochs, nodes."""
    nodes, d = shown.nodes, shown.dimension
    tracks, sizes = shown.tracks, [len(track.time) for track in shown.tracks]
    epochs = {
        "target": np.repeat([track.target for track in tracks], sizes).tolist(),
        "time": np.concatenate([np.empty(0), *(track.time for track in tracks)]),
        "colour": np.repeat([colour(k) for k in range(len(tracks))], sizes).tolist(),
    }
    places = np.concatenate([np.empty((0, d)), *(track.after for track in tracks)])
    sds = np.concatenate([np.empty((0, d)), *(track.sd for track in tracks)]).astype("f4")
    for axis in range(d):
        epochs[AXES[axis]], epochs[f"sd_{AXES[axis]}"] = places[:, axis], sds[:, axis]
    points = {"name": nodes.name.tolist(), "words": list(_words(tree, shown))}
    for axis in range(d):
        points[AXES[axis]], points[f"to_{AXES[axis]}"] = nodes.stated[:, axis], nodes.calibrated[:, axis]
    return {"epochs": ColumnDataSource(data=epochs), "nodes": ColumnDataSource(data=points)}


def _words(tree: xr.DataTree, shown: Scene) -> Iterator[str]:
    """The map's text on each node: its position, its biases and those of its sensors."""
    constant, said = tree["constant_data"].to_dataset(), dict[str, list[str]]()
    for row in frame_of(tree, "calibration", "owner", "mean", "sd", "unit").itertuples():
        value = f"{row.mean:.4g} ± {row.sd:.2g} {'' if row.unit == '1' else row.unit}".rstrip()
        said.setdefault(row.owner, []).append(f"{row.Index.removeprefix(f'{row.owner}.')} {value}")
    placed = list(zip(constant["placed_node"].values, constant["placed_sensor"].values, strict=True))
    for name, place in zip(shown.nodes.name.tolist(), shown.nodes.stated, strict=True):
        owners = dict.fromkeys([name, *(sensor for node, sensor in placed if node == name)])
        own = [text for owner in owners for text in said.get(owner, [])]
        more = [f"and {len(own) - LISTED} more"] if len(own) > LISTED else []
        where = ", ".join(f"{axis} {value:.6g}" for axis, value in zip(AXES, place, strict=False))
        yield "\n".join([f"stated {where} m", *own[:LISTED], *more])


# Panels


def _panel(shown: Scene, sources: dict[str, ColumnDataSource], axes: tuple[int, int], probability: float) -> figure:
    """One plane of the map."""
    x, y = (AXES[axis] for axis in axes)
    plane, flat = list(axes), axes == (0, 1)
    wheel = WheelZoomTool(modifiers={"ctrl": True})
    wide, tall = (shown.high - shown.low)[plane]
    height = int(np.clip(800 * tall / wide, *HEIGHTS)) if flat else HEIGHTS[0] // 4 * 3
    sheet = figure(
        name="map" if flat else "heights", sizing_mode="stretch_width", height=height, match_aspect=flat,
        tools=["pan", "box_zoom", wheel, "zoom_in", "zoom_out", "reset", "save"], active_scroll=wheel,
        x_axis_label=f"{x} in m", y_axis_label=f"{y} in m", toolbar_location="above",
        background_fill_alpha=0.0, border_fill_alpha=0.0, outline_line_color=MIDDLE,
    )  # fmt: skip
    sheet.toolbar.logo = None
    sheet.axis.formatter = BasicTickFormatter(use_scientific=False)
    (left, bottom), (right, top) = low, high = shown.low[plane], shown.high[plane]
    frame = sheet.quad(left=left, right=right, bottom=bottom, top=top, alpha=0.0)  # what the limits hold
    sheet.x_range, sheet.y_range = (DataRange1d(name=name, renderers=[frame], range_padding=0.0) for name in (x, y))
    sheet.grid.visible = not flat or shown.frame is None
    sheet.grid.grid_line_color, sheet.grid.grid_line_alpha = MIDDLE, 0.25
    if flat and shown.frame is not None:
        # meridians and parallels at round degrees over three times the map, named where they enter it
        lines: list[Any] = list(graticule(shown.frame, low, high, shown.dimension))
        xs, ys = ([line[:, axis] for _, line in lines] for axis in (0, 1))
        sheet.multi_line(xs, ys, line_color=MIDDLE, line_alpha=0.45, line_dash="dotdash")
        inside = [(text, line[((line > low) & (line < high)).all(1)][:1]) for text, line in lines]
        named = [text for text, place in inside if len(place)]
        at = np.concatenate([np.empty((0, 2)), *(place for _, place in inside)])
        sheet.text(at[:, 0], at[:, 1], text=named, x_offset=3, y_offset=-2, **TEXT)
    if flat:
        _draw_views(sheet, shown.views)
    _draw_objects(sheet, shown, plane)
    _draw_tracks(sheet, shown, sources["epochs"], plane)
    _draw_nodes(sheet, shown, sources["nodes"], plane, probability)
    return sheet


def _draw_views(sheet: figure, views: list[Outline]) -> None:
    """Draws the limit of the view of each sensor; filled if one line goes round it."""
    lines = [
        (*line.T, colour(k), 0.05 if own.whole else 0.0, own.sensor)
        for k, own in enumerate(views)
        for line in own.lines
    ]
    if lines:
        names = ("xs", "ys", "colour", "fill", "sensor")
        source = ColumnDataSource(data=dict(zip(names, map(list, zip(*lines, strict=True)), strict=True)))
        _tagged("views", sheet.patches("xs", "ys", source=source, color="colour", alpha="fill", line_color=None))
        ends = sheet.multi_line("xs", "ys", source=source, line_color="colour", line_dash="dotdash", line_alpha=0.7)
        said = "<b>@sensor</b><div>its view ends here</div>"
        _hover(sheet, [_tagged("views", ends)], said, name="views", visible=False)


def _draw_objects(sheet: figure, shown: Scene, plane: list[int]) -> None:
    """Objects that nobody named, by existence, with a bar that says which colour is how sure."""
    if not shown.objects:
        return
    tracks = shown.objects
    sure = np.concatenate([own.existence[1:] for own in tracks])
    columns = {
        "name": [own.name for own in tracks for _ in own.time[1:]],
        "time": np.concatenate([own.time[1:] for own in tracks]), "existence": sure, "opacity": 0.2 + 0.7 * sure,
    }  # fmt: skip
    for name, axis in zip("xy", plane, strict=True):
        columns[f"{name}0"] = np.concatenate([own.position[:-1, axis] for own in tracks])
        columns[f"{name}1"] = np.concatenate([own.position[1:, axis] for own in tracks])
    tint = LinearColorMapper(
        palette=[to_hex(colour) for colour in LinearSegmentedColormap.from_list("", [FAINT, SURE], 64)(range(64))],
        low=0.0,
        high=1.0,
    )
    band = sheet.segment(
        "x0", "y0", "x1", "y1", source=ColumnDataSource(data=columns), line_width=5, line_alpha="opacity",
        line_color={"field": "existence", "transform": tint},
    )  # fmt: skip
    said = "<b>@name</b><div>time @time{0.000} s</div><div>existence @existence{0.00}</div>"
    _hover(sheet, [_tagged("objects", band)], said, name="objects", description="Objects")
    if plane == [0, 1]:
        bar = ColorBar(
            color_mapper=tint, title="existence", width=10, height=120, background_fill_alpha=0.0, location=(0, 0),
            major_label_text_color=MIDDLE, title_text_color=MIDDLE, major_tick_line_color=None, bar_line_color=MIDDLE,
        )  # fmt: skip
        sheet.add_layout(_tagged("objects", bar), "right")


def _draw_tracks(sheet: figure, shown: Scene, epochs: ColumnDataSource, plane: list[int]) -> None:
    """Lines by layer, and a dot at each epoch that says where it is."""
    tracks = shown.tracks

    def lines(tag: str, chosen: Sequence[Track], part: str, **style: Any) -> Any:
        xs, ys = ([getattr(track, part)[:, axis] for track in chosen] for axis in plane)
        tints = [colour(k) for k in range(len(chosen))]
        return _tagged(tag, sheet.multi_line(xs, ys, **({"line_color": tints} | style)))

    if not tracks:
        return
    alone = [track for track in tracks if len(track.time) == 1]  # a line of one point is none
    marks = (("before", "before", "circle", BEFORE), ("truth", "true", "x", MIDDLE))
    for tag, part, marker, tint in marks if alone else ():
        u, v = np.array([getattr(track, part)[0, plane] for track in alone]).T
        _tagged(tag, sheet.scatter(u, v, marker=marker, size=6, fill_color=tint, line_color=tint))
    lines("before", tracks, "before", line_color=BEFORE, line_width=1)
    after = lines("after", tracks, "after", line_width=1.5)
    if any(np.isfinite(track.true).any() for track in tracks):
        lines("truth", tracks, "true", line_color=MIDDLE, line_dash="dotted", line_width=2)
    for way in shown.elsewhere:
        u, v = way[:, plane].T
        _tagged("mirror", sheet.line(u, v, line_dash="dashed", line_color=MIDDLE))
        _tagged("mirror", sheet.scatter(u[1:], v[1:], size=9, fill_color=None, line_color=MIDDLE))
    if shown.mirrored:
        lines("mirror", shown.mirrored, "after", line_dash="dashed", line_width=1.5)
    x, y = (AXES[axis] for axis in plane)
    size = 6 if len(alone) == len(tracks) else 3
    dots = _tagged("after", sheet.scatter(x, y, source=epochs, size=size, fill_color="colour", line_color=None))
    axes = AXES[: shown.dimension]
    where = "".join(f"<div>{axis} @{axis}{{0.000}} ± @sd_{axis}{{0.000}} m</div>" for axis in axes)
    said = f"<b>@target</b><div>time @time{{0.000}} s</div>{where}"
    _hover(sheet, [dots], said, name="epochs", description="Epochs")
    if plane == [0, 1] and 1 < len(tracks) <= LISTED:
        items = [LegendItem(label=track.target, renderers=[after], index=k) for k, track in enumerate(tracks)]
        key: dict[str, Any] = {"items": items, "border_line_color": None, "background_fill_alpha": 0.5}
        sheet.add_layout(Legend(**key), "center")


def _draw_nodes(sheet: figure, shown: Scene, source: ColumnDataSource, plane: list[int], probability: float) -> None:
    """Stated and calibrated places, ellipses, headings, names."""
    nodes, (x, y) = shown.nodes, (AXES[axis] for axis in plane)
    moved = nodes.calibrated[:, plane]
    if _encircled(shown):
        spread = nodes.covariance[:, plane][:, :, plane]
        known = nodes.free & np.isfinite(moved).all(1) & np.isfinite(spread).all((1, 2))
        rings = np.reshape([_ring(moved[k], spread[k], probability) for k in np.flatnonzero(known)], (-1, 2, CORNERS))
        style: dict[str, Any] = {"fill_color": MIDDLE, "fill_alpha": 0.2, "line_color": MIDDLE}
        _tagged("ellipses", sheet.patches(list(rings[:, 0]), list(rings[:, 1]), **style))
    sheet.segment(x, y, f"to_{x}", f"to_{y}", source=source, line_color=MIDDLE, line_width=1.5)
    turned = np.isfinite(nodes.heading)
    if plane == [0, 1] and turned.any():
        size = 0.04 * float((shown.high - shown.low)[:2].max())
        heading = nodes.heading[turned]
        tips = moved[turned] + size * np.stack([np.cos(heading), np.sin(heading)], 1)
        sheet.segment(*moved[turned].T, *tips.T, line_color="#d00000", line_width=2)
    stated = sheet.scatter(x, y, source=source, marker="square", size=10, fill_color=None, line_color=MIDDLE)
    found = sheet.scatter(f"to_{x}", f"to_{y}", source=source, size=6, fill_color=MIDDLE, line_color=None)
    said = '<b>@name</b><div style="white-space: pre-line">@words</div>'
    _hover(sheet, [stated, found], said, name="nodes", description="Nodes")
    if plane == [0, 1] and len(nodes.name) <= NAMED:
        at = nodes.named
        inner = at[:, 0] < shown.low[0] + 0.75 * (shown.high - shown.low)[0]  # names stay on the sheet
        side = {
            "x_offset": np.where(inner, 8, -8), "text_align": np.where(inner, "left", "right").tolist()
        }  # fmt: skip
        _tagged("names", sheet.text(at[:, 0], at[:, 1], text=nodes.name.tolist(), y_offset=-6, **side, **TEXT))


def _tagged(layer: str, renderer: Any) -> Any:
    renderer.tags = [layer]
    return renderer


def _hover(sheet: figure, renderers: list[Any], text: str, **options: Any) -> None:
    """Show a text where the pointer is on what is drawn."""
    sheet.add_tools(HoverTool(renderers=renderers, tooltips=text, **options))


def _ring(centre: np.ndarray, covariance: np.ndarray, probability: float) -> np.ndarray:
    """Corners (2, CORNERS) of an ellipse."""
    width, height, angle = ellipse(covariance, probability)
    turn = np.exp(1j * np.linspace(0.0, 2 * np.pi, CORNERS, endpoint=False))
    corners = np.exp(1j * angle) * (width / 2 * turn.real + 0.5j * height * turn.imag)
    return np.stack([centre[0] + corners.real, centre[1] + corners.imag])


# Meridians and parallels


def graticule(frame: LocalFrame, low: np.ndarray, high: np.ndarray, dimension: int) -> Iterator[tuple[str, np.ndarray]]:
    """Name and places (P, 2) in m of each meridian and parallel over three times the box from `low` to `high`."""
    middle, reach = (low + high) / 2, 1.5 * (high - low)
    sides = [np.linspace(m - r, m + r, 9) for m, r in zip(middle, reach, strict=True)]
    grid = np.stack(np.meshgrid(*sides), -1)
    corners = grid if dimension == 2 else np.concatenate([grid, np.zeros((*grid.shape[:2], 1))], -1)
    latitude, longitude = frame.to_geodetic(corners)[:2]
    longitude = frame.longitude + (longitude - frame.longitude + 180.0) % 360.0 - 180.0
    spans = [(part.min(), part.max()) for part in (latitude, longitude)]
    height = [] if dimension == 2 else [frame.height]
    for own, (first, last) in enumerate(spans):
        values: Any = MaxNLocator(3 * LINES, steps=[1, 2, 5, 10]).tick_values(first, last)
        along = np.linspace(*spans[1 - own], 61)
        for value in values[(values >= first) & (values <= last)]:
            place = [np.full(len(along), value), along]
            shown = value if own == 0 else (value + 180.0) % 360.0 - 180.0
            side = ("NS", "EW")[own][int(shown < 0)]
            text = f"{np.format_float_positional(abs(round(shown, 9)), trim='-')}° {side}"
            yield text, frame.to_local(*(place if own == 0 else place[::-1]), *height)[:, :2]
