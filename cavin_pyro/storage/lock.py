"""A lock on a folder: one process at a time writes into it."""

from __future__ import annotations

import errno
import os
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from cavin_pyro.config.errors import UserError

LOCK_NAME = ".lock"
_WITHOUT_LOCKS = {errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP}  # what a file system without locks answers


@contextmanager
def folder_lock(folder: Path) -> Iterator[None]:
    """Hold the lock of an existing folder; the same thread may take it again within.

    The operating system holds it for this process (flock) and frees it when the process ends, however it ends. Its file
    `.lock` tells who holds it and is deleted at the end; one that a killed process left behind locks nothing. Where
    another process writes into the folder, a `UserError` names it, and nothing was changed.
    """
    path = folder.resolve() / LOCK_NAME
    # One object per path, which counts how often its thread took it: train takes the folder that its command holds.
    lock = FileLock(path, timeout=0, is_singleton=True, fallback_to_soft=False, on_acquired=_sign)
    try:
        lock.acquire()
    except Timeout:
        holder = ""
        with suppress(OSError, ValueError):
            holder = path.read_text(encoding="utf-8").strip()
        raise UserError(
            f"{folder} is being written by {holder or 'another process'}: "
            "wait until it ends, stop it, or choose another folder with output=DIR"
        ) from None
    except OSError as error:
        if error.errno not in _WITHOUT_LOCKS:
            raise
        print(f"note: the file system of {folder} has no locks: let no other command write there", file=sys.stderr)
        yield
        return
    try:
        yield
    finally:
        if lock.lock_counter == 1:
            path.unlink(missing_ok=True)  # while it is held: who opened it before notices and opens the next one
        lock.release()


def _sign(descriptor: int) -> None:
    os.write(descriptor, f"process {os.getpid()} on {socket.gethostname()}\n".encode())
