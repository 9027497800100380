"""GeoJSON: points and tracks in longitude and latitude, from and to files."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from probcal.adapters.shared import check_frame, file_bytes, instant, since
from probcal.errors import InputError
from probcal.files import AnyPath, parsed_json, write_whole
from probcal.geodesy import GEODETIC, LocalFrame, check_place
from probcal.labels import AXES
from probcal.lazy import pd, xr
from probcal.linalg import handedness, spectrum
from probcal.results.read import each_target

NAMES = ("target", "name", "id")  # properties that name a target, the first that is there
TIMES = ("time", "timestamp", "datetime")
CORNERS = 36  # of an ellipse


def read_geojson(
    path: AnyPath,
    frame: LocalFrame,
    *,
    sensor: str = "geojson",
    dimension: int | None = None,
    start: Any = None,
) -> pd.DataFrame:
    """Points and tracks of a GeoJSON file as a table: time (s), sensor, target, position_x, position_y[, position_z].

    A Point has a property `time` (ISO, or Unix seconds), a LineString or MultiLineString the times of its points in
    `coordTimes` (or `times`, or `coordinateProperties.times`). Targets are called by `target`, `name` or `id`, of the
    properties or of the feature. Heights count where every point has one, or by `dimension`. Features of another kind,
    or without a time, are left out and counted in `.attrs["left_out"]`; `start` and `.attrs["start"]` are those of
    `read_ais`. A `Problem` takes it (the targets of `sensors.position`), `Known` and `Truth` too. Raises `InputError`
    naming file and feature.

    >>> import probcal.adapters as adapters
    >>> adapters.read_geojson("none.geojson", LocalFrame(48.0, 11.0))
    Traceback (most recent call last):
    ...
    probcal.errors.InputError: none.geojson: no such file
    """
    check_frame("read_geojson", frame)
    if dimension not in (None, 2, 3):
        raise InputError(f"read_geojson: dimension is {dimension!r}; give 2 or 3, or nothing")
    name = Path(path).name
    left: Counter[str] = Counter()
    rows: list[tuple[int, str, list[float]]] = []
    for n, feature in enumerate(_features(path), 1):
        rows += _rows(f"{name} feature {n}", feature, left)
    if not rows:
        raise InputError(
            f"{name} holds no point with a time; write a property time for Points, coordTimes for LineStrings"
        )
    least = min(len(place) for *_, place in rows)
    wanted = dimension or min(least, 3)
    if least < wanted:
        raise InputError(f"{name}: a point has no height; give every one a third coordinate, or dimension=2")
    place = np.array([place[:wanted] for *_, place in rows])
    check_place(name, place[:, 1], place[:, 0], place[:, 2] if wanted == 3 else 0.0)
    position = frame.to_local(*place[:, [1, 0, 2][:wanted]].T)
    time, zero = since(np.array([stamp for stamp, *_ in rows], np.int64), start)
    found: dict[str, Any] = {"time": time, "sensor": sensor, "target": [target for _, target, _ in rows]}
    found |= {f"position_{axis}": column for axis, column in zip(AXES, position.T, strict=False)}
    table = pd.DataFrame(found).sort_values("time", kind="stable").reset_index(drop=True)
    table.attrs = {"start": zero, "left_out": dict(left)}
    return table


def _features(path: AnyPath) -> list[Any]:
    """Features of a file."""
    name = Path(path).name
    try:
        content = parsed_json(file_bytes(path))
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"{name} cannot be read as GeoJSON: {error}") from None
    if isinstance(content, dict) and content.get("type") == "Feature":
        return [content]
    found = content.get("features") if isinstance(content, dict) else None
    if not isinstance(found, list):
        raise InputError(f"{name} holds no features; a table is read from a FeatureCollection")
    return found


def _rows(where: str, feature: Any, left: Counter[str]) -> list[tuple[int, str, list[float]]]:
    """Instant (ns), target and [longitude, latitude(, height)] of every point of a feature."""
    feature = feature if isinstance(feature, dict) else {}
    geometry, properties = (
        feature.get(k) if isinstance(feature.get(k), dict) else {} for k in ("geometry", "properties")
    )
    kind, places = geometry.get("type"), geometry.get("coordinates")
    times: Any = next((properties[key] for key in TIMES if properties.get(key) is not None), None)
    if kind == "Point":
        places, times = [places], None if times is None else [times]
    elif kind in ("LineString", "MultiLineString"):
        nested = properties.get("coordinateProperties")
        nested = nested if isinstance(nested, dict) else {}
        options = (properties.get("coordTimes"), properties.get("times"), nested.get("times"))
        times = next((option for option in options if option is not None), times)
        if kind == "MultiLineString":
            places, times = _flat(where, places), _flat(where, times) if _nested(times) else times
    else:
        left["other geometries"] += 1
        return []
    if times is None:
        left["without a time"] += 1
        return []
    if not isinstance(times, list) or not isinstance(places, list) or len(times) != len(places):
        shown = len(times) if isinstance(times, list) else 1
        count = len(places) if isinstance(places, list) else 0
        raise InputError(f"{where} has {count} points and {shown} times; coordTimes holds one time a point")
    named = [*(properties.get(key) for key in NAMES), feature.get("id")]
    target = next((str(name) for name in named if name is not None and str(name).strip()), "target")
    for place in places:
        if (
            not isinstance(place, list)
            or len(place) < 2
            or not all(isinstance(v, (int, float)) and abs(v) < 1e9 for v in place[:3])
        ):
            raise InputError(
                f"{where}: {place!r} is no place; write [longitude, latitude] in degrees, perhaps a height"
            )
    return [
        (instant(time, f"{where}: a time"), target, [float(v) for v in place[:3]])
        for time, place in zip(times, places, strict=True)
    ]


def _nested(times: Any) -> bool:
    return isinstance(times, list) and bool(times) and all(isinstance(part, list) for part in times)


def _flat(where: str, parts: Any) -> list[Any]:
    if not isinstance(parts, list) or not all(isinstance(part, list) for part in parts):
        raise InputError(f"{where}: the coordinates of a MultiLineString are a list of lines")
    return [item for part in parts for item in part]


def write_geojson(
    path: AnyPath,
    tree: xr.DataTree,
    frame: LocalFrame | None = None,
    *,
    start: Any = None,
    deviations: float = 1.0,
) -> Path:
    """Write what a fit found as GeoJSON: nodes, stated and calibrated, and the tracks of the targets, lines with times.

    A calibrated node whose position was estimated has its sd (`sd_position_x`, ... in m) and its other biases as
    properties, and an ellipse of `deviations` standard deviations as a Polygon of its own. Every feature has a `kind`:
    stated, calibrated, ellipse, track. Tracks have `coordTimes` (ISO, counted from `start`, by default 1970), `time`
    in s, and `sd`, and `read_geojson` reads them back. `frame` is that of the network by default. Nodes that move are
    left out. Raises `InputError` for a tree without them, or without a frame.

    >>> import probcal.adapters as adapters
    >>> path = adapters.write_geojson(folder / "fit.geojson", tree, LocalFrame(48.0, 11.0))
    >>> adapters.read_geojson(path, LocalFrame(48.0, 11.0)).columns.tolist()
    ['time', 'sensor', 'target', 'position_x', 'position_y']
    """
    path = Path(path)
    if "constant_data" not in tree.children:
        raise InputError(f"{path.name}: the tree states no nodes; give what fit() returned")
    if frame is None:
        origin = tree["constant_data"].attrs
        if not set(GEODETIC) <= set(origin):
            raise InputError(f"{path.name}: the network has no frame; give that of its nodes, LocalFrame(...)")
        frame = LocalFrame(*(float(origin[name]) for name in GEODETIC))
    check_frame("write_geojson", frame)
    features = [*_node_features(tree, frame, deviations), *_track_features(tree, frame, start)]
    content = {"type": "FeatureCollection", "features": features}
    return write_whole(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


def _feature(kind: str, geometry: str, coordinates: Any, **properties: Any) -> dict[str, Any]:
    return {
        "type": "Feature",
        "geometry": {"type": geometry, "coordinates": coordinates},
        "properties": {"kind": kind, **properties},
    }


def _places(frame: LocalFrame, positions: np.ndarray) -> list[list[float]]:
    """[longitude, latitude(, height)] of positions (N, d)."""
    latitude, longitude, *height = frame.to_geodetic(positions)
    columns = [np.round(longitude, 10), np.round(latitude, 10), *(np.round(h, 4) for h in height)]
    return np.stack(columns, -1).tolist()


def _node_features(tree: xr.DataTree, frame: LocalFrame, deviations: float) -> list[dict[str, Any]]:
    constant = tree["constant_data"].to_dataset()
    table, covariance = _found(tree)
    fixed = constant["fixed"].to_series().to_dict() if "fixed" in constant else {}
    features = []
    parts = zip(*(constant[name].values for name in ("node", "node_position", "moving")), strict=True)
    for node, stated, moving in parts:
        if moving:
            continue
        features.append(_feature("stated", "Point", _places(frame, stated[None])[0], node=str(node)))
        if not table:
            continue
        axes = [f"{node}.position_{axis}" for axis in AXES[: len(stated)]]
        shift = np.array([table.get(label, {}).get("mean", fixed.get(label, 0.0)) for label in axes])
        own = {label.partition(f"{node}.")[2]: row for label, row in table.items() if label.startswith(f"{node}.")}
        properties = {name: float(row["mean"]) for name, row in own.items()}
        properties |= {f"sd_{name}": float(row["sd"]) for name, row in own.items()}
        calibrated = stated + shift
        features.append(
            _feature("calibrated", "Point", _places(frame, calibrated[None])[0], node=str(node), **properties)
        )
        if axes[0] in table and axes[1] in table:
            outline = _ellipse(calibrated, covariance(axes[:2]), deviations)
            features.append(
                _feature("ellipse", "Polygon", [_places(frame, outline)], node=str(node), deviations=deviations)
            )
    return features


def _found(tree: xr.DataTree) -> tuple[dict[str, Any], Any]:
    """Mean and sd by label, and a function that gives the covariance of some labels."""
    if "calibration" not in tree.children:
        return {}, None
    group = tree["calibration"].to_dataset()
    columns = (group[name].values.tolist() for name in ("bias_label", "mean", "sd"))
    table = {str(label): {"mean": mean, "sd": sd} for label, mean, sd in zip(*columns, strict=True)}
    if "covariance" in group:
        matrix = group["covariance"]
        return table, lambda labels: matrix.sel(bias_label=labels, bias_label_other=labels).values
    return table, lambda labels: np.diag([table[label]["sd"] ** 2 for label in labels])


def _ellipse(centre: np.ndarray, covariance: np.ndarray, deviations: float) -> np.ndarray:
    """Outline (CORNERS + 1, d) of an ellipse about a centre (d,), closed, counter-clockwise."""
    values, vectors = spectrum(covariance)
    vectors[:, 1] *= handedness(vectors)
    angle = np.linspace(0.0, 2 * np.pi, CORNERS + 1)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    outline = np.tile(centre, (CORNERS + 1, 1)).astype(float)
    outline[:, :2] += deviations * (vectors @ (np.sqrt(np.maximum(values, 0.0))[:, None] * circle)).T
    outline[-1] = outline[0]
    return outline


def _track_features(tree: xr.DataTree, frame: LocalFrame, start: Any) -> list[dict[str, Any]]:
    zero = 0 if start is None else instant(start, "start")
    features = []
    for target, group in each_target(tree):
        components = [str(c) for c in group["component"].values]
        axes = [f"position_{axis}" for axis in AXES if f"position_{axis}" in components]
        position = group["mean"].sel(component=axes).values
        times = group["time"].values
        stamps = [pd.Timestamp(zero + round(time * 1e9), tz="UTC").isoformat() for time in times.tolist()]
        sd = group["sd"].sel(component=axes).values
        line = _places(frame, position)
        single = len(line) == 1
        properties: dict[str, Any] = {"target": target, "sd": np.round(sd, 6).tolist()}
        properties |= {"time": stamps[0]} if single else {"coordTimes": stamps}
        geometry = ("Point", line[0]) if single else ("LineString", line)
        features.append(_feature("track", *geometry, **properties))
    return features
