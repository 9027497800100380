"""Weak directions of the biases by name: what neither data nor survey fix, and what to anchor.

A direction is weak when its marginal information is below 1 in units of the prior scale; a surveyed bias
brings an information of 1 of its own.
"""

from dataclasses import dataclass

import numpy as np

from probcal.problem import Problem
from probcal.types import AXES

WEAK = 1.0 - 1e-6  # marginal information below which a direction is left to the prior
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

    Translations, rotations, dilation and common shifts are tried first, each completed by the other biases
    that move along; what remains is described by its largest entries.
    """
    if not len(z):
        return ()
    known = information + np.diag(problem.surveyed.astype(float))
    values, vectors = np.linalg.eigh(known)
    missing = int((values < WEAK).sum())
    if not missing:
        return ()
    tried = []
    for name, pattern, remedy in _patterns(problem, z):
        vector = _complete(known, pattern)
        tried.append((float(vector @ known @ vector), name, vector, pattern != 0, remedy))
    found: list[Direction] = []
    basis = np.zeros((len(z), 0))
    for strength, name, vector, own, remedy in sorted(tried, key=lambda entry: entry[0]):
        rest = vector - basis @ (basis.T @ vector)
        if strength < WEAK and np.linalg.norm(rest) > 0.5 and len(found) < missing:
            basis = np.concatenate([basis, rest[:, None] / np.linalg.norm(rest)], 1)
            involved = _involved(problem, np.where(own, 0.0, vector), np.abs(vector).max())
            found.append(Direction(name, strength, vector, involved, remedy))
    weak = vectors[:, :missing]
    left = np.linalg.svd(weak @ weak.T - (weak @ weak.T @ basis) @ basis.T)[0][:, : missing - len(found)]
    for vector in left.T:
        involved = _involved(problem, vector, np.abs(vector).max())
        remedy = f"fix or survey {involved[0]}, or add a pass that excites it"
        found.append(Direction("a combination", float(vector @ known @ vector), vector, involved, remedy))
    return tuple(sorted(found, key=lambda direction: direction.information))


def _involved(problem: Problem, vector: np.ndarray, largest: float) -> tuple[str, ...]:
    order = np.argsort(-np.abs(vector))
    return tuple(problem.labels[m] for m in order if abs(vector[m]) > INVOLVED * largest)


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
    """Candidate directions in z: rigid motions, dilation, and a shift common to all biases of one name."""
    d = problem.network.dimension
    place = {(b.owner, b.axis): m for m, b in enumerate(problem.biases) if b.component == "position"}
    heading = [m for m, b in enumerate(problem.biases) if b.component == "heading"]
    nodes = {node.name: node for node in problem.network.nodes}
    owners = list(dict.fromkeys(owner for owner, _ in place))
    found = []
    if owners:
        shift = z * problem.scales
        at = {
            owner: nodes[owner].position
            + np.array([shift[place[owner, a]] if (owner, a) in place else 0.0 for a in range(d)])
            for owner in owners
        }
        centre = np.mean(list(at.values()), 0)

        def positions(move) -> np.ndarray:
            pattern = np.zeros(len(z))
            for (owner, axis), m in place.items():
                pattern[m] = move(at[owner] - centre)[axis] / problem.scales[m]
            return pattern

        for axis in range(d):
            step = np.eye(d)[axis]
            remedy = "anchor the position of one node (fix it, or give it a survey)"
            found.append((f"translation along {AXES[axis]}", positions(lambda r, step=step: step), remedy))
        planes = [(0, 1)] if d == 2 else [(0, 1), (1, 2), (2, 0)]
        for a, b in planes:

            def turn(r, a=a, b=b):
                moved = np.zeros(d)
                moved[a], moved[b] = -r[b], r[a]
                return moved

            pattern = positions(turn)
            if (a, b) == (0, 1):
                for m in heading:
                    pattern[m] = 1.0 / problem.scales[m]
            axis = "" if d == 2 else f" about {AXES[3 - a - b]}"
            found.append((f"rotation{axis}", pattern, "anchor the positions of two nodes, or one heading with one position"))
        remedy = "anchor the positions of two nodes, or one range scale"
        found.append(("dilation: all positions grow or shrink about their centre", positions(lambda r: r), remedy))
    for component in dict.fromkeys(b.component for b in problem.biases if b.component != "position"):
        members = [m for m, b in enumerate(problem.biases) if b.component == component]
        if len(members) > 1:
            pattern = np.zeros(len(z))
            pattern[members] = 1.0 / problem.scales[members]
            found.append((f"a common {component} of all", pattern, f"fix the {component} of one of them"))
    return [(name, pattern, remedy) for name, pattern, remedy in found if np.abs(pattern).max() > 0]
