"""The remedies for an open direction: biases to fix or survey, kept only if recomputing confirms
them."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from probcal.identifiability.wording import together
from probcal.linalg import solve_square, spectrum
from probcal.problem import Problem

WEAK = 1.0  # marginal information below which a direction is left to the prior
TRIED = 12  # remedies of one direction that are recomputed
HALVINGS = 6  # survey stds tried, each half of the one before


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


def with_remedies(
    problem: Problem, known: np.ndarray, among: np.ndarray, found: list[Direction],
    anchors: list[tuple[tuple[str, ...], ...]],
) -> Iterator[Direction]:  # fmt: skip
    """The directions with the biases whose fixing, or survey, removes each, together with those before it.

    A remedy is kept only if the information (F, F) about the biases `among` (F,), recomputed with it, has a weak
    direction less.
    """
    labels, scales = [problem.labels[m] for m in among], problem.scales[among]
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
            yield replace(direction, fix=fixed, remedy=f"{before}fix {together(fixed, problem.labels)}")
            continue
        members = [[labels.index(name) for name in group] for group in groups]
        both = [m for group in members[:2] for m in group]
        chosen = _anchor(known, done, members, left) or _anchor(known, done, [both], left)
        if not chosen:
            left += 1
            yield replace(direction, remedy=general)
            continue
        fixed = tuple(labels[m] for m in chosen)
        std = _survey(known, done, chosen, left, scales, direction.vector[among])
        units = {problem.biases[problem.labels.index(label)].unit for label in fixed}
        std = std if len(units) == 1 else None
        survey = f", or survey it to {std:g} {units.pop().strip('1')}".rstrip() if std is not None else ""
        yield replace(direction, fix=fixed, survey=std, remedy=f"{before}fix {together(fixed, problem.labels)}{survey}")
        done += chosen


def _spectrum(known: np.ndarray, done: Iterable[int]) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues and vectors (F, F - fixed) of the information with some biases fixed."""
    stay = np.setdiff1d(np.arange(len(known)), list(done))
    values, vectors = spectrum(known[np.ix_(stay, stay)])
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
    best = (left, np.inf)
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
        rest = known - known[:, chosen] @ solve_square(inner, known[chosen])
        if _count(rest, [*done, *chosen]) <= left:
            return std
    return None


def _round_down(value: float) -> float:
    """One significant digit, towards zero."""
    step = 10.0 ** np.floor(np.log10(value))
    return float(f"{np.floor(value / step) * step:.1g}")
