"""The guide of `models/cascaded.py` (paper, section 3.3)."""

from __future__ import annotations

import pyro
from torch import Tensor

from guides.guide import Guide
from guides.networks import effect_inference, motion_inference
from models.cascaded import CascadedModel
from models.plate import sequence_mask, windows_plate
from models.state import Window


class CascadedGuide(Guide):
    """Infers the two codes of each window, the motion given the effect.

    c ~ q_h(c | s, s')      # effect_code
    z ~ q_g(z | s, a, c)    # motion_code
    """

    fits = ("cascaded",)

    def __init__(self, model: CascadedModel, *, width: int = 64) -> None:
        """The inference networks.

        Args:
            model: whose codes the guide infers, and whose other dimensions it has.
            width: width of the guide's own layers.

        Raises:
            ValueError: an incompatible model.
        """
        super().__init__(model)
        self.effect_inference = effect_inference(model, width=width)
        self.motion_inference = motion_inference(model, width=width, reads_effect=True)

    def forward(self, window: Window, generate: bool = False, encoded: Tensor | None = None) -> None:
        """`window: [B]`. The codes are inferred from the window, also if the model then generates."""
        first, last = window.first, window.last
        encoded = self.model.encode(window, generate) if encoded is None else encoded

        with windows_plate(window), sequence_mask(window):
            effect_code = pyro.sample("effect_code", self.effect_inference(first, last))
            motion = self.motion_inference(encoded[:, 0], first.mask, window.actions, effect_code)
            pyro.sample("motion_code", motion)
