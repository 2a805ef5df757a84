"""The device on which networks run, from the option `device`."""

from __future__ import annotations

import sys
import warnings

import torch
from torch import Tensor

from cavin_pyro.config.errors import UserError

DEVICES = ("auto", "cpu", "cuda")


def choose_device(name: str) -> torch.device:
    """The device that `auto`, `cpu` or `cuda` names; `auto` says on standard error what it took.

    Raises:
        UserError: `cuda` where torch can use no GPU, which says why.
    """
    missing = None if name == "cpu" else _missing()
    if name == "cuda" and missing:
        raise UserError(
            f"device=cuda, but {missing}: choose device=cpu, or device=auto, which takes a GPU where there is one"
        )
    chosen = torch.device("cpu" if name == "cpu" or missing else "cuda")
    if name == "auto":
        why = missing or torch.cuda.get_device_name(chosen)
        print(f"device=auto takes {chosen.type}: {why}", file=sys.stderr, flush=True)
    return chosen


def _missing() -> str | None:
    """Why torch can use no GPU; None if it can."""
    if not torch.backends.cuda.is_built():
        return f"torch {torch.__version__} is built for the CPU alone"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a driver that is too old, which is no error for `auto`
        return None if torch.cuda.is_available() else "torch finds no GPU with a driver that it can use"


def send(tensor: Tensor, device: torch.device) -> Tensor:
    """A tensor on a device. Pinned memory lets a copy to a GPU run beside what the CPU does next."""
    if device.type == "cuda" and tensor.device.type == "cpu":
        tensor = tensor.pin_memory()
    return tensor.to(device, non_blocking=True)


def free_memory(device: torch.device) -> int:
    """Bytes that are free on a device other than the CPU."""
    return int(torch.get_device_module(device).mem_get_info(device)[0])
