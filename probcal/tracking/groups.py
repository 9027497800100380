"""Detections without names in a tree: the objects found, the detections and looks of each sensor, and beliefs."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from probcal.lazy import pd, xr
from probcal.problem import Problem
from probcal.tracking.objects import Objects
from probcal.tracking.poses.propagation import Beliefs
from probcal.tracking.scan import View, Watch, alone, detected, watch_of

LOOKS, UNSEEN = 8.0, 0.1  # detections expected of an object, and the share below which it is not seen


def with_objects(tree: xr.DataTree, objects: Objects, problem: Problem, z: Any) -> xr.DataTree:
    """The tree with the groups `association`, `object` and `detection`, at biases z (M,)."""
    tree.attrs["objects"] = len(objects.names)
    for name, group in object_groups(problem, objects, z).items():
        tree[name] = xr.DataTree(group)
    return tree


def object_groups(problem: Problem, objects: Objects, z: Any) -> dict[str, xr.Dataset]:
    """Groups `association` (pairs of detection and track), `object` (paths by scan) and `detection` (by sensor)."""
    return {
        "association": objects.rows.rename_axis("pair").to_xarray(),
        "object": objects.path.rename_axis("line").to_xarray(),
        "detection": _by_sensor(problem, objects, np.asarray(z, float)),
    }


def belief_group(beliefs: Beliefs) -> xr.Dataset:
    """The history of beliefs: mean and sd of biases per iteration, sensor placement, and edges."""
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
    """The degree, 0 to 1, to which an object at x (N, n) is in view of a scan's sensor (N,)."""

    def one(k: jax.Array, x: jax.Array) -> jax.Array:
        own = jax.tree.map(lambda leaf: leaf[k], watch.scans)
        return detected(watch.model, own._replace(probability=1.0), views, x, z)

    return jax.vmap(one)(scan, x)
