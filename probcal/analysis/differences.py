"""Where one method is enough and where it lies: a comparison in sentences.

Every method is judged by the reference: the first fit that was sampled, else the first. On a bias it is enough where
its interval holds the mean of the reference and its sd is within a factor of `NARROW`; where it pruned the bias, if
as much of the reference as an interval holds lies within `overlap.ZERO` scales of zero.
"""

from collections.abc import Callable

import numpy as np
import xarray as xr

from probcal.analysis.findings import NAMES, Finding
from probcal.analysis.loo import BAD
from probcal.analysis.overlap import ZERO
from probcal.labels import listed
from probcal.results.schema import EVIDENCES
from probcal.status import INVALID, Status

NARROW = 0.7  # ratio of sds beyond which, either way, a method is not enough
GAMMA = 0.05  # by which a gamma must lie above the interval of the reference's to be a finding
CERTAIN = 4.0  # nats of elpd below which a difference is none, whatever its error
MIXED = 1.01  # r_hat above which chains disagree


def findings(comparison: xr.DataTree) -> list[Finding]:
    """Sentences on a comparison, those that put it in question first."""
    names, reference = (
        comparison["estimate"].to_dataset()["estimator"].values.tolist(),
        str(comparison.attrs["reference"]),
    )
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
    if method.attrs.get("largest_r_hat", 1.0) > MIXED:
        label = method["bias_label"].values[int(np.argmax(method["r_hat"].values))]
        text = f"{name}: r_hat of {label} is {method.attrs['largest_r_hat']:.3f}, its chains disagree; draw more"
        found.append(Finding("sampling", name, text))
    if method.attrs.get("divergences", 0) > 0:
        text = f"{name}: {method.attrs['divergences']} of its transitions diverged, its posterior may lack a part"
        found.append(Finding("sampling", name, text))
    return found


def _against(comparison: xr.DataTree, name: str, reference: str) -> list[Finding]:
    """What the reference says of one method."""
    estimate = comparison["estimate"].to_dataset()
    one, other = (estimate.sel(estimator=n) for n in (name, reference))
    labels, level = estimate["bias_label"].values.astype(str), float(comparison.attrs["interval_probability"])
    scale, unit = estimate["scale"].values, [f" {u}" if u != "1" else "" for u in estimate["unit"].values]
    mean, sd = (other[column].values for column in ("mean", "sd"))
    own, theirs = (estimated["status"].values == "pruned" for estimated in (one, other))
    pruned, known = own | theirs, sd > 0
    missed = ~pruned & ((mean < one["lower"].values) | (mean > one["upper"].values))
    ratio = np.where(known, one["sd"].values / np.where(known, sd, 1.0), 1.0)
    narrow, wide = ~pruned & (ratio < NARROW), ~pruned & (ratio > 1 / NARROW)
    away = np.abs(one["mean"].values - mean) / scale
    total, found = len(labels), list[Finding]()

    def tell(kind: str, mask: np.ndarray, size: np.ndarray, text: str, of: Callable[[int], str]) -> None:
        """One sentence on the biases in a mask, {} their number, those of the largest size named."""
        order = np.flatnonzero(mask)[np.argsort(-size[mask], kind="stable")]
        if len(order):
            said = f"{name}: {text.replace('{}', str(len(order)), 1)}"
            named = listed([f"{labels[k]} ({of(k)})" for k in order], NAMES)
            found.append(Finding(kind, labels[order[0]], f"{said}: {named}"))

    pair = comparison["pair"].to_dataset()
    mine = [{a, b} == {name, reference} for a, b in zip(pair["first"].values, pair["second"].values, strict=True)]
    there = pair["overlap"].values[np.flatnonzero(mine)[0]]  # of a pruned bias: how much of the reference is near zero
    lost = pruned & (there < level)
    enough = ~(lost | missed | narrow | wide)
    sampled = comparison[f"method/{reference}"].attrs["posterior"] == "draws"
    verb = "is enough for" if sampled else f"agrees with {reference} on"
    text = f"{verb} {enough.sum()} of {total} biases"
    text += f": its interval holds the mean of {reference}, its sd is within {NARROW:g} to {1 / NARROW:.2f} times that"
    if pruned.any():
        text += f"; of those pruned {level:.0%} of the other posterior lies within {ZERO:g} scales of zero"
    found.append(Finding("enough", name, f"{name} {text}"))
    tell("interval", missed, away, f"the {level:.0%} intervals of {{}} of {total} miss the mean of {reference}",
         lambda k: f"{one['mean'].values[k]:.3g} against {mean[k]:.3g}{unit[k]}")  # fmt: skip
    tell("narrow", narrow, -ratio, f"the sd of {{}} of {total} is below {NARROW:g} times that of {reference}",
         lambda k: f"{ratio[k]:.2g} times")  # fmt: skip
    tell("wide", wide, ratio, f"the sd of {{}} of {total} is above {1 / NARROW:.2f} times that of {reference}",
         lambda k: f"{ratio[k]:.2g} times")  # fmt: skip
    text = f"{{}} of the {own.sum()} that it pruned are not zero to {reference}, which leaves them"
    tell("pruned", lost & own, -there, text, lambda k: f"{there[k]:.0%} near zero, sd {sd[k] / scale[k]:.2g} scales")
    wider = one["sd"].values / scale
    text = f"{{}} of the {theirs.sum()} that {reference} pruned are not zero to it, which leaves them"
    tell("pruned", lost & theirs & ~own, -there, text, lambda k: f"{there[k]:.0%} near zero, sd {wider[k]:.2g} scales")
    method = comparison[f"method/{reference}"].to_dataset()
    if "gamma_upper" in method:
        upper, gamma = method["gamma_upper"].values, one["gamma"].values
        text = f"gamma of {{}} of {total} lies above the {level:.0%} interval of that of {reference}"
        tell("gamma", gamma > upper + GAMMA, gamma - upper, text, lambda k: f"{gamma[k]:.2f} above {upper[k]:.2f}")
    return found


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
