"""PyBullet, without its messages at import and on connecting."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_redirecting = threading.Lock()  # descriptors belong to the process: of two threads, one would keep the null device


@contextmanager
def _quiet(descriptor: int) -> Iterator[None]:
    """Silence what Bullet prints at import and on connecting, so that the streams hold the program's output only."""
    with _redirecting:
        sys.stdout.flush()
        sys.stderr.flush()
        kept = os.dup(descriptor)
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), descriptor)
        try:
            yield
        finally:
            os.dup2(kept, descriptor)
            os.close(kept)


with _quiet(2):
    import pybullet
    import pybullet_data
    from pybullet_utils.bullet_client import BulletClient


def connect() -> BulletClient:
    """Start a separate simulation, without a window and without Bullet's messages."""
    with _quiet(1):
        return BulletClient(pybullet.DIRECT)


PYBULLET_DATA = Path(pybullet_data.getDataPath())  # the models that PyBullet ships with

__all__ = ["PYBULLET_DATA", "BulletClient", "connect", "pybullet"]
