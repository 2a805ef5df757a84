from __future__ import annotations

from collections.abc import Callable

import pytest

from cavin_pyro.models.state import Window
from tests.models import conftest as of_models
from tests.models.conftest import clean_pyro  # noqa: F401


def _random_window(batch: int = 4, steps: int = 3, objects: int = 4, features: int = 6) -> Window:
    """Windows with padding, an object that vanishes, and some pairs and windows that do not count."""
    window = of_models._random_window(batch, steps, objects, features)
    mask = window.states.mask.clone()
    mask[2, 2:, 0] = False  # gone after the second push
    window.transition_mask[3] = False
    return window._replace(states=window.states._replace(mask=mask))


@pytest.fixture(scope="session")
def random_window() -> Callable[..., Window]:
    return _random_window


@pytest.fixture
def window() -> Window:
    """In double precision, with parts that do not count for each term."""
    return _random_window().map(lambda tensor: tensor.double() if tensor.is_floating_point() else tensor)
