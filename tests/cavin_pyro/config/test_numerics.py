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
def test_a_name_sets_the_precision_of_matrix_products(name: str) -> None:
    set_matmul_precision(name)
    assert torch.get_float32_matmul_precision() == {"float32": "highest", "bfloat16": "medium"}[name]


def test_a_command_computes_in_one_thread(tmp_path: Path) -> None:
    environment = {name: value for name, value in os.environ.items() if name != "OMP_NUM_THREADS"}
    script = "import cavin_pyro.plan as plan; plan.main(); import torch; print(torch.get_num_threads())"
    command = [sys.executable, "-c", script, "--cfg", "job"]
    shown = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    assert shown.stdout.splitlines()[-1] == "1"
