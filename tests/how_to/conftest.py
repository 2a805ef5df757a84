"""The small dataset of the commands' tests, their clean start, and planning's toy worlds."""

from __future__ import annotations

from tests.cavin_pyro.conftest import clean_pyro, pushes
from tests.planning.conftest import toy

__all__ = ["clean_pyro", "pushes", "toy"]
