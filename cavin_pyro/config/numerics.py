"""Numerics of this process: the precision of matrix products, and the allocator."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import torch

MATMUL_PRECISIONS = {"float32": "highest", "bfloat16": "medium"}  # to torch's names

# glibc's names for the options of mallopt, <malloc.h>.
TRIM_THRESHOLD, TOP_PAD, MMAP_THRESHOLD, LARGEST_FAST = -1, -2, -3, 1
LARGEST_ON_HEAP = 32 * 2**20  # bytes; the most that glibc accepts
KEPT = 256 * 2**20  # bytes; enough for a plan of 8,192 samples


def set_matmul_precision(name: str) -> None:
    """Round the factors of matrix products to `float32` or `bfloat16`; sums are kept in float32 either way."""
    torch.set_float32_matmul_precision(MATMUL_PRECISIONS[name])


def keep_freed_memory() -> None:
    """Make the allocator keep freed memory between tensors, instead of returning it to the system.

    A plan allocates and frees thousands of tensors of some hundred kilobytes. Fresh pages for each of them take a third
    of the time at 8,192 samples. Does nothing where the C library has no such option.
    """
    if sys.platform != "linux":
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(MMAP_THRESHOLD, LARGEST_ON_HEAP)
        mallopt(TRIM_THRESHOLD, KEPT)
        mallopt(TOP_PAD, KEPT // 16)
        mallopt(LARGEST_FAST, 0)  # otherwise every large allocation scans all freed small blocks


@contextmanager
def one_thread() -> Iterator[None]:
    """Compute in one thread: which plan wins can change with the rounding of sums in several."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
