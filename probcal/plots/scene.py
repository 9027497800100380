"""What a map shows: nodes as stated and as calibrated, tracks without and with calibration, the truth, a mirror.

Of detections that nobody named also the objects found, and what each sensor sees.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from probcal.errors import InputError
from probcal.geodesy import GEODETIC, LocalFrame
from probcal.labels import AXES, NODE
from probcal.results.read import each_object, each_target

ARC = 48  # corners of a sector's arc
SEEN = 0.5  # share of an object in view at which the outline of a view is drawn
ASIDE = 0.25  # of the extent of nodes and tracks up to which views and faint objects widen the map
BEYOND = 2.0  # sd from which a node stands elsewhere in an answer that fits as well
SURE = 0.5  # existence from which an object widens it at all


@dataclass(frozen=True)
class Track:
    """Positions (E, d) of one target in order of time, in m; `true` is NaN where nothing is known."""

    target: str
    time: np.ndarray  # (E,) in s
    before: np.ndarray
    after: np.ndarray
    sd: np.ndarray
    true: np.ndarray

    def thin(self, most: int) -> "Track":
        """At most `most` epochs, evenly spaced, both ends kept."""
        if len(self.time) <= most:
            return self
        kept = np.linspace(0, len(self.time) - 1, most).round().astype(int)
        parts = (self.time, self.before, self.after, self.sd, self.true)
        return Track(self.target, *(part[kept] for part in parts))


@dataclass(frozen=True)
class Found:
    """Positions (L, d) in m of one object that nobody named, in order of time in s, and how surely it exists (L,)."""

    name: str
    time: np.ndarray
    position: np.ndarray
    existence: np.ndarray

    def thin(self, most: int) -> "Found":
        """At most `most` instants, evenly spaced, both ends kept."""
        if len(self.time) <= most:
            return self
        kept = np.linspace(0, len(self.time) - 1, most).round().astype(int)
        return Found(self.name, self.time[kept], self.position[kept], self.existence[kept])


@dataclass(frozen=True)
class Outline:
    """Where the view of one sensor ends in the plane: lines (P, 2) in m; `whole` where a single one goes round it."""

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
        """Where the name of each node stands (N, d): as stated, as calibrated where several are stated at one place."""
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
    nodes, tracks, mirrored = _places(tree), list(_tracks(tree)), list(_mirrored(tree))
    attrs = tree["constant_data"].attrs
    frame = LocalFrame(*(float(attrs[name]) for name in GEODETIC)) if GEODETIC[0] in attrs else None
    objects = [Found(name, *rest) for name, *rest in each_object(tree, AXES[: nodes.stated.shape[1]])]
    elsewhere = _elsewhere(tree, nodes)
    low, high = _limits(nodes, [*tracks, *mirrored], diverged=tree.attrs.get("status") == "diverged")
    views = list(_views(tree, nodes, float(np.linalg.norm(high - low))))
    sure = [own.position[own.existence >= SURE] for own in objects]
    low, high = _widened(low, high, sure, [*elsewhere, *(line for own in views for line in own.lines)])
    return Scene(nodes, tracks, mirrored, elsewhere, objects, views, low, high, frame)


def ellipse(covariance: np.ndarray, probability: float) -> tuple[float, float, float]:
    """Width, height and angle (rad) of the ellipse that holds a probability of a Gaussian with covariance (2, 2)."""
    (xx, xy), (_, yy) = covariance
    spread = np.hypot((xx - yy) / 2, xy)
    variances = np.maximum([(xx + yy) / 2 + spread, (xx + yy) / 2 - spread], 0.0)
    width, height = 2.0 * np.sqrt(-2.0 * np.log1p(-probability) * variances)
    return float(width), float(height), float(np.arctan2(2 * xy, xx - yy) / 2)


def shifts(tree: xr.DataTree) -> dict[str, float]:
    """Value of every bias, estimated or fixed, by label."""
    group, nodes = tree["calibration"].to_dataset(), tree["constant_data"].to_dataset()
    found = dict(zip(group["bias_label"].values.tolist(), group["mean"].values.tolist(), strict=True))
    if "fixed" in nodes:
        found |= dict(zip(nodes["fixed_label"].values.tolist(), nodes["fixed"].values.tolist(), strict=True))
    return found


def _places(tree: xr.DataTree) -> Places:
    group, nodes, moved = tree["calibration"].to_dataset(), tree["constant_data"].to_dataset(), shifts(tree)
    names, stated = nodes["node"].values.astype(str), nodes["node_position"].values
    labels = [[f"{name}.position_{axis}" for axis in AXES[: stated.shape[1]]] for name in names]
    index = {label: k for k, label in enumerate(group["bias_label"].values.tolist())}
    at = np.array([[index.get(label, -1) for label in own] for own in labels])
    covariance = _of_places(group, at)
    turned = [moved.get(f"{name}.heading", np.nan) for name in names]
    return Places(
        names, stated, stated + np.array([[moved.get(label, 0.0) for label in own] for own in labels]),
        covariance, (at >= 0).any(1), nodes["moving"].values.astype(bool),
        (nodes["node_heading"].values if "node_heading" in nodes else np.nan) + np.array(turned),
    )  # fmt: skip


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
        axes = [f"position_{axis}" for axis in AXES if f"position_{axis}" in group["component"].values]
        if len(axes) > 1:
            part = group.sel(component=axes)
            after = part["mean"].values
            true = part["true"].values if "true" in part else np.full(after.shape, np.nan)
            yield Track(target, group["time"].values, part["before"].values, after, part["sd"].values, true)


def _alike(tree: xr.DataTree) -> xr.Dataset:
    """Answers that fit as well, without their tracks; none where there is no group of them."""
    if "mirror" not in tree.children:
        return xr.Dataset({"gain": ("mirror", np.zeros(0))})
    group = tree["mirror"].to_dataset()
    return group.assign(number=("mirror", np.arange(group.sizes["mirror"]))).isel(
        mirror=group["gain"].values > -group.attrs["same"]
    )


def _mirrored(tree: xr.DataTree) -> Iterator[Track]:
    """Tracks of the best answer on the other side of a mirror, where one fits as well."""
    alike = _alike(tree)
    if alike.sizes["mirror"] and "kind" in alike:
        alike = alike.isel(mirror=alike["kind"].values != NODE)
    if not alike.sizes["mirror"]:
        return
    best = int(alike["number"].values[alike["gain"].values.argmax()])
    for target, there in each_target(tree.children["mirror"]):
        places = there["position"].isel(mirror=best).values
        nothing = np.full(places.shape, np.nan)
        yield Track(target, there["time"].values, places, places, nothing, nothing)


def _elsewhere(tree: xr.DataTree, nodes: Places) -> np.ndarray:
    """Where nodes were found and where they stand in answers that fit as well (K, 2, d), if that is another place."""
    alike, d = _alike(tree), nodes.stated.shape[1]
    found = list[np.ndarray]()
    label = {name: k for k, name in enumerate(alike["bias_label"].values.tolist())} if len(alike.coords) else {}
    at = np.array([[label.get(f"{name}.position_{axis}", -1) for axis in AXES[:d]] for name in nodes.name.tolist()])
    for own in range(alike.sizes["mirror"]):
        bias, apart = (np.append(alike[name].values[own], 0.0) for name in ("bias", "apart"))
        for k in np.flatnonzero(apart[at].max(1) > BEYOND):
            there = np.where(at[k] >= 0, nodes.stated[k] + bias[at[k]], nodes.calibrated[k])
            found.append(np.stack([nodes.calibrated[k], there]))
    return np.array(found).reshape(-1, 2, d)


def _views(tree: xr.DataTree, nodes: Places, far: float) -> Iterator[Outline]:
    """What each sensor sees from its calibrated node, in the plane; a view without an end ends `far` m away."""
    group, moved = tree["constant_data"].to_dataset(), shifts(tree)
    if "view_range" not in group:
        return
    on = list(zip(group["placed_sensor"].values.tolist(), group["placed_node"].values.tolist(), strict=True))
    names, at = nodes.name.tolist(), {}
    for sensor, node in on:
        at[sensor] = names.index(node) if [own for own, _ in on].count(sensor) == 1 else -1
    parts = (group[f"view_{part}"].values.tolist() for part in ("range", "width", "towards"))
    for sensor, reach, width, towards in zip(group["sensor"].values.tolist(), *parts, strict=True):
        k, round_ = at.get(sensor, -1), width >= 2 * np.pi - 1e-6
        if k < 0 or np.isnan(reach) or (round_ and np.isinf(reach)) or (nodes.moving[k] and not round_):
            continue
        turned = float(group["node_heading"].values[k]) + moved.get(f"{names[k]}.heading", 0.0) + towards
        angle = turned + width * np.linspace(-0.5, 0.5, ARC)
        arc = nodes.calibrated[k, :2] + min(reach, far) * np.stack([np.cos(angle), np.sin(angle)], 1)
        corner = np.empty((0, 2)) if round_ else nodes.calibrated[k, :2][None]
        yield Outline(sensor, [np.concatenate([corner, arc, corner])], whole=True)
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
    low, high = low.copy(), high.copy()
    near, far = low - aside, high + aside
    for points in (*objects, *views):
        some = points[np.isfinite(points).all(1)]
        if len(some):
            d = some.shape[1]
            low[:d] = np.minimum(low[:d], np.maximum(some.min(0), near[:d]))
            high[:d] = np.maximum(high[:d], np.minimum(some.max(0), far[:d]))
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
