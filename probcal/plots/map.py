"""The map of a fit, for print: nodes and tracks before and after calibration."""

from collections.abc import Sequence

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon

from probcal.plots.base import (
    ALL_POINTS,
    BEFORE,
    FEW,
    PALE,
    POINTS,
    REACH,
    SURE,
    colour,
    ellipse_patch,
    figure_of,
    finish,
    name_places,
    new_axes,
    plain_text,
    probability,
)
from probcal.plots.scene import Found, Outline, Places, Track, scene, thinned


def plot_map(tree: xr.DataTree, ax: Axes | None = None) -> Axes:
    """Draw stated and calibrated nodes with their ellipses, the tracks before and after calibration.

    Dotted: the true tracks, where `add_scores` has met them. Dashed: the tracks of an answer on the other side of a
    mirror that fits as well, and the way to where a node stands in such an answer (a ring). Of detections that nobody
    named: a broad line where an object was, in the colour of its existence and faint where that is small; and what each
    sensor sees, from where it was found to stand. Where nodes clearly moved by less than can be
    seen, displacements and ellipses are drawn so many times as large as the legend says.
    """
    ax = new_axes(ax, 9.0, 6.5)
    ax.set_aspect("equal", adjustable="box")
    shown = scene(tree)
    ax.set(xlim=(shown.low[0], shown.high[0]), ylim=(shown.low[1], shown.high[1]))
    keys = _draw_views(ax, shown.views) + _draw_objects(ax, shown.objects)
    # draw the tracks and the nodes of the other side and return the legend entry
    for k, track in enumerate(shown.mirrored):
        places = thinned(track, _most(shown.mirrored)).after[:, :2]
        ax.plot(*places.T, "--", color=colour(k), linewidth=1.0, alpha=0.7, zorder=2.5)
    for way in shown.elsewhere:
        ax.plot(*way[:, :2].T, "--", color="0.3", linewidth=0.8, zorder=4)
        ax.plot(*way[1, :2], "o", color="0.3", markerfacecolor="none", markersize=7, zorder=5)
    drawn = shown.mirrored or len(shown.elsewhere)
    keys += _draw_tracks(ax, shown.tracks) + (
        [Line2D([], [], color="0.3", linestyle="--", label="fits as well")] if drawn else []
    )
    keys += _draw_nodes(ax, shown.nodes, probability(tree))
    title = "Map of nodes and tracks" + (" (x-y plane, z not shown)" if shown.dimension > 2 else "")
    return finish(ax, title, grid="", keys=keys, xlabel="x in m", ylabel="y in m")


def _most(tracks: Sequence[Track]) -> int:
    """Epochs of each track that are drawn."""
    return min(POINTS, max(2, ALL_POINTS // max(len(tracks), 1)))


def _draw_views(ax: Axes, views: list[Outline]) -> list[Line2D]:
    """Draw where the view of each sensor ends and return the legend entry."""
    for k, own in enumerate(views):
        for line in own.lines:
            ax.plot(*line.T, "-.", color=colour(k), linewidth=0.8, alpha=0.7, zorder=1.5)
            if own.whole:
                ax.add_patch(Polygon(line, facecolor=colour(k), edgecolor="none", alpha=0.05, zorder=1))
    return [Line2D([], [], color="0.3", linestyle="-.", linewidth=0.8, label="view of a sensor")] if views else []


def _draw_objects(ax: Axes, objects: list[Found]) -> list[Line2D]:
    """Draw objects that nobody named by existence, with a colour bar, and return the legend entry."""
    if not objects:
        return []
    most, tint = max(2, ALL_POINTS // len(objects)), LinearSegmentedColormap.from_list("existence", [PALE, SURE])
    for whole in objects:
        own = thinned(whole, most)
        places, sure = own.position[:, :2], own.existence[1:]
        lines = list(np.stack([places[:-1], places[1:]], 1))
        ax.add_collection(
            LineCollection(lines, colors=tint(sure), linewidths=4.0, capstyle="round", zorder=1.8), autolim=False
        )
    bar = ax.inset_axes((1.03, 0.05, 0.02, 0.3))
    figure_of(ax).colorbar(ScalarMappable(Normalize(0.0, 1.0), tint), cax=bar, label="existence")
    return [Line2D([], [], color=SURE, linewidth=4.0, label=f"{len(objects)} objects, by existence")]


def _draw_tracks(ax: Axes, tracks: list[Track]) -> list[Line2D]:
    """Draw all tracks and return the legend entries."""
    true = False
    for k, whole in enumerate(tracks):
        track = thinned(whole, _most(tracks))
        line, point = ("o", "x") if len(track.time) == 1 else ("-", ":")
        ax.plot(*track.before[:, :2].T, line, color=BEFORE, linewidth=0.7, markersize=3, zorder=2)
        ax.plot(*track.after[:, :2].T, line, color=colour(k), linewidth=1.2, markersize=5, zorder=3)
        if np.isfinite(track.true).any():
            true = True
            ax.plot(*track.true[:, :2].T, point, color="0.1", linewidth=1.0, zorder=3.5)
    keys = [Line2D([], [], color=BEFORE, linewidth=0.9, label="before calibration")] if tracks else []
    keys += [Line2D([], [], color="0.1", linestyle=":", label="truth")] if true else []
    if len(tracks) > 12:
        return [*keys, Line2D([], [], color=colour(0), label=f"{len(tracks)} targets, after")]
    for k, track in enumerate(tracks):
        line, text = "o" if len(track.time) == 1 else "-", f"{plain_text(track.target)}, after"
        keys += ax.plot([], [], line, color=colour(k), markersize=5, label=text)
    return keys


def _draw_nodes(ax: Axes, nodes: Places, probability: float) -> list[Line2D]:
    """Draw all nodes and return the legend entries."""
    stated, calibrated, few = nodes.stated[:, :2], nodes.calibrated[:, :2], len(nodes.name) <= FEW
    keys = list[Line2D]()
    for moving, marker, text in ((False, "s", "stated position"), (True, "D", "start of a moving node")):
        chosen = nodes.moving == moving
        if chosen.any():
            size = 7 if few else 4
            keys += ax.plot(
                *stated[chosen].T, marker, zorder=5, color="black", markerfacecolor="none", markersize=size, label=text
            )
    if nodes.free.any():
        label, times = f"calibrated, {probability:.0%} ellipse", _magnified(ax, nodes)
        if times > 1:
            label = f"shift and {probability:.0%} ellipse \N{MULTIPLICATION SIGN} {times:g}"
            room = REACH * np.ptp(ax.get_xlim()) * np.array([-1.0, 1.0])
            ax.set(xlim=ax.get_xlim() + room, ylim=ax.get_ylim() + room)
        ends = stated + times * (calibrated - stated)
        keys += ax.plot(*ends[nodes.free].T, ".", color="black", markersize=6, zorder=6, label=label)
        for k in np.flatnonzero(nodes.free):
            _draw_shift(ax, stated[k], ends[k], times**2 * nodes.covariance[k, :2, :2], probability)
    name_places(ax, nodes.name, nodes.named[:, :2])
    return keys + _draw_headings(ax, nodes)


def _magnified(ax: Axes, nodes: Places) -> float:
    """The factor 1, 2, 5, 10, ... by which displacements are enlarged, as weak directions are."""
    shift = np.linalg.norm((nodes.calibrated - nodes.stated)[nodes.free, :2], axis=1)
    sd = np.sqrt(np.diagonal(nodes.covariance[nodes.free, :2, :2], axis1=1, axis2=2).max(1))
    clear = shift > 2.0 * sd
    times = REACH * np.ptp(ax.get_xlim()) / max(np.nanmax(np.maximum(shift, 2.0 * sd), initial=0.0), 1e-300)
    if not clear.any() or times < 2.0:  # no node moved for sure, or far enough to be seen
        return 1.0
    whole = 10.0 ** np.floor(np.log10(times))
    return float(max(step for step in (1.0, 2.0, 5.0) if step * whole <= times) * whole)


def _draw_shift(ax: Axes, start: np.ndarray, end: np.ndarray, covariance: np.ndarray, probability: float) -> None:
    """Draw the arrow from the stated to the calibrated position, unless too short to see, and the ellipse."""
    if not np.isfinite(end).all():
        return
    if np.linalg.norm(end - start) > 0.01 * np.ptp(ax.get_xlim()):
        arrow = {"arrowstyle": "->", "mutation_scale": 10.0, "shrinkA": 0.0, "shrinkB": 0.0, "linewidth": 0.9}
        ax.annotate("", tuple(end), tuple(start), arrowprops=arrow, zorder=5)
    if not np.isfinite(covariance).all():
        return
    shape = {"facecolor": "#00000018", "edgecolor": "black", "linewidth": 0.8, "zorder": 4}
    ax.add_patch(ellipse_patch(end, covariance, probability, **shape))


def _draw_headings(ax: Axes, nodes: Places) -> list[Line2D]:
    """Draw the calibrated heading of nodes with a heading bias, where the stated ones are saved."""
    turned = np.isfinite(nodes.heading)
    if not turned.any():
        return []
    angle = nodes.heading[turned]
    ax.quiver(
        *nodes.calibrated[turned, :2].T, np.cos(angle), np.sin(angle), color="#d00000", angles="xy",
        scale_units="width", scale=22.0 if len(nodes.name) <= FEW else 45.0, width=0.004,
        headwidth=1.0, headlength=0.0, headaxislength=0.0, zorder=5,
    )  # fmt: skip
    return [Line2D([], [], color="#d00000", label="calibrated heading")]
