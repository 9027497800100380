"""What a check has to say: one sentence each."""

from collections.abc import Sequence
from typing import NamedTuple

from probcal.labels import listed

NAMES = 4  # that a sentence on several channels lists
PRACTICAL = 1.25  # factor from 1 within which a NIS beyond its limits is no finding
LAGGED = 2.5  # sd of its lag-1 correlation from which a channel is called correlated, beside its Ljung-Box test
NOTABLE = 0.1  # lag-1 correlation, and mean, of innovations within which neither is


FIRST = ("status", "wrapping", "drifting", "conflicting", "outliers", "level", "nis", "motion")  # likely causes
LAST = ("predictive", "rest", "gain", "loo")  # and what says little of them


class Finding(NamedTuple):
    """One thing to know about a fit: its kind, what it concerns, and a sentence."""

    kind: str
    subject: str
    sentence: str


def alarms(labels: Sequence[str], verdicts: Sequence[str], reasons: Sequence[str]) -> list[Finding]:
    """Findings on biases that drift or are in conflict: each reason once, with the biases that have it."""
    owners = dict[tuple[str, str], list[str]]()
    for label, word, reason in zip(labels, verdicts, reasons, strict=True):
        owners.setdefault((word, reason), []).append(label)
    return [
        Finding(word, own[0], f"{listed(own)}: {reason}")
        for (word, reason), own in owners.items()
        if word in ("drifting", "conflicting")
    ]


def in_order(findings: list[Finding]) -> list[Finding]:
    """The findings with likely causes first, those of one kind as they came."""

    def place(one: Finding) -> int:
        if one.kind in FIRST:
            return FIRST.index(one.kind)
        return len(FIRST) + (1 + LAST.index(one.kind) if one.kind in LAST else 0)

    return sorted(findings, key=place)
