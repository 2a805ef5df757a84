"""Folders of files: the user's meshes, and files that PyBullet reads from disk."""

from __future__ import annotations

import os
import shutil
import tempfile
from multiprocessing.util import Finalize
from pathlib import Path


def process_folder(what: str) -> Path:
    """A new folder for `what`, which stands in its name; it is removed when this process ends."""
    folder = Path(tempfile.mkdtemp(prefix=f"cavin_pyro_{what}_"))
    # Workers of `multiprocessing` end without `atexit`, but not without finalizers.
    Finalize(None, shutil.rmtree, [folder], {"ignore_errors": True}, exitpriority=0)
    return folder


def assets_folder(assets: str | Path) -> Path:
    """The user's folder of meshes; `~` at the beginning is a home, which no shell expands in `env.assets=~/x`."""
    return Path(os.path.expanduser(assets))  # unlike Path.expanduser, it leaves the home of an unknown user as it is
