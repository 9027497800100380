"""The other side of a mirror: tracks and nodes reflected in the lines and planes of a network, polished and compared.

Sensors that see a distance, a strength or a delay cannot tell the two sides of the line (in 3-D the plane) on which
their nodes lie. A climb ends on one side, and pieces of a track may end on different ones. Candidates are screened by
the misfit of the data at the reflected places with the prior spread of the biases added to the noise, so that a network
that has no mirror pays for two looks at its data, and one with nodes that may stand on either side of what they hear
for some thirty.
"""

from collections.abc import Callable, Iterator, Sequence
from itertools import chain, pairwise
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from probcal.errors import FitError
from probcal.gaussian.choose import engine_of
from probcal.gaussian.climb import climb_to_mode
from probcal.gaussian.engine import Engine, Factors, evidence
from probcal.gaussian.information import at_levels
from probcal.gaussian.linearised import laplace
from probcal.gaussian.mode import Point, find_mode
from probcal.labels import NODE, PIECE, SCENE
from probcal.model import variants
from probcal.modes.crossings import node_sides
from probcal.modes.grid import grid_start, profile, track_mode
from probcal.modes.reflections import Gap, Plane, distance, movable, new, planes, reach, reflect, reflect_nodes
from probcal.priors import Precision
from probcal.problem import Problem
from probcal.types import float64

WORSE = 0.4  # nats a datum by which a reflected place may fit worse and is still polished: 0 to 0.2 beside a mirror,
# 0.9 to 5 in networks without one (models/, share 0.3)
TRIED, BREAKS, ROUNDS = 8, 30, 5  # pieces of tracks that are polished, places where one may be cut, and rounds of it
LOOKED = 3 * TRIED  # pieces that are smoothed: those that come back by themselves are not polished
ALIKE, APART_BY = 0.7, 0.5  # share of common epochs from which pieces are one, if their reflections lie at most so
# much of their own size apart
SHORTEST = 3  # epochs of a piece: fewer do not stay on another side than their neighbours
STRAIN = 20.0  # sum of squares of a process noise from which a track may be cut there
GAIN, MORE = 1.0, 0.1  # nats from which a piece belongs on the other side, and from which a scene does
SAME, NEAR = 3.0, 10.0  # nats within which another answer is as good, and within which it is mentioned
CROSSED = 30  # times that nodes may cross
MOST = 4  # answers that are kept
CLIMB = 60  # steps of a climb by an engine
HELD = 30.0  # nats that a node may fit worse on its other side, tracks held, where each trial is such a climb
PIECES = "pieces of tracks on their other side"


class Mirrored(NamedTuple):
    """Another answer: what was reflected, and its evidence less that of the answer (under the declared scales)."""

    name: str
    gain: float
    point: Point
    shift: np.ndarray  # (M,) its biases z less those of the answer
    kind: str = SCENE
    status: str = ""  # of the fit from there; empty where it was found only


class SideClimb(NamedTuple):
    """How the mode next to a point under the declared scales is found and weighed."""

    mode: Callable[[Point], tuple[Point, float]]  # the mode, and its log density or evidence, -inf where there is none
    evidence: Callable[[Point, float], float]  # of a mode and what came with it
    most: float = np.inf  # nats that a node may fit worse on its other side, tracks held, and is still tried

    @classmethod
    def on(cls, problem: Problem, engine: Engine) -> "SideClimb":
        """To the joint mode, weighed by Laplace's formula; on an engine of large networks to the marginal mode.

        Where log determinants are estimated the log marginal density weighs it: of reflected biases they are nearly
        the same, and their errors would blur what tells the sides apart.
        """
        model, scales = problem.model, Precision(jnp.ones(problem.model.biases))
        factors = Factors.of(scales)

        def joint(point: Point) -> tuple[Point, float]:
            found = find_mode(model, point, scales, 30, 1e-3)
            return found.point, -float(found.cost)

        def marginal(point: Point) -> tuple[Point, float]:
            try:
                found = climb_to_mode(lambda at: engine.settled(model, at), point, factors, CLIMB, 1e-3)
                value = evidence(found.at, scales, factors).value if engine.exact else -found.value
            except (np.linalg.LinAlgError, FitError):  # no evidence there, or conjugate gradients did not end
                return point, -np.inf
            return found.at.point, value

        if engine.cheap:
            return cls(joint, lambda at, _: float(laplace(model, at, scales).evidence))
        return cls(marginal, lambda _, value: value, HELD)


class Sides(NamedTuple):
    """What a search on the other sides found."""

    point: Point  # the best place
    moved: bool  # whether it is another than the given one
    others: tuple[Mirrored, ...]  # those within `NEAR` nats of it
    name: str = ""  # what was reflected on the way to it
    gain: float = 0.0  # its evidence less that of the given place
    kind: str = SCENE


@float64
def other_sides(problem: Problem, point: Point, climb: SideClimb | None = None) -> Sides:
    """Search the other sides of a point: pieces of tracks first, then all of the scene, polished and compared.

    Where a scene fits better on another side its pieces are looked at again from there.
    """
    climb = SideClimb.on(problem, engine_of("dense", problem.model)) if climb is None else climb
    given, name, kind = point, "", SCENE
    for _ in range(ROUNDS):
        sides = _searched(problem, point, climb)
        name, kind = (sides.name, sides.kind) if sides.name else (name, kind)
        if sides.gain <= MORE:
            break
        point = sides.point
    if not name:
        return sides
    there, begun = (climb.evidence(*climb.mode(at)) for at in (sides.point, given))
    if not np.isfinite(there - begun):  # nothing was found at the given place itself
        return Sides(given, False, ())
    return sides._replace(moved=True, name=name, gain=there - begun, kind=kind)


class _Beside(NamedTuple):
    """Another place that may fit as well."""

    kind: str
    name: str
    candidate: Point  # as it was reflected
    start: Point  # polished
    mode: tuple[Point, float] | None = None  # that it leads to, where it was looked for


def _searched(problem: Problem, point: Point, climb: SideClimb) -> Sides:
    """One search from a point; its gain is that of the best scene over the place with its pieces and nodes turned."""
    name = ""
    for _ in range(ROUNDS):
        point, turned, pieces = _turned(problem, point, climb)
        point, crossed, nodes = _crossed(problem, point, climb)
        name = crossed or name or (PIECES if turned else "")
        if not crossed:
            break
    best: tuple[Point, float] | None = None
    found: list[Mirrored] = []
    whole = (_Beside(SCENE, name, there, track_mode(problem, there)) for name, there in _candidates(problem, point))
    for kind, named, candidate, start, mode in chain(whole, nodes, pieces):
        best = climb.mode(point) if best is None else best
        polished = climb.mode(start) if mode is None else mode
        loose = kind == NODE or named == PIECES
        size = reach(problem, candidate, best[0]) if loose else _size(problem, candidate, point, best[0])
        if not new(problem, polished[0], [best[0], *(other.point for other in found)], size):
            continue
        worth = [climb.evidence(*at) for at in (polished, best)]
        if np.isfinite(worth).all() and worth[0] - worth[1] > -NEAR:
            shift = np.asarray(polished[0].z - best[0].z)
            found.append(Mirrored(named, worth[0] - worth[1], polished[0], shift, kind))
    found.sort(key=lambda one: -one.gain)
    if found and best is not None and found[0].gain > MORE:
        first = found[0]
        rest = [o._replace(gain=o.gain - first.gain, shift=o.shift - first.shift) for o in found[1:]]
        back = Mirrored(first.name, -first.gain, best[0], -first.shift, first.kind)
        return Sides(first.point, True, _kept([back, *rest]), first.name, first.gain, first.kind)
    kind = SCENE if not name else PIECE if name == PIECES else NODE
    return Sides(point, bool(name), _kept(found), name, kind=kind)


def _size(problem: Problem, candidate: Point, point: Point, best: Point) -> Gap:
    """What lies between a reflection of a point and the best place; nodes count where they were reflected too."""
    gap = distance(problem, candidate, best)
    return gap._replace(nodes=0.0) if np.array_equal(candidate.z, point.z) else gap


def _kept(found: Sequence[Mirrored]) -> tuple[Mirrored, ...]:
    """Those that are told of: as good ones first, and of these whole scenes before nodes and pieces."""
    near = [other for other in found if other.gain > -NEAR]
    near.sort(key=lambda one: (one.gain <= -SAME, one.kind != SCENE, -one.gain))
    return tuple(near[:MOST])


def _crossed(problem: Problem, point: Point, climb: SideClimb) -> tuple[Point, str, list[_Beside]]:
    """The point with those nodes on the other side of their paths that fit better there, and in words which went last.

    Also those that fit about as well. A node may come back and leave pieces of tracks on another side.
    """
    others: list[_Beside] = []
    best: tuple[Point, float] | None = None
    crossed = ""
    for _ in range(CROSSED):
        again, others, climbs, back = False, [], 0, 0
        for name, candidate in node_sides(problem, point, WORSE, climb.most):
            if max(climbs, back) >= TRIED:
                break
            best = climb.mode(point) if best is None else best
            tried, size = climb.mode(candidate), reach(problem, candidate, best[0])
            far = new(problem, tried[0], [best[0]], size._replace(tracks=0.0))
            kind, named = (NODE, name) if far else (PIECE, PIECES)
            climbs, back = climbs + far, back + (not far)  # those that come back take no other's place
            if not (far or new(problem, tried[0], [best[0]], size)):
                continue
            if tried[1] > best[1] + GAIN:
                point, best, crossed, again = tried[0], tried, named, True
                break
            if tried[1] > best[1] - NEAR:
                others.append(_Beside(kind, named, candidate, tried[0], tried))
        if not again:
            break
    return point, crossed, others


def _losses(problem: Problem, z: np.ndarray, point: Point, plane: Plane | None) -> list[np.ndarray]:
    """Robust misfit (E,) of the data of each epoch at the places of a point, or at those on the other side."""
    found = []
    for r, place in enumerate(problem.positions(point.states)):
        place = place if plane is None else plane.across(place)
        loss, _ = profile(problem.model, r, problem.epochs[r].position, jnp.asarray(z), jnp.asarray(place))
        found.append(np.nan_to_num(np.asarray(loss), nan=1e9, posinf=1e9))
    return found


def _counts(problem: Problem) -> list[np.ndarray]:
    """Number of data (E,) at each epoch of each recursion."""
    return variants.counts(problem.model, lambda mask: mask.sum(1))


def _candidates(problem: Problem, point: Point) -> Iterator[tuple[str, Point]]:
    """Reflections of the whole scene, and of the track of one target alone, that fit nearly as well unpolished."""
    z, free, counts = np.asarray(point.z), movable(problem), _counts(problem)
    targets = [n for epochs in problem.epochs for n in epochs.members if n in problem.targets]
    every = sum(float(count.sum()) for count in counts)
    found = planes(problem, z)
    here = _losses(problem, z, point, None) if found else []
    for plane in found:
        nodes = reflect_nodes(problem, z, plane)
        ways = [(z, "")] if np.array_equal(nodes, z) else [(nodes, " and nodes"), (z, "")]
        for biases, word in ways:
            there = _losses(problem, biases, point, plane)
            worse = [b - a for a, b in zip(here, there, strict=True)]
            total = sum(float(w[mine].sum()) for w, mine in zip(worse, free, strict=True))
            if any(mine.any() for mine in free) and total < WORSE * every:
                who = "the targets" if len(targets) > 1 else f'target "{targets[0]}"'
                yield f"{who}{word} reflected in {plane.name}", reflect(problem, point, plane, free, biases)
            if len(targets) < 2 or word:
                continue
            for name in targets[:MOST]:
                own = problem.model.each(lambda _, mine, own, n=name: mine & (own.target == n), free, problem.epochs)
                much = sum(float(c[mine].sum()) for c, mine in zip(counts, own, strict=True))
                loss = sum(float(w[mine].sum()) for w, mine in zip(worse, own, strict=True))
                if any(mine.any() for mine in own) and loss < WORSE * much:
                    yield f'target "{name}" reflected in {plane.name}', reflect(problem, point, plane, own, z)


def _turned(problem: Problem, point: Point, climb: SideClimb) -> tuple[Point, bool, list[_Beside]]:
    """The point with those pieces of tracks on the other side that fit better there; whether any do.

    Also those that fit about as well. Where there is a piece to be tried the whole track is searched again too, at the
    biases reached so far.
    """
    others: list[_Beside] = []
    best: tuple[Point, float] | None = None
    turned, again = False, True
    for _ in range(ROUNDS):
        if not again:
            break
        again, others, climbs, back = False, [], 0, 0
        for name, candidate in _cut(problem, point):
            best = climb.mode(point) if best is None else best
            smoothed = track_mode(problem, candidate)
            size = _size(problem, candidate, point, best[0])
            if not new(problem, smoothed, [best[0]], size):
                continue  # it came back by itself
            if TRIED in (climbs, back):
                break
            tried = climb.mode(smoothed)
            apart = new(problem, tried[0], [best[0]], size)
            climbs, back = climbs + apart, back + (not apart)  # those that climb back take no other's place
            if tried[1] > best[1] + GAIN:
                point, best, turned, again = tried[0], tried, True, True
            elif tried[1] > best[1] - NEAR:
                others.append(_Beside(PIECE, name, candidate, tried[0], tried))
        if best is not None and not again:
            searched = at_levels(problem.model, grid_start(problem, best[0].z, 30), point.levels)
            tried = climb.mode(searched)
            if tried[1] > best[1] + GAIN:
                point, best, turned, again = tried[0], tried, True, True
    return point, turned, others


class _Piece(NamedTuple):
    """A piece of a track, and how much worse a datum of it fits on the other side, unpolished."""

    worse: float
    recursion: int
    target: str
    own: np.ndarray  # its epochs
    plane: Plane
    place: np.ndarray  # (n, d) where it is

    def alike(self, other: "_Piece") -> bool:
        """Whether it is the same piece, reflected to about the same places."""
        if (self.recursion, self.target) != (other.recursion, other.target):
            return False
        both, mine, others = np.intersect1d(self.own, other.own, assume_unique=True, return_indices=True)
        if len(both) < ALIKE * (len(self.own) + len(other.own) - len(both)):
            return False
        here, there = self.plane.across(self.place[mine]), other.plane.across(other.place[others])
        moved = max(np.linalg.norm(here - self.place[mine]), np.linalg.norm(there - other.place[others]))
        return bool(np.linalg.norm(here - there) <= APART_BY * moved)


def _cut(problem: Problem, point: Point) -> Iterator[tuple[str, Point]]:
    """Pieces of tracks on the other side, those first whose data fit best there unpolished: names, and the points.

    Of pieces that differ by where their planes cut them there is one. A long piece does not go before a short one:
    what is left over when a track goes over from one side to the other is short as often.
    """
    z, free, counts = np.asarray(point.z), movable(problem), _counts(problem)
    found = planes(problem, z)
    pieces = list[_Piece]()
    here = _losses(problem, z, point, None) if found else []
    for plane in found:
        there = _losses(problem, z, point, plane)
        for r, epochs in enumerate(problem.epochs):
            worse = there[r] - here[r]
            for target, members in epochs.members.items():
                mine = np.flatnonzero(members & free[r])
                for own in _pieces(problem, point, plane, r, mine):
                    count = float(counts[r][own].sum())
                    if len(own) >= SHORTEST and count > 0 and worse[own].sum() < WORSE * count:
                        place = np.asarray(point.states[r])[own][:, slice(*epochs.position)]
                        pieces.append(_Piece(float(worse[own].sum()) / count, r, target, own, plane, place))
    kept = list[_Piece]()
    for piece in sorted(pieces, key=lambda piece: piece.worse):
        if len(kept) < LOOKED and not any(piece.alike(other) for other in kept):
            kept.append(piece)
    for _, r, target, own, plane, _ in kept:
        chosen = [np.zeros(len(epochs.time), bool) for epochs in problem.epochs]
        chosen[r][own] = True
        first, last = problem.epochs[r].time[own[[0, -1]]]
        name = f'target "{target}" from {first:.6g} to {last:.6g} s reflected in {plane.name}'
        yield name, reflect(problem, point, plane, chosen, z)


def _pieces(problem: Problem, point: Point, plane: Plane, r: int, mine: np.ndarray) -> list[np.ndarray]:
    """Epochs of pieces of a track, and of all that follows each cut: cut where it nears the plane, strains, or gaps."""
    if len(mine) < 2:
        return []
    epochs = problem.epochs[r]
    away = plane.distance(np.asarray(point.states[r])[mine][:, slice(*epochs.position)])
    strain = np.sum(np.asarray(point.noises[r])[mine] ** 2, 1)
    gap = np.diff(epochs.time[mine], prepend=epochs.time[mine[0]])
    size, usual = np.abs(away), max(float(np.median(gap[1:])), 1e-300)
    near = np.zeros(len(mine), bool)
    near[1:-1] = (size[1:-1] <= size[:-2]) & (size[1:-1] < size[2:])
    crossed = np.concatenate([[False], np.sign(away[1:]) != np.sign(away[:-1])])
    worth = near + 2.0 * crossed + (strain > STRAIN) * strain / STRAIN + (gap > 5 * usual) * gap / (5 * usual)
    worth[0] = 0.0
    cuts = np.sort(np.argsort(-worth, kind="stable")[:BREAKS])
    cuts = cuts[worth[cuts] > 0]
    ends = [0, *cuts.tolist(), len(mine)]
    pieces = [mine[a:b] for a, b in pairwise(ends) if len(ends) > 2]
    return [*pieces, *(mine[a:] for a in ends[2:-1])]
