"""The guide beside `models/flat.py` (paper, appendix A.2)."""

from __future__ import annotations

import pyro

from guides.guide import Guide
from guides.networks import motion_inference
from models.flat import FlatModel
from models.plate import counted_sequences, windows_plate
from models.state import Window


class FlatGuide(Guide):
    """Infers the motion of each window.

    z ~ q(z | s, a)         # motion_code
    """

    fits = ("flat",)

    def __init__(self, model: FlatModel, *, width: int = 64) -> None:
        """Dimensions are the model's; `width` is that of the guide's own layers.

        Raises `ValueError` for a model that this guide does not fit.
        """
        super().__init__(model)
        self.motion_inference = motion_inference(model, width=width, reads_effect=False)

    def forward(self, window: Window, generate: bool = False) -> None:
        """`window: [B]`. The code is inferred from the window, also where the model goes on to generate."""
        first = window.first
        encoded = self.model.encode(window, generate, for_guide=True)[:, 0]

        with windows_plate(window), counted_sequences(window):
            pyro.sample("motion_code", self.motion_inference(encoded, first.mask, window.actions))
