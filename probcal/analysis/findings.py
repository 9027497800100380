"""What a check has to say: one sentence each."""

from typing import NamedTuple

NAMES = 4  # that a sentence on several channels lists
PRACTICAL = 1.25  # factor from 1 within which a NIS beyond its limits is no finding
LAGGED = 2.5  # sd of its lag-1 correlation from which a channel is called correlated, beside its Ljung-Box test
NOTABLE = 0.1  # lag-1 correlation, and mean, of innovations within which neither is


class Finding(NamedTuple):
    """One thing to know about a fit: its kind, what it concerns, and a sentence."""

    kind: str
    subject: str
    sentence: str
