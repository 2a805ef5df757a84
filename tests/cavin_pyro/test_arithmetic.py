"""How a process computes is said once, and changes speed and rounding only."""

from __future__ import annotations

import subprocess
import sys

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


@pytest.mark.skipif(sys.platform != "linux", reason="the option is glibc's")
def test_memory_that_was_freed_is_not_fetched_from_the_system_again() -> None:
    code = """
import resource, sys, torch
from cavin_pyro.arithmetic import keep_freed_memory
if sys.argv[1] == "keep":
    keep_freed_memory()
def faults_of(rounds):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(rounds):
        tensors = [torch.ones(2_000_000) for _ in range(20)]  # 160 MB
        del tensors
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
faults_of(5)
print(faults_of(5))
"""
    counts = [
        int(subprocess.run([sys.executable, "-c", code, word], check=True, capture_output=True, text=True).stdout)
        for word in ("keep", "usual")
    ]
    assert 10 * counts[0] < counts[1]


def test_keeping_memory_twice_does_no_harm() -> None:
    keep_freed_memory()
    keep_freed_memory()
