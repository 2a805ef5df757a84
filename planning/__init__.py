"""What is chosen: planners over a learned model and a reward, for many environments at once."""

from planning.cavin import MOTION_HORIZONS, CavinPlanner
from planning.plan import Plan
from planning.protocol import Outcome, Planner, PlanningModel, RewardFunction
from planning.random_pushes import RandomPlanner
from planning.robustness import Robustness

__all__ = [
    "MOTION_HORIZONS",
    "CavinPlanner",
    "Outcome",
    "Plan",
    "Planner",
    "PlanningModel",
    "RandomPlanner",
    "RewardFunction",
    "Robustness",
]
