"""Errors, and the words that they share; nothing here needs jax or NumPy."""

from collections.abc import Iterable
from difflib import get_close_matches


class InputError(ValueError):
    """A declaration, table or argument that cannot be used; the text, one line, says what to do about it."""

    def __init__(self, text: object):
        super().__init__(one_line(text))


class FitError(RuntimeError):
    """A fit that left nothing to report: the text says why and what to do."""


def nearest(name: str, known: Iterable[str]) -> str:
    """Return `; did you mean "..."?` for the nearest known name, or the list of what is known."""
    names = [str(item) for item in known]
    close = get_close_matches(str(name), names, n=1)
    if close:
        return f'; did you mean "{close[0]}"?'
    shown = ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")
    return f"; known: {shown}" if names else ""


def one_line(text: object, width: int = 800) -> str:
    """Text on one line that can be printed, its middle cut out where it is longer than `width`."""
    line = " ".join(str(text).split())
    if len(line) > width:
        line = f"{line[: width // 2]} ... {line[-width // 2 :]}"
    return "".join(character if character.isprintable() else "\N{REPLACEMENT CHARACTER}" for character in line)
