"""Push-T: a disc pushes a T-shaped block to a goal pose (`gym-pusht`)."""

from cavin_pyro.envs.pusht.policy import CENTER, OUTLINE, PushTPolicy, in_window
from cavin_pyro.envs.pusht.world import PoseGoal, PushT

__all__ = ["CENTER", "OUTLINE", "PoseGoal", "PushT", "PushTPolicy", "in_window"]
