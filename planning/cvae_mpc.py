"""CVAE-MPC as the paper adapts it: a flat generative model of motions (appendix A.2)."""

from __future__ import annotations

from typing import Any

from planning.levels import MotionLevel
from planning.protocol import PlanningModel, RewardFunction
from planning.push_search import PushSearch


class CvaeMpcPlanner(PushSearch):
    """Sequences of K motion codes z ~ p(z | s), T pushes g(s, z) for each, and what f predicts of all H pushes.

    model: p(z | s), g without effect codes, f. For the options and errors see `PushSearch`.
    """

    needs = ("motion_prior", "actions", "next_state")
    lacks = ("effect_prior",)
    usual_model = "flat"
    has_codes = True

    def __init__(self, model: PlanningModel, reward: RewardFunction, **options: Any) -> None:
        """`options` are those of `PushSearch`."""
        super().__init__(MotionLevel(model, None), model, reward, **options)
