from __future__ import annotations

from collections.abc import Callable, Iterator

import pyro
import pytest
import torch
from torch.nn import functional

from cavin_pyro.models.state import State, Window


@pytest.fixture(autouse=True)
def clean_pyro() -> Iterator[None]:
    pyro.clear_param_store()
    torch.manual_seed(0)
    with pyro.settings.context(module_local_params=True):
        yield
    pyro.clear_param_store()


def _random_window(batch: int = 4, steps: int = 3, objects: int = 4, features: int = 6) -> Window:
    """Windows with padding, an object that vanishes, and some pairs and windows that do not count."""
    low, high = torch.tensor([0.22, -0.61, 0.0]), torch.tensor([0.98, 0.61, 0.1])
    centers = low + (high - low) * torch.rand(batch, steps + 1, objects, 3)
    vectors = functional.normalize(torch.randn(batch, steps + 1, objects, features), dim=-1)
    mask = torch.ones(batch, steps + 1, objects, dtype=torch.bool)
    mask[:, :, -1] = False  # padding
    mask[2, 2:, 0] = False  # gone after the second push
    transition_mask = torch.ones(batch, steps, dtype=torch.bool)
    transition_mask[0, 1] = False
    transition_mask[3] = False
    sequence_mask = torch.arange(batch) != 1
    actions = 2 * torch.rand(batch, steps, 4) - 1
    return Window(State(centers, vectors, mask), actions, transition_mask, sequence_mask)


@pytest.fixture(scope="session")
def random_window() -> Callable[..., Window]:
    return _random_window


@pytest.fixture
def window() -> Window:
    """In double precision, with parts that do not count for each term."""
    return _random_window().map(lambda tensor: tensor.double() if tensor.is_floating_point() else tensor)
