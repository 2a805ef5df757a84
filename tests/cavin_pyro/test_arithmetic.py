"""How a process computes is said once, and changes speed and rounding only."""

from __future__ import annotations

import pytest
import torch

from cavin_pyro.arithmetic import PRODUCTS, keep_freed_memory, set_products


@pytest.mark.parametrize("name", PRODUCTS)
def test_products_round_as_their_name_says(name: str) -> None:
    set_products(name)
    assert torch.get_float32_matmul_precision() == {"float32": "highest", "bfloat16": "medium"}[name]
    generator = torch.Generator().manual_seed(0)
    left, right = torch.randn(64, 64, generator=generator), torch.randn(64, 64, generator=generator)
    error = ((left @ right).double() - left.double() @ right.double()).abs().max()
    assert error < {"float32": 1e-4, "bfloat16": 0.5}[name]  # bfloat16 keeps 8 bits, where the processor has it


def test_keeping_memory_twice_does_no_harm() -> None:
    keep_freed_memory()
    keep_freed_memory()
