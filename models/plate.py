"""Where every program over windows puts its sites: the plate, and what counts in it."""

from __future__ import annotations

from contextlib import AbstractContextManager

import pyro
from pyro import poutine

from models.state import Window


def windows_plate(window: Window) -> AbstractContextManager:
    """One independent draw for each window of the batch `window: [B]`."""
    return pyro.plate("windows", len(window.actions))


def counted_sequences(window: Window) -> AbstractContextManager:
    """Sites within it count where `sequence_mask: [B]` is set."""
    return poutine.mask(mask=window.sequence_mask)  # type: ignore[call-overload]
