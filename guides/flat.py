"""The guide of `models/flat.py` (paper, appendix A.2)."""

from __future__ import annotations

import pyro
from torch import Tensor

from guides.guide import Guide
from guides.networks import motion_inference
from models.flat import FlatModel
from models.plate import sequence_mask, windows_plate
from models.state import Window


class FlatGuide(Guide):
    """Infers the motion of each window.

    z ~ q(z | s, a)         # motion_code
    """

    fits = ("flat",)

    def __init__(self, model: FlatModel, *, width: int = 64) -> None:
        """The inference networks.

        Args:
            model: whose codes the guide infers, and whose other dimensions it has.
            width: width of the guide's own layers.

        Raises:
            ValueError: an incompatible model.
        """
        super().__init__(model)
        self.motion_inference = motion_inference(model, width=width, reads_effect=False)

    def forward(self, window: Window, generate: bool = False, encoded: Tensor | None = None) -> None:
        """`window: [B]`. The codes are inferred from the window, also if the model then generates."""
        first = window.first
        encoded = self.model.encode(window, generate) if encoded is None else encoded

        with windows_plate(window), sequence_mask(window):
            pyro.sample("motion_code", self.motion_inference(encoded[:, 0], first.mask, window.actions))
