"""What the plans of an episode tell about its success, as numbers: by-products of planning, kept in its row."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from torch import Tensor

from cavin_pyro.evaluation.rollout import Episode, PlanRecord

Columns = Mapping[str, Sequence[float | None]]  # a number per plan, by name; None where a planner does not know it
DIGITS = 5  # significant ones, of numbers in a row

# Unit and meaning of each number. All are known when the plan is made.
PROSPECTS = {
    "step": "pushes made before",
    "pushes_left": "pushes that the episode still allows",
    "objects": "objects that are observed",
    "distance": "metres left to the goal by the task's potential, as observed",
    "way": "metres left to the goal along allowed places, as observed; with guidance only",
    "way_after": "the same at the end of the chosen plan, by the model",
    "reaches": "1 if the chosen plan reaches the goal by the model, else 0",
    "reaching": "share of the candidates that do",
    "segments": "of the chosen plan until it ends",
    "expected_return": "cumulative reward of the chosen plan",
    "failures": "share of the perturbed rollouts of the chosen motion that fail",
    "tracking": "metres from the predicted end of the chosen motion to its subgoal, the mean over objects",
}


def prospects_of(episode: Episode) -> dict[str, list[float | None]] | None:
    """The numbers `PROSPECTS` of every plan of an episode; None if its planner predicts nothing."""
    if any(record.plan.prospects is None for record in episode.plan_records) or not episode.plan_records:
        return None
    lines = [_prospects(record) for record in episode.plan_records]
    return {name: [_rounded(line[name]) for line in lines] for name in PROSPECTS}


def _prospects(record: PlanRecord) -> dict[str, float]:
    plan, told = record.plan, record.plan.prospects
    assert told is not None
    return {
        "step": record.step,
        "pushes_left": record.pushes_left,
        "objects": int(record.mask.sum()),
        "distance": record.distance,
        "way": float(told.way[0]),
        "way_after": float(told.way_after[0]),
        "reaches": int(plan.expected_success[0]),
        "reaching": float(told.reaching[0]),
        "segments": int(plan.segments[0]),
        "expected_return": float(plan.expected_return[0]),
        "failures": float(told.failures[0]),
        "tracking": _tracking(record),
    }


def _tracking(record: PlanRecord) -> float:
    """Metres, or NaN for a plan without subgoals."""
    plan = record.plan
    if plan.subgoals.centers.shape[1] == 0:
        return math.nan
    segment_length = plan.actions.shape[1]
    off: Tensor = (plan.predicted_centers[0, segment_length - 1] - plan.subgoals.centers[0, 0]).norm(dim=-1)
    return float(off[plan.subgoals.mask[0, 0]].mean())


def _rounded(value: float) -> float | None:
    if not math.isfinite(value):
        return None
    return value if isinstance(value, int) else float(f"{value:.{DIGITS}g}")
