"""The fingerprint of a function, as text: equal for functions that compute the same, however often
declared."""

import hashlib
import re
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np

ADDRESS = re.compile(r" at 0x[0-9a-f]+")


def computes(function: Callable[..., Any], *arguments: Any) -> str:
    """Digest of the jaxpr of a function in double precision and of the array constants that it closes over."""
    with jax.enable_x64(True):
        closed = jax.make_jaxpr(function)(*arguments)
    digest = hashlib.sha256(ADDRESS.sub("", str(closed)).encode())
    for constant in _constants(closed):
        array = np.asarray(constant)
        digest.update(f"{array.dtype} {array.shape}".encode() + np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _constants(closed: Any) -> Iterator[Any]:
    """Constants of a closed jaxpr and of those inside it, in order."""
    yield from closed.consts
    for equation in closed.jaxpr.eqns:
        for value in equation.params.values():
            for part in value if isinstance(value, (tuple, list)) else (value,):
                if hasattr(part, "consts") and hasattr(part, "jaxpr"):
                    yield from _constants(part)
