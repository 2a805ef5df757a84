"""The states that f predicts for actions (paper, equation 1; Algorithm 1, line 9)."""

from __future__ import annotations

import torch
from torch import Tensor

from models.state import State
from planning.protocol import DynamicsModel, SampledDynamics


def predict_states(model: DynamicsModel, here: State, pushes: Tensor) -> tuple[State, Tensor]:
    """T `pushes: [B, n, T, 4]` from `here: [B, n]` or `[B, 1]`: the last state `[B, n]` and the path `[B, n, T, M, 3]`.

    Step by step; the path is in metres.
    """
    steps = []
    for push in pushes.unbind(-2):
        here = model.next_state(here, push).expand(pushes.shape[:2])
        steps.append(here.centers)
    return here, torch.stack(steps, -3)


def sample_states(model: SampledDynamics, here: State, pushes: Tensor, uniform: Tensor) -> tuple[State, Tensor]:
    """The same, sampled from f's predictive distribution: push by push, each from the sample before.

    uniform: `[B, n, T, M, 2]` in [0, 1), which determines the samples of x and y.
    """
    steps = []
    for push, own in zip(pushes.unbind(-2), uniform.unbind(2), strict=True):
        here = model.sampled_next_state(here, push, own).expand(pushes.shape[:2])
        steps.append(here.centers)
    return here, torch.stack(steps, -3)
