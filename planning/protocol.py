"""What planning needs of a model and of a task, and what it offers: structural types, not to be inherited.

Letters used in all of `planning`: B environments, N plan samples, K segments of T steps each, H = K T steps
of horizon, M objects (padding included).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor
from torch.distributions import Distribution

from models.state import State
from planning.plan import Plan


class PlanningModel(Protocol):
    """The cascaded generative process (paper, equations 1 to 3): its priors, and the means of h, g and f.

    Leading dimensions `[...]` of the arguments broadcast: planners hand over states `[B, 1]` with codes or
    actions `[B, N]` where all plans are in one state, else `[B, N]` for all. Priors are asked for `[N]`, an
    environment at a time. Planners name in `needs` what they ask for; a model without effects takes its motion code by
    keyword, one without motions is given none.
    """

    @property
    def segment_length(self) -> int:
        """`T`, the number of pushes that lead from a state to its subgoal."""

    @property
    def effect_dimension(self) -> int:
        """C, the numbers of an effect code."""

    @property
    def motion_dimension(self) -> int:
        """Z, the numbers of a motion code."""

    def effect_prior(self, state: State) -> Distribution:
        """p(c | s), or p(c): batch `[...]`, event `[C]`."""

    def motion_prior(self, state: State, effect_code: Tensor) -> Distribution:
        """p(z | s, c), or p(z): batch `[...]`, event `[Z]`; `effect_code: [..., C]`."""

    def subgoal(self, state: State, effect_code: Tensor) -> State:
        """Mean of the meta-dynamics h(s' | s, c), the state T steps on: `[...]`; `effect_code: [..., C]`."""

    def actions(self, state: State, effect_code: Tensor, motion_code: Tensor) -> Tensor:
        """Mean of the action generator g(a | s, c, z): `[..., T, 4]` pushes; codes `[..., C]`, `[..., Z]`."""

    def next_state(self, state: State, action: Tensor) -> State:
        """Mean of the dynamics f(s'' | s, a): `[...]`; `action: [..., 4]`."""


class Outcome(Protocol):
    """What a task says of one step, in any batch `[...]`. Success and failure both end the episode."""

    @property
    def reward(self) -> Tensor:
        """`[...]` reward of the step, the reward of its end (goal, violation) included."""

    @property
    def success(self) -> Tensor:
        """`[...]` bool: the goal is reached."""

    @property
    def failure(self) -> Tensor:
        """`[...]` bool: a constraint is violated, or an object has left the workspace."""


class RewardFunction(Protocol):
    """R(s_{t+1}) of the paper (section 2), with the state before it for rewards of progress."""

    def __call__(self, previous: Tensor, centers: Tensor, mask: Tensor, /) -> Outcome:
        """Judge the step `previous: [..., M, 3]` to `centers: [..., M, 3]` metres; `mask: [..., M]` bool.

        Object 0 is the target.
        """


class Planner(Protocol):
    """Anything that turns observed states into pushes."""

    @property
    def segment_length(self) -> int:
        """T, the number of pushes in a plan's `actions`."""

    def plan(self, state: State, generators: Sequence[torch.Generator], previous: Plan | None = None) -> Plan:
        """Plan for the scenes `state: [B]`, each with its own source of randomness.

        `previous`: the plans whose `actions`, or the first of them, have just been executed, for optimisers that go on
        from them.
        """
