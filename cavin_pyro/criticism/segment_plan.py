"""One segment for a drawn effect: obtain codes in one of several ways, and generate the pushes.

Letters: N candidates, T pushes, M objects.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavin_pyro.criticism.context import CheckContext
from models.model import Model
from models.state import State
from planning.extensions.touchdown import TOUCHDOWN_DISTANCE, ObservedPoints
from planning.rollouts import ranking
from planning.rollouts.dynamics import predict_states, sample_states
from planning.rollouts.sampling import sample_each, uniform_each

# How a code is obtained. CLOSEST, EXPECTED and GIVEN are for motion codes.
SAMPLED, CHOSEN, CLOSEST, EXPECTED, GIVEN = "sampled", "chosen", "closest", "closest in expectation", "given"
OUTCOMES = 16  # samples of f for each motion, to choose one by its expected distance
OUTCOMES_OF_CHOSEN = 64  # other samples, for what f expects of the chosen motion


class SegmentPlan(NamedTuple):
    """The pushes of one segment, with the states that the model predicts after them."""

    actions: NDArray[np.float32]  # [T, 4] normalised
    subgoal: NDArray[np.float32] | None  # [M, 3] metres, by h
    predicted: NDArray[np.float32]  # [M, 3] metres, by f along the actions
    expected: NDArray[np.float32] | None = None  # [M] metres from the subgoal, the mean over samples of f


def code_selections(codes: tuple[str, ...]) -> list[tuple[str, str]]:
    """The pairs (effect, motion) of ways to obtain these codes; none for a model without codes."""
    motions = {2: (SAMPLED, CLOSEST, EXPECTED), 1: (GIVEN,), 0: ()}[len(codes)]
    return [(effect, motion) for effect in (SAMPLED, CHOSEN) for motion in motions]


@torch.inference_mode()
def plan_segment(
    context: CheckContext,
    state: State,
    goal: Tensor,
    selection: tuple[str, str],
    seed: list[int],
    samples: int,
    observed: ObservedPoints | None = None,
) -> SegmentPlan:
    """Obtain codes for one scene `state: [1]` in one of the `code_selections`, and generate the pushes.

    An effect code is sampled from the prior, or chosen: of N samples, the one whose subgoal (without h: the state that
    f predicts) brings object 0 closest to `goal: [2]` metres. A motion code is sampled, or it is the closest of N: the
    one that leads f closest to the subgoal, as in planning (paper, Algorithm 1, line 10); or the closest of N in
    expectation: the one whose distance is smallest in the mean over samples of f's predictive distribution, of those
    without a push that touches down on an `observed` point, which moves with its object as f predicts. A model with
    one code has the motion given by the effect.
    """
    model, (effect, motion), here = context.model, selection, state.expand_plans(1)
    if "effect_code" not in context.codes:
        return _closest_to_goal(model, state, goal, seed, samples if effect == CHOSEN else 1)
    subgoal, actions = sampled_motions(context, state, goal, selection, seed, samples)
    ends, path = predict_states(model, here, actions)
    if motion == EXPECTED:
        scores = -expected_distances(model, here, actions, subgoal, _generator([*seed, 4]), OUTCOMES).sum(-1)
        if observed is not None:
            blocked = observed.blocked_by_any(actions, path, state, TOUCHDOWN_DISTANCE)
            scores = ranking.prefer(scores, ~blocked)
    else:
        scores = -ranking.squared_distance(ends, subgoal)
    best = int(ranking.best_of(scores, "distances of motions to the subgoal"))
    # By other samples than those that chose it, by which the distance would look too small.
    expected = expected_distances(
        model, here, actions[:, best : best + 1], subgoal, _generator([*seed, 5]), OUTCOMES_OF_CHOSEN
    )
    return SegmentPlan(
        actions[0, best].numpy(), subgoal.centers[0, 0].numpy(), ends.centers[0, best].numpy(), expected[0, 0].numpy()
    )


@torch.inference_mode()
def sampled_motions(
    context: CheckContext, state: State, goal: Tensor, selection: tuple[str, str], seed: list[int], samples: int
) -> tuple[State, Tensor]:
    """The subgoal `[1, 1]` and the pushes `[1, N, T, 4]` that `plan_segment` chooses from, of a model with effects."""
    effect, motion = selection
    code = _effect_code(context.model, state, goal, seed, samples if effect == CHOSEN else 1)
    subgoal = context.model.subgoal(state.expand_plans(1), code)
    return subgoal, _actions(context, state, code, seed, 1 if motion == SAMPLED else samples)


def _closest_to_goal(model: Model, state: State, goal: Tensor, seed: list[int], count: int) -> SegmentPlan:
    """Of `count` sampled motions of a model without effects, the one that f leads closest to the goal."""
    here = state.expand_plans(1)
    code = sample_each(model.motion_prior, [state.expand_plans(count)], [_generator([*seed, 2])])
    actions = model.actions(here, motion_code=code)
    ends, _ = predict_states(model, here, actions)
    best = int(_distance_to_goal(ends, goal).argmin())
    return SegmentPlan(actions[0, best].numpy(), None, ends.centers[0, best].numpy())


def _effect_code(model: Model, state: State, goal: Tensor, seed: list[int], count: int) -> Tensor:
    """Of `count` sampled effect codes, the one whose subgoal is closest to the goal: `[1, 1, C]`."""
    code = sample_each(model.effect_prior, [state.expand_plans(count)], [_generator([*seed, 2])])
    best = int(_distance_to_goal(model.subgoal(state.expand_plans(1), code), goal).argmin())
    return code[:, best : best + 1]


def _actions(context: CheckContext, state: State, effect_code: Tensor, seed: list[int], count: int) -> Tensor:
    """The pushes of `count` sampled motions for the effect, or of the one that it determines: `[1, N, T, 4]`."""
    model, here = context.model, state.expand_plans(1)
    if "motion_code" not in context.codes:
        return model.actions(here, effect_code=effect_code)
    plans = state.expand_plans(count)
    effect_code = effect_code.expand(*plans.batch_shape, -1)
    motion_code = sample_each(model.motion_prior, [plans, effect_code], [_generator([*seed, 3])])
    return model.actions(here, effect_code=effect_code, motion_code=motion_code)


def expected_distances(
    model: Model, here: State, actions: Tensor, subgoal: State, generator: torch.Generator, outcomes: int
) -> Tensor:
    """Expected distance of each object from its place in the `subgoal: [1, 1]`: `[1, N, M]` metres, 0 for padding.

    The mean over `outcomes` samples of f's predictive distribution along `actions: [1, N, T, 4]` from `here: [1, 1]`.
    All actions get the same random numbers, so that their differences are not those of chance.
    """
    _, count, length, _ = actions.shape
    uniform = uniform_each((outcomes, length, here.objects, 2), [generator]).repeat(1, count, 1, 1, 1)
    ends, _ = sample_states(model, here, actions.repeat_interleave(outcomes, 1), uniform)
    distances = (ends.centers - subgoal.centers).norm(dim=-1) * subgoal.mask
    return distances.unflatten(1, (count, outcomes)).mean(2)


def _distance_to_goal(states: State, goal: Tensor) -> Tensor:
    """Distance of object 0 from `goal: [2]` in the plane: `[...]` metres, from `states: [...]`."""
    return (states.centers[..., 0, :2] - goal).norm(dim=-1)


def _generator(seed: list[int]) -> torch.Generator:
    return torch.Generator().manual_seed(int(np.random.SeedSequence(seed).generate_state(1)[0]))
