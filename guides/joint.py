"""A guide for `models/cascaded.py` whose two codes both see the actions: an ablation of the cascade."""

from __future__ import annotations

import pyro

from guides.guide import Guide
from guides.networks import effect_inference, motion_inference
from models.cascaded import CascadedModel
from models.plate import counted_sequences, windows_plate
from models.state import Window


class JointGuide(Guide):
    """Infers the two codes of each window, each from all that the exact posterior of the model depends on.

    c ~ q(c | s, s', a)     # effect_code
    z ~ q_g(z | s, a, c)    # motion_code
    """

    fits = ("cascaded",)

    def __init__(self, model: CascadedModel, *, width: int = 64) -> None:
        """Dimensions are the model's; `width` is that of the guide's own layers.

        Raises `ValueError` for a model that this guide does not fit.
        """
        super().__init__(model)
        self.effect_inference = effect_inference(model, width=width, reads_actions=True)
        self.motion_inference = motion_inference(model, width=width, reads_effect=True)

    def forward(self, window: Window, generate: bool = False) -> None:
        """`window: [B]`. Codes are inferred from the window, also where the model goes on to generate."""
        first, last = window.first, window.last
        encoded = self.model.encode(window, generate, for_guide=True)[:, 0]

        with windows_plate(window), counted_sequences(window):
            effect_code = pyro.sample("effect_code", self.effect_inference(first, last, window.actions))
            motion = self.motion_inference(encoded, first.mask, window.actions, effect_code)
            pyro.sample("motion_code", motion)
