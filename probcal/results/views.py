"""The fields of view of sensors that declare detection, as variables of a tree."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from probcal.detection import Sector
from probcal.labels import coordinates
from probcal.model.epochs import Seen
from probcal.model.rows import look

if TYPE_CHECKING:
    from probcal.gaussian.mode import Point
    from probcal.problem import Problem

CELLS = 121  # along each side of the grid on which a view that is no sector is evaluated
BESIDE = 0.5  # of the extent of nodes and tracks that this grid reaches beyond them


def view_variables(problem: Problem, point: Point | None) -> tuple[dict[str, Any], dict[str, Any]]:
    """Variables and coordinates of a tree that say what each sensor sees; none where no sensor declares detection.

    A `Sector` is its range, width and direction, NaN elsewhere. Another function is evaluated at a `point`, if
    there is one: for its pose, on a grid over nodes and tracks, in space at the mean height of the tracks.
    """
    placed = problem.network.sensors
    if all(sensor.detection is None for sensor in placed):
        return {}, {}
    declared = [sensor.detection for sensor in placed]
    views = [getattr(own, "view", None) for own in declared]
    sectors = [view if isinstance(view, Sector) else None for view in views]
    columns: dict[str, tuple[list[Any], str]] = {
        "view_range": (sectors, "range"), "view_width": (sectors, "width"), "view_towards": (sectors, "towards"),
        "detection_probability": (declared, "chance"), "clutter": (declared, "rate"),
    }  # fmt: skip
    values: dict[str, Any] = {
        name: ("sensor", np.array([getattr(own, part, np.nan) for own in owners], float))
        for name, (owners, part) in columns.items()
    }
    coords: dict[str, Any] = {"sensor": [sensor.name for sensor in placed]}
    others = [s for s, view in enumerate(views) if view is not None and not isinstance(view, Sector)]
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
    shift = dict(zip(problem.labels, np.asarray(point.z) * problem.scales, strict=True))
    for node in problem.network.nodes:
        moved = [shift.get(label, 0.0) for label in coordinates(of=node.name)[:d]]
        parts.append((node.position + moved)[None] if node.path is None else node.path.position)
    flown = problem.positions(problem.model.vectors_of(point.states))
    whole = np.concatenate([*parts, *flown])
    whole = whole[np.isfinite(whole).all(1)]
    low, high = whole.min(0)[:2], whole.max(0)[:2]
    beside = BESIDE * max(float((high - low).max()), 1.0)
    x, y = (np.linspace(a - beside, b + beside, CELLS) for a, b in zip(low, high, strict=True))
    tracks = np.concatenate(flown)
    return x, y, float(np.nanmean(tracks[:, 2])) if d == 3 else 0.0


def _over(problem: Problem, point: Point, s: int, grid: tuple[np.ndarray, np.ndarray, float]) -> np.ndarray | None:
    """The degree to which each grid place (y, x) is in the view of sensor s; None without rows."""
    model, sensor = problem.model, problem.network.sensors[s]
    assert sensor.detection is not None
    assert sensor.detection.view is not None
    x, y, height = grid
    flat = [part.ravel() for part in np.meshgrid(x, y)]
    places = np.stack([*flat, np.full(len(flat[0]), height)][: problem.network.dimension], 1)
    for block, data, r, index in model.each_block(problem.row_index):
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
