"""The run in a folder: its manifest, the names of its parts, their removal; loads nothing heavy.

The parts of a run are numbered files, or one zarr store: the fits of a study.
"""

import hashlib
import json
import os
import re
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from probcal.errors import InputError
from probcal.files import AnyPath, Lock, cannot_write, write_whole

MANIFEST = "probcal-run.json"
KINDS = {"draws": "chunk", "climb": "loop", "sbc": "runs"}  # what a folder holds: the name of its numbered parts
STORE = "fits.zarr"  # the part of a study
MARK = "probcal"  # attribute of a store that is complete: the digest of its run
OLDER = re.compile(r"state\.npz|chunk-\d+\.nc|batch-\d+\.npz|runs\.json")  # of probcal before the manifest
OLD_FITS = re.compile(r"fits-\d+\.npz")  # of probcal before the zarr store
_IN_STORE = re.compile(r"(\w+/)?(zarr\.json|c(/\d+)+)")
_DRAFT = re.compile(r".*\.[0-9a-f]{32}\.partial")  # that a killed write of zarr leaves
OVERWRITE = "give --overwrite (overwrite=True) to begin anew"
REMEDY = "give --resume (resume=True) to go on with it, --overwrite (overwrite=True) to replace it, or another folder"


def check_choice(resume: bool, overwrite: bool) -> None:
    """Raise `InputError` where both are asked for."""
    if resume and overwrite:
        raise InputError("resume and overwrite exclude each other: go on with the run that is there, or replace it")


def check_same(
    path: AnyPath, identity: Mapping[str, str], there: Mapping[str, str],
    remedy: str = f"give another folder, or {OVERWRITE}",
) -> None:  # fmt: skip
    """Raise `InputError` where the run in a folder is not the one to go on with, by the name of what differs."""
    for name in sorted(identity.keys() | there.keys(), key=[*identity, *there].index):
        if identity.get(name) != there.get(name):
            raise InputError(
                f"{path}: the {name} has changed since the run there began; resume it as it began, {remedy}"
            )


def write_manifest(path: Path, kind: str, identity: Mapping[str, str]) -> None:
    """Say what run the parts in a folder belong to."""
    content = {"kind": kind, "digest": digest_of(kind, identity), "identity": dict(identity)}
    write_whole(path / MANIFEST, json.dumps(content, indent=1))


def digest_of(kind: str, identity: Mapping[str, str]) -> str:
    """Digest of what a run is."""
    return hashlib.sha256(json.dumps([kind, dict(identity)], sort_keys=True).encode()).hexdigest()


def parts_of(path: Path) -> dict[int, Path]:
    """Files that have the name of a part, by number."""
    pattern = re.compile(rf"({'|'.join(KINDS.values())})-(\d{{6,}})\.npz")
    matches = ((pattern.fullmatch(name), name) for name in os.listdir(path))
    return {int(match[2]): path / name for match, name in matches if match}


def store_mark(path: Path) -> str:
    """Digest of the run whose fits the zarr store in a folder holds; empty where there is none, or half of one."""
    try:
        return str(json.loads((path / STORE / "zarr.json").read_text())["attributes"][MARK])
    except (OSError, ValueError, KeyError, TypeError):
        return ""


def holds_parts(path: Path) -> bool:
    """True if a folder holds parts of a run."""
    return bool(parts_of(path) or store_mark(path))


def clear_store(path: Path, *, drafts: bool = False) -> None:
    """Remove the zarr store in a folder, its description first: what a kill leaves is none. Or only killed writes."""
    store = path / STORE
    pattern = _DRAFT if drafts else re.compile(f"{_IN_STORE.pattern}|{_DRAFT.pattern}")
    if not drafts:
        (store / "zarr.json").unlink(missing_ok=True)
    for folder, _, names in os.walk(store, topdown=False):
        for name in names:
            file = Path(folder, name)
            if pattern.fullmatch(file.relative_to(store).as_posix()):
                file.unlink(missing_ok=True)
        if not drafts:
            with suppress(OSError):  # it holds something else
                os.rmdir(folder)


def read_manifest(path: Path) -> tuple[str, dict[str, str]]:
    """Kind and identity of the run in a folder."""
    file = path / MANIFEST
    try:
        found = json.loads(file.read_text())
        kind, identity = str(found["kind"]), dict(found["identity"])
        if found["digest"] != digest_of(kind, identity):
            raise ValueError("wrong digest")
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        raise InputError(f"{file} is damaged; give another folder, or {OVERWRITE}") from None
    return kind, identity


def described(path: Path) -> str:
    """The description of the run in a folder, for a sentence."""
    kind, identity = read_manifest(path)
    words = {
        "draws": "a sampler's run",
        "climb": "a climb",
        "sbc": "the runs of an sbc",
        "study": "the fits of a study",
    }
    return f"{words.get(kind, kind)} ({identity['method']})" if "method" in identity else words.get(kind, kind)


def clear_parts(path: Path) -> None:
    """Remove all parts, the last first: what a kill leaves is a run that stopped earlier."""
    try:
        clear_store(path)
        for _, file in sorted(parts_of(path).items(), reverse=True):
            file.unlink(missing_ok=True)
    except OSError as error:
        raise cannot_write(path, error) from None


def remove_parts(path: Path, lock: Lock, *, folder: bool) -> None:
    """Remove parts, manifest and lock, and the folder too where nothing else is in it."""
    try:
        clear_parts(path)
        (path / MANIFEST).unlink(missing_ok=True)
        lock.release()
    except OSError as error:
        raise cannot_write(path, error) from None
    if folder:
        with suppress(OSError):  # it holds something else
            path.rmdir()


def remove_run(path: AnyPath, digest: str) -> None:
    """Remove the parts of the run with this digest; any other run and any other file stay."""
    path = Path(path)
    try:
        mine = digest_of(*read_manifest(path)) == digest
    except InputError:  # there is none, or a damaged one that is no business of this run
        return
    if mine:
        remove_parts(path, Lock(path), folder=True)


def stored_digest(path: AnyPath) -> str:
    """Digest of the run in a folder; empty where there is none."""
    return digest_of(*read_manifest(Path(path))) if stored_run(path) else ""


def stored_run(path: AnyPath) -> str:
    """A short description of the run in a folder; empty where there is none."""
    path = Path(path)
    if not path.is_dir() or not (path / MANIFEST).exists() or not holds_parts(path):
        return ""
    return described(path)
