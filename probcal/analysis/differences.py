"""The sentences of a comparison: the biases for which one method is enough, or is wrong.

Every method is judged by the reference: the first fit that was sampled, else the first. On a bias it is enough where
its interval holds the mean of the reference and its sd is within a factor of `NARROW`; where it pruned the bias, if
as much of the reference as an interval holds lies within `overlap.ZERO` scales of zero.
"""

from typing import Any

import numpy as np
import xarray as xr

from probcal.analysis.findings import NAMES, Finding
from probcal.analysis.loo import BAD
from probcal.analysis.overlap import ZERO
from probcal.inference.mixed import R_HAT
from probcal.labels import listed
from probcal.results.read import listed_in
from probcal.results.schema import EVIDENCES
from probcal.status import INVALID, Status

NARROW = 0.7  # ratio of sds beyond which, either way, a method is not enough
GAMMA = 0.05  # by which a gamma must lie above the interval of the reference's to be a finding
CERTAIN = 4.0  # nats of elpd below which a difference is none, whatever its error


def findings(comparison: xr.DataTree) -> list[Finding]:
    """Sentences on a comparison, those that put it in question first."""
    names, reference = listed_in(comparison, "estimate", "estimator"), str(comparison.attrs["reference"])
    methods = {name: comparison[f"method/{name}"].to_dataset() for name in names}
    found = [finding for name in names for finding in _doubts(name, methods[name])]
    for name in names:
        if name != reference and not {methods[n].attrs["status"] for n in (name, reference)} & set(INVALID):
            found += _against(comparison, name, reference)
    return [*found, *_coverage(comparison, methods), *_prediction(methods), *_evidence(methods)]


def _doubts(name: str, method: xr.Dataset) -> list[Finding]:
    status, found = Status(method.attrs["status"]), list[Finding]()
    if not status.settled:
        found.append(Finding("status", name, f"{name} {status.said}"))
    if method.attrs.get("largest_r_hat", 1.0) > R_HAT:
        label = method["bias_label"].values[int(np.argmax(method["r_hat"].values))]
        text = f"{name}: r_hat of {label} is {method.attrs['largest_r_hat']:.3f}, its chains disagree; draw more"
        found.append(Finding("sampling", name, text))
    if method.attrs.get("divergences", 0) > 0:
        text = f"{name}: {method.attrs['divergences']} of its transitions diverged, its posterior may lack a part"
        found.append(Finding("sampling", name, text))
    return found


def _against(comparison: xr.DataTree, name: str, reference: str) -> list[Finding]:
    """The findings on one method, judged by the reference."""
    level, other = float(comparison.attrs["interval_probability"]), comparison[f"method/{reference}"].to_dataset()
    frame = _by_bias(comparison, name, reference)
    total, found = len(frame), list[Finding]()
    pruned = frame["pruned"] | frame["pruned_there"]
    lost = pruned & (frame["overlap"] < level)
    missed = ~pruned & ~frame["mean_there"].between(frame["lower"], frame["upper"])
    narrow, wide = ~pruned & (frame["ratio"] < NARROW), ~pruned & (frame["ratio"] > 1 / NARROW)
    enough = (~(lost | missed | narrow | wide)).sum()
    verb = "is enough for" if other.attrs["posterior"] == "draws" else f"agrees with {reference} on"
    text = f"{name} {verb} {enough} of {total} biases"
    text += f": its interval holds the mean of {reference}, its sd is within {NARROW:g} to {1 / NARROW:.2f} times that"
    if pruned.any():
        text += f"; of those pruned {level:.0%} of the other posterior lies within {ZERO:g} scales of zero"
    found.append(Finding("enough", name, text))

    times, left = f"times that of {reference}", "are not zero to"
    frame["gamma_upper"] = other["gamma_upper"].to_series() if "gamma_upper" in other else frame["gamma"]
    above = frame["gamma"] - frame["gamma_upper"]
    near = "{overlap:.0%} near zero, sd "
    missing = f"the {level:.0%} intervals of {{}} of {total} miss the mean of {reference}"
    sds, many = f"the sd of {{}} of {total} is", f"{{}} of the {frame['pruned'].sum()} that it pruned"
    more = f"{{}} of the {frame['pruned_there'].sum()} that {reference} pruned {left} it, which leaves them"
    gammas = f"gamma of {{}} of {total} lies above the {level:.0%} interval of that of {reference}"
    cases = (  # kind, biases, size, text with {} their number, numbers of each
        ("interval", missed, frame["away"], missing, "{mean:.3g} against {mean_there:.3g}{unit}"),
        ("narrow", narrow, -frame["ratio"], f"{sds} below {NARROW:g} {times}", "{ratio:.2g} times"),
        ("wide", wide, frame["ratio"], f"{sds} above {1 / NARROW:.2f} {times}", "{ratio:.2g} times"),
        ("pruned", lost & frame["pruned"], -frame["overlap"], f"{many} {left} {reference}, which leaves them",
         near + "{wide_there:.2g} scales"),
        ("pruned", lost & ~frame["pruned"], -frame["overlap"], more, near + "{wide:.2g} scales"),
        ("gamma", above > GAMMA, above, gammas, "{gamma:.2f} above {gamma_upper:.2f}"),
    )  # fmt: skip
    for kind, chosen, size, text, form in cases:
        own = frame[chosen].loc[size[chosen].sort_values(ascending=False, kind="stable").index]
        if len(own):
            named = [f"{label} ({form.format_map(row)})" for label, row in own.to_dict("index").items()]
            text = text.replace("{}", str(len(own)), 1)
            found.append(Finding(kind, own.index[0], f"{name}: {text}: {listed(named, NAMES)}"))
    return found


def _by_bias(comparison: xr.DataTree, name: str, reference: str) -> Any:
    """One row a bias: what a method says of it, what the reference does (`_there`), and how they differ."""
    group, pair = comparison["estimate"].to_dataset(), comparison["pair"].to_dataset()
    one, other = (group.sel(estimator=own).to_dataframe() for own in (name, reference))
    frame = one.join(other[["mean", "sd"]].add_suffix("_there"))
    frame["pruned"], frame["pruned_there"] = one["status"] == "pruned", other["status"] == "pruned"
    frame["ratio"] = (one["sd"] / other["sd"]).where(other["sd"] > 0, 1.0)
    frame["away"] = (one["mean"] - other["mean"]).abs() / one["scale"]
    frame["wide"], frame["wide_there"] = one["sd"] / one["scale"], other["sd"] / one["scale"]
    frame["unit"] = [f" {unit}" if unit != "1" else "" for unit in one["unit"]]
    both = [{a, b} == {name, reference} for a, b in zip(pair["first"].values, pair["second"].values, strict=True)]
    frame["overlap"] = pair["overlap"].values[both.index(True)]  # of a pruned bias: how much is near zero
    return frame


def _coverage(comparison: xr.DataTree, methods: dict[str, xr.Dataset]) -> list[Finding]:
    level, found = float(comparison.attrs["interval_probability"]), list[Finding]()
    for name, method in methods.items():
        at = method.attrs
        if "covered" in at:
            text = f"{name}: the {level:.0%} intervals hold {at['covered']} of {at['known']} true biases"
            if at.get("known_nonzero", at["known"]) < at["known"]:
                text += f", {at['covered_nonzero']} of the {at['known_nonzero']} that are not zero"
            found.append(Finding("coverage", name, f"{text}; error {at['bias_rmse']:.3g} scales (rms)"))
    return found


def _prediction(methods: dict[str, xr.Dataset]) -> list[Finding]:
    found = list[Finding]()
    known = {name: method.attrs for name, method in methods.items() if "elpd" in method.attrs}
    if missing := [name for name in methods if name not in known]:
        text = (
            "no elpd, it has no finite log_likelihood of every datum and draw: a row has probability zero at some draw,"
            " or the data are too many for a fit to keep it"
        )
        found.append(Finding("elpd", missing[0], f"{', '.join(missing)}: {text}"))
    for name, at in known.items():
        if at["bad_k"] > BAD:
            text = f"Pareto k of {at['bad_k']:.1%} of the data is above {at['good_k']:.2f}, its elpd is uncertain"
            found.append(Finding("loo", name, f"{name}: {text} and is compared with no other"))
    known = {name: at for name, at in known.items() if at["bad_k"] <= BAD}
    if len(known) < 2:
        return found
    best, alike = max(known, key=lambda name: known[name]["elpd"]), list[str]()
    for name in known:
        difference, error = abs(known[name]["elpd_difference"]), known[name]["elpd_difference_se"]
        by = f"{difference:.1f} \N{PLUS-MINUS SIGN} {error:.1f}"
        if difference > max(2 * error, CERTAIN):
            found.append(Finding("elpd", name, f"{best} predicts better than {name} by {by} nats (elpd)"))
        elif name != best:
            alike.append(f"{name} ({by} nats behind)")
    if alike:
        found.append(Finding("elpd", best, f"the elpd does not tell {best} from {', '.join(alike)}"))
    return found


def _evidence(methods: dict[str, xr.Dataset]) -> list[Finding]:
    """Evidences of one kind put in order: one that is maximised says nothing beside one that is integrated."""
    found = []
    for kind, words in EVIDENCES.items():
        known = {name: method.attrs[kind] for name, method in methods.items()
                 if kind in method.attrs and method.attrs["status"] not in INVALID}  # fmt: skip
        if len(known) < 2:
            continue
        best, *others = sorted(known, key=lambda name: -known[name])
        listed = ", ".join(f"{name} {known[name] - known[best]:.1f}" for name in others)
        found.append(Finding("evidence", best, f"{words} is highest of {best}; in nats below it: {listed}"))
    return found
