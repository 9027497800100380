"""A tree as a netCDF file: written whole or not at all, compressed, sealed by a digest, checked where it is read."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from probcal.errors import InputError, checked
from probcal.files import AnyPath, write_whole
from probcal.lazy import xr
from probcal.results.accessor import register
from probcal.results.blocks import SensorBlocks
from probcal.results.modes import upgraded
from probcal.results.schema import (
    ATTRIBUTES,
    BLOCKS,
    JUDGED,
    NEEDED,
    RESULTS_VERSION,
    SUMMARY,
    TRACKED,
    WHOLE,
    Member,
)
from probcal.status import Status

SMALL = 1024  # bytes up to which an array of a file has no chunk of its own
SEAL = b"probcal sha256:"  # behind the content of a file, before its digest
ROUNDING = 1e-9  # by which a number of a fit may lie outside its range
# of a correlation matrix: asymmetry, and size of negative eigenvalues, that rounding leaves
LOSS = 1e-6


@checked
def save(tree: xr.DataTree, path: AnyPath) -> Path:
    """Write netCDF in one step, compressed and with checksums: a file of that name is whole or absent.

    Raises `InputError` where it cannot be written.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = save(tree, folder + "/fit.nc")
    ...     load(path).attrs["status"]
    'converged'
    """
    # every array compressed, with a checksum; texts as characters, which alone can have them;
    # small ones plain, as an HDF5 chunk costs more: the digest of the whole file covers them
    packed = {"zlib": True, "complevel": 4, "shuffle": True, "fletcher32": True}
    found: dict[str, Any] = {}
    for node in tree.subtree:
        variables = node.to_dataset(inherit=False).variables.items()
        found[node.path] = {
            name: packed | ({"dtype": "S1"} if _is_text(variable) else {})
            for name, variable in variables
            if variable.nbytes > SMALL
        }
    content = tree.to_netcdf(engine="h5netcdf", encoding=found)  # in memory: HDF5 dies on a full disk
    return write_whole(path, b"".join([content, SEAL, hashlib.sha256(content).digest()]))


def _is_text(variable: xr.Variable) -> bool:
    return variable.dtype.kind in "UO" and all(isinstance(value, str) for value in variable.values.ravel())


def load(path: AnyPath) -> xr.DataTree:
    """Read a fit back from its file, or from the folder that holds `fit.nc`.

    Raises `InputError` where the file is damaged, foreign, or written by another version.
    """
    if not isinstance(path, (str, PathLike)):
        raise InputError(f"load: path is of type {type(path).__name__}; give the folder of a fit, or its fit.nc")
    path = Path(path)
    try:
        path = path / "fit.nc" if path.is_dir() else path
        sealed = _sealed(path)
    except (OSError, ValueError) as error:  # nor is a name that no file can have
        raise InputError(f"{path} is not a fit written by probcal ({type(error).__name__}: {error})") from None
    if not sealed:
        raise InputError(f"{path} is damaged: its checksum does not match its content; fit again")
    try:
        with xr.open_datatree(path, engine="h5netcdf") as tree:
            tree = upgraded(tree.load())
    except Exception as error:  # whatever the netCDF and HDF5 libraries say of foreign bytes
        raise InputError(f"{path} is not a fit written by probcal ({type(error).__name__}: {error})") from None
    check_content(tree, path)
    register()
    return tree


def _sealed(path: Path) -> bool:
    """True where the digest after the content matches it, or there is none, as of another program."""
    tail = len(SEAL) + hashlib.sha256().digest_size
    with path.open("rb") as file:
        left = file.seek(0, 2) - tail
        if left < 0:
            return True
        file.seek(left)
        seal, found = file.read(tail), hashlib.sha256()
        if not seal.startswith(SEAL):
            return True
        file.seek(0)
        while left > 0:
            found.update(piece := file.read(min(left, 2**20)))
            left -= len(piece)
    return seal.endswith(found.digest())


def check_content(tree: xr.DataTree, path: Path) -> None:
    """Raise `InputError` where a fit lacks what its readers need, or holds what no fit can hold."""
    for fault in _faults(tree):
        raise InputError(f"{path}{fault}")


def _faults(tree: xr.DataTree) -> Iterator[str]:
    """The missing or invalid parts of a fit, each to be read after the name of its file."""
    if "calibration" not in tree.children or not set(SUMMARY[1:]) <= set(tree["calibration"].variables):
        yield " is not a fit written by probcal: its group calibration is missing or incomplete"
    if (found := tree.attrs.get("results_version")) != RESULTS_VERSION:
        age = "a newer" if isinstance(found, (int, np.integer)) and found > RESULTS_VERSION else "an older"
        yield f" was written by {age} probcal; fit again"
    tracks = list(tree["track"].children.values()) if "track" in tree.children else []
    if not tracks or any("target" not in node.attrs for node in tracks):
        yield " is incomplete: its group track lacks what a fit holds; fit again"
    judged = {group: members for group, members in JUDGED.items() if group in tree.children}
    expected = [*NEEDED.items(), ("calibration", BLOCKS if "block" in tree["calibration"] else WHOLE), *judged.items()]
    parts = [(group, tree.children.get(group), members) for group, members in expected]
    for name, node, members in [*parts, *((f"track/{node.name}", node, TRACKED) for node in tracks)]:
        if node is None or not set(members) <= set(node.variables):
            yield f" is incomplete: its group {name.partition('/')[0]} lacks what a fit holds; fit again"
        else:
            yield from (f": {name}/{fault}; the file was changed, fit again" for fault in _unlike(node, members))
    for name in ATTRIBUTES:
        if name not in tree.attrs:
            yield f" is incomplete: it has no attribute {name}; fit again"
    if (status := tree.attrs["status"]) not in set(Status):
        yield f': its attribute status is "{status}", which no fit has; fit again'
    if not 0.0 < float(tree.attrs["interval_probability"]) < 1.0:
        yield ": its attribute interval_probability does not lie between 0 and 1; fit again"
    yield from (f": {fault}; the file was changed, fit again" for fault in _wrong_moments(tree))


def _unlike(node: xr.DataTree, members: Mapping[str, Member]) -> Iterator[str]:
    """The variables that have other dimensions, another kind of values, or numbers out of range."""
    for name, member in members.items():
        variable = node.variables[name]
        values = variable.values
        if variable.dims != member.dims:
            yield f"{name} has the dimensions {variable.dims} in place of {member.dims}"
        elif values.size and member.kind not in ("any", _kind_of(values)):
            yield f"{name} holds no {member.kind}"
        elif member.kind == "numbers":
            away = (values < member.least - ROUNDING) | (values > member.most + ROUNDING)
            away |= member.finite & ~np.isfinite(values)
            if away.any():
                yield f"{name} holds {values[away].flat[0]:g}, which no fit can have"


def _kind_of(values: np.ndarray) -> str:
    """The kind of the values of an array, by the names of `Member`."""
    if values.dtype.kind == "O":
        return "texts" if all(isinstance(value, str) for value in values.ravel()) else "objects"
    return {"U": "texts", "b": "flags"}.get(values.dtype.kind, "numbers" if values.dtype.kind in "iuf" else "objects")


def _wrong_moments(tree: xr.DataTree) -> Iterator[str]:
    """Labels that differ or repeat, intervals upside down, and covariances that are none."""
    group, draws = tree["calibration"].to_dataset(), tree["posterior"].to_dataset()
    blocks = "block" in group
    labels, others = group["bias_label"].values.tolist(), [draws["bias_label"].values.tolist()]
    others += [] if blocks else [group["bias_label_other"].values.tolist()]
    if len(set(labels)) < len(labels) or any(other != labels for other in others):
        yield "its biases have labels that differ or repeat"
    upside = np.flatnonzero(group["lower"].values > group["upper"].values)
    if len(upside):
        yield f"calibration/lower of {labels[upside[0]]} lies above its upper"
    try:
        semi_definite = _semi_definite(SensorBlocks.read(group, labels, "load").covariance)
    except (IndexError, ValueError):
        yield "calibration/block names no block"
    else:
        if not semi_definite:
            yield f"calibration/{'block_covariance' if blocks else 'covariance'} is no covariance matrix"


def _semi_definite(matrices: np.ndarray) -> bool:
    """True where matrices (B, M, M) are symmetric and positive semi-definite up to rounding."""
    size = np.sqrt(np.maximum(np.diagonal(matrices, axis1=1, axis2=2), np.finfo(float).tiny))
    unit = matrices / size[:, :, None] / size[:, None, :]
    if not (np.abs(unit - unit.swapaxes(1, 2)) <= LOSS).all():
        return False
    try:
        np.linalg.cholesky(unit + LOSS * np.eye(unit.shape[1]))
    except np.linalg.LinAlgError:
        return False
    return True
