"""Files that appear whole or not at all, and the note of which files in a folder this package wrote."""

import hashlib
import json
import os
import re
import secrets
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from os import PathLike
from pathlib import Path
from typing import Any

from probcal.errors import InputError

try:
    import fcntl
except ImportError:  # Windows: drafts of a killed write stay
    fcntl = None  # type: ignore[assignment]

type AnyPath = str | PathLike[str]

LOCK = ".probcal.lock"
NOTE = ".probcal.json"
_DRAFT = re.compile(r"\..+\.probcal-[0-9a-f]{8}\.part")


def write_whole(path: AnyPath, data: bytes | memoryview | str) -> Path:
    """Write a file in one step: it is whole or absent, on a full disk too.

    What a killed write left in the folder is cleared. Raises `InputError` where the folder cannot be written.
    """
    path = Path(path)
    content = data.encode() if isinstance(data, str) else data
    try:
        clear_drafts(path.parent)
        draft, handle = _draft(path)
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
                if fcntl is not None:  # while the draft is still locked, so that nobody takes it for a leftover
                    os.replace(draft, path)
            if fcntl is None:
                os.replace(draft, path)
        finally:
            draft.unlink(missing_ok=True)
    except (OSError, ValueError) as error:  # a ValueError of a name that no file can have
        raise cannot_write(path, error) from None
    return path


def parsed_json(content: bytes) -> Any:
    """The value of a JSON text in UTF-8, with or without a byte order mark.

    Raises `ValueError` for anything else.
    """
    try:
        return json.loads(content.decode("utf-8-sig"))
    except RecursionError:
        raise ValueError("its lists are nested too deeply") from None


def cannot_write(path: Path, error: OSError | ValueError) -> InputError:
    """The sentence of a file or folder that cannot be written."""
    return InputError(f"{path} cannot be written: {getattr(error, 'strerror', None) or error}")


def _draft(path: Path) -> tuple[Path, int]:
    """A new locked file beside the one to write, and its open handle."""
    while True:
        draft = path.with_name(f".{path.name[:100]}.probcal-{secrets.token_hex(4)}.part")
        try:
            handle = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o666)
        except FileExistsError:
            continue
        if _locked(handle) and os.fstat(handle).st_nlink == 0:  # cleared before it was locked
            os.close(handle)
            continue
        return draft, handle


def _locked(handle: int) -> bool:
    """Lock an open draft; False where the file system has no locks."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
    except (AttributeError, OSError):
        return False
    return True


def clear_drafts(folder: Path) -> None:
    """Remove the drafts that a killed write left in a folder; those of a living process are locked and stay."""
    if fcntl is None:
        return
    for name in os.listdir(folder):
        if _DRAFT.fullmatch(name):
            with suppress(OSError):
                handle = os.open(folder / name, os.O_RDONLY | os.O_NOFOLLOW)
                try:
                    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    os.unlink(folder / name)
                finally:
                    os.close(handle)


def make_folder(path: AnyPath) -> Path:
    """Make a folder and check that it can be written, before any work is done."""
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except FileExistsError:
        raise InputError(f"{path} is a file; give the name of a folder") from None
    except (OSError, ValueError) as error:
        raise cannot_write(path, error) from None
    return path


class Lock:
    """The right to work in a folder, held by one process at a time; `release` gives it back, a kill too.

    Raises `InputError` where another holds it for longer than `wait` s.
    """

    def __init__(self, folder: Path, wait: float = 0.0):
        import filelock  # slow to load, and only writers of folders need it

        self.path = folder / LOCK
        self._lock = filelock.FileLock(self.path)
        try:
            self._lock.acquire(timeout=wait)
        except filelock.Timeout:
            raise InputError(
                f"{folder}: another process is working there; wait until it has ended, or give another folder"
            ) from None
        except OSError as error:
            raise cannot_write(folder, error) from None

    def release(self) -> None:
        """Give the folder back, without a trace."""
        with suppress(OSError):  # while it is locked: whoever waits for it sees that it is gone
            self.path.unlink()
        self._lock.release()


class Outputs:
    """Files that a command writes into one folder.

    A file is replaced only where this package wrote it and nobody changed it since: a hidden file beside them notes
    the digest of each, and the run that it came from.
    """

    def __init__(self, folder: Path, names: Sequence[str]):
        self.folder, self.names = folder, tuple(names)

    @property
    def there(self) -> list[str]:
        """Those of the files that are there."""
        return [name for name in self.names if os.path.lexists(self.folder / name)]

    def runs(self) -> set[str]:
        """The runs that the files there came from; one that is being written has none."""
        noted = self._noted()
        return {noted[name][1] for name in self.there if name in noted} - {""}

    def check(self) -> None:
        """Raise `InputError` where one of the files is there and is not this package's own."""
        for name in self.there:
            if not self._own(name):
                raise InputError(
                    f"{self.folder / name} is no file that probcal wrote here, or it was changed since; move it away,"
                    " or write elsewhere"
                )

    def begin(self) -> None:
        """Note all files as about to be written: a kill leaves them to the next run."""
        self.check()
        self._note({name: ["", ""] for name in self.names})

    @contextmanager
    def writing(self, run: str = "") -> Iterator[None]:
        """Note the files as this package's own, written by a run."""
        self.begin()
        yield
        self._note({name: [digest_of_file(self.folder / name), run] for name in self.there})

    def remove(self, name: str) -> None:
        """Remove a file that this package wrote; any other stays."""
        if self._own(name):
            (self.folder / name).unlink(missing_ok=True)

    def _own(self, name: str) -> bool:
        path, noted = self.folder / name, self._noted()
        return not path.is_dir() and name in noted and noted[name][0] in ("", digest_of_file(path))

    def _noted(self) -> dict[str, list[str]]:
        try:
            found = json.loads((self.folder / NOTE).read_text())
            return {str(name): [str(digest), str(run)] for name, (digest, run) in found.items()}
        except (OSError, ValueError, TypeError, AttributeError):
            return {}

    def _note(self, changed: dict[str, list[str]]) -> None:
        others = {name: entry for name, entry in self._noted().items() if name not in self.names}
        write_whole(self.folder / NOTE, json.dumps(others | changed, indent=1))


def digest_of_file(path: Path) -> str:
    """Digest of a file, empty where it cannot be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return ""
