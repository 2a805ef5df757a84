"""Base class of guide programs, and their inference networks q_h and q_g (paper, section 3.3, appendix A.1)."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from pyro.distributions import TorchDistribution
from torch import Tensor, nn

from cavin_pyro.models.model import Model, Program
from cavin_pyro.models.networks.dynamics import EffectTrunk
from cavin_pyro.models.networks.layers import (
    POSITION_UNIT,
    GaussianCode,
    ObjectPool,
    fully_connected,
    relative_positions,
)
from cavin_pyro.models.state import State, Window


class Guide(Program):
    """A guide for the models in `fits`, by their `name`.

    A guide's `forward(window)` has a `pyro.sample` for every code of the model and no others. It reads the same state
    features as the model, `model.encode(window)`, which training computes once for both.

    Args:
        model: whose codes the guide infers, and whose other dimensions it has.
        width: width of the guide's own layers.
    """

    fits: ClassVar[tuple[str, ...]] = ()
    amortized: ClassVar[bool] = True  # whether it infers any window; False: only those that it has parameters for

    def __init__(self, model: Model) -> None:
        """Raises `ValueError` for an incompatible model."""
        super().__init__()
        if not isinstance(model, Model) or model.name not in self.fits:
            raise ValueError(
                f"guide {type(self).__name__} does not fit model {type(model).__name__}; it fits {', '.join(self.fits)}"
            )
        # In a tuple, so that the model's parameters are not registered (and saved) in the guide as well.
        self._model = (model,)

    def __call__(self, window: Window) -> Any:
        """Infer the codes of whole windows. Raises `ValueError` for initial ones."""
        if not window.whole:
            raise ValueError("a guide infers from whole windows: Predictive(model.generate, guide=guide)(window)")
        return super().__call__(window)

    @property
    def model(self) -> Model:
        """The model of this guide, with its dimensions and shared networks."""
        return self._model[0]


def push_features(width: int) -> nn.Sequential:
    """FC of each push, concatenated over T: `[..., T, 4] -> [..., T * width]`."""
    return nn.Sequential(fully_connected(4, width), nn.Flatten(-2))


class EffectInference(nn.Module):
    """q_h(c | s, s'): the effect between s and s'; with `reads_actions`, q(c | s, s', a).

    Per object two FC on (s, s' - s), centers and features; masked sum over objects; FC of each push, concatenated over
    T, with `reads_actions`; FC; Gaussian.
    """

    def __init__(self, model: Model, *, width: int = 64, reads_actions: bool = False) -> None:
        """For a `model` with an effect code. `width`: of all layers."""
        super().__init__()
        inputs = 2 * (3 + model.feature_dimension)
        self.objects = nn.Sequential(fully_connected(inputs, width), fully_connected(width, width))
        self.pushes = push_features(width) if reads_actions else None
        self.scene = fully_connected(width + model.segment_length * width if reads_actions else width, width)
        self.code: nn.Module = GaussianCode(model.effect_dimension, width=width)

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
    """q_g(z | s, a, c): the motion behind the actions; without `reads_effect`, q(z | s, a), which ignores the code.

    (s, c) pooled as in the action generator; FC of each push, concatenated over T; FC of both; Gaussian.
    """

    def __init__(self, model: Model, *, width: int = 64, reads_effect: bool = True) -> None:
        """For a `model` with a motion code. `width`: of all layers."""
        super().__init__()
        code = model.effect_dimension if reads_effect else None
        self.trunk = EffectTrunk(code, width=width, encoder_width=model.width)
        self.pool = ObjectPool(width)
        self.pushes = push_features(width)
        self.from_pushes = nn.Linear(model.segment_length * width, width)
        self.from_pooled = nn.Linear(width, width, bias=False)
        self.code: nn.Module = GaussianCode(model.motion_dimension, width=width)

    def forward(
        self, encoded: Tensor, mask: Tensor, actions: Tensor, effect_code: Tensor | None = None
    ) -> TorchDistribution:
        """Leading dimensions broadcast.

        Args:
            encoded: `[..., M, 3 * model.width]`, features of s from the model's `StateEncoder`.
            mask: `[..., M]` of s.
            actions: `[..., T, 4]`.
            effect_code: `[..., C]`.
        """
        pooled = self.pool(self.trunk(encoded, effect_code), mask)
        # A linear layer on (pooled, pushes), in two parts, because only the first varies with the code.
        feature = (self.from_pooled(pooled) + self.from_pushes(self.pushes(actions))).relu()
        return self.code(feature)
