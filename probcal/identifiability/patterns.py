"""Directions that a network is likely to leave open: common shifts, translation, rotation and dilation."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from probcal.gaussian.mode import Point
from probcal.labels import AXES, NOBODY, label_parts
from probcal.linalg import singular
from probcal.problem import Problem

STRAIGHT = 0.03  # width of a path over its length below which it is one line
DILATION = "dilation: all positions grow or shrink together"
TOWARDS = {"x": "east", "y": "north", "z": "up"}


class Pattern(NamedTuple):
    """A candidate direction (F,) in z of the free biases; those that it leaves at 0 may move along."""

    name: str
    words: str
    vector: np.ndarray
    remedy: str
    anchors: tuple[tuple[str, ...], ...]  # groups of labels one of which is to be fixed


def common_shifts(problem: Problem) -> list[Pattern]:
    """One component of all owners shifted together, by the same amount."""
    found = []
    kinds = [(b.component, b.axis, b.since) for b in problem.biases]
    for kind in dict.fromkeys(kind for kind in kinds if kind[0] != "position"):
        members = [m for m, own in enumerate(kinds) if own == kind]
        component = kind[0] if kind[2] is None else label_parts(problem.labels[members[0]])[1]
        if len(members) > 1:
            vector = np.zeros(len(problem.biases))
            vector[members] = 1.0 / problem.scales[members]
            anchors = tuple((problem.labels[m],) for m in members)
            words = f"{component} of all grows by the same amount"
            found.append(Pattern(f"a common {component} of all", words, vector, f"anchor one {component}", anchors))
    return found


def rigid_motions(problem: Problem, z: np.ndarray) -> list[Pattern]:
    """Translation, rotation and dilation of all nodes; about the anchor where one node is anchored."""
    d = problem.network.dimension
    place = {
        (b.owner, b.axis): m for m, b in enumerate(problem.biases) if b.component == "position" and b.kind == "scale"
    }
    owners = {owner for owner, _ in place}
    at = {
        node.name: node.position + [problem.fixed.get(f"{node.name}.position_{axis}", 0.0) for axis in AXES[:d]]
        for node in problem.network.nodes
    }
    anchors = [where for name, where in at.items() if name not in owners]
    if not owners or len(anchors) > 1:
        return []
    at = {name: where for name, where in at.items() if name in owners}
    for (owner, axis), m in place.items():
        at[owner][axis] += z[m] * problem.scales[m]
    centre = anchors[0] if anchors else np.mean(list(at.values()), 0)
    about, who = (" about the anchor", "all nodes but the anchor") if anchors else ("", "all nodes")

    def pattern(move: np.ndarray, shift: Any = 0.0) -> np.ndarray:
        """Velocities move @ (position - centre) + shift of all free positions, in z."""
        vector = np.zeros(len(z))
        for (owner, axis), m in place.items():
            vector[m] = (move @ (at[owner] - centre) + shift)[axis] / problem.scales[m]
        return vector

    nodes = tuple(
        tuple(problem.labels[m] for (other, _), m in place.items() if other == owner) for owner in dict.fromkeys(at)
    )
    found = []
    if not anchors:
        for axis in range(d):
            vector = pattern(np.zeros((d, d)), np.eye(d)[axis])
            words = f"{who} move 1 m {TOWARDS[AXES[axis]]} together"
            name = f"translation of all nodes along {AXES[axis]}"
            found.append(Pattern(name, words, vector, "anchor the position of one node", nodes))
    turned = tuple((b.label,) for b in problem.biases if b.component == "heading")
    headed = ", or one heading" if turned else ""
    for a, b in [(0, 1)] if d == 2 else [(0, 1), (1, 2), (2, 0)]:
        turn = np.zeros((d, d))
        turn[a, b], turn[b, a] = -1.0, 1.0
        vector = pattern(turn)
        for m, bias in enumerate(problem.biases):
            if bias.component == "heading" and (a, b) == (0, 1):
                vector[m] = 1.0 / problem.scales[m]
        name = ("rotation" if d == 2 else f"rotation around {AXES[3 - a - b]}") + about
        words = f"{who} turn{about or ' about their centre'} together" + (
            f", around {AXES[3 - a - b]}" if d > 2 else ""
        )
        remedy = f"anchor the position of one more node{headed}"
        found.append(Pattern(name, words, vector, remedy, (*nodes, *turned)))
    words = f"distances{about or ' from the centre'} grow together"
    found.append(Pattern(f"{DILATION}{about}", words, pattern(np.eye(d)), "anchor the positions of two nodes", nodes))
    return found


def directed(problem: Problem, z: np.ndarray) -> Iterator[tuple[Pattern, np.ndarray]]:
    """Rigid motions and common shifts of more than one bias without a survey, and the unit vector (M,) of each."""
    for pattern in (*rigid_motions(problem, z), *common_shifts(problem)):
        vector = np.where(problem.surveyed, 0.0, pattern.vector)
        if np.count_nonzero(vector) > 1:
            yield pattern, vector / np.linalg.norm(vector)


def cause(problem: Problem, point: Point) -> str:
    """Why a combination may be weak: all targets pass along one direction, each on one line, where that is so."""
    lines = []
    for name, _, path in problem.tracks(problem.positions(point.states)):
        if name == NOBODY:
            continue
        if len(path) < 3:
            return ""
        _, sizes, along = singular(path - path.mean(0))
        if sizes[1] > STRAIGHT * sizes[0]:
            return ""
        lines.append(along[0])
    if not lines or np.abs(np.array(lines) @ lines[0]).min() < 1 - STRAIGHT:
        return ""
    return ": the target passed on one line" if len(lines) == 1 else ": the targets passed along parallel lines"
