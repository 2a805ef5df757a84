"""The small dataset of the commands' tests, and their clean start."""

from __future__ import annotations

from tests.cavin_pyro.conftest import clean_pyro, pushes

__all__ = ["clean_pyro", "pushes"]
