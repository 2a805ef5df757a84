"""Folders for files that PyBullet reads from disk, removed when the process ends."""

from __future__ import annotations

import shutil
import tempfile
from multiprocessing.util import Finalize
from pathlib import Path


def process_folder(what: str) -> Path:
    """A new folder of this process, for `what`, which stands in its name."""
    folder = Path(tempfile.mkdtemp(prefix=f"cavin_pyro_{what}_"))
    # Workers of `multiprocessing` end without `atexit`, but not without finalizers.
    Finalize(None, shutil.rmtree, [folder], {"ignore_errors": True}, exitpriority=0)
    return folder
