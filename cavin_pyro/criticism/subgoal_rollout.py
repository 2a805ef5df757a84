"""Subgoals in physics: obtain codes in a sampled scene, execute the pushes in PyBullet, and observe the result.

Letters: N candidates, T pushes, M objects.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavin_pyro.criticism.context import CheckContext
from cavin_pyro.data.collection import clutter_area, open_scene
from cavin_pyro.data.observed import observed_points, observed_state
from envs.objects.sampling import ObjectRanges
from envs.observation import Observation
from envs.scene import Scene
from envs.workspace import REACH_HIGH, REACH_LOW
from models.model import Model
from models.state import State
from planning.extensions.touchdown import TOUCHDOWN_DISTANCE, ObservedPoints
from planning.rollouts import ranking
from planning.rollouts.dynamics import predict_states, sample_states
from planning.rollouts.sampling import sample_each, uniform_each

GOAL_DISTANCE = 0.15  # metres; how far a selected effect should move the target
PHOTOGRAPH = (384, 318)  # pixels
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


@dataclass(frozen=True)
class SubgoalRollout:
    """A plan of one segment, executed in one scene.

    Attributes:
        scene: its number. effect, motion: how the codes were obtained.
        before, reached: [M, 3] metres, as observed before the first push and after the last.
        unsafe, ineffective: numbers of pushes that were not executed, and that were executed and moved nothing.
        fallen: an object left the table, which ended the rollout. hidden: an object is not visible at the end.
        photograph: [height, width, 3] before the first push.
    """

    scene: int
    effect: str
    motion: str
    plan: SegmentPlan
    before: NDArray[np.float32]
    reached: NDArray[np.float32]
    unsafe: int
    ineffective: int
    fallen: bool
    hidden: bool
    photograph: NDArray[np.uint8]


def code_selections(codes: tuple[str, ...]) -> list[tuple[str, str]]:
    """The pairs (effect, motion) of ways to obtain these codes; none for a model without codes."""
    motions = {2: (SAMPLED, CLOSEST, EXPECTED), 1: (GIVEN,), 0: ()}[len(codes)]
    return [(effect, motion) for effect in (SAMPLED, CHOSEN) for motion in motions]


def sample_scene(scene: Scene, ranges: ObjectRanges, seed: int, number: int, objects: int) -> Observation:
    """Sample scene `number` with so many objects, as cluttered as in collection; equal numbers give equal scenes."""
    generator = np.random.default_rng([seed, number])
    return scene.sample([clutter_area(generator)] * objects, ranges, generator)


def subgoal_rollouts(
    context: CheckContext, *, scenes: int, objects: int, samples: int
) -> Iterator[list[SubgoalRollout]]:
    """In each scene, one rollout per way to obtain the codes; scene k depends on the seed and k alone.

    Args:
        samples: N, the number of candidates for a code that is chosen.
    """
    scene = open_scene(context.world)
    try:
        for number in range(scenes):
            yield [
                _rollout(context, scene, number, selection, objects, samples)
                for selection in code_selections(context.codes)
            ]
    finally:
        scene.close()


def _rollout(
    context: CheckContext, scene: Scene, number: int, selection: tuple[str, str], objects: int, samples: int
) -> SubgoalRollout:
    first = sample_scene(scene, context.world.ranges, context.seed, number, objects)
    seen = {"centers": first.centers, "clouds": first.clouds, "mask": first.mask}
    state, points = observed_state(seen, context.geometry), observed_points(seen)
    goal = _goal(first.centers[0], np.random.default_rng([context.seed, number, 1]))
    plan = plan_segment(context, state, torch.from_numpy(goal), selection, [context.seed, number], samples, points)
    photograph = scene.photograph(scene.camera.resized(*PHOTOGRAPH))
    reports = []
    for action in plan.actions:
        reports.append(scene.push(np.clip(action, -1.0, 1.0)))
        if reports[-1].fallen:
            break
    last = scene.observe()
    return SubgoalRollout(
        number,
        *selection,
        plan=plan,
        before=first.centers[:objects],
        reached=last.centers[:objects],
        unsafe=sum(report.unsafe for report in reports),
        ineffective=sum(report.ineffective and not report.unsafe for report in reports),
        fallen=reports[-1].fallen,
        hidden=not last.visible[:objects].all(),
        photograph=photograph,
    )


def _goal(target: NDArray[np.float32], generator: np.random.Generator) -> NDArray[np.float32]:
    """A point (x, y) metres for the target at `GOAL_DISTANCE`, within the tool's reach if a few attempts find one."""
    for _ in range(20):
        angle = generator.uniform(-np.pi, np.pi)
        goal = target[:2] + GOAL_DISTANCE * np.array([np.cos(angle), np.sin(angle)])
        if (goal > REACH_LOW).all() and (goal < REACH_HIGH).all():
            break
    return goal.astype(np.float32)


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
    model, (effect, motion) = context.model, selection
    here, count = state.expand_plans(1), samples if effect == CHOSEN else 1
    plans = state.expand_plans(count)
    if "effect_code" not in context.codes:
        code = sample_each(model.motion_prior, [plans], [_generator([*seed, 2])])
        actions = model.actions(here, motion_code=code)
        ends, _ = predict_states(model, here, actions)
        best = int(_distance_to_goal(ends, goal).argmin())
        return SegmentPlan(actions[0, best].numpy(), None, ends.centers[0, best].numpy())
    code = sample_each(model.effect_prior, [plans], [_generator([*seed, 2])])
    best = int(_distance_to_goal(model.subgoal(here, code), goal).argmin())
    code = code[:, best : best + 1]
    subgoal = model.subgoal(here, code)
    if "motion_code" in context.codes:
        plans = state.expand_plans(1 if motion == SAMPLED else samples)
        code = code.expand(*plans.batch_shape, -1)
        motion_code = sample_each(model.motion_prior, [plans, code], [_generator([*seed, 3])])
        actions = model.actions(here, effect_code=code, motion_code=motion_code)
    else:
        actions = model.actions(here, effect_code=code)
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
