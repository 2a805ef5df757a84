"""The guide of `models/flat.py` (paper, appendix A.2)."""

from __future__ import annotations

import pyro

from cavin_pyro.guides.cascaded import MotionInference
from cavin_pyro.guides.guide import Guide
from cavin_pyro.models.model import Model, sequence_mask, windows_plate
from cavin_pyro.models.state import Window


class FlatGuide(Guide):
    """Infers the motion of each window.

    z ~ q(z | s, a)         # motion_code
    """

    fits = ("flat",)

    def __init__(self, model: Model, *, width: int = 64) -> None:
        """The inference network; for the arguments see `Guide`."""
        super().__init__(model)
        self.motion_inference = MotionInference(model, width=width, reads_effect=False)

    def forward(self, window: Window) -> None:
        """`window: [B]`."""
        encoded = self.model.encode(window)
        with windows_plate(window), sequence_mask(window):
            pyro.sample("motion_code", self.motion_inference(encoded[:, 0], window.first, window.actions))
