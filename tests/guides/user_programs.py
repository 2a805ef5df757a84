"""A user's own model with a discrete latent, and guides for it: one leaves it to enumeration, one infers it."""

from __future__ import annotations

from typing import Any

import pyro
import torch
from pyro.distributions import Categorical
from torch import nn

from cavin_pyro.guides.flat import FlatGuide
from cavin_pyro.models.flat import FlatModel
from cavin_pyro.models.model import sequence_mask, windows_plate
from cavin_pyro.models.state import Window


class KindsModel(FlatModel):
    """Motions of two kinds, which shift their pushes.

    k ~ Categorical(p)               # kind, 0 or 1
    z ~ p(z | s)                     # motion_code
    a ~ g(a | s, z) + shift_k        # actions
    s_t+1 ~ f(s_t+1 | s_t, a_t)      # next_centers, next_features
    """

    name = "kinds"

    def __init__(self, **shared: Any) -> None:
        super().__init__(**shared)
        self.logits = nn.Parameter(torch.tensor([0.4, -0.3]))
        self.shifts = nn.Parameter(torch.tensor([[0.2, 0.0, 0.1, 0.0], [-0.1, 0.1, 0.0, 0.3]]))

    def forward(self, window: Window) -> None:
        encoded, first = self.encode(window), window.first
        with windows_plate(window):
            with sequence_mask(window):
                kind = pyro.sample("kind", Categorical(logits=self.logits), infer={"enumerate": "parallel"})
                motion_code = pyro.sample("motion_code", self.prior_of_motions(first))
                mean = self.action_generator(self.trunk(encoded[:, 0]), first, motion_code)
                around = self.scales.actions(mean + self.shifts[kind].unsqueeze(-2))
                actions = pyro.sample("actions", around, obs=window.observed(window.actions))
            for step in self.transitions(window, encoded, actions):
                centers = pyro.sample(f"next_centers{step.suffix}", step.centers, obs=step.observed_centers)
                features = pyro.sample(f"next_features{step.suffix}", step.features, obs=step.observed_features)
                step.sampled = (centers, features)


class KindsGuide(FlatGuide):
    """z ~ q(z | s, a); the kind is enumerated."""

    fits = ("kinds",)


class InferredKindsGuide(KindsGuide):
    """k ~ q(k | a), z ~ q(z | s, a)."""

    def __init__(self, model: FlatModel, *, width: int = 64) -> None:
        super().__init__(model, width=width)
        self.kind = nn.Linear(12, 2)

    def forward(self, window: Window) -> None:
        encoded = self.model.encode(window)
        with windows_plate(window), sequence_mask(window):
            pyro.sample("kind", Categorical(logits=self.kind(window.actions.flatten(-2))))
            pyro.sample("motion_code", self.motion_inference(encoded[:, 0], window.first, window.actions))
