"""The findings of a check: one sentence each."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr

from probcal.labels import listed

NAMES = 4  # that a sentence on several channels lists

FIRST = (
    "status",
    "wrapping",
    "drifting",
    "conflicting",
    "outliers",
    "slope",
    "level",
    "nis",
    "motion",
)  # likely causes
ALARMS = ("drifting", "conflicting")  # verdicts that are findings too
LAST = ("predictive", "rest", "gain", "loo")  # and what says little of them


class Finding(NamedTuple):
    """One thing to know about a fit: its kind, what it concerns, and a sentence."""

    kind: str
    subject: str
    sentence: str


def sized(names: list[str], values: np.ndarray, order: np.ndarray) -> str:
    """The first names in an order, each with its number."""
    return listed([f"{names[k]} {values[k]:.3g}" for k in order], NAMES)


def alarms(verdict: xr.Dataset) -> list[Finding]:
    """Findings on biases that drift or are in conflict: each reason once, with the biases that have
    it."""
    owners = dict[tuple[str, str], list[str]]()
    for label, *of in zip(
        *(verdict[name].values.tolist() for name in ("bias_label", "verdict", "reason")), strict=True
    ):
        owners.setdefault((of[0], of[1]), []).append(label)
    return [
        Finding(word, own[0], f"{listed(own)}: {reason}") for (word, reason), own in owners.items() if word in ALARMS
    ]


def in_order(findings: Sequence[Finding]) -> list[Finding]:
    """The findings with likely causes first, those of one kind as they came."""
    places = {kind: k for k, kind in enumerate((*FIRST, "", *LAST))}
    return sorted(findings, key=lambda one: places.get(one.kind, places[""]))


def finding_group(findings: Sequence[Finding]) -> xr.Dataset:
    """Findings as a group of a tree."""
    columns = {name: [getattr(one, name) for one in findings] for name in Finding._fields}
    return xr.Dataset({name: ("finding", np.array(values, str)) for name, values in columns.items()})
