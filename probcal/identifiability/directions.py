"""Gauge and weak directions of the biases by name: what data and surveys leave open, and what fixes it.

A direction is weak when its marginal information lambda is below 1 in units of the prior scale: lambda / (1 + lambda)
is the share of its answer that the data give. It is a gauge when no row fixes it (`identifiability.gauge`).
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from probcal.gaussian.engine import Expansion, Factors
from probcal.gaussian.mode import Point
from probcal.identifiability.gauge import Gauge, unfixed
from probcal.identifiability.patterns import DILATION, Pattern, cause, common_shifts, directed, rigid_motions
from probcal.identifiability.remedies import TRIED, WEAK, Direction, with_remedies
from probcal.identifiability.spaces import complete, inside, orthonormal, readable
from probcal.identifiability.wording import amount, in_words, involved, name_without_owner, owner_of
from probcal.linalg import invert, least_squares, marginalise, outer, spectrum
from probcal.problem import Problem
from probcal.results.blocks import SensorBlocks

ALONG = 0.1  # share of the largest entry above which a component moves along with a rigid motion
APART = 0.5  # part of a unit direction outside those already named that makes it a new one
MATCH = 1e-3  # how closely a gauge must follow a pattern
INSIDE = {"gauge": 1e-6, "weak": 0.3}  # size outside one sensor below which a unit direction is its own
ALONE = 20  # combinations of the biases of single sensors that are named where biases are many
MOSTLY = 0.7  # size inside the weak space from which a completed pattern belongs to it


def weak_directions(
    problem: Problem, information: np.ndarray, point: Point, gauge: Gauge | None = None
) -> tuple[Direction, ...]:
    """Name the directions of marginal information (M, M) below 1 at a point, in an order in which remedies add up.

    Surveyed biases are marginalised with their survey. Combinations within one sensor, translations, rotations,
    dilation and common shifts are tried, each completed by the other biases that move along; what remains is
    described by its largest entries. With a `gauge` its directions are named first, also those that only the start
    of a target holds. The remedy of each is checked by recomputing, on top of those before it.
    """
    free = ~problem.surveyed
    if not free.any():
        return ()
    naming = _Naming(problem, free, marginalise(information, free)[0], point)
    if gauge is not None and gauge.countable:
        naming.name_gauge(gauge.basis[free])
    naming.name_weak()
    return tuple(with_remedies(problem, naming.known, np.flatnonzero(free), naming.found, naming.anchors))


class _Naming:
    """The directions named so far, and the space (F, k) of the free biases that they span."""

    def __init__(self, problem: Problem, free: np.ndarray, known: np.ndarray, point: Point):
        self.problem, self.free, self.known = problem, free, known
        self.cause = cause(problem, point)
        self.labels = [label for label, own in zip(problem.labels, free, strict=True) if own]
        self.found: list[Direction] = []
        self.anchors: list[tuple[tuple[str, ...], ...]] = []  # of each, groups of labels one of which is to be fixed
        self.basis = np.zeros((len(self.labels), 0))
        rigid = [p._replace(vector=p.vector[free]) for p in rigid_motions(problem, np.asarray(point.z))]
        common = [p._replace(vector=p.vector[free]) for p in common_shifts(problem)]
        self.rigid, self.common = ([p for p in group if p.vector.any()] for group in (rigid, common))

    def name_gauge(self, space: np.ndarray) -> None:
        """Name the null space (F, k) of the rows."""
        space = orthonormal(space, 1e-6)

        def follow(pattern: np.ndarray) -> np.ndarray | None:
            own = pattern != 0
            mixed = least_squares(space[own], pattern[own], 1e-9)
            near = np.linalg.norm(space[own] @ mixed - pattern[own]) <= MATCH * np.linalg.norm(pattern)
            return space @ mixed if near else None

        self._name("gauge", space, follow)

    def name_weak(self) -> None:
        """Name what else the data leave weak."""
        values, vectors = spectrum(self.known)
        space = vectors[:, values < WEAK]

        def follow(pattern: np.ndarray) -> np.ndarray | None:
            vector = complete(self.known, pattern)
            weak = vector @ self.known @ vector < WEAK and np.linalg.norm(space.T @ vector) > MOSTLY
            return vector if weak else None

        self._name("weak", space, follow)

    def _name(self, kind: str, space: np.ndarray, follow: Callable[[np.ndarray], np.ndarray | None]) -> None:
        """Name the part of a space (F, k) that has no name yet; `follow` completes a pattern, or refuses."""
        left = self._outside(space)
        weak = sum(direction.information < WEAK for direction in self.found)
        missing = min(left.shape[1], space.shape[1] - (weak if kind == "weak" else 0))
        groups = [inside(space, own, INSIDE[kind]) for own in self._owners()] if missing > 0 else []
        groups = [group for group in groups if group.shape[1]]
        owned = [self._combination(vector) for group in groups for vector in readable(group)]
        candidates = [*owned, *self.rigid] if len(groups) > 1 else [*self.rigid, *owned]
        for pattern in (*candidates, *self.common):
            if missing <= 0 or not left.shape[1]:
                return
            vector = pattern.vector if any(pattern is own for own in owned) else follow(pattern.vector)
            if vector is None:
                continue
            vector = vector / np.linalg.norm(vector)
            if np.linalg.norm(left.T @ vector) > APART:
                self._add(kind, pattern, vector)
                left = self._outside(space)
                missing -= 1
        for vector in readable(left[:, : max(missing, 0)]):
            self._add(kind, self._combination(vector), vector)

    def _owners(self) -> list[np.ndarray]:
        """Masks (F,) of the biases of each node with its sensors."""
        nodes = [m["node"] for m, own in zip(self.problem.members, self.free, strict=True) if own]
        names = np.array(nodes)
        return [names == name for name in dict.fromkeys(nodes)] if len(set(nodes)) > 1 else []

    def _outside(self, space: np.ndarray) -> np.ndarray:
        """Orthonormal basis of what of a space lies outside the directions named so far."""
        return orthonormal(space - self.basis @ (self.basis.T @ space), APART)

    def _add(self, kind: str, pattern: Pattern, vector: np.ndarray) -> None:
        strength = max(float(vector @ self.known @ vector), 0.0)
        rest = vector - self.basis @ (self.basis.T @ vector)
        self.basis = np.concatenate([self.basis, rest[:, None] / np.linalg.norm(rest)], 1)
        whole = np.zeros(len(self.free))
        whole[self.free] = vector
        along = np.where(pattern.vector != 0, 0.0, vector)
        others = involved(self.labels, along, np.abs(vector).max())
        words, remedy, anchors = pattern.words, pattern.remedy, pattern.anchors
        if any(pattern is rigid for rigid in self.rigid):  # range scales in a dilation, pitch and roll in a rotation
            # components other than those of a pattern that a direction moves most, by name
            most: dict[str, float] = {}
            for label, size in zip(self.labels, np.abs(along), strict=True):
                most[name_without_owner(label)] = max(most.get(name_without_owner(label), 0.0), float(size))
            moved = [
                name
                for name, size in most.items()
                if size > max(ALONG * np.abs(vector).max(), 0.5 * max(most.values()))
            ]
            if moved:
                words += f" and the {' and '.join(name.replace('_', ' ') for name in moved)}s with them"
                anchors = (*anchors, *((label,) for label in self.labels if name_without_owner(label) in moved))
            if moved and pattern.name.startswith(DILATION):
                remedy += f", or fix one {moved[0].replace('_', ' ')}"
        if kind == "gauge" and strength >= WEAK:
            words += "; only the start of the motion holds it"
        self.found.append(Direction(pattern.name, words, kind, strength, whole, others, remedy))
        own = (tuple(label for label in group if label in self.labels) for group in anchors)  # a survey is not fixed
        self.anchors.append(tuple(group for group in own if group))

    def _combination(self, vector: np.ndarray) -> Pattern:
        return combination(self.problem, self.labels, vector, self.cause)


def combination(problem: Problem, labels: list[str], vector: np.ndarray, why: str) -> Pattern:
    """A direction (F,) of biases with these labels, without a pattern, in words: its largest bias against the next.

    `why` is added where it moves a place.
    """
    most = involved(labels, vector, np.abs(vector).max())
    alone = tuple((label,) for label in most)
    placed = any(
        name_without_owner(label).startswith("position_") or name_without_owner(label) == "heading"
        for label in most[:3]
    )
    why = why if placed else ""
    if len(most) == 1:
        return Pattern(f"{in_words(most[0])} alone", f"the data hardly depend on it{why}", vector, "", alone)
    one = len({owner_of(label) for label in most[:3]}) == 1
    others = " and ".join(name_without_owner(label) if one else in_words(label) for label in most[1:3])
    more = f" and {len(most) - 3} more" if len(most) > 3 else ""
    amounts = ", ".join(amount(problem, label, vector[labels.index(label)]) for label in most[:3])
    name = f"{in_words(most[0])} against {'its ' if one else ''}{others}{more}"
    return Pattern(name, f"{amounts} together hardly change the data{why}", vector, "", alone)


def screened_directions(problem: Problem, at: Expansion, blocks: SensorBlocks) -> tuple[tuple[Direction, ...], int]:
    """Directions that the data leave to the prior where biases are too many for a matrix of all, and their number.

    Looked at are rigid motions and common shifts, and combinations of the biases of each sensor, of which at most
    `ALONE` are named, the weakest first. `blocks` is what a prior of the declared scales leaves of each. The
    information about a combination is one over its variance, less that of the prior; what moves along is what the data
    cannot tell from it. A remedy is kept where the information about the biases that it may fix says so, all others
    uncertain.
    """
    together = shared_directions(problem, at)
    alone, count = alone_directions(problem, at.point, blocks)
    return (*together, *alone), len(together) + count


def shared_directions(problem: Problem, at: Expansion) -> tuple[Direction, ...]:
    """Rigid motions and common shifts that the data leave to a prior of the declared scales."""
    patterns, scales = list(directed(problem, np.asarray(at.point.z))), Factors.alone(np.ones(len(problem.labels)))
    if not patterns:
        return ()
    moved = np.asarray(at.solve(scales, np.stack([vector for _, vector in patterns], 1)))
    free = {label: m for m, label in enumerate(problem.labels) if not problem.surveyed[m]}
    found, anchors = list[Direction](), list[tuple[tuple[str, ...], ...]]()
    for (pattern, vector), along in zip(patterns, moved.T, strict=True):
        information = max(1.0 / float(vector @ along) - 1.0, 0.0)
        if information < WEAK:
            unit = along / np.linalg.norm(along)
            found.append(Direction(pattern.name, pattern.words, "weak", information, unit, (), pattern.remedy))
            groups = [tuple(label for label in group if label in free) for group in pattern.anchors]
            sizes = {group: sum(unit[free[label]] ** 2 for label in group) for group in groups if group}
            anchors.append(tuple(sorted(sizes, key=sizes.__getitem__, reverse=True)[:TRIED]))
    if not found:
        return ()
    found = with_kinds(problem, at.point, found)
    among = np.array(sorted({problem.labels.index(name) for groups in anchors for group in groups for name in group}))
    known = invert(np.asarray(at.marginals(scales, among[None]))[0]) - np.eye(len(among))
    return tuple(with_remedies(problem, known, among, found, anchors))


def with_kinds(problem: Problem, point: Point, found: Sequence[Direction]) -> list[Direction]:
    """The directions, each tried by itself whether it is a gauge."""
    own = unfixed(problem, point, np.stack([direction.vector for direction in found], 1))
    return [replace(d, kind="gauge" if free else d.kind) for d, free in zip(found, own, strict=True)]


def alone_directions(problem: Problem, point: Point, blocks: SensorBlocks) -> tuple[tuple[Direction, ...], int]:
    """Combinations of the biases of single sensors that the data leave to the prior, the weakest first, and how many.

    At most `ALONE` are named.
    """
    M, members = len(problem.labels), blocks.members
    free = np.append(~problem.surveyed, False)[members]
    values, vectors = spectrum(np.where(outer(free), blocks.covariance, 0.0))
    information = 1.0 / np.maximum(values, 1e-300) - 1.0
    weak = np.argwhere(information < WEAK)
    weak = weak[np.argsort(information[tuple(weak.T)], kind="stable")]
    found, why = dict[int, list[tuple[Direction, Pattern]]](), cause(problem, point) if len(weak) else ""
    for b, k in weak[:ALONE]:
        own = members[b][free[b]]
        part = vectors[b, free[b], k]
        vector = np.zeros(M)
        vector[own] = part
        pattern = combination(problem, [problem.labels[m] for m in own], part, why)
        strength = max(float(information[b, k]), 0.0)
        found.setdefault(int(b), []).append(
            (Direction(pattern.name, pattern.words, "weak", strength, vector, (), ""), pattern)
        )
    done = list[Direction]()
    for b, pairs in found.items():
        own = members[b][free[b]]
        known = invert(blocks.covariance[b][np.ix_(free[b], free[b])]) - np.eye(len(own))
        done += with_remedies(problem, known, own, [one for one, _ in pairs], [p.anchors for _, p in pairs])
    return tuple(sorted(done, key=lambda direction: direction.information)), len(weak)
