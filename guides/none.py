"""The guide beside `models/dynamics_only.py`."""

from __future__ import annotations

from guides.guide import Guide
from models.state import Window


class NoGuide(Guide):
    """Infers nothing: the model has no codes, and the bound on its evidence is the evidence."""

    fits = ("dynamics",)

    def forward(self, window: Window, generate: bool = False) -> None:
        """No site."""
