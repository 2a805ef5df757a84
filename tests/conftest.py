"""What all tests share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch
from hypothesis import settings

# Other processes may hold the machine up: how long an example takes says nothing.
settings.register_profile("cavin_pyro", deadline=None)
settings.load_profile("cavin_pyro")


@pytest.fixture(autouse=True)
def products_round_as_before() -> Iterator[None]:
    """Commands say what matrix products of their process round to; a test of one must not change the next."""
    precision = torch.get_float32_matmul_precision()
    yield
    torch.set_float32_matmul_precision(precision)
