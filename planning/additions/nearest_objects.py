"""Plans about the target and the objects nearest to it (our addition to Algorithm 1, lines 5 to 9)."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from cavin_pyro.models.checks import check_number
from cavin_pyro.planning.additions.addition import Addition
from cavin_pyro.planning.focus import Focus
from cavin_pyro.planning.protocol import Query


@dataclass(frozen=True)
class NearestObjects(Addition):
    """Where the goal is about the target, plans are about it and the objects nearest to it, `objects` in all.

    h, g and the priors read and move only these, so they read no more objects than in training. f still predicts all,
    because an excluded object can obstruct a push. Raises ValueError for a count below 1.
    """

    objects: int = 2

    def __post_init__(self) -> None:
        check_number("objects", self.objects, 1, whole=True)

    def focus(self, focus: Focus, scene: Query) -> Focus:
        """See `Addition`; all objects in scenes of up to `objects`."""
        state = scene.state
        if state.objects <= self.objects or scene.reward.about != "target":
            return focus
        distances = (state.centers[..., :2] - state.centers[:, :1, :2]).norm(dim=-1)  # [B, M] metres
        distances = torch.where(state.mask, distances, torch.inf)
        return Focus(distances.topk(self.objects, largest=False).indices.sort(-1).values)
