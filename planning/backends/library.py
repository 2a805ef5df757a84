"""A function as a shared library of torch's AOTInductor, called through its C entry points.

Torch's own Python class keeps the interpreter's lock while native code runs, so that two threads would take turns; a
call by `ctypes` frees it.
"""

from __future__ import annotations

import ctypes
import os
import weakref
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

# Where code needs it, torch's Python class makes it; without it, a call would end the process.
PROXY_EXECUTOR = b"aoti_torch_proxy_executor_call_function"

_pointer = ctypes.pythonapi.PyCapsule_GetPointer
_pointer.restype, _pointer.argtypes = ctypes.c_void_p, (ctypes.py_object, ctypes.c_char_p)
_capsule = ctypes.pythonapi.PyCapsule_New
_capsule.restype, _capsule.argtypes = ctypes.py_object, (ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p)


class Library:
    """A loaded library. Calls may run in several threads at once."""

    def __init__(self, path: Path) -> None:
        """Raises OSError for a file that is no such library."""
        self._library = ctypes.CDLL(os.fspath(path))  # frees the interpreter's lock in every call
        try:
            self._run = self._library.AOTInductorModelContainerRun
            self._run.argtypes = (
                *(ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t),
                *(ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p, ctypes.c_void_p),
            )
            self._container = ctypes.c_void_p()
            # At most so many calls at once; each has little of its own, the weights are shared.
            calls = ctypes.c_size_t(os.cpu_count() or 1)
            self._check(
                self._library.AOTInductorModelContainerCreateWithDevice(
                    ctypes.byref(self._container), calls, b"cpu", None
                )
            )
            delete = self._library.AOTInductorModelContainerDelete
            weakref.finalize(self, delete, self._container).atexit = False
            self.inputs, self.outputs = self._count("Inputs"), self._count("Outputs")
        except (AttributeError, RuntimeError) as error:
            raise OSError(str(error)) from error

    def __call__(self, tensors: Sequence[Tensor]) -> list[Tensor]:
        """The function's results. Raises RuntimeError, as torch does."""
        handles = torch._C._aoti.unsafe_alloc_void_ptrs_from_tensors([*tensors])
        given = (ctypes.c_void_p * len(handles))(*[_pointer(handle, None) for handle in handles])
        results = (ctypes.c_void_p * self.outputs)()
        self._check(self._run(self._container, given, len(handles), results, self.outputs, None, None))
        return torch._C._aoti.alloc_tensors_by_stealing_from_void_ptrs(
            [_capsule(result, None, None) for result in results]
        )

    def _count(self, what: str) -> int:
        number = ctypes.c_size_t()
        count = getattr(self._library, f"AOTInductorModelContainerGetNum{what}")
        self._check(count(self._container, ctypes.byref(number)))
        return number.value

    def _check(self, failed: int) -> None:
        if failed:
            message = ctypes.c_char_p()
            self._library.AOTInductorGetLastError(ctypes.byref(message))
            raise RuntimeError((message.value or b"native code failed").decode(errors="replace"))
