"""Nodes from and to files: CSV and GeoJSON, in metres or in latitude and longitude."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from difflib import get_close_matches
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from probcal.errors import InputError, check_known, nearest
from probcal.files import AnyPath, parsed_json, write_whole
from probcal.geodesy import GEODETIC, LocalFrame, check_place, earth_axes
from probcal.labels import coordinates, step_of, unescaped
from probcal.lazy import pd, xr
from probcal.network import ANGLES, POSE_UNITS, Network, Node
from probcal.sensor import Bias
from probcal.table import Table, csv_text, header, name_as_text, numbers, read_table, unit_factor

LOCAL = ("x", "y", "z")
PLACE_UNITS = dict.fromkeys((*LOCAL, "height"), "m") | dict.fromkeys(GEODETIC[:2], "deg")
OWN = tuple(name for name in POSE_UNITS if name != "position")  # components that every node has
KINDS = ("survey", "scale")
RESERVED = ("position", "path", "self", *KINDS)  # arguments of Node that are no column
KNOWN = (*OWN, "position", *(f"{kind}_{name}" for kind in KINDS for name in ("position", *OWN)))
GEOJSON = (".geojson", ".json")


class Nodes(dict[str, Node]):
    """Nodes by name, and the `frame` of their coordinates (None where the file states metres)."""

    frame: LocalFrame | None = None


def _reference(frame: LocalFrame, place: np.ndarray) -> np.ndarray:
    """Axes (N, 3, 3) from which attitudes at places (N, 2 or 3) count; in 2-D the turn in the plane alone."""
    axes = frame.axes(place[:, 0], place[:, 1])
    if place.shape[1] == 3:
        return axes
    turn = np.arctan2(axes[:, 0, 1], axes[:, 0, 0])
    c, s, zero, one = np.cos(turn), np.sin(turn), np.zeros_like(turn), np.ones_like(turn)
    return np.stack([c, s, zero, -s, c, zero, zero, zero, one], -1).reshape(-1, 3, 3)


def _turned(components: Mapping[str, float], axes: np.ndarray) -> dict[str, float]:
    """Components with heading, pitch and roll (the turns of `PoseView.local`) taken from other axes (3, 3)."""
    turns = [components.get(name, 0.0) for name in ANGLES]
    (c, cp, cr), (s, sp, sr) = np.cos(turns), np.sin(turns)
    ahead, level, above = np.array([[cp * c, cp * s, sp], [-s, c, 0.0], [-sp * c, -sp * s, cp]]) @ axes
    left, up = cr * level + sr * above, cr * above - sr * level
    heading, roll = np.arctan2([ahead[1], left[2]], [ahead[0], up[2]])
    turned = (heading, np.arcsin(np.clip(ahead[2], -1.0, 1.0)), roll)
    return {**components, **{name: float(angle) for name, angle in zip(ANGLES, turned, strict=True)}}


def read_nodes(source: AnyPath | pd.DataFrame, *, origin: Sequence[float] | LocalFrame | None = None) -> Nodes:
    """Nodes by name from CSV, GeoJSON (Point features, the columns as properties) or a DataFrame.

    Columns: `node` (or `name`); `x, y[, z]` in m or `latitude, longitude[, height]` in degrees and m; optional
    `heading`, `pitch`, `roll` in rad, `clock`, `time_offset` in s, `survey_<component>` and `scale_<component>` as of
    `Node`, and extra components as numbers. A header may carry a unit (`heading [deg]`); clock and extras keep theirs.
    A blank cell leaves its component out; columns `sd_...` and `note` (of `write_nodes`) are not read.

    Latitude and longitude become metres in a `LocalFrame` about `origin` (latitude, longitude[, height]; the mean of
    the nodes by default), kept as `.frame`. The heading counts from the node's own east, counter-clockwise (a compass
    angle c is pi/2 - c), pitch and roll from its own horizon; they are turned into the frame. Raises `InputError`
    naming file, row and column.
    """
    path = Path(source) if isinstance(source, (str, PathLike)) else None
    table = _features(path) if path is not None and path.suffix.lower() in GEOJSON else read_table(source)
    names, units = header(table)
    cells = table.frame.set_axis(names, axis=1)
    if cells.empty:
        raise InputError(f"{table.source} has no nodes; write one a row")
    labels = _labels(table, cells)
    place = _place_columns(table, cells)
    position = np.stack([_stated_place(table, cells[c], c, units[c]) for c in place], -1)
    frame, axes = None, None
    if place[0] == "latitude":
        # local frame, axes of the attitudes (N, 3, 3) and positions (N, d) of nodes at geodetic places (N, d)
        for number, (latitude, longitude, *height) in enumerate(position):
            check_place(table.where(number), latitude, longitude, height[0] if height else 0.0)
        if isinstance(origin, LocalFrame):
            frame = origin
        elif origin is None:  # by the mean of directions, which knows no date line
            x, y, z = earth_axes(position[:, 0], position[:, 1])[:, 2].mean(axis=0).tolist()
            middle = np.rad2deg([np.arctan2(z, np.hypot(x, y)), np.arctan2(y, x)])
            frame = LocalFrame(*middle.tolist(), *position[:, 2:].mean(axis=0).tolist())
        elif isinstance(origin, (Sequence, np.ndarray)) and len(origin) in (2, 3):
            frame = LocalFrame(*origin)
        else:
            raise InputError(f"read_nodes: origin is {origin!r}; give (latitude, longitude) or with a height")
        axes, position = _reference(frame, position), frame.to_local(*position.T)
    elif origin is not None:
        raise InputError(f"{table.source} states x and y; an origin goes with latitude and longitude, drop it")
    columns = _columns(table, cells, units)
    nodes = Nodes()
    for row, name in enumerate(labels):
        own: dict[str, Any] = {
            kind: {component: value[row] for component, value in found.items() if value[row] is not None}
            for kind, found in columns.items()
        }
        components = own.pop("") if axes is None else _turned(own.pop(""), axes[row])
        try:
            nodes[name] = Node(name, position[row], **own, **components)
        except InputError as error:
            raise InputError(f"{table.where(row)}: {error}") from None
    nodes.frame = frame
    return nodes


def _features(path: Path) -> Table:
    """Point features of a GeoJSON file as a table, one row a feature."""
    try:
        content = parsed_json(path.read_bytes())
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except ValueError as error:
        raise InputError(f"{path.name} is not GeoJSON: {error}") from None
    features = content.get("features") if isinstance(content, dict) else None
    if not isinstance(features, list):
        raise InputError(f"{path.name} is not GeoJSON: it holds no FeatureCollection")
    table = Table(pd.DataFrame(), path.name, np.arange(1, len(features) + 1), "feature")
    records = []
    for row, feature in enumerate(features):
        geometry, properties = (_member(feature, name) for name in ("geometry", "properties"))
        place = geometry.get("coordinates") if geometry.get("type") == "Point" else None
        if not isinstance(place, list) or len(place) not in (2, 3) or not {type(v) for v in place} <= {int, float}:
            raise InputError(f"{table.where(row)} is no Point with coordinates [longitude, latitude] or with a height")
        records.append(properties | dict(zip(("longitude", "latitude", "height"), place, strict=False)))
    return replace(table, frame=pd.DataFrame(records))


def _member(record: Any, name: str) -> dict[str, Any]:
    """The object of that name, empty where there is none."""
    found = record.get(name) if isinstance(record, dict) else None
    return found if isinstance(found, dict) else {}


def _labels(table: Table, cells: pd.DataFrame) -> list[str]:
    """Names of the nodes, each once."""
    found = [column for column in ("node", "name") if column in cells]
    if len(found) != 1:
        raise InputError(
            f'{table.source} has both a column "node" and a column "name"; keep one'
            if found
            else f'{table.source} has no column "node"{nearest("node", cells.columns)}'
        )
    column = cells[found[0]]
    labels: list[str] = []
    for row, (value, blank) in enumerate(zip(column, column.isna(), strict=True)):
        label = "" if blank else name_as_text(value)
        if not label:
            raise InputError(f'{table.where(row)} column "{found[0]}" is blank; name the node')
        if label in labels:
            first = table.lines[labels.index(label)]
            raise InputError(f'{table.where(row)}: node "{label}" is there already ({table.word} {first}); rename one')
        labels.append(label)
    return labels


def _place_columns(table: Table, cells: pd.DataFrame) -> tuple[str, ...]:
    """The columns that state the place: two, or three where a height is stated."""
    stated = [column for column in (*LOCAL, *GEODETIC) if column in cells]
    if not stated:
        raise InputError(
            f"{table.source} states no place: write x, y and perhaps z in m, or latitude, longitude and perhaps height"
        )
    chosen = LOCAL if stated[0] in LOCAL else GEODETIC
    for column in stated:
        if column not in chosen:
            raise InputError(f'{table.source} column "{column}" does not go with "{stated[0]}"; drop one of them')
    for column in chosen[:2]:
        check_known(column, cells.columns, f'{table.source} has no column "{column}"')
    return chosen if chosen[2] in cells and cells[chosen[2]].notna().any() else chosen[:2]


def _stated_place(table: Table, column: pd.Series, name: str, unit: str | None) -> np.ndarray:
    values, there = numbers(table, column, name)
    table.refuse(~there, name, " is blank; state it for every node")
    return values * unit_factor(table, name, unit, PLACE_UNITS[name])


def _columns(table: Table, cells: pd.DataFrame, units: Mapping[str, str | None]) -> dict[str, dict[str, list[Any]]]:
    """Cells by kind ("" stated, "survey", "scale") and component, None where blank; angles in rad, lengths in m."""
    found: dict[str, dict[str, list[Any]]] = {"": {}, "survey": {}, "scale": {}}
    first: dict[str, tuple[str, str]] = {}
    for name in cells.columns:
        if name in (*LOCAL, *GEODETIC, "node", "name", "note") or name.startswith("sd_"):
            continue
        kind, _, component = name.partition("_")
        if kind not in KINDS or not component:
            kind, component = "", name
            if name not in OWN and (name in RESERVED or get_close_matches(name, KNOWN, 1, 0.85)):
                raise InputError(
                    f'{table.source} column "{name}" cannot be the name of an extra component,'
                    f" rename it{nearest(name, KNOWN)}"
                )
        default = POSE_UNITS.get(component, "1")
        unit = units[name] or default
        values, there = numbers(table, cells[name], name)
        if component in POSE_UNITS and component != "clock":
            values = values * unit_factor(table, name, unit, default)
            unit = default
        other = first.setdefault(component, (name, unit))
        if other[1] != unit:
            raise InputError(
                f'{table.source} column "{name}" is in "{unit}", "{other[0]}" in "{other[1]}"; give both one unit'
            )
        found[kind][component] = [
            (float(value) if not kind or unit == default else _bias(table, row, unit, value)) if known else None
            for row, (value, known) in enumerate(zip(values, there, strict=True))
        ]
    return found


def _bias(table: Table, row: int, unit: str, scale: float) -> Bias:
    try:
        return Bias(unit, float(scale))
    except InputError as error:
        raise InputError(f"{table.where(row)}: {error}") from None


def write_network(path: AnyPath, network: Network) -> Path:
    """Write all that a network states as CSV, each number exact: a row per component of a node and bias of a sensor.

    Columns: `name` (the label of the bias that it has or might have, such as `mast.position_x`), `of` (node, sensor or
    sensor type), `unit`, `value` and `sd`, the survey, blank where a value is known exactly or only its scale is
    declared. The position of a moving node is the start of its path. Sensor functions, scales and correlations are
    not in it; `with_calibration` lays it on a declared network. Raises `InputError` where it cannot be written.
    """
    rows: list[dict[str, Any]] = []
    surveys = {bias.label: bias for bias in network.biases if bias.since is None}
    stated = network.stated
    for node in network.nodes:
        for component in ("position", *node.components):
            unit = node.spread[component][1].unit if component in node.spread else POSE_UNITS.get(component, "1")
            for label in node.labels(component):
                rows.append({"name": label, "of": "node", "unit": unit, "value": float(stated[label])})
    types = {kind.name for kind in network.types}
    for bias in surveys.values():
        if bias.sensor_type:
            of = "sensor type" if bias.owner in types else "sensor"
            rows.append({"name": bias.label, "of": of, "unit": bias.unit, "value": bias.nominal})
    for row in rows:
        known = surveys.get(row["name"])
        row["sd"] = known.scale if known is not None and known.kind == "survey" else None
    return write_whole(path, csv_text(pd.DataFrame(rows)))


def read_network(path: AnyPath, network: Network) -> dict[str, tuple[float, float]]:
    """Value and sd by label, of the biases of a network whose sds a file of `write_network` has.

    Sensors and nodes that the network does not have are left out. Raises `InputError` naming file, row and name.
    """
    path = Path(path)
    try:
        table = list(csv.DictReader(path.read_text(encoding="utf-8-sig").splitlines()))
        rows = [(unescaped(row["name"]), row["unit"], float(row["value"]), row["sd"]) for row in table]
        known = {
            name: (unit, value, float(sd)) if sd.strip() else (unit, value, None) for name, unit, value, sd in rows
        }
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, csv.Error) as error:
        raise InputError(f"{path} is no file of write_network ({type(error).__name__}: {error})") from None
    owners = {sensor.name for sensor in network.sensors} | {kind.name for kind in network.types}
    owners |= {node.name for node in network.nodes}
    biases = {bias.label: bias for bias in network.biases if bias.since is None}
    stated = network.stated
    if owners.isdisjoint(name.rpartition(".")[0] for name in known):
        raise InputError(f"{path}: the network has none of its nodes and sensors; give the file of this network")
    found = {}
    for name, (unit, value, sd) in known.items():
        if name.rpartition(".")[0] not in owners:
            continue
        if not np.isfinite(value) or not (sd is None or (np.isfinite(sd) and sd > 0)):
            raise InputError(f"{path}: {name} is {value:g} with sd {sd}; give finite numbers, an sd above 0 or none")
        bias = biases.get(name)
        if sd is not None and (bias is None or bias.unit != unit):
            raise InputError(f"{path}: {name} in {unit} is no bias of the network; declare it, or leave its sd blank")
        if sd is not None:
            found[name] = (value, sd)
        elif bias is None and not np.isclose(stated.get(name, value), value, rtol=1e-9, atol=1e-9):
            raise InputError(f"{path}: {name} is {value:g}, the network states {stated[name]:g}; state the same")
    return found


class _Record(NamedTuple):
    """The data to write for a node: name, position (d,), components, spreads or sds by column."""

    name: str
    position: np.ndarray
    components: dict[str, float]
    further: dict[str, float]
    units: dict[str, str]  # by component


def write_nodes(
    path: AnyPath,
    nodes: xr.DataTree | Mapping[str, Node] | Iterable[Node],
    *,
    frame: LocalFrame | None = None,
) -> Path:
    """Write nodes, or the calibrated nodes of a fit, to CSV or GeoJSON with the columns of `read_nodes`.

    Nodes are written with their `survey_...` and `scale_...`, a fit as stated value + bias (its mean) with columns
    `sd_<bias>`. With a `frame` (that of `Nodes` from `read_nodes` by default) places are latitude and longitude, and
    GeoJSON can be written; without, metres. Nodes that move or drift are left out. Raises `InputError`.

    Such a file is a map. Where a fit has biases of sensors, or nodes that are left out, a column `note` counts them;
    `write_network` keeps them.
    """
    path = Path(path)
    if frame is None and isinstance(nodes, Nodes):
        frame = nodes.frame
    geojson = path.suffix.lower() in GEOJSON
    if geojson and frame is None:
        raise InputError(f"{path.name}: GeoJSON holds latitude and longitude; give a frame, or write CSV")
    if isinstance(nodes, xr.DataTree):
        records = _calibrated(nodes)
    else:
        given: Any = nodes.values() if isinstance(nodes, Mapping) else nodes
        records = _stated(given)
    if not records:
        raise InputError(f"{path.name}: there is no node that stands still; nothing is to be written")
    cells = pd.DataFrame(_rows(records, frame))
    idle = [c for c in cells.columns if c.split(" ")[0] in OWN and (cells[c].abs() < 1e-12).all()]
    cells = cells.drop(columns=idle)
    if isinstance(nodes, xr.DataTree) and (note := _left_out(nodes, len(records))):
        cells["note"] = note
    text = _geojson(cells) if geojson else csv_text(cells)
    return write_whole(path, text)


def _left_out(tree: xr.DataTree, written: int) -> str:
    """The sentence that says what of a fit a map of its nodes lacks; empty where it lacks nothing."""
    sensors = int((tree["calibration"]["sensor_type"] != "").sum())
    nodes = tree["constant_data"].sizes["node"] - written
    counts = ((sensors, "biases of sensors"), (nodes, "nodes that move or drift"))
    left = ", ".join(f"{what} ({count})" for count, what in counts if count)
    return f"a map, without {left}; write_network keeps them" if left else ""


def _stated(nodes: Iterable[Node]) -> list[_Record]:
    records = []
    for node in nodes:
        for component, value in node.components.items():
            if np.ndim(value):
                raise InputError(
                    f'node "{node.name}" states {component} as a vector, which a file of nodes does not hold; keep such'
                    " nodes in Python"
                )
        for component in node.sizes:
            if len(set(node.sizes[component])) > 1:
                raise InputError(
                    f'node "{node.name}" has a survey of {component} per axis, which a file of nodes does not hold;'
                    " write the network with write_network"
                )
        further = {f"{kind}_{component}": bias.scale for component, (kind, bias) in node.spread.items()}
        units = {component: bias.unit for component, (_, bias) in node.spread.items()}
        if node.path is None and not any(bias.drift for _, bias in node.spread.values()):
            records.append(_Record(node.name, node.position, node.components, further, units))
    return records


def _calibrated(tree: xr.DataTree) -> list[_Record]:
    """Nodes of a fit: stated value + fixed bias or posterior mean, and the posterior sd of each bias."""
    if not {"constant_data", "calibration"} <= set(tree.children):
        raise InputError("the tree holds no calibrated nodes; give the result of fit()")
    constant, found = tree["constant_data"].to_dataset(), tree["calibration"].to_dataset()
    table = found[["mean", "sd", "unit"]].to_dataframe().to_dict("index")
    shift: dict[Any, float] = constant["fixed"].to_series().to_dict() if "fixed" in constant else {}
    shift |= {label: row["mean"] for label, row in table.items()}
    steps = [step_of(label, shift) for label in shift]
    drifting = {step[0] for step in steps if step is not None}
    stated = constant[["stated_node", "stated_component", "stated"]].to_dataframe()
    records = []
    for node, place, moving in zip(*(constant[n].values for n in ("node", "node_position", "moving")), strict=True):
        axes = coordinates()[: len(place)]
        rows = stated.loc[stated["stated_node"] == node, ["stated_component", "stated"]].itertuples(index=False)
        components = {str(name): value + shift.get(f"{node}.{name}", 0.0) for name, value in rows}
        labels = {name: f"{node}.{name}" for name in (*axes, *components)}
        own = {name: table[label] for name, label in labels.items() if label in table}
        if not moving and drifting.isdisjoint(labels.values()):
            position = place + [shift.get(labels[axis], 0.0) for axis in axes]
            further = {f"sd_{name}": row["sd"] for name, row in own.items()}
            units = {name: row["unit"] for name, row in own.items() if name not in axes}
            records.append(_Record(str(node), position, components, further, units))
    return records


def _rows(records: list[_Record], frame: LocalFrame | None) -> list[dict[str, Any]]:
    """Cells of each record by header: angles in degrees, clock and extras in their unit."""
    for record in records:
        if record.position.shape != records[0].position.shape:
            raise InputError(f'nodes "{records[0].name}" and "{record.name}" differ in dimension; write them apart')
    position = np.stack([record.position for record in records])
    place, columns, axes = position, LOCAL, None
    if frame is not None:
        place, columns = np.stack(frame.to_geodetic(position), -1), GEODETIC
        axes = _reference(frame, place).swapaxes(1, 2)
    units: dict[str, str] = {}
    for record in records:
        for component, unit in record.units.items():
            if units.setdefault(component, unit) != unit:
                raise InputError(
                    f'the nodes state "{component}" in "{units[component]}" and in "{unit}"; a file needs one unit'
                )

    def cell(name: str, value: float) -> tuple[str, float]:
        component = name.partition("_")[2] if name.startswith(("sd_", "survey_", "scale_")) else name
        default = POSE_UNITS.get(component, "m" if component.startswith("position") else "1")
        unit = units.get(component, default)
        if component in ANGLES:
            return f"{name} [deg]", round(float(np.rad2deg(value)), 12) + 0.0  # no negative zero
        return (name if unit == default else f"{name} [{unit}]"), float(value)

    rows = []
    for k, record in enumerate(records):
        components = record.components if axes is None else _turned(record.components, axes[k])
        where = {
            name: round(float(v), 6 if PLACE_UNITS[name] == "m" else 11)
            for name, v in zip(columns, place[k], strict=False)
        }
        row = {"node": record.name} | where
        rows.append(row | dict(cell(*item) for item in (components | record.further).items()))
    return rows


def _geojson(cells: pd.DataFrame) -> str:
    """A FeatureCollection of points, blank properties left out."""
    features = []
    for record in cells.to_dict("records"):
        place = [record.pop(column) for column in ("longitude", "latitude", "height") if column in record]
        properties = {name: value for name, value in record.items() if value == value}
        geometry = {"type": "Point", "coordinates": place}
        features.append({"type": "Feature", "geometry": geometry, "properties": properties})
    return json.dumps({"type": "FeatureCollection", "features": features}, indent=1, allow_nan=False) + "\n"
