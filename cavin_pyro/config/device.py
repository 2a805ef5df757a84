"""Where and how networks compute: the device, and the precision of matrix products."""

from __future__ import annotations

import sys
import warnings

import torch
from torch import Tensor

from cavin_pyro.config.errors import UserError

MATMUL_PRECISIONS = {"float32": "highest", "bfloat16": "medium"}  # to torch's names


def choose_device(name: str) -> torch.device:
    """The device that `auto`, `cpu` or `cuda` names; `auto` says on standard error what it took.

    Another name, and `cuda` where torch can use no GPU, are a `UserError`, which says why.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise UserError(f"unknown device {name!r}: choose from auto, cpu, cuda")
    if name == "cpu":
        return torch.device(name)
    missing = _missing()
    if name == "cuda" and missing:
        raise UserError(
            f"device=cuda, but {missing}: choose device=cpu, or device=auto, which takes a GPU where there is one"
        )
    chosen = torch.device("cpu" if missing else "cuda")
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


def set_matmul_precision(name: str) -> None:
    """Round the factors of matrix products to `float32` or `bfloat16`; sums are kept in float32 either way."""
    torch.set_float32_matmul_precision(MATMUL_PRECISIONS[name])
