"""The guide beside `models/cascaded.py` (paper, section 3.3)."""

from __future__ import annotations

import pyro
from pyro import poutine

from guides.guide import Guide
from guides.inference import EffectInference, MotionInference
from models.cascaded import CascadedModel
from models.state import Window


class CascadedGuide(Guide):
    """Infers the two codes of each window, the motion given the effect.

    c ~ q_h(c | s, s')      # effect_code
    z ~ q_g(z | s, a, c)    # motion_code
    """

    fits = ("cascaded",)

    def __init__(self, model: CascadedModel, *, width: int = 64) -> None:
        """Dimensions are the model's; `width` is that of the guide's own layers.

        Raises `ValueError` for a model that this guide does not fit.
        """
        super().__init__(model)
        self.effect_inference = EffectInference(
            effect_dimension=model.effect_dimension, feature_dimension=model.feature_dimension, width=width
        )
        self.motion_inference = MotionInference(
            segment_length=model.segment_length,
            effect_dimension=model.effect_dimension,
            motion_dimension=model.motion_dimension,
            width=width,
            encoder_width=model.width,
        )

    def forward(self, window: Window, generate: bool = False) -> None:
        """`window: [B]`. Codes are inferred from the window, also where the model goes on to generate."""
        first, last = window.first, window.last
        encoded = self.model.encoder(first)  # the model's state features, trained by this path as well

        counted = poutine.mask(mask=window.sequence_mask)  # type: ignore[call-overload]
        with pyro.plate("windows", len(window.actions)), counted:
            effect_code = pyro.sample("effect_code", self.effect_inference(first, last))
            motion = self.motion_inference(encoded, first.mask, window.actions, effect_code)
            pyro.sample("motion_code", motion)
