"""Motion level: how to achieve it (paper, Algorithm 1, lines 8 to 10; section 3.2, "Motion-Level Plan")."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from models.state import State
from planning import ranking, returns
from planning.effects import EffectPlan
from planning.protocol import PlanningModel, RewardFunction
from planning.robustness import Robustness, try_again
from planning.sampling import sample_each


class MotionPlan(NamedTuple):
    """The chosen motion codes, their actions, and where f says that they lead; S segments of T steps."""

    codes: Tensor  # [B, S, 16] z*
    actions: Tensor  # [B, S T, 4] a*
    predicted_centers: Tensor  # [B, S T, M, 3] metres


def plan_motions(
    model: PlanningModel,
    reward: RewardFunction,
    state: State,
    effects: EffectPlan,
    generators: Sequence[torch.Generator],
    *,
    samples: int,
    segments: int,
    feature_weight: float,
    avoid_failures: bool,
    robustness: Robustness | None,
) -> MotionPlan:
    """Choose among N = `samples` sequences of S = `segments` motion codes for the scenes `state: [B]`.

    Segments after the end of the chosen effect plan have nothing to aim at, and do not count.
    Raises ValueError where no sequence of an environment leads to finite states.
    """
    plans = state.expand_plans(samples)  # [B, N, M, .]
    here = state.expand_plans(1)  # [B, 1, M, .]: all sequences begin here, as in `plan_effects`
    mask = plans.mask
    progress = returns.start(plans.centers)
    distance = first_distance = plans.centers.new_zeros(plans.batch_shape)
    sound = torch.ones_like(progress.failed)
    failed_in_executed = progress.failed
    codes, actions, paths = [], [], []
    for segment in range(segments):
        counts = (segment < effects.segments).unsqueeze(-1)  # [B, 1]
        effect_code = effects.codes[:, segment].unsqueeze(1).expand(-1, samples, -1)
        # Line 8, a segment at a time as in line 5; every sequence is paired with the chosen effect codes.
        code = sample_each(model.motion_prior, [plans, effect_code], generators)
        # Line 9: the actions by g, from the state that f predicted; the states by f, an action at a time.
        pushes = model.actions(here, effect_code, code)
        before, steps = plans.centers, []
        for push in pushes.unbind(-2):
            plans = here = model.next_state(here, push).expand(mask.shape[:2])
            steps.append(plans.centers)
        path = torch.stack(steps, -3)
        # Line 10: distance to the chosen subgoal, at the end of the segment.
        goal = effects.subgoals.step(slice(segment, segment + 1))  # [B, 1, M, .]
        from_goal = ranking.squared_distance(plans, goal, feature_weight=feature_weight)
        distance = distance + torch.where(counts, from_goal, 0.0)
        first_distance = distance if segment == 0 else first_distance
        sound = sound & (torch.isfinite(pushes).all(-1).all(-1) | ~counts)
        if avoid_failures:
            progress = progress._replace(succeeded=progress.succeeded | ~counts)  # nothing left to fail
            progress = returns.advance(progress, reward, before, path, mask)
            if segment == 0:
                failed_in_executed = progress.failed
        codes.append(code)
        actions.append(pushes)
        paths.append(path)

    # Line 10: choose the sequence that comes closest to the subgoals (our addition: if it does not fail).
    score = torch.where(sound, -distance, -torch.inf)
    score = ranking.prefer(score, ~failed_in_executed)
    score = ranking.prefer(score, ~progress.failed)
    chosen = ranking.best(score, "distances of motion plans to the subgoals")
    if robustness is not None:
        # Our addition: of the best, the one that still works where its pushes start a little elsewhere.
        first = effects.subgoals.step(slice(0, 1))
        numbers, cost = try_again(
            robustness, model, reward, state, first, score, actions[0], generators, feature_weight=feature_weight
        )
        cost = cost + (distance - first_distance).gather(1, numbers)  # later segments, as they were
        chosen = numbers.gather(1, cost.argmin(-1, keepdim=True)).squeeze(1)
    environments = torch.arange(len(chosen), device=chosen.device)
    return MotionPlan(
        codes=torch.stack([code[environments, chosen] for code in codes], 1),
        actions=torch.cat([pushes[environments, chosen] for pushes in actions], 1),
        predicted_centers=torch.cat([path[environments, chosen] for path in paths], 1),
    )
