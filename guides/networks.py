"""Inference networks q_h and q_g (paper, section 3.3, appendix A.1)."""

from __future__ import annotations

import torch
from pyro.distributions import TorchDistribution
from torch import Tensor, nn

from models.model import Model
from models.networks.dynamics import EffectTrunk
from models.networks.layers import POSITION_UNIT, GaussianCode, ObjectPool, fully_connected, relative_positions
from models.state import State


def push_features(width: int) -> nn.Sequential:
    """FC of each push, concatenated over T: `[..., T, 4] -> [..., T * width]`."""
    return nn.Sequential(fully_connected(4, width), nn.Flatten(-2))


class EffectInference(nn.Module):
    """q_h(c | s, s'): the effect between s and s'; with `reads_actions`, q(c | s, s', a).

    Per object two FC on (s, s' - s), centers and features; masked sum over objects; FC of each push, concatenated over
    T, with `reads_actions`; FC; Gaussian.
    """

    def __init__(
        self,
        *,
        effect_dimension: int = 16,
        feature_dimension: int = 64,
        width: int = 64,
        reads_actions: bool = False,
        segment_length: int = 3,
    ) -> None:
        super().__init__()
        self.objects = nn.Sequential(fully_connected(2 * (3 + feature_dimension), width), fully_connected(width, width))
        self.pushes = push_features(width) if reads_actions else None
        self.scene = fully_connected(width + segment_length * width if reads_actions else width, width)
        self.code: nn.Module = GaussianCode(effect_dimension, width=width)

    def forward(self, state: State, subgoal: State, actions: Tensor | None = None) -> TorchDistribution:
        """`state, subgoal: [...]`, `actions: [..., T, 4]` -> batch `[...]`; counts objects that are real in both."""
        parts = (
            relative_positions(state.centers),
            state.features,
            (subgoal.centers - state.centers) / POSITION_UNIT,
            subgoal.features - state.features,
        )
        real = (state.mask & subgoal.mask).unsqueeze(-1)
        pooled = (self.objects(torch.cat(parts, -1)) * real).sum(-2)
        if self.pushes is not None:
            pooled = torch.cat((pooled, self.pushes(actions)), -1)
        return self.code(self.scene(pooled))


class MotionInference(nn.Module):
    """q_g(z | s, a, c): the motion behind the actions; with `effect_dimension=None`, q(z | s, a).

    (s, c) pooled as in the action generator; FC of each push, concatenated over T; FC of both; Gaussian.
    """

    def __init__(
        self,
        *,
        segment_length: int = 3,
        effect_dimension: int | None = 16,
        motion_dimension: int = 16,
        width: int = 64,
        encoder_width: int = 64,
    ) -> None:
        super().__init__()
        self.trunk = EffectTrunk(effect_dimension, width=width, encoder_width=encoder_width)
        self.pool = ObjectPool(width)
        self.pushes = push_features(width)
        self.from_pushes = nn.Linear(segment_length * width, width)
        self.from_pooled = nn.Linear(width, width, bias=False)
        self.code: nn.Module = GaussianCode(motion_dimension, width=width)

    def forward(
        self, encoded: Tensor, mask: Tensor, actions: Tensor, effect_code: Tensor | None = None
    ) -> TorchDistribution:
        """Leading dimensions broadcast.

        Args:
            encoded: `[..., M, 3 * encoder_width]`, features of s from the model's `StateEncoder`.
            mask: `[..., M]` of s.
            actions: `[..., T, 4]`.
            effect_code: `[..., C]`.
        """
        pooled = self.pool(self.trunk(encoded, effect_code), mask)
        # A linear layer on (pooled, pushes), in two parts, because only the first varies with the code.
        feature = (self.from_pooled(pooled) + self.from_pushes(self.pushes(actions))).relu()
        return self.code(feature)


def effect_inference(model: Model, *, width: int, reads_actions: bool = False) -> EffectInference:
    """q(c | s, s') or q(c | s, s', a) for a model with an effect code."""
    return EffectInference(
        effect_dimension=model.effect_dimension,
        feature_dimension=model.feature_dimension,
        width=width,
        reads_actions=reads_actions,
        segment_length=model.segment_length,
    )


def motion_inference(model: Model, *, width: int, reads_effect: bool) -> MotionInference:
    """q(z | s, a, c) or q(z | s, a) for a model with a motion code."""
    return MotionInference(
        segment_length=model.segment_length,
        effect_dimension=model.effect_dimension if reads_effect else None,
        motion_dimension=model.motion_dimension,
        width=width,
        encoder_width=model.width,
    )
