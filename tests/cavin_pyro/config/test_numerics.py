"""Matrix precision and threads change speed and rounding only."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from cavin_pyro.config.device import MATMUL_PRECISIONS, set_matmul_precision


@pytest.mark.parametrize("name", MATMUL_PRECISIONS)
def test_matrix_products_round_their_factors_to_the_named_precision(name: str) -> None:
    set_matmul_precision(name)
    assert torch.get_float32_matmul_precision() == {"float32": "highest", "bfloat16": "medium"}[name]
    generator = torch.Generator().manual_seed(0)
    left, right = torch.randn(256, 256, generator=generator), torch.randn(256, 256, generator=generator)
    exact, rounded = left.double() @ right.double(), left.bfloat16().double() @ right.bfloat16().double()
    assert (exact - rounded).abs().max() > 0.1
    allowed = {"float32": [exact], "bfloat16": [exact, rounded]}  # by processor
    product = (left @ right).double()
    # Sums are kept in float32 in any case, so the product is within 1e-3 of one of these and far from all others.
    assert min(float((product - expected).abs().max()) for expected in allowed[name]) < 1e-3


def test_a_command_computes_in_one_thread(tmp_path: Path) -> None:
    environment = {name: value for name, value in os.environ.items() if name != "OMP_NUM_THREADS"}
    script = "import cavin_pyro.plan as plan; plan.main(); import torch; print(torch.get_num_threads())"
    command = [sys.executable, "-c", script, "--cfg", "job"]
    shown = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    assert shown.stdout.splitlines()[-1] == "1"
