"""The guide of `models/dynamics_only.py`."""

from __future__ import annotations

from cavin_pyro.guides.guide import Guide
from cavin_pyro.models.state import Window


class NoGuide(Guide):
    """Infers nothing: the model has no codes, and the bound equals the evidence."""

    fits = ("dynamics",)

    def forward(self, window: Window) -> None:
        """No site."""
