"""Base class of model and guide programs."""

from __future__ import annotations

from typing import Any

import pyro
from torch import nn


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
