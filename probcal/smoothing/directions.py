"""Weak directions of the biases by name: what neither data nor survey fix, and what to anchor.

A direction is weak when its marginal information is below 1 in units of the prior scale.
"""

from dataclasses import dataclass

import numpy as np

from probcal.problem import Problem
from probcal.types import AXES

WEAK = 1.0  # marginal information below which a direction is left to the prior
RIDGE = 1e-2  # keeps the completion of a pattern from running along other weak directions
INVOLVED = 0.3  # share of the largest entry above which a bias is named


@dataclass(frozen=True)
class Direction:
    """A combination of biases that the data do not fix: its name, information, what it moves and a remedy."""

    name: str
    information: float
    vector: np.ndarray  # (M,) unit vector in z
    labels: tuple[str, ...]
    remedy: str

    @property
    def sentence(self) -> str:
        """Name, biases involved and remedy in one line."""
        others = f" with {', '.join(self.labels[:6])}{', ...' if len(self.labels) > 6 else ''}" if self.labels else ""
        return f"{self.name}{others} (information {self.information:.2g}): {self.remedy}"


def weak_directions(problem: Problem, information: np.ndarray, z: np.ndarray) -> tuple[Direction, ...]:
    """Name the directions of marginal information below 1 at biases z (M,), the weakest first.

    Surveyed biases are marginalised with their survey. Translations, rotations, dilation and common shifts
    are tried first, each completed by the other biases that move along; what remains is described by its
    largest entries.
    """
    free = ~problem.surveyed
    if not free.any():
        return ()
    known = _marginal(information, free)
    values, vectors = np.linalg.eigh(known)
    missing = int((values < WEAK).sum())
    if not missing:
        return ()
    labels = [label for label, own in zip(problem.labels, free, strict=True) if own]
    found: list[Direction] = []
    basis = np.zeros((len(labels), 0))
    for name, pattern, remedy in _patterns(problem, z):
        own = pattern[free] != 0
        if not own.any() or len(found) == missing:
            continue
        vector = _complete(known, pattern[free])
        strength = float(vector @ known @ vector)
        rest = vector - basis @ (basis.T @ vector)
        if strength < WEAK and np.linalg.norm(rest) > 0.5:
            basis = np.concatenate([basis, rest[:, None] / np.linalg.norm(rest)], 1)
            involved = _involved(labels, np.where(own, 0.0, vector), np.abs(vector).max())
            found.append(Direction(name, strength, _spread(vector, free), involved, remedy))
    weak = vectors[:, :missing]
    left = np.linalg.svd(weak - basis @ (basis.T @ weak))[0][:, : missing - len(found)]
    for vector in left.T:
        involved = _involved(labels, vector, np.abs(vector).max())
        remedy = f"fix or survey {involved[0]}, or add a pass that excites it"
        strength = float(vector @ known @ vector)
        found.append(Direction("a combination", strength, _spread(vector, free), involved, remedy))
    return tuple(sorted(found, key=lambda direction: direction.information))


def _marginal(information: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Information of the free biases with the surveyed ones marginalised."""
    held = ~free
    inner = information[np.ix_(held, held)] + np.eye(held.sum())
    cross = information[np.ix_(held, free)]
    return information[np.ix_(free, free)] - cross.T @ np.linalg.solve(inner, cross)


def _spread(vector: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Vector of the free biases in the order of all."""
    whole = np.zeros(len(free))
    whole[free] = vector
    return whole


def _involved(labels: list[str], vector: np.ndarray, largest: float) -> tuple[str, ...]:
    order = np.argsort(-np.abs(vector))
    return tuple(labels[m] for m in order if abs(vector[m]) > INVOLVED * largest)


def _complete(information: np.ndarray, pattern: np.ndarray) -> np.ndarray:
    """Unit vector that holds a pattern and lets the other biases move so as to hide it from the data."""
    own = pattern != 0
    unit = pattern / np.linalg.norm(pattern)
    other = ~own
    if other.any():
        inner = information[np.ix_(other, other)] + RIDGE * np.eye(other.sum())
        unit[other] = -np.linalg.solve(inner, information[np.ix_(other, own)] @ unit[own])
    return unit / np.linalg.norm(unit)


def _patterns(problem: Problem, z: np.ndarray) -> list[tuple[str, np.ndarray, str]]:
    """Candidate directions in z, in the order in which names are preferred: rigid motions, dilation, common shifts."""
    found = [*_rigid(problem, z)]
    for component in dict.fromkeys(b.component for b in problem.biases if b.component != "position"):
        members = [m for m, b in enumerate(problem.biases) if b.component == component]
        if len(members) > 1:
            pattern = np.zeros(len(z))
            pattern[members] = 1.0 / problem.scales[members]
            found.append((f"a common {component} of all", pattern, f"fix the {component} of one of them"))
    return found


def _rigid(problem: Problem, z: np.ndarray) -> list[tuple[str, np.ndarray, str]]:
    """Translation, rotation and dilation of all nodes; about the anchor where one node is anchored."""
    d = problem.network.dimension
    place = {
        (b.owner, b.axis): m for m, b in enumerate(problem.biases) if b.component == "position" and b.kind == "scale"
    }
    owners = {owner for owner, _ in place}
    anchors = [node.position for node in problem.network.nodes if node.name not in owners]
    if not owners or len(anchors) > 1:
        return []
    shift = z * problem.scales
    at = {node.name: np.array(node.position) for node in problem.network.nodes if node.name in owners}
    for (owner, axis), m in place.items():
        at[owner][axis] += shift[m]
    centre = anchors[0] if anchors else np.mean(list(at.values()), 0)
    about = " about the anchor" if anchors else ""

    def pattern(move: np.ndarray) -> np.ndarray:
        """Velocities move @ (position - centre) of all free positions, in z."""
        vector = np.zeros(len(z))
        for (owner, axis), m in place.items():
            vector[m] = move[axis] @ (at[owner] - centre) / problem.scales[m]
        return vector

    found = []
    if not anchors:
        for axis in range(d):
            vector = np.zeros(len(z))
            for (_, a), m in place.items():
                vector[m] = (a == axis) / problem.scales[m]
            remedy = "anchor the position of one node (fix it, or give it a survey)"
            found.append((f"translation of all nodes along {AXES[axis]}", vector, remedy))
    headed = ", or one heading" if any(b.component == "heading" for b in problem.biases) else ""
    for a, b in [(0, 1)] if d == 2 else [(0, 1), (1, 2), (2, 0)]:
        turn = np.zeros((d, d))
        turn[a, b], turn[b, a] = -1.0, 1.0
        vector = pattern(turn)
        for m, bias in enumerate(problem.biases):
            if bias.component == "heading" and (a, b) == (0, 1):
                vector[m] = 1.0 / problem.scales[m]
        name = "rotation" if d == 2 else f"rotation around {AXES[3 - a - b]}"
        found.append((name + about, vector, f"anchor the position of one more node{headed}"))
    remedy = "anchor the positions of two nodes, or fix one range scale"
    found.append((f"dilation: all positions grow or shrink together{about}", pattern(np.eye(d)), remedy))
    return found
