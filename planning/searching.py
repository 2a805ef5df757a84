"""What every planner that searches takes, checked in one place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import torch

from models.state import State
from planning.candidates import Candidates, Search
from planning.compiled import Compiled
from planning.engine import Engine, directly
from planning.inputs import check_horizon, check_positive
from planning.memory import hints
from planning.optimisers import make_optimiser
from planning.plan import Plan
from planning.protocol import PlanningModel, RewardFunction
from planning.rewards import CumulativeReward, StrideLimits
from planning.segments import Level


class SearchingPlanner:
    """N = `samples` plans of K = `horizon` / T segments, searched by an optimiser for the highest cumulative reward.

    Algorithm 1, line 1, and the options of the search: see `planning.cavin.CavinPlanner`, which names them all.
    """

    strides: ClassVar[str] = "segments"  # what `stride_limits` limits, or "pushes"
    best_only = True  # whether of the plans that were considered only the one with the highest return matters

    def __init__(
        self,
        model: PlanningModel,
        reward: RewardFunction,
        samples: int = 1024,
        horizon: int = 30,
        *,
        optimizer: str = "shooting",
        optimizer_options: Mapping[str, Any] | None = None,
        reward_at: str = "path",
        stride_limits: Sequence[float] | None = None,
        memory: bool = False,
        compile: bool = False,
    ) -> None:
        """Raises ValueError for counts below 1, a horizon that T does not divide, unknown names, and no compiler."""
        check_positive("samples", samples)
        check_horizon(horizon, model.segment_length)
        self.optimiser = make_optimiser(optimizer, optimizer_options, samples=samples)
        self.model, self._reward = model, reward
        self.reward_at, self.stride_limits = reward_at, stride_limits
        self.engine: Engine = Compiled() if compile else directly
        self.from_noise = memory or compile
        self.score  # noqa: B018 (complains of a name or of limits now, not in the first plan)
        self.memory = memory
        self.samples = samples
        self.segments = horizon // model.segment_length  # line 1: K = H / T

    @property
    def segment_length(self) -> int:
        """T, the number of pushes in a plan's `actions`."""
        return self.model.segment_length

    @property
    def reward(self) -> RewardFunction:
        """The task's; of a reward that changes from episode to episode, what it is `now`."""
        return getattr(self._reward, "now", self._reward)

    @property
    def score(self) -> CumulativeReward:
        """Of plans in this episode."""
        reward, limits = self.reward, self.stride_limits
        return CumulativeReward(
            reward if limits is None else StrideLimits(reward, limits, of=self.strides), self.reward_at
        )

    def search(
        self, level: Level, state: State, generators: Sequence[torch.Generator], previous: Plan | None
    ) -> Candidates:
        """All plans that were considered for the scenes `state: [B]`, with what is left of the `previous` ones.

        Raises ValueError for a memory of codes whose prior is not made of noise (`planning.sampling.code_of`).
        """
        left = hints(previous, generators) if self.memory else None
        wanted = Search(
            level,
            self.score,
            state,
            generators,
            self.segments,
            self.from_noise,
            left,
            best_only=self.best_only,
            engine=self.engine,
        )
        return self.optimiser.optimise(wanted, self.samples)
