"""The guide of `models/cascaded.py` (paper, section 3.3), and two ablations of what it reads."""

from __future__ import annotations

import pyro

from cavin_pyro.guides.guide import EffectInference, Guide, MotionInference
from cavin_pyro.models.cascaded import CascadedModel
from cavin_pyro.models.model import sequence_mask, windows_plate
from cavin_pyro.models.state import Window


class CascadedGuide(Guide):
    """Infers the two codes of each window, the motion given the effect.

    c ~ q_h(c | s, s')      # effect_code
    z ~ q_g(z | s, a, c)    # motion_code
    """

    fits = ("cascaded",)

    def __init__(
        self,
        model: CascadedModel,
        *,
        width: int = 64,
        effect_reads_actions: bool = False,
        motion_reads_effect: bool = True,
    ) -> None:
        """The inference networks. For `model` and `width` see `Guide`.

        Args:
            effect_reads_actions: whether the effect is inferred from the actions as well, q(c | s, s', a), as in the
                exact posterior (guide=joint).
            motion_reads_effect: whether the motion is inferred given the effect; without, q(z | s, a), the codes are
                independent given the window (guide=mean_field).
        """
        super().__init__(model)
        self.effect_inference = EffectInference(model, width=width, reads_actions=effect_reads_actions)
        self.motion_inference = MotionInference(model, width=width, reads_effect=motion_reads_effect)

    def forward(self, window: Window) -> None:
        """`window: [B]`."""
        first, last = window.first, window.last
        encoded = self.model.encode(window)

        with windows_plate(window), sequence_mask(window):
            effect_code = pyro.sample("effect_code", self.effect_inference(first, last, window.actions))
            motion = self.motion_inference(encoded[:, 0], first.mask, window.actions, effect_code)
            pyro.sample("motion_code", motion)
