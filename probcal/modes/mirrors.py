"""The other side of a mirror: tracks and nodes reflected in the lines and planes of a network.

Sensors that see a distance, a strength or a delay cannot tell the two sides of the line (in 3-D the plane) on which
their nodes lie. A climb ends on one side, and pieces of a track may end on different ones. Candidates are screened by
the misfit of the data at the reflected places with the prior spread of the biases added to the noise, so that a network
that has no mirror pays for two looks at its data, and one with nodes that may stand on either side of what they hear
for some thirty.
"""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import jax
import numpy as np

from probcal.gaussian.choose import engine_of
from probcal.gaussian.information import at_levels
from probcal.gaussian.mode import Point
from probcal.labels import PIECE, SCENE
from probcal.model import variants
from probcal.modes.crossings import crossed_nodes
from probcal.modes.explore import MOST, PIECES, TRIED, WORSE, Candidate, SideClimb, Sides, explore
from probcal.modes.grid import grid_start, profile
from probcal.modes.reflections import Plane, movable, planes, reflect, reflect_nodes
from probcal.problem import Problem
from probcal.types import float64

BREAKS = 30  # places where a track may be cut
LOOKED = 3 * TRIED  # pieces that are smoothed: those that come back by themselves are not polished
ALIKE, APART_BY = 0.7, 0.5  # share of common epochs from which pieces are one, if their reflections lie at most so
# much of their own size apart
SHORTEST = 3  # epochs of a piece: fewer do not stay on another side than their neighbours
STRAIN = 20.0  # sum of squares of a process noise from which a track may be cut there


@float64
def other_sides(problem: Problem, point: Point, climb: SideClimb | None = None) -> Sides:
    """Search the other sides of a point: of pieces of tracks, of nodes alone, and of all of the scene."""
    climb = SideClimb.on(problem, engine_of("dense", problem.model)) if climb is None else climb
    return explore(problem, point, climb, (reflected_pieces, crossed_nodes, reflected_scenes))


def _losses(problem: Problem, z: np.ndarray, point: Point, plane: Plane | None) -> list[np.ndarray]:
    """Robust misfit (E,) of the data of each epoch at the places of a point, or at those on the other side."""
    found = []
    for r, place in enumerate(problem.positions(point.states)):
        place = place if plane is None else plane.across(place)
        loss, _ = profile(problem.model, r, problem.epochs[r].position, jax.device_put(z), jax.device_put(place))
        found.append(np.nan_to_num(np.asarray(loss), nan=1e9, posinf=1e9))
    return found


def _counts(problem: Problem) -> list[np.ndarray]:
    """Number of data (E,) at each epoch of each recursion."""
    return variants.counts(problem.model, lambda mask: mask.sum(1))


def reflected_scenes(problem: Problem, point: Point, most: float = np.inf) -> Iterator[Candidate]:
    """Reflections of the whole scene, and of the track of one target alone, that fit nearly as well unpolished.

    Those first that fit best.
    """
    z, free, counts = np.asarray(point.z), movable(problem), _counts(problem)
    targets = [n for epochs in problem.epochs for n in epochs.members if n in problem.targets]
    found = planes(problem, z)
    here = _losses(problem, z, point, None) if found else []
    parts: list[tuple[str, Sequence[np.ndarray]]] = [("the targets", free)] if len(targets) > 1 else []
    for name in targets[:MOST]:
        own = problem.model.each(lambda _, mine, own, n=name: mine & (own.target == n), free, problem.epochs)
        parts.append((f'target "{name}"', own))
    seen: list[tuple[float, Candidate]] = []
    for plane in found:
        other = reflect_nodes(problem, z, plane)
        ways = [(z, parts)] if np.array_equal(other, z) else [(other, parts[:1]), (z, parts)]
        for biases, moved in ways:
            worse = list(map(np.subtract, _losses(problem, biases, point, plane), here))
            word = "" if biases is z else " and nodes"
            for who, chosen in moved:
                loss, much = (
                    sum(float(part[mine].sum()) for part, mine in zip(values, chosen, strict=True))
                    for values in (worse, counts)
                )
                if loss < WORSE * much:
                    way = f"{who}{word} reflected in {plane.name}"
                    seen.append((loss / much, Candidate(way, SCENE, reflect(problem, point, plane, chosen, biases))))
    yield from (candidate for _, candidate in sorted(seen, key=lambda one: one[0]))


class _Piece(NamedTuple):
    """A piece of a track, and how much worse a datum of it fits on the other side, unpolished."""

    worse: float
    recursion: int
    target: str
    own: np.ndarray  # its epochs
    plane: Plane
    place: np.ndarray  # (n, d) where it is

    def alike(self, other: "_Piece") -> bool:
        """True if it is the same piece, reflected to about the same places."""
        if (self.recursion, self.target) != (other.recursion, other.target):
            return False
        both, mine, others = np.intersect1d(self.own, other.own, assume_unique=True, return_indices=True)
        if len(both) < ALIKE * (len(self.own) + len(other.own) - len(both)):
            return False
        here, there = self.plane.across(self.place[mine]), other.plane.across(other.place[others])
        moved = max(np.linalg.norm(here - self.place[mine]), np.linalg.norm(there - other.place[others]))
        return bool(np.linalg.norm(here - there) <= APART_BY * moved)


def reflected_pieces(problem: Problem, point: Point, most: float = np.inf) -> Iterator[Candidate]:
    """Pieces of tracks on the other side, those first whose data fit best there unpolished.

    Where there are any the whole track is searched again too, at the biases reached so far.
    Of pieces that differ by where their planes cut them there is one. A long piece does not go before a short one:
    what is left over when a track goes over from one side to the other is short as often.
    """
    z, free, counts = np.asarray(point.z), movable(problem), _counts(problem)
    found = planes(problem, z)
    cut = list[_Piece]()
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
                        cut.append(_Piece(float(worse[own].sum()) / count, r, target, own, plane, place))
    kept = list[_Piece]()
    for piece in sorted(cut, key=lambda piece: piece.worse):
        if len(kept) < LOOKED and not any(piece.alike(other) for other in kept):
            kept.append(piece)
    if kept:
        again = at_levels(problem.model, grid_start(problem, point.z), point.levels)
        yield Candidate(PIECES, PIECE, again)
    for _, r, target, own, plane, _ in kept:
        chosen = [np.zeros(len(epochs.time), bool) for epochs in problem.epochs]
        chosen[r][own] = True
        first, last = problem.epochs[r].time[own[[0, -1]]]
        name = f'target "{target}" from {first:.6g} to {last:.6g} s reflected in {plane.name}'
        yield Candidate(name, PIECE, reflect(problem, point, plane, chosen, z))


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
    return [*(mine[a:b] for a, b in pairwise(ends) if len(ends) > 2), *(mine[a:] for a in ends[2:-1])]
