"""Folders of files: the user's meshes, and files that PyBullet reads from disk."""

from __future__ import annotations

import os
import platform
import shutil
import tempfile
from contextlib import suppress
from multiprocessing.util import Finalize
from pathlib import Path


def process_folder(what: str) -> Path:
    """A new folder for `what`, which stands in its name; it is removed when this process ends.

    A process that was killed leaves its own, which this removes: of the same user, and of the same machine, which the
    name holds beside the process's number.
    """
    owner = f"cavin_pyro_{what}_{platform.node()}_"
    for left in Path(tempfile.gettempdir()).iterdir():
        if left.name.startswith(owner):
            with suppress(OSError, ValueError, OverflowError):  # it lives, or is no process's
                if left.lstat().st_uid == os.getuid() and not _alive(int(left.name[len(owner) :].partition("_")[0])):
                    shutil.rmtree(left, ignore_errors=True)
    folder = Path(tempfile.mkdtemp(prefix=f"{owner}{os.getpid()}_"))
    # Workers of `multiprocessing` end without `atexit`, but not without finalizers.
    Finalize(None, shutil.rmtree, [folder], {"ignore_errors": True}, exitpriority=0)
    return folder


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


def assets_folder(assets: str | Path) -> Path:
    """The user's folder of meshes; `~` at the beginning is a home, which no shell expands in `env.assets=~/x`."""
    return Path(os.path.expanduser(assets))  # unlike Path.expanduser, it leaves the home of an unknown user as it is
