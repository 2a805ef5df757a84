"""What model and guide programs share: their base class, the plate over windows and the mask of sites with codes."""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import Any

import pyro
from pyro import poutine
from torch import nn

from models.state import Window


class Program(nn.Module):
    """A Pyro program whose networks are its submodules.

    Each call registers the parameters with `pyro.module`, because `SVI` and Pyro's optimizers find them in Pyro's
    parameter store. `pyro.settings.set(module_local_params=True)` disables the store: `Trace_ELBO()(model, guide)` is
    then an ordinary module for a torch optimizer, and calls skip the registration, about a tenth of a training step.
    """

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        if not pyro.settings.get("module_local_params"):
            pyro.module(type(self).__name__, self)
        return super().__call__(*args, **kwargs)


def windows_plate(window: Window) -> AbstractContextManager:
    """The plate over the independent windows of a batch `window: [B]`."""
    return pyro.plate("windows", len(window.actions))


def sequence_mask(window: Window) -> AbstractContextManager:
    """Masks sites by `window.sequence_mask: [B]`."""
    return poutine.mask(mask=window.sequence_mask)  # type: ignore[call-overload]
