"""The planners that the paper compares with (section 4.1, appendix A.2), an ablation, and random actions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from cavin_pyro.models.checks import check_number, told, typed
from cavin_pyro.models.state import State
from cavin_pyro.planning.additions import Choice
from cavin_pyro.planning.cavin import EffectSpace
from cavin_pyro.planning.checks import NoFiniteCandidateError, UnsuitedError, check_scenes
from cavin_pyro.planning.protocol import (
    ActionModel,
    EffectActionModel,
    ModelRequirements,
    MotionModel,
    Plan,
    PlanningModel,
    Query,
    Reward,
    RewardFunction,
    SegmentRollout,
    as_reward,
)
from cavin_pyro.planning.returns import best_of
from cavin_pyro.planning.rollout import actions_of, predict_states, project
from cavin_pyro.planning.sampling import noise_each, sample_codes, uniform_each
from cavin_pyro.planning.searching import SearchingPlanner, summary


class ActionSearch(SearchingPlanner):
    """The common part of CVAE-MPC and MPC, everything but the source of actions.

    For the options see `SearchingPlanner`. Samples, horizon, returns, termination and replacement, segment by segment,
    are Algorithm 1's.
    """

    space: ClassVar[type]  # a `SearchSpace` that generates the actions of a segment and predicts their states with f
    has_codes: ClassVar[bool] = False  # the space searches motion codes

    def plan_scene(self, scene: Query) -> Plan:
        """Plan for observed scenes `scene.state: [B]`. There are no effect codes and no subgoals."""
        space = type(self).space(self.model, self.decimals, scene.reward.reads_features)
        candidates = self.search_by_reward(space, scene)
        # A sum is finite only if all of its terms are.
        finite = torch.isfinite(candidates.actions.sum((-2, -1)))
        scores = torch.where(finite, candidates.returns, -torch.inf)
        choice = Choice(scene, self.model, candidates, lambda: candidates.at(0, actions_of))
        best = best_of(self.added("rank", scores, choice), "returns of action sequences")
        chosen = candidates.take(best.unsqueeze(-1))
        actions, path, codes = chosen.actions[:, 0], chosen.path[:, 0], chosen.codes[:, 0]
        no_codes = codes.new_empty(len(codes), 0, 0)
        return Plan(
            actions=actions[:, : self.segment_length],
            planned_actions=actions,
            effect_codes=no_codes,
            motion_codes=codes if self.has_codes else no_codes,
            subgoals=scene.state.map(lambda field: field[:, None][:, :0]),
            predicted_centers=path,
            **summary(candidates, best),
        )


class FlatMotionSpace(NamedTuple):
    """Motion codes, the actions that g generates from them alone, and the states that f predicts."""

    model: MotionModel
    decimals: int | None = None
    features: bool = False  # whether paths record these too

    @property
    def dimension(self) -> int:
        """Z."""
        return self.model.motion_dimension

    def extend(
        self, segment: int, here: State, plans: State, noise: Tensor | None, generators: Sequence[torch.Generator]
    ) -> SegmentRollout:
        z = sample_codes(self.model.motion_prior, [plans], noise, generators)
        a = project(self.model.actions(here, motion_code=z), self.decimals)
        states, path = predict_states(self.model, here, a, self.features)
        return SegmentRollout(z, a, states, path)


class CvaeMpcPlanner(ActionSearch):
    """CVAE-MPC: sequences of K motion codes z ~ p(z | s), T actions g(s, z) for each, and f's prediction for all H.

    model: p(z | s), g without effect codes, f. For the options and errors see `ActionSearch`.
    """

    requires = ModelRequirements("flat", ("motion_prior", "actions", "next_state"), excluded=("effect_prior",))
    space = FlatMotionSpace
    has_codes = True


class RawActionSpace(NamedTuple):
    """Raw actions, T a segment, uniform over the action space, and the states that f predicts step by step."""

    model: ActionModel
    decimals: int | None = None
    features: bool = False  # whether paths record these too

    @property
    def dimension(self) -> int:
        """A T numbers of noise."""
        return self.model.action_dimension * self.model.segment_length

    def extend(
        self, segment: int, here: State, plans: State, noise: Tensor | None, generators: Sequence[torch.Generator]
    ) -> SegmentRollout:
        if noise is None:
            noise = noise_each((plans.batch_shape[-1], self.dimension), generators, plans.centers.device)
        actions = project(
            (2.0 * torch.special.ndtr(noise) - 1.0).unflatten(-1, (-1, self.model.action_dimension)), self.decimals
        )
        states, path = predict_states(self.model, here, actions, self.features)
        return SegmentRollout(actions.flatten(-2), actions, states, path)


class MpcPlanner(ActionSearch):
    """Sequences of H raw actions in "the original action space" (paper, section 4.1 and appendix A.2).

    model: any model, since only f is used. For the options and errors see `ActionSearch`.
    """

    requires = ModelRequirements("dynamics", ("next_state", "action_dimension"))
    space = RawActionSpace


class SectarPlanner(SearchingPlanner):
    """SeCTAR: effect codes ranked by reward, as in `CavinPlanner`; g generates the actions from the chosen code alone.

    There is no motion code to choose, so lines 8 to 10 of Algorithm 1 become a = g(s, c*). f only predicts the states
    after them, for pictures and additions. An effect has one motion here, so additions rank effect plans. Where
    actions move nothing, h may still believe that they reach the subgoal, and the next plan starts from the same state.

    model: p(c | s), h, g without motion codes, f. For the options see `SearchingPlanner`. Raises ValueError for counts
    below 1, a horizon that T does not divide, and unknown names.
    """

    requires = ModelRequirements(
        "single_latent", ("effect_prior", "subgoal", "actions", "next_state"), excluded=("motion_prior",)
    )

    def __init__(self, model: EffectActionModel, **options: Any) -> None:
        super().__init__(model, **options)
        self.model: EffectActionModel
        self.model, self.effect_actions = model, model.actions

    def _actions(self, here: State, effect_code: Tensor) -> Tensor:
        return project(self.effect_actions(here, effect_code), self.decimals)

    def plan_scene(self, scene: Query) -> Plan:
        """Plan for observed scenes `scene.state: [B]`."""
        # Lines 5 to 7: choose the codes c* and their subgoals.
        space, here = EffectSpace(self.model, scene.reward.reads_features), scene.state.expand_plans(1)
        effects = self.search_by_reward(space, scene)
        choice = Choice(
            scene,
            self.model,
            effects,
            lambda: self._actions(here, effects.at(0, lambda segment: segment.rollout.code)),
            subgoals=State(
                effects.at(0, lambda segment: segment.rollout.states.centers),
                effects.at(0, lambda segment: segment.rollout.states.features),
                effects.plans.mask,
            ),
        )
        best = best_of(self.added("rank", effects.returns, choice), "returns of effect plans")
        chosen = effects.take(best.unsqueeze(-1))
        effect_codes = chosen.codes[:, 0]
        # Lines 8 to 10 without motion codes: the actions of the first segment, which is executed.
        actions = self._actions(here, effect_codes[:, :1])
        _, path = predict_states(self.model, here, actions)
        broken = (~torch.isfinite(actions).flatten(1).all(-1)).nonzero().flatten().tolist()
        if broken:
            raise NoFiniteCandidateError(
                broken[0], "the actions of the chosen effect are not finite; check the model's weights"
            )
        return Plan(
            actions=actions[:, 0],
            planned_actions=actions[:, 0],
            effect_codes=effect_codes,
            motion_codes=effect_codes.new_empty(len(actions), 0, 0),
            subgoals=chosen.states.map(lambda field: field[:, 0]),
            predicted_centers=path[:, 0],
            **summary(effects, best),
        )


class CascadeSpace(NamedTuple):
    """Effect and motion codes of the cascade, the actions that g makes from both, and the states that f predicts."""

    model: PlanningModel
    decimals: int | None = None
    features: bool = False  # whether paths record these too

    @property
    def dimension(self) -> int:
        """C + Z."""
        return self.model.effect_dimension + self.model.motion_dimension

    def extend(
        self, segment: int, here: State, plans: State, noise: Tensor | None, generators: Sequence[torch.Generator]
    ) -> SegmentRollout:
        sizes = self.model.effect_dimension, self.model.motion_dimension
        effect_noise, motion_noise = (None, None) if noise is None else noise.split(sizes, -1)
        c = sample_codes(self.model.effect_prior, [plans], effect_noise, generators)
        z = sample_codes(self.model.motion_prior, [plans, c], motion_noise, generators)
        a = project(self.model.actions(here, c, z), self.decimals)
        states, path = predict_states(self.model, here, a, self.features)
        return SegmentRollout(torch.cat([c, z], -1), a, states, path)


class CavinWithoutEffectsPlanner(ActionSearch):
    """Sequences of K pairs of codes c ~ p(c | s), z ~ p(z | s, c), T actions g(s, c, z) for each, and f's prediction.

    The same generative model as `CavinPlanner`, but planned like CVAE-MPC: no subgoals, and whole sequences ranked by
    cumulative reward. A plan's motion codes are the pairs, `[B, K, C + Z]`.

    model: the cascade, without h. For the options and errors see `ActionSearch`.
    """

    requires = ModelRequirements("cascaded", ("effect_prior", "motion_prior", "actions", "next_state"))
    space = CascadeSpace
    has_codes = True


@runtime_checkable
class Policy(Protocol):
    """What acts without predicting, such as a script that belongs to a world."""

    def __call__(self, state: State, reward: Reward, observed: Any, /) -> Tensor:
        """The next action `[1, A]` of one scene, `state: []`; `observed`: what else the world shows of it."""


class PolicyPlanner:
    """The actions of a policy, one a plan, for one scene at a time: a floor for planners.

    `action_dimension`: A.
    """

    segment_length = 1

    @typed(ValueError)
    def __init__(self, policy: Policy, *, action_dimension: int) -> None:
        self.policy, self.action_dimension = policy, action_dimension

    @torch.inference_mode()
    def plan(
        self,
        state: State,
        *,
        generators: Sequence[torch.Generator],
        reward: RewardFunction | None = None,
        observed: Any = None,
        steps_left: int | None = None,
    ) -> Plan:
        """Actions for the scenes `state: [B]`, without prediction or choice.

        Raises ValueError unless there are scenes, with a generator for each, and for what `act` cannot do.
        """
        check_scenes(state, generators, steps_left, observed)
        actions = self.act(state, reward, generators, observed)
        environments, objects, positions = state.centers.shape
        empty = state.centers.new_empty
        return Plan(
            actions=actions,
            planned_actions=actions,
            effect_codes=empty(environments, 0, 0),
            motion_codes=empty(environments, 0, 0),
            subgoals=state.map(lambda field: field[:, None][:, :0]),
            segments=torch.zeros(environments, dtype=torch.int64, device=actions.device),
            predicted_centers=empty(environments, 0, objects, positions),
            expected_return=state.centers.new_full((environments,), torch.nan),
            expected_success=torch.zeros(environments, dtype=torch.bool, device=actions.device),
            candidate_centers=empty(environments, 0, 0, objects, positions),
            candidate_returns=empty(environments, 0),
        )

    def act(self, state: State, reward: Any, generators: Sequence[torch.Generator], observed: Any) -> Tensor:
        """`[B, T, A]`, here of one scene; ValueError: several, or another action than `[1, A]`."""
        if len(generators) > 1:
            raise ValueError(f"a policy acts in one scene at a time, not in {len(generators)}")
        try:
            actions = self.policy(state.map(lambda field: field[0]), as_reward(reward), observed)
        except ValueError as error:
            raise UnsuitedError(str(error)) from error
        given = list(actions.shape) if isinstance(actions, Tensor) else told(actions)
        if given != [1, self.action_dimension]:
            raise ValueError(f"a policy must give an action [1, {self.action_dimension}], not {given}")
        return actions[None]


class RandomPlanner(PolicyPlanner):
    """Uniform random actions: each number ~ Uniform(-1, 1), normalised.

    `action_dimension`: A. `segment_length`: T, the number of actions per plan. Raises ValueError if one is less than 1.
    """

    def __init__(self, segment_length: int = 3, *, action_dimension: int) -> None:
        check_number("segment_length", segment_length, 1, whole=True)
        check_number("action_dimension", action_dimension, 1, whole=True)
        self.segment_length, self.action_dimension = segment_length, action_dimension

    def act(self, state: State, reward: Any, generators: Sequence[torch.Generator], observed: Any) -> Tensor:
        """Samples `[B, T, A]`."""
        size = self.segment_length, self.action_dimension
        return 2 * uniform_each(size, generators, state.centers.device) - 1
