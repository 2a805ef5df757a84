"""Base class of planners that search: their options, the search itself, and many environments in chunks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import wraps
from operator import itemgetter
from typing import Any, ClassVar

import torch
from torch import Tensor

from cavin_pyro.models.state import State
from cavin_pyro.planning import records
from cavin_pyro.planning.additions.guidance import check_guidance, distance_to_goal_of, guided_return
from cavin_pyro.planning.additions.perturbed_rollouts import PerturbedRollouts
from cavin_pyro.planning.additions.touchdown import TOUCHDOWN_DISTANCE, ObservedPoints, prefer_free
from cavin_pyro.planning.backends import make_backend
from cavin_pyro.planning.checks import NoFiniteCandidateError, check_horizon, check_positive, check_scenes, check_weight
from cavin_pyro.planning.optimizers import Optimizer, make_optimizer, search
from cavin_pyro.planning.protocol import (
    DistanceToGoal,
    DynamicsModel,
    EpisodicReward,
    FixedShapes,
    ModelRequirements,
    Objective,
    Plan,
    RewardFunction,
    SearchSpace,
)
from cavin_pyro.planning.returns import CumulativeReward, StrideLimits
from cavin_pyro.planning.rollout import Candidates, SearchProblem

ROBUSTNESS = PerturbedRollouts()
# Measured: a plan of 1,024 samples fills a processor's caches; sixteen plans in one pass take 1.6 times as long per
# plan. Matrix products of another number of rows may also round differently, and a plan must not depend on its
# neighbours.
ENVIRONMENTS_ON_PROCESSOR = 1
PLANS_ON_ACCELERATOR = 131_072  # samples of all environments of a chunk

PlanMethod = Callable[..., Plan]  # (self, state, generators, observed)


def chunked(plan: PlanMethod) -> PlanMethod:
    """Let a planner's method `plan` take any number of environments `[B]`, in chunks of whole environments.

    It concatenates the plans of the chunks. Raises ValueError for a state that is not a batch of scenes, for another
    number of generators than B, and for an environment without a finite candidate, which it names.
    """

    @wraps(plan)
    def planned(
        self: SearchingPlanner,
        state: State,
        generators: Sequence[torch.Generator],
        observed: ObservedPoints | None = None,
    ) -> Plan:
        check_scenes(state, generators)
        size, plans = ENVIRONMENTS_ON_PROCESSOR, []
        if state.centers.device.type != "cpu":
            size = max(1, PLANS_ON_ACCELERATOR // self.samples)
        for start in range(0, max(len(generators), 1), size):
            chunk = slice(start, start + size)
            seen = observed and records.apply(observed, itemgetter(chunk))
            try:
                plans.append(plan(self, state.scene(chunk), generators[chunk], seen))
            except NoFiniteCandidateError as error:
                raise NoFiniteCandidateError(start + error.environment, error.what) from error
        return plans[0] if len(plans) == 1 else records.join(plans, dimension=0)

    return planned


class SearchingPlanner:
    """Searches N = `samples` plans of K = `horizon` / T segments for the highest cumulative reward.

    The options, of which `cavin_pyro.planning.cavin.CavinPlanner` has more:

    samples: N, plans to compare.
    horizon: H steps, a multiple of the model's T.
    optimizer: searches the plans: `shooting` (paper), `cem`, `icem`, `mppi`, `evolution`, `smc`, or a
        `cavin_pyro.planning.optimizers.Optimizer`.
    reward_at: `path` rewards interpolated states as well (paper), `subgoals` only the end of each segment (published
        implementation).
    stride_limits: two distances in metres; a segment that moves every object less than the first, or any object more
        than the second, ends the plan like a violation (0.1 and 0.3 from subgoal to subgoal in the published
        implementation); None in the paper.
    early_stopping: `shooting` stops when no candidate can become the best, which leaves the chosen plan as it is up to
        its end (our addition); false in the paper. Codes then follow from noise, which is sampled beforehand.
    robustness: ranks the best plans by perturbed rollouts (our addition); None in the paper.
    touchdown_distance: metres; plans whose first push starts nearer to a point that the camera sees are left out, as
        far as the caller gives such points (our addition to line 10); 0 in the paper.
    guidance: `layout` prefers, among plans that miss the goal, those that leave the shortest way to it along allowed
        places (our addition); `none` in the paper.
    compile: true compiles the inner functions by `torch.compile`, which takes minutes and is cached on disk;
        `cuda_graphs` captures them on the GPU where the model is. Codes then follow from noise, too.
    """

    requires: ClassVar[ModelRequirements]  # of the planner on its model
    strides: ClassVar[str] = "segments"  # unit of `stride_limits`: "segments" or "pushes"

    def __init__(
        self,
        model: DynamicsModel,
        reward: RewardFunction,
        samples: int = 1024,
        horizon: int = 30,
        *,
        optimizer: str | Optimizer = "shooting",
        reward_at: str = "path",
        stride_limits: Sequence[float] | None = None,
        early_stopping: bool = True,
        robustness: PerturbedRollouts | None = ROBUSTNESS,
        touchdown_distance: float = TOUCHDOWN_DISTANCE,
        guidance: str = "none",
        compile: bool | str = False,
    ) -> None:
        """Raises ValueError for numbers out of range, a horizon that T does not divide, unknown names."""
        check_positive("samples", samples)
        check_horizon(horizon, model.segment_length)
        check_weight("touchdown_distance", touchdown_distance)
        check_guidance(guidance)
        self.optimizer = make_optimizer(optimizer, samples=samples)
        self.model, self._reward, self.guidance = model, reward, guidance
        self.reward_at, self.stride_limits = reward_at, stride_limits
        self.backend = make_backend(compile, model.fixed_shapes if isinstance(model, FixedShapes) else nullcontext)
        self.reparameterized = early_stopping or bool(compile)
        _ = self.cumulative_reward(), self.distance_to_goal  # refuse bad options now, not in the first plan
        self.early_stopping, self.robustness = early_stopping, robustness
        self.touchdown_distance = touchdown_distance
        self.samples = samples
        self.segments = horizon // model.segment_length  # line 1 of Algorithm 1: K = H / T

    @property
    def segment_length(self) -> int:
        """T, the number of pushes in a plan's `actions`."""
        return self.model.segment_length

    @property
    def reward(self) -> RewardFunction:
        """The task's reward, in this episode."""
        return self._reward.current if isinstance(self._reward, EpisodicReward) else self._reward

    @property
    def distance_to_goal(self) -> DistanceToGoal | None:
        """The distance to the goal, in this episode; None without guidance."""
        return distance_to_goal_of(self.guidance, self.reward)

    def cumulative_reward(self) -> CumulativeReward:
        """The objective of effect codes and pushes, in this episode."""
        reward, limits = self.reward, self.stride_limits
        return CumulativeReward(
            reward if limits is None else StrideLimits(reward, limits, of=self.strides), self.reward_at
        )

    def search(
        self,
        space: SearchSpace,
        objective: Objective,
        state: State,
        generators: Sequence[torch.Generator],
        *,
        optimizer: Optimizer | None = None,
        segments: int | None = None,
        samples: int | None = None,
        early_stopping: bool = False,
    ) -> Candidates:
        """All candidates `[B, N]` that the optimizer evaluates.

        Args:
            space: extends candidates by a segment, from D numbers of noise. objective: ranks them.
            state: `[B]`, observed scenes. generators: one per scene.
            optimizer: by default `self.optimizer`.
            segments: of a candidate, by default K. samples: number of candidates, by default N.
            early_stopping: whether the search may stop when no candidate can become the best.

        Raises:
            ValueError: codes must be reparameterised and their prior cannot be.
        """
        problem = SearchProblem(
            space,
            objective,
            state,
            generators,
            self.segments if segments is None else segments,
            self.reparameterized,
            early_stopping,
            self.backend,
        )
        return search(optimizer or self.optimizer, problem, self.samples if samples is None else samples)

    def search_by_reward(self, space: SearchSpace, state: State, generators: Sequence[torch.Generator]) -> Candidates:
        """Candidates `[B, N]` of K segments, searched by cumulative reward."""
        objective = guided_return(self.cumulative_reward(), self.distance_to_goal)
        return self.search(space, objective, state, generators, early_stopping=self.early_stopping)

    def prefer_free(self, scores: Tensor, pushes: Tensor, observed: ObservedPoints | None) -> Tensor:
        """Scores `[B, N]` that leave out candidates whose first push would touch down on an object.

        pushes: `[B, N, T, 4]`, their first segments.
        """
        return prefer_free(scores, pushes[..., 0, :], observed, self.touchdown_distance)


def summary(candidates: Candidates, best: Tensor) -> dict[str, Any]:
    """The fields of a `Plan` about its search.

    candidates: `[B, N]`, evaluated by cumulative reward, guided or not. best: `[B]` int64, index of the chosen one.
    """
    progress = candidates.score_state
    environments = torch.arange(len(best), device=best.device)
    return {
        "segments": progress.segments[environments, best],
        "expected_return": progress.earned[environments, best],
        "expected_success": progress.succeeded[environments, best],
        "candidate_centers": candidates.centers,
        "candidate_returns": progress.earned,
        "evidence": candidates.problem.evidence[-1] if candidates.problem.evidence else None,
        "share_reaching_goal": progress.succeeded.float().mean(-1),
    }
