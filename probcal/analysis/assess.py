"""`assess`: is the answer of a fit good? Innovations, predictive checks, left-out data, halves, and verdicts."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from probcal.analysis import (
    checks,
    leave,
    levels,
    nees,
    pieces,
    predictive,
    process,
    scaling,
    shape,
    verdict,
)
from probcal.analysis.beside import lag_doubts, mirror_doubts, mirror_findings
from probcal.analysis.findings import Finding, alarms, completed, of_invalid
from probcal.analysis.large import assess_large
from probcal.analysis.pieces import Change, Pieces
from probcal.analysis.verdict import RATE, limit_of
from probcal.identifiability.remedies import WEAK
from probcal.inference import residuals
from probcal.inference.fitted import Fitted, take_up
from probcal.inference.widen import rejection, unwidened, widened
from probcal.labels import listed
from probcal.problem import Problem
from probcal.results.answer import Answer
from probcal.results.groups import bias_coords, node_of
from probcal.results.read import each_target
from probcal.simulate import Key, Truth, as_key
from probcal.status import INVALID, Status
from probcal.types import float64

QUARTERS = 4
SHARED = 1.8  # sd that an open combination of one scale may put a bias off; of four with a free common part, about 1.9
COPIES = 2000  # most biases of all pieces together


@float64
def assess(
    problem: Problem, tree: xr.DataTree, *, truth: Truth | None = None, key: Key = 0, answer: Answer | None = None
) -> xr.DataTree:
    """Say what a fit is worth: a copy of its tree with further groups.

    `problem` is the one that `fit` solved, `truth` is used for scoring only, `key` seeds replicas; the `answer` that
    `calibrate` returns with the tree saves finding the point of the fit again.

    - `datum_check`, `epoch_check`, `channel_check`, `sensor_check`, `target_check`: innovations, and their NIS (mean
      square a datum) with limits; whiteness; posterior predictive p-values; PSIS-LOO by row; by sensor and target
      the log predictive density `elpd` of what was left out, and its NIS given the rest.
    - `level_check`: the noise levels that the data ask for, and what the biases would move with them.
    - `halves`: what each bias alone would change from the first half of the recording to the second.
    - `sensitivity`: power scaling of prior and likelihood, where the tree holds both.
    - `verdict`: `verdict` and `reason` of every bias (rules in `probcal.analysis.verdict`); `finding`: sentences.

    Where the innovations reject the model (p below 0.001: their mean square, or their correlation in time) the sd,
    intervals, covariance and draws of the biases are widened by what they call for, and a finding says so.

    Limits have a false-alarm rate of 1 %: of one epoch in `epoch_check`, else of all comparisons of a kind together.
    Refits of large networks are one step from the fit (attribute `refits` of the group). Of a misfit nothing is left
    out and no halves are compared. A fit in sparse form is judged by its innovations, its halves, its noise levels, and
    by how much the data narrow each bias (`probcal.analysis.large`). Raises `InputError` where the tree is
    no fit of the problem.

    >>> checked = assess(problem, tree)
    >>> checked["verdict"]["verdict"].sel(bias_label="sonar_1.range_offset").item()
    'determined'
    """
    tree = unwidened(tree)  # what a fit made of its innovations is judged anew
    if tree.attrs.get("sparse", 0):
        with np.errstate(all="ignore" if _absurd(tree) else None):
            return assess_large(problem, tree, answer)
    fit = take_up(problem, tree, answer)
    with np.errstate(all="ignore" if _absurd(tree) else None):  # squares of absurd residuals overflow
        return _assessed(fit, tree, truth, as_key(key))


def _absurd(tree: xr.DataTree) -> bool:
    return bool(tree.attrs["status"] == "misfit")


def _assessed(fit: Fitted, tree: xr.DataTree, truth: Truth | None, key: jax.Array) -> xr.DataTree:
    keys = jax.random.split(key, 3)
    drawn = predictive.draws_of(fit, tree, keys[0])
    replicas = predictive.check_replicas(fit, drawn, keys[1])
    found = residuals.innovations(fit, replicas.kurtosis)
    groups: dict[str, xr.Dataset] = {"epoch_check": xr.Dataset()} | checks.by_epoch(fit, found.innovations)
    groups["datum_check"], findings = checks.by_datum(fit, found.innovations, tree)
    channels = residuals.channels_of(fit.data, found.innovations)
    groups["channel_check"], more = checks.by_channel(found.innovations, channels, replicas)
    findings += more
    for name in ("sensor", "target"):
        groups[f"{name}_check"], more = checks.squares_by(fit, found.innovations, name)
        findings += more
    findings += checks.outlying(fit, found.innovations)
    findings += checks.wrapping(fit, tree)
    findings += [] if _absurd(tree) else checks.left_out(fit, tree, groups) + process.check_process_noise(fit, keys[2])
    bent = None if tree.attrs["status"] in INVALID else shape.check_shape(fit, tree)
    findings += [] if bent is None else [bent]
    hanging, more = dict[int, str](), list[Finding]()
    if tree.attrs["status"] not in INVALID:
        asked, more, hanging = levels.check_levels(fit, tree)
        groups |= {} if asked is None else {"level_check": asked}
    groups["verdict"] = _verdicts(fit, tree, found, channels, groups, bent, hanging)
    if not (any(f.kind == "outliers" for f in findings) or (groups["verdict"]["verdict"] == "drifting").any()):
        findings += more  # else the levels are only a sign of these
    findings += mirror_findings(tree)
    columns = [groups["verdict"][name].values.tolist() for name in ("bias_label", "verdict", "reason")]
    findings += alarms(*columns)
    if tree.attrs["status"] in INVALID:
        # likely causes; the message of a misfit has its own
        findings = of_invalid(tree, findings, ("wrapping", "nis" if _absurd(tree) else "outliers"))
    scaled = scaling.power_scaling(tree) if leave.weighable(tree) else None
    if scaled is not None:
        groups["sensitivity"] = scaled
    if truth is not None:
        _score(fit, tree, drawn, truth, groups)
    rejected = rejection(fit, found.innovations, channels)
    result, text = widened(fit, rejected, tree, residuals.root_of(fit.covariance))
    return completed(result, text, groups, findings)


def _verdicts(
    fit: Fitted,
    tree: xr.DataTree,
    found: residuals.Filtered,
    channels: residuals.Channels,
    groups: dict[str, xr.Dataset],
    bent: Finding | None,
    hanging: dict[int, str],
) -> xr.Dataset:
    """Group `verdict`; adds the group `halves` where the recording can be divided."""
    problem, calibration = fit.problem, tree["calibration"].to_dataset()
    M, inflation, square = problem.model.biases, np.ones(problem.model.biases), np.zeros(problem.model.biases)
    drifts, disagreements, first = dict[int, str](), dict[int, str](), ""
    grid = _grid(problem)
    if grid.patterns and not _absurd(tree):
        divided = pieces.divide(fit, grid.piece, grid.pieces)
        wide = {name: _inflation(fit, found, channels, divided, grid, member) for name, member in grid.members.items()}
        inflation = wide.get("halves", inflation)
        if "halves" in grid.patterns:
            alone = pieces.contrasts(divided, grid.patterns["halves"])
            square[list(alone)] = [c.square / inflation[m] for m, c in alone.items()]
            if alone:
                groups["halves"] = _halves(problem, alone, inflation, grid.edges[len(grid.edges) // 2], limit_of(M))
        changes = pieces.changing(divided, grid.patterns, wide, partial(limit_of, M))
        shapes = pieces.contrasts(divided, grid.quarters) if changes and grid.quarters.shape[1] > 1 else {}
        if changes:
            first = problem.labels[changes[0].bias]
            hanging = hanging | _touched(fit, divided, changes, grid.patterns)
        for change in changes:
            if change.name == "halves":
                text = _drift(problem, change, inflation, limit_of(M))
                drifts[change.bias] = text + _shape(shapes.get(change.bias), grid.edges)
            else:
                disagreements[change.bias] = _disagreement(problem, change, limit_of(M, change.contrast.freedom))
    z, alpha, gamma = np.asarray(fit.point.z), np.asarray(fit.prior.alpha), calibration["gamma"].values
    known = verdict.Grounds(
        verdict.contraction(calibration["information"].values), square,
        verdict.pull(z, alpha, gamma, inflation), float(np.sqrt(limit_of(M))),
        verdict.explained_part(z, alpha, gamma, found.innovations.excess),
    )  # fmt: skip
    ended = calibration["status"].values.tolist()
    status = Status(tree.attrs["status"])
    doubts = (
        hanging if bent is None else dict.fromkeys(range(M), "the answer is far from Gaussian, so its interval is none")
    )

    def around() -> list[np.ndarray]:  # draws of chains lie on both sides
        return [np.asarray(variance) for variance in fit.at.variances(jnp.asarray(fit.covariance))]

    doubts |= mirror_doubts(fit, tree, around) | lag_doubts(fit, found)
    words, reasons = verdict.judge_biases(
        problem, status, ended, known, drifts, disagreements, first, _shared(tree), doubts
    )
    values = {"verdict": np.array(words, str), "reason": np.array(reasons, str), "contraction": known.contraction}
    values |= {"inflation": inflation}
    group = xr.Dataset({name: ("bias_label", value) for name, value in values.items()}, bias_coords(problem))
    group.attrs |= {"rate": RATE, "limit": known.limit}
    return group


def _touched(fit: Fitted, divided: Pieces, changes: list[Change], patterns: pieces.Patterns) -> dict[int, str]:
    """Why the answers of biases are in doubt that would move by more than `HANGS` sd if others may change."""
    free = [(change.bias, patterns[change.name]) for change in changes]
    moved = pieces.freed(divided, free) / np.sqrt(np.maximum(np.diag(fit.covariance), 1e-300))
    others = listed([fit.problem.labels[change.bias] for change in changes], 1)
    told = np.flatnonzero(np.abs(moved) > levels.HANGS).tolist()
    return {m: f"it would move by {abs(moved[m]):.1f} sd if {others} may change" for m in told}


def _shared(tree: xr.DataTree) -> dict[int, str]:
    """The combination that the data leave open, by name, that would put the answer of a bias far off.

    Where the truth lies c v along a combination v, an estimate under the declared scales, C = (G + I)^-1, is off by
    c C v. Named is what is off by more than `SHARED` sd once the largest part of c v is one scale: of M biases with a
    common part that no row tells, each is sqrt(M) sd off.
    """
    found = dict[int, str]()
    if "direction" not in tree.children:
        return found
    group = tree["direction"].to_dataset()
    information, vectors = group["information"].values, group["vector"].values
    known = tree["calibration"].to_dataset()["information"].values
    left = np.linalg.inv(known + np.eye(vectors.shape[1]))
    off = np.abs(vectors @ left) / np.sqrt(np.diag(left)) / np.abs(vectors).max(1, keepdims=True)
    off[information >= WEAK] = 0.0
    for m in np.flatnonzero(off.max(0, initial=0.0) > SHARED):
        k = int(off[:, m].argmax())
        found[int(m)] = f"{group['direction'].values[k]} (information {information[k]:.2g})"
    return found


class _Grid(NamedTuple):
    """The pieces of a recording, parts of its time by groups of targets, and what may differ between them."""

    piece: np.ndarray  # (rows,) of the table
    pieces: int
    edges: np.ndarray  # times at which the parts begin
    quarters: np.ndarray  # (pieces, parts - 1) which part
    patterns: pieces.Patterns  # halves (pieces, 1), targets (pieces, groups - 1)
    members: pieces.Patterns  # (pieces,) what has biases of its own while the noise behind a pattern is measured


def _grid(problem: Problem) -> _Grid:
    """Quarters of equal numbers of rows (halves where biases are many) by targets (in groups where they are many)."""
    M, time = problem.model.biases, problem.measurements.time
    edges = _edges(time[problem.measurements.measured.any(1)], QUARTERS if QUARTERS * M <= COPIES else 2)
    parts = len(edges)
    groups = _groups(problem, parts)
    part = np.searchsorted(edges[1:], time, side="right")
    piece = part * groups + problem.measurements.target % groups
    quarters, patterns, members = np.kron(np.eye(parts)[:, 1:], np.ones((groups, 1))), {}, {}
    if parts > 1:
        patterns["halves"] = np.repeat(2 * np.arange(parts) // parts, groups)[:, None].astype(float)
        members["halves"] = np.repeat(np.arange(parts), groups)
    if groups > 1:
        patterns["targets"] = np.kron(np.ones((parts, 1)), np.eye(groups)[:, 1:])
        members["targets"] = np.tile(np.arange(groups), parts)
    return _Grid(piece, parts * groups, edges, quarters, patterns, members)


def _groups(problem: Problem, parts: int) -> int:
    """Number of groups of targets: every target alone while the biases of all pieces are not too many."""
    return max(1, min(len(problem.measurements.target_names), COPIES // (parts * problem.model.biases)))


def _edges(time: np.ndarray, count: int) -> np.ndarray:
    """Times at which pieces of equal numbers of rows begin; fewer where there are hardly any times."""
    edges = np.quantile(time, np.arange(count) / count, method="inverted_cdf")
    if len(np.unique(edges)) == count and len(np.unique(time)) >= 2 * count:
        return edges
    return _edges(time, 2) if count > 2 else edges[:1]


def _inflation(
    fit: Fitted,
    found: residuals.Filtered,
    channels: residuals.Channels,
    divided: Pieces,
    grid: _Grid,
    member: np.ndarray,
) -> np.ndarray:
    """How much wider (M,) the variance of a change is than the model says: overdispersion and correlation in time.

    Both are measured on innovations from which the own biases of every `member` (pieces,) are taken (each quarter, or
    each target), so that a change does not hide itself: the mean square of a sensor's channel (at least 1) times how
    many of its innovations count as one. A bias has the mean of the channels that tell of it, by their information,
    and not less than the mean of all.
    """
    own, piece = pieces.own_biases(divided, member), grid.piece
    step = np.concatenate([own, np.zeros((len(own), 1))], 1)
    shift = [
        jnp.asarray(step[piece[index][:, None], np.asarray(bias)])
        for index, bias in zip(fit.problem.row_index, fit.problem.model.read, strict=True)
    ]
    freed = found.innovations._replace(value=residuals.moved_innovations(fit, found, shift))
    wide = residuals.scatter_of(fit.data, freed, channels.members)
    return residuals.inflation(fit, wide.size * wide.memory, channels.group)


def _drift(problem: Problem, change: Change, inflation: np.ndarray, limit: float) -> str:
    """Reason of a bias whose halves differ: by how much."""
    contrast = change.contrast
    sd = np.sqrt(inflation[change.bias] / contrast.information[0, 0])
    return pieces.changed(problem, change.bias, float(contrast.estimate[0]), float(sd), limit)


def _shape(shape: pieces.Contrast | None, edges: np.ndarray) -> str:
    """Whether quarters tell of a jump, and where, or of a drift."""
    if shape is None:
        return ""
    later = np.arange(1, len(edges))
    shapes = {f"it jumps at about {edges[k]:.4g} s": 1.0 * (later >= k) for k in later} | {"it drifts": 1.0 * later}
    return f"; {max(shapes, key=lambda name: shape.along(shapes[name]))}"


def _disagreement(problem: Problem, change: Change, limit: float) -> str:
    """Reason of a bias on which the targets disagree, with the one that is most out of line."""
    names, groups = problem.measurements.target_names, len(change.contrast.estimate) + 1
    alone = [change.contrast.along(unit[1:] - unit[0]) for unit in np.eye(groups)]
    odd = [name for k, name in enumerate(names) if k % groups == int(np.argmax(alone))]
    most = f"{names[0]} and {names[1]}" if len(names) == 2 else f"{listed(odd, 1)} most"
    found = f"chi-square {change.square:.1f} on {change.contrast.freedom}, limit {limit:.1f}"
    return f"the targets disagree, {most} ({found})"


def _halves(
    problem: Problem, contrast: dict[int, pieces.Contrast], inflation: np.ndarray, middle: float, limit: float
) -> xr.Dataset:
    """Group `halves`: second half less first of each bias alone, in its unit, corrected sd, and their ratio."""
    index = list(contrast)
    scale = problem.scales[index]
    change = np.array([contrast[m].estimate[0] for m in index]) * scale
    sd = np.sqrt(inflation[index] / np.array([contrast[m].information[0, 0] for m in index])) * scale
    group = xr.Dataset(
        {"change": ("bias_label", change), "sd": ("bias_label", sd), "t": ("bias_label", change / sd)},
        bias_coords(problem, index),
    )
    group.attrs |= {"time": float(middle), "limit": float(np.sqrt(limit)), "rate": RATE}
    return group


def _score(
    fit: Fitted, tree: xr.DataTree, drawn: predictive.FitDraws, truth: Truth, groups: dict[str, xr.Dataset]
) -> None:
    """Add NEES of positions by epoch to `epoch_check`, and those of all positions and biases to its attributes."""
    tracked = dict(each_target(tree))
    truth.check_targets(tracked)
    for r, epochs in enumerate(fit.problem.epochs):
        for target in (name for name in tracked if name in epochs.target):
            states = np.asarray(drawn.states[r])[:, epochs.target == target]
            found = nees.of_positions(target, tracked[target], states, truth, RATE)
            if found is not None:
                name = f"epoch_check/{node_of(target)}"
                check = groups[name].assign_coords(nees_time=tracked[target]["time"].values[found.known])
                groups[name] = check.assign(nees=("nees_time", found.value))
                groups[name].attrs |= {"nees": found.mean, "nees_lower": found.lower, "nees_upper": found.upper}
    biases = nees.of_biases(tree, truth, RATE)
    if biases is not None:
        names = ("nees_bias", "nees_bias_count", "nees_bias_lower", "nees_bias_upper")
        groups["epoch_check"].attrs |= dict(zip(names, biases, strict=True))
