"""`assess` of a fit in sparse form: innovations and verdicts, by nothing of size (M, M).

Innovations are those of any fit. The degrees of freedom that the biases used, the sum of gamma, are shared among the
data by what each tells of the biases of its sensor. Halves of the recording are compared by one factor more
(`halves`), but for fits without one. Left out are refits without a sensor or a target, replicas, and the shape of the
posterior.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from probcal.analysis import checks, pieces, predictive, residuals, verdict
from probcal.analysis.beside import mirror_doubts, mirror_findings
from probcal.analysis.findings import Finding, in_order
from probcal.analysis.fitted import Judged, identified, point_of
from probcal.analysis.halves import SAMPLED, Divided, Halves, drifts_of
from probcal.analysis.widen import rejection, widened
from probcal.identifiability.directions import shared_in_blocks
from probcal.inference.sparse import SparsePosterior, declared_blocks
from probcal.problem import Problem
from probcal.results.answer import Answer
from probcal.results.blocks import SensorBlocks
from probcal.results.groups import bias_coords
from probcal.smoothing import cholesky
from probcal.smoothing.joint import JointPrecision
from probcal.smoothing.sparse_mode import SparseSystem, system_at
from probcal.status import INVALID, Status

SHARED = 1.8  # sd that an open combination of one scale may put a bias off
DRAWS = 20  # of data about the fit, from which the kurtosis of noise that is not Gaussian is taken


@dataclass(frozen=True, eq=False)
class JudgedLarge(Judged):
    """A fit in sparse form taken up again."""

    system: SparseSystem
    blocks: SensorBlocks  # of the covariance of z
    declared: SensorBlocks  # what a prior of the declared scales leaves


def assess_large(problem: Problem, tree: xr.DataTree, answer: Answer | None) -> xr.DataTree:
    """A copy of the tree of a fit in sparse form with what its innovations say and a verdict a bias.

    Groups as of `assess`: `datum_check`, `epoch_check`, `channel_check`, `sensor_check`, `target_check`, `verdict`,
    `finding`. Raises `InputError` where the tree is no fit of the problem.
    """
    fit = _taken_up(problem, tree, answer)
    found = _innovations(fit, tree["calibration"].to_dataset()["gamma"].values)
    groups: dict[str, xr.Dataset] = {"epoch_check": xr.Dataset()} | checks.by_epoch(fit, found)
    groups["datum_check"], findings = checks.by_datum(fit, found, tree)
    groups["channel_check"], more = checks.by_channel(fit, found, None)
    findings += more
    for name in ("sensor", "target"):
        groups[f"{name}_check"], more = checks.squares_by(fit, found, name)
        findings += more
    findings += checks.outlying(fit, found)
    residual = tree["residual"].to_dataset()
    turned = residuals.wrapping(fit, residual["after"].values, residual["std"].values)
    findings += [Finding("wrapping", *pair) for pair in turned]
    groups["verdict"] = _verdicts(fit, tree, _inflation(fit, found), found.excess, groups)
    if "halves" in groups and (unsolved := groups["halves"].attrs["unsolved"]):
        text = f"{unsolved} more biases may differ between the halves than were looked at: so many are no drift of one"
        findings.append(Finding("halves", "fit", text))
    findings += mirror_findings(tree)
    if tree.attrs["status"] in INVALID:
        text = (
            f"the fit ended {tree.attrs['status']}, which is no answer: what is left of the data says nothing of them"
        )
        findings = [Finding("status", "fit", text), *(f for f in findings if f.kind in ("wrapping", "nis"))]
    reason = rejection(found, groups["channel_check"])
    result, widening = widened(tree, groups["verdict"]["inflation"].values, reason)
    findings = in_order(findings + widening)
    texts = {name: ("finding", np.array([getattr(f, name) for f in findings], str)) for name in Finding._fields}
    groups["finding"] = xr.Dataset(texts)
    for name, group in groups.items():
        result[name] = xr.DataTree(group)
    return result


def _taken_up(problem: Problem, tree: xr.DataTree, answer: Answer | None) -> JudgedLarge:
    problem, data, picks = identified(problem, tree, answer)
    posterior = None if answer is None else answer.posterior
    point = point_of(problem, tree) if posterior is None else posterior.point
    system = system_at(problem.model, JointPrecision.of(problem.model), point)
    told = tree["calibration"].to_dataset()
    if isinstance(posterior, SparsePosterior):
        declared = posterior.declared
    elif "sd_error" in told:  # no factor was made, or none that has exact variances
        apart = 1.0 - told["contraction"].values
        declared = SensorBlocks(len(apart), np.arange(len(apart))[:, None], apart[:, None, None])
    else:
        declared = declared_blocks(problem, system)
    blocks = SensorBlocks.read(told, problem.labels, problem.scales)
    return JudgedLarge(problem, system.point, system.rows, system.solved, picks, data, system, blocks, declared)


def _innovations(
    fit: JudgedLarge, gamma: np.ndarray, shift: list[np.ndarray] | None = None
) -> residuals.Innovations:  # fmt: skip
    """Innovations of all data with the biases at their means, or shifted (N, p) from row to row."""
    moved = [jnp.zeros((lin.bias.shape[0], lin.bias.shape[2])) for lin in fit.lins]
    moved = moved if shift is None else [jnp.asarray(own) for own in shift]
    filters = residuals.prepare(fit.solved)
    found = residuals.innovations_at(fit.problem.model, fit.point, fit.lins, filters, moved)
    value, kept = (fit.flat(parts) for parts in zip(*found, strict=True))
    told = np.maximum(fit.flat(_told(fit)), 0.0)
    used = np.minimum(told * (gamma.sum() / max(told.sum(), 1e-300)), 0.9)
    return residuals.Innovations(value, used, _kurtosis(fit) * kept**4, residuals.expected_squares(fit, kept))


def _told(fit: JudgedLarge) -> list[np.ndarray]:
    """Variance of each predicted value (N, C) of each block by the biases of its sensor, over that of its noise."""
    M = fit.problem.model.biases
    own, place = (np.append(values, 0) for values in fit.blocks.located())
    found = []
    for read, lin in zip(fit.problem.model.read, fit.lins, strict=True):
        bias = np.asarray(read)
        block, at = own[bias], place[bias]
        same = (block[:, :, None] == block[:, None, :]) & (bias < M)[:, :, None] & (bias < M)[:, None, :]
        matrix = np.where(same, fit.blocks.covariance[block[:, :, None], at[:, :, None], at[:, None, :]], 0.0)
        along = np.asarray(lin.bias)
        found.append(np.asarray(lin.weight) * np.einsum("ncp,npq,ncq->nc", along, matrix, along))
    return found


def _kurtosis(fit: JudgedLarge) -> np.ndarray:
    """Excess kurtosis (D,) of what is standardised."""
    if predictive.all_gaussian(fit.problem.model):
        return np.zeros(len(fit.data))

    def again(values: jax.Array) -> jax.Array:
        return jnp.broadcast_to(values, (DRAWS, *values.shape))

    point = fit.point
    drawn = predictive.FitDraws(again(point.z), again(point.levels), tuple(again(x) for x in point.states), None)
    return predictive.check_replicas(fit, drawn, jax.random.key(0)).kurtosis


def _inflation(fit: JudgedLarge, found: residuals.Innovations) -> np.ndarray:
    """How much wider (M,) the variance of a bias is than the model says: overdispersion and correlation in time.

    The mean of the channels that tell of it, by their information, and not less than the mean of all.
    """
    group, _ = checks.codes(fit.data, ["sensor", "channel"])
    counts = np.bincount(group)
    members = np.split(np.argsort(group, kind="stable"), np.cumsum(counts)[:-1])
    target, time = fit.data["target"].to_numpy(str), fit.data["time"].to_numpy()
    wide = np.array(
        [
            max(found.spread(mine), 1.0) * residuals.memory(found.value[mine], target[mine], time[mine])
            for mine in members
        ]
    )
    M, start = fit.problem.model.biases, 0
    told, weighed = np.zeros(M + 1), np.zeros(M + 1)
    for read, lin, (row, channel) in zip(fit.problem.model.read, fit.lins, fit.picks, strict=True):
        own = (np.asarray(lin.weight)[:, :, None] * np.asarray(lin.bias) ** 2)[row, channel]  # (data, p)
        bias, scatter = np.asarray(read)[row].ravel(), wide[group[start : start + len(row)]][:, None]
        told += np.bincount(bias, own.ravel(), M + 1)
        weighed += np.bincount(bias, (own * scatter).ravel(), M + 1)
        start += len(row)
    return np.maximum(weighed[:M] / np.maximum(told[:M], 1e-300), np.average(wide, weights=counts))


def _middle(problem: Problem) -> float | None:
    """The time that parts the rows of a recording in halves; None where there is one half only."""
    data = problem.measurements
    measured = np.sort(data.time[data.measured.any(1)])
    middle = float(measured[len(measured) // 2])
    return middle if middle > measured[0] else None


def _compared(
    problem: Problem, found: Halves, middle: float, inflation: np.ndarray
) -> tuple[xr.Dataset, np.ndarray, dict[int, str], str]:
    """Group `halves`, chi-squares (M,), the reasons of the biases that drift, and the label of the first of these."""
    M = problem.model.biases
    limit, told = verdict.limit_of(M), np.flatnonzero(found.information > 0)
    scale = problem.scales[told]
    change = found.estimate[told] * scale
    sd = np.sqrt(inflation[told] / found.information[told]) * scale
    values = {"change": change, "sd": sd, "t": change / sd, "solved": np.isin(told, found.solved)}
    group = xr.Dataset({name: ("bias_label", own) for name, own in values.items()}, bias_coords(problem, told.tolist()))
    group.attrs |= {"time": middle, "limit": float(np.sqrt(limit)), "rate": verdict.RATE}
    group.attrs |= {"draws": SAMPLED, "unsolved": found.unsolved}
    changes = drifts_of(found, inflation, limit)
    drifts = {
        one.bias: pieces.changed(
            problem, one.bias, one.estimate, np.sqrt(inflation[one.bias] / one.information), limit
        )
        for one in changes
    }  # fmt: skip
    square = np.zeros(M)
    square[found.solved] = (found.square / inflation)[found.solved]  # what the strongest may explain
    return group, square, drifts, problem.labels[changes[0].bias] if changes else ""


def _verdicts(
    fit: JudgedLarge, tree: xr.DataTree, inflation: np.ndarray, excess: float, groups: dict[str, xr.Dataset]
) -> xr.Dataset:
    """Group `verdict`; adds the group `halves` where the recording can be divided."""
    problem, group = fit.problem, tree["calibration"].to_dataset()
    M, z = problem.model.biases, np.asarray(fit.point.z)
    alpha, gamma = group["precision"].values, group["gamma"].values
    square, drifts, first = np.zeros(M), dict[int, str](), ""
    without = "log_evidence_error" in tree.attrs or ("sd_error" in group and cholesky.exact())  # a factor of the biases
    middle = _middle(problem)
    if tree.attrs["status"] not in INVALID and not without and middle is not None:
        late = [problem.measurements.time[index] >= middle for index in problem.row_index]
        with suppress(MemoryError, np.linalg.LinAlgError):  # no room for a factor: no halves
            halves = Divided(problem.model, fit.system, alpha, late)
            own = _inflation(fit, _innovations(fit, gamma, halves.own_shift()))  # a change does not hide itself
            compared = halves.compare(own, verdict.limit_of(M))
            groups["halves"], square, drifts, first = _compared(problem, compared, middle, own)
            inflation = own
    known = verdict.Grounds(
        np.clip(1.0 - fit.declared.variance, 0.0, 1.0), square, verdict.pull(z, alpha, gamma, inflation),
        float(np.sqrt(verdict.limit_of(M))), verdict.explained_part(z, alpha, gamma, excess),
    )  # fmt: skip
    shared = shared_in_blocks(problem, fit.point, fit.declared.members, fit.declared.covariance, SHARED)
    ended, doubts = group["status"].values.tolist(), mirror_doubts(fit, tree)
    words, reasons = verdict.judge_biases(
        problem, Status(tree.attrs["status"]), ended, known, drifts, {}, first, shared, doubts
    )
    values = {"verdict": np.array(words, str), "reason": np.array(reasons, str), "contraction": known.contraction}
    values |= {"inflation": inflation}
    found = xr.Dataset({name: ("bias_label", value) for name, value in values.items()}, bias_coords(problem))
    found.attrs |= {"rate": verdict.RATE, "limit": known.limit}
    return found
