"""Effect level: what to achieve (paper, Algorithm 1, lines 5 to 7; section 3.2, "Effect-Level Plan")."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from models.state import State
from planning import ranking, returns
from planning.protocol import PlanningModel, RewardFunction
from planning.replacement import draw_parents, trace_back
from planning.sampling import sample_each


class EffectPlan(NamedTuple):
    """The chosen effect codes and subgoals, and all candidates."""

    codes: Tensor  # [B, K, 16] c*
    subgoals: State  # [B, K, M, .]
    segments: Tensor  # [B] int64, 1..K: segments until the plan ends
    expected_return: Tensor  # [B]
    expected_success: Tensor  # [B] bool
    candidate_centers: Tensor  # [B, N, K, M, 3] metres
    candidate_returns: Tensor  # [B, N]


def plan_effects(
    model: PlanningModel,
    reward: RewardFunction,
    state: State,
    generators: Sequence[torch.Generator],
    *,
    samples: int,
    segments: int,
) -> EffectPlan:
    """Choose among N = `samples` plans of K = `segments` subgoals for the scenes `state: [B]`.

    Raises ValueError where no plan of an environment has a finite return.
    """
    plans = state.expand_plans(samples)  # [B, N, M, .]
    here = state.expand_plans(1)  # [B, 1, M, .]: all plans begin here, so the model need not compute it N times
    mask = plans.mask
    progress = returns.start(plans.centers)
    own_numbers = torch.arange(samples, device=mask.device).expand(plans.batch_shape)
    codes, subgoals, parents = [], [], []
    for segment in range(segments):
        # Line 5, a segment at a time: a learned prior p(c | s) has to see the state that it goes on from.
        code = sample_each(model.effect_prior, [plans], generators)
        # Line 6: predict the subgoals with h, recursively; plans that have ended stay where they are ...
        subgoal = _where(progress.active, model.subgoal(here, code).expand(mask.shape[:2]), plans)
        # ... and interpolate the states between them.
        path = returns.interpolate(plans.centers, subgoal.centers, model.segment_length)
        # Line 7: cumulative reward.
        progress = returns.advance(progress, reward, plans.centers, path, mask)
        plans, parent = subgoal, own_numbers
        if segment < segments - 1 and bool(progress.failed.any()):
            # Section 3.2: plans that failed early are replaced by copies of plans that are still active.
            parent = draw_parents(progress.failed, progress.active, generators)
            plans, progress = plans.take_plans(parent), progress.take_plans(parent)
        here = plans
        codes.append(code)
        subgoals.append(subgoal)
        parents.append(parent)

    # Line 7: choose the highest return, and follow its codes and subgoals back through the copies.
    chosen = ranking.best(progress.returns, "returns of effect plans")  # [B]
    numbers = trace_back(torch.stack(parents))  # [K, B, N]
    environments = torch.arange(len(chosen), device=chosen.device)
    numbers_chosen = numbers[:, environments, chosen]  # [K, B]
    pairs = list(zip(subgoals, numbers, strict=True))
    return EffectPlan(
        codes=_follow(codes, numbers_chosen),
        subgoals=State(*(_follow(field, numbers_chosen) for field in zip(*subgoals, strict=True))),
        segments=progress.segments[environments, chosen],
        expected_return=progress.returns[environments, chosen],
        expected_success=progress.succeeded[environments, chosen],
        candidate_centers=torch.stack(
            [subgoal.centers[environments[:, None], number] for subgoal, number in pairs], dim=2
        ),
        candidate_returns=progress.returns,
    )


def _where(condition: Tensor, states: State, otherwise: State) -> State:
    """`states` where `condition: [B, N]` holds, else `otherwise`; no copy where it holds everywhere."""
    if bool(condition.all()):
        return states
    per_object = condition[..., None, None]
    return State(
        torch.where(per_object, states.centers, otherwise.centers),
        torch.where(per_object, states.features, otherwise.features),
        states.mask,
    )


def _follow(fields: Sequence[Tensor], numbers: Tensor) -> Tensor:
    """One plan's record of every segment: K fields `[B, N, ...]`, `numbers: [K, B]` -> `[B, K, ...]`."""
    environments = torch.arange(numbers.shape[1], device=numbers.device)
    return torch.stack([field[environments, number] for field, number in zip(fields, numbers, strict=True)], 1)
