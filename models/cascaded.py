"""The cascaded generative process as a Pyro program (paper, sections 3.1 and 3.3)."""

from __future__ import annotations

from typing import Any

import pyro
from pyro.distributions import TorchDistribution
from torch import Tensor

from cavin_pyro.models.checks import check_last
from cavin_pyro.models.model import Model, sequence_mask, windows_plate
from cavin_pyro.models.networks.dynamics import ActionGenerator, MetaDynamics
from cavin_pyro.models.priors.prior import Prior
from cavin_pyro.models.priors.standard import StandardPrior
from cavin_pyro.models.state import State, Window


class CascadedModel(Model):
    """Effects, motions and their outcomes, for each window with states s = s_0, ..., s_T = s'.

    c ~ p(c | s)                     # effect_code
    s' ~ h(s' | s, c)                # subgoal_centers, subgoal_features
    z ~ p(z | s, c)                  # motion_code
    a ~ g(a | s, c, z)               # actions, T of them
    s_t+1 ~ f(s_t+1 | s_t, a_t)      # next_centers, next_features, for t = 0, ..., T - 1

    `sequence_mask` masks the first four lines, `transition_mask` masks pair t of the last. A term counts the objects
    that are real in both of its states. Padding must be finite and is otherwise ignored. Of an initial window the last
    line samples one step after the other, at next_centers_1, next_features_1 and so on, and h and f count s's objects.
    """

    name = "cascaded"
    codes = ("effect_code", "motion_code")

    def __init__(
        self,
        *,
        effect_dimension: int = 16,
        motion_dimension: int = 16,
        effect_prior: Prior | None = None,
        motion_prior: Prior | None = None,
        **shared: Any,
    ) -> None:
        """The networks of the cascade.

        Args:
            effect_dimension: C, numbers of an effect code.
            motion_dimension: Z, numbers of a motion code.
            effect_prior: p(c | s); by default N(0, I).
            motion_prior: p(z | s, c); by default N(0, I).
            shared: the arguments of `Model`.
        """
        super().__init__(**shared)
        self.effect_dimension = effect_dimension
        self.motion_dimension = motion_dimension
        self.meta_dynamics = MetaDynamics(
            self.space, effect_dimension=effect_dimension, feature_dimension=self.feature_dimension, width=self.width
        )
        self.action_generator = ActionGenerator(
            self.space, segment_length=self.segment_length, motion_dimension=motion_dimension, width=self.width
        )
        self.prior_of_effects = effect_prior or StandardPrior(dimension=effect_dimension)
        self.prior_of_motions = motion_prior or StandardPrior(dimension=motion_dimension)

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

                motion_code = pyro.sample("motion_code", self.prior_of_motions(first, effect_code))

                mean = self.action_generator(effect, first, motion_code)
                actions = pyro.sample("actions", self.scales.actions(mean), obs=window.observed(window.actions))

            for step in self.transitions(window, encoded, actions):
                centers = pyro.sample(f"next_centers{step.suffix}", step.centers, obs=step.observed_centers)
                features = pyro.sample(f"next_features{step.suffix}", step.features, obs=step.observed_features)
                step.sampled = (centers, features)

    def effect_prior(self, state: State) -> TorchDistribution:
        """p(c | s): `state: [...]` -> batch `[...]`, event `[C]`."""
        self.space.check(state, self.feature_dimension)
        return self.prior_of_effects(state)

    def motion_prior(self, state: State, effect_code: Tensor) -> TorchDistribution:
        """p(z | s, c): `state: [...]`, `effect_code: [..., C]` -> batch `[...]`, event `[Z]`."""
        self.space.check(state, self.feature_dimension)
        check_last("effect_code", effect_code, self.effect_dimension)
        return self.prior_of_motions(state, effect_code)

    def subgoal(self, state: State, effect_code: Tensor) -> State:
        """Mean of h: `state: [...]`, `effect_code: [..., C]` -> the state T actions ahead."""
        return self.meta_dynamics(state, self.meta_dynamics.effect(self.encoder(state), effect_code))

    def actions(self, state: State, effect_code: Tensor, motion_code: Tensor) -> Tensor:
        """Mean of g: `state: [...]`, `effect_code: [..., C]`, `motion_code: [..., Z]` -> `[..., T, A]`."""
        effect = self.meta_dynamics.effect(self.encoder(state), effect_code)
        return self.action_generator(effect, state, motion_code)
