"""What is chosen: planners over a learned model and a reward, for many environments at once.

A planner is a composition: what is searched (`planning.levels`: codes at two levels or one, raw pushes), by an
optimiser (`planning.optimisers`), scored by returns (`planning.rewards`) or aim (`planning.motions`). All of them
roll out in `planning.candidates`.
"""

from planning.cavin import MOTION_HORIZONS, CavinPlanner
from planning.cvae_mpc import CvaeMpcPlanner
from planning.mpc import MpcPlanner
from planning.plan import Plan
from planning.proposals import PushBox
from planning.protocol import Outcome, Planner, PlanningModel, RewardFunction
from planning.random_pushes import RandomPlanner
from planning.reachability import Reachability
from planning.robustness import Robustness
from planning.sectar import SectarPlanner

__all__ = [
    "MOTION_HORIZONS",
    "CavinPlanner",
    "CvaeMpcPlanner",
    "MpcPlanner",
    "Outcome",
    "Plan",
    "Planner",
    "PlanningModel",
    "PushBox",
    "RandomPlanner",
    "Reachability",
    "RewardFunction",
    "Robustness",
    "SectarPlanner",
]
