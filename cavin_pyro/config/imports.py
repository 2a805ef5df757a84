"""Imports without looking for garbage: Python's collector takes a third of the time that a command needs to start."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def without_collections() -> Iterator[None]:
    """Keep what is made within: later collections do not look through it either.

    For a block that mostly imports: nearly all that it makes stays until the process ends.
    """
    collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        if collecting:
            gc.enable()
