"""Base class of planners that search: their options, and the search itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, ClassVar

import torch
from torch import Tensor

from models.state import State
from planning.backends.compiled import Compiled
from planning.backends.cuda_graphs import CudaGraphs
from planning.backends.eager import Backend, eager
from planning.extensions.guidance import check_guidance, distance_to_goal_of, guided_return
from planning.extensions.idle_pushes import IDLE_DISTANCE, idle_last
from planning.extensions.perturbed_rollouts import PerturbedRollouts
from planning.extensions.touchdown import TOUCHDOWN_DISTANCE, ObservedPoints, prefer_free
from planning.extensions.warm_start import chosen_noise, warm_start_noise
from planning.inputs import check_horizon, check_positive, check_weight
from planning.optimizers import Optimizer, make_optimizer, search
from planning.plan import Plan
from planning.protocol import (
    DistanceToGoal,
    DynamicsModel,
    EpisodicReward,
    FixedShapes,
    ModelRequirements,
    RewardFunction,
    SampledDynamics,
)
from planning.rollouts.candidates import Candidates, SearchProblem
from planning.rollouts.cumulative_reward import CumulativeReward, StrideLimits
from planning.rollouts.segment import Objective, SearchSpace

ROBUSTNESS = PerturbedRollouts()
AUTO = "auto"  # value of `compile`: native code where it is cached; never compiles
GRAPHS = "cuda_graphs"  # value of `compile`: for models on a GPU


class SearchingPlanner:
    """Searches N = `samples` plans of K = `horizon` / T segments for the highest cumulative reward.

    The options, of which `planning.cavin.CavinPlanner` says more:

    samples: N, plans to compare.
    horizon: H steps, a multiple of the model's T.
    optimizer: searches the plans: `shooting` (paper), `cem`, `icem`, `mppi`, `evolution`, `smc`, or a
        `planning.optimizers.Optimizer`.
    reward_at: `path` rewards interpolated states as well (paper), `subgoals` only the end of each segment.
    stride_limits: two distances in metres; a segment that moves every object less than the first, or any object more
        than the second, ends the plan like a violation; None in the paper.
    warm_start: the last plan's noise is among the candidates of `shooting`, `evolution` and `smc` (our addition).
    robustness: ranks the best plans by perturbed rollouts (our addition); None in the paper.
    idle_distance: metres; pushes that, according to f, move no object by this distance come last (our addition); 0 in
        the paper.
    touchdown_distance: metres; plans whose first push starts nearer to a point that the camera sees are left out (our
        addition); 0 in the paper.
    guidance: `layout` prefers, among plans that miss the goal, those that leave the shortest way to it along allowed
        places (our addition); `none` in the paper.
    compile: true runs the inner functions as native code, which takes minutes once and is cached on disk; `auto` loads
        what is cached and runs the rest eagerly; `cuda_graphs` captures them on the GPU where the model is.
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
        warm_start: bool = True,
        robustness: PerturbedRollouts | None = ROBUSTNESS,
        idle_distance: float = IDLE_DISTANCE,
        touchdown_distance: float = TOUCHDOWN_DISTANCE,
        guidance: str = "none",
        compile: bool | str = False,
    ) -> None:
        """Raises ValueError for numbers out of range, a horizon that T does not divide, unknown names, no compiler."""
        check_positive("samples", samples)
        check_horizon(horizon, model.segment_length)
        check_weight("idle_distance", idle_distance)
        check_weight("touchdown_distance", touchdown_distance)
        check_guidance(guidance)
        self.optimizer = make_optimizer(optimizer, samples=samples)
        self.model, self._reward, self.guidance = model, reward, guidance
        self.reward_at, self.stride_limits = reward_at, stride_limits
        self.backend = _backend(compile, model.fixed_shapes if isinstance(model, FixedShapes) else nullcontext)
        self.reparameterized = warm_start or bool(compile)
        if robustness is not None and robustness.outcomes == "sampled" and not isinstance(model, SampledDynamics):
            raise ValueError("robustness.outcomes=sampled needs a model that samples f: it has no sampled_next_state")
        _ = self.cumulative_reward(), self.distance_to_goal  # refuse bad options now, not in the first plan
        self.warm_start, self.robustness, self.idle_distance = warm_start, robustness, idle_distance
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
        warm_start: Tensor | None = None,
        best_only: bool = False,
    ) -> Candidates:
        """All candidates `[B, N]` that the optimizer evaluates.

        Args:
            space: extends candidates by a segment, from D numbers of noise. objective: ranks them.
            state: `[B]`, observed scenes. generators: one per scene.
            optimizer: by default `self.optimizer`.
            segments: of a candidate, by default K. samples: number of candidates, by default N.
            warm_start: `[B, h, K, D]`, noise of promising candidates, from the last plan.
            best_only: whether the caller reads only the best candidate.

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
            warm_start,
            best_only,
            self.backend,
        )
        return search(optimizer or self.optimizer, problem, self.samples if samples is None else samples)

    def search_by_reward(
        self, space: SearchSpace, state: State, generators: Sequence[torch.Generator], previous: Plan | None
    ) -> Candidates:
        """Candidates `[B, N]` of K segments, searched by cumulative reward, with a warm start from `previous`."""
        warm_start = warm_start_noise(previous, generators) if self.warm_start else None
        objective = guided_return(self.cumulative_reward(), self.distance_to_goal)
        return self.search(space, objective, state, generators, warm_start=warm_start, best_only=True)

    def prefer_free(self, scores: Tensor, pushes: Tensor, observed: ObservedPoints | None) -> Tensor:
        """Scores `[B, N]` that leave out candidates whose first push would touch down on an object.

        pushes: `[B, N, T, 4]`, their first segments.
        """
        return prefer_free(scores, pushes[..., 0, :], observed, self.touchdown_distance)

    def idle_last(
        self, actions: Tensor, path: Tensor, state: State, observed: ObservedPoints | None
    ) -> tuple[Tensor, Tensor]:
        """The chosen actions `[B, H, 4]` with idle pushes last, and the states after each: `[B, H, M, 3]` metres."""
        return idle_last(
            actions, path, state, self.segment_length, self.idle_distance, observed, self.touchdown_distance
        )


def _backend(compile: bool | str, tracing: Callable[[], AbstractContextManager[None]]) -> Backend:
    if not isinstance(compile, bool) and compile not in (AUTO, GRAPHS):
        raise ValueError(f"compile must be true, false, {AUTO} or {GRAPHS}, not {compile}")
    if compile == GRAPHS:
        return CudaGraphs(tracing)
    return Compiled(tracing=tracing, make=compile is True) if compile else eager


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
        "noise": chosen_noise(candidates.take(best.unsqueeze(-1))),
        "candidate_centers": candidates.centers,
        "candidate_returns": progress.earned,
        "evidence": candidates.problem.evidence[-1] if candidates.problem.evidence else None,
        "share_reaching_goal": progress.succeeded.float().mean(-1),
    }
