"""`assess`: is the answer of a fit good? Innovations, predictive checks, left-out data, halves, and verdicts."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import xarray as xr

from probcal.analysis import checks, nees, pieces, predictive, residuals, sensitivity, verdict
from probcal.analysis.checks import Finding
from probcal.analysis.fitted import Fitted, take_up
from probcal.analysis.pieces import Change, Pieces
from probcal.analysis.verdict import RATE, limit_of
from probcal.problem import Problem
from probcal.simulate import Key, Truth, as_key
from probcal.tree import suffix
from probcal.types import float64

QUARTERS = 4
COPIES = 2000  # most biases of all pieces together
SURE = 3.0  # sd beyond which a correlation of innovations widens the limits


@float64
def assess(problem: Problem, tree: xr.DataTree, *, truth: Truth | None = None, key: Key = 0) -> xr.DataTree:
    """Say what a fit is worth: a copy of its tree with further groups.

    `problem` is the one that `fit` solved, `truth` is used for scoring only, `key` seeds replicas.

    - `datum_check`, `epoch_check`, `channel_check`, `sensor_check`, `target_check`: innovations, and their NIS (mean
      square a datum) with limits; whiteness; posterior predictive p-values; PSIS-LOO by row; by sensor and target
      the log predictive density `elpd` of what was left out, and its NIS given the rest.
    - `halves`: what each bias alone would change from the first half of the recording to the second.
    - `sensitivity`: power scaling of prior and likelihood, where the tree holds both.
    - `verdict`: `verdict` and `reason` of every bias (rules in `probcal.analysis.verdict`); `finding`: sentences.

    Limits have a false-alarm rate of 1 %: of one epoch in `epoch_check`, else of all comparisons of a kind together.
    Refits of large networks are one step from the fit (attribute `refits` of the group). Raises `InputError` where
    the tree is no fit of the problem.
    """
    fit = take_up(problem, tree)
    replicas = predictive.check(fit, tree, as_key(key))
    found = residuals.innovations(fit, replicas.kurtosis)
    groups: dict[str, xr.Dataset] = {"epoch_check": checks.by_epoch(fit, found.innovations)}
    groups["datum_check"], findings = checks.by_datum(fit, found.innovations, tree)
    groups["channel_check"], more = checks.by_channel(fit, found.innovations, replicas)
    findings += more
    for name in ("sensor", "target"):
        groups[f"{name}_check"], more = checks.squares_by(fit, found.innovations, name)
        findings += more
    residual = tree["residual"].to_dataset()
    findings += [
        Finding("wrapping", *pair) for pair in residuals.wrapping(fit, residual["after"].values, residual["std"].values)
    ]
    findings += checks.left_out(fit, tree, groups)
    groups["verdict"] = _verdicts(fit, tree, found, groups)
    columns = [groups["verdict"][name].values.tolist() for name in ("verdict", "bias_label", "reason")]
    alarms = [row for row in zip(*columns, strict=True) if row[0] in ("drifting", "conflicting")]
    findings += [Finding(word, label, f"{label}: {reason}") for word, label, reason in alarms]
    scaled = sensitivity.power_scaling(tree)
    if scaled is not None:
        groups["sensitivity"] = scaled
    if truth is not None:
        _score(fit, tree, truth, groups)
    texts = {name: ("finding", np.array([getattr(f, name) for f in findings], str)) for name in Finding._fields}
    groups["finding"] = xr.Dataset(texts)
    result = tree.copy()
    for name, group in groups.items():
        result[name] = xr.DataTree(group)
    return result


def _verdicts(fit: Fitted, tree: xr.DataTree, found: residuals.Filtered, groups: dict[str, xr.Dataset]) -> xr.Dataset:
    """Group `verdict`; adds the group `halves` where the recording can be divided."""
    problem, calibration = fit.problem, tree["calibration"].to_dataset()
    M, inflation, square = problem.spec.biases, np.ones(problem.spec.biases), np.zeros(problem.spec.biases)
    drifts, disagreements = list[tuple[Change, str]](), list[tuple[Change, str]]()
    edges = _edges(problem, QUARTERS if QUARTERS * M <= COPIES else 2)
    if len(edges) > 1:
        piece = np.searchsorted(edges[1:], problem.measurements.time, side="right")
        quarters = pieces.divide(fit, piece, len(edges))
        inflation = _inflation(fit, found, quarters, piece)
        into = [2 * p // len(edges) for p in range(len(edges))]
        halves = pieces.merged(quarters, into)
        contrast = pieces.contrasts(halves)
        square[list(contrast)] = [c.square / inflation[m] for m, c in contrast.items()]
        limit = limit_of(len(contrast))
        if contrast:
            groups["halves"] = _halves(problem, contrast, inflation, edges[into.index(1)], limit)
        shapes = pieces.contrasts(quarters)
        for change in pieces.changing(halves, inflation, limit):
            drifts.append((change, _drift(problem, change, inflation, limit, shapes.get(change.bias), edges)))
    names = problem.measurements.target_names
    if len(names) > 1:
        count = min(len(names), max(2, COPIES // M))
        passes = pieces.divide(fit, problem.measurements.target % count, count)
        limit = limit_of(M, count - 1)
        for change in pieces.changing(passes, inflation, limit):
            disagreements.append((change, _disagreement(change, inflation, limit, names, count)))
    z, alpha = np.asarray(fit.point.z), np.asarray(fit.prior.alpha)
    known = verdict.Evidence(
        verdict.contraction(calibration["information"].values), square,
        verdict.pull(z, alpha, calibration["gamma"].values, inflation), float(np.sqrt(limit_of(M))),
    )  # fmt: skip
    pruned = calibration["status"].values == "pruned"
    words, reasons = verdict.judge(problem, str(tree.attrs["status"]), pruned, known, drifts, disagreements)
    values = {"verdict": np.array(words, str), "reason": np.array(reasons, str), "contraction": known.contraction}
    values |= {"inflation": inflation}
    labels = {"bias_label": list(problem.labels)}
    group = xr.Dataset({name: ("bias_label", value) for name, value in values.items()}, labels)
    group.attrs |= {"rate": RATE, "limit": known.limit}
    return group


def _edges(problem: Problem, count: int) -> np.ndarray:
    """Times at which pieces of equal numbers of rows begin, as many as the recording has times for."""
    time = problem.measurements.time[problem.measurements.measured.any(1)]
    edges = np.quantile(time, np.arange(count) / count, method="inverted_cdf")
    distinct = len(np.unique(edges)) == count and len(np.unique(time)) >= 2 * count
    return edges if distinct else _edges(problem, 2) if count > 2 else edges[:1]


def _inflation(fit: Fitted, found: residuals.Filtered, quarters: Pieces, piece: np.ndarray) -> np.ndarray:
    """How much wider (M,) the variance of a change is than the model says: overdispersion and correlation in time.

    Both are measured on innovations from which each quarter's own biases are taken, so that a change does not hide
    itself: the mean square of the sensors that read a bias (not below that of all), times (1 + r) / (1 - r), r their
    correlation from one datum to the next.
    """
    step = np.concatenate([pieces.own_biases(quarters), np.zeros((int(piece.max()) + 1, 1))], 1)
    shift = [
        jnp.asarray(step[piece[index][:, None], np.asarray(data.bias)[np.asarray(data.sensor)]])
        for index, data in zip(fit.problem.row_index, fit.problem.system.rows, strict=True)
    ]
    value = residuals.moved_innovations(fit, found, shift)
    group, labels = checks.codes(fit.data, ["sensor", "channel"])
    data = np.bincount(group)
    wide = np.maximum(np.bincount(group, value**2) / data, 1.0)
    target, time = fit.data["target"].to_numpy(str), fit.data["time"].to_numpy()
    for k in range(len(labels)):
        white = residuals.whiteness(value[group == k], target[group == k], time[group == k])
        if white is not None and white.autocorrelation > SURE / np.sqrt(data[k]):
            r = min(white.autocorrelation, 0.95)
            wide[k] *= (1 + r) / (1 - r)
    names = [placed.name for placed in fit.problem.network.sensors]
    weights = data * fit.readers[[names.index(name) for name in labels["sensor"]]].T  # (M, parts)
    own = weights @ wide / np.maximum(weights.sum(1), 1)
    return np.maximum(own, np.average(wide, weights=data))


class _Text(NamedTuple):
    """Numbers of a change in the unit of its bias."""

    change: float
    sd: float
    unit: str


def _in_units(problem: Problem, change: Change, inflation: np.ndarray) -> _Text:
    bias, contrast = problem.biases[change.bias], change.contrast
    sd = np.sqrt(inflation[change.bias] / contrast.information[0, 0])
    return _Text(contrast.estimate[0] * bias.scale, sd * bias.scale, f" {bias.unit}" if bias.unit != "1" else "")


def _drift(problem: Problem, change: Change, inflation: np.ndarray, limit: float, shape: Any, edges: np.ndarray) -> str:
    """Reason of a bias whose halves differ: by how much, and whether it jumps or drifts."""
    text = _in_units(problem, change, inflation)
    reason = (
        f"second half less first {text.change:.3g} \N{PLUS-MINUS SIGN} {text.sd:.2g}{text.unit} "
        f"({np.sqrt(change.square):.1f} sd, limit {np.sqrt(limit):.1f})"
    )
    if shape is None or len(edges) < QUARTERS:
        return reason
    patterns = {f"it jumps at about {t:.4g} s": 1.0 * (np.arange(len(edges)) > k) for k, t in enumerate(edges[1:])}
    patterns["it drifts"] = np.arange(len(edges)) / len(edges)
    return f"{reason}; {max(patterns, key=lambda name: shape.along(patterns[name]))}"


def _disagreement(change: Change, inflation: np.ndarray, limit: float, names: tuple[str, ...], count: int) -> str:
    """Reason of a bias on which the targets disagree, with the one that is most out of line."""
    alone = [change.contrast.along(unit) for unit in np.eye(count)]
    odd = [name for k, name in enumerate(names) if k % count == int(np.argmax(alone))]
    listed = odd[0] if len(odd) == 1 else f"{odd[0]} and {len(odd) - 1} more"
    return f"the targets disagree, {listed} most (chi-square {change.square:.1f} on {count - 1}, limit {limit:.1f})"


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
        {"bias_label": [problem.labels[m] for m in index]},
    )
    group.attrs |= {"time": float(middle), "limit": float(np.sqrt(limit)), "rate": RATE}
    return group


def _score(fit: Fitted, tree: xr.DataTree, truth: Truth, groups: dict[str, xr.Dataset]) -> None:
    """Add NEES of positions by epoch to `epoch_check`, and those of all positions and biases to its attributes."""
    check = groups["epoch_check"]
    for r in range(len(fit.problem.epochs)):
        s = suffix(fit.problem, r)
        found = nees.of_positions(tree, truth, s, RATE)
        if found is not None:
            track = tree["track"].to_dataset()
            coords = {
                f"nees_time{s}": (f"nees_epoch{s}", track[f"epoch_time{s}"].values[found.known]),
                f"nees_target{s}": (f"nees_epoch{s}", track[f"epoch_target{s}"].values[found.known]),
            }
            check = check.assign_coords(coords).assign({f"nees{s}": (f"nees_epoch{s}", found.value)})
            check.attrs |= {f"nees{s}": found.mean, f"nees_lower{s}": found.lower, f"nees_upper{s}": found.upper}
    biases = nees.of_biases(tree, truth, RATE)
    if biases is not None:
        check.attrs |= dict(
            zip(("nees_bias", "nees_bias_count", "nees_bias_lower", "nees_bias_upper"), biases, strict=True)
        )
    groups["epoch_check"] = check
