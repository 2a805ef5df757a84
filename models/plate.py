"""Where every program over windows puts its sites: the plate, and the mask of the terms with codes."""

from __future__ import annotations

from contextlib import AbstractContextManager

import pyro
from pyro import poutine

from models.state import Window


def windows_plate(window: Window) -> AbstractContextManager:
    """Windows of the batch `window: [B]` are independent."""
    return pyro.plate("windows", len(window.actions))


def sequence_mask(window: Window) -> AbstractContextManager:
    """Sites within contribute to the loss where `window.sequence_mask: [B]` is set."""
    return poutine.mask(mask=window.sequence_mask)  # type: ignore[call-overload]
