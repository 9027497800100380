"""`assess`: is the answer of a fit good? Innovations, predictive checks, left-out data, halves, and verdicts."""

from collections import ChainMap
from itertools import product

import numpy as np
import xarray as xr

from probcal.analysis.check import Case, Checked
from probcal.analysis.checks import CHECKS
from probcal.analysis.findings import ALARMS, Finding, alarms, finding_group, in_order
from probcal.analysis.verdict import (
    PART,
    RATE,
    Grounds,
    explained_part,
    gaussian_interval,
    judge_biases,
    limit_of,
    pull,
)
from probcal.inference.fitted import take_up
from probcal.inference.widen import said, sentence, unwidened, widened
from probcal.problem import Problem
from probcal.results.groups import along, bias_coords
from probcal.results.schema import VERDICTS
from probcal.simulate import Key, Truth, as_key, derived_keys
from probcal.status import Status
from probcal.types import float64


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
    - `verdict`: `verdict` and `reason` of every bias (rules in `probcal.analysis.verdict`), and its
      interval under a Gaussian prior of its scale, `gaussian_lower` and `gaussian_upper`;
      `finding`: sentences.

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
    case = Case(take_up(problem, tree), tree, truth, derived_keys(as_key(key), range(3)))
    with np.errstate(all=None if "explained" in case.has else "ignore"):  # squares of absurd residuals overflow
        return _assessed(case)


def _assessed(case: Case) -> xr.DataTree:
    fit, tree = case.fit, case.tree
    found = {name: own(case) for name, own in CHECKS.items() if own.needs <= case.has}
    groups = {name: group for own in found.values() for name, group in own.groups.items()}
    groups["verdict"] = verdict = _verdicts(case, list(found.values()))
    signs = {name for own in found.values() for name in own.explains}
    signs = {name for own in found.keys() - signs for name in found[own].explains}  # what is a sign explains nothing
    findings = [one for name, own in found.items() if name not in signs for one in own.findings] + alarms(verdict)
    if "answer" not in case.has:  # likely causes; the message of a misfit has its own
        cause = "other" if "explained" in case.has else "misfit"
        text = f"the fit ended {tree.attrs['status']}, so it is not judged; findings after this may say why"
        told = [own for name, own in found.items() if cause in CHECKS[name].causes]
        findings = [Finding("status", "fit", text), *(one for own in told for one in own.findings)]
        for word, own in product(ALARMS, told):
            for m, why in own.doubts.get(word, {}).items():
                label = fit.problem.labels[m]
                findings.append(Finding(word, label, f"{label}: {why}"))
    result, text = widened(fit, case.rejected, tree, fit.root)
    said(result, sentence(text))
    findings = in_order(findings + [Finding("widened", "fit", text)] * bool(text))
    for name, group in (groups | {"finding": finding_group(findings)}).items():
        result[name] = xr.DataTree(group)
    result.attrs["assessed"] = 1
    return result


def _verdicts(case: Case, found: list[Checked]) -> xr.Dataset:
    """Group `verdict` of what the checks found."""
    fit, problem, group = case.fit, case.fit.problem, case.tree["calibration"].to_dataset()
    inflation = np.ones(problem.model.biases) if fit.engine.cheap else case.rejected.inflation
    inflation = next((own.inflation for own in reversed(found) if own.inflation is not None), inflation)
    narrowed = np.clip(1.0 - case.declared.variance, 0.0, 1.0)
    z, alpha, gamma = np.asarray(fit.point.z), group["precision"].values, group["gamma"].values
    part = explained_part(z, alpha, gamma, case.innovations.excess)
    sd = np.sqrt(np.maximum(case.declared.variance, 1e-300))
    wide = np.maximum(inflation, 1.0) if case.rejected.reason else 1.0  # as the fit is widened
    gaussian = gaussian_interval(case.declared_mean, sd * np.sqrt(1.0 + narrowed * (wide - 1.0)))
    sharper, limit = group["sd"].values / (problem.scales * sd), float(np.sqrt(limit_of(len(z))))
    sharper = np.where(1.0 - gamma < PART, 1.0, sharper)  # what its own prior hardly gives
    known = Grounds(narrowed, pull(z, alpha, gamma, inflation), limit, part, gaussian, sharper)
    doubts = {word: dict(ChainMap(*(dict(own.doubts.get(word, {})) for own in reversed(found)))) for word in VERDICTS}
    remarks = {m: text for own in found for m, text in own.remarks.items()}
    status, ended = Status(case.tree.attrs["status"]), group["status"].values.tolist()
    words, reasons = judge_biases(problem, status, ended, known, doubts, remarks)
    values = {"verdict": np.array(words, str), "reason": np.array(reasons, str), "contraction": narrowed}
    lower, upper = gaussian * problem.scales
    values |= {"inflation": inflation, "gaussian_lower": lower, "gaussian_upper": upper}
    return xr.Dataset(along("bias_label", values), bias_coords(problem), {"rate": RATE, "limit": known.limit})
