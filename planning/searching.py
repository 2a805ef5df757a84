"""Base class of planners that search: their options, the search itself, and many environments in chunks."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import nullcontext
from operator import itemgetter
from typing import Any, ClassVar, TypeVar

import torch
from torch import Tensor

from cavin_pyro.models.checks import check_choice, check_number, told, typed
from cavin_pyro.models.state import State
from cavin_pyro.planning import records
from cavin_pyro.planning.additions import Addition, make_additions
from cavin_pyro.planning.backends import make_backend
from cavin_pyro.planning.checks import NoFiniteCandidateError, OptimizerError, check_horizon, check_scenes
from cavin_pyro.planning.optimizers import Optimizer, make_optimizer
from cavin_pyro.planning.protocol import (
    FixedShapes,
    ModelRequirements,
    Plan,
    Query,
    RewardFunction,
    SearchObjective,
    SearchSpace,
    TransitionModel,
    as_reward,
)
from cavin_pyro.planning.returns import REWARD_AT, CumulativeReward
from cavin_pyro.planning.rollout import Candidates, SearchProblem

# Measured: a plan of 1,024 samples fills a processor's caches; sixteen plans in one pass take 1.6 times as long per
# plan. Matrix products of another number of rows may also round differently, and a plan must not depend on its
# neighbours.
ENVIRONMENTS_ON_PROCESSOR = 1
PLANS_ON_ACCELERATOR = 131_072  # samples of all environments of a chunk


Value = TypeVar("Value")


class SearchingPlanner(ABC):
    """Searches N = `samples` plans of K = `horizon` / T segments for the highest cumulative reward.

    A planner implements `plan_scene`. The options, of which `cavin_pyro.planning.cavin.CavinPlanner` has more:

    samples: N, plans to compare.
    horizon: H steps, a multiple of the model's T.
    shrinking_horizon: plan no farther than to the end of the episode, H at most the steps that are left.
    optimizer: searches the plans: `shooting` (paper), `cem`, `icem`, `mppi`, `smc`, or a
        `cavin_pyro.planning.optimizers.Optimizer`.
    reward_at: `path` rewards interpolated states as well (paper), `subgoals` only the end of each segment (published
        implementation).
    decimals: to which actions are rounded before f predicts them, so that what is executed is what was scored; None
        keeps them as they are, within [-1, 1].
    additions: to Algorithm 1, by name or objects, see `cavin_pyro.planning.additions`; none in the paper.
    add, drop: of commands: more additions, of which one replaces another of its class, and names to leave out.
    compile: true compiles the inner functions by `torch.compile`, which takes minutes and is cached on disk;
        `cuda_graphs` captures them on the GPU where the model is. Codes then follow from noise.
    """

    requires: ClassVar[ModelRequirements]  # of the planner on its model
    hooks: ClassVar[tuple[str, ...]] = ("wrap_objective", "rank", "replan")  # of `Addition`, which the planner calls

    @typed(ValueError)
    def __init__(
        self,
        model: TransitionModel,
        samples: int = 1024,
        horizon: int = 30,
        *,
        shrinking_horizon: bool = False,
        optimizer: str | Optimizer = "shooting",
        reward_at: str = "path",
        decimals: int | None = None,
        additions: Sequence[str | Addition] = (),
        compile: bool | str = False,
    ) -> None:
        """Raises ValueError for numbers out of range, a horizon that T does not divide, unknown names."""
        if not all(hasattr(model, method) for method in self.requires.methods):
            needed, lacking = self.requires.model, self.requires.violation(model)
            raise ValueError(f"{type(self).__name__} needs a model as {needed}; {told(model)} {lacking}")
        check_number("samples", samples, 1, whole=True)
        check_number("decimals", 1 if decimals is None else decimals, 1)
        check_horizon(horizon, model.segment_length)
        check_choice("reward_at", reward_at, REWARD_AT)
        self.optimizer = make_optimizer(optimizer, samples=samples)
        self.additions = make_additions(additions, self.hooks)
        self.backend = make_backend(compile, model.fixed_shapes if isinstance(model, FixedShapes) else nullcontext)
        self.early_stopping = any(addition.stops_early for addition in self.additions)
        self.reparameterized = self.early_stopping or bool(compile)
        self.model, self.reward_at, self.samples, self.decimals = model, reward_at, samples, decimals
        self.segments = horizon // model.segment_length  # line 1 of Algorithm 1: K = H / T
        self.shrinking_horizon = shrinking_horizon

    @property
    def segment_length(self) -> int:
        """T, the number of actions of a segment."""
        return self.model.segment_length

    @torch.inference_mode()
    def plan(
        self,
        state: State,
        *,
        reward: RewardFunction,
        generators: Sequence[torch.Generator],
        observed: Any = None,
        steps_left: int | None = None,
    ) -> Plan:
        """Plan for the observed scenes `state: [B]`, in chunks of whole environments.

        An environment's plan depends on its own arguments only.

        Args:
            reward: the task's. generators: one per environment, which the call advances.
            observed: what else the world shows, for additions: a named tuple of tensors `[B, ...]`.
            steps_left: in the episodes, for `shrinking_horizon`.

        Raises ValueError: a state that is not a batch of at least one scene, another number of generators than B, or an
        environment without a finite candidate, which is named.
        """
        check_scenes(state, generators, steps_left, observed)
        size, plans, reward = ENVIRONMENTS_ON_PROCESSOR, [], as_reward(reward)
        if state.centers.device.type != "cpu":
            size = max(1, PLANS_ON_ACCELERATOR // self.samples)
        segments = self.segments
        if self.shrinking_horizon and steps_left is not None:
            segments = max(1, min(segments, steps_left // self.segment_length))
        for start in range(0, len(generators), size):
            chunk = slice(start, start + size)
            seen = observed and records.apply(observed, itemgetter(chunk))
            try:
                scene = Query(state.scene(chunk), reward, generators[chunk], seen, segments)
                plans.append(self.added("replan", self.plan_scene(scene), scene, self.plan_scene))
            except NoFiniteCandidateError as error:
                raise NoFiniteCandidateError(start + error.environment, error.what) from error
        return plans[0] if len(plans) == 1 else records.join(plans, dimension=0)

    @abstractmethod
    def plan_scene(self, scene: Query) -> Plan:
        """Plan for the environments of one chunk."""

    def search(
        self,
        space: SearchSpace,
        objective: SearchObjective,
        scene: Query,
        *,
        optimizer: Optimizer | None = None,
        segments: int | None = None,
        samples: int | None = None,
        early_stopping: bool = False,
    ) -> Candidates:
        """All candidates `[B, N]` that the optimizer evaluates.

        Args:
            space: extends candidates by a segment, from D numbers of noise. objective: ranks them.
            optimizer: by default `self.optimizer`.
            segments: of a candidate, by default K. samples: number of candidates, by default N.
            early_stopping: whether the search may stop when no candidate can become the best.

        Raises ValueError: codes must be reparameterised and their prior cannot be.
        """
        problem = SearchProblem(
            space,
            objective,
            scene.state,
            scene.generators,
            scene.segments if segments is None else segments,
            self.reparameterized,
            early_stopping,
            self.backend,
        )
        return search(optimizer or self.optimizer, problem, self.samples if samples is None else samples)

    def search_by_reward(self, space: SearchSpace, scene: Query) -> Candidates:
        """Candidates `[B, N]` of K segments, searched by cumulative reward."""
        objective = self.added("wrap_objective", CumulativeReward(scene.reward, self.reward_at), scene, None)
        return self.search(space, objective, scene, early_stopping=self.early_stopping)

    def added(self, hook: str, value: Value, *arguments: Any) -> Value:
        """A value after every addition's `hook(value, *arguments)`, in the order in which they act.

        Raises ValueError: an addition returned another kind of value, or another shape, or NaN.
        """
        for addition in self.additions:
            before, value = value, getattr(addition, hook)(value, *arguments)
            if isinstance(before, Tensor):
                wanted = f"shape {list(before.shape)}"
                given = f"shape {list(value.shape)}" if isinstance(value, Tensor) else type(value).__name__
                if isinstance(value, Tensor) and given == wanted and (value.isnan() & ~before.isnan()).any():
                    given = "NaN"
                if given != wanted:
                    raise ValueError(f"{type(addition).__name__}.{hook} must return {wanted}, not {given}")
        return value


def search(optimizer: Optimizer, problem: SearchProblem, samples: int) -> Candidates:
    """All whole candidates `[B, n]` that the optimizer has evaluated.

    Raises OptimizerError, naming the optimizer's class, for candidates of a wrong shape and if it has evaluated none.
    """
    try:
        optimizer.optimize(problem, samples)
        return problem.pop_candidates()
    except OptimizerError as error:
        raise OptimizerError(f"optimizer {type(optimizer).__name__}: {error}") from error


def summary(candidates: Candidates, best: Tensor) -> dict[str, Any]:
    """The fields of a `Plan` about its search.

    candidates: `[B, N]`, evaluated by cumulative reward. best: `[B]` int64, index of the chosen one.
    """
    progress = candidates.progress
    environments = torch.arange(len(best), device=best.device)
    return {
        "segments": progress.segments[environments, best],
        "expected_return": progress.returns[environments, best],
        "expected_success": progress.succeeded[environments, best],
        "candidate_centers": candidates.centers,
        "candidate_returns": progress.returns,
        "evidence": candidates.problem.evidence[-1] if candidates.problem.evidence else None,
        "share_reaching_goal": progress.succeeded.float().mean(-1),
    }
