"""Errors, and the words that they share; nothing here needs jax or NumPy."""

from collections.abc import Callable, Iterable
from difflib import get_close_matches
from functools import wraps
from inspect import formatannotation, signature
from typing import Any

GIVE = {  # class of an argument: the remedy where a value of another class is given
    "Problem": "a Problem, as in Problem(network, motion, table)",
    "Network": "a Network, as in Network([sensor_type.on(node), ...])",
    "Method": "a method, such as EA() or MAP()",
    "Prior": "a prior, such as Gaussian() or Horseshoe()",
    "Particles": "the number of particles, as in Particles(2000)",
    "ParticleSmoother": "the number of particles, as in Particles(2000)",
    "Point": "a Point, as probcal.modes.automatic_start(problem) returns it",
    "Truth": "a Truth, such as the truth of simulate(...)",
    "DataTree": "the tree that fit(problem) or load(folder) returns",
}


class InputError(ValueError):
    """A declaration, table or argument that cannot be used; the text, one line, says what to do about it."""

    def __init__(self, text: object):
        line, longest = " ".join(str(text).split()), 800  # characters, else its middle is cut out
        if len(line) > longest:
            line = f"{line[: longest // 2]} ... {line[-longest // 2 :]}"
        super().__init__(
            "".join(character if character.isprintable() else "\N{REPLACEMENT CHARACTER}" for character in line)
        )


class FitError(RuntimeError):
    """A fit that left nothing to report: the text says why and what to do."""


def checked[**P, R](function: Callable[P, R]) -> Callable[P, R]:
    """Raise `InputError` for an argument that is missing or not of its declared class, for the
    classes of `GIVE`.

    Classes are compared by name, so that no module is imported for the annotations.
    """
    parameters = signature(function).parameters
    declared = {name: _classes(one.annotation) for name, one in parameters.items()}
    wanted = {name: classes for name, classes in declared.items() if classes <= {*GIVE, "NoneType"}}
    give = {name: " or ".join(GIVE[kind] for kind in sorted(wanted[name] - {"NoneType"})) for name in wanted}
    required = [name for name in wanted if parameters[name].default is parameters[name].empty]
    verb = function.__qualname__.removesuffix(".__init__")

    @wraps(function)
    def entry(*args: P.args, **kwargs: P.kwargs) -> R:
        given = dict(zip(parameters, args, strict=False)) | kwargs
        for name, value in given.items():
            if name in wanted and wanted[name].isdisjoint(kind.__name__ for kind in type(value).__mro__):
                raise InputError(f"{verb}: {name} is {_described(value)}; give {give[name]}")
        for name in required:
            if name not in given:
                raise InputError(f"{verb}: the argument {name} is missing; give {give[name]}")
        return function(*args, **kwargs)

    return entry


def _classes(annotation: object) -> set[str]:
    """Names of the classes that an annotation allows, without their modules."""
    parts = formatannotation(annotation).strip("'").split(" | ")
    return {"NoneType" if part == "None" else part.rpartition(".")[2] for part in parts}


def _described(value: Any) -> str:
    """A value of the wrong class in a few words."""
    if isinstance(value, type):
        return f"the class {value.__name__} itself"
    return f'the text "{value}"' if isinstance(value, str) else f"of type {type(value).__name__}"


def nearest(name: str, known: Iterable[str]) -> str:
    """Return `; did you mean "..."?` for the nearest known name, or the list of what is known."""
    names = [str(item) for item in known]
    close = get_close_matches(str(name), names, n=1)
    if close:
        return f'; did you mean "{close[0]}"?'
    shown = ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")
    return f"; known: {shown}" if names else ""


def check_known(name: str, known: Iterable[str], text: str) -> None:
    """Raise `InputError` for a name that is not known: a text, and the nearest of those that are."""
    if name not in known:
        raise InputError(f"{text}{nearest(name, known)}")
