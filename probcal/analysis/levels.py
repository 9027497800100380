"""Are the declared noise levels those of the data, and which biases hang on them?

A level that is declared too large or too small does not only make intervals wrong: along what the data hardly tell (the
size of a network that the motion alone fixes) it moves the answer by many sd. The evidence is expanded about the fit in
all log levels at once, biases following: its slope by a log level is that of MacKay (Paper B 25, for noise), and its
curvature comes from the slopes a little to either side, trajectories at their mode there.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import numpy as np
import xarray as xr

from probcal.analysis.check import Case, Checked, check
from probcal.analysis.findings import Finding
from probcal.analysis.verdict import limit_of
from probcal.gaussian.engine import Engine, Expansion, Factors, noise_score, noise_terms
from probcal.inference.fitted import Judged
from probcal.inference.residuals import PRACTICAL
from probcal.labels import listed
from probcal.linalg import eigenvalues, invert
from probcal.model.motions import by_component, linear_of
from probcal.motion import as_motion
from probcal.motion.base import level_label
from probcal.noise import Bernoulli, Unknown, guess_of
from probcal.problem import Problem
from probcal.results.groups import bias_coords

STEP = 0.1  # of a log level to either side
FEWEST = 30  # noises below which nothing is said of their level
TURNS, LONGEST, NEAR = 4, 1.0, 0.15  # most expansions, the longest step of a log level in one, and one that is the last
SUSPECT = 4.0  # chi-square of a look at a large network from which its levels are expanded
NEGLIGIBLE = 6.0  # chi-square up to which a step is chance, and is not followed
CLIMBS, SETTLED_Z = 3, 0.01  # most steps of z to its mode, and scales within which it is there
MOST = 12  # levels that are looked at, those of the most noises
FARTHEST = 1.5  # log of a factor beyond which only its side is said
HANGS = 1.0  # sd by which biases must move to hang on a level


class Level(NamedTuple):
    """One noise level of a problem."""

    label: str
    declared: float | None  # None where it stands in the table
    unknown: int = -1  # its number among the unknown ones


class Members(NamedTuple):
    """The index in `levels` of every datum and every process noise, -1 where none."""

    levels: list[Level]
    rows: list[np.ndarray]  # (N, C) of each block
    noises: list[np.ndarray]  # (E, n) of each recursion

    def sums(self, rows: Sequence[Any], noises: Sequence[Any]) -> np.ndarray:
        """Sums (K,) of values of the data and of the process noises over those of each level."""
        total = np.zeros(len(self.levels) + 1)  # what has no level goes last
        for index, value in zip([*self.rows, *self.noises], [*rows, *noises], strict=True):
            np.add.at(total, index, np.asarray(value))
        return total[:-1]

    def only(self, kept: np.ndarray) -> Members:
        """Those of some of the levels (K,)."""
        place = np.append(np.where(kept, np.cumsum(kept) - 1, -1), -1)
        levels = [level for level, own in zip(self.levels, kept, strict=True) if own]
        return Members(levels, [place[k] for k in self.rows], [place[k] for k in self.noises])


class Wanted(NamedTuple):
    """The steps to the largest evidence by its expansion, and the shift of the biases with each."""

    step: np.ndarray  # (K,) of the log levels
    sd: np.ndarray  # (K,)
    square: np.ndarray  # (K,) of each step alone over its variance
    shift: np.ndarray  # (K, M) of z with the step of each level; NaN where not linearised
    linearised: np.ndarray  # (K,) whether the posterior was linearised with that level changed


def members_of(problem: Problem, *, moving: bool = True) -> Members:
    """The levels of a problem that have enough noises, at most `MOST`; those of sampled motions are left out."""
    found: dict[Level, int] = {}
    rows = [_of_rows(problem, b, found) for b in range(len(problem.model.blocks))]
    noises = [_of_noises(problem, r, found) for r in range(len(problem.model.recursions))]
    noises = noises if moving else [np.full_like(own, -1) for own in noises]
    counts = np.bincount(np.concatenate([k.ravel() for k in (*rows, *noises)]) + 1, minlength=len(found) + 1)[1:]
    kept = (np.argsort(np.argsort(-counts, kind="stable")) < MOST) & (counts >= FEWEST)
    return Members(list(found), rows, noises).only(kept)


def _of_rows(problem: Problem, b: int, found: dict[Level, int]) -> np.ndarray:
    """Level (N, C) of every datum of a block."""
    block, data, H = problem.model.blocks[b], problem.model.rows[b], len(problem.levels)
    number, std, index = np.asarray(data.level), np.asarray(data.std), np.full(data.std.shape, -1)
    for c, (name, channel) in enumerate(block.type.expand(block.dimension)):
        if isinstance(channel.noise, Bernoulli):
            continue
        label = f"{block.type.name}.{name.rpartition('_')[0] if channel.per_axis else name}_std"
        own = (number[:, c] == H) & (isinstance(channel.std, Unknown) | (std[:, c] != guess_of(channel.std)))
        levels = [Level(label, None if isinstance(channel.std, Unknown) else float(channel.std)), Level(label, None)]
        for level, mine in zip(levels, ((number[:, c] == H) & ~own, own), strict=True):
            if mine.any():
                index[mine, c] = found.setdefault(level, len(found))
    whole = np.asarray(data.mask) == 1  # rows of less weight scatter more than they count
    return np.where(whole, _with_unknown(problem, number, index, found), -1)


def _of_noises(problem: Problem, r: int, found: dict[Level, int]) -> np.ndarray:
    """Level (E, n) of every whitened process noise of a recursion, starts left out."""
    epochs, part = problem.epochs[r], problem.model.recursions[r]
    first, index = np.asarray(part.first), np.full(part.drift.shape, -1)
    for target, members in epochs.members.items():
        mine = members & ~first
        components = linear_of(as_motion(problem.target(target).motion))
        for component, _, own in by_component(components, problem.network.dimension):
            if mine.any() and not isinstance(component.std, Unknown):
                level = Level(level_label(component), float(component.std))
                index[mine, own] = found.setdefault(level, len(found))
    index = _with_unknown(problem, np.asarray(part.level), index, found)
    return np.where(np.asarray(part.L).any(1) & ~first[:, None], index, -1)


def _with_unknown(problem: Problem, number: np.ndarray, index: np.ndarray, found: dict[Level, int]) -> np.ndarray:
    """The index with the unknown levels in it, `number` of each entry."""
    for h in np.unique(number[number < len(problem.levels)]).tolist():
        record = problem.levels[h]
        index = np.where(number == h, found.setdefault(Level(record.label, record.guess, h), len(found)), index)
    return index


def _at(engine: Engine, at: Expansion, members: Members, step: np.ndarray, z: np.ndarray) -> Expansion:
    """The posterior with the levels a step (K,) of their logs away, trajectories at their mode, biases moved by z."""
    factor = np.append(np.exp(step), 1.0)  # what has no level goes last
    model, point = at.model, at.point
    rows = tuple(
        own._replace(std=jax.device_put(np.asarray(own.std) * factor[index]))
        for _, own, _, index in model.each_block(members.rows)
    )
    scales = [factor[index] for index in members.noises]
    recursions = model.each(
        lambda part, scale: part._replace(L=jax.device_put(np.asarray(part.L) * scale[:, None, :])), scales
    )
    noises = model.each(lambda _, u, scale: jax.device_put(np.asarray(u) / scale), point.noises, scales)
    moved = point._replace(noises=noises, z=jax.device_put(np.asarray(point.z) + z))
    return engine.settled(replace(model, rows=rows, recursions=recursions), moved)


def _expanded(
    fit: Judged, factors: Factors, at: Expansion, members: Members, moved: np.ndarray
) -> tuple[Expansion, tuple[np.ndarray, ...] | None]:
    """The log evidence where the levels have moved already, (K,), at the mode of z near a point, biases following.

    The posterior there; slope (K,) and inverse negative curvature (K, K) by log levels, how much these pull the score
    of z (K, M) and move its mode (K, M), None without a maximum.
    """
    K, M = len(members.levels), len(at.point.z)

    def stepped(step: np.ndarray, away: np.ndarray) -> Expansion:
        return _at(fit.engine, at, members, step, away)

    def slopes(at: Expansion) -> np.ndarray:
        """Slopes (K + M,) of the log evidence by log levels, and by z before the prior."""
        return np.append(members.sums(*noise_score(at, factors)), at.score())

    here = slopes(at)
    for _ in range(CLIMBS):
        away = np.asarray(at.solve(factors, here[K:] + factors.pull(at.point.z)))
        if not np.abs(away).max(initial=0.0) > SETTLED_Z:
            break
        at = stepped(np.zeros(K), away)
        here = slopes(at)
    pairs = [[slopes(stepped(s * unit, np.zeros(M))) for s in (STEP, -STEP)] for unit in np.eye(K)]
    curved, pull = np.split(np.array([up - down for up, down in pairs]) / (2 * STEP), [K], axis=1)
    follow = np.asarray(at.solve(factors, pull.T)).T
    unknown = [level.unknown for level in members.levels]
    known = np.append(fit.problem.model.level_spread, np.inf)[unknown] ** -2
    slope = here[:K] - (np.append(fit.point.levels, 0.0)[unknown] + moved) * known
    alone = known - np.diag(curved)
    matrix = np.diag(known) - 0.5 * (curved + curved.T) - pull @ follow.T
    if not (np.isfinite(matrix).all() and np.isfinite(slope).all() and (alone > 0).all()):
        return at, None
    if not eigenvalues(matrix).min() > 0:  # far from the maximum: each level by itself
        matrix = np.diag(alone)
    return at, (slope, invert(matrix), pull, follow)


def ask(fit: Judged, members: Members, factors: Factors) -> Wanted | None:
    """The steps from the fit to the largest evidence in all log levels; None without a maximum.

    `factors` are those of the prior of z that is held. What biases move is their covariance times what their score
    changes, the slope of any posterior mean by what is added to the score.

    Where expansions are not cheap one look at the scores says of which levels that is worked out.
    """
    if fit.engine.cheap:
        return _followed(fit, members, factors)
    # the levels by one look, and which of them may be wrong: those to linearise again
    slope, alone = (members.sums(*own) for own in noise_terms(fit.expansion, factors))
    alone = np.maximum(alone, 1e-300)
    step, sd = slope / alone, alone**-0.5
    suspect = (np.abs(step) > NEAR) | (step**2 > SUSPECT * sd**2)
    shift = np.full((len(step), fit.expansion.model.biases), np.nan)
    look = Wanted(step, sd, (step / sd) ** 2, shift, suspect)
    if not look.linearised.any():
        return look
    asked = _followed(fit, members.only(look.linearised), factors)
    if asked is None:
        return None
    for whole, own in zip(look[:-1], asked[:-1], strict=True):
        whole[look.linearised] = own
    return look


def _followed(fit: Judged, members: Members, factors: Factors) -> Wanted | None:
    """Newton steps in all levels together.

    The slope of N noises of mean square r^2 is N (r^2 exp(-2 t) - 1): a Newton step d stands for t = -log(1 - 2 d) / 2.
    """
    at, K = fit.expansion, len(members.levels)
    step, shift, square = np.zeros(K), np.zeros((K, len(at.point.z))), np.zeros(K)
    sd, every = np.zeros(K), np.ones(K, bool)
    for turn in range(TURNS):
        at, found = _expanded(fit, factors, at, members, step)
        if found is None:
            return None if turn == 0 else Wanted(step, sd, square, shift, every)
        slope, covariance, pull, follow = found
        newton, sd = covariance @ slope, np.sqrt(np.diag(covariance))
        square = newton**2 / sd**2 if turn == 0 else square
        bent = -0.5 * np.log(np.maximum(1.0 - 2.0 * newton, np.exp(-2.0 * LONGEST)))
        own = np.clip(bent, -LONGEST, LONGEST)
        step, shift = step + own, shift + own[:, None] * fit.times(pull.T).T
        if np.abs(own).max() < NEAR or not (newton**2 > NEGLIGIBLE * sd**2).any():
            break
        at = _at(fit.engine, at, members, own, own @ follow)
    return Wanted(step, sd, square, shift, every)


@check("answer", "factor")
def check_levels(case: Case) -> Checked:
    """Group `level_check`, findings on declared levels, and why the answer of some biases is in doubt with them.

    `factor` is what the data ask for over what the fit had (all levels together), `factor_sd` its sd, `square` the
    chi-square of that alone, `shift` what every bias would move with it, in its unit. Of a large network only levels
    that one look finds suspect are `linearised` again, the others held; these have no `shift` (NaN), and their
    `factor_sd` are upper bounds. Of process noise nothing is said where it was left out of the fit. Where precisions
    were integrated the declared scales are held.
    """
    fit, attrs, asked = case.fit, case.tree.attrs, None
    members = members_of(fit.problem, moving=attrs.get("motion") != "left out")
    integrated = attrs["precisions"] == "integrated"
    factors = Factors.alone(np.ones(len(fit.point.z))) if integrated else fit.factors
    if members.levels and fit.problem.model.biases:
        with suppress(MemoryError, np.linalg.LinAlgError):  # a flat prior on biases that the data leave open
            asked = ask(fit, members, factors)
    if asked is None:
        return Checked()
    problem, limit = fit.problem, limit_of(sum(level.unknown < 0 for level in members.levels))
    sd = np.maximum(fit.sd, 1e-150)
    factor = np.exp(np.clip(asked.step, -FARTHEST, FARTHEST))
    sure = np.array([level.unknown < 0 for level in members.levels]) & (asked.square > limit)
    moved = np.where(sure[:, None], asked.shift / sd, 0.0)
    findings = []
    for k in np.flatnonzero(sure & ((np.abs(np.log(factor)) > np.log(PRACTICAL)) | (np.abs(moved) > HANGS).any(1))):
        text = _sentence(members.levels[k], factor[k], asked.sd[k] * factor[k])
        findings.append(Finding("level", members.levels[k].label, text + _moved(problem, moved[k])))
    values: dict[str, Any] = {
        "factor": ("level", factor), "factor_sd": ("level", asked.sd * factor), "square": ("level", asked.square),
        "linearised": ("level", asked.linearised),
    }  # fmt: skip
    if asked.linearised.any():
        values["shift"] = (("level", "bias_label"), asked.shift * problem.scales)
    group = xr.Dataset(values, bias_coords(problem) | {"level": _names(members.levels)})
    group.attrs |= {"limit": float(limit)}
    return Checked({"level_check": group}, findings, {"weak": _doubts(members, moved, factor)})


def _names(levels: list[Level]) -> list[str]:
    """A name of its own for each level: that of an unknown one, else its label, numbered where that is taken."""
    taken = {level.label for level in levels if level.unknown >= 0}
    names = list[str]()
    for level in levels:
        name, k = level.label, 1
        while level.unknown < 0 and name in taken:
            name, k = f"{level.label}#{k + 1}", k + 1
        taken.add(name)
        names.append(name)
    return names


def _sentence(level: Level, factor: float, sd: float) -> str:
    """A sentence on the size of a level that the data ask for, and the remedy."""
    what = "what the table has" if level.declared is None else f"the declared {level.declared:g}"
    if abs(np.log(factor)) >= FARTHEST:
        size = f"far {'more' if factor > 1 else 'less'} than {what}"
    else:
        size = f"{factor:.2f} ± {sd:.2f} times {what}"
    remedy = "correct its std" if level.declared is None else f"declare Unknown({level.declared:g})"
    if np.log(factor) >= FARTHEST:
        remedy += ", unless a unit, a sensor or the motion is wrong"
    return f"{level.label}: the data ask for {size}: {remedy}"


def _moved(problem: Problem, moved: np.ndarray) -> str:
    """A clause on the biases that are sensitive to a level, which moves them by `moved` (M,) sd."""
    far = [m for m in np.argsort(-np.abs(moved)) if abs(moved[m]) > HANGS]
    if not far:
        return ""
    return f"; {listed([problem.labels[m] for m in far], 1)} would move by {abs(moved[far[0]]):.1f} sd"


def _doubts(members: Members, moved: np.ndarray, factor: np.ndarray) -> dict[int, str]:
    """Why the answers of biases are in doubt that would move by more than `HANGS` sd, `moved` (K, M)."""
    found = {}
    for m in np.flatnonzero(np.abs(moved.sum(0)) > HANGS).tolist():
        k = int(np.abs(moved[:, m]).argmax())
        label = members.levels[k].label
        found[m] = f"it would move by {abs(moved[:, m].sum()):.1f} sd with the {label} that the data ask for"
        found[m] += f" ({factor[k]:.2f} times what is declared)"
    return found
