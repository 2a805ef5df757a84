"""MPC: sampling in the original action space (paper, section 4.1 and appendix A.2)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from models.state import State
from planning.baselines.proposals import HeuristicPushes, Proposal, PushBox, UniformPushes
from planning.baselines.push_search import PushSearch
from planning.protocol import DynamicsModel, ModelRequirements, RewardFunction
from planning.rollouts.dynamics import predict_states
from planning.rollouts.sampling import noise_each
from planning.rollouts.segment import SegmentRollout

PROPOSALS = ("uniform", "heuristic")


class PushSpace(NamedTuple):
    """Raw pushes, T a segment, and the states that f predicts."""

    model: DynamicsModel
    proposal: Proposal

    @property
    def dimension(self) -> int:
        """The numbers of noise that the proposal takes for T pushes."""
        return self.proposal.shared + self.model.segment_length * self.proposal.own

    def extend(
        self, segment: int, here: State, plans: State, noise: Tensor | None, generators: Sequence[torch.Generator]
    ) -> SegmentRollout:
        """See `planning.rollouts.segment.SearchSpace`."""
        if noise is None:
            noise = noise_each((plans.batch_shape[-1], self.dimension), generators, plans.centers.device)
        shared, pushes, path = noise[..., : self.proposal.shared], [], []
        for own in noise[..., self.proposal.shared :].split(self.proposal.own, -1):
            push = self.proposal(plans, shared, own).unsqueeze(-2)
            plans, step = predict_states(self.model, here, push)
            here = plans
            pushes.append(push)
            path.append(step)
        actions = torch.cat(pushes, -2)
        return SegmentRollout(actions.flatten(-2), actions, plans, torch.cat(path, -3))


class MpcPlanner(PushSearch):
    """Sequences of H raw pushes, and the states that f predicts for them, step by step.

    model: any model, since only f is used. proposal: `uniform` over the action space (paper), or `heuristic`,
    pushes that are likely to move something (a stronger variant, see `HeuristicPushes`), which needs `box`.
    For the other options and errors see `PushSearch`.
    """

    requires = ModelRequirements("dynamics", ("next_state",))

    def __init__(
        self,
        model: DynamicsModel,
        reward: RewardFunction,
        *,
        proposal: str = "uniform",
        box: PushBox | None = None,
        **options: Any,
    ) -> None:
        """`options` are those of `PushSearch`."""
        super().__init__(PushSpace(model, _proposal(proposal, box)), model, reward, **options)


def _proposal(name: str, box: PushBox | None) -> Proposal:
    if name == "uniform":
        return UniformPushes()
    if name != "heuristic":
        raise ValueError(f"unknown proposal '{name}': choose {' or '.join(PROPOSALS)}")
    if box is None:
        raise ValueError("proposal heuristic needs the box that pushes start in")
    return HeuristicPushes(box)
