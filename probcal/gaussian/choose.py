"""The engines by name, and the choice of one by the size of a model."""

import warnings
from collections.abc import Callable
from importlib.util import find_spec

import numpy as np

from probcal.errors import InputError
from probcal.gaussian.cholmod import Cholmod
from probcal.gaussian.dense import DenseEngine
from probcal.gaussian.engine import Engine
from probcal.gaussian.iterative import Iterative
from probcal.gaussian.joint import missing
from probcal.gaussian.room import ROOM, dense_numbers
from probcal.gaussian.sparse import SparseEngine
from probcal.gaussian.superlu import SuperLU
from probcal.model.model import Model

MANY, THIN = 500, 0.25  # biases, and the share of them that an epoch sees, from which the sparse form is the faster
ENGINES: dict[str, Callable[[], Engine]] = {
    "dense": DenseEngine,
    "cholmod": lambda: SparseEngine(Cholmod),
    "superlu": lambda: SparseEngine(SuperLU),
    "iterative": lambda: SparseEngine(Iterative(Cholmod if has_cholmod() else SuperLU)),
}


def has_cholmod() -> bool:
    """Say whether the extra is installed that brings CHOLMOD."""
    return find_spec("sparsax") is not None


def factoriser() -> str:
    """The name of the sparse engine that factorises fastest here."""
    return "cholmod" if has_cholmod() else "superlu"


def direct_engine() -> Engine:
    """The sparse engine that factorises fastest here."""
    return ENGINES[factoriser()]()


def engine_named(method: str, asked: str | Engine, form: str = "") -> str | Engine:
    """The engine that a method asks for, a name of versions before replaced with a warning.

    Raises `InputError` for a name that no engine has.
    """
    given = f'form="{form}"' if form else f'engine="{asked}"'
    found = form or asked
    found = {"sparse": factoriser(), "matrix-free": "iterative"}.get(str(found), found)
    if found is not asked:
        warnings.warn(f'{method}({given}) is {method}(engine="{found}") now', FutureWarning, stacklevel=4)
    if isinstance(found, str) and found not in ("auto", *ENGINES):
        raise InputError(f'{method}(engine="{found}"): give one of auto, {", ".join(ENGINES)}')
    return found


def estimates(asked: str | Engine) -> bool:
    """Say whether an engine estimates variances and log determinants."""
    return not getattr(asked, "exact", asked != "iterative")


def choose(model: Model) -> Engine:
    """Dense where its matrices take at most 240 MB, or where the sparse engine does not take the model."""
    return direct_engine() if prefers_sparse(model) and not missing(model) else DenseEngine()


def engine_of(asked: str | Engine, model: Model, *, fast: bool = False) -> Engine:
    """The engine of a name; of "auto" that which the size of a model calls for, or with `fast` its shape too.

    Raises `InputError` where its library is not installed, or where it does not take the model.
    """
    if asked == "cholmod" and not has_cholmod():
        raise InputError('engine="cholmod" needs sparsax: install probcal[sparse], or take engine="superlu"')
    if asked == "auto":
        return choose_fast(model) if fast else choose(model)
    engine = ENGINES[asked]() if isinstance(asked, str) else asked
    if not engine.cheap and (lacks := missing(model)):
        raise InputError(f'engine="{asked}" does not take {lacks}: give engine="dense"')
    return engine


def choose_fast(model: Model) -> Engine:
    """The engine that solves fastest under many factors: sparse also where an epoch sees few of many biases."""
    return direct_engine() if is_thin(model) and not missing(model) else choose(model)


def prefers_sparse(model: Model) -> bool:
    """True if the matrices of the dense form take more than 240 MB."""
    return dense_numbers(model) > ROOM


def is_thin(model: Model) -> bool:
    """True if an epoch sees few of many biases: more than 500, less than a quarter of them."""
    if model.biases <= MANY:
        return False
    seen = sum(int(np.sum(np.asarray(data.bias)[np.asarray(data.sensor)] < model.biases)) for data in model.rows)
    epochs = sum(part.drift.shape[0] for part in model.recursions)
    return seen < THIN * epochs * model.biases
