"""Effects of the prior, which terms of the objective beside the bound ask the model about."""

from __future__ import annotations

import torch
from pyro.distributions import TorchDistribution
from torch import Tensor

from models.model import Model
from models.state import State, Window


def sample(prior: TorchDistribution) -> Tensor:
    """A sample of a prior; `sample` of torch's normal distributions waits for a GPU, to check their scales."""
    return prior.rsample() if prior.has_rsample else prior.sample()


@torch.no_grad()
def sample_effects(model: Model, window: Window, windows: int) -> tuple[State, Tensor]:
    """An effect c ~ p(c | s) for the first states of b = at most `windows` of the B windows.

    Returns:
        The states `[b, 1]` and the effect codes `[b, 1, C]`.
    """
    state = window.first.scene(slice(0, windows))
    return state.expand_plans(1), sample(model.effect_prior(state)).unsqueeze(-2)
