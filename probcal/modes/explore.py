"""All modes of a posterior near one: proposed, screened, polished, compared and ranked by evidence.

A proposal is a function of the problem and a point that yields candidates: other configurations of
nodes and tracks that the data hardly tell from that one, those first that fit best. All else is done
here, by one rule each.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import jax
import numpy as np

from probcal.errors import FitError
from probcal.gaussian.climb import climb_to_mode
from probcal.gaussian.engine import Engine, Factors, evidence
from probcal.gaussian.mode import Point, find_mode
from probcal.labels import NODE, PIECE, SCENE
from probcal.modes.grid import track_mode
from probcal.modes.reflections import SHIFTED, place_biases
from probcal.priors import Precision
from probcal.problem import Problem

# nats a datum by which an unpolished candidate may fit worse and is still polished: 0 to 0.2 beside
# a mirror, 0.9 to 5 in networks without one (models/, share 0.3)
WORSE = 0.4
TRIED = 8  # candidates of a proposal that are climbed from to another mode, and that come back
MOVES, ROUNDS = 40, 5  # moves of nodes and pieces, and of scenes
GAIN = 1.0  # nats from which a node or a piece of a track belongs elsewhere
MORE = 0.1  # nats from which a whole scene does
SAME = 3.0  # nats within which another answer is as good
NEAR = 10.0  # nats within which it is mentioned
MOST = 4  # answers that are kept
CLIMB = 60  # steps of a climb by an engine
# nats that a node may fit worse on its other side, tracks held, where each trial is such a climb
HELD = 30.0
FAINT = 0.03  # share of the extent of the tracks, of which a part (`new`) is no other place
APART = 0.1  # share of a reflection that must be left after polishing: below, it came back
PIECES = "pieces of tracks on their other side"


class Candidate(NamedTuple):
    """Another configuration that may fit as well: name, kind, and the point before it is polished."""

    name: str
    kind: str  # of `labels`: a scene, a piece of a track, a node
    point: Point


class Mirrored(NamedTuple):
    """Another answer: what was reflected, and its evidence less that of the answer (under the declared scales)."""

    name: str
    gain: float
    point: Point
    shift: np.ndarray  # (M,) its biases z less those of the answer
    kind: str = SCENE
    status: str = ""  # of the fit from there; empty where it was found only


class SideClimb(NamedTuple):
    """The functions that find and weigh the mode next to a point under the declared scales."""

    mode: Callable[[Point], tuple[Point, float]]  # the mode, and its log density or evidence, -inf where there is none
    evidence: Callable[[Point, float], float]  # of a mode and what came with it
    most: float = np.inf  # nats that a node may fit worse on its other side, tracks held, and is still tried

    @classmethod
    def on(cls, problem: Problem, engine: Engine) -> "SideClimb":
        """To the joint mode, weighed by Laplace's formula; on an engine of large networks to the marginal mode.

        Where log determinants are estimated the log marginal density weighs it: of reflected biases they are nearly
        the same, and their errors would blur what tells the sides apart.
        """
        model, scales = problem.model, Precision(jax.device_put(np.ones(problem.model.biases)))
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
            return cls(joint, lambda at, _: evidence(engine.at(model, at), scales, factors).value)
        return cls(marginal, lambda _, value: value, HELD)


# from a point, and the nats that a node may fit worse on its other side, tracks held
Proposal = Callable[[Problem, Point, float], Iterator[Candidate]]


class Sides(NamedTuple):
    """The result of a search."""

    point: Point  # the best place
    moved: bool  # whether it is another than the given one
    others: tuple[Mirrored, ...]  # those within `NEAR` nats of it
    name: str = ""  # what was reflected on the way to it
    gain: float = 0.0  # its evidence less that of the given place
    kind: str = SCENE


def explore(problem: Problem, point: Point, climb: SideClimb, proposals: Sequence[Proposal]) -> Sides:
    """The best mode that proposals lead to from a point, and those of about the same evidence.

    A node or a piece of a track that fits better elsewhere is moved at once. Whole scenes, and
    candidates that fit about as well, are weighed by their evidence; the search goes on from the best.
    """
    given = here = _Here(problem, climb, point)
    way = None
    others: list[Mirrored] = []
    for _ in range(ROUNDS):
        here, moved, near = _moved(here, proposals)
        way, others = moved or way, _ranked(here, near)
        if not others or others[0].gain <= MORE:
            break
        first = others[0]
        way, here = (first.name, first.kind), _Here(problem, climb, first.point)
        others = [o._replace(gain=o.gain - first.gain, shift=o.shift - first.shift) for o in others[1:]]
    others.sort(key=lambda one: (one.gain <= -SAME, one.kind != SCENE, -one.gain))
    if way is None:
        return Sides(point, False, tuple(others[:MOST]))
    gain = here.evidence - given.evidence
    if not np.isfinite(gain):  # nothing was found at the given place itself
        return Sides(point, False, ())
    return Sides(here.point, True, tuple(others[:MOST]), way[0], gain, way[1])


@dataclass(frozen=True)
class _Here:
    """The point where a search stands; its mode is found when a candidate is compared with it."""

    problem: Problem
    climb: SideClimb
    point: Point
    polished: float | None = None  # the density, where the point is a mode

    @cached_property
    def mode(self) -> tuple[Point, float]:
        return self.climb.mode(self.point) if self.polished is None else (self.point, self.polished)

    @cached_property
    def evidence(self) -> float:
        return self.climb.evidence(*self.mode)


class Gap(NamedTuple):
    """Root sums of squares between two points, over all places of targets and over those of nodes."""

    tracks: float  # m
    nodes: float  # in declared scales


class _Tried(NamedTuple):
    """A candidate with the mode that it leads to, and its distance from the mode of the point."""

    candidate: Candidate
    mode: tuple[Point, float]
    size: Gap
    back: bool = False  # what it moved came back, whatever else did not


def _moved(here: _Here, proposals: Sequence[Proposal]) -> tuple[_Here, tuple[str, str] | None, list[_Tried]]:
    """The point from which no proposal leads to a better node or piece; name and kind of the last move.

    Also what fits about as well there, that of the last proposal first.
    """
    near: dict[int, list[_Tried]] = {}
    way = None
    k = moves = 0
    while len(near) < len(proposals):
        better, found = _looked(here, proposals[k])
        if better is not None and moves < MOVES:
            here, near, moves = _Here(here.problem, here.climb, *better.mode), {}, moves + 1
            if way is None or better.candidate.kind == NODE:
                way = PIECES if better.candidate.kind == PIECE else better.candidate.name, better.candidate.kind
        else:
            near[k] = found
            k = (k + 1) % len(proposals)
    return here, way, [tried for k in sorted(near, reverse=True) for tried in near[k]]


def _looked(here: _Here, proposal: Proposal) -> tuple[_Tried | None, list[_Tried]]:
    """The first node or piece that fits better than the mode here, and all that fit about as well."""
    found, count = list[_Tried](), Counter[bool]()
    for candidate in proposal(here.problem, here.point, here.climb.most):
        if TRIED in count.values():
            break
        tried = _tried(here, candidate)
        if tried is None:
            continue
        count[tried.back] += 1  # those that come back take no other's place
        if not new(here.problem, tried.mode[0], [here.mode[0]], tried.size):
            continue
        gain = tried.mode[1] - here.mode[1]
        if gain > GAIN and candidate.kind != SCENE:
            return tried, []
        if gain > -NEAR:
            found.append(tried)
    return None, found


def _tried(here: _Here, candidate: Candidate) -> _Tried | None:
    """A candidate polished; None where its tracks come back by themselves.

    A node may come back and leave tracks on another side.
    """
    problem, best, start = here.problem, here.mode[0], candidate.point
    size = reach(problem, start, best)
    if candidate.kind == NODE:
        alone = size._replace(tracks=0.0)
    else:
        start = track_mode(problem, start)
        alone = size = size if np.any(candidate.point.z != here.point.z) else size._replace(nodes=0.0)
        if not new(problem, start, [best], size):
            return None
    mode = here.climb.mode(start)
    back = not new(problem, mode[0], [best], alone)
    if back and candidate.kind == NODE:
        candidate = candidate._replace(name=PIECES, kind=PIECE)
    return _Tried(candidate, mode, size, back)


def _ranked(here: _Here, near: Sequence[_Tried]) -> list[Mirrored]:
    """Each mode within `NEAR` nats once, with its evidence less that of the mode here, best first."""
    found = list[Mirrored]()
    for (name, kind, _), mode, size, _ in near:
        if new(here.problem, mode[0], [other.point for other in found], size):
            gain = here.climb.evidence(*mode) - here.evidence
            if np.isfinite(gain) and gain > -NEAR:
                found.append(Mirrored(name, gain, mode[0], np.asarray(mode[0].z - here.mode[0].z), kind))
    return sorted(found, key=lambda one: -one.gain)


def distance(problem: Problem, a: Point, b: Point) -> Gap:
    """The distances between two points, over their targets and over their nodes."""
    away = problem.positions(jax.tree.map(np.subtract, a.states, b.states))
    own = [m for members in place_biases(problem).values() for m in members]
    moved = (np.asarray(a.z) - np.asarray(b.z))[own]
    return Gap(float(np.sqrt(sum(np.sum(own**2) for own in away))), float(np.sqrt(np.sum(moved**2))))


def reach(problem: Problem, a: Point, b: Point) -> Gap:
    """The distance of two answers, at least `FAINT` of the extent of the tracks."""
    gap, places = distance(problem, a, b), problem.positions(b.states)
    extent = float(np.sqrt(sum(np.sum((own - own.mean(0)) ** 2) for own in places)))
    return gap._replace(tracks=max(gap.tracks, FAINT * extent))


def new(problem: Problem, point: Point, known: Sequence[Point], size: Gap) -> bool:
    """True if a point lies apart from all known ones by a fraction of the size of a reflection."""
    gaps = [distance(problem, point, other) for other in known]
    nodes = size.nodes if size.nodes > SHIFTED else np.inf
    tracks = size.tracks if size.tracks > 0 else np.inf
    return all(gap.tracks > APART * tracks or gap.nodes > APART * nodes for gap in gaps)
