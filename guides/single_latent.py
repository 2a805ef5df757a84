"""The guide of `models/single_latent.py` (paper, appendix A.2)."""

from __future__ import annotations

import pyro

from cavin_pyro.guides.cascaded import EffectInference
from cavin_pyro.guides.guide import Guide
from cavin_pyro.models.model import Model, sequence_mask, windows_plate
from cavin_pyro.models.state import Window


class SingleLatentGuide(Guide):
    """Infers the one code of each window from its states.

    c ~ q_h(c | s, s')      # effect_code

    Like SeCTAR's encoder it reads states only, through the cascade's effect inference network. With `reads_actions` it
    is q(c | s, s', a): c decodes the actions too.
    """

    fits = ("single_latent",)

    def __init__(self, model: Model, *, width: int = 64, reads_actions: bool = False) -> None:
        """The inference network. For `model` and `width` see `Guide`.

        Args:
            reads_actions: whether the code is inferred from the actions as well, q(c | s, s', a).
        """
        super().__init__(model)
        self.effect_inference = EffectInference(model, width=width, reads_actions=reads_actions)

    def forward(self, window: Window) -> None:
        """`window: [B]`."""
        with windows_plate(window), sequence_mask(window):
            pyro.sample("effect_code", self.effect_inference(window.first, window.last, window.actions))
