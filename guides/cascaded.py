"""The guide of `models/cascaded.py`, two ablations, and its networks q_h and q_g (paper, section 3.3, appendix A.1)."""

from __future__ import annotations

import pyro
import torch
from pyro.distributions import TorchDistribution
from torch import Tensor, nn

from cavin_pyro.guides.guide import Guide
from cavin_pyro.models.model import Model, sequence_mask, windows_plate
from cavin_pyro.models.networks.dynamics import EffectTrunk
from cavin_pyro.models.networks.layers import GaussianCode, ObjectPool, fully_connected
from cavin_pyro.models.state import State, Window


class CascadedGuide(Guide):
    """Infers the two codes of each window, the motion given the effect.

    c ~ q_h(c | s, s')      # effect_code
    z ~ q_g(z | s, a, c)    # motion_code
    """

    fits = ("cascaded",)

    def __init__(
        self, model: Model, *, width: int = 64, effect_reads_actions: bool = False, motion_reads_effect: bool = True
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
            motion = self.motion_inference(encoded[:, 0], first, window.actions, effect_code)
            pyro.sample("motion_code", motion)


def action_features(model: Model, width: int) -> nn.Sequential:
    """FC of each action, concatenated over T: `[..., T, A] -> [..., T * width]`."""
    return nn.Sequential(fully_connected(model.space.actions, width), nn.Flatten(-2))


class EffectInference(nn.Module):
    """q_h(c | s, s'): the effect between s and s'; with `reads_actions`, q(c | s, s', a).

    Per object two FC on (s, s' - s), centers and features; masked sum over objects; FC of each action, concatenated
    over T, with `reads_actions`; FC; Gaussian.
    """

    def __init__(self, model: Model, *, width: int = 64, reads_actions: bool = False) -> None:
        """For a `model` with an effect code. `width`: of all layers."""
        super().__init__()
        self.space = space = model.space
        inputs = space.inputs + space.positions + 2 * model.feature_dimension
        self.objects = nn.Sequential(fully_connected(inputs, width), fully_connected(width, width))
        self.pushes = action_features(model, width) if reads_actions else None
        self.scene = fully_connected(width + model.segment_length * width if reads_actions else width, width)
        self.code: nn.Module = GaussianCode(model.effect_dimension, width=width)

    def forward(self, state: State, subgoal: State, actions: Tensor | None = None) -> TorchDistribution:
        """`state, subgoal: [...]`, `actions: [..., T, A]` -> batch `[...]`; counts objects that are real in both."""
        space = self.space
        parts = (
            space.describe(state, space.locate(state)),
            state.features,
            space.turn((subgoal.centers - state.centers) / space.length, state),
            space.turn(subgoal.features - state.features, state),
        )
        real = (state.mask & subgoal.mask).unsqueeze(-1)
        pooled = (self.objects(torch.cat(parts, -1)) * real).sum(-2)
        if self.pushes is not None:
            assert actions is not None
            pooled = torch.cat((pooled, self.pushes(space.turn_actions(actions, state))), -1)
        return self.code(self.scene(pooled))


class MotionInference(nn.Module):
    """q_g(z | s, a, c): the motion behind the actions; without `reads_effect`, q(z | s, a), which ignores the code.

    (s, c) pooled as in the action generator; FC of each action, concatenated over T; FC of both; Gaussian.
    """

    def __init__(self, model: Model, *, width: int = 64, reads_effect: bool = True) -> None:
        """For a `model` with a motion code. `width`: of all layers."""
        super().__init__()
        self.space = model.space
        code = model.effect_dimension if reads_effect else None
        self.trunk = EffectTrunk(code, width=width, encoder_width=model.width)
        self.pool = ObjectPool(width)
        self.pushes = action_features(model, width)
        self.from_pushes = nn.Linear(model.segment_length * width, width)
        self.from_pooled = nn.Linear(width, width, bias=False)
        self.code: nn.Module = GaussianCode(model.motion_dimension, width=width)

    def forward(
        self, encoded: Tensor, state: State, actions: Tensor, effect_code: Tensor | None = None
    ) -> TorchDistribution:
        """Leading dimensions broadcast.

        Args:
            encoded: `[..., M, 3 * model.width]`, features of s from the model's `StateEncoder`.
            state: s, `[...]`.
            actions: `[..., T, A]`.
            effect_code: `[..., C]`.
        """
        pooled = self.pool(self.trunk(encoded, effect_code), state.mask)
        # A linear layer on (pooled, actions), in two parts, because only the first varies with the code.
        feature = (
            self.from_pooled(pooled) + self.from_pushes(self.pushes(self.space.turn_actions(actions, state)))
        ).relu()
        return self.code(feature)
