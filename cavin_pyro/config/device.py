"""Where and how networks compute: the device, the precision of matrix products, the allocator."""

from __future__ import annotations

import ctypes
import sys
import warnings

import torch
from torch import Tensor

from cavin_pyro.config.errors import UserError

MATMUL_PRECISIONS = {"float32": "highest", "bfloat16": "medium"}  # to torch's names

# glibc's names for the options of mallopt, <malloc.h>.
TRIM_THRESHOLD, TOP_PAD, MMAP_THRESHOLD, LARGEST_FAST = -1, -2, -3, 1
LARGEST_ON_HEAP = 32 * 2**20  # bytes; the most that glibc accepts
KEPT = 256 * 2**20  # bytes; enough for a plan of 8,192 samples


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


def keep_freed_memory() -> None:
    """Make the allocator keep freed memory between tensors, instead of returning it to the system.

    A plan allocates and frees thousands of tensors of some hundred kilobytes. Fresh pages for each of them take a third
    of the time at 8,192 samples. Does nothing where the C library has no such option.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(MMAP_THRESHOLD, LARGEST_ON_HEAP)
        mallopt(TRIM_THRESHOLD, KEPT)
        mallopt(TOP_PAD, KEPT // 16)
        mallopt(LARGEST_FAST, 0)  # otherwise every large allocation scans all freed small blocks
