"""Motions without effects, CVAE-MPC, as a Pyro program (paper, appendix A.2)."""

from __future__ import annotations

from typing import Any

import pyro
from pyro.distributions import TorchDistribution
from torch import Tensor

from cavin_pyro.models.model import Model, sequence_mask, windows_plate
from cavin_pyro.models.networks.dynamics import ActionGenerator, EffectTrunk
from cavin_pyro.models.priors.prior import Prior
from cavin_pyro.models.priors.standard import StandardPrior
from cavin_pyro.models.state import State, Window


class FlatModel(Model):
    """Motions and their outcomes, for each window with states s = s_0, ..., s_T.

    z ~ p(z | s)                     # motion_code
    a ~ g(a | s, z)                  # actions, T of them
    s_t+1 ~ f(s_t+1 | s_t, a_t)      # next_centers, next_features, for t = 0, ..., T - 1

    Masks are as in `CascadedModel`, and so are the networks, without h and the layers that read c.
    """

    name = "flat"
    codes = ("motion_code",)

    def __init__(self, *, motion_dimension: int = 32, motion_prior: Prior | None = None, **shared: Any) -> None:
        """The networks of the cascade without h and the layers that read c.

        Args:
            motion_dimension: Z, numbers of a motion code.
            motion_prior: p(z | s); by default N(0, I).
            shared: the arguments of `Model`.
        """
        super().__init__(**shared)
        self.motion_dimension = motion_dimension
        self.trunk = EffectTrunk(None, width=self.width, encoder_width=self.width)
        self.action_generator = ActionGenerator(
            self.space, segment_length=self.segment_length, motion_dimension=motion_dimension, width=self.width
        )
        self.prior_of_motions = motion_prior or StandardPrior(dimension=motion_dimension)

    def forward(self, window: Window) -> None:
        """Run the process for `window: [B]`, see `Model`."""
        encoded, first = self.encode(window), window.first

        with windows_plate(window):
            with sequence_mask(window):
                motion_code = pyro.sample("motion_code", self.prior_of_motions(first))

                mean = self.action_generator(self.trunk(encoded[:, 0]), first, motion_code)
                actions = pyro.sample("actions", self.scales.actions(mean), obs=window.observed(window.actions))

            for step in self.transitions(window, encoded, actions):
                centers = pyro.sample(f"next_centers{step.suffix}", step.centers, obs=step.observed_centers)
                features = pyro.sample(f"next_features{step.suffix}", step.features, obs=step.observed_features)
                step.sampled = (centers, features)

    def motion_prior(self, state: State, effect_code: Tensor | None = None) -> TorchDistribution:
        """p(z | s): `state: [...]` -> batch `[...]`, event `[Z]`; the effect code is ignored."""
        self.space.check(state, self.feature_dimension)
        return self.prior_of_motions(state)

    def actions(self, state: State, effect_code: Tensor | None = None, *, motion_code: Tensor) -> Tensor:
        """Mean of g: `state: [...]`, `motion_code: [..., Z]` -> `[..., T, A]`; the effect code is ignored."""
        return self.action_generator(self.trunk(self.encoder(state)), state, motion_code)
