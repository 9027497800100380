"""Checks of options and arguments that need nothing heavy: names, files, values of settings."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import typer

from probcal.cli.names import METHODS, PRIORS, SAVE
from probcal.cli.outputs import RECORDINGS
from probcal.errors import InputError, check_known
from probcal.labels import check_name

MOST_VALUES = 10_000  # of a setting of a study
# largest count that an option takes: of more draws or particles no machine has the memory
MOST = 10**6
LEAST_SIZE = 1e-12  # least size of a number that an option takes, in its unit
MOST_SIZE = 1e12  # largest size of the same


def count(least: int, text: str) -> Any:
    """An option that is a count, `least` to `MOST`, with its help text."""
    return typer.Option(min=least, max=MOST, help=text)


def quantity(text: str, *, zero: bool = False, negative: bool = False) -> Any:
    """An option that is a finite number of a sensible size, positive unless said otherwise, with
    its help text."""

    def check(option: typer.CallbackParam, value: float | None) -> float | None:
        fits = value is None or (LEAST_SIZE <= abs(value) <= MOST_SIZE and (negative or value > 0))
        if not fits and not (zero and value == 0):
            kind = "a number" if negative else "0 or a positive number" if zero else "a positive number"
            raise InputError(f"--{option.name} {value:g}: give {kind} from {LEAST_SIZE:g} to {MOST_SIZE:g} in size")
        return value

    return typer.Option(help=text, callback=check)


def check_files(model: Path, data: Path | None = None) -> None:
    """Raise `InputError` where the model file, or the table given with it, is not there."""
    if not exists(model) or not model.is_file():
        raise InputError(f"{model}: no such model file")
    if model.suffix != ".py":
        raise InputError(f"{model} is not a Python file; a model file defines problem(data=None)")
    if data is not None and not exists(data):
        raise InputError(f"{data}: no such file")


def recordings(data: Sequence[Path], out: Path | None, scheduler: str | None) -> list[Path]:
    """The recordings where there are several, none where there is one.

    Raises `InputError` for those that are not there or would be fitted into one folder.
    """
    if len(data) < 2:
        if scheduler is not None:
            raise InputError("--scheduler spreads the fits of several recordings; give more than one")
        return []
    if out is None:
        raise InputError("several recordings need --out, the folder for a fit of each and the table fits.csv")
    seen: dict[str, Path] = {}
    for path in data:
        if not exists(path):
            raise InputError(f"{path}: no such file")
        check_name(f"--out: the folder of {path}", path.stem)
        if not path.stem.strip(".") or path.stem in RECORDINGS:
            raise InputError(f'{path} cannot be fitted into a folder "{path.stem}" of --out; give it another name')
        if path.stem in seen:
            raise InputError(
                f"{seen[path.stem]} and {path} would both be fitted into {out / path.stem}; give them different names"
            )
        seen[path.stem] = path
    return list(data)


def check_fit(path: Path) -> None:
    """Raise `InputError` where there is no file of a fit to read."""
    file = path / "fit.nc" if exists(path) and path.is_dir() else path
    if not exists(file):
        raise InputError(f"{file} is not a fit written by probcal: there is no such file")


def network_file(path: Path | None) -> Path | None:
    """The file of a calibrated network, in the folder of a fit where that is given; raises `InputError` without one."""
    file = path / "network.csv" if path is not None and exists(path) and path.is_dir() else path
    if file is not None and not exists(file):
        raise InputError(f"--network {file}: there is no such file; give the folder of a valid fit, or its network.csv")
    return file


def exists(path: Path) -> bool:
    """True if a file or folder is there; a name that no file can have is not."""
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


def check_priors(method: str, priors: Sequence[str]) -> None:
    """Raise `InputError` for priors, `NAME` or `PATTERN=NAME`, that are not known or that a method does not take."""
    known, split = METHODS[method], [text.rpartition("=") for text in priors]
    for pattern, _, name in split:
        check_known(name, PRIORS, f'--prior "{name}" is not known')
        if name not in known.priors and not (pattern and name == "gaussian"):
            raise InputError(
                f"{known.title} does not take the prior {PRIORS[name]}; it takes: {', '.join(known.priors)}"
            )
    if sum(not pattern for pattern, *_ in split) > 1:
        raise InputError('--prior: give one NAME for all biases, and "PATTERN=NAME" for those of a kind')


def chain_sizes(method: str, sizes: Mapping[str, int | None]) -> dict[str, int]:
    """The numbers of chains and draws that are given; raises `InputError` for a method that draws none."""
    given = {option: number for option, number in sizes.items() if number is not None}
    if given and not METHODS[method].chains:
        raise InputError(f'--{next(iter(given))}: "{method}" draws no chains; take mcmc, collapsed, nuts, gibbs or svi')
    return given


def saved_names(text: str) -> list[str]:
    """Names of the draws that a fit shall save, separated by commas."""
    names = [name.strip() for name in text.split(",") if name.strip()]
    for name in names:
        if name not in SAVE:
            raise InputError(f'--save "{name}" is not known; give states, predictive or both, separated by a comma')
    return names


def parse_values(text: str) -> tuple[str, list[Any]]:
    """`name=a,b,c` or `name=first:last:step` as a name and its values; numbers where they are numbers."""
    name, equals, values = text.partition("=")
    parts = [part.strip() for part in values.split(",")]
    if not equals or not name.strip() or not all(parts):
        raise InputError(f'--set "{text}": write name=value,value,... or name=first:last:step')
    found: list[Any] = []
    for part in parts:
        numbers = [as_number(piece) for piece in part.split(":")]
        if len(numbers) == 3 and all(isinstance(number, (int, float)) for number in numbers):
            first, last, step = numbers
            if not all(map(math.isfinite, numbers)) or not step or (last - first) / step < 0:
                raise InputError(f'--set "{text}": the step does not lead from {first} to {last}')
            count = math.floor((last - first) / step + 1e-9) + 1
            if count > MOST_VALUES:
                raise InputError(f'--set "{text}": these are {count} values; give {MOST_VALUES} of them at most')
            found += [round(first + k * step, 12) for k in range(count)]
        else:
            found.append(as_number(part))
    return name.strip(), found


def given(settings: Sequence[str]) -> dict[str, Any]:
    """Arguments of a model by name: a number, a text, or several of them separated by commas as a tuple."""
    found: dict[str, Any] = {}
    for name, values in map(parse_values, settings):
        if name in found:
            raise InputError(f"--set {name}: it is given twice; write {name}=value,value for a tuple")
        found[name] = values[0] if len(values) == 1 else tuple(values)
    return found


def as_number(text: str) -> Any:
    """An integer or a float where the text is one, else the text."""
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def check_alignment(name: str | None) -> None:
    """Raise `InputError` for an alignment of truth and answer that there is not."""
    if name not in (None, "rigid", "similarity"):
        raise InputError(f'--align "{name}": give rigid or similarity')
