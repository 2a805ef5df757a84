"""Arrays that outgrow memory: written to a temporary file piece by piece, then read by index through a memory map.

The operating system keeps in memory what is read often, as far as there is room, and drops it when others need room.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


class MappedArray:
    """Grows at its end. Its file has no name in the folder, so it is gone when the process ends, however it ends."""

    def __init__(self, folder: Path | None = None) -> None:
        """The file is in this folder, or by default in the system's folder for temporary files."""
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 - `close` closes it
        self._shape: tuple[int, ...] | None = None  # of a row
        self._dtype = np.dtype(np.float32)
        self._rows = 0

    def append(self, rows: NDArray) -> None:
        """Add rows [n, ...].

        Raises:
            ValueError: they have another shape or type than earlier ones.
        """
        if self._shape is None:
            self._shape, self._dtype = rows.shape[1:], rows.dtype
        if (rows.shape[1:], rows.dtype) != (self._shape, self._dtype):
            raise ValueError(f"rows {list(rows.shape[1:])} of {rows.dtype} after {list(self._shape)} of {self._dtype}")
        self._file.write(np.ascontiguousarray(rows).data)
        self._rows += len(rows)

    def tensor(self) -> Tensor:
        """All rows, to be read only; no more can follow."""
        shape = (self._rows, *(self._shape or ()))
        self._file.flush()
        if 0 in shape:  # which cannot be mapped
            return torch.from_numpy(np.empty(shape, self._dtype))
        # Shared rather than private: a private map of more than the memory is refused.
        return torch.from_numpy(np.memmap(self._file, self._dtype, mode="r+", shape=shape))

    def close(self) -> None:
        """Close the file; a tensor of it stays."""
        self._file.close()
