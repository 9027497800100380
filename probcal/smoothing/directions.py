"""Gauge and weak directions of the biases by name: what data and surveys leave open, and what fixes it.

A direction is weak when its marginal information lambda is below 1 in units of the prior scale: lambda / (1 + lambda)
is the share of its answer that the data give. It is a gauge when no row fixes it (`smoothing.gauge`).
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from probcal.labels import AXES, label_parts
from probcal.problem import Problem
from probcal.smoothing.gauge import Gauge
from probcal.smoothing.mode import Point

WEAK = 1.0  # marginal information below which a direction is left to the prior
RIDGE = 1e-2  # keeps the completion of a pattern from running along other weak directions
INVOLVED = 0.3  # share of the largest entry above which a bias is named
ALONG = 0.1  # share of the largest entry above which a component moves along with a rigid motion
APART = 0.5  # part of a unit direction outside those already named that makes it a new one
MATCH = 1e-3  # how closely a gauge must follow a pattern
INSIDE = {"gauge": 1e-6, "weak": 0.3}  # size outside one sensor below which a unit direction is its own
MOSTLY = 0.7  # size inside the weak space from which a completed pattern belongs to it
TRIED = 12  # remedies of one direction that are recomputed
HALVINGS = 6  # survey stds tried, each half of the one before
STRAIGHT = 0.03  # width of a path over its length below which it is one line
DILATION = "dilation: all positions grow or shrink together"
TOWARDS = {"x": "east", "y": "north", "z": "up"}


@dataclass(frozen=True)
class Direction:
    """A combination of biases that the data do not fix: its name, information, what it moves and a remedy."""

    name: str
    words: str  # what moves
    kind: str  # gauge or weak
    information: float  # marginal, in units of the prior scale
    vector: np.ndarray  # (M,) unit vector in z
    labels: tuple[str, ...]  # further biases that move along
    remedy: str
    fix: tuple[str, ...] = ()  # labels whose fixing removes the direction, with those before it; checked by recomputing
    survey: float | None = None  # survey std of these labels, in their unit, that does as well; checked likewise

    @property
    def share(self) -> float:
        """Share of the answer that the data give: lambda / (1 + lambda)."""
        return self.information / (1.0 + self.information)

    @property
    def sentence(self) -> str:
        """Name, biases involved and remedy in one line."""
        others = f" with {', '.join(self.labels[:6])}{', ...' if len(self.labels) > 6 else ''}" if self.labels else ""
        return f"{self.name}{others} (information {self.information:.2g}): {self.remedy}"


class Pattern(NamedTuple):
    """A candidate direction (F,) in z of the free biases; those that it leaves at 0 may move along."""

    name: str
    words: str
    vector: np.ndarray
    remedy: str
    anchors: tuple[tuple[str, ...], ...]  # groups of labels one of which is to be fixed


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
    naming = _Naming(problem, free, marginal(information, free), point)
    if gauge is not None and gauge.countable:
        naming.name_gauge(gauge.basis[free])
    naming.name_weak()
    return tuple(_with_remedies(problem, naming.known, naming.found, naming.anchors))


def marginal(information: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Information of the free biases with the surveyed ones (whose survey is 1 in z) marginalised."""
    held = ~free
    inner = information[np.ix_(held, held)] + np.eye(held.sum())
    cross = information[np.ix_(held, free)]
    return information[np.ix_(free, free)] - cross.T @ np.linalg.solve(inner, cross)


class _Naming:
    """The directions named so far, and the space (F, k) of the free biases that they span."""

    def __init__(self, problem: Problem, free: np.ndarray, known: np.ndarray, point: Point):
        self.problem, self.free, self.known = problem, free, known
        self.cause = _cause(problem, point)
        self.labels = [label for label, own in zip(problem.labels, free, strict=True) if own]
        self.found: list[Direction] = []
        self.anchors: list[tuple[tuple[str, ...], ...]] = []  # of each, groups of labels one of which is to be fixed
        self.basis = np.zeros((len(self.labels), 0))
        rigid = [p._replace(vector=p.vector[free]) for p in _rigid(problem, np.asarray(point.z))]
        common = [p._replace(vector=p.vector[free]) for p in _common(problem)]
        self.rigid, self.common = ([p for p in group if p.vector.any()] for group in (rigid, common))

    def name_gauge(self, space: np.ndarray) -> None:
        """Name the null space (F, k) of the rows."""
        space = _orthonormal(space, 1e-6)

        def follow(pattern: np.ndarray) -> np.ndarray | None:
            own = pattern != 0
            mixed, *_ = np.linalg.lstsq(space[own], pattern[own], rcond=1e-9)
            near = np.linalg.norm(space[own] @ mixed - pattern[own]) <= MATCH * np.linalg.norm(pattern)
            return space @ mixed if near else None

        self._name("gauge", space, follow)

    def name_weak(self) -> None:
        """Name what else the data leave weak."""
        values, vectors = np.linalg.eigh(self.known)
        space = vectors[:, values < WEAK]

        def follow(pattern: np.ndarray) -> np.ndarray | None:
            vector = _complete(self.known, pattern)
            weak = vector @ self.known @ vector < WEAK and np.linalg.norm(space.T @ vector) > MOSTLY
            return vector if weak else None

        self._name("weak", space, follow)

    def _name(self, kind: str, space: np.ndarray, follow: Callable[[np.ndarray], np.ndarray | None]) -> None:
        """Name the part of a space (F, k) that has no name yet; `follow` completes a pattern, or refuses."""
        left = self._outside(space)
        weak = sum(direction.information < WEAK for direction in self.found)
        missing = min(left.shape[1], space.shape[1] - (weak if kind == "weak" else 0))
        groups = [_inside(space, own, INSIDE[kind]) for own in self._owners()] if missing > 0 else []
        groups = [group for group in groups if group.shape[1]]
        owned = [self._combination(vector) for group in groups for vector in _readable(group)]
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
        for vector in _readable(left[:, : max(missing, 0)]):
            self._add(kind, self._combination(vector), vector)

    def _owners(self) -> list[np.ndarray]:
        """Masks (F,) of the biases of each node with its sensors."""
        nodes = [m["node"] for m, own in zip(self.problem.members, self.free, strict=True) if own]
        names = np.array(nodes)
        return [names == name for name in dict.fromkeys(nodes)] if len(set(nodes)) > 1 else []

    def _outside(self, space: np.ndarray) -> np.ndarray:
        """Orthonormal basis of what of a space lies outside the directions named so far."""
        return _orthonormal(space - self.basis @ (self.basis.T @ space), APART)

    def _add(self, kind: str, pattern: Pattern, vector: np.ndarray) -> None:
        strength = max(float(vector @ self.known @ vector), 0.0)
        rest = vector - self.basis @ (self.basis.T @ vector)
        self.basis = np.concatenate([self.basis, rest[:, None] / np.linalg.norm(rest)], 1)
        whole = np.zeros(len(self.free))
        whole[self.free] = vector
        along = np.where(pattern.vector != 0, 0.0, vector)
        others = _involved(self.labels, along, np.abs(vector).max())
        words, remedy, anchors = pattern.words, pattern.remedy, pattern.anchors
        if any(pattern is rigid for rigid in self.rigid):  # range scales in a dilation, pitch and roll in a rotation
            moved = self._moved_along(along, np.abs(vector).max())
            if moved:
                words += f" and the {' and '.join(name.replace('_', ' ') for name in moved)}s with them"
                anchors = (*anchors, *((label,) for label in self.labels if _name(label) in moved))
            if moved and pattern.name.startswith(DILATION):
                remedy += f", or fix one {moved[0].replace('_', ' ')}"
        if kind == "gauge" and strength >= WEAK:
            words += "; only the start of the motion holds it"
        self.found.append(Direction(pattern.name, words, kind, strength, whole, others, remedy))
        own = (tuple(label for label in group if label in self.labels) for group in anchors)  # a survey is not fixed
        self.anchors.append(tuple(group for group in own if group))

    def _moved_along(self, along: np.ndarray, largest: float) -> list[str]:
        """Components other than those of a pattern that a direction moves most, by name."""
        most: dict[str, float] = {}
        for label, size in zip(self.labels, np.abs(along), strict=True):
            most[_name(label)] = max(most.get(_name(label), 0.0), float(size))
        return [name for name, size in most.items() if size > max(ALONG * largest, 0.5 * max(most.values()))]

    def _combination(self, vector: np.ndarray) -> Pattern:
        """A direction without a pattern, in words: its largest bias against the next ones."""
        problem, labels = self.problem, _involved(self.labels, vector, np.abs(vector).max())
        first = labels[0]
        alone = tuple((label,) for label in labels)
        placed = any(_name(label).startswith("position_") or _name(label) == "heading" for label in labels[:3])
        cause = self.cause if placed else ""
        if len(labels) == 1:
            return Pattern(f"{_of(first)} alone", f"the data hardly depend on it{cause}", vector, "", alone)
        one = len({_owner(label) for label in labels[:3]}) == 1
        others = " and ".join(_name(label) if one else _of(label) for label in labels[1:3])
        more = f" and {len(labels) - 3} more" if len(labels) > 3 else ""
        amounts = ", ".join(_amount(problem, label, vector[self.labels.index(label)]) for label in labels[:3])
        name = f"{_of(first)} against {'its ' if one else ''}{others}{more}"
        return Pattern(name, f"{amounts} together hardly change the data{cause}", vector, "", alone)


# Remedies


def _with_remedies(
    problem: Problem, known: np.ndarray, found: list[Direction], anchors: list[tuple[tuple[str, ...], ...]]
) -> Iterator[Direction]:
    """The directions with the biases whose fixing, or survey, removes each, together with those before it.

    A remedy is kept only if the information (F, F) recomputed with it has a weak direction less.
    """
    labels = [label for label, surveyed in zip(problem.labels, problem.surveyed, strict=True) if not surveyed]
    scales = problem.scales[~problem.surveyed]
    done: list[int] = []
    fixed: tuple[str, ...] = ()
    left = _count(known, done)  # weak directions still to be removed
    for direction, groups in zip(found, anchors, strict=True):
        general = direction.remedy or f"fix or survey {groups[0][0]} (not verified)"
        before = f"{direction.remedy}: " if direction.remedy else ""
        if direction.information >= WEAK:
            yield replace(direction, remedy=general)
            continue
        left -= 1
        if _count(known, done) <= left:
            yield replace(direction, fix=fixed, remedy=f"{before}done by fixing {_together(fixed, problem.labels)}")
            continue
        members = [[labels.index(name) for name in group] for group in groups]
        both = [m for group in members[:2] for m in group]
        chosen = _anchor(known, done, members, left) or _anchor(known, done, [both], left)
        if not chosen:
            left += 1
            yield replace(direction, remedy=general)
            continue
        fixed = tuple(labels[m] for m in chosen)
        std = _survey(known, done, chosen, left, scales, direction.vector[~problem.surveyed])
        units = {problem.biases[problem.labels.index(label)].unit for label in fixed}
        std = std if len(units) == 1 else None
        survey = f", or survey it to {std:g} {units.pop().strip('1')}".rstrip() if std is not None else ""
        yield replace(
            direction, fix=fixed, survey=std, remedy=f"{before}fix {_together(fixed, problem.labels)}{survey}"
        )
        done += chosen


def _together(labels: tuple[str, ...], known: Sequence[str]) -> str:
    """Labels as `--fix` takes them: the position of a node as one pattern, where that reaches no other of the known."""
    owner = _owner(labels[0])
    whole = len(labels) > 1 and set(labels) == {name for name in known if name.startswith(f"{owner}.position_")}
    return f"{owner}.position_*" if whole else " and ".join(labels)


def _spectrum(known: np.ndarray, done: Iterable[int]) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues and vectors (F, F - fixed) of the information with some biases fixed."""
    stay = np.setdiff1d(np.arange(len(known)), list(done))
    values, vectors = np.linalg.eigh(known[np.ix_(stay, stay)])
    whole = np.zeros((len(known), len(stay)))
    whole[stay] = vectors
    return values, whole


def _count(known: np.ndarray, done: Iterable[int]) -> int:
    """Number of weak directions with some biases fixed."""
    return int((_spectrum(known, done)[0] < WEAK).sum())


def _anchor(known: np.ndarray, done: list[int], groups: list[list[int]], left: int) -> list[int]:
    """The group of biases that leaves at most `left` weak directions when fixed, and the strongest; empty if none does.

    Tried are those that hold most of the weak space; the fewest weak directions count first, then the weakest left.
    """
    values, vectors = _spectrum(known, done)
    hold = (vectors[:, values < WEAK] ** 2).sum(1)
    best: tuple[int, float] = (left, np.inf)
    chosen: list[int] = []
    for group in sorted(groups, key=lambda group: -hold[group].sum())[:TRIED]:
        values, _ = _spectrum(known, [*done, *group])
        rank = (int((values < WEAK).sum()), -float(values.min(initial=np.inf)))
        if rank < best:
            best, chosen = rank, [m for m in group if m not in done]
    return chosen


def _survey(
    known: np.ndarray, done: list[int], chosen: list[int], left: int, scales: np.ndarray, vector: np.ndarray
) -> float | None:
    """A survey std of the chosen biases that leaves at most `left` weak directions, found by recomputing."""
    largest = scales[chosen] * np.abs(vector[chosen])
    for halving in range(HALVINGS if largest.max() > 0 else 0):
        std = _round_down(float(largest.max()) / 2**halving)
        inner = known[np.ix_(chosen, chosen)] + np.diag((scales[chosen] / std) ** 2)
        rest = known - known[:, chosen] @ np.linalg.solve(inner, known[chosen])
        if _count(rest, [*done, *chosen]) <= left:
            return std
    return None


def _round_down(value: float) -> float:
    """One significant digit, towards zero."""
    step = 10.0 ** np.floor(np.log10(value))
    return float(f"{np.floor(value / step) * step:.1g}")


# Words


def _owner(label: str) -> str:
    return label_parts(label)[0]


def _name(label: str) -> str:
    return label_parts(label)[1]


def _of(label: str) -> str:
    """A bias in words: `range_offset of mic_3`."""
    owner, name = label_parts(label)
    return f"{name} of {owner}"


def _amount(problem: Problem, label: str, size: float) -> str:
    m = problem.labels.index(label)
    return f"{label} {size * problem.scales[m]:+.2g} {problem.biases[m].unit}"


def _involved(labels: list[str], vector: np.ndarray, largest: float) -> tuple[str, ...]:
    order = np.argsort(-np.abs(vector), kind="stable")
    return tuple(labels[m] for m in order if abs(vector[m]) > INVOLVED * largest)


# Spaces


def _orthonormal(space: np.ndarray, least: float) -> np.ndarray:
    """Orthonormal basis of the columns (F, k), without directions of singular value at most `least`."""
    if not space.shape[1]:
        return space
    left, sizes, _ = np.linalg.svd(space, full_matrices=False)
    return left[:, sizes > least]


def _inside(space: np.ndarray, own: np.ndarray, most: float) -> np.ndarray:
    """The directions of an orthonormal space (F, k) of which at most `most` lies outside the entries `own` (F,)."""
    _, sizes, rows = np.linalg.svd(space[~own], full_matrices=True)
    sizes = np.concatenate([sizes, np.zeros(len(rows) - len(sizes))])
    return space @ rows[sizes < most].T


def _readable(space: np.ndarray) -> Iterator[np.ndarray]:
    """Unit vectors that span a space (F, k), each with a bias of its own that the others leave alone."""
    if not space.shape[1]:
        return
    from scipy import linalg as dense  # here, that a fit without weak directions does not load it

    pivots = dense.qr(space.T, mode="r", pivoting=True)[1][: space.shape[1]]
    for vector in np.linalg.solve(space[pivots].T, space.T):
        yield vector / np.linalg.norm(vector)


def _complete(information: np.ndarray, pattern: np.ndarray) -> np.ndarray:
    """Unit vector that holds a pattern and lets the other biases move so as to hide it from the data."""
    own = pattern != 0
    unit = pattern / np.linalg.norm(pattern)
    other = ~own
    if other.any():
        inner = information[np.ix_(other, other)] + RIDGE * np.eye(other.sum())
        unit[other] = -np.linalg.solve(inner, information[np.ix_(other, own)] @ unit[own])
    return unit / np.linalg.norm(unit)


# Patterns


def _common(problem: Problem) -> list[Pattern]:
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


def _rigid(problem: Problem, z: np.ndarray) -> list[Pattern]:
    """Translation, rotation and dilation of all nodes; about the anchor where one node is anchored."""
    d = problem.network.dimension
    place = {
        (b.owner, b.axis): m for m, b in enumerate(problem.biases) if b.component == "position" and b.kind == "scale"
    }
    owners = {owner for owner, _ in place}
    held = {
        node.name: np.array([problem.fixed.get(f"{node.name}.position_{axis}", 0.0) for axis in AXES[:d]])
        for node in problem.network.nodes
    }
    anchors = [node.position + held[node.name] for node in problem.network.nodes if node.name not in owners]
    if not owners or len(anchors) > 1:
        return []
    shift = z * problem.scales
    at = {node.name: node.position + held[node.name] for node in problem.network.nodes if node.name in owners}
    for (owner, axis), m in place.items():
        at[owner][axis] += shift[m]
    centre = anchors[0] if anchors else np.mean(list(at.values()), 0)
    about, who = (" about the anchor", "all nodes but the anchor") if anchors else ("", "all nodes")

    def pattern(move: np.ndarray) -> np.ndarray:
        """Velocities move @ (position - centre) of all free positions, in z."""
        vector = np.zeros(len(z))
        for (owner, axis), m in place.items():
            vector[m] = move[axis] @ (at[owner] - centre) / problem.scales[m]
        return vector

    nodes = tuple(
        tuple(problem.labels[m] for (other, _), m in place.items() if other == owner) for owner in dict.fromkeys(at)
    )
    found = []
    if not anchors:
        for axis in range(d):
            vector = np.zeros(len(z))
            for (_, a), m in place.items():
                vector[m] = (a == axis) / problem.scales[m]
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


def _cause(problem: Problem, point: Point) -> str:
    """Why a combination may be weak: all targets pass along one direction, each on one line, where that is so."""
    lines = []
    for epochs, states in zip(problem.epochs, point.states, strict=True):
        places = np.asarray(states)[:, slice(*epochs.position)]
        for name in dict.fromkeys(epochs.target):
            path = places[epochs.target == name]
            if len(path) < 3:
                return ""
            _, sizes, along = np.linalg.svd(path - path.mean(0), full_matrices=False)
            if sizes[1] > STRAIGHT * sizes[0]:
                return ""
            lines.append(along[0])
    if np.abs(np.array(lines) @ lines[0]).min() < 1 - STRAIGHT:
        return ""
    return ": the target passed on one line" if len(lines) == 1 else ": the targets passed along parallel lines"
