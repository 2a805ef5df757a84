"""Planners over a learned model and a reward, for many environments at once.

`cavin` is Algorithm 1 of the paper, `baselines` has the planners that it compares with, `additions` what we add. All
search candidates (`rollout`, `returns`) with one of the `optimizers`; `protocol` says what a model and a reward offer.
"""

from cavin_pyro.planning.additions import Addition
from cavin_pyro.planning.baselines import (
    CavinWithoutEffectsPlanner,
    CvaeMpcPlanner,
    MpcPlanner,
    PolicyPlanner,
    RandomPlanner,
    SectarPlanner,
)
from cavin_pyro.planning.cavin import CavinPlanner
from cavin_pyro.planning.protocol import Plan, Planner, PlanningModel, Reward, RewardFunction, StepOutcome

__all__ = [
    "Addition",
    "CavinPlanner",
    "CavinWithoutEffectsPlanner",
    "CvaeMpcPlanner",
    "MpcPlanner",
    "Plan",
    "Planner",
    "PlanningModel",
    "PolicyPlanner",
    "RandomPlanner",
    "Reward",
    "RewardFunction",
    "SectarPlanner",
    "StepOutcome",
]
