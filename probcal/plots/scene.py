"""The content of a map: nodes and tracks before and after calibration, the truth, a reflected mode.

Of detections that nobody named also the objects found, and what each sensor sees.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
import xarray as xr

from probcal.errors import InputError
from probcal.geodesy import GEODETIC, LocalFrame
from probcal.labels import AXES, NODE, coordinates
from probcal.results.modes import alike
from probcal.results.read import bias_values, each_object, each_target
from probcal.results.schema import DIFFERENT

ARC = 48  # corners of a sector's arc
THERE = 0.5  # existence from which an object is counted
SEEN = 0.5  # share of an object in view at which the outline of a view is drawn
ASIDE = 0.25  # of the extent of nodes and tracks up to which views and faint objects widen the map


@dataclass(frozen=True)
class Track:
    """Positions (E, d) of one target in order of time, in m; `true` is NaN where nothing is known."""

    target: str
    time: np.ndarray  # (E,) in s
    before: np.ndarray
    after: np.ndarray
    sd: np.ndarray
    true: np.ndarray


@dataclass(frozen=True)
class Found:
    """Positions (L, d) in m of one object that nobody named, in order of time in s, and how surely it exists (L,)."""

    name: str
    time: np.ndarray
    position: np.ndarray
    existence: np.ndarray


def thinned[T: (Track, Found)](whole: T, most: int) -> T:
    """A track or object at `most` of its times, evenly spaced, both ends kept."""
    if len(whole.time) <= most:
        return whole
    chosen = np.linspace(0, len(whole.time) - 1, most).round().astype(int)
    parts = {name: values[chosen] for name, values in vars(whole).items() if np.ndim(values)}
    return replace(whole, **parts)


@dataclass(frozen=True)
class Outline:
    """The limit of a sensor's view in the plane: lines (P, 2) in m; `whole` if one encloses it."""

    sensor: str
    lines: list[np.ndarray]
    whole: bool


@dataclass(frozen=True)
class Places:
    """Nodes: positions (N, d) in m, which of them are biased, which move, headings (N,) in rad where one is biased."""

    name: np.ndarray
    stated: np.ndarray
    calibrated: np.ndarray
    covariance: np.ndarray  # (N, d, d) of the calibrated positions, 0 where a coordinate is no bias
    free: np.ndarray  # (N,) bool: some coordinate is an estimated bias
    moving: np.ndarray
    heading: np.ndarray  # calibrated; NaN where it is no bias

    @property
    def named(self) -> np.ndarray:
        """The place (N, d) of each node's name: as stated, or calibrated if several share it."""
        _, place, count = np.unique(self.stated, axis=0, return_inverse=True, return_counts=True)
        return np.where((count[place] > 1)[:, None], self.calibrated, self.stated)


@dataclass(frozen=True)
class Scene:
    """Everything that a map shows, and the limits (d,) of what is worth looking at."""

    nodes: Places
    tracks: list[Track]
    mirrored: list[Track]  # of the best answer with tracks on the other side of a mirror, where one fits as well
    elsewhere: np.ndarray  # (K, 2, d) where a node was found, and where it stands in an answer that fits as well
    objects: list[Found]
    views: list[Outline]
    low: np.ndarray
    high: np.ndarray
    frame: LocalFrame | None  # of the coordinates, where they come from latitude and longitude

    @property
    def dimension(self) -> int:
        """Number of coordinates."""
        return self.nodes.stated.shape[1]


def scene(tree: xr.DataTree) -> Scene:
    """Read the map of a fit; raises `InputError` for a tree that is none."""
    if not {"calibration", "constant_data"} <= set(tree.children):
        raise InputError("the map needs a result of fit(), with its groups calibration and constant_data")
    nodes, tracks, others = _places(tree), list(_tracks(tree)), alike(tree)
    # where nodes were found and where they stand in answers that fit as well (K, 2, d), if that
    # is another place
    d, found = nodes.stated.shape[1], list[np.ndarray]()
    at = others.get_index("bias_label").get_indexer(pd.Index(_coordinates(nodes.name, d))).reshape(-1, d)
    for bias, apart in zip(others["bias"].values, others["apart"].values, strict=True):
        there = np.where(at >= 0, nodes.stated + bias[at], nodes.calibrated)
        other = np.where(at >= 0, apart[at], 0.0).max(1) > DIFFERENT
        found.append(np.stack([nodes.calibrated, there], 1)[other])
    mirrored, elsewhere = list(_mirrored(tree, others)), np.concatenate([np.empty((0, 2, d)), *found])
    attrs = tree["constant_data"].attrs
    frame = LocalFrame(*(float(attrs[name]) for name in GEODETIC)) if GEODETIC[0] in attrs else None
    objects = [Found(name, *rest) for name, *rest in each_object(tree, AXES[: nodes.stated.shape[1]])]
    low, high = _limits(nodes, [*tracks, *mirrored], diverged=tree.attrs.get("status") == "diverged")
    views = list(_views(tree, nodes, float(np.linalg.norm(high - low))))
    sure = [own.position[own.existence >= THERE] for own in objects]
    low, high = _widened(low, high, sure, [*elsewhere, *(line for own in views for line in own.lines)])
    return Scene(nodes, tracks, mirrored, elsewhere, objects, views, low, high, frame)


def ellipse(covariance: np.ndarray, probability: float) -> tuple[float, float, float]:
    """Width, height and angle (rad) of the ellipse that holds a probability of a Gaussian with covariance (2, 2)."""
    (xx, xy), (_, yy) = covariance
    spread = np.hypot((xx - yy) / 2, xy)
    variances = np.maximum([(xx + yy) / 2 + spread, (xx + yy) / 2 - spread], 0.0)
    width, height = 2.0 * np.sqrt(-2.0 * np.log1p(-probability) * variances)
    return float(width), float(height), float(np.arctan2(2 * xy, xx - yy) / 2)


def _coordinates(names: np.ndarray, d: int) -> list[str]:
    """Labels of the coordinates of all nodes, one node after the other."""
    return [label for name in names for label in coordinates(of=name)[:d]]


def _places(tree: xr.DataTree) -> Places:
    group, nodes = tree["calibration"].to_dataset(), tree["constant_data"].to_dataset()
    names, stated, moved = nodes["node"].values.astype(str), nodes["node_position"].values, pd.Series(bias_values(tree))
    labels = _coordinates(names, stated.shape[1])
    at = group.get_index("bias_label").get_indexer(pd.Index(labels)).reshape(stated.shape)
    return Places(
        name=names,
        stated=stated,
        calibrated=stated + moved.reindex(labels, fill_value=0.0).to_numpy().reshape(stated.shape),
        covariance=_of_places(group, at),
        free=(at >= 0).any(1),
        moving=nodes["moving"].values.astype(bool),
        heading=nodes["node_heading"].values + moved.reindex(names + ".heading").to_numpy(),
    )


def _of_places(group: xr.Dataset, at: np.ndarray) -> np.ndarray:
    """Covariances (S, d, d) of the places of nodes, whose biases have numbers `at` (S, d), -1 of none.

    A fit in sparse form knows the variances alone.
    """
    if "covariance" in group:
        return np.pad(group["covariance"].values, (0, 1))[at[:, :, None], at[:, None, :]]
    variance = np.append(group["sd"].values ** 2, 0.0)[at]
    return np.eye(at.shape[1])[None] * variance[:, None, :]


def _tracks(tree: xr.DataTree) -> Iterator[Track]:
    """Positions of every target that has some."""
    for target, group in each_target(tree):
        axes = coordinates(group["component"].values)
        if len(axes) > 1:
            part = group.sel(component=axes)
            true = part["true"] if "true" in part else xr.full_like(part["mean"], np.nan)
            places = (part["before"], part["mean"], part["sd"], true)
            yield Track(target, group["time"].values, *(own.values for own in places))


def _mirrored(tree: xr.DataTree, others: xr.Dataset) -> Iterator[Track]:
    """Tracks of the best answer on the other side of a mirror, where one fits as well."""
    others = others.isel(mode=others["kind"].values != NODE)
    if others.sizes["mode"]:
        best = int(others["number"].values[others["gain"].values.argmax()])
        for target, group in each_target(tree.children["mode"]):
            places = group["position"].isel(mode=best).values
            unknown = np.full(places.shape, np.nan)
            yield Track(target, group["time"].values, places, places, unknown, unknown)


def _views(tree: xr.DataTree, nodes: Places, far: float) -> Iterator[Outline]:
    """The plane view of each sensor from its calibrated node; unlimited ones end at `far` m."""
    group = tree["constant_data"].to_dataset()
    if "view_range" not in group:
        return
    turned, names = pd.Series(bias_values(tree)), nodes.name.tolist()
    placed = pd.Series(group["placed_node"].values, group["placed_sensor"].values)
    placed = placed[~placed.index.duplicated(keep=False)]  # a sensor of several nodes has no one view
    sectors = group[["view_range", "view_width", "view_towards"]].to_dataframe().dropna(subset="view_range")
    for sensor, reach, width, towards in sectors.itertuples(name=None):
        round_ = width >= 2 * np.pi - 1e-6
        if sensor not in placed or (round_ and np.isinf(reach)):
            continue
        k = names.index(placed[sensor])
        if nodes.moving[k] and not round_:
            continue
        heading = float(group["node_heading"][k]) + turned.get(f"{names[k]}.heading", 0.0)
        angle = heading + towards + width * np.linspace(-0.5, 0.5, ARC)
        place = nodes.calibrated[k, :2]
        arc = place + min(reach, far) * np.stack([np.cos(angle), np.sin(angle)], 1)
        yield Outline(sensor, [arc if round_ else np.concatenate([[place], arc, [place]])], whole=True)
    if "view" in group:
        from contourpy import contour_generator  # what both libraries of pictures draw with

        for sensor, seen in zip(group["viewing"].values.tolist(), group["view"].values, strict=True):
            lines = contour_generator(group["view_x"].values, group["view_y"].values, seen).lines(SEEN)
            yield Outline(sensor, [np.asarray(line) for line in lines], whole=False)


def _widened(
    low: np.ndarray, high: np.ndarray, objects: list[np.ndarray], views: list[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Corners that hold objects and views too, as far as they lie beside what is there."""
    aside = ASIDE * float((high - low).max())
    near, far = low - aside, high + aside
    low, high = low.copy(), high.copy()
    for points in (*objects, *views):
        d = points.shape[1]
        some = np.clip(points[np.isfinite(points).all(1)], near[:d], far[:d])
        low[:d] = np.minimum(low[:d], some.min(0, initial=np.inf))
        high[:d] = np.maximum(high[:d], some.max(0, initial=-np.inf))
    return low, high


def _limits(nodes: Places, tracks: list[Track], *, diverged: bool) -> tuple[np.ndarray, np.ndarray]:
    """Corners of nodes and tracks; what flew off before calibration, or in a diverged fit, is cut."""
    d = nodes.stated.shape[1]
    after = [nodes.calibrated, *(track.after for track in tracks)]
    before = _known([track.before for track in tracks], d)
    before = np.quantile(before, [0.01, 0.99], axis=0) if len(before) else before
    anchor, rest = _known([nodes.stated, *after], d), before
    if diverged:
        anchor, rest = _known([nodes.stated, before], d), _known(after, d)
    low, high = anchor.min(0), anchor.max(0)
    reach = max(float((high - low).max()), 1.0)
    both = np.concatenate([anchor, np.clip(rest, low - reach, high + reach)])
    low, high = both.min(0), both.max(0)
    margin = 0.07 * max(float((high - low).max()), 1.0)
    return low - margin, high + margin


def _known(parts: Sequence[np.ndarray], d: int) -> np.ndarray:
    """Finite points (N, d) of all parts."""
    points = np.concatenate([np.empty((0, d)), *parts])
    return points[np.isfinite(points).all(1)]
