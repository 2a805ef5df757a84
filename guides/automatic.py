"""Pyro's automatic guides, for a fixed set of windows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pyro
import torch
from pyro import poutine
from torch import Tensor, nn

from cavin_pyro.guides.guide import Guide
from cavin_pyro.models.model import Model
from cavin_pyro.models.state import Window


class AutomaticGuide(Guide):
    """One of `pyro.infer.autoguide`: it reads the model's sites and has parameters for every window on its own.

    The other guides compute q(c, z | window) with a network, so they infer any window. This one holds the posteriors of
    the windows of its first call as numbers: it fits those windows and no others, and cannot be trained on batches.
    `AutoNormal` and `AutoDelta` treat the windows apart; `AutoLowRankMultivariateNormal`, `AutoIAFNormal` and other
    subclasses of `AutoContinuous` have one density over the codes of all windows.
    """

    fits = ("cascaded", "single_latent", "flat")
    amortized = False
    fixed_actions: Tensor | None

    def __init__(self, model: Model, *, autoguide: Callable[[Model], nn.Module]) -> None:
        """Pyro's guide of the model.

        Args:
            autoguide: a class of `pyro.infer.autoguide`, or one of your own that takes the model.

        Raises:
            ValueError: an incompatible model, or a class that is no module.
        """
        super().__init__(model)
        with pyro.settings.context(module_local_params=True):  # which Pyro's modules must know when they are made
            self.automatic = autoguide(model)
        if not isinstance(self.automatic, nn.Module):
            raise ValueError(f"guide.autoguide makes a {type(self.automatic).__name__}, which is no torch module")
        self.register_buffer("fixed_actions", None)

    def forward(self, window: Window) -> Any:
        """`window: [B]`, those of the first call, which makes the parameters. Raises `ValueError` for others.

        So it does if one of the first does not count (`sequence_mask`): Pyro's automatic guides know no masks.
        """
        if self.fixed_actions is None:
            if not bool(window.sequence_mask.all()):
                raise ValueError("an automatic guide takes windows that all count: see sequence_mask")
            with torch.no_grad():
                self.automatic(window)
            self.fixed_actions = window.actions.clone()
        elif not torch.equal(self.fixed_actions, window.actions):
            raise ValueError(
                f"this automatic guide has parameters for {len(self.fixed_actions)} windows, and these are others: "
                "make one for each set of windows, or choose a guide that infers any window"
            )
        # `AutoMessenger` runs the model, whose observations are no guide's.
        with poutine.block(hide_fn=lambda site: site["type"] == "sample" and site["is_observed"]):
            return self.automatic(window)
