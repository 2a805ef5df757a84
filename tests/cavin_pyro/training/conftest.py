"""What several tests of training share."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from models.state import State, Window


@pytest.fixture
def small_window() -> Window:
    """Four windows of three pushes, with one, two or three objects."""
    generator = torch.Generator().manual_seed(5)
    centers = 0.2 * torch.rand(4, 4, 3, 3, generator=generator, dtype=torch.float64) + torch.tensor([0.5, -0.1, 0.0])
    features = nn.functional.normalize(torch.randn(4, 4, 3, 6, generator=generator, dtype=torch.float64), dim=-1)
    mask = (torch.arange(3) < torch.tensor([1, 2, 3, 3])[:, None, None]).expand(4, 4, 3)
    actions = 2 * torch.rand(4, 3, 4, generator=generator, dtype=torch.float64) - 1
    every = torch.ones(4, 3, dtype=torch.bool)
    return Window(State(centers, features, mask), actions, every, every[:, 0])
