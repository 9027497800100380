"""What a check has to say: one sentence each."""

from typing import NamedTuple

NAMES = 4  # that a sentence on several channels lists


class Finding(NamedTuple):
    """One thing to know about a fit: its kind, what it concerns, and a sentence."""

    kind: str
    subject: str
    sentence: str
