"""The input of every check: a trained model, its guide, and windows."""

from __future__ import annotations

from dataclasses import dataclass, field

from cavin_pyro.data.collection import CollectionConfig
from guides.guide import Guide
from models.model import Model
from models.networks.geometry import Geometry
from models.state import Window


@dataclass(frozen=True)
class CheckContext:
    """The input of a check.

    Attributes:
        model, guide: trained, in evaluation mode, without gradients. pointnet: makes the features of new clouds.
        training: windows `[B]` that the model was trained on. validation: windows `[B]` of held-out episodes. In
            both every window counts for all terms (`sequence_mask` is set everywhere).
        seed: of everything random. world: in which new episodes are made.
    """

    model: Model
    guide: Guide
    pointnet: Geometry
    training: Window
    validation: Window
    seed: int = 0
    world: CollectionConfig = field(default_factory=CollectionConfig)

    @property
    def codes(self) -> tuple[str, ...]:
        """Names of the model's latent sites: effect_code, motion_code, one of them, or none."""
        return self.model.codes
