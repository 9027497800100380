"""A tree as a netCDF file: written whole or not at all, compressed, sealed by a digest, checked where it is read."""

from __future__ import annotations

import hashlib
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from probcal.errors import InputError, checked
from probcal.files import write_whole
from probcal.lazy import Later
from probcal.results.accessor import register
from probcal.results.schema import ATTRIBUTES, JUDGED, NEEDED, RESULTS_VERSION, SUMMARY, TRACKED, WHOLE

if TYPE_CHECKING:
    import xarray as xr
else:
    xr = Later("xarray")

SMALL = 1024  # bytes up to which an array of a file has no chunk of its own
SEAL = b"probcal sha256:"  # behind the content of a file, before its digest


@checked
def save(tree: xr.DataTree, path: str | PathLike[str]) -> Path:
    """Write netCDF in one step, compressed and with checksums: a file of that name is whole or absent.

    Raises `InputError` where it cannot be written.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = save(tree, folder + "/fit.nc")
    ...     load(path).attrs["status"]
    'converged'
    """
    content = tree.to_netcdf(engine="h5netcdf", encoding=_encoding(tree))  # in memory: HDF5 dies on a full disk
    return write_whole(path, b"".join([content, SEAL, hashlib.sha256(content).digest()]))


def _encoding(tree: xr.DataTree) -> dict[str, Any]:
    """Compression and a checksum for every array of every group; texts as characters, which alone can have them.

    Small ones stay plain, an HDF5 chunk would cost more than it holds: the digest of the whole file covers them.
    """
    packed = {"zlib": True, "complevel": 4, "shuffle": True, "fletcher32": True}
    found: dict[str, Any] = {}
    for node in tree.subtree:
        variables = node.to_dataset(inherit=False).variables.items()
        found[node.path] = {
            name: packed | ({"dtype": "S1"} if _is_text(variable) else {})
            for name, variable in variables
            if variable.nbytes > SMALL
        }
    return found


def _is_text(variable: xr.Variable) -> bool:
    return variable.dtype.kind in "UO" and all(isinstance(value, str) for value in variable.values.ravel())


def load(path: str | PathLike[str]) -> xr.DataTree:
    """Read a fit back from its file, or from the folder that holds `fit.nc`.

    Raises `InputError` where the file is damaged, foreign, or written by another version.
    """
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
            tree = tree.load()
    except Exception as error:  # whatever the netCDF and HDF5 libraries say of foreign bytes
        raise InputError(f"{path} is not a fit written by probcal ({type(error).__name__}: {error})") from None
    check_content(tree, path)
    register()
    return tree


def _sealed(path: Path) -> bool:
    """Whether the digest behind the content matches it; a file that another program wrote has none."""
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
    """Raise `InputError` where a fit lacks what its readers need."""
    if "calibration" not in tree.children or not set(SUMMARY[1:]) <= set(tree["calibration"].variables):
        raise InputError(f"{path} is not a fit written by probcal: its group calibration is missing or incomplete")
    if (found := tree.attrs.get("results_version")) != RESULTS_VERSION:
        age = "a newer" if isinstance(found, (int, np.integer)) and found > RESULTS_VERSION else "an older"
        raise InputError(f"{path} was written by {age} probcal; fit again")
    whole = {} if tree.attrs.get("sparse", 0) else {"calibration": WHOLE}
    for group, names in [*NEEDED.items(), *whole.items()]:
        if group not in tree.children or not set(names) <= set(tree[group].variables):
            raise InputError(f"{path} is incomplete: its group {group} lacks what a fit holds; fit again")
    for group, names in JUDGED.items():
        if group in tree.children and not set(names) <= set(tree[group].variables):
            raise InputError(f"{path} is incomplete: its group {group} lacks what a fit holds; fit again")
    tracks = tree["track"].children if "track" in tree.children else {}
    if not tracks or any(not {*TRACKED} <= {*node.variables} or "target" not in node.attrs for node in tracks.values()):
        raise InputError(f"{path} is incomplete: its group track lacks what a fit holds; fit again")
    if missing := [name for name in ATTRIBUTES if name not in tree.attrs]:
        raise InputError(f"{path} is incomplete: it has no attribute {missing[0]}; fit again")
    calibration = tree["calibration"].to_dataset()
    told = [name for name in ("mean", "sd", "covariance") if name in calibration]
    if not all(np.isfinite(calibration[name].values).all() for name in told):
        raise InputError(f"{path}: its means or sds are not finite; fit again")
