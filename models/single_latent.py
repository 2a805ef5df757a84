"""One latent for states and actions, SeCTAR, as a Pyro program (paper, appendix A.2)."""

from __future__ import annotations

from typing import Any

import pyro
from pyro import poutine
from pyro.distributions import TorchDistribution
from torch import Tensor

from cavin_pyro.models.checks import check_number
from cavin_pyro.models.model import Model, sequence_mask, windows_plate
from cavin_pyro.models.networks.dynamics import ActionGenerator, MetaDynamics
from cavin_pyro.models.priors.prior import Prior
from cavin_pyro.models.priors.standard import StandardPrior
from cavin_pyro.models.state import State, Window


class SingleLatentModel(Model):
    """Effects that also determine the actions, for each window with states s = s_0, ..., s_T = s'.

    c ~ p(c | s)                     # effect_code
    s' ~ h(s' | s, c)                # subgoal_centers, subgoal_features
    a ~ g(a | s, c)                  # actions, T of them; log-density times action_weight
    s_t+1 ~ f(s_t+1 | s_t, a_t)      # next_centers, next_features, for t = 0, ..., T - 1

    Masks are as in `CascadedModel`, and so are the networks, without the layers that read z.
    """

    name = "single_latent"
    codes = ("effect_code",)

    def __init__(
        self,
        *,
        effect_dimension: int = 32,
        effect_prior: Prior | None = None,
        action_weight: float = 1.0,
        **shared: Any,
    ) -> None:
        """The networks of the cascade without the layers that read z.

        Args:
            effect_dimension: C, numbers of an effect code.
            effect_prior: p(c | s); by default N(0, I).
            action_weight: factor on the log-density of the actions, which balances the two reconstructions. The paper
                tunes it with care (section 4.2): up to a constant, a weight w divides the standard deviations of the
                actions by sqrt(w). The objective is a bound on the evidence only with 1.
            shared: the arguments of `Model`.

        Raises:
            ValueError: an `action_weight` that is not a positive number.
        """
        check_number("action_weight", action_weight, positive=True)
        super().__init__(**shared)
        self.effect_dimension = effect_dimension
        self.action_weight = action_weight
        self.meta_dynamics = MetaDynamics(
            self.space, effect_dimension=effect_dimension, feature_dimension=self.feature_dimension, width=self.width
        )
        self.action_generator = ActionGenerator(
            self.space, segment_length=self.segment_length, motion_dimension=None, width=self.width
        )
        self.prior_of_effects = effect_prior or StandardPrior(dimension=effect_dimension)

    def forward(self, window: Window) -> None:
        """Run the process for `window: [B]`, see `Model`."""
        encoded, first, last = self.encode(window), window.first, window.last
        real = first.mask & last.mask

        with windows_plate(window):
            with sequence_mask(window):
                effect_code = pyro.sample("effect_code", self.prior_of_effects(first))

                effect = self.meta_dynamics.effect(encoded[:, 0], effect_code)
                goal = self.meta_dynamics(first, effect)
                pyro.sample("subgoal_centers", self.scales.centers(goal, real), obs=window.observed(last.centers))
                pyro.sample("subgoal_features", self.scales.features(goal, real), obs=window.observed(last.features))

                mean = self.action_generator(effect, first)
                with poutine.scale(scale=self.action_weight):
                    actions = pyro.sample("actions", self.scales.actions(mean), obs=window.observed(window.actions))

            for step in self.transitions(window, encoded, actions):
                centers = pyro.sample(f"next_centers{step.suffix}", step.centers, obs=step.observed_centers)
                features = pyro.sample(f"next_features{step.suffix}", step.features, obs=step.observed_features)
                step.sampled = (centers, features)

    def effect_prior(self, state: State) -> TorchDistribution:
        """p(c | s): `state: [...]` -> batch `[...]`, event `[C]`."""
        self.space.check(state, self.feature_dimension)
        return self.prior_of_effects(state)

    def subgoal(self, state: State, effect_code: Tensor) -> State:
        """Mean of h: `state: [...]`, `effect_code: [..., C]` -> the state T actions ahead."""
        return self.meta_dynamics(state, self.meta_dynamics.effect(self.encoder(state), effect_code))

    def actions(self, state: State, effect_code: Tensor, motion_code: Tensor | None = None) -> Tensor:
        """Mean of g: `state: [...]`, `effect_code: [..., C]` -> `[..., T, A]`; the motion code is ignored."""
        return self.action_generator(self.meta_dynamics.effect(self.encoder(state), effect_code), state)
