"""Regressors of success: functions of the success predictors of an episode's plans so far."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

from cavin_pyro.evaluation.success.predictors import PredictorValues

FEW = 1e-3  # added to the share of candidates before its logarithm: about one of 1,024
CLOSER = 0.02  # metres; less is no progress


class Regressor(NamedTuple):
    """A function of the plans up to now, NaN where the planner does not know it.

    sign: 1 if more of it can only make success likelier, -1 if less likely.
    """

    sign: int
    value: Callable[[Sequence[PredictorValues]], float]


def left(plan: PredictorValues) -> float:
    """Metres left to the goal: along allowed places where guidance knows them, else by the task's potential."""
    return plan["distance"] if math.isnan(plan["allowed_distance"]) else plan["allowed_distance"]


def without_progress(plans: Sequence[PredictorValues]) -> int:
    """Pushes since the distance left was last shortened by `CLOSER`."""
    nearest, since = math.inf, plans[0]["step"]
    for plan in plans:
        if left(plan) < nearest - CLOSER:
            nearest, since = left(plan), plan["step"]
    return int(plans[-1]["step"] - since)


# What each means for the last of the plans so far.
REGRESSORS = {
    "reaches the goal": Regressor(1, lambda plans: plans[-1]["reaches"]),
    "log share that reaches it": Regressor(1, lambda plans: math.log10(plans[-1]["reaching"] + FEW)),
    "failed rollouts": Regressor(-1, lambda plans: plans[-1]["failures"]),
    "metres per push left": Regressor(-1, lambda plans: left(plans[-1]) / plans[-1]["pushes_left"]),
    "log pushes without progress": Regressor(-1, lambda plans: math.log10(1 + without_progress(plans))),
    "objects": Regressor(-1, lambda plans: plans[-1]["objects"]),
}
