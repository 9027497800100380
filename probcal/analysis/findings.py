"""What a check has to say: one sentence each."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr

from probcal.inference.widen import said, sentence
from probcal.labels import listed

NAMES = 4  # that a sentence on several channels lists

FIRST = ("status", "wrapping", "drifting", "conflicting", "outliers", "level", "nis", "motion")  # likely causes
LAST = ("predictive", "rest", "gain", "loo")  # and what says little of them


class Finding(NamedTuple):
    """One thing to know about a fit: its kind, what it concerns, and a sentence."""

    kind: str
    subject: str
    sentence: str


def alarms(labels: Sequence[str], verdicts: Sequence[str], reasons: Sequence[str]) -> list[Finding]:
    """Findings on biases that drift or are in conflict: each reason once, with the biases that have
    it."""
    owners = dict[tuple[str, str], list[str]]()
    for label, word, reason in zip(labels, verdicts, reasons, strict=True):
        owners.setdefault((word, reason), []).append(label)
    return [
        Finding(word, own[0], f"{listed(own)}: {reason}")
        for (word, reason), own in owners.items()
        if word in ("drifting", "conflicting")
    ]


def of_invalid(
    tree: xr.DataTree,
    findings: Sequence[Finding],
    causes: Sequence[str],
) -> list[Finding]:
    """The findings on a fit that ended without an answer: a first sentence, and those of some kinds."""
    ended = f"the fit ended {tree.attrs['status']}"
    text = f"{ended}: the checks of its residuals and biases are not meaningful"
    return [Finding("status", "fit", text), *(f for f in findings if f.kind in causes)]


def in_order(findings: list[Finding]) -> list[Finding]:
    """The findings with likely causes first, those of one kind as they came."""

    def place(one: Finding) -> int:
        if one.kind in FIRST:
            return FIRST.index(one.kind)
        return len(FIRST) + (1 + LAST.index(one.kind) if one.kind in LAST else 0)

    return sorted(findings, key=place)


def finding_group(findings: Sequence[Finding]) -> xr.Dataset:
    """Findings as a group of a tree."""
    columns = {name: [getattr(one, name) for one in findings] for name in Finding._fields}
    return xr.Dataset({name: ("finding", np.array(values, str)) for name, values in columns.items()})


def completed(
    result: xr.DataTree,
    text: str,
    groups: dict[str, xr.Dataset],
    findings: list[Finding],
) -> xr.DataTree:
    """A widened result with its assessment; `text` says why the innovations reject the model."""
    said(result, sentence(text))
    findings = in_order(findings + [Finding("widened", "fit", text)] * bool(text))
    for name, group in (groups | {"finding": finding_group(findings)}).items():
        result[name] = xr.DataTree(group)
    result.attrs["assessed"] = 1
    return result
