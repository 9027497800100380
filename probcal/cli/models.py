"""Model files: imported, their functions called, whatever they raise in one sentence."""

import importlib.util
import inspect
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from socket import gethostname
from types import ModuleType
from typing import TYPE_CHECKING, Any

from probcal.cli.options import check_files
from probcal.errors import FitError, InputError, nearest
from probcal.files import digest_of_file
from probcal.lazy import xr

if TYPE_CHECKING:
    from probcal.inference.method import Method
    from probcal.network import Network
    from probcal.priors import Prior
    from probcal.problem import Problem
    from probcal.simulate import Truth


def load_model(path: Path) -> ModuleType:
    """Import a model file; raises `InputError` if it is missing or fails."""
    check_files(path)
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    folder = str(path.parent.resolve())
    sys.path.insert(0, folder)
    try:
        with _told(f"{path.name} cannot be loaded:", f"{path.name}: "):
            spec.loader.exec_module(module)
    finally:
        if folder in sys.path:
            sys.path.remove(folder)
    return module


@contextmanager
def _told(what: str, prefix: str = "") -> Iterator[None]:
    """Whatever a user's file raises, `sys.exit()` included, becomes one sentence; Ctrl-C stays what it is."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{prefix}{error}") from None
    except (FitError, KeyboardInterrupt):
        raise
    except BaseException as error:
        try:
            reason = str(error)
        except Exception:  # an exception of the user's own that cannot be printed
            reason = "no text"
        raise InputError(f"{what} {type(error).__name__}: {reason}") from None


def call(module: ModuleType, path: Path, name: str, /, *arguments: Any, **options: Any) -> Any:
    """Call a function of a model file; its own failures become one sentence."""
    function = getattr(module, name, None)
    if not callable(function):
        raise InputError(
            f"{path.name} defines no {name}(); a model file defines problem(data=None) and, to simulate, scenario(key)"
        )
    with _told(f"{path.name}: {name}() failed with"):
        return function(*arguments, **options)


@dataclass(frozen=True)
class ModelFile:
    """A model file, which other processes load by its path, once each; it and a table beside it must be the same there.

    Raises `InputError` where they are not.
    """

    path: Path
    digest: str

    @classmethod
    def of(cls, path: Path) -> "ModelFile":
        """A file as it is now, loaded here."""
        check_files(path)
        found = cls(path.resolve(), digest_of_file(path))
        found.module()
        return found

    def module(self) -> ModuleType:
        """The module of the file."""
        return _module_of(self)

    def setting(self, run: int, **point: Any) -> Any:
        """The result of setting(run, ...) of the file: a problem and its truth."""
        return call(self.module(), self.path, "setting", run, **point)


@cache
def _module_of(model: ModelFile) -> ModuleType:
    check_here(model.path, model.digest)
    return load_model(model.path)


def check_here(path: Path, digest: str) -> None:
    """Raise `InputError` where this process finds another file under a path than the one that sent it, or none."""
    if digest_of_file(path) != digest:
        raise InputError(
            f"{path} is not there on {gethostname()}, or another file than here; put it where all workers read"
            " it by the same path"
        )


def load_problem(
    model: Path,
    data: Path | None,
    fix: Sequence[str] | None = (),
    given: Mapping[str, Any] | None = None,
    epoch: float | None = None,
    module: ModuleType | None = None,
) -> "tuple[ModuleType, Problem]":
    """A model file and its problem with given data and arguments, some biases held at 0, rows at common epochs."""
    check_files(model, data)
    module, given = load_model(model) if module is None else module, given or {}
    taken = arguments(module, "problem")
    for name in given:
        if taken is not None and name not in taken:
            known = nearest(name, taken) or f"; it takes {', '.join(taken) or 'the data alone'}"
            raise InputError(f"{model.name}: problem() has no argument {name}{known}")
    problem = call(module, model, "problem", *_recording(module, "problem", data), **given)
    from probcal.problem import Problem  # loaded by the model, if it is one

    if not isinstance(problem, Problem):
        raise InputError(
            f"{model.name}: problem() returned {type(problem).__name__}; return a probcal.Problem with a network"
        )
    if fix:
        problem = problem.rebuild(fix=problem.fixed | dict.fromkeys(fix, 0.0))
    if epoch is not None:
        problem = problem.rebuild(epoch=epoch)
    return module, problem


def on_network(problem: "Problem", file: Path | None) -> "Problem":
    """The problem on the calibrated network of a file; itself without one."""
    from probcal.results.read import with_calibration

    return problem if file is None else problem.rebuild(network=with_calibration(problem.network, file))


def note_network(tree: "xr.DataTree", file: Path | None) -> "xr.DataTree":
    """The tree of a fit with a note of the calibrated network that it started from, as `load_fit` compares it."""
    if file is not None:
        tree.attrs["network"] = digest_of_file(file)
    return tree


def load_fit(calibration: Path, file: Path | None) -> "xr.DataTree":
    """A saved fit to go on from, which started from the calibrated network of a file, or from none.

    Raises `InputError` where it is invalid or counts its biases from another network.
    """
    from probcal.results.io import load
    from probcal.results.read import check_valid

    tree = load(calibration)
    check_valid(tree, str(calibration))
    if tree.attrs.get("network", "") != ("" if file is None else digest_of_file(file)):
        raise InputError(
            f"{calibration}: the fit started from another network; give --network as that fit had it, or none if it"
            " had none"
        )
    return tree


def arguments(module: ModuleType, name: str) -> list[str] | None:
    """Names of the arguments of a function of a model file after its first; None where it takes any, or is none."""
    try:
        found = list(inspect.signature(getattr(module, name)).parameters.values())
    except (AttributeError, TypeError, ValueError):
        return None
    if any(one.kind is one.VAR_KEYWORD for one in found):
        return None
    return [one.name for one in found[1:] if one.kind in (one.POSITIONAL_OR_KEYWORD, one.KEYWORD_ONLY)]


def _recording(module: ModuleType, name: str, data: Path | None) -> tuple[Path | None, ...]:
    """The first argument of a function of a model file; none where its own default holds."""
    with suppress(AttributeError, TypeError, ValueError):
        first = next(iter(inspect.signature(getattr(module, name)).parameters.values()), None)
        if data is None and first is not None and first.default is not first.empty:
            return ()
    return (data,)


def load_truth(
    module: ModuleType,
    model: Path,
    data: Path | None,
    problem: "Problem",
    given: Mapping[str, Any] | None = None,
    network: "Network | None" = None,
) -> "Truth | None":
    """The truth beside the data, else the model's own with those of the further arguments that it has.

    It is checked before a fit rather than at its scores. Its biases count from the network of the problem; `network`
    is the one that the model declares, where that is another.
    """
    import numpy as np

    from probcal.simulate import Truth, truth_beside

    truth = truth_beside(data) if data is not None else None
    if truth is None and hasattr(module, "truth"):
        taken = arguments(module, "truth")
        own = {name: value for name, value in (given or {}).items() if taken is None or name in taken}
        truth = call(module, model, "truth", *_recording(module, "truth", data), **own)
        if not isinstance(truth, Truth | None):
            raise InputError(f"{model.name}: truth() returned {type(truth).__name__}; return a probcal.Truth or None")
    if truth is not None and network is not None:
        old, new = network.stated, problem.network.stated
        biases = {label: value + (old.get(label, 0.0) - new.get(label, 0.0)) for label, value in truth.biases.items()}
        truth = replace(truth, biases=biases)
    if truth is not None:
        truth.check_targets(problem.measurements.target_names)
        truth.positions(np.zeros(0), np.zeros(0, str), problem.network.dimension)
    return truth


def prior_named(
    module: ModuleType, method: "Method", implied: "Prior | None", names: Sequence[str] = ()
) -> "Prior | None":
    """The prior that is named, else that of the method's name, else the model's own `PRIOR` if the method takes it.

    Of the names, `NAME` is for all biases, and `PATTERN=NAME` for those of a kind.
    """
    from probcal.priors import PRIORS, Prior, as_prior, by_kind

    named = {pattern: PRIORS[name] for pattern, _, name in (text.rpartition("=") for text in names)}
    chosen, own = named.pop("", implied), getattr(module, "PRIOR", None)
    if not isinstance(own, Prior | Mapping | None):
        raise InputError(f"{module.__name__}.py: PRIOR is {own!r}; give a prior of probcal, such as Horseshoe()")
    if chosen is None and own is not None and method.takes(as_prior(own, method.first_prior())):
        chosen = as_prior(own, method.first_prior())
    return by_kind(chosen or method.first_prior(), named) if named else chosen
