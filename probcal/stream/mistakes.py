"""Mistakes in rows that a model does not explain: each is undone, and the tracks are found anew."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from probcal.errors import InputError
from probcal.gaussian.draws import residuals
from probcal.modes import automatic_start
from probcal.modes.grid import track_mode
from probcal.problem import Problem
from probcal.results.answer import uncalibrated
from probcal.table import UNITS

LARGE = 100.0  # largest square of a standardised residual that counts: a few outliers hide no mistake
CLEARLY = 0.3  # of what was left before, and of `LARGE`: what is left where a mistake is found
ALIKE = 1.5  # times the least that is left: what explains the rows as well
MOST = 15  # pairs of sensors that are tried


def mistake(problem: Problem, suspects: Sequence[str]) -> str:
    """The mistake of some sensors whose undoing explains the rows, and what to do; empty where none does.

    Two that explain them alike are both named.
    """
    before = _left(problem)
    found = sorted((_left(undone), text) for text, undone in _undone(problem, suspects))
    best = min((left for left, _ in found), default=np.inf)
    if best > CLEARLY * min(before, LARGE):
        return ""
    texts = [text for left, text in found if left < ALIKE * best][:2]
    said = "; or ".join(texts)
    return f"{said[0].upper()}{said[1:]} (mean square a datum {best:.2g} then, {before:.2g} now)."


def _left(problem: Problem) -> float:
    """Mean of the squares, none larger than `LARGE`, that the best tracks leave with the biases as stated."""
    point = track_mode(problem, uncalibrated(problem, automatic_start(problem)))
    squares = [
        np.asarray(part)[np.asarray(there) > 0]
        for part, there in zip(residuals(problem.model, point).square, problem.model.measured, strict=True)
    ]
    return float(np.mean(np.nan_to_num(np.minimum(np.concatenate(squares), LARGE), nan=LARGE)))


def _undone(problem: Problem, suspects: Sequence[str]) -> Iterator[tuple[str, Problem]]:
    """The rows without one mistake, and a sentence that names it."""
    for pair in _pairs(problem, suspects):
        frame = problem.measurements.table.frame
        sensor = frame["sensor"].astype(str).replace(dict(zip(pair, reversed(pair), strict=True)))
        try:
            other = problem.rebuild(replace(problem.measurements.table, frame=frame.assign(sensor=sensor)))
        except InputError:
            continue
        yield f"the rows of {pair[0]} and {pair[1]} look exchanged: exchange their names", other
    blocks = enumerate(problem.model.each_block(problem.columns, problem.row_index))
    for b, (block, data, _, channels, rows) in blocks:
        names = np.array([s.name for s in problem.network.sensors])[problem.measurements.sensor[rows]]
        whole = f"all {block.type.name} sensors", np.ones(len(rows), bool)
        for c, name in enumerate(channels):
            channel = block.channels[c]
            for owner, mine in (whole, *((own, names == own) for own in suspects)):
                if not mine.any() or (owner != whole[0] and mine.all()):
                    continue
                for cause, values in _values(np.asarray(data.y)[:, c], channel.unit, channel.period):
                    y = [np.array(rows.y) for rows in problem.model.rows]
                    y[b][mine, c] = values[mine]
                    yield f"values of {name} of {owner} {cause}", problem.redrawn(y)


def _pairs(problem: Problem, suspects: Sequence[str]) -> list[tuple[str, str]]:
    """Sensors of one type that may be exchanged."""
    kinds = {placed.name: placed.type for placed in problem.network.sensors}
    own = sorted(kinds, key=lambda name: name not in suspects)
    pairs = [pair for pair in combinations(own, 2) if kinds[pair[0]] == kinds[pair[1]]]
    return sorted(pairs, key=lambda pair: sum(name not in suspects for name in pair))[:MOST]


def _values(y: np.ndarray, unit: str, period: float | None) -> Iterator[tuple[str, np.ndarray]]:
    """Each possible mistake in the values of a channel (N,): its sentence, and the values without it."""
    if period is not None:
        yield "look like compass bearings: declare Channel(..., wrap=True, compass=True)", period / 4 - y
        yield "look reversed: change their sign", -y
        return
    quantity, size = UNITS.get(unit, ("", 1.0))
    for other, (kind, factor) in UNITS.items():
        if kind == quantity and factor != size:
            yield f"look like {other} and not {unit}: convert them", y * factor / size
