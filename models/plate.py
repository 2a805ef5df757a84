"""The plate over windows, and the mask of the sites with codes, for all programs."""

from __future__ import annotations

from contextlib import AbstractContextManager

import pyro
from pyro import poutine

from models.state import Window


def windows_plate(window: Window) -> AbstractContextManager:
    """The plate over the independent windows of a batch `window: [B]`."""
    return pyro.plate("windows", len(window.actions))


def sequence_mask(window: Window) -> AbstractContextManager:
    """Masks sites by `window.sequence_mask: [B]`."""
    return poutine.mask(mask=window.sequence_mask)  # type: ignore[call-overload]
