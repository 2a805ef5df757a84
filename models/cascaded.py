"""The cascaded generative process as a Pyro program (paper, sections 3.1 and 3.3)."""

from __future__ import annotations

import pyro
from pyro import poutine
from pyro.distributions import TorchDistribution
from torch import Tensor, nn

from models.action_generator import ActionGenerator
from models.dynamics import Dynamics, MetaDynamics
from models.encoder import StateEncoder
from models.likelihoods import LikelihoodScales, Scales
from models.priors import StandardPrior
from models.program import Program
from models.state import State, Window
from models.transitions import generate_transitions, observe_transitions


class CascadedModel(Program):
    """Effects, motions and their outcomes, for each window with states s = s_0, ..., s_T = s'.

    c ~ p(c | s)                     # effect_code
    s' ~ h(s' | s, c)                # subgoal_centers, subgoal_features
    z ~ p(z | s, c)                  # motion_code
    a ~ g(a | s, c, z)               # actions, T pushes
    s_t+1 ~ f(s_t+1 | s_t, a_t)      # next_centers, next_features, for t = 0, ..., T - 1

    The first four lines count where `sequence_mask` is set, pair t of the last where `transition_mask` is.
    Objects count that are real in both states of a term. Padding is finite and otherwise ignored.
    """

    name = "cascaded"

    def __init__(
        self,
        *,
        segment_length: int = 3,
        effect_dimension: int = 16,
        motion_dimension: int = 16,
        feature_dimension: int = 64,
        width: int = 64,
        maximum_objects: int = 5,
        effect_prior: nn.Module | None = None,
        motion_prior: nn.Module | None = None,
        scales: Scales | None = None,
    ) -> None:
        super().__init__()
        self.segment_length = segment_length
        self.effect_dimension = effect_dimension
        self.motion_dimension = motion_dimension
        self.feature_dimension = feature_dimension
        self.width = width
        self.maximum_objects = maximum_objects
        self.scales = scales or LikelihoodScales()
        self.encoder = StateEncoder(feature_dimension=feature_dimension, width=width, maximum_objects=maximum_objects)
        self.dynamics = Dynamics(feature_dimension=feature_dimension, width=width)
        self.meta_dynamics = MetaDynamics(
            effect_dimension=effect_dimension, feature_dimension=feature_dimension, width=width
        )
        self.action_generator = ActionGenerator(
            segment_length=segment_length, motion_dimension=motion_dimension, width=width
        )
        self.prior_of_effects = effect_prior or StandardPrior(dimension=effect_dimension)
        self.prior_of_motions = motion_prior or StandardPrior(dimension=motion_dimension)

    def forward(self, window: Window, generate: bool = False) -> None:
        """Run the process for `window: [B]`, a batch of training examples.

        With `generate=True` only the first states are read; subgoals, actions and next states are drawn
        instead of observed (next states push by push, see `models/transitions.py`).
        Raises `ValueError` for windows of another shape, more objects or features of another length.
        """
        self._check(window)
        # Reading a network off the program may announce its parameters to Pyro: read each once.
        encoder, meta_dynamics, scales = self.encoder, self.meta_dynamics, self.scales
        first, last = window.first, window.last
        real = first.mask if generate else first.mask & last.mask
        before = window.states.step(slice(0, 1) if generate else slice(0, -1))
        encoded = encoder(before)  # [B, T, M, 3 * width]; only the first state when generating

        def seen(value: Tensor) -> Tensor | None:
            return None if generate else value

        counted = poutine.mask(mask=window.sequence_mask)  # type: ignore[call-overload]
        with pyro.plate("windows", len(window.actions)):
            with counted:
                effect_code = pyro.sample("effect_code", self.prior_of_effects(first))
                effect = meta_dynamics.effect(encoded[:, 0], effect_code)
                subgoal = meta_dynamics(first, effect)
                pyro.sample("subgoal_centers", scales.centers(subgoal, real), obs=seen(last.centers))
                pyro.sample("subgoal_features", scales.features(subgoal, real), obs=seen(last.features))
                motion_code = pyro.sample("motion_code", self.prior_of_motions(first, effect_code))
                mean = self.action_generator(effect, first.mask, motion_code)
                actions = pyro.sample("actions", scales.actions(mean), obs=seen(window.actions))
            if generate:
                generate_transitions(self.dynamics, encoder, scales, first, actions)
            else:
                observe_transitions(self.dynamics, scales, window, encoded)

    def effect_prior(self, state: State) -> TorchDistribution:
        """p(c | s): `state: [...]` -> batch `[...]`, event `[C]`."""
        return self.prior_of_effects(state)

    def motion_prior(self, state: State, effect_code: Tensor) -> TorchDistribution:
        """p(z | s, c): `state: [...]`, `effect_code: [..., C]` -> batch `[...]`, event `[Z]`."""
        return self.prior_of_motions(state, effect_code)

    def subgoal(self, state: State, effect_code: Tensor) -> State:
        """Mean of h: `state: [...]`, `effect_code: [..., C]` -> the state T pushes ahead."""
        meta_dynamics = self.meta_dynamics
        return meta_dynamics(state, meta_dynamics.effect(self.encoder(state), effect_code))

    def actions(self, state: State, effect_code: Tensor, motion_code: Tensor) -> Tensor:
        """Mean of g: `state: [...]`, `effect_code: [..., C]`, `motion_code: [..., Z]` -> `[..., T, 4]`."""
        effect = self.meta_dynamics.effect(self.encoder(state), effect_code)
        return self.action_generator(effect, state.mask, motion_code)

    def next_state(self, state: State, action: Tensor) -> State:
        """Mean of f: `state: [...]`, `action: [..., 4]` -> the state after one push."""
        return self.dynamics(state, self.encoder(state), action)

    def _check(self, window: Window) -> None:
        if len(window.batch_shape) != 1:
            raise ValueError(f"windows come as one batch [B]; got leading dimensions {[*window.batch_shape]}")
        if window.segment_length != self.segment_length:
            raise ValueError(
                f"window has {window.segment_length} pushes; this model was made for {self.segment_length}"
            )
