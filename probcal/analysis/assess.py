"""`assess`: is the answer of a fit good? Innovations, predictive checks, left-out data, halves, and verdicts."""

from contextlib import suppress

import jax
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
    segments,
    shape,
    verdict,
)
from probcal.analysis.beside import lag_doubts, mirror_doubts, mirror_findings
from probcal.analysis.findings import Finding, alarms, completed, of_invalid
from probcal.analysis.pieces import Change, Contrast
from probcal.analysis.segments import Compared, Grid
from probcal.analysis.verdict import RATE
from probcal.gaussian.draws import many_data
from probcal.identifiability.directions import shared_in_blocks
from probcal.identifiability.remedies import WEAK
from probcal.inference import residuals
from probcal.inference.fitted import Judged, take_up
from probcal.inference.widen import Rejection, rejection, unwidened, widened
from probcal.labels import listed
from probcal.linalg import invert
from probcal.problem import Problem
from probcal.results.groups import bias_coords, node_of
from probcal.results.read import each_target
from probcal.simulate import Key, Truth, as_key
from probcal.status import INVALID, Status
from probcal.types import float64

SHARED = 1.8  # sd that an open combination of one scale may put a bias off; of four with a free common part, about 1.9


@float64
def assess(problem: Problem, tree: xr.DataTree, *, truth: Truth | None = None, key: Key = 0) -> xr.DataTree:
    """Say what a fit is worth: a copy of its tree with further groups.

    `problem` is the one that `fit` solved, `truth` is used for scoring only, `key` seeds replicas.

    - `datum_check`, `epoch_check`, `channel_check`, `sensor_check`, `target_check`: innovations, and their NIS (mean
      square a datum) with limits; whiteness; posterior predictive p-values; PSIS-LOO by row; by sensor and target
      the log predictive density `elpd` of what was left out, and its NIS given the rest.
    - `level_check`: the noise levels that the data ask for, and what the biases would move with them;
      `linearised` says for which levels of a large network that was worked out.
    - `halves`: what each bias alone would change from the first half of the recording to the second.
    - `sensitivity`: power scaling of prior and likelihood, where the tree holds both.
    - `verdict`: `verdict` and `reason` of every bias (rules in `probcal.analysis.verdict`); `finding`: sentences.

    Where the innovations reject the model (p below 0.001: their mean square, or their correlation in time) the sd,
    intervals, covariance and draws of the biases are widened by what they call for, and a finding says so.

    Limits have a false-alarm rate of 1 %: of one epoch in `epoch_check`, else of all comparisons of a kind together.
    Refits of large networks are one step from the fit (attribute `refits` of the group), and
    without matrices of all biases only the sensors and targets of the largest mean squares are left
    out (`sensor_left`, `target_left`). Of a misfit nothing is left out and no halves are compared;
    nor is anything that needs a factor of the biases where the fit has none. A large network of
    more than 500,000 data has no replicas. Raises `InputError` where the tree is no fit of the
    problem.

    >>> checked = assess(problem, tree)
    >>> checked["verdict"]["verdict"].sel(bias_label="sonar_1.range_offset").item()
    'determined'
    """
    tree = unwidened(tree)  # what a fit made of its innovations is judged anew
    fit = take_up(problem, tree)
    with np.errstate(all="ignore" if _absurd(tree) else None):  # squares of absurd residuals overflow
        return _assessed(fit, tree, truth, as_key(key))


def _absurd(tree: xr.DataTree) -> bool:
    return not Status(tree.attrs["status"]).explains


def _assessed(fit: Judged, tree: xr.DataTree, truth: Truth | None, key: jax.Array) -> xr.DataTree:
    keys = jax.random.split(key, 3)
    drawable = fit.engine.cheap or (fit.engine.exact and not many_data(fit.problem.model))
    drawn = predictive.draws_of(fit, tree, keys[0]) if drawable else None
    replicas = None if drawn is None else predictive.check_replicas(fit, drawn, keys[1])
    found = residuals.innovations(fit, residuals.measured_kurtosis(fit) if replicas is None else replicas.kurtosis)
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
    if not _absurd(tree) and fit.engine.exact:
        findings += checks.left_out(fit, tree, groups) + process.check_process_noise(fit, keys[2])
    bent = None if tree.attrs["status"] in INVALID else shape.check_shape(fit, tree)
    findings += [] if bent is None else [bent]
    doubts, more = dict[int, str](), list[Finding]()
    if tree.attrs["status"] not in INVALID and fit.engine.exact:
        with suppress(MemoryError):
            asked, more, doubts = levels.check_levels(fit, tree)
            groups |= {} if asked is None else {"level_check": asked}
    rejected = rejection(fit, found.innovations, channels)
    grid, compared = segments.grid_for(fit), None
    if grid.patterns and not _absurd(tree) and fit.engine.exact:
        compared = segments.compare_segments(fit, found, channels, grid)
    if compared is not None and compared.alone:
        groups["halves"] = segments.group_of(fit.problem, compared, grid)
    groups["verdict"] = _verdicts(fit, tree, found, rejected, compared, grid, bent, doubts)
    findings += [] if compared is None else _not_compared(compared.unsolved)
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
    result, text = widened(fit, rejected, tree, fit.root)
    return completed(result, text, groups, findings)


def _not_compared(count: int) -> list[Finding]:
    text = f"{count} more biases may have changed and were not compared: so many are rarely drifts of single biases"
    return [Finding("halves", "fit", text)] if count else []


def _verdicts(
    fit: Judged, tree: xr.DataTree, found: residuals.Filtered, rejected: Rejection, compared: Compared | None,
    grid: Grid, bent: Finding | None, doubts: dict[int, str],
) -> xr.Dataset:  # fmt: skip
    """Group `verdict`."""
    problem, calibration = fit.problem, tree["calibration"].to_dataset()
    M, limit = problem.model.biases, verdict.limit_of(problem.model.biases)
    square, drifts, disagreements, first = np.zeros(M), dict[int, str](), dict[int, str](), ""
    inflation = np.ones(M) if fit.engine.cheap else rejected.inflation
    if compared is not None:
        inflation = compared.inflation
        square[list(compared.alone)] = [c.square / inflation[m] for m, c in compared.alone.items()]
        if compared.changes:
            first = problem.labels[compared.changes[0].bias]
            doubts = doubts | _touched(fit, compared)
        for change in compared.changes:
            if change.name == "halves":
                text = _drift(problem, change, inflation, limit)
                drifts[change.bias] = text + _shape(compared.shapes.get(change.bias), grid.edges)
            else:
                freedom = verdict.limit_of(M, change.contrast.freedom)
                disagreements[change.bias] = _disagreement(problem, change, freedom)
    z, alpha, gamma = np.asarray(fit.point.z), calibration["precision"].values, calibration["gamma"].values
    contraction, shared = _told(fit, tree)
    known = verdict.Grounds(
        contraction, square, verdict.pull(z, alpha, gamma, inflation), float(np.sqrt(limit)),
        verdict.explained_part(z, alpha, gamma, found.innovations.excess),
    )  # fmt: skip
    ended = calibration["status"].values.tolist()
    status = Status(tree.attrs["status"])
    if bent is not None:
        doubts = dict.fromkeys(range(M), "the answer is far from Gaussian: its interval is not valid")

    def around() -> list[np.ndarray]:  # draws of chains lie on both sides
        return fit.expansion.followed(fit.root)

    doubts |= mirror_doubts(fit, tree, around if fit.whole else None) | lag_doubts(fit, found)
    words, reasons = verdict.judge_biases(problem, status, ended, known, drifts, disagreements, first, shared, doubts)
    values = {"verdict": np.array(words, str), "reason": np.array(reasons, str), "contraction": known.contraction}
    values |= {"inflation": inflation}
    group = xr.Dataset({name: ("bias_label", value) for name, value in values.items()}, bias_coords(problem))
    group.attrs |= {"rate": RATE, "limit": known.limit}
    return group


def _touched(fit: Judged, compared: Compared) -> dict[int, str]:
    """Why the answers of biases are in doubt that would move by more than `HANGS` sd if others may change."""
    moved = compared.moved / np.maximum(fit.sd, 1e-150)
    others = listed([fit.problem.labels[change.bias] for change in compared.changes], 1)
    told = np.flatnonzero(np.abs(moved) > levels.HANGS).tolist()
    return {m: f"it would move by {abs(moved[m]):.1f} sd if {others} may change" for m in told}


def _told(fit: Judged, tree: xr.DataTree) -> tuple[np.ndarray, dict[int, str]]:
    """Contraction (M,) of each bias, and the open combinations that would put some far off."""
    declared = fit.declared(tree)
    if declared is None:
        return verdict.contraction(tree["calibration"].to_dataset()["information"].values), _shared(tree)
    shared = shared_in_blocks(fit.problem, fit.point, declared.members, declared.covariance, SHARED)
    return np.clip(1.0 - declared.variance, 0.0, 1.0), shared


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
    left = invert(known + np.eye(vectors.shape[1]))
    off = np.abs(vectors @ left) / np.sqrt(np.diag(left)) / np.abs(vectors).max(1, keepdims=True)
    off[information >= WEAK] = 0.0
    for m in np.flatnonzero(off.max(0, initial=0.0) > SHARED):
        k = int(off[:, m].argmax())
        found[int(m)] = f"{group['direction'].values[k]} (information {information[k]:.2g})"
    return found


def _drift(problem: Problem, change: Change, inflation: np.ndarray, limit: float) -> str:
    """Reason of a bias whose halves differ: by how much."""
    contrast = change.contrast
    sd = np.sqrt(inflation[change.bias] / contrast.information[0, 0])
    return pieces.changed(problem, change.bias, float(contrast.estimate[0]), float(sd), limit)


def _shape(shape: Contrast | None, edges: np.ndarray) -> str:
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


def _score(
    fit: Judged, tree: xr.DataTree, drawn: predictive.FitDraws | None, truth: Truth, groups: dict[str, xr.Dataset]
) -> None:
    """Add NEES of positions by epoch to `epoch_check`, and those of all positions and biases to its attributes.

    Positions are judged by draws of their tracks, where there are some.
    """
    tracked = dict(each_target(tree))
    truth.check_targets(tracked)
    for r, draws in enumerate(() if drawn is None else drawn.states):
        epochs = fit.problem.epochs[r]
        for target in (name for name in tracked if name in epochs.target):
            states = np.asarray(draws)[:, epochs.target == target]
            found = nees.of_positions(target, tracked[target], states, truth, RATE)
            if found is not None:
                name = f"epoch_check/{node_of(target)}"
                check = groups[name].assign_coords(nees_time=tracked[target]["time"].values[found.known])
                groups[name] = check.assign(nees=("nees_time", found.value))
                groups[name].attrs |= {"nees": found.mean, "nees_lower": found.lower, "nees_upper": found.upper}
    biases = nees.of_biases(tree, truth, RATE) if fit.whole else nees.of_all_biases(fit, truth, RATE)
    if biases is not None:
        names = ("nees_bias", "nees_bias_count", "nees_bias_lower", "nees_bias_upper")
        groups["epoch_check"].attrs |= dict(zip(names, biases, strict=True))
