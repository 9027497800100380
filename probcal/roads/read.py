"""Road networks from files: GeoJSON and GraphML."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from probcal.errors import InputError
from probcal.files import AnyPath, parsed_json
from probcal.geodesy import LocalFrame
from probcal.roads.checks import as_points
from probcal.roads.coordinates import WGS84, projection
from probcal.roads.extra import networkx
from probcal.roads.graphs import direction, name_of, unique
from probcal.roads.network import RoadNetwork, joined


def read_roads(
    path: AnyPath,
    *,
    frame: LocalFrame | None = None,
    crs: Any = None,
    dimension: int | None = None,
    snap: float = 0.01,
    connected: bool = True,
    bridges: Collection[str] = (),
) -> RoadNetwork:
    """Read a road network from GeoJSON (.geojson, .json) or GraphML (.graphml), as osmnx and GIS programs write them.

    Coordinates are in `crs`, by default what the file states; GeoJSON that states none is longitude and latitude
    (RFC 7946). Those need a `frame` that takes them to metres; projected ones are metres without one, and
    `crs="local"` says that the coordinates are metres already. Heights count where every point has one, but with
    `dimension=2`. Lines are named by name, id or osmid, one-way by oneway (yes, no, -1); what is no line is skipped.
    The other arguments are those of `RoadNetwork.from_lines`. Raises `InputError` naming file and edge.
    """
    path = Path(path)
    try:
        if path.suffix.lower() == ".graphml":
            return _graphml(path, frame, crs, dimension, snap, connected, bridges)
        if path.suffix.lower() in (".geojson", ".json"):
            return _geojson(path, frame, crs, dimension, snap, connected, bridges)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error}") from None
    except InputError as error:
        raise InputError(f"{path.name}: {error}") from None
    raise InputError(f"{path.name}: roads are read from .geojson, .json or .graphml")


def _graphml(path: Path, frame: Any, crs: Any, dimension: Any, snap: float, connected: bool, bridges: Any) -> Any:
    """The network of a GraphML file."""
    if not path.read_bytes().strip():
        raise InputError("the file is empty")
    try:
        graph = networkx.read_graphml(path)
    except OSError:
        raise
    except Exception as error:  # whatever networkx and the XML library say of foreign bytes
        raise InputError(f"the file is no GraphML: {error}") from None
    for _, data in graph.nodes(data=True):
        if isinstance(data.get("pos"), str):
            data["pos"] = data["pos"].strip("()[] ").replace(",", " ").split()
    return RoadNetwork.from_graph(
        graph, frame=frame, crs=crs, dimension=dimension, snap=snap, connected=connected, bridges=bridges
    )


def _geojson(path: Path, frame: Any, crs: Any, dimension: Any, snap: float, connected: bool, bridges: Any) -> Any:
    """The network of a GeoJSON file."""
    text = path.read_bytes()
    if not text.strip():
        raise InputError("the file is empty")
    try:
        content = parsed_json(text)
    except ValueError as error:
        raise InputError(f"the file is no JSON: {error}") from None
    names, lines, ways, over = _features(content)
    d = dimension or min(line.shape[1] for line in lines)
    if min(line.shape[1] for line in lines) < d:
        raise InputError("some points have no height; give every point one, or dimension=2")
    stated = content.get("crs") if crs is None else crs
    if isinstance(stated, dict):
        stated = _mapping(stated.get("properties")).get("name")
    to_metres = projection(WGS84 if stated is None else stated, frame)
    points = to_metres(np.concatenate([line[:, :d] for line in lines]))
    lines = np.split(points, np.cumsum([len(line) for line in lines])[:-1])
    lines = [line[::-1] if way < 0 else line for line, way in zip(lines, ways, strict=True)]
    names = unique(names)
    bridged = [name for name, high in zip(names, over, strict=True) if high]
    pieces = joined(names, lines, [way != 0 for way in ways], snap, bridged)
    return RoadNetwork.from_pieces(pieces, snap, connected, bridges)


def _mapping(value: Any) -> dict[str, Any]:
    """A mapping as it is, an empty one for anything else."""
    return value if isinstance(value, dict) else {}


def _features(content: Any) -> tuple[list[str], list[np.ndarray], list[int], list[bool]]:
    """Names, lines, ways (1, -1 or 0) and whether it is a bridge, of every line of a GeoJSON object."""
    if not isinstance(content, dict):
        raise InputError("the file is no GeoJSON object; give a FeatureCollection of LineString features")
    features = content.get("features", [content] if content.get("type") == "Feature" else [])
    names: list[str] = []
    lines: list[np.ndarray] = []
    ways: list[int] = []
    over: list[bool] = []
    for k, feature in enumerate(features if isinstance(features, list) else []):
        feature = _mapping(feature)
        geometry, own = _mapping(feature.get("geometry")), _mapping(feature.get("properties"))
        kind, parts = geometry.get("type"), geometry.get("coordinates")
        if kind not in ("LineString", "MultiLineString"):
            continue
        name = name_of({**own, "feature": feature.get("id")}, ("name", "id", "osmid", "feature"), str(k))
        for part in parts if kind == "MultiLineString" and isinstance(parts, list) else [parts]:
            names.append(name)
            lines.append(as_points(name, part))
            ways.append(direction(name, own.get("oneway")))
            over.append(any(name_of(own, (key,), "no") != "no" for key in ("bridge", "tunnel")))
    if not lines:
        raise InputError("the file has no LineString or MultiLineString feature; a network needs at least one")
    return names, lines, ways, over
