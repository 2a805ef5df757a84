"""What models, rewards, searches and planners offer, and a plan. The protocols are structural types.

Letters used in all of `planning`: B environments, N candidates, K segments of T steps each, H = K T steps
of horizon, M objects (padding included).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

import torch
from torch import Tensor
from torch.distributions import Distribution

from cavin_pyro.models.checks import check_kinds, typed
from cavin_pyro.models.state import State

ScoreStateKind = TypeVar("ScoreStateKind")


@runtime_checkable
class TransitionModel(Protocol):
    """The dynamics f alone (paper, equation 1), of which planners take the mean.

    Leading dimensions `[...]` of the arguments broadcast: planners pass states `[B, 1]` with codes or
    actions `[B, N]` if all candidates are in one state, else `[B, N]` for all. They call priors with `[N]`, one
    environment at a time.
    """

    @property
    def segment_length(self) -> int:
        """`T`, the number of actions from a state to its subgoal."""

    def next_state(self, state: State, action: Tensor) -> State:
        """Mean of the dynamics f(s'' | s, a): `[...]`; `action: [..., A]`."""


class ActionModel(TransitionModel, Protocol):
    """A model that tells the size of an action, for planners that search raw actions."""

    @property
    def action_dimension(self) -> int:
        """A."""


@runtime_checkable
class FixedShapes(Protocol):
    """A model that computes less where shapes of tensors may depend on values, which a CUDA graph does not allow."""

    def fixed_shapes(self) -> AbstractContextManager[None]:
        """Within it shapes follow from the shapes of arguments; results are the same up to rounding."""


class EffectModel(TransitionModel, Protocol):
    """A model with effect codes: their prior, and the meta-dynamics h (paper, equation 2)."""

    @property
    def effect_dimension(self) -> int:
        """C, the dimension of an effect code."""

    def effect_prior(self, state: State) -> Distribution:
        """p(c | s), or p(c): batch `[...]`, event `[C]`."""

    def subgoal(self, state: State, effect_code: Tensor) -> State:
        """Mean of the meta-dynamics h(s' | s, c), the state T steps ahead: `[...]`; `effect_code: [..., C]`."""


class PlanningModel(EffectModel, Protocol):
    """The cascaded generative process (paper, equations 1 to 3): `model=cascaded`."""

    @property
    def motion_dimension(self) -> int:
        """Z, the dimension of a motion code."""

    def motion_prior(self, state: State, effect_code: Tensor) -> Distribution:
        """p(z | s, c), or p(z): batch `[...]`, event `[Z]`; `effect_code: [..., C]`."""

    def actions(self, state: State, effect_code: Tensor, motion_code: Tensor) -> Tensor:
        """Mean of the action generator g(a | s, c, z): `[..., T, A]`; codes `[..., C]`, `[..., Z]`."""


class EffectActionModel(EffectModel, Protocol):
    """One code for the subgoal and the actions (SeCTAR): `model=single_latent`."""

    def actions(self, state: State, effect_code: Tensor) -> Tensor:
        """Mean of g(a | s, c): `[..., T, A]`."""


class MotionModel(TransitionModel, Protocol):
    """Motion codes without effects (CVAE-MPC): `model=flat`."""

    @property
    def motion_dimension(self) -> int:
        """Z, the dimension of a motion code."""

    def motion_prior(self, state: State) -> Distribution:
        """p(z | s), or p(z): batch `[...]`, event `[Z]`."""

    def actions(self, state: State, *, motion_code: Tensor) -> Tensor:
        """Mean of g(a | s, z): `[..., T, A]`."""


@dataclass(frozen=True)
class ModelRequirements:
    """Requirements of a planner on its model: the class attribute `requires` of every planner that searches.

    model: the choice of `model=` for the planner. methods: which the model must have. excluded: codes that the planner
    does not choose, so the model must not have them.
    """

    model: str
    methods: tuple[str, ...]
    excluded: tuple[str, ...] = ()

    def violation(self, model: object) -> str | None:
        """What `model` lacks or must not have, for an error line; None if it fits."""
        missing = [name for name in self.methods if not hasattr(model, name)]
        superfluous = [name for name in self.excluded if hasattr(model, name)]
        if missing:
            return f"has no {' and no '.join(missing)}"
        return f"has {superfluous[0]} besides" if superfluous else None


@runtime_checkable
class Reparameterized(Protocol):
    """A distribution with its own reparameterisation.

    Torch's normal distributions and their transforms do not need it: `cavin_pyro.planning.sampling.reparameterize`.
    """

    def reparameterize(self, noise: Tensor) -> Tensor:
        """The sample `[..., D]` that `noise: [..., D]` determines."""


@runtime_checkable
class StepOutcome(Protocol):
    """The outcome of one step, in any batch `[...]`. Success and failure both end the episode."""

    @property
    def reward(self) -> Tensor:
        """`[...]` reward of the step, the reward of its end (goal, violation) included."""

    @property
    def success(self) -> Tensor:
        """`[...]` bool: the goal is reached."""

    @property
    def failure(self) -> Tensor:
        """`[...]` bool: a constraint is violated, or an object has left the workspace."""


class RemainingDistance(Protocol):
    """The remaining distance to the goal along allowed places, for guidance beyond the horizon."""

    def __call__(self, centers: Tensor, mask: Tensor, /) -> Tensor:
        """What is left: `[...]`, from `centers: [..., M, P]` and `mask: [..., M]` bool; 0 at the goal."""

    def longest(self, mask: Tensor, /) -> Tensor:
        """An upper bound on what is left with the objects in `mask: [..., M]`: `[...]`."""


@runtime_checkable
class RewardFunction(Protocol):
    """R(s_{t+1}) of the paper (section 2); it also takes the state before, for rewards of progress."""

    def __call__(self, previous: Tensor, centers: Tensor, mask: Tensor, /) -> StepOutcome:
        """Evaluate the step `previous: [..., M, P]` to `centers: [..., M, P]`; `mask: [..., M]` bool.

        Object 0 is the target. A reward that `reads_features` gets `[..., M, P + F]`, centres and features.
        """


@runtime_checkable
class Reward(RewardFunction, Protocol):
    """A reward function with what planners can use besides; `as_reward` gives a plain function the defaults."""

    @property
    def reads_features(self) -> bool:
        """Whether it gets centres and features of the objects, not centres alone.

        Of the states between a segment's ends (line 6) features are interpolated: vectors of unit length get shorter.
        """
        return False

    @property
    def about(self) -> str:
        """The objects that the goal is about: `target`, which is object 0, or `all`; empty if unknown."""
        return ""

    @property
    def maximum_return(self) -> float:
        """Upper bound on the cumulative reward of any sequence of steps, for early stopping."""
        return math.inf

    def along(self, states: Tensor, mask: Tensor, /) -> StepOutcome:
        """Evaluate the T steps of paths `states: [..., T + 1, M, P]`, `mask: [..., M]` bool: fields `[..., T]`.

        Equal to a call for each step; it may read every state once instead of twice.
        """
        previous, centers = states[..., :-1, :, :], states[..., 1:, :, :]
        return self(previous, centers, mask.unsqueeze(-2).expand(centers.shape[:-1]))

    def distance_to_goal(self) -> RemainingDistance | None:
        """The remaining distance to the goal, the same object in every call; None if unknown."""
        return None


@dataclass(frozen=True)
class FunctionReward(Reward):
    """A plain function as a `Reward`."""

    function: RewardFunction

    def __call__(self, previous: Tensor, centers: Tensor, mask: Tensor) -> StepOutcome:
        outcome = self.function(previous, centers, mask)
        check_kinds({"what the reward gives": outcome}, {"what the reward gives": StepOutcome})
        return outcome


@typed(ValueError)
def as_reward(reward: RewardFunction) -> Reward:
    """A reward function itself, or with the defaults of `Reward` if it has no more than its call."""
    return reward if isinstance(reward, Reward) else FunctionReward(reward)


class Query(NamedTuple):
    """What one plan is made for: B environments."""

    state: State  # [B], observed
    reward: Reward
    generators: Sequence[torch.Generator]  # one per environment
    observed: Any = None  # what else the world shows, for additions: a named tuple of tensors [B, ...]
    segments: int = 1  # K


class SegmentRollout(NamedTuple):
    """One segment of n candidates, T steps long."""

    code: Tensor  # [B, n, D] effect or motion codes; or the concatenated T raw actions
    actions: Tensor | None  # [B, n, T, A], if the search space has actions
    states: State  # [B, n, M, .] at the end of the segment
    path: Tensor  # [B, n, T, M, P] centres after every step; [B, n, T, M, P + F] for a reward that reads features


class SearchSpace(Protocol):
    """Effect codes, motion codes or raw actions. A named tuple, so that a backend can compile it."""

    @property
    def dimension(self) -> int:
        """D, the dimension of the noise of one segment."""

    def extend(
        self, segment: int, here: State, plans: State, noise: Tensor | None, generators: Sequence[torch.Generator]
    ) -> SegmentRollout:
        """Roll out segment number `segment` of candidates in the states `plans: [B, n]`.

        `here`: the same states, or `[B, 1]` if all are equal. `noise: [B, n, D]`, standard normal, determines
        the segment; None samples the prior with the `generators`.
        """


class SearchObjective(Protocol):
    """Scores candidates. A named tuple or a frozen dataclass, so that a backend can compile it.

    Its score state, the running score of candidates, is a named tuple of fields `[B, n]` with
    returns: higher is better; -inf for candidates with a prediction that is not finite.
    failed: bool, terminated by a failure, so that a copy of an active candidate may replace it.
    active: bool, not terminated.
    The state of an objective that wraps another one has the other's state as its field `inner`: see `unwrap`.
    """

    def start(self, plans: State) -> Any:
        """Score state of candidates without a segment, `plans: [B, n]`."""

    def advance(self, score_state: Any, segment: int, before: State, rollout: SegmentRollout) -> Any:
        """Score state after one more segment, which begins at `before: [B, n]`."""

    def early_stopped(self, score_state: Any) -> Tensor:
        """`[B]` bool: no active candidate can still reach a higher return than the best terminated one."""


def unwrap(score_state: Any, kind: type[ScoreStateKind]) -> ScoreStateKind:
    """The state of that kind, in itself or in the ones that it wraps.

    Raises TypeError if there is none.
    """
    while not isinstance(score_state, kind):
        if not hasattr(score_state, "inner"):
            raise TypeError(f"no {kind.__name__} in this score state: {type(score_state).__name__} wraps no other one")
        score_state = score_state.inner
    return score_state


def replace_within(
    score_state: Any, kind: type[ScoreStateKind], function: Callable[[ScoreStateKind], ScoreStateKind]
) -> Any:
    """The same state with `function(it)` in place of the one of that kind, in it or in the ones that it wraps."""
    if isinstance(score_state, kind):
        return function(score_state)
    return score_state._replace(inner=replace_within(score_state.inner, kind, function))


class Evidence(NamedTuple):
    """Estimates of planning as inference, and their reliability (`planner.optimizer=smc`).

    Z is the expected exp(return / temperature) of a plan from the prior. With a low effective sample size few plans
    carry all the weight, and neither Z nor the sample is reliable.
    """

    log_evidence: Tensor  # [B] float64: the logarithm of the estimate of Z; -inf if every weight was zero
    temperature: Tensor  # [B] float64: in units of return, after the last segment
    effective_samples: Tensor  # [B, K] float64: effective sample size after each segment, before resampling
    particles: Tensor  # [B] int64: the largest possible effective sample size


class Plan(NamedTuple):
    """The chosen plan of every environment, and the candidates (for pictures).

    S is the number of segments with motions: K, or 1 if motions are planned for the first segment only. C and Z are the
    dimensions of the codes. Fields that a planner lacks are empty: without effect codes K = 0 for these and the
    subgoals, without motion codes S = 0 for these. `RandomPlanner`, which predicts nothing, has S = 1 for its actions,
    and no codes, states or candidates.
    """

    actions: Tensor  # [B, T, A] the first segment; it, or its first actions, are executed before the next plan
    planned_actions: Tensor  # [B, S T, A] a*, which begins with `actions`
    effect_codes: Tensor  # [B, K, C] c*
    motion_codes: Tensor  # [B, S, Z] z*
    subgoals: State  # [B, K, M, .] chosen subgoals; those after the plan's end repeat the last one
    segments: Tensor  # [B] int64: segments until the chosen plan ends, 1..K; later ones have no meaning
    predicted_centers: Tensor  # [B, S T, M, P] predicted by f after each of the planned actions
    expected_return: Tensor  # [B] cumulative reward of the chosen plan; NaN where nothing was predicted
    expected_success: Tensor  # [B] bool: the chosen plan reaches the goal
    # [B, N, K, M, P] ends of all plans' segments, traced back through copies; of the nearest objects alone, the
    # target first, where plans are about these
    candidate_centers: Tensor
    candidate_returns: Tensor  # [B, N] their cumulative rewards; -inf where a prediction was not finite
    evidence: Evidence | None = None  # of the search by return; None for optimizers that do not sample by weights
    # [B] share of the candidates that reach the goal by the model, as far as they were rolled out; None for planners
    # that predict nothing
    share_reaching_goal: Tensor | None = None


class Planner(Protocol):
    """Turns observed states into actions."""

    @property
    def segment_length(self) -> int:
        """T, the number of actions in a plan's `actions`."""

    def plan(
        self,
        state: State,
        *,
        reward: RewardFunction,
        generators: Sequence[torch.Generator],
        observed: Any = None,
        steps_left: int | None = None,
    ) -> Plan:
        """Plan for the scenes `state: [B]`, each with its own generator; `observed` as in `Query`.

        `steps_left`: in the episodes; None: unknown.
        """
