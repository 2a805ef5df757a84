"""Plan one segment in a sampled scene, execute its pushes in PyBullet, and observe the result.

Letters: N candidates, T pushes, M objects.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from cavin_pyro.criticism.context import CheckContext
from cavin_pyro.data.collection import clutter_area, open_scene
from cavin_pyro.data.observed import observed_state
from envs.objects.sampling import ObjectRanges
from envs.observation import Observation
from envs.scene import Scene
from models.model import Model
from models.state import State
from planning.returns import best_of, squared_distance
from planning.rollout import predict_states
from planning.sampling import sample_each

SAMPLED, CLOSEST, GIVEN = "sampled", "closest", "given by the effect"  # how a motion is obtained

Floats = NDArray[np.floating]


class SegmentPlan(NamedTuple):
    """The pushes of one segment, with the states that the model predicts after them."""

    actions: Floats  # [T, 4] normalised
    subgoal: Floats | None  # [M, 3] metres, by h
    predicted: Floats  # [M, 3] metres, by f along the actions


@dataclass(frozen=True)
class SubgoalRollout:
    """A plan of one segment, executed in one scene.

    Attributes:
        motion: how its code was obtained.
        before, reached: [M, 3] metres, as observed before the first push and after the last.
        unsafe, ineffective: numbers of pushes that were not executed, and that were executed and moved nothing.
        fallen: an object left the table, which ended the rollout. hidden: an object is not visible at the end.
    """

    motion: str
    plan: SegmentPlan
    before: Floats
    reached: Floats
    unsafe: int
    ineffective: int
    fallen: bool
    hidden: bool


def motions(codes: tuple[str, ...]) -> tuple[str, ...]:
    """The ways to obtain a motion for a model with these codes."""
    return {2: (SAMPLED, CLOSEST), 1: (GIVEN,), 0: ()}[len(codes)]


def subgoal_rollouts(
    context: CheckContext, *, scenes: int, objects: int, samples: int
) -> Iterator[list[SubgoalRollout]]:
    """In each scene, one rollout per way to obtain a motion; scene k depends on the seed and k alone.

    Args:
        samples: N, the number of candidates for the closest motion.
    """
    with closing(open_scene(context.world)) as scene:
        for number in range(scenes):
            yield [_rollout(context, scene, number, way, objects, samples) for way in motions(context.codes)]


def sample_scene(scene: Scene, ranges: ObjectRanges, seed: int, number: int, objects: int) -> Observation:
    """Sample scene `number` with so many objects, as cluttered as in collection; equal numbers give equal scenes."""
    generator = np.random.default_rng([seed, number])
    return scene.sample([clutter_area(generator)] * objects, ranges, generator)


def _rollout(
    context: CheckContext, scene: Scene, number: int, motion: str, objects: int, samples: int
) -> SubgoalRollout:
    first = sample_scene(scene, context.world.ranges, context.seed, number, objects)
    seen = {"centers": first.centers, "clouds": first.clouds, "mask": first.mask}
    state = observed_state(seen, context.geometry)
    plan = plan_segment(context.model, state, motion, [context.seed, number], samples)
    reports = []
    for action in plan.actions:
        reports.append(scene.push(np.clip(action, -1.0, 1.0)))
        if reports[-1].fallen:
            break
    last = scene.observe()
    return SubgoalRollout(
        motion,
        plan=plan,
        before=first.centers[:objects],
        reached=last.centers[:objects],
        unsafe=sum(report.unsafe for report in reports),
        ineffective=sum(report.ineffective and not report.unsafe for report in reports),
        fallen=reports[-1].fallen,
        hidden=not last.visible[:objects].all(),
    )


@torch.inference_mode()
def plan_segment(model: Model, state: State, motion: str, seed: list[int], samples: int) -> SegmentPlan:
    """Sample an effect for one scene `state: [1]`, obtain a motion in one of the ways, and generate the pushes.

    A motion code is sampled from the prior, or it is the closest of N: the one that leads f closest to the subgoal, as
    in planning (paper, Algorithm 1, line 10). A model with one code has its motion given by the effect.
    """
    here = state.expand_plans(1)
    if "effect_code" not in model.codes:
        code = sample_each(model.motion_prior, [here], [_generator([*seed, 2])])
        actions = model.actions(here, motion_code=code)
        ends, _ = predict_states(model, here, actions)
        return SegmentPlan(actions[0, 0].numpy(), None, ends.centers[0, 0].numpy())
    code = sample_each(model.effect_prior, [here], [_generator([*seed, 2])])
    subgoal = model.subgoal(here, code)
    if motion == GIVEN:
        actions = model.actions(here, effect_code=code)
    else:
        plans = state.expand_plans(1 if motion == SAMPLED else samples)
        code = code.expand(*plans.batch_shape, -1)
        motion_code = sample_each(model.motion_prior, [plans, code], [_generator([*seed, 3])])
        actions = model.actions(here, effect_code=code, motion_code=motion_code)
    ends, _ = predict_states(model, here, actions)
    best = int(best_of(-squared_distance(ends, subgoal), "distances of motions to the subgoal"))
    return SegmentPlan(actions[0, best].numpy(), subgoal.centers[0, 0].numpy(), ends.centers[0, best].numpy())


def _generator(seed: list[int]) -> torch.Generator:
    return torch.Generator().manual_seed(int(np.random.SeedSequence(seed).generate_state(1)[0]))
