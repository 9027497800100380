"""Lines and planes of a network, and what is reflected in them."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np

from probcal.gaussian.information import at_levels
from probcal.gaussian.mode import Point
from probcal.labels import AXES
from probcal.linalg import spectrum
from probcal.modes.grid import WINDOWS, follow_states, known_places
from probcal.problem import Problem

FAR = 6.0  # scales beyond which a node is not reflected
SHIFTED = 0.3  # scales by which nodes must be moved to count as reflected
HEARD = 4  # sets of nodes that are heard alone in some window of a track, and are looked at


class Plane(NamedTuple):
    """A line in 2-D or a plane in 3-D."""

    name: str
    centre: np.ndarray  # (d,)
    normal: np.ndarray  # (d,) unit

    def distance(self, place: np.ndarray) -> np.ndarray:
        """Signed distance (...) of places (..., d)."""
        return (place - self.centre) @ self.normal

    def across(self, place: np.ndarray) -> np.ndarray:
        """Places (..., d) on the other side."""
        return place - 2.0 * self.distance(place)[..., None] * self.normal


def planes(problem: Problem, z: np.ndarray) -> list[Plane]:
    """Least-squares lines (in 3-D planes) at biases z (M,): of the known nodes, of all, of those heard together."""
    d, place = problem.network.dimension, node_places(problem, z)
    free = {b.owner for b in problem.biases if b.component == "position"}
    groups = [("the known nodes", [name for name in place if name not in free]), ("the nodes", list(place))]
    groups += [(_listed(names), names) for names in _heard(problem, set(place))]
    found: list[Plane] = []
    for name, group in groups:
        points = np.array([place[n] for n in group]).reshape(-1, d)
        if len(group) < d:
            continue
        centre = points.mean(0)
        values, vectors = spectrum(np.cov(points.T))
        if values[1] <= 1e-9 * values[-1]:  # nodes at one place, or on one line in 3-D
            continue
        plane = Plane(f"the {'line' if d == 2 else 'plane'} of {name}", centre, vectors[:, 0])
        size = float(np.sqrt(values[-1]))
        same = (abs(plane.normal @ p.normal) > 1 - 1e-9 and abs(p.distance(centre)) < 1e-6 * size for p in found)
        if not any(same):
            found.append(plane)
    return found


def touched(problem: Problem, point: Point, variances: Sequence[np.ndarray]) -> tuple[float, str]:
    """The least distance in sd of a target from a plane of the nodes, and which, when and where.

    `variances` are those (E, n) of the states of each recursion. On the plane the data do not tell how far off it a
    target is, nor on which side it goes on: an approximation by a Gaussian around one track says too little there.
    """
    least, words = np.inf, ""
    for plane in planes(problem, np.asarray(point.z)):
        for name, time, place, variance, mine in problem.tracks(
            problem.positions(point.states), problem.positions(variances), movable(problem)
        ):
            sd = np.sqrt(variance @ plane.normal**2)
            ratio = np.where(mine, np.abs(plane.distance(place)) / np.maximum(sd, 1e-300), np.inf)
            k = int(ratio.argmin())
            if ratio[k] < least:
                least = float(ratio[k])
                words = f'target "{name}" touches {plane.name} at {time[k]:.6g} s'
    return least, words


def _heard(problem: Problem, resting: set[str]) -> list[list[str]]:
    """Sets of resting nodes that alone tell of a target for some time, those of most rows first."""
    data, sensors = problem.measurements, problem.network.sensors
    nodes = [sorted({node.name for node in sensor.nodes} & resting) for sensor in sensors]
    rows: dict[tuple[str, ...], int] = {}
    for k in range(len(data.target_names)):
        mine = np.flatnonzero(data.target == k)
        for window in np.array_split(mine[np.argsort(data.time[mine], kind="stable")], WINDOWS):
            names = tuple(sorted({name for s in np.unique(data.sensor[window]) for name in nodes[s]}))
            if 2 <= len(names) < len(resting):
                rows[names] = rows.get(names, 0) + len(window)
    return [list(names) for names in sorted(rows, key=lambda names: -rows[names])[:HEARD]]


def _listed(names: list[str]) -> str:
    """Names in a sentence."""
    few = names[:4]
    return ", ".join(few[:-1]) + f" and {few[-1]}" if len(names) <= 4 else f"{', '.join(few)} and {len(names) - 4} more"


def node_places(problem: Problem, z: np.ndarray) -> dict[str, np.ndarray]:
    """Place (d,) of every node that rests, by name, at biases z (M,)."""
    d = problem.network.dimension
    place = {
        node.name: node.position + [problem.fixed.get(f"{node.name}.position_{axis}", 0.0) for axis in AXES[:d]]
        for node in problem.network.nodes
        if node.path is None
    }
    for m, bias in enumerate(problem.biases):
        if bias.component == "position" and bias.owner in place and bias.since is None:
            place[bias.owner][bias.axis] += z[m] * bias.scale
    return place


def place_biases(problem: Problem) -> dict[str, list[int]]:
    """The position biases of each static node that has any, by its name."""
    resting = {node.name for node in problem.network.nodes if node.path is None}
    found: dict[str, list[int]] = {}
    for m, bias in enumerate(problem.biases):
        if bias.component == "position" and bias.owner in resting and bias.since is None:
            found.setdefault(bias.owner, []).append(m)
    return found


def across(
    problem: Problem, z: np.ndarray, place: np.ndarray, members: list[int], plane: Plane
) -> np.ndarray | None:  # fmt: skip
    """Biases z of a node at `place` (d,) on the other side of a plane, for its free axes.

    None where an axis that is not free would have to move, or where it lies `FAR` scales off.
    """
    shift = plane.across(place) - place
    axes = [problem.biases[m].axis for m in members]
    held = np.abs(np.delete(shift, np.array(axes))).max(initial=0.0)
    moved = z[members] + shift[axes] / problem.scales[members]
    within = held <= 1e-6 * np.abs(shift).max() and np.abs(moved).max() < FAR
    return moved if within else None


def reflect_nodes(problem: Problem, z: np.ndarray, plane: Plane) -> np.ndarray:
    """Biases (M,) with every node of free place on the other side, where that is within `FAR` scales."""
    place, moved = node_places(problem, z), np.array(z, float)
    for name, members in place_biases(problem).items():
        if (own := across(problem, z, place[name], members, plane)) is not None:
            moved[members] = own
    return moved


def reflect(problem: Problem, point: Point, plane: Plane, chosen: Sequence[np.ndarray], z: np.ndarray) -> Point:
    """The point at biases z (M,) with the chosen epochs (E,) of each recursion on the other side of a plane."""
    tracks = []
    for _, epochs, states, mine in problem.model.each_layout(problem.epochs, point.states, chosen):
        moved = np.array(states)
        for name, start, stop, _ in epochs.layout:
            if name == "position":
                moved[mine, start:stop] = plane.across(moved[mine, start:stop])
            elif name in ("velocity", "acceleration"):
                vector = moved[mine, start:stop]
                moved[mine, start:stop] = vector - 2.0 * (vector @ plane.normal)[:, None] * plane.normal
        tracks.append(moved)
    return at_levels(problem.model, follow_states(problem, tracks)._replace(z=jax.device_put(z)), point.levels)


def movable(problem: Problem) -> list[np.ndarray]:
    """Epochs (E,) of each recursion whose place the data tell, not the motion."""
    found = []
    for r, epochs in enumerate(problem.epochs):
        _, known = known_places(problem, r, epochs.position)
        found.append(~known)
    return found
