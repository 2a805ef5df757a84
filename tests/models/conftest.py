from __future__ import annotations

from collections.abc import Callable, Iterator

import pyro
import pytest
import torch
from torch.nn import functional

from cavin_pyro.models.state import State, Window

WIDTH, FEATURES = 8, 6  # small networks keep the tests fast


@pytest.fixture(autouse=True)
def clean_pyro() -> Iterator[None]:
    pyro.clear_param_store()
    torch.manual_seed(0)
    with pyro.settings.context(module_local_params=True):
        yield
    pyro.clear_param_store()


def _random_state(*batch: int, objects: int = 4, real: int | None = None, features: int = FEATURES) -> State:
    """Objects anywhere on the table; the first `real` are real (all, if not given)."""
    low, high = torch.tensor([0.22, -0.61, 0.0]), torch.tensor([0.98, 0.61, 0.1])
    centers = low + (high - low) * torch.rand(*batch, objects, 3)
    vectors = functional.normalize(torch.randn(*batch, objects, features), dim=-1)
    mask = (torch.arange(objects) < (objects if real is None else real)).expand(*batch, objects)
    return State(centers, vectors, mask)


def _random_window(batch: int = 4, steps: int = 3, objects: int = 4, features: int = FEATURES) -> Window:
    """Windows with one padded object each and some pairs and windows that do not count."""
    states = _random_state(batch, steps + 1, objects=objects, real=objects - 1, features=features)
    transition_mask = torch.ones(batch, steps, dtype=torch.bool)
    transition_mask[0, 1] = False
    sequence_mask = torch.arange(batch) != 1
    return Window(states, 2 * torch.rand(batch, steps, 4) - 1, transition_mask, sequence_mask)


@pytest.fixture(scope="session")
def random_state() -> Callable[..., State]:
    return _random_state


@pytest.fixture(scope="session")
def random_window() -> Callable[..., Window]:
    return _random_window
