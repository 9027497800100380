"""Biases and combinations of them in words."""

from collections.abc import Sequence

import numpy as np

from probcal.labels import label_parts
from probcal.problem import Problem

INVOLVED = 0.3  # share of the largest entry above which a bias is named


def owner_of(label: str) -> str:
    """Node or sensor of a bias."""
    return label_parts(label)[0]


def name_without_owner(label: str) -> str:
    """The name of a bias, without its owner."""
    return label_parts(label)[1]


def in_words(label: str) -> str:
    """A bias in words: `range_offset of mic_3`."""
    owner, name = label_parts(label)
    return f"{name} of {owner}"


def amount(problem: Problem, label: str, size: float) -> str:
    """The change of a bias by `size` scales, as text with its unit."""
    m = problem.labels.index(label)
    return f"{label} {size * problem.scales[m]:+.2g} {problem.biases[m].unit}"


def involved(labels: list[str], vector: np.ndarray, largest: float) -> tuple[str, ...]:
    """The biases whose entries are not small beside the largest, the greatest first."""
    order = np.argsort(-np.abs(vector), kind="stable")
    return tuple(labels[m] for m in order if abs(vector[m]) > INVOLVED * largest)


def together(labels: tuple[str, ...], known: Sequence[str]) -> str:
    """Labels as `--fix` takes them: the position of a node as one pattern, where that reaches no other of the known."""
    owner = owner_of(labels[0])
    whole = len(labels) > 1 and set(labels) == {name for name in known if name.startswith(f"{owner}.position_")}
    return f"{owner}.position_*" if whole else " and ".join(labels)
