"""The labels of biases and what they are made of, and other names that stand in results.

Text only.
"""

import unicodedata
from collections.abc import Collection, Sequence

from probcal.errors import InputError

AXES = ("x", "y", "z")
SCENE, PIECE, NODE, START = "scene", "piece", "node", "start"  # what an answer beside another differs by
NOBODY = "no target"  # the target of rows that name none and whose sensor reads none

# Unicode categories: control characters, half of a pair, ends of lines
UNPRINTED = ("Cc", "Cs", "Zl", "Zp")
FORMULA = ("=", "+", "-", "@")  # first characters of a cell that a spreadsheet computes


def check_name(what: str, name: str) -> None:
    """Raise `InputError` for a name that is blank or holds control characters, which a terminal
    would obey.

    `what` names the thing. A name such as "'=a" is refused too: in a table it stands for "=a"
    (`escaped`).
    """
    if not name.strip():
        raise InputError(f'{what} has the blank name "{name}"; give it letters or digits')
    if any(unicodedata.category(character) in UNPRINTED for character in name):
        raise InputError(f"{what} has control characters in its name {name!a}; leave them out")
    if unescaped(name) != name:
        raise InputError(f"{what} has the name {name}, which stands for {name[1:]} in a table; drop the apostrophe")


def escaped(text: str) -> str:
    """A text as the cell of a table: one that a spreadsheet would compute gets an apostrophe in
    front.

    >>> escaped("=a.gain"), escaped("-1"), unescaped("'=a.gain")
    ("'=a.gain", '-1', '=a.gain')
    """
    return f"'{text}" if unescaped(f"'{text}") == text else text


def unescaped(text: str) -> str:
    """The text that `escaped` made a cell of."""
    if text[:1] != "'" or text[1:2] not in FORMULA:
        return text
    try:
        float(text[1:])
    except ValueError:
        return text[1:]
    return text  # of a number a spreadsheet makes a number


def listed(names: Sequence[str], most: int = 4) -> str:
    """The first names and how many there are beyond them: `A, B and 18 more`.

    >>> listed(["a", "b", "c", "d"], 2)
    'a, b and 2 more'
    """
    more = len(names) - most
    return ", ".join(names[:most]) + (f" and {more} more" if more > 0 else "")


def coordinates(names: Collection[str] | None = None, of: str = "") -> list[str]:
    """Names of the coordinates of a position among some names, `of` an owner where that is given.

    >>> coordinates(["position_x", "position_y", "velocity_x"]), coordinates(of="mast")[2]
    (['position_x', 'position_y'], 'mast.position_z')
    """
    found = [f"{of}.position_{axis}" if of else f"position_{axis}" for axis in AXES]
    return found if names is None else [name for name in found if name in names]


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
