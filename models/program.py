"""Base class of model and guide programs."""

from __future__ import annotations

from typing import Any

import pyro
import torch
from pyro.nn import PyroModule
from pyro.poutine.runtime import _PYRO_STACK


class Program(PyroModule):
    """A `PyroModule` that reads its networks without ceremony when parameters are module-local.

    Reading a network off a running `PyroModule` announces each of its parameters to Pyro's handlers, about
    a tenth of a training step here. `SVI` needs that to find them. With
    `pyro.settings.set(module_local_params=True)`, for `Trace_ELBO()(model, guide)` and a torch optimiser,
    nobody listens, and networks (plain `nn.Module`s) are returned as they are.
    """

    def __getattr__(self, name: str) -> Any:
        network = self.__dict__.get("_modules", {}).get(name)
        compiling = torch.compiler.is_compiling()  # a planner's functions, to which no handler listens
        if network is None or (not compiling and (isinstance(network, PyroModule) or _parameters_are_awaited())):
            return super().__getattr__(name)
        return network


def _parameters_are_awaited() -> bool:
    # SVI listens with a tracer of parameters only; it must not find none and go on without training.
    listens = any(getattr(handler, "param_only", False) for handler in _PYRO_STACK)
    return listens or not pyro.settings.get("module_local_params")
