"""Effects that motions can bring about (our addition to Algorithm 1, line 7)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from models.state import State
from planning import ranking, returns
from planning.candidates import Candidates, Search
from planning.following import follow
from planning.inputs import check_positive
from planning.levels import predicted_effect
from planning.protocol import PlanningModel, RewardFunction
from planning.sampling import sample_each
from planning.segments import Stretch


@dataclass(frozen=True)
class Reachability:
    """How the best effect plans are scored anew by what f predicts of their first segment, instead of h.

    h promises some subgoals that no pushes lead to. finalists: effect plans that are looked at, the best by line 7.
    motions: codes drawn for the first segment of each, of which the one counts that f says comes closest to the
    subgoal. From there on h goes on with the plan's other effect codes.

    Raises ValueError for counts below 1.
    """

    finalists: int = 32
    motions: int = 32

    def __post_init__(self) -> None:
        check_positive("finalists", self.finalists)
        check_positive("motions", self.motions)


def most_reachable(
    options: Reachability, candidates: Candidates, model: PlanningModel, reward: RewardFunction
) -> Tensor:
    """The effect plan `[B]` int64 with the highest return by f and then h, of equals the one that f comes closest to.

    candidates: effect plans `[B, N]` of K segments; the reward is that of motions, which are not to fail.
    Raises ValueError where no finalist of an environment has a finite return.
    """
    count = min(options.finalists, candidates.count)
    numbers = candidates.returns.topk(count, -1).indices
    finalists = candidates.take(numbers)
    codes = finalists.history(lambda segment: segment.stretch.code)  # [B, F, K, C]
    first, distance = _first_segment(options, finalists, codes[:, :, 0], model, reward)
    search = candidates.search
    level = _FirstByMotions(model, first, codes)
    again = Search(level, search.score, search.state, search.generators, search.segments).begin(count)
    for _ in range(search.segments):
        again = again.extend()
    best = ranking.best(again.returns, "returns of effect plans, as far as motions reach them")
    equals = again.returns >= again.returns.gather(1, best.unsqueeze(-1))
    closest = ranking.best(ranking.prefer(-distance, equals), "distances of motions to subgoals")
    return numbers.gather(1, closest.unsqueeze(-1)).squeeze(-1)


def _first_segment(
    options: Reachability, finalists: Candidates, codes: Tensor, model: PlanningModel, reward: RewardFunction
) -> tuple[Stretch, Tensor]:
    """Of each finalist the motion `[B, F]` that comes closest to its first subgoal, and how close in square metres."""
    state, count = finalists.search.state, finalists.count
    plans = state.expand_plans(count * options.motions)
    repeated = codes.repeat_interleave(options.motions, dim=1)  # [B, F m, C]
    motion = sample_each(model.motion_prior, [plans, repeated], finalists.search.generators)
    here = state.expand_plans(1)
    pushes = model.actions(here, repeated, motion)
    ends, path = follow(model, here, pushes)
    goals = State(
        finalists.at(0, lambda segment: segment.stretch.states.centers).repeat_interleave(options.motions, dim=1),
        ends.features,
        plans.mask,
    )
    distance = ranking.squared_distance(ends, goals)
    progress = returns.advance(returns.start(plans.centers), reward, plans.centers, path, plans.mask)
    sound = torch.isfinite(distance) & torch.isfinite(pushes).all(-1).all(-1)
    distance = torch.where(sound, distance, torch.inf).unflatten(1, (count, options.motions))
    scores = ranking.prefer(-distance.flatten(0, 1), ~progress.failed.reshape(-1, options.motions))
    closest = scores.argmax(-1).unflatten(0, (-1, count))  # [B, F]
    number = closest + options.motions * torch.arange(count, device=closest.device)
    rows = torch.arange(len(number), device=number.device).unsqueeze(-1)
    stretch = Stretch(codes, pushes[rows, number], ends.take_plans(number), path[rows, number])
    return stretch, distance.gather(-1, closest.unsqueeze(-1)).squeeze(-1)


class _FirstByMotions:
    """Given plans: the first segment as it was predicted by f, the others by h from there."""

    dimension = 0  # there is nothing to search

    def __init__(self, model: PlanningModel, first: Stretch, codes: Tensor) -> None:
        self.model, self.first, self.codes = model, first, codes

    def extend(
        self, segment: int, here: State, plans: State, noise: Tensor | None, generators: Sequence[torch.Generator]
    ) -> Stretch:
        if segment == 0:
            return self.first
        return predicted_effect(self.model, here, plans, self.codes[:, :, segment])
