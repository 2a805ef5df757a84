"""Planners over a learned model and a reward, for many environments at once.

`planning/cavin.py` is Algorithm 1. The subpackages: `rollouts` (candidates, segment by segment), `optimizers` (which
search candidates), `extensions` (our additions), `baselines` (the planners that the paper compares with) and `backends`
(which run the inner functions).
"""

from planning.baselines.cavin_without_effects import CavinWithoutEffectsPlanner
from planning.baselines.cvae_mpc import CvaeMpcPlanner
from planning.baselines.mpc import MpcPlanner
from planning.baselines.proposals import PushBox
from planning.baselines.random_pushes import RandomPlanner
from planning.baselines.sectar import SectarPlanner
from planning.cavin import MOTION_HORIZONS, CavinPlanner
from planning.extensions.perturbed_rollouts import PerturbedRollouts
from planning.plan import Plan
from planning.protocol import Outcome, Planner, PlanningModel, RewardFunction

__all__ = [
    "MOTION_HORIZONS",
    "CavinPlanner",
    "CavinWithoutEffectsPlanner",
    "CvaeMpcPlanner",
    "MpcPlanner",
    "Outcome",
    "PerturbedRollouts",
    "Plan",
    "Planner",
    "PlanningModel",
    "PushBox",
    "RandomPlanner",
    "RewardFunction",
    "SectarPlanner",
]
