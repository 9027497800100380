"""`assess` of a fit in sparse form: innovations and verdicts, by nothing of size (M, M).

Innovations are those of any fit. The degrees of freedom that the biases used, the sum of gamma, are shared among the
data by what each tells of the biases of its sensor. Halves of the recording are compared by one factor more
(`halves`), but for fits without one. Left out are refits without a sensor or a target, replicas, and the shape of the
posterior.
"""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import xarray as xr

from probcal.analysis import checks, levels, pieces, verdict
from probcal.analysis.beside import mirror_doubts, mirror_findings
from probcal.analysis.findings import Finding, completed, of_invalid
from probcal.analysis.halves import SAMPLED, Divided, Halves, drifts_of
from probcal.gaussian import cholesky
from probcal.identifiability.directions import shared_in_blocks
from probcal.inference import residuals
from probcal.inference.blockwise import BlockPosterior, declared_blocks
from probcal.inference.fitted import JudgedLarge, take_up_large
from probcal.inference.widen import Rejection, rejection, widened
from probcal.problem import Problem
from probcal.results.answer import Answer
from probcal.results.blocks import SensorBlocks
from probcal.results.groups import bias_coords
from probcal.status import INVALID, Status

SHARED = 1.8  # sd that an open combination of one scale may put a bias off


def assess_large(problem: Problem, tree: xr.DataTree, answer: Answer | None) -> xr.DataTree:
    """A copy of the tree of a fit in sparse form with what its innovations say and a verdict a bias.

    Groups as of `assess`: `datum_check`, `epoch_check`, `channel_check`, `sensor_check`, `target_check`, `level_check`,
    `verdict`, `finding`. Raises `InputError` where the tree is no fit of the problem.
    """
    fit = take_up_large(problem, tree, answer)
    found = residuals.innovations_large(fit, tree["calibration"].to_dataset()["gamma"].values)
    channels = residuals.channels_of(fit.data, found)
    groups: dict[str, xr.Dataset] = {"epoch_check": xr.Dataset()} | checks.by_epoch(fit, found)
    groups["datum_check"], findings = checks.by_datum(fit, found, tree)
    groups["channel_check"], more = checks.by_channel(found, channels, None)
    findings += more
    for name in ("sensor", "target"):
        groups[f"{name}_check"], more = checks.squares_by(fit, found, name)
        findings += more
    findings += checks.outlying(fit, found)
    findings += checks.wrapping(fit, tree)
    rejected, declared = rejection(fit, found, channels), _declared(fit, tree, answer)
    doubts, levelled = dict[int, str](), list[Finding]()
    if tree.attrs["status"] not in INVALID and cholesky.exact() and "sd_error" not in tree["calibration"]:
        with suppress(MemoryError):
            asked, levelled, doubts = levels.check_levels(fit, tree)
            groups |= {} if asked is None else {"level_check": asked}
    groups["verdict"] = _verdicts(fit, tree, rejected, declared, found.excess, groups, doubts)
    if not (any(f.kind == "outliers" for f in findings) or (groups["verdict"]["verdict"] == "drifting").any()):
        findings += levelled  # else the levels are only a sign of these
    if "halves" in groups and (unsolved := groups["halves"].attrs["unsolved"]):
        text = f"{unsolved} more biases may differ between the halves than were looked at: so many are no drift of one"
        findings.append(Finding("halves", "fit", text))
    findings += mirror_findings(tree)
    if tree.attrs["status"] in INVALID:
        findings = of_invalid(tree, findings, ("wrapping", "nis"))
    result, text = widened(fit, rejected, tree, fit.blocks.root())
    return completed(result, text, groups, findings)


def _declared(fit: JudgedLarge, tree: xr.DataTree, answer: Answer | None) -> SensorBlocks:
    """Covariance of z by sensor that a prior of the declared scales leaves."""
    if answer is not None and isinstance(answer.posterior, BlockPosterior):
        return answer.posterior.declared
    told = tree["calibration"].to_dataset()
    if "sd_error" in told:  # no factor was made, or none that has exact variances
        apart = 1.0 - told["contraction"].values
        return SensorBlocks(len(apart), np.arange(len(apart))[:, None], apart[:, None, None])
    return declared_blocks(fit.at)


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
    fit: JudgedLarge,
    tree: xr.DataTree,
    rejected: Rejection,
    declared: SensorBlocks,
    excess: float,
    groups: dict[str, xr.Dataset],
    doubts: dict[int, str],
) -> xr.Dataset:
    """Group `verdict`; adds the group `halves` where the recording can be divided."""
    problem, group = fit.problem, tree["calibration"].to_dataset()
    M, z = problem.model.biases, np.asarray(fit.point.z)
    alpha, gamma = group["precision"].values, group["gamma"].values
    square, drifts, first, inflation = np.zeros(M), dict[int, str](), "", rejected.inflation
    without = "log_evidence_error" in tree.attrs or ("sd_error" in group and cholesky.exact())  # a factor of the biases
    middle = _middle(problem)
    if tree.attrs["status"] not in INVALID and not without and middle is not None:
        late = [problem.measurements.time[index] >= middle for index in problem.row_index]
        with suppress(MemoryError, np.linalg.LinAlgError):  # no room for a factor: no halves
            halves = Divided(fit.at, alpha, late)
            freed = residuals.innovations_large(fit, gamma, halves.own_shift())  # a change does not hide itself
            wide = residuals.scatter_of(fit.data, freed, rejected.channels.members)
            own = residuals.inflation(fit, wide.size * wide.memory, rejected.channels.group)
            compared = halves.compare(own, verdict.limit_of(M))
            groups["halves"], square, drifts, first = _compared(problem, compared, middle, own)
            inflation = own
    known = verdict.Grounds(
        np.clip(1.0 - declared.variance, 0.0, 1.0), square, verdict.pull(z, alpha, gamma, inflation),
        float(np.sqrt(verdict.limit_of(M))), verdict.explained_part(z, alpha, gamma, excess),
    )  # fmt: skip
    shared = shared_in_blocks(problem, fit.point, declared.members, declared.covariance, SHARED)
    ended, doubts = group["status"].values.tolist(), doubts | mirror_doubts(fit, tree)
    words, reasons = verdict.judge_biases(
        problem, Status(tree.attrs["status"]), ended, known, drifts, {}, first, shared, doubts
    )
    values = {"verdict": np.array(words, str), "reason": np.array(reasons, str), "contraction": known.contraction}
    values |= {"inflation": inflation}
    found = xr.Dataset({name: ("bias_label", value) for name, value in values.items()}, bias_coords(problem))
    found.attrs |= {"rate": verdict.RATE, "limit": known.limit}
    return found
