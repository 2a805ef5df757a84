"""By-products of planning that help to predict the success of an episode, stored in the episode's row."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from planning import Plan

PredictorValues = Mapping[str, float]  # the numbers of one plan, by name; NaN where its planner does not know one
Columns = Mapping[str, Sequence[float | None]]  # those of all plans of an episode, as in its row: None for NaN
DIGITS = 5  # significant ones, of numbers in a row

# All are known when the plan is made. The names are those in stored rows.
SUCCESS_PREDICTORS = {
    "step": "pushes made before",
    "pushes_left": "pushes that the episode still allows",
    "objects": "objects that are observed",
    "distance": "metres left to the goal by the task's potential, as observed",
    "allowed_distance": "metres left to the goal along allowed places, as observed; with guidance only",
    "allowed_distance_after": "the same at the end of the chosen plan, by the model",
    "reaches": "1 if the chosen plan reaches the goal by the model, else 0",
    "reaching": "share of the candidates that do",
    "segments": "of the chosen plan until it ends",
    "expected_return": "cumulative reward of the chosen plan",
    "failures": "share of the perturbed rollouts of the chosen motion that fail",
    "tracking": "metres from the predicted end of the chosen motion to its subgoal, the mean over objects",
}


def success_predictors(
    plan: Plan, *, step: int, pushes_left: int, distance: float, mask: NDArray[np.bool_]
) -> PredictorValues | None:
    """The numbers `SUCCESS_PREDICTORS` of a plan for one environment; None if its planner predicts nothing.

    Args:
        distance: metres, minus the task's `potential`. mask: [M], of the observation.
    """
    found = plan.success_predictors
    if found is None:
        return None
    numbers = {
        "step": step,
        "pushes_left": pushes_left,
        "objects": int(mask.sum()),
        "distance": distance,
        "allowed_distance": found.distance_to_goal.item(),
        "allowed_distance_after": found.distance_to_goal_after.item(),
        "reaches": int(plan.expected_success.item()),
        "reaching": found.reaching.item(),
        "segments": int(plan.segments.item()),
        "expected_return": plan.expected_return.item(),
        "failures": found.failures.item(),
        "tracking": _tracking(plan),
    }
    return {name: _rounded(value) for name, value in numbers.items()}


def columns_of(plans: Sequence[PredictorValues | None]) -> dict[str, list[float | None]] | None:
    """The numbers of all plans of an episode by name, for its row; None if its planner predicts nothing."""
    known = [plan for plan in plans if plan is not None]
    if not known or len(known) < len(plans):
        return None
    return {name: [_known(plan[name]) for plan in known] for name in SUCCESS_PREDICTORS}


def plans_of(columns: Columns) -> list[PredictorValues]:
    """The numbers of each plan, from an episode's row."""
    lines = zip(*(columns[name] for name in SUCCESS_PREDICTORS), strict=True)
    return [
        {name: math.nan if value is None else value for name, value in zip(SUCCESS_PREDICTORS, line, strict=True)}
        for line in lines
    ]


def _tracking(plan: Plan) -> float:
    """Metres, or NaN for a plan without subgoals."""
    if plan.subgoals.centers.shape[1] == 0:
        return math.nan
    reached, subgoal = plan.predicted_centers[0, plan.actions.shape[1] - 1], plan.subgoals.centers[0, 0]
    return (reached - subgoal).norm(dim=-1)[plan.subgoals.mask[0, 0]].mean().item()


def _rounded(value: float) -> float:
    """As a row has it, so that a probability follows from the row."""
    return value if isinstance(value, int) or not math.isfinite(value) else float(f"{value:.{DIGITS}g}")


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None
