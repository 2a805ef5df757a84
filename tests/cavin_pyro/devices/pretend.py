"""A device beside the CPU that every machine has: its tensors live in the CPU's memory, but nothing may mix the two.

torch lets Python provide one backend (`PrivateUse1`). Ours is called `pretend`. An operation on its tensors runs on the
CPU, so results are those of the CPU bit for bit, and an operation that a GPU would refuse raises `DeviceError`: one
with tensors of both devices (numbers without dimensions excepted, in elementwise operations, as for CUDA), or with a
generator of the CPU. Indexing by a tensor of the CPU, which CUDA allows and waits for, is refused, too. Random numbers
come from a generator of its own.

The backend stays for the rest of the process, and the first backward pass must come after it: `test_devices.py` runs
the tests that use it in a process of their own.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch._ops import OpOverload
from torch.utils import backend_registration
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_iter, tree_map_only

NAME = "pretend"
UNASKED = [torch.ops.aten.empty_strided.default, torch.ops.aten.copy_.default]
COPIES = {torch.ops.aten._to_copy.default, torch.ops.aten.copy_.default}
# Operations whose result the host reads, or whose shape depends on values, so that it waits for a GPU.
WAITS = {
    torch.ops.aten._local_scalar_dense.default,
    torch.ops.aten.equal.default,
    torch.ops.aten.is_nonzero.default,
    torch.ops.aten.masked_select.default,
    torch.ops.aten.multinomial.default,
    torch.ops.aten.nonzero.default,
    torch.ops.aten.normal.Tensor_Tensor,
    torch.ops.aten.normal.float_Tensor,
    torch.ops.aten.repeat_interleave.Tensor,
}
INDEXING = {torch.ops.aten.index.Tensor, torch.ops.aten.index_put.default, torch.ops.aten.index_put_.default}
PLENTY = 2**40  # bytes


class DeviceError(AssertionError):
    """What a GPU would refuse."""


class Module(backend_registration._DummyBackendModule):
    """`torch.pretend`, as far as torch and this repository ask for it."""

    def __init__(self) -> None:
        self.free = PLENTY  # bytes of memory
        self.random = torch.Generator().manual_seed(0).get_state()

    def manual_seed(self, seed: int) -> None:
        self.random = torch.Generator().manual_seed(seed).get_state()

    manual_seed_all = manual_seed

    def get_rng_state(self, device: Any = None) -> Tensor:
        return self.random.clone()

    def set_rng_state(self, state: Tensor, device: Any = None) -> None:
        self.random = state.clone()

    def mem_get_info(self, device: Any = None) -> tuple[int, int]:
        return self.free, PLENTY


module = Module()
_library = torch.library.Library("aten", "IMPL")


class PretendTensor(torch.Tensor):
    """A tensor on the pretend device; `inner` has its numbers."""

    inner: Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, inner: Tensor) -> PretendTensor:
        form = {"strides": inner.stride(), "storage_offset": inner.storage_offset(), "dtype": inner.dtype}
        made = torch.Tensor._make_wrapper_subclass(cls, inner.size(), **form, device=torch.device(NAME, 0))
        made.inner = inner
        return made

    def __repr__(self, *, tensor_contents: Any = None) -> str:
        return f"{NAME} {self.inner}"

    def tolist(self) -> Any:
        return self.inner.tolist()

    def numpy(self, *, force: bool = False) -> Any:
        raise DeviceError(f"numpy() of a tensor on {NAME}")

    @classmethod
    def __torch_dispatch__(cls, operation: OpOverload, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(operation, args, kwargs or {})


class PretendDevice(TorchDispatchMode):
    """Within the block, `device="pretend"` works. `copies`: the tensors that went from one device to the other.
    `waits`: the operations for which the host waits, by name. A CUDA graph may have neither.

    Inference mode, which knows no tensors of Python's, is `torch.no_grad` there.
    """

    def __init__(self) -> None:
        super().__init__()
        self.copies: list[Tensor] = []
        self.waits: list[str] = []
        self._inference = torch.inference_mode.__enter__, torch.inference_mode.__exit__

    def __enter__(self) -> PretendDevice:
        torch.inference_mode.__enter__ = torch.no_grad.__enter__  # type: ignore[assignment, method-assign]
        torch.inference_mode.__exit__ = torch.no_grad.__exit__  # type: ignore[method-assign]
        _open.append(self)
        return super().__enter__()

    def __exit__(self, *error: Any) -> None:
        torch.inference_mode.__enter__, torch.inference_mode.__exit__ = self._inference  # type: ignore[method-assign]
        _open.remove(self)
        super().__exit__(*error)

    def __torch_dispatch__(self, operation: OpOverload, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = _run(operation, args, kwargs or {})
        ours = [one for one in tree_iter((args, kwargs)) if isinstance(one, PretendTensor)]
        if ours and (
            operation in WAITS or (operation in INDEXING and any(one.dtype == torch.bool for one in ours[1:]))
        ):
            self.waits.append(str(operation))
        if operation in COPIES:
            source = args[1] if operation is torch.ops.aten.copy_.default else args[0]
            if isinstance(source, PretendTensor) != isinstance(result, PretendTensor):
                self.copies.append(source)
        return result


_open: list[PretendDevice] = []


def register() -> torch.device:
    """Make the device known to torch, for the rest of the process."""
    if torch._C._get_privateuse1_backend_name() != NAME:
        backend_registration._setup_privateuseone_for_python_backend(NAME, module)
        # Some functions of torch, `torch.tensor` among them, make tensors without asking `PretendDevice`.
        for operation in UNASKED:
            _library.impl(operation, partial(_directly, operation), "PrivateUse1")
    return torch.device(NAME)


def _run(operation: OpOverload, args: Any, kwargs: dict[str, Any]) -> Any:
    tensors = [one for one in tree_iter((args, kwargs)) if isinstance(one, Tensor)]
    ours = [one for one in tensors if isinstance(one, PretendTensor)]
    named = kwargs.get("device")
    there = bool(ours) if named is None else torch.device(named).type == NAME
    if not ours and not there:
        return operation(*args, **kwargs)
    if ours and operation not in COPIES:
        others = [one for one in tensors if not isinstance(one, PretendTensor)]
        if torch.Tag.pointwise in operation.tags:
            others = [one for one in others if one.ndim > 0]
        if others:
            raise DeviceError(f"{operation}: some tensors are on {NAME}, and one {list(others[0].shape)} is on cpu")
    generator = kwargs.get("generator")
    if there and generator is not None:
        raise DeviceError(f"{operation}: the generator is on {generator.device}, the tensor on {NAME}")
    wrapped = {id(one.inner): one for one in ours}  # an operation in place returns its argument
    args, kwargs = tree_map_only(PretendTensor, lambda one: one.inner, (args, kwargs))
    if named is not None:
        kwargs = {**kwargs, "device": torch.device("cpu")}
    if torch.Tag.nondeterministic_seeded in operation.tags:
        with _own_randomness():
            result = operation(*args, **kwargs)
    else:
        result = operation(*args, **kwargs)
    if not there:
        return result.clone() if result is not None and id(result) in wrapped else result
    if operation is torch.ops.aten.copy_.default and not isinstance(tensors[0], PretendTensor):
        return tensors[0]
    return tree_map_only(Tensor, lambda one: wrapped[id(one)] if id(one) in wrapped else PretendTensor(one), result)


def _directly(operation: OpOverload, *args: Any, **kwargs: Any) -> Any:
    if operation is torch.ops.aten.copy_.default and _open:  # as `new_tensor` copies
        _open[-1].copies.append(args[1])
    return _run(operation, args, kwargs)


@contextmanager
def _own_randomness() -> Iterator[None]:
    before = torch.get_rng_state()
    torch.set_rng_state(module.random)
    try:
        yield
        module.random = torch.get_rng_state()
    finally:
        torch.set_rng_state(before)
