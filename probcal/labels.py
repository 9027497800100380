"""The labels of biases and what they are made of, and other names that stand in results; text only."""

from collections.abc import Collection, Sequence

AXES = ("x", "y", "z")
SCENE, PIECE, NODE, START = "scene", "piece", "node", "start"  # what an answer beside another differs by
NOBODY = "no target"  # the target of rows that name none and whose sensor reads none


def listed(names: Sequence[str], most: int = 4) -> str:
    """The first names and how many there are beyond them: `A, B and 18 more`.

    >>> listed(["a", "b", "c", "d"], 2)
    'a, b and 2 more'
    """
    more = len(names) - most
    return ", ".join(names[:most]) + (f" and {more} more" if more > 0 else "")


def label_parts(label: str) -> tuple[str, str]:
    """Owner and bias of a label: `mic_3` and `position_x`, `radar_2` and `heading@0.5` of a step."""
    constant, _, time = label.rpartition("@")
    try:
        float(time)
    except ValueError:
        constant = label
    constant = constant if "." in constant else label
    owner, _, name = constant.rpartition(".")
    return owner, name + label[len(constant) :]


def step_of(label: str, labels: Collection[str]) -> tuple[str, float] | None:
    """The drifting bias that a label is a step of, and the time of the step in s; None for any other bias."""
    owner, _, time = label.rpartition("@")
    try:
        return (owner, float(time)) if owner in labels else None
    except ValueError:
        return None
