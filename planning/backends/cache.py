"""Native code on disk: one file for each key, in a folder that only its owner can read or write.

Whoever can write there can run code as the user, so a folder of another user, or one that others can write, is refused.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import stat
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock

from planning.backends.library import Library

VARIABLE = "CAVIN_PYRO_CACHE"  # names another folder
DIGEST = 32  # bytes, at the end of each file, where loaders of libraries do not look
ABANDONED = 24 * 3600.0  # seconds
MOST = 256  # files, of one to two megabytes each; those that were not used for the longest time go first


class UnsafeFolderError(OSError):
    """A folder that is unsafe for native code; the message is one line."""


def default_folder() -> Path:
    """The folder for native code: `native` in the one that `CAVIN_PYRO_CACHE` names, or in the platform's for caches.

    Raises UnsafeFolderError for a user without a home.
    """
    if given := os.environ.get(VARIABLE):
        return Path(given).expanduser().absolute() / "native"
    try:
        home = Path.home()
    except RuntimeError as error:
        raise UnsafeFolderError(f"you have no home folder: name a folder in {VARIABLE}") from error
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA") or home / "AppData" / "Local")
    elif sys.platform == "darwin":
        base = home / "Library" / "Caches"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME") or "")
        base = base if base.is_absolute() else home / ".cache"
    return base / "cavin_pyro" / "native"


class CodeCache:
    """Libraries in a folder, by key. Several processes may use it at once."""

    def __init__(self, folder: Path) -> None:
        """Makes the folder. Raises UnsafeFolderError if others could have put code there, OSError if it cannot be."""
        missing = [place for place in (folder, *folder.parents) if not place.exists()]
        for place in reversed(missing):
            place.mkdir(mode=0o700, exist_ok=True)
        self.folder = folder.resolve()
        _check(self.folder)

    def load(self, key: str) -> Library | None:
        """The library of a key; None if there is none that is whole, one's own, and can be loaded."""
        path = self._path(key)
        try:
            with os.fdopen(os.open(path, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0)), "rb") as file:
                status = os.fstat(file.fileno())
                if not stat.S_ISREG(status.st_mode) or _complaint(status):
                    return None
                content = file.read()
            if len(content) <= DIGEST or content[-DIGEST:] != _digest(key, content[:-DIGEST]):
                return None
            library = Library(path)
            os.utime(path)  # it was used
        except OSError:
            return None
        return library

    def store(self, key: str, code: bytes) -> None:
        """Store a library atomically. Raises OSError, for example if the disk is full."""
        descriptor, name = tempfile.mkstemp(dir=self.folder, prefix=f"{key}.", suffix=".partial")
        try:
            with os.fdopen(descriptor, "wb") as file:
                file.write(code + _digest(key, code))
                file.flush()
                os.fsync(file.fileno())
            os.replace(name, self._path(key))
        except BaseException:
            Path(name).unlink(missing_ok=True)
            raise
        self._prune()

    @contextmanager
    def building(self, key: str) -> Iterator[Path]:
        """Yield an empty folder to make a library in, while other processes that want to make the same one wait."""
        lock = FileLock(self.folder / f"{key}.lock", mode=0o600, fallback_to_soft=False)
        with suppress(OSError):  # where a file system has no locks, both make it
            lock.acquire()
        try:
            with tempfile.TemporaryDirectory(dir=self.folder, prefix=f"{key}.") as folder:
                yield Path(folder)
        finally:
            if lock.is_locked:
                Path(lock.lock_file).unlink(missing_ok=True)  # who opened it before notices and opens the next one
                lock.release()

    def _path(self, key: str) -> Path:
        return self.folder / f"{key}.so"

    def _prune(self) -> None:
        with suppress(OSError):  # another process may do the same
            ages = sorted((path.stat().st_mtime, path) for path in self.folder.iterdir())
            libraries = [path for _, path in ages if path.suffix == ".so"]
            for path in libraries[:-MOST]:
                path.unlink(missing_ok=True)
            for age, path in ages:  # a killed process leaves what it had begun
                if path.suffix != ".so" and age < time.time() - ABANDONED:
                    if path.is_dir():
                        shutil.rmtree(path, ignore_errors=True)
                    else:
                        path.unlink(missing_ok=True)


def _digest(key: str, code: bytes) -> bytes:
    return hashlib.sha256(key.encode() + code).digest()


def _check(folder: Path) -> None:
    if complaint := _complaint(folder.stat()):
        raise UnsafeFolderError(f"{folder} {complaint}")
    for place in folder.parents:  # who can write there can put another folder in its place
        status = place.stat()
        if hasattr(os, "geteuid") and status.st_uid not in (0, os.geteuid()):
            raise UnsafeFolderError(f"{place} belongs to another user")
        if hasattr(os, "geteuid") and status.st_mode & stat.S_IWOTH and not status.st_mode & stat.S_ISVTX:
            raise UnsafeFolderError(f"{place} can be written by other users")


def _complaint(status: os.stat_result) -> str | None:
    """Why other users could change a file or a folder; None if they cannot, or the platform does not say."""
    if not hasattr(os, "geteuid"):
        return None
    if status.st_uid != os.geteuid():
        return "belongs to another user"
    return "can be written by other users" if status.st_mode & 0o022 else None
