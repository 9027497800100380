"""Innovations of every sensor and of every target, and what the rest of the data says of each."""

import numpy as np
import xarray as xr

from probcal.analysis import leave
from probcal.analysis.check import Case, Check, Checked, check
from probcal.analysis.findings import Finding, sized
from probcal.analysis.verdict import RATE
from probcal.inference import residuals
from probcal.inference.residuals import PRACTICAL, codes
from probcal.results.groups import along

GAIN = 5.0  # nats that a calibration must win before it is a finding
LOOKED = 4  # sensors, and targets, of a large network that are left out


def check_parts(name: str) -> Check:
    """The check of each "sensor" or "target": its NIS, and the predictive density and NIS given the rest.

    Of a large network those of the largest mean squares are left out; they stand in `sensor_left`
    and `target_left`, whose attribute `of` says of how many.
    """

    @check(causes=["misfit"])
    def of(case: Case) -> Checked:
        group, labels = codes(case.fit.data, [name])
        names = labels[name].tolist()
        part = residuals.squares(case.innovations, group, len(names), RATE / len(names))
        groups = {f"{name}_check": xr.Dataset(along(name, part._asdict()), {name: names})}
        alone = name == "target" and len(names) == 1  # its sensors say the same
        findings = [] if alone else _beyond(names, part)
        if case.has >= {"explained", "factor"}:
            findings += _left_out(case, name, group, groups)
        return Checked(groups, findings)

    return of


def _beyond(names: list[str], part: residuals.Squares) -> list[Finding]:
    """Findings of the groups whose NIS lies beyond the limits, and notably so: one sentence for those alike."""
    found, order = [], np.argsort(-np.abs(np.log(np.maximum(part.nis, 1e-300))))
    high, low = part.nis > np.maximum(part.upper, PRACTICAL), part.nis < np.minimum(part.lower, 1 / PRACTICAL)
    for out, word, limit in ((high, "more", part.upper), (low, "less", part.lower)):
        if out.any():
            order_out = order[out[order]]
            text = f"NIS a datum {sized(names, part.nis, order_out)} (limit {limit[order_out[0]]:.3g})"
            found.append(
                Finding("nis", names[order_out[0]], f"{text}: the data scatter {word} than declared: check their std")
            )
    return found


def _left_out(case: Case, name: str, group: np.ndarray, groups: dict[str, xr.Dataset]) -> list[Finding]:
    """Add to the groups what the rest says of each sensor or target; returns findings."""
    key = f"{name}_check"
    check = groups[key]
    if leave.tailed(case.tree) and check.sizes[name] > 1:
        check["pareto_k"] = (name, leave.psis(case.tree, group, check.sizes[name]).pareto_k)
    if not case.fit.engine.cheap:
        worst = np.sort(np.argsort(-check["nis"].values, kind="stable")[:LOOKED])
        key = f"{name}_left"
        check = groups[key] = check.isel({name: worst}).assign_attrs(of=check.sizes[name])
    found = leave.leave_out(case.fit, name, check[name].values.tolist())
    if found is None or not all(np.isfinite(values).all() for values in found.values.values()):
        return []  # the rest alone leaves a flat prior without an answer
    check = groups[key] = check.assign(along(name, found.values))
    check.attrs |= {"refits": found.refits, "elpd": float(check["elpd"].sum())}
    if check.sizes[name] > 1:
        check.attrs["elpd_se"] = leave.standard_error(check["elpd"].values)
    return _unlike_the_rest(check) if "difference" in check else []


def _unlike_the_rest(check: xr.Dataset) -> list[Finding]:
    """Findings on sensors that do not fit the rest: as stated (the largest gain by calibration), or even calibrated."""
    names, gain = check["sensor"].values.tolist(), check["difference"].values
    order, findings = np.argsort(-gain), list[Finding]()
    worst = order[0]
    if gain[worst] > GAIN:
        text = f"calibration matters most for {names[worst]}, no fault by itself: given the rest its"
        text += f" data are {gain[worst]:.1f} nats likelier than as stated"
        if len(order) > 1:
            text += f"; next {names[order[1]]}, {gain[order[1]]:.1f}"
        findings.append(Finding("gain", names[worst], text))
    nis, upper = check["rest_nis"].values, check["upper"].values
    for k in np.flatnonzero(nis > np.maximum(upper, PRACTICAL)):
        text = f"{names[k]} does not fit the rest even when calibrated: NIS {nis[k]:.3g} a datum, limit"
        text += f" {upper[k]:.3g}: check its stated place, units and formula, or leave it out"
        findings.append(Finding("rest", names[k], text))
    return findings
