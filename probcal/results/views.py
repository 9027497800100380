"""Detections that nobody named, in a tree: the objects found, what each sensor detected of them, and what it sees."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from probcal.detection import Sector
from probcal.labels import AXES
from probcal.lazy import Later
from probcal.model.epochs import Seen
from probcal.model.rows import look
from probcal.tracking.objects import Objects
from probcal.tracking.scan import View, Watch, alone, detected, watch_of

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from probcal.problem import Problem
    from probcal.smoothing.mode import Point
    from probcal.tracking.poses.propagation import Beliefs
else:
    pd, xr = Later("pandas"), Later("xarray")

LOOKS, UNSEEN = 8.0, 0.1  # detections expected of an object, and the share below which it is not seen
CELLS = 121  # along each side of the grid on which a view that is no sector is evaluated
BESIDE = 0.5  # of the extent of nodes and tracks that this grid reaches beyond them


def object_groups(problem: Problem, objects: Objects, z: Any) -> dict[str, xr.Dataset]:
    """Groups `association` (pairs of detection and track), `object` (paths by scan) and `detection` (by sensor)."""
    return {
        "association": objects.rows.rename_axis("pair").to_xarray(),
        "object": objects.path.rename_axis("line").to_xarray(),
        "detection": _by_sensor(problem, objects, np.asarray(z, float)),
    }


def belief_group(beliefs: Beliefs) -> xr.Dataset:
    """How beliefs went: mean and sd of each bias by iteration, how each sensor was placed, and the edges."""
    trace = beliefs.trace
    rounds = trace.drop_duplicates("iteration").set_index("iteration")[["phase", "seconds"]]
    found = trace.set_index(["iteration", "bias"])[["mean", "sd"]].to_xarray().rename(bias="bias_label")
    sensors = beliefs.sensors.set_index("sensor").rename_axis("vertex").to_xarray()
    edges = beliefs.edges.rename_axis("edge").to_xarray()
    return xr.merge([found, rounds.to_xarray(), sensors, edges]).assign_attrs(rests=int(beliefs.rests))


def _by_sensor(problem: Problem, objects: Objects, z: np.ndarray) -> xr.Dataset:
    """Scans and detections of each sensor, how many are of objects, and looks: the mean number of objects in view."""
    scans, S = problem.scans, len(problem.network.sensors)
    assert scans is not None
    pairs = looks_of(problem, objects, z)
    columns = {
        "scans": np.bincount(scans.sensor, minlength=S),
        "detections": np.bincount(scans.sensor, scans.count, S).astype(int),
        "of_objects": np.bincount(pairs["sensor"], pairs["detections"], S),
        "looks": np.bincount(pairs["sensor"], pairs["looks"], S),
    }
    values = {name: ("sensor", column) for name, column in columns.items()}
    return xr.Dataset(values, coords={"sensor": [placed.name for placed in problem.network.sensors]})


def looks_of(problem: Problem, objects: Objects, z: np.ndarray) -> pd.DataFrame:
    """Looks and detections of each track by each sensor: columns sensor (its number), track, looks, detections.

    A look is an object in view in one scan, counted with its existence, at biases z (M,).
    """
    scans = problem.scans
    assert scans is not None
    rows, path = objects.rows, objects.path.drop_duplicates(["track", "time"], keep="last")
    pairs = path.merge(pd.DataFrame({"time": scans.time, "scan": np.arange(len(scans))}), on="time")
    scan = pairs["scan"].to_numpy(int)
    watch, views = watch_of(problem)
    seen = np.ones(len(scan))
    if views != (None,) and len(scan):
        x = pairs[list(alone(problem).epochs[0].components)].to_numpy(float)
        seen = np.asarray(_in_view(watch, views, jnp.asarray(scan), jnp.asarray(x), jnp.asarray(z)))
    keys = ["sensor", "track"]
    looks = pairs.assign(sensor=scans.sensor[scan], looks=pairs["existence"] * seen).groupby(keys)["looks"].sum()
    sensor = problem.measurements.sensor[rows["row"].to_numpy(int)]
    found = rows.assign(sensor=sensor, detections=rows["weight"]).groupby(keys)["detections"].sum()
    return pd.concat([looks, found], axis=1).fillna(0.0).reset_index()


def disagreeing(problem: Problem, objects: Objects, z: Any) -> list[tuple[str, str, str, str]]:
    """Two sensors, and an object of each that the other should see, at the same time, and never does.

    Such twins tell that sensors differ by what no bias allows for (a clock, say); an object that is hidden from one
    sensor has none.
    """
    placed = problem.network.sensors
    pairs = looks_of(problem, objects, np.asarray(z, float))
    chance = np.array([s.detection.chance if s.detection is not None else 0.0 for s in placed])
    expected = pairs["looks"] * chance[pairs["sensor"]]
    sure = expected >= LOOKS
    missed = pairs[sure & (pairs["detections"] < UNSEEN * expected)]
    held = pairs[sure & (pairs["detections"] > 0.5 * expected)]
    span = objects.path.groupby("track")["time"].agg(["min", "max"])
    alone_ = missed.merge(held, on="track", suffixes=("", "_held"))  # of a track: who misses it, who holds it
    found: dict[tuple[int, int], tuple[str, str, str, str]] = {}
    both = alone_.merge(alone_, left_on=["sensor", "sensor_held"], right_on=["sensor_held", "sensor"])
    for a, b, first, second in zip(
        both["sensor_x"], both["sensor_held_x"], both["track_x"], both["track_y"], strict=True
    ):
        together = min(span["max"][first], span["max"][second]) - max(span["min"][first], span["min"][second])
        if a < b and together > 0:
            found.setdefault((a, b), (placed[a].name, first, placed[b].name, second))
    return list(found.values())


@partial(jax.jit, static_argnames=("views",))
def _in_view(watch: Watch, views: tuple[View, ...], scan: jax.Array, x: jax.Array, z: jax.Array) -> jax.Array:
    """How far an object at x (N, n) is in the view of the sensor of a scan (N,), from 0 to 1."""

    def one(k: jax.Array, x: jax.Array) -> jax.Array:
        own = jax.tree.map(lambda leaf: leaf[k], watch.scans)
        return detected(watch.model, own._replace(probability=1.0), views, x, z)

    return jax.vmap(one)(scan, x)


# What a sensor sees


def view_variables(problem: Problem, point: Point | None) -> tuple[dict[str, Any], dict[str, Any]]:
    """Variables and coordinates of a tree that say what each sensor sees; none where no sensor declares detection.

    A `Sector` is its range, width and direction, NaN elsewhere. Another function is evaluated at a `point`, if
    there is one: for its pose, on a grid over nodes and tracks, in space at the mean height of the tracks.
    """
    placed = problem.network.sensors
    if all(sensor.detection is None for sensor in placed):
        return {}, {}
    told = [sensor.detection for sensor in placed]
    sectors = [own.view if own is not None and isinstance(own.view, Sector) else None for own in told]
    columns = {
        "view_range": [np.nan if own is None else own.range for own in sectors],
        "view_width": [np.nan if own is None else own.width for own in sectors],
        "view_towards": [np.nan if own is None else own.towards for own in sectors],
        "detection_probability": [np.nan if own is None else own.chance for own in told],
        "clutter": [np.nan if own is None else own.rate for own in told],
    }
    values: dict[str, Any] = {name: ("sensor", np.array(column, float)) for name, column in columns.items()}
    coords: dict[str, Any] = {"sensor": [sensor.name for sensor in placed]}
    others = [
        s for s, own in enumerate(told) if own is not None and own.view is not None and not isinstance(own.view, Sector)
    ]
    if point is None or not others:
        return values, coords
    grid = _grid(problem, point)
    seen = {placed[s].name: values_ for s in others if (values_ := _over(problem, point, s, grid)) is not None}
    if seen:
        values["view"] = (("viewing", "view_y", "view_x"), np.stack(list(seen.values())))
        coords |= {"viewing": list(seen), "view_x": grid[0], "view_y": grid[1]}
    return values, coords


def _grid(problem: Problem, point: Point) -> tuple[np.ndarray, np.ndarray, float]:
    """Coordinates x and y of a grid over nodes and tracks, and the mean height of the tracks."""
    d, parts = problem.network.dimension, []
    z = np.asarray(point.z) * problem.scales
    for node in problem.network.nodes:
        labels = [f"{node.name}.position_{axis}" for axis in AXES[:d]]
        moved = [z[problem.labels.index(label)] if label in problem.labels else 0.0 for label in labels]
        parts.append((node.position + moved)[None] if node.path is None else node.path.position)
    flown = [
        np.asarray(problem.model.vectors(r, point.states[r]))[:, slice(*epochs.position)]
        for r, epochs in enumerate(problem.epochs)
    ]
    whole = np.concatenate([*parts, *flown])
    whole = whole[np.isfinite(whole).all(1)]
    low, high = whole.min(0)[:2], whole.max(0)[:2]
    beside = BESIDE * max(float((high - low).max()), 1.0)
    x, y = (np.linspace(a - beside, b + beside, CELLS) for a, b in zip(low, high, strict=True))
    tracks = np.concatenate(flown)
    return x, y, float(np.nanmean(tracks[:, 2])) if d == 3 else 0.0


def _over(problem: Problem, point: Point, s: int, grid: tuple[np.ndarray, np.ndarray, float]) -> np.ndarray | None:
    """How far each place (y, x) of a grid is in the view of sensor s; None where it has no row."""
    model, sensor = problem.model, problem.network.sensors[s]
    assert sensor.detection is not None
    assert sensor.detection.view is not None
    x, y, height = grid
    flat = [part.ravel() for part in np.meshgrid(x, y)]
    places = np.stack([*flat, np.full(len(flat[0]), height)][: problem.network.dimension], 1)
    for block, data, index, r in zip(model.blocks, model.rows, problem.row_index, model.recursion, strict=True):
        mine = np.flatnonzero(problem.measurements.sensor[index] == s)
        if len(mine):
            one = {name: np.asarray(getattr(data, name))[mine[:1]] for name in Seen._fields}
            row = data._replace(epoch=np.zeros(1, int), **one)
            vectors = np.asarray(model.vectors(r, point.states[r]))
            states = np.repeat(vectors[:1], len(places), 0)
            states[:, slice(*problem.epochs[r].position)] = places
            view, z = sensor.detection.view, jnp.asarray(point.z)

            def at(state: jax.Array, block: Any = block, row: Any = row, view: Any = view, z: Any = z) -> jax.Array:
                return jnp.asarray(look(block, row, state[None], z, view)[0], float)

            seen = jax.jit(jax.vmap(at))(jnp.asarray(states))
            return np.asarray(seen).reshape(len(y), len(x)).round(3)
    return None
