"""MPC: sampling in the original action space (paper, section 4.1 and appendix A.2)."""

from __future__ import annotations

from typing import Any

from planning.levels import PushLevel
from planning.proposals import HeuristicPushes, Proposal, PushBox, UniformPushes
from planning.protocol import PlanningModel, RewardFunction
from planning.push_search import PushSearch

PROPOSALS = ("uniform", "heuristic")


class MpcPlanner(PushSearch):
    """Sequences of H raw pushes, and what f predicts of them, step by step.

    model: f alone is asked, so any model will do. proposal: `uniform` over the action space (paper), or `heuristic`,
    pushes that are likely to move something (a stronger variant, see `planning.proposals.HeuristicPushes`), which needs
    `box`. For the other options and errors see `PushSearch`.
    """

    needs = ("next_state",)
    usual_model = "dynamics"

    def __init__(
        self,
        model: PlanningModel,
        reward: RewardFunction,
        *,
        proposal: str = "uniform",
        box: PushBox | None = None,
        **options: Any,
    ) -> None:
        """`options` are those of `PushSearch`."""
        super().__init__(PushLevel(model, _proposal(proposal, box)), model, reward, **options)


def _proposal(name: str, box: PushBox | None) -> Proposal:
    if name == "uniform":
        return UniformPushes()
    if name != "heuristic":
        raise ValueError(f"unknown proposal '{name}': take {' or '.join(PROPOSALS)}")
    if box is None:
        raise ValueError("proposal heuristic needs the box that pushes start in")
    return HeuristicPushes(box)
