"""Plans about few objects, the target and those nearest to it (our addition to Algorithm 1, lines 5 to 9)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from cavin_pyro.models.checks import check_number
from cavin_pyro.planning.additions.addition import Addition
from cavin_pyro.planning.checks import UnsuitedError
from cavin_pyro.planning.focus import Focus
from cavin_pyro.planning.protocol import Query


@dataclass(frozen=True)
class NearestObjects(Addition):
    """Where the goal is about the target, plans are about it and the objects nearest to it, `objects` in all.

    h, g and the priors read and move only these, so they read no more objects than in training. f still predicts all,
    because an excluded object can obstruct a push.

    of_all: where the goal is about all objects, plans are about so many, with the shortest ways left; null: about all.
        Plans then raise UnsuitedError for a reward that does not know the remaining distance to the goal.

    Raises ValueError for a count below 1.
    """

    objects: int = 2
    of_all: int | None = None

    def __post_init__(self) -> None:
        check_number("objects", self.objects, 1, whole=True)
        check_number("of_all", 1 if self.of_all is None else self.of_all, 1, whole=True)

    def focus(self, focus: Focus, scene: Query) -> Focus:
        """See `Addition`; all objects in scenes of up to as many."""
        state, about_all = scene.state, scene.reward.about == "all"
        most = self.of_all if about_all else self.objects
        if most is None or state.objects <= most or scene.reward.about not in ("all", "target"):
            return focus
        if about_all:
            distances = self.ways_left(scene)
        else:
            distances = (state.centers[..., :2] - state.centers[:, :1, :2]).norm(dim=-1)  # [B, M] metres
        distances = torch.where(state.mask, distances, torch.inf)
        return Focus(distances.topk(most, largest=False).indices.sort(-1).values)

    def ways_left(self, scene: Query) -> Tensor:
        """Metres that each object is away from its goal, `[B, M]`; infinite where it has arrived."""
        distance, state = scene.reward.distance_to_goal(), scene.state.expand_plans(scene.state.objects)
        if distance is None:
            raise UnsuitedError("nearest_objects.of_all needs a reward with a `distance_to_goal`: set it to null")
        left = distance(state.centers, torch.eye(state.objects, dtype=torch.bool, device=state.centers.device))
        return torch.where(left > 0, left, torch.inf)
