"""The input of every check: a trained model, its guide, and windows."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from cavin_pyro.config.commands.training import WindowConfig
from cavin_pyro.data.collection import CollectionConfig
from guides.guide import Guide
from models.model import Model
from models.networks.geometry import Geometry
from models.state import Window


@dataclass(frozen=True)
class CheckContext:
    """The input of a check.

    Attributes:
        model, guide: trained, in evaluation mode, without gradients. geometry: makes the features of new clouds.
        training: windows `[B]` that the model was trained on. validation: windows `[B]` of held-out episodes. In
            both every window counts for all terms (`sequence_mask` is set everywhere).
        seed: of everything random. world: in which new episodes are made.
        training_episodes, validation_episodes: number of each window's episode `[B]`, by which intervals are clustered;
            without it every window stands for an episode of its own.
        selection: the options by which training selected windows, such as how far an object had to move.
    """

    model: Model
    guide: Guide
    geometry: Geometry
    training: Window
    validation: Window
    seed: int = 0
    world: CollectionConfig = field(default_factory=CollectionConfig)
    training_episodes: Tensor | None = None
    validation_episodes: Tensor | None = None
    selection: WindowConfig = field(default_factory=WindowConfig)

    @property
    def codes(self) -> tuple[str, ...]:
        """Names of the model's latent sites: effect_code, motion_code, one of them, or none."""
        return self.model.codes

    def held_out(self, number: int) -> tuple[Window, Tensor]:
        """At most `number` of the held-out windows, the same ones each time, and the episode of each `[B]`."""
        return self._some(self.validation, self.validation_episodes, number)

    def trained_on(self, number: int) -> tuple[Window, Tensor]:
        """The same of the training windows."""
        return self._some(self.training, self.training_episodes, number)

    def _some(self, windows: Window, episodes: Tensor | None, number: int) -> tuple[Window, Tensor]:
        count = len(windows.actions)
        order = torch.randperm(count, generator=torch.Generator().manual_seed(self.seed))[:number]
        return windows.map(lambda field: field[order]), (torch.arange(count) if episodes is None else episodes)[order]
